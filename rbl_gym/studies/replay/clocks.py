"""Estimate the clock offset of a sensor from the ranges.

For odometry the likelihood of the ranges is used, for an inertial sensor the accelerations of the
estimated path.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbl_gym.estimators.calibration.inertial_clock import TaggedRanges, inertial_clock
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.causes import local_trial
from rbl_gym.studies.replay.evidence import evidence, std_of
from rbl_gym.studies.replay.place import start_of
from rbl_gym.studies.replay.settings import Settings

__all__ = ["CLOCK_TRIALS", "SensorClock", "sensor_clock"]

# Spacing of the tested offsets, first coarse, then finer, and their number on each side.
_STEPS, _SIDES = (0.4, 0.1, 0.03), (7, 3, 3)
CLOCK_TRIALS = len(_STEPS)
# Offsets (s) about the best one that determine the peak.
_NEAR_S = 0.25
# Longest part used: in epochs, for an inertial sensor in ranges; and its search range (s).
_MOST, _MOST_RANGES, _SEARCH_S = 1_500, 60_000, 10.0


class SensorClock(NamedTuple):
    """How far the clock of a sensor is ahead of that of the ranges.

    Attributes
    ----------
    offset_s, std_s
        The offset, and its standard deviation, seconds.
    gain
        Increase of the log-likelihood: for odometry relative to the given offset, for an inertial
        sensor relative to the best other offset.
    correlation
        Correlation of the accelerations from the inertial sensor and the ranges; None for odometry.
    """

    offset_s: float
    std_s: float
    gain: float
    correlation: float | None = None


def sensor_clock(
    recording: Recording,
    settings: Settings,
    name: str = "odometry_offset_s",
    advance: Callable[[], None] = lambda: None,
) -> SensorClock:
    """Estimate the clock offset of a sensor at which its readings fit the ranges best.

    For odometry it is the most likely offset within 2.4 s of that in the settings, on a grid that
    is refined around its best point. For an inertial sensor it is found by
    `estimators.calibration.inertial_clock`, within 10 s. The truth is not used.

    Parameters
    ----------
    recording, settings
        The recording to filter, and the settings.
    name
        Name of the setting with the offset.
    advance
        Called after each of `CLOCK_TRIALS` steps.

    Raises
    ------
    ValueError
        If the clocks differ by more, or the data do not determine the offset.
    """
    if name == "imu_offset_s":
        clock = _inertial_clock(recording, settings)
        for _ in range(CLOCK_TRIALS):
            advance()
        return clock
    trial = local_trial(recording.part(slice(_MOST)), settings)
    given = float(settings.flat()[name])
    seen: dict[float, float] = {}
    best = given
    for step, side in zip(_STEPS, _SIDES, strict=True):
        tried = [round(best + step * k, 6) for k in range(-side, side + 1)]
        new = [x for x in tried if x not in seen]
        trials = [trial._replace(settings=trial.settings.changed(**{name: x})) for x in new]
        seen |= dict(zip(new, evidence(trials).log_likelihood.sum(axis=1).tolist(), strict=True))
        best = max(tried, key=lambda x: seen[x])
        if step == _STEPS[0] and best in (tried[0], tried[-1]):
            raise ValueError(
                f"{name}: the likelihood of the ranges is highest at {best:+.2f} s, the end of "
                f"the search; give a rough offset (--time-offset {name.partition('_')[0]}=S)"
            )
        advance()
    at, std = _peak({x: y for x, y in seen.items() if abs(x - best) < _NEAR_S}, best)
    return SensorClock(at, std, max(seen.values()) - seen[round(given, 6)])


def _peak(seen: dict[float, float], best: float) -> tuple[float, float]:
    """Return the place of the peak of log-likelihoods by offset, and its standard deviation.

    A parabola is fitted to all of them, and again to those within three standard deviations: the
    curvature between the finest steps alone is too uncertain.
    """
    fine = _STEPS[-1]
    x, y = np.array(sorted(seen)), np.array([seen[a] for a in sorted(seen)])
    std, step = fine, 0.0
    near = np.ones(len(x), np.bool_)
    for _ in range(2):
        bend, slope, _ = np.polyfit(x[near] - best, y[near], 2)
        if bend >= 0:
            break
        std = float(1 / np.sqrt(-2 * bend))
        step = float(np.clip(-slope / (2 * bend), -2 * fine, 2 * fine))
        near = np.abs(x - best) < max(3 * std, 2.5 * fine)
    return best + step, max(std, 1e-4)


def _inertial_clock(recording: Recording, settings: Settings) -> SensorClock:
    log = recording.inertial
    if log is None:
        raise ValueError("imu_offset_s needs imu, but the recording has none")
    recording, settings = local_trial(recording, settings)
    k, m, n = (a[:_MOST_RANGES] for a in np.nonzero(recording.links))
    told = TaggedRanges(
        recording.times[k],
        recording.ranges[k, m, n],
        std_of(recording, settings)[k, m, n],
        recording.anchors_by_epoch[k, m],
        recording.tags[n],
        np.unique(m * len(recording.tags) + n, return_inverse=True)[1],
    )
    start = start_of(recording, settings)[1]
    if settings.knowledge.start is None:
        # Start outside the plane of coplanar anchors.
        start = start - [0.0, 0.0, 0.5]
    near = settings.inertial.imu_offset_s
    try:
        found = inertial_clock(told, log.times, log.readings, start, near, _SEARCH_S)
    except ValueError as error:
        raise ValueError(f"imu_offset_s: {error} (--time-offset imu=S)") from error
    return SensorClock(found.offset_s, found.std_s, found.gain, found.correlation)
