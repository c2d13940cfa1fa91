"""Smooth a recording: estimate every pose from all ranges, including later ones."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rbl_gym import estimators
from rbl_gym.checks import FloatArray
from rbl_gym.estimators import smoothing
from rbl_gym.estimators.costs.losses import LATE, SQUARES
from rbl_gym.estimators.smoothing.inertial import InertialMotion
from rbl_gym.measurements import ranging
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.motion.unknown_twist import WanderingTwist
from rbl_gym.recordings.odometry import OdometryLog
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.groups import beliefs_of
from rbl_gym.studies.replay.centre import about_origin, centred
from rbl_gym.studies.replay.mirror import covering
from rbl_gym.studies.replay.place import level_of, origin_of, own_std, plane_of, start_of
from rbl_gym.studies.replay.settings import DEFAULT_RANGE_STD_M, Settings
from rbl_gym.studies.replay.tracking import (
    Track,
    log_steps,
    prior_of,
    readings_of,
    recording_filter,
    robust_of,
)

__all__ = ["SmoothedRecording", "smooth_recording"]

# The start had diverged if squared residuals exceed this multiple of their expectation.
_LOST = 1.5
# Standard deviations of an unknown turn rate (rad/s) and velocity (m/s).
_ANY_TURN, _ANY_SPEED = 1.0, 3.0
# Maximum memory (bytes) of the blocks of all epochs.
_MOST_MEMORY = 8e9


class SmoothedRecording(NamedTuple):
    """The smoothed track of a recording.

    Attributes
    ----------
    track
        Beliefs of every epoch.
    found
        Result of `estimators.smooth`, in coordinates relative to `origin_of`.
    seconds
        Processor time, seconds.
    """

    track: Track
    found: smoothing.Smoothed
    seconds: float


def smooth_recording(recording: Recording, settings: Settings, track: Track) -> SmoothedRecording:
    """Return the most likely track of a recording, starting from its causal track.

    If the fit shows that the causal track had diverged, a track filtered backwards in time and a
    body at rest are tried as starts too. The most likely result is returned.

    Parameters
    ----------
    recording, settings
        The recording to smooth, and the settings.
    track
        Result of `track_recording`.

    Raises
    ------
    ValueError
        If blocks of all epochs and links do not fit into memory.
    """
    _check_size(recording, settings)
    began = time.process_time()
    recording, settings, centre = centred(recording, settings)
    if centre is not None:
        track = about_origin(track, -centre)
    origin = origin_of(recording)
    local = recording._replace(anchors=recording.anchors - origin)
    rotation, translation, covariance = prior_of(recording, settings)
    prior = rotation, translation - origin, covariance
    own = own_std(recording, settings)
    noise = None if own is None else ranging.LinkNoise(own)
    log = smoothing.RangeLog(local.times, local.ranges, local.anchors, local.links, noise)
    model, best = model_of(recording, settings), None
    for rotation, translation in _starts(recording, settings, track):
        found = estimators.smooth(log, model, prior, (rotation, translation - origin))
        if best is None or found.cost < best.cost:
            best = found
        if best.converged and best.squares.sum() < _LOST * best.freedom.sum():
            break
    assert best is not None
    poses = best.rotation, best.translation + origin, best.covariance
    if track.other is not None:
        poses = (*poses[:2], covering(track.other, poses))
    smoothed = Track(recording.times, *poses, other=track.other)
    if centre is not None:
        smoothed = about_origin(smoothed, centre)._replace(at_centre=smoothed.covariance)
    return SmoothedRecording(smoothed, best, time.process_time() - began)


def _along(axes: tuple[int, int, int], size: float) -> tuple[float, float, float]:
    """Return `size` on the axes that are 1, zero on the others."""
    x, y, z = axes
    return size * x, size * y, size * z


def model_of(recording: Recording, settings: Settings) -> smoothing.LogModel:
    """Return the model of a recording according to the settings."""
    laws, planar = settings.smoothing, settings.knowledge.planar
    biases = (
        LinkBias(laws.smooth_constant_m, None, laws.smooth_common_m),
        LinkBias(laws.smooth_bias_std_m, laws.smooth_bias_time_s),
    )
    level = level_of(settings, origin_of(recording))
    turn, shift = ((0, 0, 1), (1, 1, 0)) if planar else ((1, 1, 1), (1, 1, 1))
    wander = WanderingTwist(
        _along(turn, _ANY_TURN),
        _along(shift, _ANY_SPEED),
        _along(turn, math.radians(laws.smooth_accel_deg)),
        _along(shift, laws.smooth_accel_m),
    )
    motion = smoothing.UnknownTwist(wander)
    if planar and not (recording.odometry is None and recording.inertial is None):
        # A sensor replaces the twist, whose law holds height and tilt.
        level = plane_of(recording, settings)
    if recording.odometry is not None:
        told = smoothing.padded(readings_of(recording, settings))
        motion = smoothing.OdometryMotion(*told, settings.odometry.sensor())
    if settings.filter == "iekf-imu":
        told = smoothing.padded(readings_of(recording, settings))
        tilt = math.radians(settings.inertial.gravity_tilt_deg)
        motion = InertialMotion(*told, settings.inertial.sensor(), gravity_tilt_rad=tilt)
        causal = settings.biases
        biases = (
            LinkBias(causal.constant_std_m, None, causal.constant_common_m),
            LinkBias(causal.drift_std_m, causal.drift_time_s),
        )
    return smoothing.LogModel(
        recording.tags,
        ranging.RangeNoise(settings.range_std_m or DEFAULT_RANGE_STD_M),
        motion,
        biases,
        () if level is None else (level,),
        loss=LATE if robust_of(settings) else SQUARES,
        offset=recording.offset,
        directions=recording.directions,
    )


def _starts(
    recording: Recording, settings: Settings, track: Track
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield start tracks, the most promising first."""
    yield track.rotation, track.translation
    if settings.filter == "iekf-imu":
        # A body at rest and reversed time are both incompatible with inertial readings.
        return
    times = recording.times
    backwards = recording.part(slice(None, None, -1))._replace(
        times=times[-1] + times[0] - times[::-1],
        truth=None,
        odometry=_backwards(recording, settings),
    )
    settings = settings.changed(odometry_offset_s=0.0)
    filter = recording_filter(backwards, settings)
    belief = beliefs_of(log_steps(backwards, settings, filter))
    yield belief.rotation[::-1], belief.translation[::-1]
    rotation, translation, _ = start_of(recording, settings)
    K = len(times)
    yield np.broadcast_to(rotation, (K, 3, 3)), np.broadcast_to(translation, (K, 3))


def _backwards(recording: Recording, settings: Settings) -> OdometryLog | None:
    """Return the odometry of the time-reversed motion, on the clock of the ranges."""
    log, times = recording.odometry, recording.times
    if log is None:
        return None
    own = log.times - settings.odometry.odometry_offset_s
    return OdometryLog(times[-1] + times[0] - own[::-1], -log.readings[::-1])


def _check_size(recording: Recording, settings: Settings) -> None:
    K, M, N = recording.ranges.shape
    name, std = "smooth_bias_std_m", settings.smoothing.smooth_bias_std_m
    if settings.filter == "iekf-imu":
        name, std = "drift_std_m", settings.biases.drift_std_m
    drifting = std > 0
    memory = 5 * 8 * K * (12 + drifting * M * N) ** 2
    if memory > _MOST_MEMORY:
        raise ValueError(
            f"smoothing {K} epochs with drifting biases of {M * N} links would take "
            f"{memory / 1e9:.0f} GB of memory: set {name} to 0, or smooth shorter logs"
        )
