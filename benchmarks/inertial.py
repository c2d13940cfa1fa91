"""The inertial filter in simulation: against its bound, its NEES, and the time of its kernel.

python benchmarks/inertial.py [--trials 1000] [--seed 0] [--sensor consumer]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym import metrics
from rbl_gym.measurements import inertial
from rbl_gym.motion import navigation
from rbl_gym.studies import monte_carlo
from rbl_gym.worlds import scene_bounds, scenes, simulation

PARTS = {
    "rotation (deg)": slice(0, 3), "position (m)": slice(3, 6), "velocity (m/s)": slice(6, 9),
    "gyroscope's bias (deg/s)": slice(9, 12), "accelerometer's bias (m/s^2)": slice(12, 15),
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sensor", default="consumer")
    options = parser.parse_args()
    for name in ("drone_yard", "uwb_room"):
        scene = scenes.get({"name": name, "inertial": options.sensor})
        rng = np.random.default_rng(options.seed)
        show(name, monte_carlo.simulate_trials(scene, options.trials, rng))
    show_times()


def show(name: str, trials: monte_carlo.SimulatedTrials) -> None:
    """Errors of all states over their bounds."""
    episode, filter = trials.episode, monte_carlo.scene_filter(trials.scene, "iekf-imu", {})
    errors, variances, nees = [], [], []
    assert episode.velocity is not None
    assert episode.bias is not None
    for k, step in enumerate(monte_carlo.trial_steps(trials, filter)):
        state = step.state
        pose = metrics.pose_error(
            state.rotation, state.translation, episode.rotation[:, k], episode.translation[:, k]
        )
        truth = np.concatenate([episode.velocity[:, k], episode.bias[:, k]], axis=-1)
        errors.append(np.concatenate([pose, state.extra[:, :9] - truth], axis=-1))
        variances.append(np.diagonal(state.covariance, axis1=-2, axis2=-1))
        nees.append(metrics.nees(errors[-1], state.covariance) / 15)
    bound = bounds_of(trials)
    error, variance = np.array(errors), np.array(variances)
    print(f"{name}: {error.shape[1]} bodies x {error.shape[0]} epochs")
    print(f"  NEES / 15: {np.mean(nees):.3f}, of an epoch {np.mean(nees, 1).min():.3f} to "
          f"{np.mean(nees, 1).max():.3f}")  # fmt: skip
    print(f"  {'':30s}   RMSE  / bound | at the end: RMSE  claimed  NEES / 3")
    for label, part in PARTS.items():
        unit = np.rad2deg(1) if "deg" in label else 1.0
        rmse = np.sqrt((error[..., part] ** 2).sum(-1).mean())
        ratio = rmse / np.sqrt(bound[..., part].sum(-1).mean())
        end = np.sqrt((error[-1][..., part] ** 2).sum(-1).mean())
        claimed = np.sqrt(variance[-1][..., part].sum(-1).mean())
        own = metrics.nees(error[-1][..., part], state.covariance[..., part, part]).mean() / 3
        print(f"  {label:30s} {unit * rmse:7.4f}  {ratio:6.3f} | {unit * end:16.4f}  "
              f"{unit * claimed:7.4f}  {own:6.3f}")  # fmt: skip


def bounds_of(trials: monte_carlo.SimulatedTrials) -> np.ndarray:
    """Variances (K, B, 15) of the posterior Cramer-Rao bound of all states."""
    scene, episode, variances, information = trials.scene, trials.episode, [], None
    for k, measured in enumerate(trials.measurements):
        at = simulation.epoch_of(episode, k)
        information, _ = scene_bounds.posterior_step(
            scene, at, episode.anchors, measured.links, information, episode.prior_covariance
        )
        variances.append(np.diagonal(np.linalg.inv(information), axis1=-2, axis2=-1))
    return np.array(variances)


def show_times() -> None:
    """Time of a sample in the kernel, over that of filterpy's prediction of 15 states."""
    from filterpy.kalman import KalmanFilter

    rng, peer = np.random.default_rng(0), KalmanFilter(dim_x=15, dim_z=3)
    law = np.append(inertial.SENSORS["consumer"].numbers, 0.0)
    state = np.eye(3), np.zeros(3), np.zeros(9), np.eye(15)
    print("one body, us a sample, and / filterpy's predict of 15 states:")
    kernel = navigation.propagate
    if not isinstance(kernel(*state, np.ones((1, 6)), np.ones(1), law), tuple):
        raise SystemExit("no kernel")
    for count in (10, 20, 100):
        readings, steps = rng.standard_normal((count, 6)), np.full(count, 0.1 / count)
        ratios, times = [], []
        for _ in range(30):
            of_peer = seconds(peer.predict)
            times.append(seconds(lambda: kernel(*state, readings, steps, law)) / count)  # noqa: B023
            ratios.append(times[-1] / of_peer)
        print(f"  {count:3d} samples an interval: {1e6 * min(times):.3f}  {np.median(ratios):.3f}")


def seconds(function: Callable[[], Any]) -> float:
    """Time of a call, the best of three times 300."""
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        for _ in range(300):
            function()
        best = min(best, (time.perf_counter() - start) / 300)
    return best


if __name__ == "__main__":
    main()
