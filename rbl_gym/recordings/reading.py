"""Read measurement logs: text files of anchors, tags, ranges, truth and calibration.

Every file has a header line; columns may be in any order. Unused columns are ignored and reported.
Cells are separated by commas, semicolons, tabs or white space. UTF-8 with or without a byte order
mark, any line ending. Blank lines and lines that start with ``#`` are skipped, except for a header.
Errors in a file raise a ValueError that names the file, the line, the column and the value.
"""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.measurements.inertial import turned
from rbl_gym.recordings.calibration import calibrated
from rbl_gym.recordings.directions import read_directions
from rbl_gym.recordings.format import Format
from rbl_gym.recordings.inertial import InertialLog, read_frame, read_inertial
from rbl_gym.recordings.odometry import read_odometry
from rbl_gym.recordings.points import read_points
from rbl_gym.recordings.ranges import Log, read_log
from rbl_gym.recordings.recording import Recording
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import AnyPath, Table, read_table
from rbl_gym.recordings.truth import Truth, read_truth, truth_at
from rbl_gym.recordings.units import check_units

__all__ = ["read_recording", "read_runs"]

_AS_DESCRIBED = Format()
# Longest gap between two poses of a carrier that is interpolated (s).
_CARRIER_GAP_S = 1.0


class _Files(NamedTuple):
    ranges: AnyPath
    anchors: AnyPath | None
    tags: AnyPath | None
    truth: AnyPath | None
    calibration: AnyPath | None
    carrier: AnyPath | None
    relative: bool
    odometry: AnyPath | None = None
    imu: AnyPath | None = None
    imu_frame: AnyPath | None = None
    directions: AnyPath | None = None


def read_recording(
    ranges: AnyPath,
    anchors: AnyPath | None = None,
    tags: AnyPath | None = None,
    truth: AnyPath | None = None,
    calibration: AnyPath | None = None,
    *,
    carrier: AnyPath | None = None,
    relative: bool = False,
    odometry: AnyPath | None = None,
    imu: AnyPath | None = None,
    imu_frame: AnyPath | None = None,
    directions: AnyPath | None = None,
    run: str | None = None,
    format: Format = _AS_DESCRIBED,
) -> Recording:
    """Read a measurement log from its files.

    Parameters
    ----------
    ranges
        Long, ``t,anchor,tag,range[,std or var][,valid][,run]``: rows with equal `t` form an epoch.
        If `valid` (0 or 1) is 0, range and std may be any number or empty. Or wide,
        ``t,a{anchor}t{tag},...``: a row is an epoch. Seconds and metres. A link is missing if its
        range is empty, or if it has no row or column. Without `anchors`, every row holds the
        position of the anchor: ``ax,ay[,az]``. Or differences of the distances to two anchors,
        ``t,anchor_a,anchor_b,tag,difference[,std or var]``, the distance to `anchor_a` minus the
        distance to `anchor_b`. They become ranges with one unknown offset per tag.
    anchors, tags
        ``anchor,x,y,z`` and ``tag,x,y,z`` (or ``id,x,y,z``), metres; ids are any unique text.
        Moving anchors have a row for every position and time: ``anchor,t,x,y,z``. Without `tags`
        there is one tag, at the origin of the body frame.
    truth
        File for `rbl_gym.recordings.read_truth`: ``t,x,y,z,qw,qx,qy,qz``, TUM, EuRoC/ASL,
        positions with a heading, or positions only.
    calibration
        ``anchor,tag,bias_m[,slope][,sigma_m]``: ``(range - bias) / (1 + slope)`` replaces the
        range of that link and ``std / (1 + slope)`` its std. A corrected range that is not
        positive becomes a missing link. Links without a row are unchanged; `sigma_m` is not read.
    carrier
        Poses of a body that carries the anchors, in the formats of `truth`. `anchors` is then in
        the frame of this body. May be the file of the ranges.
    relative
        Estimate the pose in the frame of the `carrier`. The anchors are fixed in this frame, and
        the truth is taken relative to it.
    odometry
        File for `rbl_gym.recordings.read_odometry`: ``t,vx,vy,vz,wx,wy,wz``, or the speeds of two
        wheels.
    imu, imu_frame
        File for `rbl_gym.recordings.read_inertial`, ``t,wx,wy,wz,ax,ay,az``, and the argument of
        `read_frame`: the rotation from its axes to those of the body.
    directions
        File for `rbl_gym.recordings.read_directions`: bias by the direction of the ray at its ends.
        It becomes part of the measurement model; the ranges are not corrected.
    run
        The run to read, if the file holds several (column `run`); see `read_runs`.
    format
        The format of the files, if it differs from the above.

    Returns
    -------
    recording
        The log. Its `report` lists the changes. Invalid ranges (zero, negative, NaN, above 10 km,
        unknown anchors or tags) are dropped and counted by cause. Rows late by at most one second
        are sorted. Duplicate rows are dropped. Units that are not given are detected.

    Raises
    ------
    ValueError
        If a file is not as described, more than a fifth of the ranges are invalid, the units do
        not fit together, or no epoch has a link. With `format.strict`, also at the first range or
        row that would be dropped or sorted.
    """
    files = _Files(
        ranges, anchors, tags, truth, calibration, carrier, relative, odometry, imu, imu_frame,
        directions,
    )  # fmt: skip
    said = Said()
    table = read_table(ranges, format.of("ranges"))
    runs = _runs_of(table)
    if run is None and len(runs) > 1:
        raise ValueError(
            f"{table.path}: has {len(runs)} runs, {[*runs]!r:.200}; choose one with run, or read "
            "all with read_runs"
        )
    if run is not None:
        if run not in runs:
            raise ValueError(f"{table.path}: has no run {run!r}, got {[*runs]!r:.200}")
        table = table.select(runs[run])
    return _read(files, table, run, format, said)


