"""Convert bags of ROS 1 and ROS 2, and MCAP files, to the files of a recording.

The library rosbags reads the logs (extra ``bags``). Message definitions stored in the log are
used. Bags of ROS 1 and MCAP store them, and so do sqlite3 bags since ROS 2 Iron.
"""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.checks import did_you_mean
from rbl_gym.recordings import bag_fields, bag_profiles, bag_reading
from rbl_gym.recordings.bag_reading import Advance, AnyPath, Paths, log_name
from rbl_gym.recordings.bag_tables import Sheet, Tables, make_tables, seconds
from rbl_gym.recordings.writing import write_table

__all__ = ["convert_bag", "list_topics", "show_message"]

_FAR_S = 1.0  # stamps further from the time of recording are reported


def convert_bag(
    log: Paths,
    out: AnyPath,
    mapping: Mapping[str, Mapping[str, Any]] | None = None,
    messages: AnyPath | None = None,
    advance: Advance = lambda steps: None,
) -> dict[str, Any]:
    """Write the ranges of a log, and the data that belong to them, as the files of a recording.

    Parameters
    ----------
    log
        A ROS 1 bag, or several consecutive ones; a ROS 2 folder; a .db3 or .mcap file.
    out
        Output folder, created if it does not exist. The files are ranges.csv; truth.csv, imu.csv
        and odometry.csv if the log has these data; anchors.csv and tags.csv if the range messages
        hold their positions; and convert.json, which holds the returned dict. Metres, seconds,
        rad/s.
    mapping
        Tables ``ranges``, ``truth``, ``imu``, ``odometry``: topics and field paths, see
        docs/bags.md. Keys that are left out are taken from the message types.
    messages
        Folder with ``PACKAGE/msg/NAME.msg``, for logs without message definitions.
    advance
        Called with the number of messages read since the last call.

    Returns
    -------
    dict
        ``kinds`` (for each kind: topics, type, messages, rows, time span, rate, the number of
        dropped rows and the reasons), ``topics``, ``files``, ``notes``, and ``replay``, the
        command to run next.

    Raises
    ------
    ValueError
        If the log cannot be read, a topic or field does not exist (the message lists those that
        do), or no range is left.
    MissingExtraError
        If rosbags is not installed.
    """
    out = Path(out)
    with bag_reading.opened(log, messages) as reader:
        topics = bag_reading.types(reader)
        with bag_reading.named(log_name(log)):
            found, notes = _sources(reader, mapping)
            _check_ranges(found, mapping or {}, topics)
        listed = _topic_rows(reader, found)
        read = bag_reading.read_values(reader, log, found, advance)
    sheets: dict[str, Sheet] = {}
    kinds: dict[str, dict[str, Any]] = {}
    for kind, values in read.items():
        source = values.source
        with bag_reading.named(f"{log_name(log)}, topic {', '.join(source.topics)}"):
            made = make_tables(kind, values.rows, source.table, source.given)
            kinds[kind] = _said(values, made, topics)
            if not len(made.times_ns) and (kind == "ranges" or kind in (mapping or {})):
                dropped = [f"{n} dropped, {why}" for why, n in kinds[kind]["dropped"].items()]
                raise ValueError(
                    f"[{kind}] no message can be used: {'; '.join(dropped) or 'the log has none'}"
                )
        notes += made.notes
        if values.by_recording:
            notes.append(f"{kind}: the messages have no stamps, so the times of recording are used")
        if len(made.times_ns):
            sheets |= made.sheets
        else:
            notes.append(f"{kind}: no message can be used, so no file was written")
    notes += _far_stamps(kinds)
    if "ranges" in kinds:
        notes += [_to_write(name, kinds["ranges"]) for name in _POINTS if name not in sheets]
    result = {
        "log": [os.fspath(path) for path in bag_reading.all_paths(log)],
        "topics": listed,
        "kinds": kinds,
        "files": _write(out, sheets),
        "notes": notes,
        "replay": _replay(out, sheets) if "ranges" in kinds else None,
    }
    text = json.dumps(result, indent=1, allow_nan=False) + "\n"
    (out / "convert.json").write_text(text, encoding="utf-8")
    return result


def list_topics(
    log: Paths,
    mapping: Mapping[str, Mapping[str, Any]] | None = None,
    messages: AnyPath | None = None,
) -> list[dict[str, Any]]:
    """List the topics of a log: name, type, messages, rate, and their kind for `convert_bag`.

    Arguments as in `convert_bag`, with the same errors.
    """
    with bag_reading.opened(log, messages) as reader, bag_reading.named(log_name(log)):
        return _topic_rows(reader, _sources(reader, mapping)[0])


