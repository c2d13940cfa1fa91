"""Convert message values to tables; invalid measurements are dropped and counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.recordings.bag_fields import text

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_UNKNOWN_M = 99999.0  # what drivers write for an unknown position
_STANDS_M = 0.01  # an anchor that moves less is fixed
_VECTORS = {"orientation": "wxyz"}  # all others are x, y, z

Row = tuple[int, dict[str, Any]]  # time in ns, values by key


class Sheet(NamedTuple):
    """A file to write: its header and rows of text."""

    header: tuple[str, ...]
    rows: list[tuple[Any, ...]]


class Tables(NamedTuple):
    """The files of one kind of measurement, and the notes on it."""

    sheets: dict[str, Sheet]  # by the name of the file
    times_ns: np.ndarray  # (rows,) of the kept measurements
    dropped: Counter[str]
    notes: list[str]
    facts: dict[str, Any]


def make_tables(
    kind: str, rows: Sequence[Row], table: dict[str, Any], given: Container[str] = ()
) -> Tables:
    """Return the files of one kind from its message values; `given`: keys named by the user.

    ValueError if a value has the wrong form, or a tag has several positions on the body.
    """
    notes: list[str] = []
    times = np.array([time for time, _ in rows], dtype=np.int64)
    if back := int((np.diff(times) < 0).sum()):
        notes.append(f"{kind}: {back} stamps were out of order, the messages were sorted")
    rows = [rows[i] for i in np.argsort(times, kind="stable")]
    if kind == "ranges":
        made = _ranges(rows, table)
    else:
        made = _motion(kind, rows, table, keep_constant="orientation" in given)
    return made._replace(notes=notes + made.notes)


def _ranges(rows: Sequence[Row], table: dict[str, Any]) -> Tables:
    unit = table.get("unit", "m")
    if unit not in UNITS:
        raise ValueError(f"[ranges] unit must be one of {', '.join(UNITS)}, got {unit!r}")
    dropped: Counter[str] = Counter()
    body = {str(tag) for tag in table.get("tags", ())}
    kept: dict[tuple[int, str, str], dict[str, Any]] = {}
    for time, values in rows:
        link, values, why = _link(values, body)
        distance = _number("range", values["range"]) * UNITS[unit]
        why = why or _no_range(values, distance)
        if not why and (time, *link) in kept:
            why = "the same link twice at one time"
        if why:
            dropped[why] += 1
        else:
            kept[(time, *link)] = {**values, "range": distance}
    notes: list[str] = []
    std = _deviations(kept.values(), UNITS[unit], notes)
    header = ("t", "anchor", "tag", "range") + (("std",) if std else ())
    lines = [
        (seconds(time), anchor, tag, values["range"], *((std[i],) if std else ()))
        for i, ((time, anchor, tag), values) in enumerate(kept.items())
    ]
    sheets = {"ranges.csv": Sheet(header, lines)}
    anchors = sorted({anchor for _, anchor, _ in kept}, key=_natural)
    tags = sorted({tag for _, _, tag in kept}, key=_natural)
    if both := [name for name in anchors if name in tags]:
        notes.append(
            f"ranges: {', '.join(both)} are used both as anchors and as tags: name the tags of "
            "the body, --ranges tags=ID,ID"
        )
    if "anchor_position" in table:
        sheets |= _anchor_sheet(kept, anchors, notes)
    if "tag_position" in table:
        sheets |= _tag_sheet(kept, tags, notes)
    facts = {
        "anchors": {name: sum(anchor == name for _, anchor, _ in kept) for name in anchors},
        "tags": {name: sum(tag == name for _, _, tag in kept) for name in tags},
    }
    times = np.array([time for time, _, _ in kept], dtype=np.int64)
    return Tables(sheets, times, dropped, notes, facts)


def _link(
    values: dict[str, Any], body: set[str]
) -> tuple[tuple[str, str], dict[str, Any], str | None]:
    """Return anchor and tag, swapped if the tag of the body is given as the anchor."""
    anchor, tag = text(values["anchor"]), text(values["tag"])
    if body:
        if anchor in body and tag in body:
            return (anchor, tag), values, "between two tags of the body"
        if anchor in body:
            places = values.get("tag_position"), values.get("anchor_position")
            values = {**values, "anchor_position": places[0], "tag_position": places[1]}
            anchor, tag = tag, anchor
        if tag not in body:
            return (anchor, tag), values, "not a tag of the body"
    return (anchor, tag), values, None if anchor and tag else "no id"


def _no_range(values: dict[str, Any], distance: float) -> str | None:
    if not np.isfinite(distance):
        return "not a finite number"
    if distance <= 0:
        return "zero or negative"
    if "most" in values or "least" in values:
        raw = _number("range", values["range"])
        least = _number("least", values.get("least", 0.0))
        most = _number("most", values.get("most", np.inf))
        # Drivers without known limits leave both at zero.
        if most > least and not least <= raw <= most:
            return "outside the sensor's limits"
    return None


def _deviations(
    values: Iterable[dict[str, Any]], scale: float, notes: list[str]
) -> list[float] | None:
    std = [_number("std", row["std"]) * scale for row in values if "std" in row]
    if std and not (np.isfinite(std).all() and min(std) > 0):
        bad = int((~(np.isfinite(std) & (np.array(std) > 0))).sum())
        notes.append(f"ranges: no std column, {bad} of {len(std)} values are not positive")
        return None
    return std or None


def _places(
    kept: dict[tuple[int, str, str], dict[str, Any]], key: str, end: int
) -> dict[str, list[tuple[int, FloatArray]]]:
    """Return times and positions by id, for known positions."""
    found: dict[str, list[tuple[int, FloatArray]]] = {}
    for (time, *ends), values in kept.items():
        if values.get(key) is None:
            continue
        place = vector(key, values[key])
        if np.isfinite(place).all() and (np.abs(place) < _UNKNOWN_M).all():
            found.setdefault(ends[end], []).append((time, place))
    return found


def _spread(places: list[tuple[int, FloatArray]]) -> float:
    return float(np.ptp([place for _, place in places], axis=0).max())


def _anchor_sheet(
    kept: dict[tuple[int, str, str], dict[str, Any]], anchors: list[str], notes: list[str]
) -> dict[str, Sheet]:
    found = _places(kept, "anchor_position", 0)
    if missing := [name for name in anchors if name not in found]:
        notes.append(f"anchors: the messages give no position of {', '.join(missing)}")
    if not found:
        return {}
    order = [name for name in anchors if name in found]
    if max(map(_spread, found.values())) <= _STANDS_M:
        rows = [(name, *np.median([p for _, p in found[name]], axis=0).tolist()) for name in order]
        return {"anchors.csv": Sheet(("anchor", "x", "y", "z"), rows)}
    notes.append("anchors: they move, so anchors.csv has a column t")
    moving = {(time, name): place for name in order for time, place in found[name]}
    rows = [
        (seconds(time), name, *moving[time, name].tolist())
        for time, name in sorted(moving, key=lambda key: key[0])
    ]
    return {"anchors.csv": Sheet(("t", "anchor", "x", "y", "z"), rows)}


def _tag_sheet(
    kept: dict[tuple[int, str, str], dict[str, Any]], tags: list[str], notes: list[str]
) -> dict[str, Sheet]:
    found = _places(kept, "tag_position", 1)
    for name, places in found.items():
        if (spread := _spread(places)) > _STANDS_M:
            raise ValueError(
                f"[ranges] tag {name!r} has several positions on the body, {spread:.3g} m apart: "
                "the path `tag` must distinguish its antennas, as in "
                "tag={requester_id}.{antenna}"
            )
    middles = {name: np.median([p for _, p in found[name]], axis=0) for name in found}
    if not found or not any(place.any() for place in middles.values()):
        notes.append("tags: the messages do not give the positions of the tags on the body")
        return {}
    if missing := [name for name in tags if name not in found]:
        notes.append(f"tags: the messages give no position of {', '.join(missing)}")
    rows = [(name, *middles[name].tolist()) for name in tags if name in found]
    return {"tags.csv": Sheet(("tag", "x", "y", "z"), rows)}


_MOTION = {
    "truth": (("position", "x y z"), ("orientation", "qw qx qy qz")),
    "imu": (("angular_velocity", "wx wy wz"), ("linear_acceleration", "ax ay az")),
    "odometry": (("velocity", "vx vy vz"), ("angular_velocity", "wx wy wz")),
}


def _motion(kind: str, rows: Sequence[Row], table: dict[str, Any], keep_constant: bool) -> Tables:
    """Return truth, inertial readings or odometry: one row per time, all numbers."""
    columns = [(key, names.split()) for key, names in _MOTION[kind] if table.get(key)]
    times = np.array([time for time, _ in rows], dtype=np.int64)
    blocks = {
        key: np.array([vector(key, values[key]) for _, values in rows]).reshape(-1, len(names))
        for key, names in columns
    }
    dropped: Counter[str] = Counter()
    notes: list[str] = []
    keep = np.ones(len(times), dtype=bool)
    _drop(keep, ~_all_finite(blocks.values()), "not a finite number", dropped)
    _drop(keep, np.diff(times, prepend=-1) == 0, "two at one time", dropped)
    quaternions = blocks.get("orientation")
    if quaternions is not None and keep.any():
        given = quaternions[keep]
        norm = np.linalg.norm(quaternions, axis=1)
        if not keep_constant and len(given) > 1 and (given == given[0]).all():
            notes.append(
                f"{kind}: the orientation never changes, so only positions were written; --truth "
                "orientation=PATH writes it too"
            )
            columns = columns[:1]
        else:
            _drop(keep, np.abs(norm - 1) > 0.01, "not a unit quaternion", dropped)
    header = ("t", *(name for _, names in columns for name in names))
    body = np.concatenate([blocks[key][keep] for key, _ in columns], axis=1)
    lines = [(seconds(time), *line) for time, line in zip(times[keep], body.tolist(), strict=True)]
    return Tables({f"{kind}.csv": Sheet(header, lines)}, times[keep], dropped, notes, {})


def _all_finite(blocks: Iterable[FloatArray]) -> BoolArray:
    return np.logical_and.reduce([np.isfinite(block).all(axis=1) for block in blocks])


def _drop(keep: BoolArray, bad: BoolArray, why: str, dropped: Counter[str]) -> None:
    if count := int((keep & bad).sum()):
        dropped[why] += count
    keep &= ~bad


def vector(key: str, value: Any) -> FloatArray:
    """Return the three numbers of a vector, or w, x, y, z of a quaternion."""
    names = _VECTORS.get(key, "xyz")
    if all(hasattr(value, name) for name in names):
        numbers = [getattr(value, name) for name in names]
    elif hasattr(value, "__len__") and len(value) == len(names) and not isinstance(value, str):
        numbers = list(value)
    else:
        raise ValueError(f"{key} must be {', '.join(names)}, got {value!r:.60}")
    return np.array([_number(key, number) for number in numbers])


def _number(key: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{key} must be a number, got {value!r:.60}") from None


def seconds(time_ns: int) -> str:
    """Return a time with all its digits."""
    return f"{time_ns // 10**9}.{time_ns % 10**9:09d}"


def _natural(name: str) -> tuple[int, float, str]:
    """Sort key: ids that are numbers come first, in numeric order."""
    try:
        return 0, float(name), name
    except ValueError:
        return 1, 0.0, name
