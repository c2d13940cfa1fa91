"""Read measurement logs: text files of anchors, tags, ranges, truth and calibration.

Every file has a header line; columns may be in any order. Unused columns are ignored and reported.
Cells are separated by commas, semicolons, tabs or white space. UTF-8 with or without a byte order
mark, any line ending. Blank lines and lines that start with ``#`` are skipped, except for a header.
Errors in a file raise a ValueError that names the file, the line, the column and the value.
"""

from __future__ import annotations

import os

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.measurements.inertial import turned
from rbl_gym.recordings.calibration import calibrated
from rbl_gym.recordings.directions import read_directions
from rbl_gym.recordings.faults import every_fault
from rbl_gym.recordings.format import Files, Format
from rbl_gym.recordings.inertial import InertialLog, read_frame, read_inertial
from rbl_gym.recordings.odometry import read_odometry
from rbl_gym.recordings.points import read_points
from rbl_gym.recordings.ranges import Log, read_log
from rbl_gym.recordings.recording import Recording
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import Table, read_table
from rbl_gym.recordings.truth import Truth, read_truth, truth_at
from rbl_gym.recordings.units import check_units

__all__ = ["read_recording", "read_runs"]

_AS_DESCRIBED = Format()
# Longest gap between two poses of a carrier that is interpolated (s).
_CARRIER_GAP_S = 1.0


def read_recording(
    files: Files, run: str | None = None, format: Format = _AS_DESCRIBED
) -> Recording:
    """Read a measurement log from its files.

    Parameters
    ----------
    files
        The files, such as ``Files("ranges.csv", "anchors.csv", "tags.csv", truth="truth.csv")``.
    run
        The run to read, if the file holds several (column `run`); see `read_runs`.
    format
        Differences of the files from the form that `Files` describes.

    Returns
    -------
    recording
        The log. Its `report` lists the changes. Invalid ranges (zero, negative, NaN, above 10 km,
        unknown anchors or tags) are dropped and counted by cause. Rows late by at most one second
        are sorted. Duplicate rows are dropped. Units that are not given are detected.

    Raises
    ------
    ValueError
        If a file is not as described (the message names every wrong file), more than a fifth of
        the ranges are invalid, the units do not fit together, or no epoch has a link. With
        `format.strict`, also at the first range or row that would be dropped or sorted.
    """
    if not isinstance(run, str | None):
        raise TypeError(
            f"run must be the name of a run or None, got {run!r:.80}; give the format by name: "
            "read_recording(files, format=...)"
        )
    _check_format(format)
    with every_fault(files, format):
        table, runs = _runs_of(files, format)
        if run is None and len(runs) > 1:
            raise ValueError(
                f"{table.path}: has {len(runs)} runs, {[*runs]!r:.200}; choose one with run, or "
                "read all with read_runs"
            )
        if run is not None:
            if run not in runs:
                named = f"got {[*runs]!r:.200}"
                held = named if "run" in table.columns else "as it has no column run"
                raise ValueError(f"{table.path}: has no run {run!r}, {held}")
            table = table.select(runs[run])
        return _read(files, table, run, format)


def read_runs(files: Files, format: Format = _AS_DESCRIBED) -> dict[str, Recording]:
    """Read the runs of a log, each as a recording, keyed by column `run` in the order of the file.

    Arguments as in `read_recording`, with the same errors. A log without this column is one run
    with the name ``""``. If the truth has this column too, each run has its own truth. A truth
    without time and with a single pose per run belongs to a body at rest.
    """
    _check_format(format)
    with every_fault(files, format):
        table, runs = _runs_of(files, format)
        return {
            run: _read(files, table if rows.all() else table.select(rows), run or None, format)
            for run, rows in runs.items()
        }


def _check_format(format: Format) -> None:
    if not isinstance(format, Format):
        raise TypeError(f"format must be recordings.Format(columns={{...}}), got {format!r:.80}")


def _runs_of(files: Files, format: Format) -> tuple[Table, dict[str, np.ndarray]]:
    """Return the table of ranges, and the rows (rows,) of each run."""
    if not isinstance(files, Files):
        raise TypeError(f"files must be recordings.Files(ranges, anchors, ...), got {files!r:.80}")
    table = read_table(files.ranges, format.of("ranges"))
    if "run" not in table.columns:
        return table, {"": np.ones(len(table.lines), dtype=bool)}
    names = np.array(table.text("run"))
    return table, {name: names == name for name in dict.fromkeys(names.tolist())}


def _read(files: Files, table: Table, run: str | None, format: Format) -> Recording:
    """Read one run."""
    said = Said()
    anchors, tags = (
        None if path is None else read_points(path, kind, format.of(f"{kind}s"), said)
        for kind, path in (("anchor", files.anchors), ("tag", files.tags))
    )
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
    paths = [
        table.path if p is None else os.fspath(p) for p in (files.ranges, files.anchors, files.tags)
    ]
    how = "carried" if files.carrier else "stand" if log.anchors.tracks is None else "move"
    points = log.anchors.places, log.tags.places
    if log.offset is None:
        check_units((paths[0], paths[1], paths[2]), log.times, log.ranges, links, *points, how)
    return Recording(
        log.times, log.ranges, links, log.range_std, places, log.tags.places, *ids, poses,
        said.report(), log.offset, odometry, _inertial(files, format), law,
    )  # fmt: skip


def _inertial(files: Files, format: Format) -> InertialLog | None:
    """Return the readings of the inertial sensor in body axes."""
    if files.imu is None:
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
    times, ranges, links = log.times[known], log.ranges[known], log.links[known]
    log = log._replace(times=times, ranges=ranges, links=links, range_std=std)
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
