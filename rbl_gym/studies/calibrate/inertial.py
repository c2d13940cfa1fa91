"""Calibrate the orientation and clock of an inertial sensor by rotations of a truth or track."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.calibration.turn_rates import SensorTurn, align_turn_rates
from rbl_gym.geometry import rotations
from rbl_gym.recordings import InertialLog, TimeOffset, Truth, time_offset

__all__ = ["CalibratedInertial", "calibrate_inertial", "inertial_figures"]

# Spacing (s) of the grid for the rates of both, and width of their smoothing in grid points.
_STEP_S, _SMOOTH = 0.02, 5.0
_LONGEST_GAP_S = 0.2
# Number of rounds in which clock and rotation are estimated in turn.
_ROUNDS = 2


class CalibratedInertial(NamedTuple):
    """The calibration of an inertial sensor.

    Attributes
    ----------
    turn
        Rotation from sensor axes to body axes, and bias of the gyroscope.
    clock
        How far the clock of the sensor is ahead of that of the truth.
    """

    turn: SensorTurn
    clock: TimeOffset


def calibrate_inertial(log: InertialLog, truth: Truth) -> CalibratedInertial:
    """Estimate the rotation of a sensor on its body, and its clock, from turn rates.

    Parameters
    ----------
    log
        Log from `rbl_gym.recordings.read_inertial`.
    truth
        Poses of the body; or the track of a filter, as `Truth(times, rotation, translation)`.

    Raises
    ------
    ValueError
        If the poses have no rotations, the clock is not determined, or the body rotates about one
        axis only.
    """
    if truth.rotation is None:
        raise ValueError("truth must have rotations, got only positions")
    middle = 0.5 * (truth.times[1:] + truth.times[:-1])
    step = np.diff(truth.times)
    world = rotations.error(truth.rotation[1:], truth.rotation[:-1]) / step[:, None]
    body = np.einsum("kji,kj->ki", truth.rotation[:-1], world)
    gyro = log.readings[:, :3]
    bias = np.zeros(3)
    for _ in range(_ROUNDS):
        # The norm of a rate does not depend on the orientation of the sensor, but on its bias.
        lengths = (np.linalg.norm(a, axis=1) for a in (body, gyro - bias))
        clock = time_offset(middle, next(lengths), log.times, next(lengths))
        turn = _turn(log.times - clock.offset_s, gyro, middle, body)
        bias = turn.bias
    return CalibratedInertial(turn, clock)  # pyrefly: ignore[unbound-name]


def _turn(stamps: FloatArray, gyro: FloatArray, middle: FloatArray, body: FloatArray) -> SensorTurn:
    """Return the rotation from turn rates of the sensor to those of the body, each at its times."""
    grid = np.arange(max(middle[0], stamps[0]), min(middle[-1], stamps[-1]), _STEP_S)
    known = np.ones(len(grid), dtype=bool)
    rates = []
    for times, values in ((stamps, gyro), (middle, body)):
        after = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
        known &= times[after] - times[after - 1] <= _LONGEST_GAP_S
        rates.append(_smoothed(times, values, grid))
    return align_turn_rates(rates[0][known], rates[1][known])


def inertial_figures(found: CalibratedInertial, truth_offset_s: float = 0.0) -> dict[str, Any]:
    """Return plain numbers of a sensor: its axes in the body frame, its bias, its clock.

    Parameters
    ----------
    found
        Result of `calibrate_inertial`.
    truth_offset_s
        How far the clock of the truth is ahead of that of the ranges; ``imu_offset_s`` is relative
        to the ranges.
    """
    turn = found.turn
    return {
        "rotation_vector_deg": np.rad2deg(rotations.log(turn.rotation)).tolist(),
        "rotation_std_deg": np.rad2deg(turn.rotation_std_rad).tolist(),
        "gyro_bias_rad_s": turn.bias.tolist(),
        "gyro_bias_std": turn.bias_std.tolist(),
        "imu_offset_s": found.clock.offset_s + truth_offset_s,
        "imu_offset_std_s": found.clock.std_s,
    }


def _smoothed(times: FloatArray, values: FloatArray, grid: FloatArray) -> FloatArray:
    """Return values (n, 3), smoothed, on a grid."""
    columns = [np.interp(grid, times, column) for column in values.T]
    return gaussian_filter1d(np.stack(columns, axis=-1), _SMOOTH, axis=0, mode="nearest")
