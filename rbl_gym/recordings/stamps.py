"""Convert time stamps, and detect their unit if it is not given."""

from __future__ import annotations

import re
from datetime import UTC, datetime

import numpy as np

from rbl_gym.checks import FloatArray

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}

# Largest usual spacing of epochs (s), and latest start of a log (s), in this unit.
_LONGEST_STEP_S = {"s": 10.0, "ms": 1.0, "us": 1.0}
_LATEST_S = 1e11
# Smallest usual spacing of the poses of a truth (s).
_SHORTEST_STEP_S = 5e-4
# Seconds since 1970 of the years 2001 to 2065: the size of such stamps determines their unit.
_DATES_S = (1e9, 3e9)
_LONGEST_DATED_STEP_S = 60.0
# With fewer distinct times, the spacing gives no information.
_FEWEST = 4
# Integers with a larger spacing are taken as milliseconds if there are many.
_WHOLE_STEP_S, _MANY = 2.0, 20
_ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d")


def seconds_per(unit: str) -> float:
    """Return the length of one `unit` of time in seconds.

    ValueError if `unit` is not one of s, ms, us, ns.
    """
    if unit not in TIME_UNITS:
        raise ValueError(f"time unit must be one of {', '.join(TIME_UNITS)}, iso, got {unit!r}")
    return TIME_UNITS[unit]


def dated_unit(stamps: FloatArray) -> str | None:
    """Return the unit of stamps (K,) since 1970 in the years 2001 to 2065; None: no such stamps."""
    distinct = np.unique(stamps)
    if len(distinct) < 2:
        return None
    step, start = float(np.median(np.diff(distinct))), float(abs(distinct[0]))
    for name, scale in TIME_UNITS.items():
        if _DATES_S[0] <= start * scale <= _DATES_S[1] and step * scale <= _LONGEST_DATED_STEP_S:
            return name
    return None


def unit_by_length(stamps: FloatArray, times: FloatArray | None) -> str:
    """Return the unit in which stamps (L,) span about as long as a log (K,) in seconds; else s.

    Logs of one run have similar lengths.
    """
    if times is None or len(stamps) < 2:
        return "s"
    length, step = float(np.ptp(times)), float(np.median(np.diff(np.sort(stamps))))
    for name, scale in TIME_UNITS.items():
        if step * scale < _SHORTEST_STEP_S:
            break
        if 0.2 * length < float(np.ptp(stamps)) * scale < 5 * length:
            return name
    return "s"


def found_unit(stamps: FloatArray) -> tuple[str, str]:
    """Return the probable unit of stamps (K,), and a note on it if it is not seconds."""
    distinct = np.unique(stamps)
    if len(distinct) < 2:
        return "s", ""
    step, start = float(np.median(np.diff(distinct))), float(abs(distinct[0]))
    unit = "ns"
    dated = dated_unit(stamps)
    if dated is not None:
        return dated, _words(dated, step)
    if len(distinct) < _FEWEST:
        return "s", ""
    for name, scale in TIME_UNITS.items():
        if step * scale <= _LONGEST_STEP_S.get(name, np.inf) and start * scale <= _LATEST_S:
            unit = name
            break
    if unit == "s" and step >= _WHOLE_STEP_S:
        # A log of many integers has ticks of a clock.
        if len(distinct) >= _MANY and (distinct == np.round(distinct)).all():
            return "ms", _words("ms", step)
        return "s", (
            f"times are {step:.6g} apart (median) and are read as seconds; set the time unit to "
            "ms if they are milliseconds"
        )
    return unit, _words(unit, step)


def _words(unit: str, step: float) -> str:
    if unit == "s":
        return ""
    return (
        f"times are read as {WORDS[unit]}, as they are {step:.6g} apart (median); set the time "
        "unit if this is wrong"
    )


def iso_seconds(cells: list[str]) -> FloatArray | None:
    """Convert ISO 8601 times to seconds since 1970, NaN for other cells; None: no cell is a time.

    A time without a zone is taken as UTC. Digits beyond the microsecond are dropped.
    """
    stamps = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        if _ISO.match(cell.strip()):
            try:
                when = datetime.fromisoformat(cell.strip())
            except ValueError:
                continue
            when = when.replace(tzinfo=when.tzinfo or UTC)
            stamps[i] = (when - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()
    return None if np.isnan(stamps).all() else stamps
