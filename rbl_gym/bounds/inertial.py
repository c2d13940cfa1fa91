"""Posterior Cramer-Rao bound of a body with an inertial sensor: 15 states, or 17 with the tilt."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.pose import range_information, symmetric
from rbl_gym.checks import FloatArray, check_array
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.inertial import InertialSensor
from rbl_gym.motion import navigation

__all__ = ["posterior_crb_step", "prior_information"]


def prior_information(
    pose_covariance: ArrayLike,
    sensor: InertialSensor,
    speed_m_s: float,
    gravity_tilt_rad: float = 0.0,
) -> FloatArray:
    """Information (..., n, n) before the first ranges: of pose, velocity, biases, and the tilt.

    Parameters
    ----------
    pose_covariance
        (..., 6, 6) of the prior of the pose.
    sensor, speed_m_s, gravity_tilt_rad
        As of `estimators.iekf.inertial.InertialEkf`; n is 15, or 17 with a tilt.
    """
    pose = check_array("pose_covariance", pose_covariance, (6, 6))
    tilt = [gravity_tilt_rad] * (2 * (gravity_tilt_rad > 0))
    std = np.concatenate([[speed_m_s] * 3, sensor.prior_std, tilt])
    n = 6 + len(std)
    information = np.zeros((*pose.shape[:-2], n, n))
    information[..., :6, :6] = symmetric(np.linalg.inv(pose))
    information[..., range(6, n), range(6, n)] = 1 / std**2
    return information


def posterior_crb_step(
    J: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: ranging.NoiseLaw,
    readings: ArrayLike,
    steps: ArrayLike,
    sensor: InertialSensor,
    links: ArrayLike | None = None,
    offset: str | None = None,
) -> FloatArray:
    """One step of the posterior Cramer-Rao recursion of all states, at the truth.

    Parameters
    ----------
    J
        Posterior information (..., n, n) of the epoch before, of the error states of
        `motion.navigation`: 15, or 17 with the tilt of gravity.
    anchors, tags, rotation, translation, noise, links
        At the new epoch, as `bounds.posterior_crb_step`.
    readings, steps
        Readings (..., S, 6) without bias of the interval that ends there, and seconds of each
        sample, as `navigation.preintegrate`.
    sensor
        Law of their noise.
    offset
        Whose ranges have an unknown offset in common, as of `bounds.range_information`.

    Returns
    -------
    Information (..., n, n); the first six rows of its inverse bound the pose.

    Raises
    ------
    ValueError
        On wrong shapes or values, and where J is singular.
    """
    J = check_array("J", J, ("n", "n"))
    if J.shape[-1] not in (15, 17) or J.shape[-2] != J.shape[-1]:
        raise ValueError(f"J must have shape (..., 15, 15) or (..., 17, 17), got {J.shape}")
    readings = check_array("readings", readings, ("S", 6))
    steps = navigation.check_steps(steps, readings)
    rotation = rotations.check_rotation("rotation", rotation)
    predicted = predict_information(J, rotation, readings, steps, sensor)
    if not np.isfinite(predicted).all():
        raise ValueError(f"J must be information about all states, got a singular one {J!r:.80}")
    seen = range_information(anchors, tags, rotation, translation, noise, links, offset=offset)
    return with_pose(predicted, seen)


def with_pose(information: FloatArray, seen: FloatArray) -> FloatArray:
    """Information (..., n, n) about all states with that (..., 6, 6) about the pose added."""
    batch = np.broadcast_shapes(information.shape[:-2], seen.shape[:-2])
    result = np.broadcast_to(information, (*batch, *information.shape[-2:])).copy()
    result[..., :6, :6] += seen
    return result


def predict_information(
    J: FloatArray,
    rotation: FloatArray,
    readings: FloatArray,
    steps: FloatArray,
    sensor: InertialSensor,
) -> FloatArray:
    """Information after the readings that led to a rotation; NaN where J is singular."""
    n = J.shape[-1]
    moved = navigation.integrate(readings, steps, np.zeros(6), sensor.numbers)
    before = rotation @ np.swapaxes(moved.rotation, -1, -2)
    law = np.append(sensor.numbers, n > 15)
    try:
        P = np.linalg.inv(J)
        P = navigation.propagate(before, np.zeros(3), np.zeros(n - 6), P, readings, steps, law)[3]
        return symmetric(np.linalg.inv(P))
    except np.linalg.LinAlgError:
        return np.full(J.shape, np.nan)
