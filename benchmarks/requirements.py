"""Designs for zones with requirements, beside those of another commit: what they meet, b, time.

Each case is designed by both trees, in processes of their own, one thread. Its result is judged
here, on 4,800 positions of each zone that neither has seen: zones that pass, the mean over the
zones of the missing share (what a zone lacks of its required share, relative to it), the smallest
margin, and b. Needs a worktree of the other commit:

    git worktree add ../other 89b6c2a7
    python benchmarks/requirements.py ../other [--json F] [--cases office-8,rooms-6] [--seeds 3]
"""

from __future__ import annotations

import side_by_side  # noqa: F401  # isort: skip (sets the number of threads)

import json
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from trees import as_line, in_tree, read_options

ROOT = Path(__file__).resolve().parents[1]
SETS = 8
Tables = dict[str, Any]


def rooms() -> Tables:
    """Six rooms of 6 x 5 m along a corridor, with brick walls and doors; each is a zone."""
    wall = {"high_m": 3.0, "material": "brick", "thickness_m": 0.15}
    lines = [
        *([[x, y], [x + 4.5, y]] for x in (0, 6, 12) for y in (5, 7)),
        *([[x, low], [x, high]] for x in (6, 12) for low, high in ((0, 5), (7, 12))),
    ]
    inner = (0.5, 0.5), (5.5, 0.5), (5.5, 4.5), (0.5, 4.5)
    zones = [
        {
            "name": f"room {k + 1}",
            "polygon": [[x + a, y + b] for a, b in inner],
            "low_m": 0.5,
            "high_m": 1.5,
            "attitude": "level",
            "position_m": 0.15,
        }
        for k, (x, y) in enumerate((x, y) for y in (0, 7) for x in (0, 6, 12))
    ]  # fmt: skip
    corridor = {
        "name": "corridor",
        "polygon": [[0.5, 5.3], [17.5, 5.3], [17.5, 6.7], [0.5, 6.7]],
        "low_m": 0.5, "high_m": 1.5, "attitude": "level", "position_m": 0.3,
    }  # fmt: skip
    outer = [[0, 0], [18, 0], [18, 12], [0, 12]]
    return {
        "name": "rooms",
        "anchors": {"number": 8},
        "walls": [
            {"line": outer, "closed": True, "high_m": 3.0, "material": "concrete"},
            *({"line": line, **wall} for line in lines),
        ],
        "mounts": [{"kind": "ceiling", "polygon": outer, "height_m": 2.9}],
        "zones": [*zones, corridor],
        "body": {"shape": "octahedron", "size_m": 0.6},
        "noise": {"floor_m": 0.1, "blocked_information": 0.01},
    }


def aisles() -> Tables:
    """A hall of 40 x 24 m with five steel racks; the aisles are a zone, and the dock is one."""
    racks = [
        {"low": [4.0, y, 0.0], "high": [32.0, y + 1.2, 5.0], "material": "metal"}
        for y in (3.0, 7.5, 12.0, 16.5, 21.0)
    ]
    return {
        "name": "aisles",
        "anchors": {"number": 10, "kind": "room", "low": [0, 0, 3.0], "high": [40, 24, 8.0]},
        "obstacles": racks,
        "zones": [
            {"name": "aisles", "low": [3, 1, 0.3], "high": [33, 23, 2.0], "attitude": "level",
             "position_m": 0.3, "heading_deg": 15},
            {"name": "dock", "low": [34, 1, 0.3], "high": [39, 23, 2.0], "attitude": "level",
             "position_m": 0.15, "heading_deg": 8},
        ],
        "body": {"tags": [[0.5, 0.4, 0.3], [-0.5, 0.4, 0], [-0.5, -0.4, 0.3], [0.5, -0.4, 0]]},
        "noise": {"floor_m": 0.1, "proportional": 0.003},
    }  # fmt: skip


def case(file: str, number: int, survive: int = 0, fewest: bool = False) -> Tables:
    return {"file": file, "number": number, "survive": survive, "fewest": fewest}


CASES: dict[str, Tables] = {
    **{f"office-{n}": case("office.toml", n) for n in (5, 6, 8, 10)},
    "office-12-survive": case("office.toml", 12, 1),
    "office-fewest": case("office.toml", 12, fewest=True),
    **{f"small-{n}": case("small_office.geojson", n) for n in (4, 5, 6)},
    "small-6-survive": case("small_office.geojson", 6, 1),
    "small-fewest": case("small_office.geojson", 8, fewest=True),
    **{f"rooms-{n}": case("rooms", n) for n in (6, 9, 12, 18)},
    **{f"aisles-{n}": case("aisles", n) for n in (6, 10, 14)},
}


