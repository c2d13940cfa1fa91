"""Real measurement logs: text files of anchors, tags, ranges, truth and calibration as arrays.

Every file has a header line; columns may come in any order, and those that nobody asks for are
left alone and named. Between cells stand commas, semicolons, tabs or white space. UTF-8 with or
without a byte order mark, any line ending; blank lines and lines that start with ``#`` are
skipped, but for a header. Whatever is wrong in a file is a ValueError that names the file, the
line, the column and the value that came.
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
# Longest gap between two poses of a carrier that is bridged (s).
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
        Long, ``t,anchor,tag,range[,std or var][,valid][,run]``: rows of equal `t` make an epoch;
        where `valid` (0 or 1) is 0, range and std may be any number or empty. Or wide,
        ``t,a{anchor}t{tag},...``: a row is an epoch. Seconds and metres. A link whose range is
        empty, or that has no row or column, is missing. Without `anchors`, the place of the
        anchor stands beside every range: ``ax,ay[,az]``. Or differences of the distances to two
        anchors, ``t,anchor_a,anchor_b,tag,difference[,std or var]``, that of `anchor_a` less that
        of `anchor_b`: they become ranges with an unknown offset of the tag.
    anchors, tags
        ``anchor,x,y,z`` and ``tag,x,y,z`` (or ``id,x,y,z``), metres; ids are any unique text.
        Anchors that move have a row for every place and time: ``anchor,t,x,y,z``. Without `tags`
        there is one tag, at the body's origin.
    truth
        As of `rbl_gym.recordings.read_truth`: ``t,x,y,z,qw,qx,qy,qz``, TUM, EuRoC/ASL, a
        heading or positions alone.
    calibration
        ``anchor,tag,bias_m[,slope][,sigma_m]``: ``(range - bias) / (1 + slope)`` replaces the
        range of that link and ``std / (1 + slope)`` its std. A corrected range that is not
        positive cannot be a distance and becomes a missing link. Links without a row stay as
        they are; `sigma_m` is not read.
    carrier
        Poses, as of `truth`, of a body that carries the anchors: `anchors` is in its frame then.
        May be the file of the ranges.
    relative
        Of a `carrier`: the body's pose is wanted in the carrier's frame. The anchors stay where
        they are on it, and the truth is taken relative to it.
    odometry
        As of `rbl_gym.recordings.read_odometry`: ``t,vx,vy,vz,wx,wy,wz``, or speeds of two wheels.
    imu, imu_frame
        As of `rbl_gym.recordings.read_inertial`, ``t,wx,wy,wz,ax,ay,az``, and of `read_frame`: the
        rotation of its axes into the body's.
    directions
        As of `rbl_gym.recordings.read_directions`: bias by the direction of the ray at its ends.
        It is a part of the measurement model, and not taken off the ranges.
    run
        Of several runs in one file (column `run`) the one to read; see `read_runs`.
    format
        How the files are written, where not as above.

    Returns
    -------
    recording
        The log. Its `report` says what became of it: ranges that are no measurement (zero,
        negative, NaN, above 10 km, of unknown anchors or tags) are dropped and counted by cause,
        rows late by a second at most are sorted, rows that come twice are dropped, units that
        nobody tells are found.

    Raises
    ------
    ValueError
        If a file is not as described, if more than a fifth of the ranges are no measurement, if
        units do not fit together, or if no epoch has a link; with `format.strict`, at the first
        range or row that would be dropped or sorted.
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
            f"{table.path}: has {len(runs)} runs, {[*runs]!r:.200}; read one of them by run, or "
            "all by read_runs"
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
    """The runs of a log, each a recording, by the names in column `run` and in their order.

    Arguments as of `read_recording`, and so the errors. A log without that column is one run with
    the name ``""``. A truth with that column too is each run's own; one without time and with a
    single pose of a run is of a body that stands.
    """
    files = _Files(
        ranges, anchors, tags, truth, calibration, carrier, relative, odometry, imu, imu_frame,
        directions,
    )  # fmt: skip
    table = read_table(ranges, format.of("ranges"))
    runs = _runs_of(table)
    return {
        run: _read(files, table.select(rows), run or None, format, Said())
        for run, rows in runs.items()
    }


def _runs_of(table: Table) -> dict[str, np.ndarray]:
    """Which rows (rows,) each run has."""
    if "run" not in table.columns:
        return {"": np.ones(len(table.lines), dtype=bool)}
    names = np.array(table.text("run"))
    return {name: names == name for name in dict.fromkeys(names.tolist())}


def _read(files: _Files, table: Table, run: str | None, format: Format, said: Said) -> Recording:
    """One run."""
    anchors, tags = (
        None if path is None else read_points(path, kind, format.of(f"{kind}s"), said)
        for kind, path in (("anchor", files.anchors), ("tag", files.tags))
    )
    if files.carrier is not None and anchors is None:
        raise ValueError("carrier needs a table of anchors, in the carrier's frame")
    if files.relative and files.carrier is None:
        raise ValueError("relative needs a carrier")
    log = read_log(table, anchors, tags, format, said)
    ids = log.anchors.ids, log.tags.ids
    if files.calibration is not None:
        biases = read_table(files.calibration, format.of("calibration"))
        if log.offset is not None:
            raise ValueError("calibration is of ranges, and these have an unknown offset in common")
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
        raise ValueError(f"{table.path}: must have an epoch with a link, got none")
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
    """Readings of the inertial sensor in the body's axes."""
    if files.imu is None:
        if files.imu_frame is not None:
            raise ValueError("imu_frame means nothing without imu")
        return None
    columns = dict(format.of("imu").columns)
    log = read_inertial(files.imu, columns=columns, turn_unit=format.turn_unit)
    if files.imu_frame is None:
        return log
    return log._replace(readings=turned(log.readings, read_frame(files.imu_frame)))


def _carried(
    log: Log, arms: FloatArray, carrier: Truth, said: Said, path: str
) -> tuple[Log, FloatArray]:
    """Anchors (K, M, 3) in the world, and the log without epochs whose carrier is nowhere."""
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
    """Poses in the carrier's frame, where its own are known."""
    rotation, translation, known = _frame_at(carrier, truth.times, path)
    back = np.swapaxes(rotation, -1, -2)
    shift = (back @ (truth.translation - translation)[..., None])[..., 0]
    turned = None if truth.rotation is None else (back @ truth.rotation)[known]
    planar = truth.planar or carrier.planar
    return Truth(truth.times[known], turned, shift[known], planar, truth.form)


def _frame_at(
    carrier: Truth, times: FloatArray, path: str
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Rotation and translation of the carrier (K, ...), and where they are known."""
    rotation, translation, known = truth_at(carrier, times, _CARRIER_GAP_S)
    if rotation is None:
        raise ValueError(f"{path}: a carrier needs rotations, got positions alone")
    if not known.any():
        spans = [f"{t[0]:.10g} to {t[-1]:.10g} s" for t in (times, carrier.times)]
        raise ValueError(
            f"{path}: the carrier's pose is known at no time wanted: those are {spans[0]}, its "
            f"poses {spans[1]}"
        )
    return rotation, translation, known
