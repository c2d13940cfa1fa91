"""The command rbl-gym convert."""

from __future__ import annotations

import argparse
from typing import Any

from rbl_gym.app.terminal import add_json, progress, write_json
from rbl_gym.extras import require

_KINDS = {
    "ranges": "topic and fields, as in topic=/uwb,anchor=to,tag=from,range=distance; further keys: "
    "std, unit, tags (ids of the tags on the body), anchor_position, tag_position",
    "truth": "topic of the poses, as in topic=/pose; with /tf also parent=FRAME,child=FRAME; "
    "further keys: position, orientation",
    "imu": "topic of the inertial sensor, as in topic=/imu",
    "odometry": "topic of the odometry, as in topic=/odom",
}


def add_convert(commands: Any) -> None:
    """Add the parser of ``rbl-gym convert``."""
    convert = commands.add_parser(
        "convert",
        help="convert a ROS 1 or ROS 2 bag, or an MCAP file, to the files that replay reads",
        description="Write ranges.csv, and anchors, tags, truth, imu and odometry if the log has "
        "them. Known message types need no option; see docs/bags.md.",
    )
    convert.add_argument(
        "log",
        nargs="*",
        metavar="LOG",
        help="a .bag file of ROS 1 (or several that follow each other), the folder of a ROS 2 bag, "
        "or a .db3 or .mcap file",
    )
    convert.add_argument("--out", metavar="DIR", help="folder for the written files")
    convert.add_argument(
        "--list",
        nargs="?",
        const="",
        metavar="TOPIC",
        help="show the topics of the log, or the fields of TOPIC, and write nothing",
    )
    convert.add_argument(
        "--map",
        metavar="F",
        help="TOML file with the tables ranges, truth, imu and odometry, in place of the options "
        "below",
    )
    for kind, text in _KINDS.items():
        convert.add_argument(
            f"--{kind}",
            metavar="KEY=VALUE,...",
            type=_table,
            help=f"{text}. --{kind} none: no file",
        )
    convert.add_argument(
        "--messages",
        metavar="DIR",
        help="folder with PACKAGE/msg/NAME.msg, if the log has no message definitions",
    )
    add_json(convert)
    convert.set_defaults(run=_convert)


def _convert(options: argparse.Namespace) -> int:
    if not options.log:
        raise ValueError("LOG must be given, before --list: rbl-gym convert LOG --list")
    require("rosbags", "bags", "reading bags")
    from rbl_gym.app import convert_report
    from rbl_gym.recordings import bag_profiles, bags

    if options.list:
        fields = bags.show_message(options.log, options.list, options.messages)
        if write_json({"topic": options.list, "fields": dict(fields)}, options.json):
            convert_report.print_fields(fields)
        return 0
    mapping = bag_profiles.read_mapping(options.map) if options.map else {}
    for kind in _KINDS:
        if (table := getattr(options, kind)) is not None:
            mapping[kind] = {**mapping.get(kind, {}), **table}
    topics = bags.list_topics(options.log, mapping, options.messages)
    if options.list is not None:
        if write_json({"topics": topics}, options.json):
            convert_report.print_topics(topics)
        return 0
    if options.out is None:
        raise ValueError(
            "--out DIR must be given, the folder for the files (--list only shows topics)"
        )
    with progress("reading", sum(row["messages"] for row in topics if row["read_as"])) as advance:
        result = bags.convert_bag(options.log, options.out, mapping, options.messages, advance)
    if write_json(result, options.json):
        convert_report.print_convert(result)
    return 0


def _table(text: str) -> dict[str, Any]:
    """Parse ``KEY=VALUE,...``; a part without ``=`` is another value, or first a topic."""
    table: dict[str, Any] = {}
    key = "topic"
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if equals:
            key, part = name.strip(), value
            if not key or key in table:
                raise argparse.ArgumentTypeError(
                    f"must be KEY=VALUE,... with each key once, got {text!r}"
                )
        values = table.get(key, [])
        table[key] = [*(values if isinstance(values, list) else [values]), part] if values else part
    return table
