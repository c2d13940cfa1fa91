"""The clock of a sensor on the body, by the ranges: of odometry by their likelihood, of an inertial
sensor by the accelerations of the path that they tell.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbl_gym.estimators.calibration.inertial_clock import TaggedRanges, inertial_clock
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.causes import cut, local_trial
from rbl_gym.studies.replay.evidence import evidence, std_of
from rbl_gym.studies.replay.place import start_of
from rbl_gym.studies.replay.settings import Settings

__all__ = ["CLOCK_TRIALS", "SensorClock", "sensor_clock"]

# Offsets that are tried: first this far apart, on both sides of what is told, then finer.
_STEPS, _SIDES = (0.4, 0.1, 0.03), (7, 3, 3)
CLOCK_TRIALS = len(_STEPS)
# Longest part that is looked at, in epochs; of an inertial sensor in ranges, and how far (s).
_MOST, _MOST_RANGES, _SEARCH_S = 1_500, 60_000, 10.0


class SensorClock(NamedTuple):
    """How far the clock of a sensor is ahead of that of the ranges.

    Attributes
    ----------
    offset_s, std_s
        The offset, and its standard deviation, seconds.
    gain
        By how much the log-likelihood is higher: of odometry than at the offset that was given, of
        an inertial sensor than at the best offset elsewhere.
    correlation
        Of the accelerations by the inertial sensor and by the ranges; None: of odometry.
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
    """The offset of a sensor's clock at which its readings fit the ranges best.

    Of odometry the likeliest within 2.4 s of the offset of the settings, on a grid that is made
    finer around its best. Of an inertial sensor by `estimators.calibration.inertial_clock`, within
    10 s. The truth is not looked at.

    Parameters
    ----------
    recording, settings
        What is filtered, and how.
    name
        Of the setting that is the offset.
    advance
        Called after each of `CLOCK_TRIALS` steps.

    Raises
    ------
    ValueError
        If the clocks differ by more, or the data do not tell.
    """
    if name == "imu_offset_s":
        clock = _inertial_clock(recording, settings)
        for _ in range(CLOCK_TRIALS):
            advance()
        return clock
    trial = local_trial(cut(recording, slice(_MOST)), settings)
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
                f"{name}: the ranges are likeliest at {best:+.2f} s, the end of what is tried; "
                "give a rough offset"
            )
        advance()
    fine = _STEPS[-1]
    x = np.array([a for a in seen if abs(a - best) < 2.5 * fine])
    y = np.array([seen[a] for a in x])
    bend, slope, _ = np.polyfit(x - best, y, 2) if len(x) > 2 else (0.0, 0.0, 0.0)
    std = float(1 / np.sqrt(-2 * bend)) if bend < 0 else fine
    if bend < 0:
        best += float(np.clip(-slope / (2 * bend), -fine, fine))
    return SensorClock(best, max(std, 1e-4), max(seen.values()) - seen[round(given, 6)])


def _inertial_clock(recording: Recording, settings: Settings) -> SensorClock:
    log = recording.inertial
    if log is None:
        raise ValueError("imu_offset_s is of imu, and the recording has none")
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
        # Off the plane that anchors may stand in.
        start = start - [0.0, 0.0, 0.5]
    near = settings.inertial.imu_offset_s
    try:
        found = inertial_clock(told, log.times, log.readings, start, near, _SEARCH_S)
    except ValueError as error:
        raise ValueError(f"imu_offset_s: {error} (--time-offset imu=S)") from error
    return SensorClock(found.offset_s, found.std_s, found.gain, found.correlation)
