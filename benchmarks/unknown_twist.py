"""The filter of an unknown twist against its bound, in the drone yard; what odometry is worth.

Bodies drawn from the law that the bound assumes (`rbl_gym.motion.unknown_twist`), and bodies on the
scene's own way-points, whose velocity jumps where they turn: of these there is no bound, only the
known twist's as a floor. RMSE, its ratio to the bound, NEES per degree of freedom over all epochs.

    python benchmarks/unknown_twist.py [--trials 1000] [--steps 100] [--seed 0] [--json F]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym import bounds, metrics
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.motion import unknown_twist as ut
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.epochs import stack_beliefs, timed
from rbl_gym.worlds import scenes

SCENE = scenes.get("drone_yard")
LAW = ut.WanderingTwist(SCENE.spin_rad_s, 3.0, 0.1, 1.0)
SENSORS = {
    "nothing": None,
    "gyroscope 0.05 rad/s": ut.TwistSensor(0.05, None, "body"),
    "gyroscope, speed 0.2 m/s": ut.TwistSensor(0.05, 0.2, "body"),
}
OPTIONS = {
    "turn_rate_rad_s": LAW.turn_rate_rad_s,
    "speed_m_s": LAW.speed_m_s,
    "turn_acceleration": LAW.turn_acceleration,
    "acceleration": LAW.acceleration,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", metavar="F")
    options = parser.parse_args()
    rows = {name: drawn(sensor, options) for name, sensor in SENSORS.items()}
    rows |= way_points(options)
    print(f"{'':<34}{'t (m)':>8}{'ratio':>7}{'w (deg)':>9}{'ratio':>7}{'ANEES':>7}{'us':>7}")
    for name, row in rows.items():
        print(
            f"{name:<34}{row['translation_m']:8.4f}{row['translation_ratio']:7.3f}"
            f"{row['rotation_deg']:9.3f}{row['rotation_ratio']:7.3f}{row['anees']:7.3f}"
            f"{row['microseconds']:7.1f}"
        )
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n")


def drawn(sensor: ut.TwistSensor | None, options: argparse.Namespace) -> dict[str, float]:
    """Bodies drawn from the law, with what a sensor reads."""
    rng = np.random.default_rng(options.seed)
    tags, anchors = np.asarray(SCENE.tags), np.asarray(SCENE.anchors)
    trials, P = options.trials, SCENE.prior_covariance
    rotation = rotations.random(rng, (trials,))
    start = rng.uniform(*SCENE.volume.bounds(), (trials, 3))
    path = ut.simulate_wandering(rotation, start, LAW, SCENE.process, SCENE.dt, options.steps, rng)
    of_sensor: dict[str, Any] = {}
    if sensor is not None:
        of_sensor = {
            "gyro_std_rad_s": sensor.gyro_std_rad_s,
            "speed_std_m_s": sensor.speed_std_m_s,
            "frame": sensor.frame,
        }
    filter = monte_carlo.scene_filter(SCENE, "iekf-cv", OPTIONS | of_sensor)
    offset = np.sqrt(np.diag(P)) * rng.standard_normal((trials, 6))
    state = filter.initial(rotations.exp(offset[:, :3]) @ rotation, start + offset[:, 3:], P)
    J = np.diag([*1 / np.diag(P), *LAW.prior_std() ** -2.0])
    J = np.broadcast_to(J, (trials, 12, 12)).copy()
    J[:, :6, :6] += bounds.range_information(anchors, tags, rotation, start, SCENE.noise)
    errors, beliefs, bound, seconds = [], [], [], 0.0
    for k in range(options.steps + 1):
        pose = path.rotation[:, k], path.translation[:, k]
        reading = None
        if k:
            twist = path.twists[:, k - 1]
            if sensor is not None:
                std = np.where(np.isfinite(sensor.std()), sensor.std(), 0.0)
                reading = sensor.read(path.rotation[:, k - 1], twist)
                reading = reading + std * rng.standard_normal((trials, 6))
            moved = bounds.UnknownTwist(twist, SCENE.dt, SCENE.process, LAW, sensor)
            epoch = bounds.RangeEpoch(anchors, tags, *pose, SCENE.noise)
            J = bounds.posterior_step(J, epoch, moved)
        ranges = ranging.simulate(anchors, tags, *pose, SCENE.noise, rng).ranges
        begin = time.process_time()
        if k:
            state = filter.predict(state, reading, SCENE.dt)
        state = filter.update(state, ranges, anchors)
        seconds += time.process_time() - begin
        error = metrics.pose_error(state.rotation, state.translation, *pose)
        errors.append(np.concatenate([error, state.extra - path.twists[:, k]], axis=-1))
        beliefs.append(state.covariance)
        bound.append(np.linalg.inv(J)[:, :6, :6])
    return judged(np.array(errors), np.array(beliefs), np.array(bound), seconds)


def way_points(options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Bodies on the scene's way-points: the twist known, ignored, and as a random walk."""
    scene = scenes.get({"name": "drone_yard", "steps": options.steps})
    rng = np.random.default_rng(options.seed)
    world = monte_carlo.simulate_trials(scene, options.trials, rng)
    free = OPTIONS | {"speed_m_s": 5.0, "acceleration": 3.0, "turn_acceleration": 0.01}
    rows = {}
    for name, kind, more in (
        ("way-points, iekf, twist known", "iekf", {}),
        ("way-points, iekf-cv", "iekf-cv", free),
    ):
        filter = monte_carlo.scene_filter(scene, kind, more)
        steps, seconds = zip(*timed(monte_carlo.trial_steps(world, filter)), strict=True)
        belief = stack_beliefs(step.belief for step in steps)
        truth = (np.moveaxis(part, 1, 0) for part in world.episode[:2])
        error = metrics.pose_error(*belief[:2], *truth)
        rows[name] = judged(error, belief.covariance, world.bound, sum(seconds))
    return rows


def judged(error: np.ndarray, P: np.ndarray, bound: np.ndarray, seconds: float) -> dict[str, float]:
    """The figures of errors (K, B, n), covariances (K, B, n, n), pose bounds (K, B, 6, 6)."""
    variance = np.diagonal(bound, axis1=-2, axis2=-1)
    rms = [np.sqrt((error[..., b] ** 2).sum(-1).mean()) for b in (slice(0, 3), slice(3, 6))]
    least = [np.sqrt(variance[..., b].sum(-1).mean()) for b in (slice(0, 3), slice(3, 6))]
    return {
        "rotation_deg": float(np.rad2deg(rms[0])),
        "rotation_ratio": float(rms[0] / least[0]),
        "translation_m": float(rms[1]),
        "translation_ratio": float(rms[1] / least[1]),
        "anees": float(metrics.nees(error, P).mean() / error.shape[-1]),
        "microseconds": 1e6 * seconds / error[..., 0].size,
    }


if __name__ == "__main__":
    main()
