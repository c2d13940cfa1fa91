"""Command line options for the files of a recording and their format."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from rbl_gym.measurements.offsets import OFFSETS

if TYPE_CHECKING:
    from rbl_gym.recordings import Recording


def add_reading(parser: argparse.ArgumentParser, left_out: Collection[str] = ()) -> None:
    """Add the options that `read_runs` reads.

    `left_out`: names of files for which the command has its own options. Then no file is required.
    """
    files = parser.add_argument_group("files")
    for name, text in (
        (
            "ranges",
            "CSV: t,anchor,tag,range[,std,valid,run], or t,a0t0,a0t1,..., or time differences "
            "t,anchor_a,anchor_b,tag,difference",
        ),
        (
            "anchors",
            "CSV: anchor,x,y,z, or anchor,t,x,y,z if they move; without it columns ax,ay,az in "
            "--ranges",
        ),
        ("tags", "CSV: tag,x,y,z in the body frame; without it one tag at the body's origin"),
        ("truth", "true poses: TUM, EuRoC/ASL, or CSV: t,x,y,z,qw,qx,qy,qz or t,x,y[,z][,yaw_deg]"),
        ("calibration", "biases of the links, CSV: anchor,tag,bias_m[,slope]"),
        (
            "directions",
            "biases by the direction of the ray, CSV: end,id,harmonic,bias_cos_m,bias_sin_m",
        ),
        ("carrier", "poses of a body that carries the anchors, in a format of --truth"),
        (
            "odometry",
            "CSV: t,vx[,vy,vz][,wx,wy],wz in the body frame, or wheel speeds t,left,right",
        ),
        ("imu", "inertial sensor, CSV: t,wx,wy,wz,ax,ay,az in rad/s and m/s^2"),
        (
            "imu-frame",
            "rotation from the axes of --imu to those of the body: a rotation vector in degrees, "
            "or a file with qw,qx,qy,qz",
        ),
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
        help="names of columns in your files. In --ranges: time=time_s,anchor=to_id,range=dist. In "
        "another file: truth.x=px. All columns with a prefix: truth.*=B_*. One column for each "
        "link: range=r_{anchor}_{tag},std=sd_{anchor}_{tag}. Without a header, numbers from 1: "
        "odometry.t=1. May be given several times",
    )
    reading.add_argument(
        "--where",
        type=_pairs,
        action="append",
        metavar="COLUMN=CELL,...",
        help="read only the rows whose COLUMN has this cell, as in anchors.agent=1,tags.agent=2",
    )
    reading.add_argument(
        "--time-unit",
        metavar="UNIT",
        help=(
            "unit of the times of --ranges: s, ms, us, ns or iso; default: from the header, "
            "else detected"
        ),
    )
    reading.add_argument(
        "--unit",
        metavar="UNIT",
        help="unit of --ranges: m, cm or mm; default: from the header, else m",
    )
    reading.add_argument(
        "--offset",
        choices=OFFSETS,
        help="ranges are pseudo-ranges. At each epoch they have one unknown offset for each tag, "
        "one for each anchor, or one for all; they may be zero or negative",
    )
    reading.add_argument(
        "--wheelbase-m",
        type=float,
        metavar="X",
        help=(
            "distance between the wheels, metres, for --odometry with columns left and right "
            "but without width"
        ),
    )
    reading.add_argument(
        "--turn-unit",
        metavar="UNIT",
        default="rad/s",
        help="unit of the turn rates of --odometry and --imu: rad/s or deg/s; default rad/s",
    )
    reading.add_argument(
        "--run",
        dest="which_run",
        metavar="NAME",
        help="name of the run to read, if the file has several",
    )
    reading.add_argument(
        "--relative",
        action="store_true",
        help="with --carrier: estimate the pose in the frame of the carrier, not of the world",
    )
    reading.add_argument(
        "--strict",
        action="store_true",
        help="stop with an error at rows that are otherwise dropped or sorted",
    )


def read_runs(options: argparse.Namespace) -> dict[str, Recording]:
    """Return the recordings given by the options, by name of run."""
    from rbl_gym import recordings

    given = {
        field.name: getattr(options, field.name) for field in dataclasses.fields(recordings.Files)
    }
    files = recordings.Files(**given)
    format = recordings.Format(
        columns=_joined(options.columns),
        where=_joined(options.where),
        time_unit=options.time_unit,
        unit=options.unit,
        offset=options.offset,
        wheelbase_m=options.wheelbase_m,
        turn_unit=options.turn_unit,
        strict=options.strict,
    )
    if options.which_run is None:
        return recordings.read_runs(files, format)
    return {options.which_run: recordings.read_recording(files, options.which_run, format)}


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
