"""Read the messages of a log with rosbags, and collect their values by kind."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.extras import require
from rbl_gym.recordings import bag_fields
from rbl_gym.recordings.bag_profiles import KEYS, NO_PATHS, Source
from rbl_gym.recordings.bag_tables import Row

AnyPath = str | os.PathLike[str]
Paths = AnyPath | Sequence[AnyPath]
Advance = Callable[[int], Any]

_ODD = 30.0  # units of time differ by a larger factor
_TIME_UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


@contextmanager
def named(where: str) -> Iterator[None]:
    """Add the location to errors of a field or value."""
    try:
        yield
    except (KeyError, ValueError) as error:
        raise ValueError(f"{where}: {error.args[0]}") from error


@contextmanager
def opened(log: Paths, messages: AnyPath | None) -> Iterator[Any]:
    """Open the log with rosbags; raise ValueError with the file name if it cannot be read."""
    require("rosbags", "bags", "reading bags")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    paths = [Path(path) for path in all_paths(log)]
    for path in paths:
        if not path.exists():
            raise ValueError(f"{path}: no such file or folder")
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            raise ValueError(
                f"{path}: the folder of a ROS 2 bag must have a file metadata.yaml, this one has "
                "none"
            )
        if path.is_file() and path.suffix not in (".bag", ".db3", ".mcap"):
            raise ValueError(
                f"{path}: must be a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag"
            )
    # ROS 2 bags without definitions come from Humble or older.
    store = get_typestore(Stores.ROS2_HUMBLE)
    if messages is not None:
        given = _definitions(Path(messages))
        store.register({name: given[name] for name in given.keys() - store.types.keys()})
    with _rosbags(log):
        reader = AnyReader(paths, default_typestore=store)
        reader.open()
    try:
        # If a log stores some definitions, rosbags does not add the others.
        if any(c.msgtype not in reader.typestore.types for c in reader.connections):
            missing = store.fielddefs.keys() - reader.typestore.fielddefs.keys()
            reader.typestore.register({name: store.fielddefs[name] for name in missing})
        yield reader
    finally:
        reader.close()


@contextmanager
def _rosbags(log: Paths) -> Iterator[None]:
    """Convert the errors of rosbags, sqlite and the decompressors."""
    try:
        yield
    except Exception as error:
        hint = " (try `rosbag reindex`)" if "index" in str(error).lower() else ""
        said = str(error) or type(error).__name__
        raise ValueError(f"{log_name(log)}: cannot be read, {said}{hint}") from error


def _definitions(folder: Path) -> dict[str, Any]:
    """Return the message types of the .msg files below a folder."""
    from rosbags.typesys import get_types_from_msg

    found: dict[str, Any] = {}
    for file in sorted(folder.rglob("*.msg")):
        package = file.parent.parent if file.parent.name == "msg" else file.parent
        text = file.read_text(encoding="utf-8")
        with _rosbags(file):
            found |= get_types_from_msg(text, f"{package.name}/msg/{file.stem}")
    if not found:
        raise ValueError(f"{folder}: must have files PACKAGE/msg/NAME.msg, has none")
    return found


def all_paths(log: Paths) -> list[AnyPath]:
    """Return the paths of a log of one file or several."""
    return [log] if isinstance(log, str | os.PathLike) else [*log]


def log_name(log: Paths) -> str:
    """Return the paths of a log as text."""
    return ", ".join(os.fspath(path) for path in all_paths(log))


def types(reader: Any) -> dict[str, str]:
    """Return the topics and their types."""
    return {topic: info.msgtype or "several types" for topic, info in sorted(reader.topics.items())}


def messages(reader: Any, topics: Sequence[str], advance: Advance) -> Iterator[bag_fields.Received]:
    """Yield the messages of some topics in the order of recording."""
    connections = [c for c in reader.connections if c.topic in topics]
    raw_messages: Iterator[Any] = reader.messages(connections) if connections else iter(())
    while True:
        with _rosbags(reader.paths):
            if (item := next(raw_messages, None)) is None:
                return
        connection, time_ns, raw = item
        if connection.msgtype not in reader.typestore.types:
            raise ValueError(
                f"{log_name(reader.paths)}, topic {connection.topic}: the log has no definition "
                f"of the type {connection.msgtype}: give the folder of its .msg files (--messages)"
            )
        with _rosbags(reader.paths):
            message = reader.deserialize(raw, connection.msgtype)
        yield bag_fields.Received(message, connection.topic, time_ns)
        advance(1)


@dataclass
class Values:
    """The values of one kind: rows in the order of recording."""

    kind: str
    source: Source
    rows: list[Row] = field(default_factory=list)
    delays_ns: list[int] = field(default_factory=list)  # time of recording minus stamp
    messages: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    by_recording: bool = False  # stamps are the times of recording
    _getters: list[bag_fields.Getter] = field(default_factory=list)
    _unit: str = "s"
    _is_number: bool = False  # times are numbers, not stamps

    def take(self, received: bag_fields.Received) -> None:
        """Add the values of a message."""
        table = self.source.table
        where = table.get("where", {})
        keys = [key for key in KEYS[self.kind] if table.get(key) and key not in NO_PATHS]
        if not self.messages:
            time = self._time_path(received.message)
            self._unit = "ns" if time == "@bag" else table.get("time_unit", "s")
            if self._unit not in _TIME_UNITS:
                raise ValueError(
                    f"time_unit must be one of {', '.join(_TIME_UNITS)}, got {self._unit!r}"
                )
            self._getters = [_getter(path) for path in (time, *where, *(table[k] for k in keys))]
        self.messages += 1
        for stamp, *values in bag_fields.rows(received, self._getters):
            wrong = [
                f"{place} is {value}" if isinstance(value, str) else f"{place} is not {wanted}"
                for (place, wanted), value in zip(where.items(), values, strict=False)
                if bag_fields.text(value).lstrip("/") != str(wanted).lstrip("/")
            ]
            if wrong:
                self.dropped[wrong[0]] += 1
                continue
            self._is_number = not hasattr(stamp, "nanosec")
            time_ns = _nanoseconds(stamp, self._unit)
            self.rows.append((time_ns, dict(zip(keys, values[len(where) :], strict=True))))
            self.delays_ns.append(received.time_ns - time_ns)

    def _time_path(self, message: Any) -> str:
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        self.by_recording = "time" not in self.source.table and stamp is None
        return self.source.table.get("time") or ("@bag" if stamp is None else "header.stamp")

    def finish(self) -> None:
        """Handle rows without a stamp: if all lack it, use the time of recording; else drop them.

        ValueError if times in `time_unit` span far more or far less than the recording.
        """
        bad = [time <= 0 and not self._is_number for time, _ in self.rows]
        if all(bad) and "time" not in self.source.given:
            self.by_recording = True
            self.rows = [
                (delay + time, values)
                for (time, values), delay in zip(self.rows, self.delays_ns, strict=True)
            ]
            self.delays_ns = [0] * len(self.rows)
        elif any(bad):
            self.dropped["no stamp"] = sum(bad)
            keep = [i for i, is_bad in enumerate(bad) if not is_bad]
            self.rows = [self.rows[i] for i in keep]
            self.delays_ns = [self.delays_ns[i] for i in keep]
        if not (self._is_number and self.rows):
            return
        stamps = np.array([time for time, _ in self.rows])
        recorded = np.ptp(stamps + np.array(self.delays_ns)) * 1e-9
        lasts = np.ptp(stamps) * 1e-9
        if recorded and lasts and not 1 / _ODD < lasts / recorded < _ODD:
            raise ValueError(
                f"times of the messages span {lasts:g} s, but the recording lasts {recorded:g} s: "
                f"time_unit must be another one of {', '.join(_TIME_UNITS)}, got {self._unit!r}"
            )


def read_values(
    reader: Any, log: Paths, found: Mapping[str, Source], advance: Advance
) -> dict[str, Values]:
    """Read the values of all kinds in one pass over the log."""
    values = {kind: Values(kind, source) for kind, source in found.items()}
    topics = sorted({topic for source in found.values() for topic in source.topics})
    for received in messages(reader, topics, advance):
        for kind, source in found.items():
            if received.topic in source.topics:
                with named(f"{log_name(log)}, topic {received.topic}, [{kind}]"):
                    values[kind].take(received)
    for kind, taken in values.items():
        with named(f"{log_name(log)}, topic {', '.join(taken.source.topics)}, [{kind}]"):
            taken.finish()
    return values


def _getter(path: Any) -> bag_fields.Getter:
    """Return the getter of a path, or of a list of paths that form a vector."""
    if isinstance(path, str):
        return bag_fields.getter(path)
    if not (isinstance(path, Sequence) and all(isinstance(part, str) for part in path)):
        raise ValueError(f"must be a field path or a list of them, got {path!r:.60}")
    parts = [bag_fields.getter(part) for part in path]

    def all_of(received: bag_fields.Received) -> Any:
        rows = bag_fields.rows(received, parts)
        has_list = any("[]" in part for part in path)
        return bag_fields.EachItem(rows) if has_list else rows[0]

    return all_of


def _nanoseconds(stamp: Any, unit: str) -> int:
    """Convert a ROS stamp, or a number in `unit`, to nanoseconds."""
    if hasattr(stamp, "nanosec"):
        return stamp.sec * 10**9 + stamp.nanosec
    if isinstance(stamp, int):
        return stamp * _TIME_UNITS[unit]
    try:
        return round(float(stamp) * _TIME_UNITS[unit])
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"time must be a stamp or a number, got {stamp!r:.60}") from None
