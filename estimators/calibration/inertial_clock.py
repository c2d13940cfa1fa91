"""Clock offset of an inertial sensor, from the accelerations of a path estimated from ranges.

In windows of some seconds, the gyroscope rotates the specific forces to one frame. Gravity levels
this frame; its heading is unknown. At the right offset, forces and accelerations of the path agree
in every window, in the band between 0.1 and 2 s. This needs no rotations along the path. Rotations
found at the offset then give the positions of the tags.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number
from rbl_gym.estimators.calibration.range_track import range_track
from rbl_gym.geometry import rotations

__all__ = ["InertialClock", "TaggedRanges", "inertial_clock"]

# Seconds: step of the grid, both ends of the band, length of a window and spacing of windows.
_STEP_S, _FAST_S, _WINDOW_S, _HOP_S = 0.02, 0.12, 10.0, 2.5
# Slow end of the band: first, to find all peaks; then, so that slow errors of the ranges do not
# move them.
_SLOW_S, _REFINED_S = 2.0, 0.5
# Correlation time (s) of the noise in such a band, for each of the two horizontal axes.
_RENEWED_S = np.sqrt(np.pi) * _FAST_S
# Offsets that differ from the best by less belong to the same peak.
_PEAK_S = 0.25
# Correlations and gains of log-likelihood below these count as chance.
_LEAST, _GAIN = 0.3, 4.0
_LONGEST_GAP_S = 0.1
# Number of times the tag positions are estimated anew.
_ROUNDS = 5


class TaggedRanges(NamedTuple):
    """Ranges in order of time: arrays (K,) and (K, 3).

    Times in seconds, ranges and standard deviations in metres, anchor positions, tag positions in
    the body frame, and the index of each link, from 0.
    """

    times: FloatArray
    ranges: FloatArray
    std: FloatArray
    anchors: FloatArray
    tags: FloatArray
    links: np.ndarray


class InertialClock(NamedTuple):
    """Time by which the clock of an inertial sensor is ahead of the clock of the ranges.

    Attributes
    ----------
    offset_s, std_s
        The offset and its standard deviation, seconds.
    correlation
        Correlation of the accelerations at the offset.
    rival_s, gain
        The best offset of another peak, and the gain in log-likelihood over it.
    """

    offset_s: float
    std_s: float
    correlation: float
    rival_s: float
    gain: float


class _Window(NamedTuple):
    """A window of readings.

    It has the index of its first grid step, band-passed forces (n, 3) in a level frame, rotations
    (S, 3, 3) from the body to this frame, and their times (S,).
    """

    start: int
    force: FloatArray
    times: FloatArray
    rotation: FloatArray


def inertial_clock(
    told: TaggedRanges,
    times: ArrayLike,
    readings: ArrayLike,
    start: ArrayLike,
    near_s: float = 0.0,
    search_s: float = 10.0,
) -> InertialClock:
    """Estimate the offset at which readings of an inertial sensor fit the path of the tags.

    Parameters
    ----------
    told
        Ranges of one recording.
    times, readings
        (S,) on the sensor's clock; (S, 6), rad/s and m/s^2, in the axes of the body.
    start
        Approximate position (3,) of the tags at the start.
    near_s, search_s
        Centre and half-width of the search for the offset, seconds.

    Raises
    ------
    ValueError
        If the overlap is too short, no offset fits, or another offset fits as well.
    """
    times, readings = check_array("times", times, ("S",)), check_array("readings", readings, (6,))
    search_s = check_number("search_s", search_s, low=0.0)
    windows = _windows(times, readings, float(told.times[0]), _SLOW_S)
    if np.ptp(told.times) < _WINDOW_S or not windows:
        raise ValueError(
            f"imu and ranges must overlap for {_WINDOW_S:g} s without a gap to estimate the time "
            "offset: give the offset in seconds"
        )
    arms = np.zeros_like(told.tags)
    path: Any = start
    first_s, slow = float(told.times[0]), _SLOW_S
    found: InertialClock | None = None
    for _ in range(_ROUNDS):
        path = range_track(told.times, told.ranges, told.anchors - arms, told.std, path, told.links)
        placed = path(np.arange(first_s, told.times[-1], _STEP_S))
        moved = np.zeros_like(placed)
        moved[1:-1] = (placed[2:] - 2 * placed[1:-1] + placed[:-2]) / _STEP_S**2
        moved = _band(moved, slow)
        scores = _scores(moved, windows)
        if found is None:
            best, rival, gain = _sought(scores, near_s, search_s)
            told_at = float(scores.offsets[best]), float(scores.offsets[rival])
            found = InertialClock(told_at[0], 0.0, float(scores.score[best]), told_at[1], gain)
            slow = _REFINED_S
            windows = _windows(times, readings, first_s, slow)
        else:
            offset, std = _peak(moved, scores, found.offset_s)
            found = found._replace(offset_s=offset, std_s=std)
        arms = _arms(moved, windows, found.offset_s, told)
    assert found is not None
    return found


def _band(values: FloatArray, slow_s: float) -> FloatArray:
    """Return the band-pass filtered values (n, 3)."""
    fast = scipy.ndimage.gaussian_filter1d(values, _FAST_S / _STEP_S, axis=0)
    return fast - scipy.ndimage.gaussian_filter1d(fast, slow_s / _STEP_S, axis=0)


def _windows(
    times: FloatArray, readings: FloatArray, first_s: float, slow_s: float
) -> list[_Window]:
    """Return windows of readings on a grid through `first_s`."""
    found: list[_Window] = []
    elapsed = np.diff(times, prepend=times[0])
    edge, size = int(2 * _FAST_S / _STEP_S), int(_WINDOW_S / _STEP_S)
    hop = int(_HOP_S / _STEP_S)
    begin, end = ((t - first_s) / _STEP_S for t in (times[0], times[-1]))
    for start in range(int(np.ceil(begin)), int(end) - size + 1, hop):
        at = first_s + _STEP_S * (start + np.arange(size))
        part = slice(*np.searchsorted(times, [at[0], at[-1] + _STEP_S]))
        gaps = elapsed[part][1:]
        if len(gaps) < size // 10 or gaps.max() > _LONGEST_GAP_S:
            continue
        steps = rotations.exp(readings[part, :3] * elapsed[part, None])
        turn = np.empty_like(steps)
        turn[0] = np.eye(3)
        for k in range(1, len(steps)):
            turn[k] = turn[k - 1] @ steps[k]
        force = (turn @ readings[part, 3:, None])[..., 0]
        up = force.mean(axis=0)
        # Roll and pitch of the frame come from its mean force; its yaw is arbitrary.
        across = np.cross(up, [0.0, 0.0, 1.0])
        angle = np.arctan2(np.linalg.norm(across), up[2])
        axis = across / max(float(np.linalg.norm(across)), 1e-12)
        level = rotations.exp(angle * (axis if across.any() else np.array([1.0, 0.0, 0.0])))
        force = force @ level.T
        even = np.stack([np.interp(at, times[part], f) for f in force.T], axis=-1)
        even = _band(even, slow_s)[edge:-edge]
        found.append(_Window(start + edge, even, times[part], level @ turn))
    return found


def _agreement(moved: FloatArray, window: _Window) -> tuple[np.ndarray, FloatArray]:
    """Correlate a window with the path at every shift: horizontal (complex) and vertical."""
    across = [a[:, 0] + 1j * a[:, 1] for a in (moved, window.force)]
    return (
        np.correlate(across[0], across[1], "valid"),
        np.correlate(moved[:, 2], window.force[:, 2], "valid"),
    )


class _Scores(NamedTuple):
    """Correlations (L,) at offsets (L,), and the total seconds of windows used for each."""

    offsets: FloatArray
    score: FloatArray
    seconds: FloatArray


def _scores(moved: FloatArray, windows: Sequence[_Window]) -> _Scores:
    size = len(windows[0].force)
    places = np.arange(len(moved) - size + 1)
    low = windows[0].start - int(places[-1])
    offsets = _STEP_S * np.arange(low, windows[-1].start + 1)
    shared, ours, theirs, seconds = np.zeros((4, len(offsets)))
    power = np.concatenate([[0.0], np.cumsum((moved**2).sum(axis=1))])
    for window in windows:
        # At index i of the path the sensor is ahead by start - i steps.
        where = window.start - places - low
        across, up = _agreement(moved, window)
        shared[where] += np.abs(across) + up
        ours[where] += power[size:] - power[:-size]
        theirs[where] += (window.force**2).sum()
        seconds[where] += _HOP_S
    return _Scores(offsets, shared / np.sqrt(np.maximum(ours * theirs, 1e-300)), seconds)


def _sought(scores: _Scores, near_s: float, search_s: float) -> tuple[int, int, float]:
    """Return the best index, its rival, and the gain, or raise ValueError with the reason."""
    offsets, score, seconds = scores
    tried = (seconds >= 0.5 * seconds.max()) & (np.abs(offsets - near_s) <= search_s + 1e-9)
    if not tried.any():
        raise ValueError(
            f"imu and ranges overlap too little at time offsets from {near_s - search_s:g} to "
            f"{near_s + search_s:g} s: give a rough offset in seconds"
        )
    score = np.where(tried, score, 0.0)
    best = int(np.argmax(score))
    what = "the accelerations of imu and of the track from the ranges agree"
    if score[best] < _LEAST:
        raise ValueError(
            f"{what} too little at every time offset (highest correlation {score[best]:.2f}, at "
            f"{offsets[best]:+.2f} s): give the offset in seconds"
        )
    if best in np.flatnonzero(tried)[[0, -1]]:
        raise ValueError(
            f"{what} best at {offsets[best]:+.2f} s, the end of the search: give a rough offset in "
            "seconds"
        )
    elsewhere = np.where(np.abs(offsets - offsets[best]) > _PEAK_S, score, 0.0)
    rival = int(np.argmax(elsewhere))
    ratio = (1 - elsewhere[rival] ** 2) / (1 - score[best] ** 2)
    gain = 0.5 * float(seconds[best] / _RENEWED_S * np.log(ratio))
    if gain < _GAIN:
        raise ValueError(
            f"{what} about as well at {offsets[rival]:+.2f} s as at {offsets[best]:+.2f} s "
            f"(correlations {elsewhere[rival]:.2f} and {score[best]:.2f}): give the offset in "
            "seconds"
        )
    return best, rival, gain


def _peak(moved: FloatArray, scores: _Scores, near_s: float) -> tuple[float, float]:
    """Return the best offset near one, and its standard deviation."""
    offsets, score, seconds = scores
    best = int(np.argmax(np.where(np.abs(offsets - near_s) <= _PEAK_S, score, -1.0)))
    before, top, after = score[np.clip([best - 1, best, best + 1], 0, len(score) - 1)]
    fine = 0.5 * (before - after) / min(before - 2 * top + after, -1e-12)
    swing = float((np.gradient(moved, _STEP_S, axis=0) ** 2).sum() / (moved**2).sum())
    variance = (1 / max(top, 0.01) ** 2 - 1) / (swing * seconds[best] / _RENEWED_S)
    return float(offsets[best] + _STEP_S * np.clip(fine, -1, 1)), float(np.sqrt(variance))


def _arms(
    moved: FloatArray, windows: Sequence[_Window], offset_s: float, told: TaggedRanges
) -> FloatArray:
    """Return arms (K, 3) of the tags in the world, from rotations and yaw of the nearest window."""
    centres = np.array([window.times.mean() for window in windows])
    nearest = np.abs(told.times[:, None] + offset_s - centres).argmin(axis=1)
    arms = np.empty_like(told.tags)
    for k, window in enumerate(windows):
        mine = nearest == k
        if not mine.any():
            continue
        across, _ = _agreement(moved, window)
        place = window.start - round(offset_s / _STEP_S)
        turn = across[np.clip(place, 0, len(across) - 1)]
        yaw = rotations.exp(np.array([0.0, 0.0, np.angle(turn)]))
        at = np.searchsorted(window.times, told.times[mine] + offset_s)
        body = yaw @ window.rotation[np.clip(at, 0, len(window.times) - 1)]
        arms[mine] = (body @ told.tags[mine, :, None])[..., 0]
    return arms
