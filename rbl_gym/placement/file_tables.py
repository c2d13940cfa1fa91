"""Values of the tables of a placement file, checked with `file_keys.FORMAT`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray, check_array, check_number, did_you_mean
from rbl_gym.geometry.polygons import check_line, check_polygon
from rbl_gym.placement.file_keys import FORMAT, MOST_M, Form, Key

# Boxes may be as large as orbits; polygons may not.
_FARTHEST_M = 1e9
# Limit of the number of points in a list.
_MOST_POINTS = 10_000
# What to say of keys that are asked for, but do not exist.
_NO_KEYS = {"known_height_m": "; place always estimates the height, also if low_m = high_m"}


def read_table(name: str, table: Any, kind: str | None = None) -> dict[str, Any]:
    """Return the checked values of one table, with defaults; a ValueError names what is wrong.

    `name` is for errors, such as ``"walls[3]"``; `kind` its name in `FORMAT`, None: the same.
    """
    table = as_table(table, name)
    keys = _form(name, table, FORMAT[kind or name].forms).keys
    check_keys(table, name, keys)
    values = {}
    for key, what in keys.items():
        value = table.get(key, what.default)
        absent = value is None and key not in table
        values[key] = None if absent else _checked(f"{name}.{key}", value, what)
    _check_heights(name, values)
    return values


def _form(name: str, table: Mapping[str, Any], forms: tuple[Form, ...]) -> Form:
    """Return the form of a table."""
    marked = [form for form in forms if form.value and form.mark in form.keys]
    if marked and marked[0].mark in table:
        mark, given = marked[0].mark, table[marked[0].mark]
        choices = [form.value for form in marked]
        if given not in choices:
            raise ValueError(
                f"{name}.{mark} must be one of {', '.join(map(repr, choices))}, got {given!r:.80}"
            )
        return marked[choices.index(given)]
    for form in forms:
        if not form.value and (not form.mark or form.mark in table):
            return form
    if not marked[0].keys[marked[0].mark].needed:
        return marked[0]
    raise ValueError(f"{name} must have the key {marked[0].mark!r}")


def as_table(value: Any, name: str) -> dict[str, Any]:
    """Return a table of keys; raises ValueError for anything else."""
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        raise ValueError(
            f"{name} must be one table [{name}], as a file has one {name}; got {len(value)} "
            f"[[{name}]]"
        )
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a table of keys, got {value!r:.80}")
    return dict(value)


def check_keys(table: Mapping[str, Any], name: str, keys: Mapping[str, Key]) -> None:
    """Check that there are only these keys, and all required ones."""
    for key in table:
        if key not in keys:
            raise ValueError(
                f"{name} has an unknown key {key!r:.80}; it may have {', '.join(keys)}"
                f"{_NO_KEYS.get(key) or did_you_mean(key, keys)}"
            )
    for key, what in keys.items():
        if what.needed and key not in table:
            raise ValueError(f"{name} must have the key {key!r}")


def _checked(name: str, value: Any, key: Key) -> Any:
    """Return the checked value."""
    if key.kind == "number":
        return check_number(name, value, low=key.low, high=key.high)
    if key.kind == "flag":
        if not isinstance(value, bool):
            raise ValueError(f"{name} must be true or false, got {value!r:.80}")
        return value
    if key.kind == "text":
        return check_text(name, value)
    if key.kind == "choice" and key.choices and value not in key.choices:
        choices = ", ".join(map(repr, key.choices))
        raise ValueError(f"{name} must be one of {choices}, got {value!r:.80}")
    if isinstance(value, list) and len(value) > _MOST_POINTS:
        raise ValueError(f"{name} must have at most {_MOST_POINTS} points, got {len(value)}")
    if key.kind in ("spot", "place"):
        return _vector(name, value, 2 if key.kind == "spot" else 3, key.high)
    if key.kind == "places":
        return _places(name, value)
    if key.kind in ("line", "polygon"):
        points = check_polygon(name, value) if key.kind == "polygon" else check_line(name, value)
        return _within(name, points)
    return value


def check_text(name: str, value: Any) -> str:
    """Return a text if it is printable; raises ValueError otherwise."""
    if not isinstance(value, str) or not value or not value.isprintable():
        raise ValueError(f"{name} must be a printable text, got {value!r:.80}")
    return value


def _vector(name: str, value: Any, size: int, most: float) -> tuple[float, ...]:
    array = check_array(name, value, (size,))
    far = np.abs(array).max()
    # A larger limit of its own is in the units of a drawing.
    if most < math.inf and far > most:
        raise ValueError(f"{name} must have numbers of at most {most:g}, got {far:g}")
    if most == math.inf and far > _FARTHEST_M:
        raise ValueError(f"{name} must lie within {_FARTHEST_M:g} m of the origin, got {far:g} m")
    if array.ndim != 1:
        numbers = {2: "two", 3: "three"}[size]
        raise ValueError(f"{name} must be {numbers} numbers, got shape {array.shape}")
    return tuple(array.tolist())


def _places(name: str, value: Any) -> FloatArray:
    if isinstance(value, list) and not value:
        return np.empty((0, 3))
    array = check_array(name, value, ("N", 3))
    if array.ndim != 2:
        raise ValueError(f"{name} must be a list of [x, y, z], got shape {array.shape}")
    return _within(name, array)


def _within(name: str, points: FloatArray) -> FloatArray:
    far = np.abs(points).max()
    if far > MOST_M:
        raise ValueError(f"{name} must lie within {MOST_M:g} m of the origin, got {far:g} m")
    return points


def _check_heights(name: str, values: Mapping[str, Any]) -> None:
    low, high = values.get("low_m"), values.get("high_m")
    if low is not None and high is not None and high < low:
        raise ValueError(f"{name}: low_m must lie below high_m, got {low:g} and {high:g}")
