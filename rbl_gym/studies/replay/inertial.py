"""Prepare a recording with an inertial sensor: the covered epochs, and the initial attitude."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.motion import navigation
from rbl_gym.recordings.inertial import InertialLog, samples_between
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.settings import Settings

__all__ = ["covered"]

# Duration of the readings that determine roll and pitch (s), and the least standard deviation (rad)
# of these angles, since the body may be moving.
_LOOK_S, _TILT_RAD = 0.25, np.deg2rad(3.0)


def covered(recording: Recording, settings: Settings) -> Recording:
    """Return the epochs with readings of the inertial sensor.

    Parameters
    ----------
    recording, settings
        The recording, and the settings with the clock offset of the sensor.

    Raises
    ------
    ValueError
        If no epoch has readings.
    """
    log = clocked(recording, settings)
    if log is None:
        return recording
    low, high = log.times[0] + _LOOK_S, log.times[-1]
    inside = np.flatnonzero((recording.times >= low) & (recording.times <= high))
    if not len(inside):
        raise ValueError(
            f"imu has readings from {log.times[0]:.6g} to {log.times[-1]:.6g} s by the clock of "
            f"the ranges, but the ranges are from {recording.times[0]:.6g} to "
            f"{recording.times[-1]:.6g} s: see --time-offset imu=S"
        )
    return recording.part(slice(inside[0], inside[-1] + 1))


def clocked(recording: Recording, settings: Settings) -> InertialLog | None:
    """Return the readings on the clock of the ranges."""
    log = recording.inertial
    return None if log is None else log._replace(times=log.times - settings.inertial.imu_offset_s)


def standing(
    recording: Recording, settings: Settings, prior: tuple[FloatArray, FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a prior with roll and pitch from gravity; its yaw and yaw variance are unchanged."""
    log = clocked(recording, settings)
    assert log is not None
    rotation, translation, covariance = prior
    first = recording.times[0]
    readings, _ = samples_between(log, first - _LOOK_S, first)
    level, spread = navigation.attitude(readings, settings.inertial.sensor())
    yaw = float(rotations.yaw(rotation) - rotations.yaw(level))
    std = np.sqrt(np.maximum(np.diag(spread), _TILT_RAD**2))
    P = covariance.copy()
    P[:3, :] = P[:, :3] = 0.0
    P[[0, 1], [0, 1]], P[2, 2] = std[:2] ** 2, covariance[2, 2]
    return rotations.exp([0.0, 0.0, yaw]) @ level, translation, P
