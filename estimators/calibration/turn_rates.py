"""Mount of an inertial sensor on a body from turn rates: rotation and gyroscope bias."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.estimators.calibration import robust
from rbl_gym.geometry import rotations

__all__ = ["SensorTurn", "align_turn_rates"]

_ROUNDS, _LEAST_RAD_S = 20, 1e-6


class SensorTurn(NamedTuple):
    """Mount of a gyroscope on a body: ``w_body = rotation @ (w_sensor - bias)``.

    Attributes
    ----------
    rotation, rotation_std_rad
        (3, 3), and (3,) of its error about the body's axes; infinite if not observable.
    bias, bias_std
        (3,) of the gyroscope, in its own axes, rad/s.
    noise_std_rad_s
        Robust standard deviation of the residuals per axis.
    """

    rotation: FloatArray
    rotation_std_rad: FloatArray
    bias: FloatArray
    bias_std: FloatArray
    noise_std_rad_s: float


def align_turn_rates(sensor: ArrayLike, body: ArrayLike) -> SensorTurn:
    """Estimate the rotation and bias that map turn rates of a sensor to those of its body.

    The method is robust least squares. Each iteration solves Wahba's problem for the rotation.

    Parameters
    ----------
    sensor
        Turn rates (K, 3) of the gyroscope, in its axes, rad/s.
    body
        Turn rates (K, 3) of the body at the same times, in its own axes, rad/s: from ground
        truth, or from the track of a filter. Estimate a clock offset first, by
        `rbl_gym.recordings.time_offset` of the norms of both.

    Raises
    ------
    ValueError
        If shapes do not match, there are fewer than 10 rates, or all turns are about one axis.
    """
    sensor, body = check_array("sensor", sensor, ("K", 3)), check_array("body", body, ("K", 3))
    if sensor.ndim != 2 or sensor.shape != body.shape or len(sensor) < 10:
        raise ValueError(
            f"sensor and body must both be (K, 3) with K at least 10, got {sensor.shape} and "
            f"{body.shape}"
        )
    w = np.ones(len(sensor))
    std, R, bias, left = 1.0, np.eye(3), np.zeros(3), body
    everything = np.ones(sensor.shape, dtype=bool)
    for _ in range(_ROUNDS):
        mean_s, mean_b = (np.average(a, axis=0, weights=w) for a in (sensor, body))
        spread = (w[:, None] * (body - mean_b)).T @ (sensor - mean_s)
        values = np.linalg.svd(spread, compute_uv=False)
        if values[1] <= 1e-6 * max(values[0], 1e-12):
            raise ValueError(
                "body must turn about two axes or more to determine the axes of the sensor"
            )
        R = rotations.nearest(spread)
        bias = mean_s - R.T @ mean_b
        left = body - (sensor - bias) @ R.T
        std = float(robust.spread(left.reshape(-1, 1), everything.reshape(-1, 1), _LEAST_RAD_S)[0])
        w = robust.share_of(np.linalg.norm(left, axis=1) / (np.sqrt(3) * std))
    # Information on the rotation error from the rates about their mean, [w]x.
    rates = (sensor - np.average(sensor, axis=0, weights=w)) @ R.T
    H = np.einsum("k,kij,kil->jl", w, rotations.hat(rates), rotations.hat(rates))
    # Smoothed rates are correlated, so the effective number follows from the errors'
    # autocorrelation.
    lasting = _lasting(np.asarray(left / std))
    turn = np.linalg.inv(H) * std**2 * lasting
    of_bias = std**2 * lasting / w.sum() * np.eye(3)
    mean = np.average(sensor - bias, axis=0, weights=w) @ R.T
    of_bias = of_bias + R.T @ rotations.hat(mean) @ turn @ rotations.hat(mean).T @ R
    return SensorTurn(R, np.sqrt(np.diag(turn)), bias, np.sqrt(np.diag(of_bias)), std)


def _lasting(z: FloatArray) -> float:
    """Return the correlation length of errors: one plus twice the sum of the first correlations."""
    z = z * robust.share_of(z)
    total, power = 1.0, float((z**2).sum())
    for lag in range(1, len(z) // 4):
        rho = float((z[lag:] * z[:-lag]).sum()) / max(power, 1e-300)
        if rho < 0.05:
            break
        total += 2 * rho
    return total
