"""Epochs as raw ranges against epochs as the statistic: time per trial, side by side, one law.

Generation is normals and measurement, from true poses to ranges (M, N) or to G and B; the step
adds the batched KF's update. The means are checked equal first: the statistic of noise-free
ranges, and the filter's state of either. Process time, one thread, medians over interleaved
repeats; ratios are raw ranges over the statistic.

    python benchmarks/statistic.py [--json F] [--repeats 15] [--trials 1024] [--seed 0]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym import estimators, motion, ranging, rotations, statistic
from rbl_gym.estimators import squared_range

SIZES = ((4, 5), (10, 6), (50, 20))
NOISE = ranging.SquaredRangeNoise(0.05)
PROCESS = motion.ProcessNoise(0.02, 0.1)
STAGES = ("normals", "generation", "step")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", metavar="F")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--trials", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    results = {
        f"{m}x{n}": measure(m, n, options.trials, options.repeats, options.seed) for m, n in SIZES
    }
    print(f"{'M x N':<7} {'stage':<11} {'ranges us':>10} {'statistic us':>13} {'ratio':>7}")
    for size, rows in results.items():
        for stage, row in rows.items():
            print(f"{size:<7} {stage:<11} {row['ranges_microseconds']:10.3f} "
                  f"{row['statistic_microseconds']:13.3f} {row['ratio']:7.2f}")  # fmt: skip
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n")


def measure(m: int, n: int, trials: int, repeats: int, seed: int) -> dict[str, dict[str, float]]:
    """Medians per stage at one number of anchors and tags."""
    world = World(np.random.default_rng([seed, m, n]), m, n, trials)
    world.check()
    jobs = {
        ("normals", "ranges"): lambda: world.rng.standard_normal((trials, m, n)),
        ("normals", "statistic"): lambda: world.rng.standard_normal((trials, 3, 4)),
        ("generation", "ranges"): world.ranges,
        ("generation", "statistic"): world.statistic,
        ("step", "ranges"): lambda: world.filter.update(world.prior, world.ranges(), world.anchors),
        ("step", "statistic"): lambda: world.filter.update_statistic(
            world.prior, *world.statistic()
        ),
    }
    times: dict[tuple[str, str], list[float]] = {job: [] for job in jobs}
    for _ in range(repeats):
        for job, run in jobs.items():
            times[job].append(clock(run) / trials)
    rows = {}
    for stage in STAGES:
        raw, small = times[stage, "ranges"], times[stage, "statistic"]
        rows[stage] = {
            "ranges_microseconds": 1e6 * float(np.median(raw)),
            "statistic_microseconds": 1e6 * float(np.median(small)),
            "ratio": float(np.median(np.divide(raw, small))),
        }
    return rows


def clock(run: Callable[[], Any], calls: int = 5) -> float:
    """Process time of a call, seconds."""
    begin = time.process_time()
    for _ in range(calls):
        run()
    return (time.process_time() - begin) / calls


class World:
    """Trials of one epoch: true poses, and a KF with its prior."""

    def __init__(self, rng: np.random.Generator, m: int, n: int, trials: int) -> None:
        self.rng = rng
        tags = rng.uniform(-0.5, 0.5, (n, 3))
        self.tags = tags - tags.mean(axis=0)
        # On a shell around the body: no anchor stands on a tag.
        places = rng.standard_normal((trials, m, 3))
        self.anchors = 15 * places / np.linalg.norm(places, axis=-1, keepdims=True)
        self.pose = rotations.random(rng, (trials,)), rng.uniform(-3, 3, (trials, 3))
        self.filter = estimators.make("kf", tags=self.tags, noise=NOISE, process=PROCESS)
        state = self.filter.initial(*self.pose, np.diag([0.02] * 3 + [1.0] * 3))
        self.prior = self.filter.predict(state, 0.5 * rng.standard_normal((trials, 6)), 0.1)

    def true_ranges(self) -> np.ndarray:
        """Distances (B, M, N)."""
        return ranging.distances(self.anchors, ranging.tag_positions(*self.pose, self.tags))

    def ranges(self) -> np.ndarray:
        """Noisy ranges."""
        true = self.true_ranges()
        return ranging.measure(true, NOISE, self.rng.standard_normal(true.shape)).ranges

    def statistic(self) -> statistic.EpochStatistic:
        """G and B, drawn."""
        normals = self.rng.standard_normal((len(self.anchors), 3, 4))
        return statistic.measure_statistic(self.anchors, self.tags, *self.pose, NOISE, normals)

    def check(self) -> None:
        """Without noise both modes are one, and so is the filter after either; or the run stops."""
        true = self.true_ranges()
        weights = 1 / NOISE.squared_range_variance(true)
        want = squared_range.paper_matrices(
            squared_range.statistic(true, self.anchors, self.tags, weights)
        )
        got = statistic.measure_statistic(
            self.anchors, self.tags, *self.pose, NOISE, np.zeros((3, 4))
        )
        states = (
            self.filter.update(self.prior, true, self.anchors),
            self.filter.update_statistic(self.prior, *got),
        )
        pairs = [*zip(got, want, strict=True), *zip(*(state[:2] for state in states), strict=True)]
        for ours, theirs in pairs:
            if np.abs(ours - theirs).max() > 1e-9 * np.abs(theirs).max():
                raise AssertionError("the statistic is not that of the ranges")


if __name__ == "__main__":
    main()
