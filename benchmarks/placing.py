"""The search of `place` beside that of commit 282192e: b on fresh places and process time, one run.

Each case is a file of tables that both read: an L-shaped floor with 31 walls and racks, halls, a
warehouse of 20,000 m2. Both design a layout, each in a process of its own, one thread; what they
find is judged here on the same 6,000 places, drawn at random, that neither has seen. Last, the
references of the environments on random contexts: the search along the gradient beside CMA-ES.
Needs a worktree of the other commit:

    git worktree add ../other 282192e
    python benchmarks/placing.py ../other [--json F] [--cases floor8,hall16] [--seeds 1]
"""

from __future__ import annotations

import side_by_side  # noqa: F401  # isort: skip (sets the number of threads)

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from trees import as_line, in_tree, read_options

PLACES, CONTEXTS = 6000, 64
Tables = dict[str, Any]


def box(low: Any, high: Any) -> Tables:
    return {"low": [float(x) for x in low], "high": [float(x) for x in high]}


def tables(name: str, number: int, size: Any, obstacles: list[Tables], work: Any) -> Tables:
    """A file: anchors on walls and ceiling of a room, and the body in a box of it."""
    return {
        "name": name,
        "anchors": {"kind": "room", "low": [0.0, 0.0, 0.5], "high": list(size), "number": number},
        "region": box(*work),
        "obstacles": obstacles,
        "body": {"shape": "octahedron", "size_m": 0.8},
        "noise": {"floor_m": 0.1, "proportional": 0.005},
    }


def floor(number: int) -> Tables:
    """60 x 40 m, L-shaped: the corner beyond (38, 24) is solid; a corridor, rooms with doors."""
    height, half = 4.0, 0.1
    found = [box((38, 24, 0), (60, 40, height))]
    for y, ends in (
        (14.0, (0, 8, 10, 20, 22, 32, 34, 44, 46, 58)),
        (17.0, (2, 12, 14, 26, 28, 38)),
        (29.0, (0, 9, 13.5, 22.5, 26, 35)),
    ):
        pairs = zip(ends[::2], ends[1::2], strict=True)
        found += [box((a, y - half, 0), (b, y + half, height)) for a, b in pairs]
    spans = dict.fromkeys((10.0, 20.0, 30.0, 40.0, 50.0), ((0, 5.5), (7, 14)))
    spans |= dict.fromkeys((12.0, 25.0), ((17, 26), (28, 40)))
    for x, pairs in spans.items():
        found += [box((x - half, a, 0), (x + half, b, height)) for a, b in pairs]
    for low, high in (
        ((3, 33), (8, 33.8)), ((30, 33), (35, 33.8)), ((42, 19), (50, 20)), ((52, 18), (53, 23)),
        ((15, 33), (16, 38)),
    ):  # fmt: skip
        found.append(box((*low, 0), (*high, 2.2)))
    size = (60.0, 40.0, height)
    return tables("floor", number, size, found, ((0.5, 0.5, 0.4), (59.5, 39.5, 2.0)))


def hall(number: int, x: float, y: float, z: float) -> Tables:
    return tables("hall", number, (x, y, z), [], ((1, 1, 0.4), (x - 1, y - 1, 2.0)))


def warehouse(number: int, racks: int) -> Tables:
    """200 x 100 m with racks at random."""
    x, y, rng, found = 200.0, 100.0, np.random.default_rng([1, racks]), []
    for _ in range(racks):
        centre = rng.uniform((5, 5), (x - 5, y - 5))
        half = rng.uniform((0.5, 3), (0.8, 6))
        half = half[::-1] if rng.random() < 0.5 else half
        low, high = np.maximum(centre - half, 0.2), np.minimum(centre + half, (x - 0.2, y - 0.2))
        found.append(box((*low, 0), (*high, rng.uniform(3, 7))))
    return tables("warehouse", number, (x, y, 10.0), found, ((1, 1, 0.4), (x - 1, y - 1, 3.0)))


CASES: dict[str, Tables] = {
    **{f"floor{n}": floor(n) for n in (8, 16, 32)},
    **{f"hall{n}": hall(n, 60, 40, 8) for n in (8, 16, 32)},
    **{f"low-hall{n}": hall(n, 60, 40, 4) for n in (8, 16, 32)},
    **{f"large-hall{n}": hall(n, 200, 100, 10) for n in (8, 16, 32)},
    "warehouse32": warehouse(32, 90),
}


