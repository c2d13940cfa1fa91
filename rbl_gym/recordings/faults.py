"""Name all wrong files of a log in one message."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rbl_gym.recordings.format import Files, Format
from rbl_gym.recordings.inertial import read_frame, read_inertial
from rbl_gym.recordings.odometry import read_odometry
from rbl_gym.recordings.points import read_points
from rbl_gym.recordings.ranges import read_log
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import read_table
from rbl_gym.recordings.truth import read_truth

# Name of a column of one link, also by a pattern with its two braces.
_OF_LINK = re.compile(r"a.+t.+|.*\d+.*\d+").fullmatch


@contextlib.contextmanager
def every_fault(files: Files, format: Format) -> Iterator[None]:
    """Context of reading a log: if a file is wrong, the error names the other wrong files too.

    A single fault is raised as it is, several as a ValueError with one line for each.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        found = dict.fromkeys([_text(error), *_faults(files, format)])
        if len(found) == 1:
            raise
        lines = "".join(f"\n  {text}" for text in found)
        raise ValueError(f"{len(found)} files cannot be used:{lines}") from error


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{os.fspath(error.filename)}: {error.strerror}"
    return str(error)


def _faults(files: Files, format: Format) -> Iterator[str]:
    """Yield the error of every file that cannot be read by itself."""
    read: dict[str, Any] = {}
    for name, work in _readers(files, format, read):
        if getattr(files, name) is None:
            continue
        try:
            read[name] = work()
        except (ValueError, OSError) as error:
            yield _text(error)


def _readers(
    files: Files, format: Format, read: dict[str, Any]
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield a function for each file. That of the ranges takes `read`, the previous results."""

    def ranges() -> None:
        table = read_table(files.ranges, format.of("ranges"))
        anchors, tags = read.get("anchors"), read.get("tags")
        missing = anchors is None and files.anchors is not None
        if not missing and (tags is not None or files.tags is None):
            read_log(table, anchors, tags, format, Said())
        elif "difference" not in table.columns and not any(map(_OF_LINK, table.names.values())):
            table.require("t", *["anchor"] * (files.anchors is not None), "range")
        table.seconds(format.time_unit)

    for kind in ("anchor", "tag"):
        name = f"{kind}s"
        path = getattr(files, name)
        yield (
            name,
            lambda path=path, kind=kind: read_points(path, kind, format.of(f"{kind}s"), Said()),
        )
    yield "ranges", ranges
    # The times are for a body at rest.
    for name in ("truth", "carrier"):
        path = getattr(files, name)
        yield (
            name,
            lambda path=path, name=name: read_truth(
                path, format.of(name), times=np.array([0.0, 1.0])
            ),
        )
    yield "calibration", lambda: read_table(str(files.calibration), format.of("calibration"))
    how = {"wheelbase_m": format.wheelbase_m, "turn_unit": format.turn_unit}
    yield "odometry", lambda: read_odometry(str(files.odometry), format.of("odometry"), **how)
    columns = dict(format.of("imu").columns)
    yield "imu", lambda: read_inertial(str(files.imu), columns=columns, turn_unit=format.turn_unit)
    yield "imu_frame", lambda: read_frame(str(files.imu_frame))
