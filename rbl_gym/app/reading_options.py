"""Command line options for the files of a recording and their format."""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from rbl_gym.measurements.offsets import OFFSETS

if TYPE_CHECKING:
    from rbl_gym.recordings import Recording

_FILES = (
    "ranges",
    "anchors",
    "tags",
    "truth",
    "calibration",
    "directions",
    "carrier",
    "odometry",
    "imu",
    "imu_frame",
)


def add_reading(parser: argparse.ArgumentParser, left_out: Collection[str] = ()) -> None:
    """Add the options that `read_runs` reads.

    `left_out`: names of files for which the command has its own options. Then no file is required.
    """
    files = parser.add_argument_group("files")
    for name, text in (
        (
            "ranges",
            "t,anchor,tag,range[,std,valid,run], or t,a0t0,a0t1,..., or differences "
            "t,anchor_a,anchor_b,tag,difference",
        ),
        ("anchors", "anchor,x,y,z; anchor,t,x,y,z where they move; without it ax,ay,az in ranges"),
        ("tags", "tag,x,y,z; without it one tag at the body's origin"),
        ("truth", "TUM, EuRoC/ASL, t,x,y,z,qw,qx,qy,qz, or t,x,y[,z][,yaw_deg]"),
        ("calibration", "anchor,tag,bias_m[,slope]"),
        ("directions", "end,id,harmonic,bias_cos_m,bias_sin_m: bias by the direction of the ray"),
        ("carrier", "poses, as of the truth, of a body that carries the anchors"),
        ("odometry", "t,vx[,vy,vz][,wx,wy],wz in the body frame, or t,left,right of wheels"),
        ("imu", "t,wx,wy,wz,ax,ay,az, rad/s and m/s^2"),
        ("imu-frame", "its axes in the body's: rotation vector in degrees, or a file qw,qx,qy,qz"),
    ):
        if name not in left_out:
            required = name == "ranges" and not left_out
            files.add_argument(f"--{name}", required=required, metavar="F", help=text)
    reading = parser.add_argument_group("reading (see docs/recordings.md)")
    reading.add_argument(
        "--columns",
        type=_pairs,
        action="append",
        metavar="WHAT=NAME,...",
        help="what columns are called: time=time_s,anchor=to_id,range=dist; of another file "
        "truth.x=px, anchors.anchor=name; wide: range=r_{anchor}_{tag},std=sd_{anchor}_{tag}; "
        "all that begin so: truth.*=B_*; without a header by number, odometry.t=1; may be given "
        "more than once",
    )
    reading.add_argument(
        "--where",
        type=_pairs,
        action="append",
        metavar="COLUMN=CELL,...",
        help="rows that are meant: anchors.agent=1,tags.agent=2",
    )
    reading.add_argument(
        "--time-unit",
        metavar="UNIT",
        help="of the ranges: s, ms, us, ns or iso; default as the header tells, else found",
    )
    reading.add_argument("--unit", metavar="UNIT", help="of the ranges: m, cm or mm; default m")
    reading.add_argument(
        "--offset",
        choices=OFFSETS,
        help="whose ranges have an unknown offset in common (pseudo-ranges): each tag's, each "
        "anchor's, or all of an epoch; they may be zero and negative",
    )
    reading.add_argument(
        "--wheelbase-m",
        type=float,
        metavar="X",
        help="distance between the wheels of --odometry with left and right, unless it has width",
    )
    reading.add_argument(
        "--turn-unit", metavar="UNIT", default="rad/s", help="of turn rates: rad/s or deg/s"
    )
    reading.add_argument("--run", dest="which_run", metavar="NAME", help="one of several runs")
    reading.add_argument(
        "--relative",
        action="store_true",
        help="with --carrier: the pose in the carrier's frame, not in the world",
    )
    reading.add_argument(
        "--strict",
        action="store_true",
        help="refuse, by line, what is dropped, sorted or counted otherwise",
    )


def read_runs(options: argparse.Namespace) -> dict[str, Recording]:
    """Return the recordings given by the options, by name of run."""
    from rbl_gym import recordings

    paths = {name: getattr(options, name) for name in _FILES}
    how: dict[str, Any] = {
        "relative": options.relative,
        "format": recordings.Format(
            columns=_joined(options.columns),
            where=_joined(options.where),
            time_unit=options.time_unit,
            unit=options.unit,
            offset=options.offset,
            wheelbase_m=options.wheelbase_m,
            turn_unit=options.turn_unit,
            strict=options.strict,
        ),
    }
    if options.which_run is None:
        return recordings.read_runs(**paths, **how)
    run = options.which_run
    return {run: recordings.read_recording(**paths, run=run, **how)}


def _pairs(text: str) -> dict[str, str]:
    """Parse ``a=b,c=d`` into a dictionary."""
    pairs = {}
    for part in text.split(","):
        name, equal, value = part.partition("=")
        if not equal or not name.strip() or not value.strip():
            raise argparse.ArgumentTypeError(f"must be WHAT=NAME,WHAT=NAME,..., got {text!r}")
        pairs[name.strip()] = value.strip()
    return pairs


def _joined(given: list[Mapping[str, str]] | None) -> dict[str, str]:
    return {name: value for pairs in given or () for name, value in pairs.items()}
