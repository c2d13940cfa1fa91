"""Derive the prior position of the body from a recording and the settings."""

from __future__ import annotations

import math

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.geometry import rotations
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.settings import Settings

__all__ = ["height_offset", "origin_of", "volume_of"]

# Coordinates above this value are map coordinates.
_MAP_M = 1e4
# Default standard deviations of a known start, and of its yaw.
START_M, _START_DEG = 0.5, 30.0
# Standard deviations of height (m), roll and pitch (rad) under the planar constraint.
_PLANAR_STD = 1e-3
# Correlation time (s) below the spacing of epochs.
_EVERY_S = 1e-6
# Anchors with heights within this margin are in one plane.
_PLANE_M = 0.1


def origin_of(recording: Recording) -> FloatArray:
    """Return the origin (3,) of coordinates: zero, or the anchors for map coordinates."""
    if np.abs(recording.anchors).max() < _MAP_M:
        return np.zeros(3)
    return np.round(recording.anchors.reshape(-1, 3).mean(axis=0))


def reach_of(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return the corners, (3,) each, of the box around the anchors within the longest range."""
    longest = recording.ranges.max()
    anchors = recording.anchors.reshape(-1, 3)
    return anchors.min(axis=0) - longest, anchors.max(axis=0) + longest


def volume_of(recording: Recording, settings: Settings) -> FloatArray | None:
    """Return corners (2, 3) of the possible positions, infinite without a limit; None: anywhere.

    Raises
    ------
    ValueError
        If the volume is further from the anchors than any range, or no part of it is below them
        although the body must be.
    """
    if settings.knowledge.volume is None and not settings.knowledge.below_anchors:
        return None
    limits = settings.knowledge.volume or (None,) * 6
    low = [-np.inf if x is None else x for x in limits[::2]]
    high = [np.inf if x is None else x for x in limits[1::2]]
    if settings.knowledge.below_anchors:
        seen = recording.links.any(axis=(0, 2))
        mean = float(recording.anchors[..., seen, 2].mean())
        if low[2] >= mean:
            raise ValueError(
                f"volume must have zmin below {mean:.4g} m, the anchors' mean height, as "
                f"below_anchors is set; got zmin {low[2]:g}"
            )
        high[2] = min(high[2], mean)
    reach = reach_of(recording)
    if (np.array(low) > reach[1]).any() or (np.array(high) < reach[0]).any():
        raise ValueError(
            "volume must overlap with the space that the anchors reach, from "
            f"{np.round(reach[0], 1).tolist()} to {np.round(reach[1], 1).tolist()} m, got "
            f"{low} to {high}"
        )
    return np.array([low, high])


def start_of(recording: Recording, settings: Settings) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rotation, translation and covariance (6, 6) of the body before the first ranges.

    The prior is anywhere among the anchors with any rotation, restricted by the known start,
    volume, height or level body. Coordinates are those of the world.
    """
    known, anchors = settings.knowledge, recording.anchors_by_epoch[0]
    rotation, centre = np.eye(3), anchors.mean(axis=0)
    # Anchors may be close together, for instance on one body.
    away = float(np.median(recording.ranges[recording.links]))
    extent = max(float(np.ptp(anchors, axis=0).max()), away, 1.0)
    std = np.array([math.pi] * 3 + [extent] * 3)
    volume = volume_of(recording, settings)
    if volume is not None:
        bounded = np.isfinite(volume).all(axis=0)
        centre = np.where(bounded, np.where(bounded, volume, 0.0).mean(axis=0), centre)
        half = 0.5 * np.diff(np.where(bounded, volume, 0.0), axis=0)[0]
        std[3:] = np.where(bounded, half, std[3:])
    if known.planar:
        centre[2] -= height_offset(recording, settings) + recording.tags[:, 2].mean()
    if known.start is not None:
        centre = np.array(known.start[:3])
        std[3:] = START_M if known.prior_position_m is None else known.prior_position_m
        if len(known.start) == 4:
            rotation = rotations.exp([0.0, 0.0, math.radians(known.start[3])])
            std[:3] = math.radians(_START_DEG)
        if known.prior_rotation_deg is not None:
            std[:3] = math.radians(known.prior_rotation_deg)
    if known.height_m is not None:
        centre[2] = known.height_m
        std[5] = min(std[5], known.height_std_m or std[5])
    if known.tilt_std_deg is not None:
        std[:2] = np.minimum(std[:2], math.radians(known.tilt_std_deg))
    if known.planar:
        std[[0, 1, 5]] = _PLANAR_STD
    return rotation, centre, np.diag(std**2)


def level_of(settings: Settings, origin: FloatArray) -> Level | None:
    """Return the soft constraint on height and tilt, relative to an origin (3,); None: none."""
    known = settings.knowledge
    if known.height_std_m is None and known.tilt_std_deg is None:
        return None
    height = tilt = None
    if known.height_std_m is not None and known.height_m is not None:
        height = known.height_m - float(origin[2])
    if known.tilt_std_deg is not None:
        tilt = math.radians(known.tilt_std_deg)
    return Level(height, known.height_std_m, tilt)


def plane_of(recording: Recording, settings: Settings) -> Level:
    """Return the planar constraint, at every epoch, on height and tilt relative to `origin_of`."""
    _, place, _ = start_of(recording, settings)
    height = float(place[2] - origin_of(recording)[2])
    # Every epoch has full weight.
    return Level(height, _PLANAR_STD, _PLANAR_STD, time_s=_EVERY_S)


def has_own_std(recording: Recording, settings: Settings) -> bool:
    """Return whether every range has its own standard deviation."""
    return settings.range_std_m is None and recording.range_std is not None


def own_std(recording: Recording, settings: Settings) -> FloatArray | None:
    """Return the standard deviations (K, M, N) of a recording; None: it has none that are used."""
    std = recording.range_std
    if std is None or not has_own_std(recording, settings):
        return None
    return settings.inertial.recorded_share * std if settings.filter == "iekf-imu" else std


def height_offset(recording: Recording, settings: Settings) -> float:
    """Return how far the tags are below the anchors [m]; raise ValueError if it must be given."""
    heights, known = recording.anchors[..., 2], settings.knowledge
    told = (known.height_offset_m, known.height_m, known.start)
    if known.planar and all(x is None for x in told) and np.ptp(heights) > _PLANE_M:
        raise ValueError(
            "planar needs height_m (height of the body) or height_offset_m (depth of the tags "
            "below the anchors, difference of the mean heights), as the anchors are at heights "
            f"of {heights.min():g} to {heights.max():g} m"
        )
    return settings.knowledge.height_offset_m or 0.0
