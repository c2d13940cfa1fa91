"""How a recording is filtered, and what follows from it and the recording."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray, check_number
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.recordings.reading import Recording

__all__ = [
    "DEFAULT_RANGE_STD_M",
    "Settings",
    "height_offset",
    "origin_of",
    "volume_of",
]

# Coordinates beyond this are those of a map.
_MAP_M = 1e4
# Heights of anchors within this much are one plane.
_PLANE_M = 0.1

DEFAULT_RANGE_STD_M = 0.12


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a recording is filtered.

    Parameters
    ----------
    filter
        Name of the filter.
    range_std_m
        Standard deviation of a range; None: the recording's own where it has one, else
        `DEFAULT_RANGE_STD_M`, which covers link biases that change with the pose.
    walk_m, walk_deg
        No twist is known: the pose is a random walk of this standard deviation after 1 s.
    robust
        Huber's loss (the iterated EKFs only).
    bias_std_m, bias_time_s, bias_common_m
        Law of the links' biases (`rbl_gym.measurements.link_bias.LinkBias`), of the filter
        ``"iekf-bias"``.
    accel_m, accel_deg
        Of the filter ``"iekf-cv"``: how much speed (m/s) and turn rate (deg/s) change in 1 s.
    planar
        Hold height, roll and pitch by a tight prior.
    height_offset_m
        How far the tags' mean height lies below the anchors' (planar only). None: the same height,
        which anchors in one plane alone can mean.
    yaw_offset_deg
        Constant turn of the tag table against the truth's body frame: the yaw error is
        estimate - (truth + offset).
    volume
        Where the body's origin may be: xmin, xmax, ymin, ymax, zmin, zmax in metres, None where
        there is no limit. It tells a pose from its mirror image.
    below_anchors
        The body stays below the anchors' mean height.
    truth_gap_s
        Longest gap, of the truth or of the ranges, that is bridged to compare the two.
    """

    filter: str = "iekf"
    range_std_m: float | None = None
    walk_m: float = 0.1
    walk_deg: float = 7.0
    robust: bool = True
    bias_std_m: float = 0.02
    bias_time_s: float | None = 3.0
    bias_common_m: float = 0.0
    accel_m: float = 0.5
    accel_deg: float = 30.0
    planar: bool = False
    height_offset_m: float | None = None
    yaw_offset_deg: float = 0.0
    volume: tuple[float | None, ...] | None = None
    below_anchors: bool = False
    truth_gap_s: float = 0.5

    def __post_init__(self) -> None:
        if self.range_std_m is not None:
            check_number("range_std_m", self.range_std_m, low=1e-6)
        check_number("walk_m", self.walk_m, low=0.0)
        check_number("walk_deg", self.walk_deg, low=0.0)
        LinkBias(self.bias_std_m, self.bias_time_s, self.bias_common_m)
        check_number("accel_m", self.accel_m, low=0.0)
        check_number("accel_deg", self.accel_deg, low=0.0)
        if check_number("height_offset_m", self.height_offset_m or 0.0) != 0 and not self.planar:
            raise ValueError("height_offset_m means nothing without planar")
        check_number("yaw_offset_deg", self.yaw_offset_deg)
        check_number("truth_gap_s", self.truth_gap_s, low=0.0)
        if self.volume is not None:
            object.__setattr__(self, "volume", _six_limits(self.volume))


def _six_limits(volume: Any) -> tuple[float | None, ...]:
    limits = tuple(volume)
    if len(limits) != 6:
        raise ValueError(
            f"volume must be xmin, xmax, ymin, ymax, zmin, zmax, got {len(limits)} numbers"
        )
    limits = tuple(None if x is None else check_number("volume", x) for x in limits)
    for axis, low, high in zip("xyz", limits[::2], limits[1::2], strict=True):
        if low is not None and high is not None and low >= high:
            raise ValueError(f"volume must have {axis}min below {axis}max, got {low:g}, {high:g}")
    return limits


def origin_of(recording: Recording) -> FloatArray:
    """Where coordinates (3,) are taken from: the origin, or for those of a map the anchors."""
    if np.abs(recording.anchors).max() < _MAP_M:
        return np.zeros(3)
    return np.round(recording.anchors.mean(axis=0))


def reach_of(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Corners (3,) each of the box that the longest range leaves around the anchors."""
    longest = recording.ranges.max()
    return recording.anchors.min(axis=0) - longest, recording.anchors.max(axis=0) + longest


def volume_of(recording: Recording, settings: Settings) -> FloatArray | None:
    """Corners (2, 3) of where the body may be, infinite where there is no limit; None: anywhere.

    Raises
    ------
    ValueError
        If the volume is further from the anchors than any range, or nothing of it is below them
        where that is asked for.
    """
    if settings.volume is None and not settings.below_anchors:
        return None
    limits = settings.volume or (None,) * 6
    low = [-np.inf if x is None else x for x in limits[::2]]
    high = [np.inf if x is None else x for x in limits[1::2]]
    if settings.below_anchors:
        seen = recording.links.any(axis=(0, 2))
        mean = float(recording.anchors[seen, 2].mean())
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
            f"{np.round(reach[1], 1).tolist()} m, got {settings.volume}"
        )
    return np.array([low, high])


def has_own_std(recording: Recording, settings: Settings) -> bool:
    """Whether every range has its own standard deviation."""
    return settings.range_std_m is None and recording.range_std is not None


def height_offset(recording: Recording, settings: Settings) -> float:
    """How far the tags lie below the anchors [m]; a ValueError where that has to be said."""
    heights = recording.anchors[:, 2]
    if settings.planar and settings.height_offset_m is None and np.ptp(heights) > _PLANE_M:
        raise ValueError(
            f"height_offset_m must be given for anchors at heights of {heights.min():g} to "
            f"{heights.max():g} m: how far the tags lie below the anchors' mean height"
        )
    return settings.height_offset_m or 0.0
