"""Read odometry logs: velocities and turn rates in body axes, split at the times of epochs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, check_number, check_one_of
from rbl_gym.recordings.column_units import METRES, SPEEDS, TURN_UNITS
from rbl_gym.recordings.inertial import rate_unit
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import AS_NAMED, AnyPath, Source, Table, read_table

__all__ = ["OdometryLog", "odometry_between", "read_odometry"]

_COLUMNS = ("wx", "wy", "wz", "vx", "vy", "vz")
_WHEELS = ("left", "right")
# Upper limits of turn rate and speed (rad/s, m/s).
_MAX_RATE, _MAX_SPEED = 50.0, 150.0


class OdometryLog(NamedTuple):
    """Odometry readings: times (K,) in seconds, and (K, 6), rad/s then m/s, in body axes.

    Components that the sensor does not measure are NaN.
    """

    times: FloatArray
    readings: FloatArray


def read_odometry(
    path: AnyPath,
    source: Source = AS_NAMED,
    said: Said | None = None,
    *,
    wheelbase_m: float | None = None,
    turn_unit: str = "rad/s",
) -> OdometryLog:
    """Read an odometry log: a table ``t,vx,vy,vz,wx,wy,wz``, or of two wheels ``t,left,right``.

    Missing columns are not measured (NaN), except for motions that wheels cannot make. If there is
    `vx` but neither `vy` nor `vz`, the body only moves forwards: `vy` and `vz` are zero. If there
    is also `wz` but neither `wx` nor `wy`, it stays level: `wx` and `wy` are zero. A row with a
    repeated time is left out.

    Parameters
    ----------
    path, source, said
        The file, the names of its columns, and the object that collects notes. The columns of a
        file without a header are named by numbers from 1: ``{"t": "2", "left": "3"}``.
    wheelbase_m
        Distance between the wheels or tracks with the speeds `left` and `right`, metres; or use the
        column `width`. The turn rate is ``(right - left) / width``.
    turn_unit
        Unit of turn rates in the file, ``"rad/s"`` or ``"deg/s"``; a unit in brackets after the
        name of a column comes first: ``speed [mm/s]``, ``{"wz": "gyro[deg/s]"}``.

    Raises
    ------
    ValueError
        If a cell is not a number or times decrease (the message names file, line and column), a
        column does not exist, or the readings cannot be in these units.
    """
    check_one_of("turn_unit", turn_unit, list(TURN_UNITS))
    said = said or Said()
    table = read_table(path, source._replace(file="odometry"))
    times, note = table.seconds()
    said.note(table.path, note)
    later = np.diff(times, prepend=-np.inf)
    table.check(later >= 0, "t", "time must not decrease from row to row")
    if any(name in table.columns for name in _WHEELS):
        readings, names = _of_wheels(table, wheelbase_m)
    else:
        readings, names = _of_axes(table, turn_unit)
        if wheelbase_m is not None:
            raise ValueError(
                f"{table.path}: wheelbase_m must be left out without the columns left and right"
            )
    said.read(table, ("t", *names))
    if (again := int((later == 0).sum())) > 0:
        said.note(table.path, f"{again} rows that repeat a time are left out")
    most = np.nan_to_num(np.abs(readings)).max(axis=0)
    if most[:3].max() > _MAX_RATE:
        raise ValueError(
            f"{table.path}: turn rates of {most[:3].max():.3g} rad/s are too large (are they in "
            "deg/s? set turn_unit to deg/s; or is wheelbase_m not in metres?)"
        )
    if most[3:].max() > _MAX_SPEED:
        told = {name: f"{table.name(name)}[mm/s]" for name in names if name[0] in "vlr"}
        raise ValueError(
            f"{table.path}: speeds of {most[3:].max():.3g} m/s are too large (are they in mm/s? "
            f'then give --columns "{table.source.given(**told)}")'
        )
    return OdometryLog(times[later > 0], readings[later > 0])


def _of_axes(table: Table, turn_unit: str) -> tuple[FloatArray, tuple[str, ...]]:
    names = tuple(name for name in _COLUMNS if name in table.columns)
    if not names:
        raise ValueError(
            f"{table.path}, line {table.header_line}: must have some of the columns "
            f"{', '.join(_COLUMNS)}, or left and right, got {[*table.names.values()]!r:.200}; "
            "if they have other names, give --columns odometry.vx=NAME,..."
        )
    readings = np.full((len(table.lines), 6), np.nan)
    for name in names:
        k = _COLUMNS.index(name)
        units, usual = (TURN_UNITS, turn_unit) if k < 3 else (SPEEDS, "m/s")
        scale = rate_unit(table, name, units, usual)
        readings[:, k] = scale * table.numbers(name, may_be_missing=True)
    if "vx" in names and not {"vy", "vz"} & {*names}:
        readings[:, 4:] = 0.0
        if "wz" in names and not {"wx", "wy"} & {*names}:
            readings[:, :2] = 0.0
    return readings, names


def _of_wheels(table: Table, wheelbase_m: float | None) -> tuple[FloatArray, tuple[str, ...]]:
    table.require(*_WHEELS)
    left, right = (rate_unit(table, name, SPEEDS, "m/s") * table.numbers(name) for name in _WHEELS)
    names, width = _WHEELS, wheelbase_m
    if width is None:
        if "width" not in table.columns:
            raise ValueError(
                f"{table.path}: speeds of wheels need wheelbase_m, the distance between them, or "
                "a column width"
            )
        names = (*_WHEELS, "width")
        width = METRES[table.unit("width", METRES) or "m"] * table.numbers("width")
        table.check(width > 0, "width", "must be positive")
    else:
        width = check_number("wheelbase_m", width, low=1e-6)
    readings = np.zeros((len(left), 6))
    readings[:, 2], readings[:, 3] = (right - left) / width, 0.5 * (left + right)
    return readings, names


def odometry_between(
    log: OdometryLog, start_s: float, end_s: float, hold_s: float = 0.5
) -> tuple[FloatArray, FloatArray]:
    """Return the readings (S, 6) between two times, and the duration (S,) of each in seconds.

    A reading is valid from half way to the previous one until half way to the next, but no further
    from its own time than half of `hold_s`. Longer gaps, and times outside the log, give rows of
    NaN.

    Parameters
    ----------
    log, start_s, end_s
        The log, and two times on its clock, the second not before the first.
    hold_s
        Longest gap that is bridged.

    Raises
    ------
    ValueError
        If the times are not in order.
    """
    start_s = check_number("start_s", start_s)
    end_s = check_number("end_s", end_s, low=start_s)
    reach = 0.5 * check_number("hold_s", hold_s, low=0.0)
    times = log.times
    first = max(int(np.searchsorted(times, start_s - reach)) - 1, 0)
    last = int(np.searchsorted(times, end_s + reach, side="right")) + 1
    near, values = times[first:last], log.readings[first:last]
    middle = 0.5 * (near[1:] + near[:-1])
    begins = np.maximum(near - reach, np.concatenate([[-np.inf], middle]))
    ends = np.minimum(near + reach, np.concatenate([middle, [np.inf]]))
    edges, rows = [start_s], []
    for begin, end, value in zip(begins, ends, values, strict=True):
        begin, end = max(begin, edges[-1]), min(end, end_s)
        if end <= begin:
            continue
        if begin > edges[-1]:
            edges.append(begin)
            rows.append(np.full(6, np.nan))
        edges.append(end)
        rows.append(value)
    if edges[-1] < end_s or not rows:
        edges.append(end_s)
        rows.append(np.full(6, np.nan))
    return np.array(rows), np.diff(edges)
