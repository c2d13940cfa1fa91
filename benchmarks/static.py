"""Static localization against scipy: time per problem, side by side, same residuals.

1000 problems of 10 anchors and 6 tags in one call of `locate`, against
`scipy.optimize.least_squares` on the whitened range residuals of each problem, started from the
CLS pose (which favours it). Process time, one thread, medians over interleaved repeats; the
results are checked equal first.

    python benchmarks/static.py [--json F] [--repeats 5] [--seed 0]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from rbl_gym import bodies, estimators, ranging, rotations, scenes

PROBLEMS, PEER_PROBLEMS = 1000, 40
METHODS = ("ls", "cls", "procrustes", "two-step", "ml", "robust")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", metavar="F")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    results = {str(db): measure(db, options.repeats, options.seed) for db in (40, 60, 80)}
    print(f"{'dB':>4} {'method':<12} {'us/problem':>11} {'scipy us':>9} {'ratio':>7}")
    for db, rows in results.items():
        for method, row in rows.items():
            print(f"{db:>4} {method:<12} {row['microseconds']:11.1f} "
                  f"{row['peer_microseconds']:9.0f} {row['ratio']:7.1f}")  # fmt: skip
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n")


def measure(db: int, repeats: int, seed: int) -> dict[str, dict[str, float]]:
    """Medians per method at a reference range."""
    rng = np.random.default_rng([seed, db])
    scene = scenes.SCENES["icassp2013"]
    tags = bodies.icassp2013()
    noise = ranging.RangeNoise.from_reference_range_db(db)
    anchors = rng.uniform(-50, 50, (PROBLEMS, 10, 3))
    ranges = ranging.simulate(
        anchors, tags, scene.start_rotation, scene.start_translation, noise, rng
    ).ranges
    starts = estimators.locate(ranges, anchors, tags, noise, "cls")
    root = np.sqrt(1 / np.broadcast_to(noise.variance(ranges), ranges.shape))

    def peer(k: int) -> float:
        def residuals(x: np.ndarray) -> np.ndarray:
            positions = x[3:] + tags @ rotations.exp(x[:3]).T
            difference = positions[None] - anchors[k][:, None]
            distance = np.sqrt(np.einsum("mni,mni->mn", difference, difference))
            return (root[k] * (distance - ranges[k])).ravel()

        start = np.concatenate([rotations.log(starts.rotation[k]), starts.translation[k]])
        return least_squares(residuals, start).cost

    found = estimators.locate(ranges, anchors, tags, noise, "ml")
    costs = [peer(k) for k in range(PEER_PROBLEMS)]
    assert (found.cost[:PEER_PROBLEMS] <= np.array(costs) * (1 + 1e-6)).all()
    times: dict[str, list[float]] = {method: [] for method in (*METHODS, "peer")}
    for _ in range(repeats):
        begin = time.process_time()
        for k in range(PEER_PROBLEMS):
            peer(k)
        times["peer"].append((time.process_time() - begin) / PEER_PROBLEMS)
        for method in METHODS:
            begin = time.process_time()
            estimators.locate(ranges, anchors, tags, noise, method)
            times[method].append((time.process_time() - begin) / PROBLEMS)
    ratios = {m: np.median(np.divide(times["peer"], times[m])) for m in METHODS}
    return {
        method: {
            "microseconds": 1e6 * float(np.median(times[method])),
            "peer_microseconds": 1e6 * float(np.median(times["peer"])),
            "ratio": float(ratios[method]),
        }
        for method in METHODS
    }


if __name__ == "__main__":
    main()
