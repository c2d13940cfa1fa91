"""What a recording and what is known of the body say of its place."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.settings import Settings

__all__ = [
    "height_offset",
    "origin_of",
    "volume_of",
]

# Coordinates beyond this are those of a map.
_MAP_M = 1e4
# Heights of anchors within this much are one plane.
_PLANE_M = 0.1


def origin_of(recording: Recording) -> FloatArray:
    """Where coordinates (3,) are taken from: the origin, or for those of a map the anchors."""
    if np.abs(recording.anchors).max() < _MAP_M:
        return np.zeros(3)
    return np.round(recording.anchors.reshape(-1, 3).mean(axis=0))


def reach_of(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Corners (3,) each of the box that the longest range leaves around the anchors."""
    longest = recording.ranges.max()
    anchors = recording.anchors.reshape(-1, 3)
    return anchors.min(axis=0) - longest, anchors.max(axis=0) + longest


def volume_of(recording: Recording, settings: Settings) -> FloatArray | None:
    """Corners (2, 3) of where the body may be, infinite where there is no limit; None: anywhere.

    Raises
    ------
    ValueError
        If the volume is further from the anchors than any range, or nothing of it is below them
        where that is asked for.
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
                f"volume must reach below the anchors' mean height of {mean:.4g} m with "
                f"below_anchors, got zmin {low[2]:g}"
            )
        high[2] = min(high[2], mean)
    reach = reach_of(recording)
    if (np.array(low) > reach[1]).any() or (np.array(high) < reach[0]).any():
        raise ValueError(
            f"volume must be in reach of the anchors, between {np.round(reach[0], 1).tolist()} and "
            f"{np.round(reach[1], 1).tolist()} m, got {settings.knowledge.volume}"
        )
    return np.array([low, high])


def has_own_std(recording: Recording, settings: Settings) -> bool:
    """Whether every range has its own standard deviation."""
    return settings.range_std_m is None and recording.range_std is not None


def height_offset(recording: Recording, settings: Settings) -> float:
    """How far the tags lie below the anchors [m]; a ValueError where that has to be said."""
    heights = recording.anchors[..., 2]
    if (
        settings.knowledge.planar
        and settings.knowledge.height_offset_m is None
        and np.ptp(heights) > _PLANE_M
    ):
        raise ValueError(
            f"height_offset_m must be given for anchors at heights of {heights.min():g} to "
            f"{heights.max():g} m: how far the tags lie below the anchors' mean height"
        )
    return settings.knowledge.height_offset_m or 0.0
