"""Smooth motion of a body with an inertial sensor.

The nominal motion of a scene is a polyline at constant speed. No sensor could follow its corners.
With an inertial sensor the body therefore follows a uniform cubic B-spline. Its control poses are
those of the nominal motion every second (or every epoch, if epochs are longer). The spline rounds
the corners and keeps a constant twist constant. The process noise does not move the body, because
no sensor could measure such jumps. It is the error of the known twist: the true mean twist of the
interval minus white noise. Filters that use the known twist therefore have the correct noise law.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import motion
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.measurements import inertial
from rbl_gym.motion import smooth
from rbl_gym.worlds.scene import Scene

# Time between control poses of the spline, seconds.
_KNOT_S = 1.0


class InertialTrack(NamedTuple):
    """The motion of an episode at epochs 0 ... T, with leading axes.

    The known twists (..., T, 6) begin with epoch 1; the readings (..., T + 1, S, 6) are zeros at
    epoch 0. Both are of the interval that ends at the epoch. `bias` (..., T + 1, 6) is that of the
    sensor.
    """

    rotation: FloatArray
    translation: FloatArray
    velocity: FloatArray
    twists: FloatArray
    readings: FloatArray
    bias: FloatArray


def normals_of(scene: Scene) -> int:
    """Return how many standard normals the sensor of an episode needs: start, noise and walks."""
    if scene.inertial is None:
        return 0
    return 6 + 12 * (scene.steps * scene.inertial.samples(scene.dt) + 1)


def fly(
    scene: Scene, trajectory: motion.Trajectory, process: FloatArray, normals: FloatArray
) -> InertialTrack:
    """Return the smooth motion along a nominal trajectory, and the readings of the sensor.

    `process` (..., T, 6) and `normals` (..., `normals_of`) are standard normals.
    """
    sensor, dt, steps = scene.inertial, scene.dt, scene.steps
    assert sensor is not None
    samples = sensor.samples(dt)
    batch = normals.shape[:-1]
    spacing, poses = _poses(trajectory, dt, steps)
    at = smooth.bspline(*poses, spacing, dt * np.arange(steps + 1))
    step = dt / samples
    between = smooth.bspline(*poses, spacing, step * (np.arange(steps * samples) + 0.5))
    felt = np.zeros((*batch, steps * samples + 1, 6))
    felt[..., :-1, :3] = between.turn_rate
    felt[..., :-1, 3:] = inertial.specific_force(between.rotation, between.acceleration)
    noise = normals[..., 6:].reshape((*batch, -1, 6))
    read = inertial.disturbed(sensor, felt, normals[..., :6], noise, step)
    readings = np.zeros((*batch, steps + 1, samples, 6))
    readings[..., 1:, :, :] = read.readings[..., :-1, :].reshape((*batch, steps, samples, 6))
    twists = motion.twists_between(at.rotation, at.translation, dt)
    twists = twists - scene.process.std() / np.sqrt(dt) * process

    def whole(field: FloatArray, trailing: int) -> FloatArray:
        return np.broadcast_to(field, (*batch, *field.shape[field.ndim - trailing :]))

    return InertialTrack(
        whole(at.rotation, 3), whole(at.translation, 2), whole(at.velocity, 2),
        whole(twists, 2), readings, read.bias[..., ::samples, :],
    )  # fmt: skip


def _poses(
    trajectory: motion.Trajectory, dt: float, steps: int
) -> tuple[float, tuple[FloatArray, FloatArray]]:
    """Return the time between control poses, and the poses, two more than the motion has."""
    held = max(1, round(_KNOT_S / dt))
    path = motion.simulate(trajectory, dt, motion.ProcessNoise())
    batch = path.translation.shape[:-2]
    rotation = [path.rotation[..., k, :, :] for k in range(0, steps + 1, held)]
    translation = [path.translation[..., k, :] for k in range(0, steps + 1, held)]
    spacing = held * dt
    twist = np.broadcast_to(trajectory.twists[..., -1, :], (*batch, 6))
    turn = rotations.exp(spacing * twist[..., :3])
    while len(rotation) < -(-steps // held) + 2:
        rotation.append(turn @ rotation[-1])
        translation.append(translation[-1] + spacing * twist[..., 3:])
    return spacing, (np.stack(rotation, axis=-3), np.stack(translation, axis=-2))
