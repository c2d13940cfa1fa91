"""The clock of a sensor on the body, by the likelihood of the ranges."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.causes import cut, local_trial
from rbl_gym.studies.replay.evidence import evidence
from rbl_gym.studies.replay.inertial import covered
from rbl_gym.studies.replay.settings import Settings

__all__ = ["CLOCK_TRIALS", "SensorClock", "sensor_clock"]

# Offsets that are tried: first this far apart, on both sides of what is told, then finer.
_STEPS, _SIDES = (0.4, 0.1, 0.03), (7, 3, 3)
CLOCK_TRIALS = len(_STEPS)
# How far that reaches (s).
_REACH_S = sum(step * side for step, side in zip(_STEPS, _SIDES, strict=True))
# Longest part that is looked at, in epochs.
_MOST = 1_500


class SensorClock(NamedTuple):
    """How far the clock of a sensor is ahead of that of the ranges.

    Attributes
    ----------
    offset_s, std_s
        The offset, and its standard deviation by the curvature of the log-likelihood, seconds.
    gain
        By how much the log-likelihood is higher than at the offset that was given.
    """

    offset_s: float
    std_s: float
    gain: float


def sensor_clock(
    recording: Recording,
    settings: Settings,
    name: str = "odometry_offset_s",
    advance: Callable[[], None] = lambda: None,
) -> SensorClock:
    """The offset of a sensor's clock at which its readings make the ranges likeliest.

    Looked for within 2.4 s of the offset of the settings, on a grid that is made finer
    around its best. The truth is not looked at.

    Parameters
    ----------
    recording, settings
        What is filtered, and how.
    name
        Of the setting that is the offset.
    advance
        Called after each of the `CLOCK_TRIALS` grids.

    Raises
    ------
    ValueError
        If the best is at the end of the grid, so that the clocks differ by more.
    """
    if name == "imu_offset_s":
        recording = covered(recording, settings, margin_s=_REACH_S)
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