def show_message(log: Paths, topic: str, messages: AnyPath | None = None) -> list[tuple[str, str]]:
    """Return the field paths of a topic with the values of its first message, as text.

    Arguments as in `convert_bag`, with the same errors.
    """
    with bag_reading.opened(log, messages) as reader:
        if topic not in (topics := bag_reading.types(reader)):
            raise ValueError(
                f"{log_name(log)}: no topic {topic!r}; the topics are {', '.join(topics)}"
                f"{did_you_mean(topic, topics)}"
            )
        for received in bag_reading.messages(reader, [topic], lambda steps: None):
            return bag_fields.describe(received.message)
    raise ValueError(f"{log_name(log)}: topic {topic} has no message")


def _sources(
    reader: Any, mapping: Mapping[str, Mapping[str, Any]] | None
) -> tuple[dict[str, bag_profiles.Source], list[str]]:
    mapping = {} if mapping is None else mapping
    bag_profiles.check_mapping(mapping)
    return bag_profiles.sources(bag_reading.types(reader), mapping)


def _check_ranges(
    found: Mapping[str, Any], mapping: Mapping[str, Any], topics: Mapping[str, str]
) -> None:
    if "ranges" in found or mapping.get("ranges", {}).get("topic") == "none":
        return
    raise ValueError(
        "no topic has a known type of ranges: give the topic and its fields, as in --ranges "
        "topic=/uwb,anchor=responder_id,tag=requester_id,range=distance (or --ranges none); "
        "there are "
        f"{', '.join(f'{topic} ({name})' for topic, name in topics.items()) or 'no topics'}"
    )


def _topic_rows(reader: Any, found: Mapping[str, bag_profiles.Source]) -> list[dict[str, Any]]:
    seconds_long = (reader.end_time - 1 - reader.start_time) * 1e-9 if reader.message_count else 0.0
    return [
        {
            "topic": topic,
            "type": msgtype,
            "messages": (count := reader.topics[topic].msgcount),
            "rate_hz": (count - 1) / seconds_long if count > 1 and seconds_long > 0 else None,
            "read_as": [kind for kind, source in found.items() if topic in source.topics],
        }
        for topic, msgtype in bag_reading.types(reader).items()
    ]


def _said(values: bag_reading.Values, made: Tables, topics: Mapping[str, str]) -> dict[str, Any]:
    """Return the entry of convert.json for one kind."""
    times = made.times_ns
    duration = float(times[-1] - times[0]) * 1e-9 if len(times) else 0.0
    epochs = len(np.unique(times))
    return {
        "topics": [*values.source.topics],
        "type": topics[values.source.topics[0]],
        "fields": values.source.table,
        "messages": values.messages,
        "rows": len(times),
        "start": seconds(int(times[0])) if len(times) else None,
        "end": seconds(int(times[-1])) if len(times) else None,
        "duration_s": duration,
        "rate_hz": (epochs - 1) / duration if duration > 0 else None,
        "delay_s": float(np.median(values.delays_ns)) * 1e-9 if values.delays_ns else None,
        "dropped": dict(values.dropped + made.dropped),
        **made.facts,
    }


def _far_stamps(kinds: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Report kinds whose stamps differ from the time of recording and from the other kinds."""
    delays = {kind: said["delay_s"] for kind, said in kinds.items() if said["delay_s"] is not None}
    if not delays or max(delays.values()) - min(delays.values()) <= _FAR_S:
        return []
    told = ", ".join(f"{kind} {delay:.3f} s" for kind, delay in delays.items())
    return [
        f"the clocks differ: the stamps are behind the times of recording by {told}. With the key "
        "time=@bag the times of recording are used"
    ]


_POINTS = {"anchors.csv": "anchors", "tags.csv": "tags"}


def _to_write(name: str, said: Mapping[str, Any]) -> str:
    ids = ", ".join(said[_POINTS[name]])
    frame = "world frame" if name == "anchors.csv" else "body frame"
    return (
        f"{name} cannot be written from the log. Write it with the columns "
        f"{_POINTS[name][:-1]},x,y,z in metres, {frame}, for {ids}"
    )


def _write(out: Path, sheets: Mapping[str, Sheet]) -> dict[str, str]:
    """Write the files, and remove those of an earlier conversion."""
    made = ("truth.csv", "imu.csv", "odometry.csv")
    if stale := [name for name in made if name not in sheets and (out / name).exists()]:
        raise ValueError(
            f"{out / stale[0]} exists and does not come from this log: remove it or choose "
            "another folder"
        )
    out.mkdir(parents=True, exist_ok=True)
    for name, sheet in sheets.items():
        write_table(out / name, sheet.header, sheet.rows)
    return {name: os.fspath(out / name) for name in sheets}


def _replay(out: Path, sheets: Mapping[str, Sheet]) -> str:
    words = ["rbl-gym", "replay"]
    for option in ("ranges", "anchors", "tags", "truth"):
        if option != "truth" or "truth.csv" in sheets:
            words += [f"--{option}", os.fspath(out / f"{option}.csv")]
    return shlex.join(words)
