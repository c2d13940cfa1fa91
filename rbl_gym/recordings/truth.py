"""Read reference poses from a file, and interpolate them."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import motion
from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number
from rbl_gym.geometry import rotations
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.stamps import WORDS, dated_unit, unit_by_length
from rbl_gym.recordings.tables import AS_NAMED, AnyPath, Source, Table, read_table

__all__ = ["Truth", "read_truth", "truth_at"]

MAX_YAW_DEG = 1e6

# The columns of a file without a header.
_TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_QUATERNION = ("qw", "qx", "qy", "qz")
_ANGLES = ("roll", "pitch", "yaw")
# Words in column names that do not belong to a pose.
_NO_POSE = {"covariance", "cov", "std", "twist", "velocity", "vel", "linear", "angular", "acc",
            "acceleration", "gyro", "bias"}  # fmt: skip


class Truth(NamedTuple):
    """Reference poses of the body, ``p_world = rotation @ p_body + translation``."""

    times: FloatArray  # (L,) seconds, strictly increasing
    rotation: FloatArray | None  # (L, 3, 3); None: only positions
    translation: FloatArray  # (L, 3) metres
    planar: bool = False  # height, roll and pitch are unknown and set to 0
    form: str = "poses"  # format of the file, in words


def truth_at(
    truth: Truth, times: ArrayLike, max_gap_s: float = 0.5
) -> tuple[FloatArray | None, FloatArray, BoolArray]:
    """Interpolate the truth: linearly in position, along the geodesic in rotation.

    Parameters
    ----------
    truth, times
        Reference poses; the requested times, (..., K) seconds.
    max_gap_s
        Longest gap between two reference poses that is interpolated, seconds.

    Returns
    -------
    rotation, translation
        (..., K, 3, 3) and (..., K, 3) metres; finite but meaningless if not `valid`. The
        rotation is None if the truth has none.
    valid
        (..., K) False outside the time span of the truth and in gaps longer than `max_gap_s`.

    Raises
    ------
    ValueError
        If `times` is empty or not finite, or `max_gap_s` is negative.
    """
    times = check_array("times", times, ("K",))
    max_gap_s = check_number("max_gap_s", max_gap_s, low=0.0)
    last = len(truth.times) - 1
    left = np.clip(np.searchsorted(truth.times, times, side="right") - 1, 0, last)
    right = np.minimum(left + 1, last)
    elapsed, gap = times - truth.times[left], truth.times[right] - truth.times[left]
    inside = (times >= truth.times[0]) & (times <= truth.times[-1])
    valid = inside & ((gap <= max_gap_s) | (elapsed == 0))
    if truth.rotation is None:
        columns = [np.interp(times, truth.times, column) for column in truth.translation.T]
        return None, np.stack(columns, axis=-1), valid
    path = motion.interpolate(truth.times, truth.rotation, truth.translation, times)
    return path.rotation, path.translation, valid


def read_truth(
    path: AnyPath,
    source: Source = AS_NAMED,
    said: Said | None = None,
    *,
    run: str | None = None,
    times: FloatArray | None = None,
) -> Truth:
    """Read the reference poses of a file.

    The known formats are TUM (``t x y z qx qy qz qw`` separated by blanks, no header), EuRoC/ASL (a
    header that begins with ``#``, nanoseconds, qw first), and tables with a header:
    ``t,x,y,z,qw,qx,qy,qz``; ``t,x,y,z,roll_deg,pitch_deg,yaw_deg``, rotated about z, y and x in
    this order; ``t,x,y[,z]`` with or without ``yaw_deg``. Angles may be ``_rad``. Columns of
    messages are identified by their last word, as in ``pose.position.x``. The norm of quaternions
    may differ from 1 by 0.01; they are normalised.

    Parameters
    ----------
    path, source, said
        The file, the names of its columns, and the object that collects notes.
    run
        The run to read, if the file has a column `run`.
    times
        Times (K,) for a file with one pose and no times: the body is at rest in this pose.

    Returns
    -------
    Truth
        Without rotation if the file has only positions; `planar` if it has no heights.

    Raises
    ------
    ValueError
        If the file has another format. The message names file, line and column.
    """
    said = said or Said()
    table = _known_names(read_table(path, source, _TUM))
    if run is not None and "run" in table.columns:
        rows = np.array([cell == run for cell in table.text("run")])
        if not rows.any():
            raise ValueError(f"{table.path}: has no run {run!r} in column {table.name('run')!r}")
        table = table.select(rows)
    once = times is not None and len(table.lines) == 1  # one pose for all times
    table.require(*(() if once else ("t",)), "x", "y")
    places = [axis for axis in "xyz" if axis in table.columns]
    rotation, angles = _rotations(table)
    planar = len(places) == 2
    translation = np.pad(table.points(places), ((0, 0), (0, 3 - len(places))))
    said.read(table, ("t", "run", *places, *angles))
    if rotation is None:
        said.note(table.path, _heading_hint(table))
    form = _form(table, len(angles), planar)
    if "t" not in table.columns and times is not None and once:
        shape = len(times), 3
        held = None if rotation is None else np.broadcast_to(rotation, (*shape, 3))
        return Truth(times, held, np.broadcast_to(translation, shape), planar, form)
    unit = table.units.get("t")
    if unit is None and table.is_numeric("t"):
        # Poses may be rare, so their spacing does not distinguish seconds from milliseconds.
        values = table.numbers("t")
        unit = dated_unit(values)
        if unit is None and (unit := unit_by_length(values, times)) != "s":
            told = table.source.given(t=f"{table.name('t')}[s]")
            said.note(
                table.path,
                f"times are read as {WORDS[unit]}, as they then span about as long as the ranges; "
                f"if they are seconds, set --columns {told}",
            )
    stamps, _ = table.seconds(unit)
    table.check(np.diff(stamps, prepend=-np.inf) > 0, "t", "time must increase from row to row")
    return Truth(stamps, rotation, translation, planar, form)


def _rotations(table: Table) -> tuple[FloatArray | None, tuple[str, ...]]:
    """Return rotations (L, 3, 3) and their columns; None: only positions."""
    found = [name for name in _QUATERNION if name in table.columns]
    if found:
        table.require(*_QUATERNION)
        q = np.stack([table.numbers(name) for name in _QUATERNION], axis=-1)
        with np.errstate(over="ignore"):
            norm = np.linalg.norm(q, axis=-1)
        must = "quaternion norm must be 1 within 0.01"
        table.check(np.abs(norm - 1) <= 1e-2, "qw", must, got=norm)
        return rotations.from_quaternion(q), _QUATERNION
    columns = {}
    for axis, angle in enumerate(_ANGLES):
        names = [name for name in (f"{angle}_deg", f"{angle}_rad") if name in table.columns]
        if len(names) == 1:
            columns[axis] = names[0]
        elif names:
            raise ValueError(
                f"{table.path}, line {table.header_line}: must have one of the columns "
                f"{angle}_deg and {angle}_rad, got {[*table.names.values()]!r:.200}"
            )
        elif angle in table.columns:
            text = (
                f"{table.path}, line {table.header_line}: column {table.name(angle)!r} must state "
                f"its unit: rename it {angle}_deg or {angle}_rad"
            )
            if table.source.file:
                given = (table.source.given(**{f"{angle}_{unit}": table.name(angle)})
                         for unit in ("rad", "deg"))  # fmt: skip
                text += f", or state it by {' or '.join(f'--columns {told}' for told in given)}"
            raise ValueError(text)
    if not columns:
        return None, ()
    if len(columns) == 2 or 2 not in columns:
        table.require(*(f"{angle}_deg" for axis, angle in enumerate(_ANGLES)
                        if axis not in columns))  # fmt: skip
    rotation = np.eye(3)
    for axis in (2, 1, 0):  # about z, then about the new y, then about the new x
        if (name := columns.get(axis)) is None:
            continue
        turn, unit = table.numbers(name), np.pi / 180 if name.endswith("_deg") else 1.0
        must = f"must be at most {MAX_YAW_DEG:g} deg in magnitude"
        table.check(np.abs(turn) * unit <= np.radians(MAX_YAW_DEG), name, must)
        rotation = rotation @ rotations.exp(unit * turn[:, None] * np.eye(3)[axis])
    return rotation, tuple(columns.values())


def _heading_hint(table: Table) -> str:
    """Return words if a column that is not read may be the yaw; "" if there is none."""
    for name in table.names.values():
        words = re.findall("[a-z]+", name.lower())
        unit = words.pop() if words[-1:] in (["deg"], ["rad"]) else ""
        if words[-1:] not in (["heading"], ["theta"], ["azimuth"]):
            continue
        units = [unit] if unit else ["deg", "rad"]
        told = (f"--columns truth.yaw_{each}={name}" for each in units)
        return (
            f"column {name!r} is not read; if it is the yaw, counted from x towards y, give "
            f"{' or '.join(told)}"
        )
    return ""


def _form(table: Table, angles: int, planar: bool) -> str:
    """Return the format of the file, in words."""
    names = [*table.names.values()]
    known = "TUM" if [*table.columns] == [*_TUM] else "table"
    if any(name.lower().startswith(("p_rs", "q_rs")) for name in names):
        known = "EuRoC/ASL"
    what = {0: "positions", 1: "headings"}.get(angles, "poses")
    return f"{known}, {what}" + (" in x and y" if planar else "")


def _known_names(table: Table) -> Table:
    """Return the table with column names replaced by the known ones, if the match is unique."""
    like: dict[str, list[str]] = {}
    for name in table.columns:
        role = _role(name, table.units.get(name, ""))
        if role is not None and role not in table.columns:
            like.setdefault(role, []).append(name)
    new = {names[0]: role for role, names in like.items() if len(names) == 1}
    return table._replace(
        columns=table.columns.renamed(new),
        names={new.get(role, role): name for role, name in table.names.items()},
        units={new.get(role, role): unit for role, unit in table.units.items()},
    )


def _role(name: str, unit: str) -> str | None:
    """Return the content of a column of this name, if it is known: ``q_RS_w []`` is qw."""
    words = re.findall(r"[a-z0-9]+", re.sub(r"[\[(].*?[\])]", "", name.lower()))
    if words[-1:] in (["m"], ["deg"], ["rad"]):
        unit = words.pop()
    if not words:
        return None
    first, last, before = words[0], words[-1], set(words[:-1])
    if last in _ANGLES:
        return f"{last}_{unit}" if unit in ("deg", "rad") else None
    if len(words) == 1:
        if last in ("t", "time", "timestamp", "stamp"):
            return "t"
        one = re.fullmatch("(q[xyzw])|[pt]([xyz])", last)
        return None if one is None else one[1] or one[2]
    if before & _NO_POSE or first in ("v", "b", "a", "w"):
        return None
    one = re.fullmatch("q?([xyzw])", last)
    if one is None:
        return None
    if before & {"q", "quat", "quaternion", "orientation", "rotation", "rot"}:
        return f"q{one[1]}"
    if before & {"p", "pos", "position", "translation", "t", "place"} and last in "xyz":
        return last
    return None
