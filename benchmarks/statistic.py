"""Epochs as raw ranges against epochs as the statistic: time per trial, side by side, one law.

Generation is normals and measurement, from true poses to ranges (M, N) or to G and B; the step
adds the batched KF's update. The means are checked equal first: the statistic of noise-free
ranges, and the filter's state of either. Process time, one thread, medians over interleaved
repeats; ratios are raw ranges over the statistic.

    python benchmarks/statistic.py [--json F] [--repeats 15] [--trials 1024] [--seed 0]
"""

from __future__ import annotations

import side_by_side  # isort: skip

import numpy as np

from rbl_gym import estimators, motion, ranging, rotations, statistic
from rbl_gym.estimators import squared_range

SIZES = ((4, 5), (10, 6), (50, 20))
NOISE = ranging.SquaredRangeNoise(0.05)
PROCESS = motion.ProcessNoise(0.02, 0.1)
STAGES = ("normals", "generation", "step")
CALLS = 5


def main() -> None:
    options = side_by_side.arguments(__doc__, repeats=15, trials=1024, seed=0)
    results = {
        f"{m}x{n}": measure(m, n, options.trials, options.repeats, options.seed) for m, n in SIZES
    }
    side_by_side.print_rows(results, "M x N", "statistic", "ranges")
    side_by_side.write(results, options.json)


def measure(m: int, n: int, trials: int, repeats: int, seed: int) -> dict[str, side_by_side.Row]:
    """Medians per stage at one number of anchors and tags; the peer is the raw ranges."""
    world = World(np.random.default_rng([seed, m, n]), m, n, trials)
    world.check()
    runs = {
        ("normals", "ranges"): lambda: world.rng.standard_normal((trials, m, n)),
        ("normals", "statistic"): lambda: world.rng.standard_normal((trials, 3, 4)),
        ("generation", "ranges"): world.ranges,
        ("generation", "statistic"): world.statistic,
        ("step", "ranges"): lambda: world.filter.update(world.prior, world.ranges(), world.anchors),
        ("step", "statistic"): lambda: world.filter.update_statistic(
            world.prior, *world.statistic()
        ),
    }
    jobs = {
        name: side_by_side.Job(lambda run=run: [run() for _ in range(CALLS)], CALLS * trials)
        for name, run in runs.items()
    }
    times = side_by_side.interleaved(jobs, repeats)
    rows = {}
    for stage in STAGES:
        rows |= side_by_side.against(times[stage, "ranges"], {stage: times[stage, "statistic"]})
    return rows


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
