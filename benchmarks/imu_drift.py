"""Drift of an inertial unit, corrected by ranges: the use that the tracking paper names first.

The world of the tracking paper for 100 steps of 1 s. The twist that the filters are told is the
true one plus a constant error of 0.2 deg/s and 0.2 m/s on every axis, which they know nothing
of. Dead reckoning integrates it; the filters correct it by ranges. Process noise of the motion
is small here, 0.1 deg and 0.1 m a step, so that what drifts is the unit.

    python benchmarks/imu_drift.py [--trials 300] [--seed 0]
"""

from __future__ import annotations

import argparse

import numpy as np

from rbl_gym import metrics, motion
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.papers import camsap2013
from rbl_gym.worlds import scenes

SCENE = {"name": "camsap2013", "steps": 99, "process": {"translation_m": 0.1}}
DRIFT = np.array([np.deg2rad(0.2)] * 3 + [0.2] * 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("--trials", 300), ("--seed", 0)):
        parser.add_argument(name, type=int, default=default)
    options = parser.parse_args()
    scene = scenes.get(SCENE)
    honest = monte_carlo.simulate_trials(scene, options.trials, np.random.default_rng(options.seed))
    told = honest.episode.twists + DRIFT
    drifting = honest._replace(episode=honest.episode._replace(twists=told))
    print("last of 100 steps            rotation (deg)   position (m)")
    for label, world in (("without drift", honest), ("with drift", drifting)):
        show(f"dead reckoning, {label}", dead_reckoning(world))
        for name, (filter, settings) in camsap2013.FILTERS.items():
            show(f"{name}, {label}", monte_carlo.track_trials(world, filter, settings).error[-1])


def dead_reckoning(world: monte_carlo.SimulatedTrials) -> np.ndarray:
    """Errors (B, 6) at the last epoch of the integrated twist, from the true pose at epoch 0."""
    episode = world.episode
    rotation, translation = episode.rotation[:, 0], episode.translation[:, 0]
    for epoch in range(1, world.scene.steps + 1):
        twist = episode.twists[:, epoch]
        rotation, translation = motion.propagate(rotation, translation, twist, world.scene.dt)
    truth = episode.rotation[:, -1], episode.translation[:, -1]
    return metrics.pose_error(rotation, translation, *truth)


def show(label: str, error: np.ndarray) -> None:
    angle = np.rad2deg(monte_carlo.rms(np.linalg.norm(error[:, :3], axis=1)))
    distance = monte_carlo.rms(np.linalg.norm(error[:, 3:], axis=1))
    print(f"{label:32s} {angle:10.2f} {distance:14.3f}")


if __name__ == "__main__":
    main()
