"""Read logs of inertial sensors, check their units, and split them at the times of epochs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, check_array, check_number, check_one_of
from rbl_gym.geometry import rotations
from rbl_gym.measurements.inertial import GRAVITY_M_S2
from rbl_gym.recordings.column_units import TURN_UNITS
from rbl_gym.recordings.tables import AnyPath, Source, Table, read_table

__all__ = ["InertialLog", "read_frame", "read_inertial", "samples_between"]

_COLUMNS = ("t", "wx", "wy", "wz", "ax", "ay", "az")
FORCE_UNITS = {"m/s^2": 1.0, "g": GRAVITY_M_S2}
# Upper limit of turn rates, and limits of the median specific force under gravity.
_MAX_RATE, _FORCE = 150.0, (0.3, 4.0)
# Longest time without a reading that is bridged, also outside the log.
_LONGEST_GAP_S = 0.1


class InertialLog(NamedTuple):
    """Readings of an inertial sensor: times (K,), and (K, 6) in rad/s and m/s^2, in sensor axes."""

    times: FloatArray
    readings: FloatArray


def read_inertial(
    path: AnyPath,
    *,
    columns: Mapping[str, str] | None = None,
    turn_unit: str = "rad/s",
    force_unit: str = "m/s^2",
) -> InertialLog:
    """Read the log of an inertial sensor: a table with the columns t, wx, wy, wz, ax, ay, az.

    Parameters
    ----------
    path
        A text file with a header; other columns are ignored.
    columns
        Names used here to names in the file, if they differ: ``{"wx": "gyro_x"}``.
    turn_unit, force_unit
        Units of the columns that do not state theirs, as in ``gyro_x [deg/s]``: ``"rad/s"`` or
        ``"deg/s"``, and ``"m/s^2"`` or ``"g"``.

    Raises
    ------
    ValueError
        If a cell is not a number or times do not increase (the message names file, line and
        column), a column does not exist, or the readings cannot be in these units.
    """
    check_one_of("turn_unit", turn_unit, list(TURN_UNITS))
    check_one_of("force_unit", force_unit, list(FORCE_UNITS))
    for name in columns or {}:
        check_one_of("columns", name, [*_COLUMNS, "time"])
    table = read_table(path, Source(dict(columns or {}), file="imu"))
    table.require(*_COLUMNS)
    times = table.times()
    values = [table.numbers(name) for name in _COLUMNS[1:]]
    scales = [rate_unit(table, name, TURN_UNITS, turn_unit) for name in _COLUMNS[1:4]]
    scales += [rate_unit(table, name, FORCE_UNITS, force_unit) for name in _COLUMNS[4:]]
    readings = np.stack(values, axis=-1) * scales
    fastest = float(np.quantile(np.linalg.norm(readings[:, :3], axis=-1), 0.99))
    if fastest > _MAX_RATE:
        raise ValueError(
            f"{table.path}: angular velocities of {fastest:.3g} rad/s are too large for a log in "
            f"{turn_unit} (are they in deg/s? set turn_unit to deg/s)"
        )
    usual = float(np.median(np.linalg.norm(readings[:, 3:], axis=-1))) / GRAVITY_M_S2
    if not _FORCE[0] < usual < _FORCE[1]:
        raise ValueError(
            f"{table.path}: the median specific force is {usual:.3g} g, which does not fit a log "
            f"in {force_unit} (is it "
            f"{'in g, or was gravity removed' if usual < 1 else 'in m/s^2'}?)"
        )
    return InertialLog(times, readings)


def rate_unit(table: Table, column: str, units: Mapping[str, float], usual: str) -> float:
    """Return the scale of a column by the unit in brackets after its name, else by `usual`."""
    told = table.units.get(column, "")
    # speed_ms and gyro_s are not milliseconds and seconds.
    plain = table.name(column).endswith(f"_{told}")
    return units[usual if plain else table.unit(column, units) or usual]


def read_frame(told: AnyPath) -> FloatArray:
    """Return the rotation (3, 3) from the axes of a sensor to those of the body.

    Parameters
    ----------
    told
        A rotation vector in degrees, ``"179.0,0.2,13.6"``; or a file with one row, of
        ``qw,qx,qy,qz``.

    Raises
    ------
    ValueError
        If `told` is anything else.
    """
    try:
        vector = [float(part) for part in os.fspath(told).split(",")]
    except ValueError:
        vector = []
    if len(vector) == 3:
        return rotations.exp(np.deg2rad(check_array("frame", vector, (3,))))
    table = read_table(told)
    table.require("qw", "qx", "qy", "qz")
    q = np.stack([table.numbers(name) for name in ("qw", "qx", "qy", "qz")], axis=-1)
    if len(q) != 1 or abs(np.linalg.norm(q) - 1) > 1e-2:
        raise ValueError(f"{table.path}: must have one row, a quaternion of norm 1, got {q!r:.80}")
    return rotations.from_quaternion(q[0])


def samples_between(
    log: InertialLog, start_s: float, end_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return the readings (S, 6) between two times, and the duration (S,) of each in seconds.

    A reading is valid from half way to the previous one until half way to the next.

    Parameters
    ----------
    log, start_s, end_s
        The log, and two times on its clock, the second not before the first.

    Raises
    ------
    ValueError
        If the times are not in order, or there is no reading for more than 0.1 s between them.
    """
    start_s = check_number("start_s", start_s)
    end_s = check_number("end_s", end_s, low=start_s)
    times = log.times
    middle = 0.5 * (times[1:] + times[:-1])
    first, last = np.searchsorted(middle, [start_s, end_s])
    edges = np.concatenate([[start_s], middle[first:last], [end_s]])
    # The readings within the interval, and one on each side.
    near = times[max(np.searchsorted(times, start_s, side="right") - 1, 0) :]
    near = near[: np.searchsorted(near, end_s) + 1]
    gap = max(float(np.diff(near).max(initial=0.0)), times[0] - start_s, end_s - times[-1])
    if gap > _LONGEST_GAP_S:
        raise ValueError(
            f"log must have readings from {start_s:g} to {end_s:g} s without gaps longer than "
            f"{_LONGEST_GAP_S:g} s, got a gap of {gap:.3g} s"
        )
    return log.readings[first : last + 1], np.diff(edges)
