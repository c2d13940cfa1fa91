"""Select what is read from a bag: known message types, and mapping tables.

A *mapping* is a dictionary of tables, as a TOML file gives it: ``ranges``, ``truth``, ``imu`` and
``odometry``, each with the topics and the field paths of the values
(`rbl_gym.recordings.bag_fields`). Keys that a table leaves out are filled in from the message
type. The custom types are described at

- https://github.com/ntu-aris/uwb_driver, msg/UwbRange.msg (data set NTU VIRAL),
- https://github.com/decargroup/miluv, uwb_ros/msg/RangeStamped.msg (data set MILUV).
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

from rbl_gym.checks import did_you_mean

Table = Mapping[str, Any]

_EVERYWHERE = ("topic", "time", "time_unit", "where")
KEYS = {
    "ranges": (
        "anchor",
        "tag",
        "range",
        "std",
        "least",
        "most",
        "unit",
        "tags",
        "anchor_position",
        "tag_position",
    ),
    "truth": ("position", "orientation", "parent", "child"),
    "imu": ("angular_velocity", "linear_acceleration"),
    "odometry": ("velocity", "angular_velocity"),
}
NO_PATHS = ("unit", "tags")  # keys that are not field paths
REQUIRED = {
    "ranges": ("anchor", "tag", "range"),
    "truth": ("position",),
    "imu": ("angular_velocity", "linear_acceleration"),
    "odometry": ("velocity", "angular_velocity"),
}

_POSE = {"position": "pose.position", "orientation": "pose.orientation"}
_POSE_IN_POSE = {"position": "pose.pose.position", "orientation": "pose.pose.orientation"}
_TYPES: dict[str, dict[str, Table]] = {
    "ranges": {
        "uwb_driver/msg/UwbRange": {
            "anchor": "responder_id",
            "tag": "{requester_id}.{antenna}",
            "range": "distance",
            "anchor_position": "responder_location",
            "tag_position": "rqst_antenna_offset",
        },
        "uwb_ros/msg/RangeStamped": {"anchor": "to_id", "tag": "from_id", "range": "range"},
        # Any distance sensor; used for a radio only if there is nothing better.
        "sensor_msgs/msg/Range": {
            "anchor": "@topic",
            "tag": "header.frame_id",
            "range": "range",
            "least": "min_range",
            "most": "max_range",
        },
    },
    "truth": {
        "geometry_msgs/msg/PoseStamped": _POSE,
        "geometry_msgs/msg/PoseWithCovarianceStamped": _POSE_IN_POSE,
        "geometry_msgs/msg/PointStamped": {"position": "point"},
        "geometry_msgs/msg/TransformStamped": {
            "position": "transform.translation",
            "orientation": "transform.rotation",
        },
        "nav_msgs/msg/Odometry": _POSE_IN_POSE,
        "tf2_msgs/msg/TFMessage": {
            "time": "transforms[].header.stamp",
            "position": "transforms[].transform.translation",
            "orientation": "transforms[].transform.rotation",
        },
    },
    "imu": {
        "sensor_msgs/msg/Imu": {
            "angular_velocity": "angular_velocity",
            "linear_acceleration": "linear_acceleration",
        }
    },
    "odometry": {
        "nav_msgs/msg/Odometry": {
            "velocity": "twist.twist.linear",
            "angular_velocity": "twist.twist.angular",
        }
    },
}
# Types that are used only if a table names their topic: estimates, frame trees.
_ONLY_BY_NAME = {"truth": ("nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage")}
# The choice between several topics, from the documentation of known data sets.
_PREFERRED = {
    "truth": ("/leica/pose/relative", "/*/vrpn_client_node/*/pose"),
    "imu": ("/imu/imu", "/*/mavros/imu/data_raw"),
}
_FRAMES = {  # frame names, by the type of the message
    "geometry_msgs/msg/TransformStamped": ("header.frame_id", "child_frame_id"),
    "nav_msgs/msg/Odometry": ("header.frame_id", "child_frame_id"),
    "tf2_msgs/msg/TFMessage": ("transforms[].header.frame_id", "transforms[].child_frame_id"),
}


class Source(NamedTuple):
    """One kind of measurement: its topics and the field paths of the values."""

    topics: tuple[str, ...]
    table: dict[str, Any]  # from the mapping, then from the known type
    given: frozenset[str]  # keys given in the mapping


def read_mapping(path: str) -> dict[str, Table]:
    """Read the tables of a TOML file.

    ValueError if the file cannot be read, or is not valid TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path}: must be a TOML file, {error}") from error


