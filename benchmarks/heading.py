"""The heading error of a layout against the distance of the tags and the number of anchors.

Grids of anchors under the ceiling of a hall of 12 x 8 x 3 m, and of 40 x 24 x 8 m, two tags, ranges
of 0.1 m; the 95th percentile of the heading error over the hall. Then b of `examples/office.toml`
with the line of sight to the body's origin only, as the search tests it, over b with that to every
tag; eight anchors, seeds 0 to 4.

    python benchmarks/heading.py
"""

from __future__ import annotations

import side_by_side  # noqa: F401  # isort: skip (sets the number of threads)

from pathlib import Path

import numpy as np

from rbl_gym import bounds
from rbl_gym.placement import design, scene_files
from rbl_gym.placement.sample import prior_of
from rbl_gym.studies.placing import accuracy, links, ranking
from rbl_gym.studies.placing.requirements import errors_of, turns

OFFICE = Path(__file__).resolve().parents[1] / "examples" / "office.toml"


def heading_p95(
    size: tuple[float, float, float], distance_m: float, grid: tuple[int, int]
) -> float:
    x, y, z = size
    tables = {
        "anchors": {"kind": "room", "low": [0, 0, 0.5], "high": list(size), "number": 4},
        "zones": [{"name": "hall", "low": [1, 1, 0.5], "high": [x - 1, y - 1, 1.5],
                   "attitude": "heading"}],
        "body": {"tags": [[distance_m / 2, 0, 0], [-distance_m / 2, 0, 0]]},
        "noise": {"floor_m": 0.1},
    }  # fmt: skip
    problem = scene_files.of_mapping(tables)
    axes = [(np.arange(n) + 0.5) / n * length for n, length in zip(grid, size, strict=False)]
    anchors = np.stack([*np.meshgrid(*axes), np.full(grid[::-1], z)], axis=-1).reshape(-1, 3)
    (zone,) = problem.zones
    places = accuracy.draw_places(problem, zone, np.random.default_rng(0), 2000)
    heading = accuracy.accuracy(problem, anchors, places, zone).heading
    return float(np.rad2deg(np.quantile(heading, 0.95)))


def of_sight(seed: int) -> float:
    problem = scene_files.problem(str(OFFICE))
    anchors, _ = design.find_layout(problem, np.random.default_rng(seed))
    scores: dict[bool, list[np.ndarray]] = {False: [], True: []}
    for zone in problem.zones:
        places = accuracy.draw_places(problem, zone, np.random.default_rng([seed, 1]), 1000)
        rotation, prior = turns(zone.attitude, 9), prior_of(problem, zone)
        for origin in scores:
            share = links.link_shares(problem, anchors, places, rotation)
            if origin:
                share[:] = problem.share(anchors, places)[:, None, :, None]
            told = bounds.information_at(
                anchors, problem.tags, rotation, places[:, None], problem.noise, share
            )
            scores[origin].append(errors_of(told + prior, rotation, problem.tags).score)
    zones = list(problem.zones)
    b = {key: ranking.overall_score(zones, found) for key, found in scores.items()}
    return float(b[True] / b[False])


def main() -> None:
    for size in ((12.0, 8.0, 3.0), (40.0, 24.0, 8.0)):
        print(f"hall {size}: heading p95, degrees")
        for distance in (0.3, 0.6, 1.2):
            found = {grid: heading_p95(size, distance, grid) for grid in ((2, 2), (4, 2), (4, 4))}
            row = ", ".join(f"{a * b} anchors {value:.2f}" for (a, b), value in found.items())
            print(f"  tags {distance} m apart: {row}")
    ratios = [of_sight(seed) for seed in range(5)]
    print("b by the sight of the origin / of every tag:", ", ".join(f"{x:.3f}" for x in ratios))


if __name__ == "__main__":
    main()
