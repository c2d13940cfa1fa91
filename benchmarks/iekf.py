"""The batched iterated EKF beside filterpy's linear filter: time per trial and step, one run.

One step is predict and update, from ranges to state; filterpy has a KalmanFilter per trial on the
squared ranges (`benchmarks/filters.py`), its measurement matrix of (M - 1) N rows ready-made. The
two do not compute the same thing: filterpy's loop is the yardstick of the machine. The iterated
EKF is first held to a plain loop over trials. One body alone is timed as well, with its belief.
Process time, one thread, medians over interleaved repeats.

    python benchmarks/iekf.py [--json F] [--repeats 7] [--trials 1024] [--seed 0]
"""

from __future__ import annotations

import side_by_side  # isort: skip

from collections.abc import Callable
from typing import Any

import filters
import numpy as np

from rbl_gym import bounds, estimators
from rbl_gym.estimators.iekf.manifold import PoseState
from rbl_gym.geometry import rotations

SIZES = ((4, 5), (10, 6))
ITERATIONS = (2, 4)
PEER_TRIALS, ONE_BODY_REPEATS = 10, 200


def main() -> None:
    options = side_by_side.arguments(__doc__, repeats=7, trials=1024, seed=0)
    results = {
        f"{m}x{n}": measure(m, n, options.trials, options.repeats, options.seed) for m, n in SIZES
    }
    side_by_side.print_rows(results, "M x N", "path", "filterpy")
    side_by_side.write(results, options.json)


def measure(m: int, n: int, trials: int, repeats: int, seed: int) -> dict[str, side_by_side.Row]:
    """Medians per path at one number of anchors and tags."""
    world = filters.World(np.random.default_rng([seed, m, n]), "kf", m, n, trials)
    start = world.filter.belief(world.prior)
    peer = world.peer(range(PEER_TRIALS))
    jobs = {"peer": side_by_side.Job(peer, filters.STEPS * PEER_TRIALS)}
    for iterations in ITERATIONS:
        filter = estimators.make(
            "iekf",
            tags=world.tags,
            noise=filters.NOISE,
            process=filters.PROCESS,
            iterations=iterations,
        )
        prior = filter.initial(start.rotation, start.translation, np.diag([0.02] * 3 + [1.0] * 3))
        run = runner(filter, prior, world.twist, world.ranges, world.anchors)
        check(run(), prior, world, iterations)
        one = runner(
            filter,
            PoseState(*(field[0] for field in prior)),
            world.twist[0],
            [ranges[0] for ranges in world.ranges],
            world.anchors[0],
            belief=True,
        )
        name = f"{iterations} iterations"
        jobs[name] = side_by_side.Job(run, filters.STEPS * trials)
        jobs[f"{name}, one body"] = side_by_side.Job(
            lambda one=one: [one() for _ in range(ONE_BODY_REPEATS)],
            filters.STEPS * ONE_BODY_REPEATS,
        )
    times = side_by_side.interleaved(jobs, repeats)
    return side_by_side.against(times.pop("peer"), times)


def runner(
    filter: Any,
    prior: PoseState,
    twist: np.ndarray,
    epochs: list[np.ndarray],
    anchors: np.ndarray,
    belief: bool = False,
) -> Callable[[], PoseState]:
    """All steps of all trials, with the beliefs or without."""

    def run() -> PoseState:
        state = prior
        for ranges in epochs:
            state = filter.update(filter.predict(state, twist, filters.DT), ranges, anchors)
            if belief:
                filter.belief(state)
        return state

    return run


def check(state: PoseState, prior: PoseState, world: filters.World, iterations: int) -> None:
    """The filter equals a plain loop on some trials, or the run stops."""
    for k in range(PEER_TRIALS):
        plain = tuple(field[k] for field in prior)
        for ranges in world.ranges:
            plain = plain_step(plain, world, k, ranges[k], iterations)
        for got, want in zip(state, plain, strict=True):
            if np.abs(got[k] - want).max() > 1e-8 * max(1.0, np.abs(want).max()):
                raise AssertionError(f"trial {k}: off the plain loop by {np.abs(got[k] - want)}")


def plain_step(
    prior: tuple[np.ndarray, ...], world: filters.World, k: int, ranges: np.ndarray, iterations: int
) -> tuple[np.ndarray, ...]:
    """One step of one trial with 6 x 6 matrices, as it is printed in textbooks."""
    rotation, translation, P = prior
    twist = world.twist[k]
    Q0 = rotations.exp(twist[:3] * filters.DT) @ rotation
    t0 = translation + twist[3:] * filters.DT
    information = np.linalg.inv(bounds.predict_covariance(P, twist, filters.DT, filters.PROCESS))
    weights = 1 / np.broadcast_to(filters.NOISE.variance(ranges), ranges.shape).ravel()
    Q, t = Q0, t0
    for last in [False] * iterations + [True]:
        distance, J = bounds.range_jacobian(world.anchors[k], world.tags, Q, t)
        error = np.concatenate([rotations.log(Q @ Q0.T), t - t0])
        D = np.eye(6)
        D[:3, :3] = rotations.left_jacobian_inverse(error[:3])
        hessian = (J * weights) @ J.T + D.T @ information @ D
        if last:
            break
        gradient = J @ (weights * (distance - ranges).ravel()) + D.T @ information @ error
        step = -np.linalg.solve(hessian, gradient)
        Q, t = rotations.exp(step[:3]) @ Q, t + step[3:]
    return Q, t, np.linalg.inv(hessian)


if __name__ == "__main__":
    main()