def check_mapping(mapping: Mapping[str, Any]) -> None:
    """Raise ValueError if a table or a key is unknown."""
    for kind, table in mapping.items():
        if kind not in KEYS:
            raise ValueError(
                f"table [{kind}] is unknown; the tables are {', '.join(KEYS)}"
                f"{did_you_mean(kind, KEYS)}"
            )
        if not isinstance(table, Mapping):
            raise ValueError(f"[{kind}] must be a table of keys and values, got {table!r:.60}")
        known = [*_EVERYWHERE, *KEYS[kind]]
        for key in table:
            if key not in known:
                raise ValueError(
                    f"[{kind}] has an unknown key {key!r}; it may have {', '.join(known)}"
                    f"{did_you_mean(key, known)}"
                )


def sources(
    topics: Mapping[str, str], mapping: Mapping[str, Table]
) -> tuple[dict[str, Source], list[str]]:
    """Return what to read from `topics` (name: type), and notes on what was not chosen.

    ValueError if a topic named in the mapping does not exist, or a value has no field path.
    """
    found: dict[str, Source] = {}
    notes: list[str] = []
    for kind in KEYS:
        table = dict(mapping.get(kind, {}))
        wanted = table.pop("topic", None)
        if wanted == "none":
            continue
        if wanted is None:
            names, note = _candidates(kind, topics)
            notes += [note] if note else []
        else:
            patterns = [wanted] if isinstance(wanted, str) else list(wanted)
            names = [topic for pattern in patterns for topic in _matching(kind, pattern, topics)]
        if names:
            found[kind] = Source(
                tuple(names), _filled(kind, table, names, topics), frozenset(table)
            )
        elif table:
            raise ValueError(
                f"[{kind}] must have the key topic, as no topic has a known type; the topics are "
                f"{_listed(topics)}"
            )
    return found, notes


def _candidates(kind: str, topics: Mapping[str, str]) -> tuple[list[str], str]:
    """Return the topics of a known type: for ranges all of the first such type, else one topic."""
    hidden = _ONLY_BY_NAME.get(kind, ())
    known = [name for name in _TYPES[kind] if name not in hidden]
    by_type = {name: [t for t in topics if topics[t] == name] for name in known}
    if kind == "ranges":
        return next((names for names in by_type.values() if names), []), ""
    names = [topic for found in by_type.values() for topic in found]
    preferred = [
        topic
        for pattern in _PREFERRED.get(kind, ())
        for topic in names
        if fnmatchcase(topic, pattern)
    ]
    if len(names) > 1 and len(preferred) != 1:
        return (
            [],
            f"{kind} not written, as several topics are possible, {', '.join(names)}: name one by "
            f"--{kind} topic=NAME",
        )
    return (preferred or names), ""


def _matching(kind: str, pattern: str, topics: Mapping[str, str]) -> list[str]:
    names = [topic for topic in topics if fnmatchcase(topic, pattern)]
    if not names:
        raise ValueError(
            f"[{kind}] has the topic {pattern!r}, which the log does not have; its topics are "
            f"{_listed(topics)}{did_you_mean(pattern, topics)}"
        )
    return names


def _filled(
    kind: str, table: dict[str, Any], names: Sequence[str], topics: Mapping[str, str]
) -> dict[str, Any]:
    """Return the table, filled in from the message type."""
    types = {topics[name] for name in names}
    if len(types) > 1:
        raise ValueError(f"[{kind}] topics must have the same message type, got {sorted(types)}")
    msgtype = types.pop()
    full = {**_TYPES[kind].get(msgtype, {}), **table}
    if missing := [key for key in REQUIRED[kind] if not full.get(key)]:
        raise ValueError(
            f"[{kind}] topic {names[0]} is of type {msgtype}: give the field paths of "
            f"{', '.join(missing)}"
        )
    for key, place in zip(("parent", "child"), _FRAMES.get(msgtype, ()), strict=False):
        if key in full:
            full["where"] = {**full.get("where", {}), place: full.pop(key)}
    if msgtype == "tf2_msgs/msg/TFMessage" and len(full.get("where", {})) < 2:
        raise ValueError(f"[{kind}] {names[0]} has messages of many frames: give parent and child")
    if frames := [key for key in ("parent", "child") if key in full]:
        raise ValueError(
            f"[{kind}] must not have the key {frames[0]}, as messages of type {msgtype} have no "
            "frames"
        )
    return full


def _listed(topics: Mapping[str, str]) -> str:
    return ", ".join(topics) or "none"