def problem_of(row: Tables) -> Any:
    from rbl_gym.placement import scene_files
    from rbl_gym.placement.plans import layers, toml_text
    from rbl_gym.placement.plans.reading import read_drawing

    path = ROOT / "examples" / row["file"]
    if row["file"].endswith(".toml"):
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        tables.pop("openings")  # the other commit knows neither these nor names
        for obstacle in tables["obstacles"]:
            obstacle.pop("name")
        problem = scene_files.of_mapping(tables)
    elif row["file"].endswith(".geojson"):
        problem = scene_files.of_mapping(
            toml_text.plain(layers.building(read_drawing(str(path))).tables)
        )
    else:
        problem = scene_files.of_mapping({"rooms": rooms, "aisles": aisles}[row["file"]]())
    return scene_files.with_anchors(problem, row["number"])


def measure(row: Tables, seed: int) -> Tables:
    """The layout that this tree designs, and its process time."""
    from rbl_gym.studies.placing import answer, choosing
    from rbl_gym.studies.progress import silent

    def work(row: Tables) -> Any:
        problem = problem_of(row)
        if row["fewest"]:
            numbers = range(3, row["number"] + 1)
            return choosing.fewest_anchors(problem, numbers, seed, row["survive"]).anchors
        number = range(row["number"], row["number"] + 1)
        question = answer.Question(number, survive=row["survive"], seed=seed)
        return answer._designed(problem, question, None, silent).anchors

    work(CASES["small-4"])  # compiles
    begin = time.process_time()
    anchors = work(row)
    return {"anchors": anchors.tolist(), "seconds": time.process_time() - begin}


def judge(row: Tables, anchors: np.ndarray) -> Tables:
    from rbl_gym.placement import scene_files
    from rbl_gym.studies.placing import judging, ranking
    from rbl_gym.studies.placing.accuracy import spread_places
    from rbl_gym.studies.placing.requirements import share_within, value_at_share

    problem = scene_files.with_anchors(problem_of(row), len(anchors))
    judged = []
    for zone in problem.zones:
        rng = np.random.default_rng([7, 70])
        places = np.concatenate(
            [spread_places(problem, zone, rng, judging.PLACES) for _ in range(SETS)]
        )
        judged.append(judging._judged(problem, zone, anchors, places, row["survive"]))
    shares = [float(share_within(one.relative)) for one in judged if one.asks]
    needed = [one.zone.share for one in judged if one.asks]
    missing = [max(0.0, 1 - a / b) for a, b in zip(shares, needed, strict=True)]
    margin = min(1 / value_at_share(one.relative, one.zone.share) for one in judged if one.asks)
    b = ranking.overall_score([one.zone for one in judged], [one.errors.score for one in judged])
    return {
        "anchors": len(anchors),
        "passed": sum(one == 0 for one in missing),
        "missing": float(np.mean(missing)),
        "margin": float(margin),
        "b_m": float(b),
    }


def usual_b(row: Tables, seed: int) -> tuple[float, int]:
    """The smallest b of the usual layouts, and the most zones that one of them passes."""
    from rbl_gym.studies.placing import design

    found = [judge(row, x) for x in design.usual_layouts(problem_of(row), seed).values()]
    return min(one["b_m"] for one in found), max(one["passed"] for one in found)


def main() -> None:
    options = read_options(__doc__, CASES)
    if options.measure:
        print(json.dumps(measure(CASES[options.measure], options.seed)))
        return
    trees = {"ours": ROOT}
    if options.other:
        trees = {"other": Path(options.other).resolve(), **trees}
    rows: list[Tables] = []
    for name in options.cases.split(","):
        for seed in range(options.seeds):
            best, most = usual_b(CASES[name], seed)
            for tree, path in trees.items():
                found = in_tree(__file__, path, name, seed)
                told = judge(CASES[name], np.array(found["anchors"]))
                row = {"case": name, "seed": seed, "tree": tree, **told}
                row |= {"usual_b_m": best, "usual_passed": most, "seconds": found["seconds"]}
                rows.append(row)
                print(as_line(row), flush=True)
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
