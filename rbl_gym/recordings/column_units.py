"""Units of columns: in brackets after a name, in a header or in ``--columns``."""

from __future__ import annotations

import math
import re

from rbl_gym.recordings.stamps import TIME_UNITS

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
SPEEDS = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3}
TURN_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180}
_FORCES = ("m/s^2", "g")
_NAMED = "|s|ms|[u\u00b5\u03bc]s|ns|m|cm|mm|deg|rad"
_AT_END = "|_(s|ms|us|ns|m|cm|mm)$"
UNIT = re.compile(rf"\s*[\[(]({_NAMED})[\])]$" + _AT_END)
# In files of motion. Elsewhere ``x [m/s]`` is the name of a column that is not a position.
_OR_RATE = re.compile(
    rf"\s*[\[(]({_NAMED}|[cm]?m/s|(?:deg|rad)/s|m/s(?:\^?2|\u00b2)|g)[\])]$" + _AT_END
)
_OF_MOTION = ("odometry", "imu")


def name_and_unit(cell: str, file: str = "") -> tuple[str, str]:
    """Split a name and its unit: ``time [ms]`` is ``time`` in ms; ``time_ms`` keeps its name.

    `file` is the kind of the file; odometry and inertial sensors also have units of rates.
    """
    cell = cell.strip()
    unit = (_OR_RATE if file in _OF_MOTION else UNIT).search(cell)
    if unit is None:
        return cell, ""
    if unit[2]:
        return cell, unit[2]
    told = re.sub("[\u00b5\u03bc]", "u", unit[1])
    return cell[: unit.start()], re.sub("/s(2|\u00b2)$", "/s^2", told)


def check_unit(where: str, file: str, content: str, name: str, unit: str) -> None:
    """Raise ValueError if the column of this content has no such unit: it would be ignored."""
    known = _units_of(file, content.rpartition(".")[2])
    if unit not in known:
        must = f"must be one of {', '.join(known)}" if known else "cannot be given"
        raise ValueError(f"{where}, column {name!r}: the unit of {content} {must}, got {unit!r}")


def _units_of(file: str, content: str) -> tuple[str, ...]:
    if content in ("t", "time"):
        return tuple(TIME_UNITS)
    if file in _OF_MOTION:
        if content in ("wx", "wy", "wz"):
            return tuple(TURN_UNITS)
        if file == "imu":
            return _FORCES
        return tuple(METRES if content == "width" else SPEEDS)
    if found := re.fullmatch("(?:roll|pitch|yaw)(?:_(deg|rad))?", content):
        return (found[1],) if found[1] else ("deg", "rad")
    lengths = ("range", "distance", "difference", "std", "var", *"xyz", "ax", "ay", "az")
    return tuple(METRES) if content in lengths else ()