def read_runs(
    ranges: AnyPath,
    anchors: AnyPath | None = None,
    tags: AnyPath | None = None,
    truth: AnyPath | None = None,
    calibration: AnyPath | None = None,
    *,
    carrier: AnyPath | None = None,
    relative: bool = False,
    odometry: AnyPath | None = None,
    imu: AnyPath | None = None,
    imu_frame: AnyPath | None = None,
    directions: AnyPath | None = None,
    format: Format = _AS_DESCRIBED,
) -> dict[str, Recording]:
    """Read the runs of a log, each as a recording, keyed by column `run` in the order of the file.

    Arguments as in `read_recording`, with the same errors. A log without this column is one run
    with the name ``""``. If the truth has this column too, each run has its own truth. A truth
    without time and with a single pose per run belongs to a body at rest.
    """
    files = _Files(
        ranges, anchors, tags, truth, calibration, carrier, relative, odometry, imu, imu_frame,
        directions,
    )  # fmt: skip
    table = read_table(ranges, format.of("ranges"))
    runs = _runs_of(table)
    return {
        run: _read(files, table if rows.all() else table.select(rows), run or None, format, Said())
        for run, rows in runs.items()
    }


def _runs_of(table: Table) -> dict[str, np.ndarray]:
    """Return the rows (rows,) of each run."""
    if "run" not in table.columns:
        return {"": np.ones(len(table.lines), dtype=bool)}
    names = np.array(table.text("run"))
    return {name: names == name for name in dict.fromkeys(names.tolist())}


