"""Read values from a message by field paths.

``header.stamp.sec`` and ``covariance[0]`` name one value of a message, ``nodes[].distance`` one
for each item of a list. ``{requester_id}.{antenna}`` is text composed of fields. ``=tag0``
is the text ``tag0`` in every message, ``@topic`` the topic, ``@index`` the position in the list,
``@bag`` the time of recording in ns.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

_NAME = re.compile(r"[A-Za-z_]\w*(\[\d*\])?")


class Received(NamedTuple):
    """A message, its topic and its time of recording."""

    message: Any
    topic: str
    time_ns: int


Getter = Callable[[Received], Any]


class EachItem(list[Any]):
    """The values of a path with ``[]``: one for each item of a list in the message."""


def getter(path: str) -> Getter:
    """Return a function that reads the value at `path` from a message.

    ValueError if `path` is not a valid path. The returned function raises a KeyError that names the
    missing field and those that exist.
    """
    if path.startswith("="):
        return lambda _: path[1:]
    if path.startswith("@"):
        return _special(path)
    if "{" in path:
        return _template(path)
    parts = path.split(".")
    if not all(_NAME.fullmatch(part) for part in parts) or path.count("[]") > 1:
        raise ValueError(
            f"{path!r} is not a field path. A path is names joined by dots, with [3] for an item "
            "of a list and [] at most once for all items; or =TEXT for a constant; or @topic, "
            "@index or @bag"
        )
    return lambda received: _walk(received.message, parts)


def rows(received: Received, getters: Iterable[Getter]) -> list[tuple[Any, ...]]:
    """Return the values of a message: one tuple per item if a path has ``[]``, else one tuple.

    ValueError if two lists of the message have different lengths.
    """
    values = [get(received) for get in getters]
    lengths = {len(value) for value in values if isinstance(value, EachItem)}
    if not lengths:
        return [tuple(0 if value is _INDEX else value for value in values)]
    if len(lengths) > 1:
        raise ValueError(
            f"lists in one message must have the same length, got {sorted(lengths)} items"
        )
    count = lengths.pop()
    columns = (
        value
        if isinstance(value, EachItem)
        else range(count)
        if value is _INDEX
        else [value] * count
        for value in values
    )
    return [*zip(*columns, strict=True)]


_INDEX = object()


def _special(path: str) -> Getter:
    known: dict[str, Getter] = {
        "@topic": lambda received: received.topic,
        "@bag": lambda received: received.time_ns,
        "@index": lambda _: _INDEX,
    }
    if path not in known:
        raise ValueError(f"{path!r} must be one of {', '.join(known)}")
    return known[path]


def _template(path: str) -> Getter:
    inner = [getter(name) for name in re.findall(r"{(.*?)}", path)]
    if "{@index}" in path:
        raise ValueError(f"{path!r}: @index must be the whole path")
    form = re.sub(r"{.*?}", "{}", path)

    def fill(received: Received) -> Any:
        filled = [form.format(*map(text, row)) for row in rows(received, inner)]
        has_list = any(isinstance(get(received), EachItem) for get in inner)
        return EachItem(filled) if has_list else filled[0]

    return fill


def _walk(value: Any, parts: list[str]) -> Any:
    for i, part in enumerate(parts):
        name, _, index = part.partition("[")
        if not hasattr(value, name):
            there = getattr(value, "__dataclass_fields__", None)
            raise KeyError(
                f"no field {'.'.join(parts[: i + 1])!r}, "
                + (
                    f"the fields are {', '.join(names(there))}"
                    if there
                    else f"there is {value!r:.60}"
                )
            )
        value = getattr(value, name)
        if index == "]":
            return EachItem(_walk(item, parts[i + 1 :]) for item in value)
        if index:
            item = int(index[:-1])
            if item >= len(value):
                raise KeyError(
                    f"no item {'.'.join(parts[: i + 1])!r}, the list has {len(value)} items"
                )
            value = value[item]
    return value


def names(fields: Iterable[str]) -> list[str]:
    """Return the field names of a message type, without those that the reader adds."""
    return [name for name in fields if not name.startswith("__")]


def describe(value: Any, path: str = "") -> list[tuple[str, str]]:
    """Return all field paths of a message with their values, as text."""
    fields = getattr(value, "__dataclass_fields__", None)
    if fields is not None:
        prefix = f"{path}." if path else ""
        return [
            line for name in names(fields) for line in describe(getattr(value, name), prefix + name)
        ]
    if hasattr(value, "__len__") and not isinstance(value, str):
        if len(value) and hasattr(value[0], "__dataclass_fields__"):
            return describe(value[0], f"{path}[]")
        first = " ".join(map(str, value[:4])) + (" ..." if len(value) > 4 else "")
        return [(f"{path}[]", f"{len(value)} items: {first}")]
    return [(path, str(value))]


def text(value: Any) -> str:
    """Return an id as text: numbers unchanged, bytes (a MAC address) in hex."""
    if isinstance(value, str):
        return value.strip().strip("\0")
    if hasattr(value, "__len__"):
        return "".join(f"{int(byte):02x}" for byte in value)
    return str(value)
