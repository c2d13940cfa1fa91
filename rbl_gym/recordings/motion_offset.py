"""Estimate the clock offset of two tracks of one body from its velocities and turn rates."""

from __future__ import annotations

import numpy as np
import scipy

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.recordings.time_offset import TimeOffset, time_offset

__all__ = ["motion_offset"]

# Rates are computed from a path smoothed by a Gaussian of this many seconds, or median steps.
_SMOOTH_S, _STEPS = 0.25, 1.5
# Grid points per standard deviation of the smoothing.
_FINE = 4
# Two estimates that differ by more standard deviations are inconsistent.
_APART = 4.0
_MOST_POINTS = 5_000_000

Poses = tuple[FloatArray, FloatArray | None, FloatArray]


def motion_offset(
    a: Poses,
    b: Poses,
    search_s: float | None = None,
    *,
    planar: bool = False,
    one_frame: bool = True,
) -> TimeOffset:
    """Estimate the clock offset at which two tracks of a body have the same motion.

    Velocities and turn rates are compared separately (`time_offset`). The two offsets are averaged
    with inverse-variance weights; one of them suffices. A causal filter lags behind the motion, and
    this lag is part of the offset.

    Parameters
    ----------
    a, b
        Times (K,) in seconds, rotation (K, 3, 3) or None, translation (K, 3), for each track.
    search_s
        As in `time_offset`.
    planar
        Compare only the motion in x and y and the rotation about z.
    one_frame
        Both tracks are in one world frame, or in shifted frames: vectors are compared. Otherwise
        their lengths are compared, which do not depend on the frame. `planar` frames differ by a
        rotation about z only.

    Returns
    -------
    TimeOffset
        Stamp t in `a` corresponds to ``t + offset_s`` in `b`. If the offsets of velocities and turn
        rates differ by more than four standard deviations, the standard deviation is at least half
        of their difference.

    Raises
    ------
    ValueError
        As in `time_offset`, if neither velocities nor turn rates give an offset.
    """
    steps = [float(np.median(np.diff(poses[0]))) if len(poses[0]) > 1 else 1.0 for poses in (a, b)]
    width = max(_SMOOTH_S, _STEPS * max(steps))
    found: list[TimeOffset] = []
    failed: ValueError | None = None
    for turning in (False, True):
        if turning and (a[1] is None or b[1] is None):
            continue
        axes = [2] if planar and turning else [0, 1] if planar else [0, 1, 2]
        signals = []
        try:
            for times, rotation, translation in (a, b):
                path = translation if not turning or rotation is None else _turned(rotation)
                when, rates = _rates(times, path[:, axes], width)
                # A rotation of the frame about z changes nothing.
                if not one_frame and not (planar and turning):
                    rates = np.linalg.norm(rates, axis=-1)
                signals += [when, rates]
            found.append(time_offset(*signals, search_s=search_s, smooth_s=width / _FINE))
        except ValueError as error:
            failed = failed or error
    if not found:
        raise ValueError(f"the motion does not determine a time offset: {failed}") from failed
    if len(found) == 1:
        return found[0]
    return _together(*found)


def _together(one: TimeOffset, other: TimeOffset) -> TimeOffset:
    """Return the mean of two offsets, weighted by their inverse variances."""
    offsets = np.array([one.offset_s, other.offset_s])
    variance = np.maximum(np.square([one.std_s, other.std_s]), 1e-30)
    apart = abs(offsets[0] - offsets[1])
    std = float(np.sqrt(1 / (1 / variance).sum()))
    if apart > _APART * np.sqrt(variance.sum()):
        std = max(std, 0.5 * float(apart))
    mean = offsets[0] + (offsets[1] - offsets[0]) * variance[0] / variance.sum()
    return TimeOffset(float(mean), std, max(one.correlation, other.correlation))


def _turned(rotation: FloatArray) -> FloatArray:
    """Return the path (K, 3) whose rate is the turn rate, in the world frame."""
    step = rotations.error(rotation[1:], rotation[:-1])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])


def _rates(times: FloatArray, path: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) on a grid and the smoothed rates (n, D) of a path (K, D), without gaps."""
    if len(times) < 2 or np.ptp(times) < 4 * width:
        lasts = np.ptp(times) if len(times) else 0.0
        raise ValueError(
            f"a track must last {4 * width:.3g} s or longer, got {lasts:.3g} s ({len(times)} poses)"
        )
    step = width / _FINE
    count = int(np.ptp(times) / step) + 1
    if count > _MOST_POINTS:
        raise ValueError(f"a track must last at most {_MOST_POINTS * step:.3g} s")
    grid = times[0] + step * np.arange(count)
    after = np.clip(np.searchsorted(times, grid, side="right"), 1, len(times) - 1)
    known = times[after] - times[after - 1] <= 2 * width
    # The first position is subtracted, because map coordinates have few digits left.
    columns = [np.interp(grid, times, column - column[0]) for column in path.T]
    rates = [
        scipy.ndimage.gaussian_filter1d(c, _FINE, order=1, mode="nearest") / step for c in columns
    ]
    near = scipy.ndimage.gaussian_filter1d(known.astype(float), _FINE, mode="constant")
    # At most a quarter of the weight may lie in gaps or beyond an end.
    used = known & (near > 0.75)
    return grid[used], np.stack(rates, axis=-1)[used]