def _read(files: _Files, table: Table, run: str | None, format: Format, said: Said) -> Recording:
    """Read one run."""
    anchors, tags = (
        None if path is None else read_points(path, kind, format.of(f"{kind}s"), said)
        for kind, path in (("anchor", files.anchors), ("tag", files.tags))
    )
    if files.carrier is not None and anchors is None:
        raise ValueError(
            "carrier needs anchors: a table of the anchors in the frame of the carrier"
        )
    if files.relative and files.carrier is None:
        raise ValueError("relative needs a carrier")
    log = read_log(table, anchors, tags, format, said)
    ids = log.anchors.ids, log.tags.ids
    if files.calibration is not None:
        biases = read_table(files.calibration, format.of("calibration"))
        if log.offset is not None:
            raise ValueError(
                "calibration must be left out for ranges with an unknown common offset"
            )
        ranges, std = calibrated(log.ranges, log.range_std, biases, ids, said)
        log = log._replace(ranges=ranges, links=ranges > 0, range_std=std)
    places = log.anchors.places if log.anchors.tracks is None else log.anchor_places
    poses = None
    if files.truth is not None:
        poses = read_truth(files.truth, format.of("truth"), said, run=run, times=log.times)
    if files.carrier is not None:
        frame = read_truth(files.carrier, format.of("carrier"), said, run=run, times=log.times)
        if not files.relative:
            log, places = _carried(log, places, frame, said, os.fspath(files.carrier))
        elif poses is not None:
            poses = _seen_from(frame, poses, os.fspath(files.carrier))
    odometry = None
    if files.odometry is not None:
        how = {"wheelbase_m": format.wheelbase_m, "turn_unit": format.turn_unit}
        odometry = read_odometry(files.odometry, format.of("odometry"), said, **how)
    law = None
    if files.directions is not None:
        law = read_directions(files.directions, ids, format.of("directions"), said)
    links = log.links
    if not links.any():
        raise ValueError(f"{table.path}: must have at least one usable range, got none")
    paths = [table.path if p is None else os.fspath(p) for p in files[:3]]
    how = "carried" if files.carrier else "stand" if log.anchors.tracks is None else "move"
    points = log.anchors.places, log.tags.places
    if log.offset is None:
        check_units((paths[0], paths[1], paths[2]), log.times, log.ranges, links, *points, how)
    return Recording(
        log.times, log.ranges, links, log.range_std, places, log.tags.places, *ids, poses,
        said.report(), log.offset, odometry, _inertial(files, format), law,
    )  # fmt: skip


def _inertial(files: _Files, format: Format) -> InertialLog | None:
    """Return the readings of the inertial sensor in body axes."""
    if files.imu is None:
        if files.imu_frame is not None:
            raise ValueError("imu_frame needs imu")
        return None
    columns = dict(format.of("imu").columns)
    log = read_inertial(files.imu, columns=columns, turn_unit=format.turn_unit)
    if files.imu_frame is None:
        return log
    return log._replace(readings=turned(log.readings, read_frame(files.imu_frame)))


def _carried(
    log: Log, arms: FloatArray, carrier: Truth, said: Said, path: str
) -> tuple[Log, FloatArray]:
    """Return anchors (K, M, 3) in the world frame, and the epochs with a known carrier pose."""
    rotation, translation, known = _frame_at(carrier, log.times, path)
    places = np.swapaxes(rotation @ np.swapaxes(arms, -1, -2), -1, -2) + translation[:, None]
    if not known.all():
        lost = int(log.links[~known].sum())
        said.drop("where the carrier's pose is not known", lost)
        said.note(path, f"{lost} ranges are left out where the carrier's pose is not known")
    std = None if log.range_std is None else log.range_std[known]
    kept = [a[known] for a in (log.times, log.ranges, log.links)]
    log = log._replace(times=kept[0], ranges=kept[1], links=kept[2], range_std=std)
    return log, places[known]


def _seen_from(carrier: Truth, truth: Truth, path: str) -> Truth:
    """Return poses in the frame of the carrier, at times when its own pose is known."""
    rotation, translation, known = _frame_at(carrier, truth.times, path)
    back = np.swapaxes(rotation, -1, -2)
    shift = (back @ (truth.translation - translation)[..., None])[..., 0]
    turned = None if truth.rotation is None else (back @ truth.rotation)[known]
    planar = truth.planar or carrier.planar
    return Truth(truth.times[known], turned, shift[known], planar, truth.form)


def _frame_at(
    carrier: Truth, times: FloatArray, path: str
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return rotation and translation of the carrier (K, ...), and a mask of known poses."""
    rotation, translation, known = truth_at(carrier, times, _CARRIER_GAP_S)
    if rotation is None:
        raise ValueError(f"{path}: the poses of a carrier must have rotations, got only positions")
    if not known.any():
        spans = [f"{t[0]:.10g} to {t[-1]:.10g} s" for t in (times, carrier.times)]
        raise ValueError(
            f"{path}: the carrier has no pose at any time of the ranges: ranges {spans[0]}, poses "
            f"{spans[1]}"
        )
    return rotation, translation, known
