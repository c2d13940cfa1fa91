"""Define the prior of a body with an inertial sensor: 15 states, or 17 with the tilt of gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.pose import symmetric
from rbl_gym.checks import FloatArray, check_array
from rbl_gym.measurements.inertial import InertialSensor

__all__ = ["prior_information"]


def prior_information(
    pose_covariance: ArrayLike,
    sensor: InertialSensor,
    speed_m_s: float,
    gravity_tilt_rad: float = 0.0,
) -> FloatArray:
    """Return the prior information (..., n, n) of pose, velocity, biases, and the tilt.

    Parameters
    ----------
    pose_covariance
        (..., 6, 6), prior of the pose.
    sensor, speed_m_s, gravity_tilt_rad
        As in `estimators.iekf.inertial.InertialEkf`; n is 15, or 17 with a tilt.
    """
    pose = check_array("pose_covariance", pose_covariance, (6, 6))
    tilt = [gravity_tilt_rad] * (2 * (gravity_tilt_rad > 0))
    std = np.concatenate([[speed_m_s] * 3, sensor.prior_std, tilt])
    n = 6 + len(std)
    information = np.zeros((*pose.shape[:-2], n, n))
    information[..., :6, :6] = symmetric(np.linalg.inv(pose))
    information[..., range(6, n), range(6, n)] = 1 / std**2
    return information
