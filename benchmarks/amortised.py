"""The network of `placement.amortised` on held-out problems, beside the best that searches find.

    python benchmarks/amortised.py --worlds 256
    python benchmarks/amortised.py --worlds 32 --families auv_buoys,buildings

Normalised: 0 is a random layout, 1 the best known, that of the gradient from the ring, greedy with
swaps and then the gradient, and CMA-ES and then the gradient; in buildings of `placement.design`.
Needs the extra ``placement``.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym import placement
from rbl_gym.placement import amortised, design, scene_files, search, setting
from rbl_gym.placement.building import Problem
from rbl_gym.placement.descent import descend
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.placement.sample import sample
from rbl_gym.worlds import scenes

FAMILIES = {
    "auv_buoys": ("auv_buoys", 0),
    "drone_yard": ("drone_yard", 0),
    "satellite": ("satellite", 0),
    "uwb_room": ("uwb_room", 0),
    "uwb_room, 1 rack": ("uwb_room", 1),
    "uwb_room, 2 racks": ("uwb_room", 2),
}
# Anchors of the worlds, in turns; evaluations after the network.
COUNTS, EVALUATIONS = range(3, 13), (0, 6, 20)
# Random layouts of a problem, and evaluations of the gradient in what is the best known.
_RANDOM, _LONG = 8, 60
CMA_EVALUATIONS = 120 * 16


def one(context: Context, index: int) -> Context:
    """One context of many."""
    return Context(*(field[index] for field in context))


def task_rows(scene: str, racks: int, count: int, worlds: int, options: Any) -> np.ndarray:
    """Log scores at random, best known, and for EVALUATIONS; then seconds of the search and those.

    Shape (worlds, 3 + 2 * len(EVALUATIONS)).
    """
    task = PlacementTask(scenes.get(scene), count, racks)
    contexts = placement.draw_contexts(task, np.random.default_rng([2026, count]), (worlds,))
    known = kept(
        options, f"{scene}-{racks}-{count}-{worlds}", lambda: searched(task, contexts, count)
    )
    scores, seconds = [], []
    for number in EVALUATIONS:
        amortised.of_task(task, one(contexts, 0), number, options.played)
        began = time.process_time()
        layouts = amortised.of_task(task, contexts, number, options.played)
        seconds.append(np.full(worlds, (time.process_time() - began) / worlds))
        scores.append(np.log(placement.score(task, contexts, layouts)))
    return np.column_stack([known[:, :2], *scores, known[:, 2], *seconds])


def searched(task: PlacementTask, contexts: Context, count: int) -> np.ndarray:
    """Log scores (C, 2) at random and of the best known, and seconds of CMA-ES."""
    worlds, rng = len(contexts.centre), np.random.default_rng([1, count])
    drawn = task.scene.anchor_region.draw(rng.random((worlds, _RANDOM, count, 3)))
    at_random = np.log(placement.score(task, search.expand(contexts), drawn)).mean(axis=-1)
    began = time.process_time()
    strongest = search.cma_es(task, contexts, rng)
    seconds = (time.process_time() - began) / worlds
    rows = []
    for index in range(worlds):
        context = one(contexts, index)
        seen = setting.of_task(task, context)
        starts = [
            strongest[index],
            search.greedy_swaps(task, context, rng),
            search.along_gradient(task, context, rng, _LONG),
        ]
        rows.append(min(descend(seen, start, _LONG)[1] for start in starts))
    return np.column_stack([at_random, np.log(rows), np.full(worlds, seconds)])


def kept(options: Any, name: str, make: Any) -> Any:
    """What `make` gives, from the folder of --keep where it is there already."""
    if not options.keep:
        return make()
    path = Path(options.keep) / f"{name}.npy"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, make())
    return np.load(path)


def building(rng: np.random.Generator) -> dict[str, Any]:
    """The tables of a random building: inner walls, furniture, up to three zones."""
    x, y, z = (round(float(rng.uniform(*pair)), 2) for pair in ((12, 36), (9, 24), (2.7, 4.5)))
    outer, materials = [[0, 0], [x, 0], [x, y], [0, y]], {"drywall": 0.6, "brick": 0.15}
    walls: list[dict[str, Any]] = [{"line": outer, "closed": True, "thickness_m": 0.3, "high_m": z}]
    for _ in range(int(rng.integers(2, 5))):
        axis = int(rng.integers(2))
        size = (x, y)
        across, end = rng.uniform(0.25, 0.75) * size[axis], rng.uniform(0.35, 0.8) * size[1 - axis]
        ends = (0.15, end) if rng.random() < 0.5 else (size[1 - axis] - end, size[1 - axis] - 0.15)
        line = [[across, a] if axis == 0 else [a, across] for a in ends]
        material = str(rng.choice(list(materials)))
        walls.append({"line": line, "thickness_m": 0.1, "high_m": z, "material": material})
    places = rng.uniform(0.2, 0.8, (int(rng.integers(0, 4)), 2)) * (x, y)
    obstacles = [
        {"low": [a - 0.8, b - 0.4, 0.0], "high": [a + 0.8, b + 0.4, 1.8]} for a, b in places
    ]
    high = {"low_m": z - 0.8, "high_m": z - 0.2}
    mounts: list[dict[str, Any]] = [{"kind": "wall", "line": outer, "closed": True, **high}]
    if rng.random() < 0.7:
        inside = [[0.15, 0.15], [x - 0.15, 0.15], [x - 0.15, y - 0.15], [0.15, y - 0.15]]
        mounts.append({"kind": "ceiling", "polygon": inside, "height_m": z - 0.1})
    if rng.random() < 0.5:
        mounts.append({"kind": "wall", "line": walls[1]["line"], "side": "both", **high})
    zones = []
    for _ in range(int(rng.integers(1, 4))):
        w, d = rng.uniform(0.25, 0.9, 2) * (x - 1, y - 1)
        a, b = 0.5 + rng.random(2) * (x - 1 - w, y - 1 - d)
        polygon = [[a, b], [a + w, b], [a + w, b + d], [a, b + d]]
        attitude = str(rng.choice(["free", "level"]))
        zones.append({"polygon": polygon, "low_m": 0.3, "high_m": 1.4, "attitude": attitude})
    tables = {
        "anchors": {"number": int(rng.integers(4, 13))},
        "materials": materials,
        "walls": walls,
        "obstacles": obstacles,
        "mounts": mounts,
        "zones": zones,
        "body": {"shape": "octahedron", "size_m": rng.uniform(0.4, 1.2)},
        "noise": {"floor_m": rng.uniform(0.05, 0.2), "blocked_information": 0.01},
    }
    return json.loads(json.dumps(tables, default=float))


def building_row(problem: Problem, number: int, options: Any) -> np.ndarray:
    """As a row of `task_rows`, of one building."""
    seen = setting.of_problem(problem, sample(problem, 256))
    known = kept(options, f"building-{number}", lambda: designed(problem, seen))
    scores, seconds = [], []
    for number in EVALUATIONS:
        amortised.of_problem(problem, number, options.played)
        began = time.process_time()
        layout = amortised.of_problem(problem, number, options.played)
        seconds.append(time.process_time() - began)
        scores.append(np.log(seen.score(layout)))
    return np.array([*known[:2], *scores, known[2], *seconds])


def designed(problem: Problem, seen: setting.Setting) -> np.ndarray:
    """As `searched`, the best known that of `placement.design`, and its seconds."""
    rng, count = np.random.default_rng(0), problem.n_anchors
    began = time.process_time()
    best, _ = design.find_layout(problem, rng)
    seconds = time.process_time() - began
    at_random = [
        np.log(seen.score(rng.permutation(design.free_candidates(problem, rng, 400))[:count]))
        for _ in range(_RANDOM)
    ]
    return np.array([np.mean(at_random), np.log(seen.score(best)), seconds])


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--worlds", type=int, default=32)
    parser.add_argument("--families", help="some of the rows, by how they begin, with commas")
    parser.add_argument("--network", help="a file in place of the package's")
    parser.add_argument("--keep", metavar="FOLDER", help="references are kept there")
    parser.add_argument("--each", action="store_true", help="a row for each number of anchors")
    options = parser.parse_args()
    options.played = None
    if options.network:
        options.played = amortised.read(Path(options.network))
    asked = options.families.split(",") if options.families else [*FAMILIES, "buildings"]
    heads = (f"{f'after {n}':>6}  [95 %]        time" for n in EVALUATIONS)
    print(f"{'':18}", *(f"{head:31}" for head in heads), "  worst without evaluations")
    for name, (scene, racks) in FAMILIES.items():
        if not any(name.startswith(one) for one in asked):
            continue
        table = []
        for turn, count in enumerate(COUNTS):
            worlds = len(range(turn, options.worlds, len(COUNTS)))
            if worlds:
                table.append(task_rows(scene, racks, count, worlds, options))
                if options.each:
                    print_row(f"{name}: {count}", table[-1])
        print_row(name, np.concatenate(table))
    if any("buildings".startswith(one) for one in asked):
        rng, rows = np.random.default_rng(2026), []
        while len(rows) < options.worlds:
            try:
                problem = scene_files.of_mapping(building(rng))
            except ValueError:  # a zone inside of furniture, too few places
                continue
            rows.append(building_row(problem, len(rows), options))
        print_row("buildings", np.array(rows))


def print_row(name: str, rows: np.ndarray) -> None:
    """One family: normalised values of means, intervals by the bootstrap over problems, times."""
    index = np.random.default_rng(0).integers(len(rows), size=(1000, len(rows)))

    def normalised(means: np.ndarray, column: int) -> Any:
        return (means[..., 0] - means[..., column]) / (means[..., 0] - means[..., 1])

    means, columns, n = rows.mean(axis=0), [], len(EVALUATIONS)
    for column in range(2, 2 + n):
        low, high = np.quantile(normalised(rows[index].mean(axis=1), column), [0.025, 0.975])
        share = means[2 + n] / means[column + 1 + n]
        columns.append(f"{normalised(means, column):.4f} [{low:.4f}, {high:.4f}]  1/{share:<6.0f}")
    print(f"{name:18}", *columns, f"  {normalised(rows, 2).min():.3f}", flush=True)


if __name__ == "__main__":
    main()