def main() -> None:
    options = read_options(__doc__, CASES)
    if options.measure:
        print(json.dumps(measure(options.measure, options.seed)))
        return
    rows: list[Tables] = []
    trees = {"other": Path(options.other).resolve(), "ours": Path(__file__).resolve().parents[1]}
    for name in filter(None, options.cases.split(",")):
        for seed in range(options.seeds):
            found = {key: in_tree(__file__, tree, name, seed) for key, tree in trees.items()}
            b = {key: judge(CASES[name], np.array(row["anchors"])) for key, row in found.items()}
            row = {"case": name, "seed": seed}
            row |= {f"b_{key}_m": value for key, value in b.items()}
            row |= {f"{key}_s": found[key]["seconds"] for key in found}
            row |= {"b_ratio": b["ours"] / b["other"]}
            row |= {"time_ratio": row["ours_s"] / row["other_s"]}
            rows.append(row)
            print(as_line(row), flush=True)
    few, many = (in_tree(__file__, trees["ours"], f"obstacles{n}", 0)["seconds"] for n in (40, 400))
    rows.append({"case": "400 obstacles over 40", "time_ratio": many / few})
    print(as_line(rows[-1]), flush=True)
    for scene, racks in (("auv_buoys", 0), ("drone_yard", 0), ("uwb_room", 2)):
        rows.append({"case": scene, **contexts(scene, racks)})
        print(as_line(rows[-1]), flush=True)
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1))


def measure(name: str, seed: int) -> Tables:
    """The layout that this tree designs, and its process time."""
    try:
        from rbl_gym.placement import scene_files
        from rbl_gym.studies.placing.design import design_layout
    except ImportError:  # the other commit
        from rbl_gym import scene_files
        from rbl_gym.app.place import design as design_layout
    # Kernels are loaded, or compiled, before.
    design_layout(scene_files.of_mapping(hall(4, 20, 10, 4)), 0)
    design_layout(scene_files.of_mapping({**floor(4), "obstacles": floor(4)["obstacles"][:2]}), 0)
    case = warehouse(12, int(name[9:])) if name.startswith("obstacles") else CASES[name]
    problem = scene_files.of_mapping(case)
    begin = time.process_time()
    found = design_layout(problem, seed)
    return {"anchors": found.anchors.tolist(), "seconds": time.process_time() - begin}


def judge(case: Tables, anchors: Any) -> float:
    """b over fresh places, each at a random turn of the body; sight to the body's origin."""
    from rbl_gym import rotations
    from rbl_gym.placement import scene_files, setting
    from rbl_gym.placement.sample import sample

    problem = scene_files.of_mapping(case)
    rng = np.random.default_rng(20260101)
    places = rng.uniform(*problem.corners(), (4 * PLACES, 3))
    places = places[~problem.obstacles.contain(places)][:PLACES]
    poses = sample(problem, PLACES)._replace(
        places=places, rotation=rotations.random(rng, (PLACES,))
    )
    one = setting.of_problem(problem, poses)
    told = poses.prior.copy()
    for anchor in anchors:
        told += one.parts(anchor[None])[0]
    return float(np.sqrt(one.squares(told)))


def contexts(scene: str, racks: int) -> Tables:
    """The search along the gradient on contexts: 0 random layouts, 1 CMA-ES, 1920 evaluations."""
    from rbl_gym import placement
    from rbl_gym.placement import layouts, search

    task, rng = placement.task(scene, None, racks), np.random.default_rng(7)
    drawn = placement.draw_contexts(task, rng, (CONTEXTS,))

    def value(anchors: Any) -> float:
        return float(np.log(placement.score(task, drawn, anchors)).mean())

    chance = float(np.mean([value(layouts.random(task, drawn, rng)) for _ in range(8)]))
    for method in (search.along_gradient, search.cma_es):
        method(task, placement.draw_contexts(task, rng, (1,)), rng)
    begin = time.process_time()
    strongest = value(search.cma_es(task, drawn, rng))
    middle = time.process_time()
    ours = value(search.along_gradient(task, drawn, rng))
    seconds = time.process_time() - middle
    return {
        "of_cma_es": (chance - ours) / (chance - strongest),
        "time_ratio": seconds / (middle - begin),
    }


if __name__ == "__main__":
    main()
