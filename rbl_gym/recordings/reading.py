"""Real measurement logs: CSV files of anchors, tags, ranges, truth and calibration as arrays.

Every file has a header line; columns may come in any order. UTF-8 with or without a byte order
mark, any line ending; blank lines and lines that start with ``#`` are skipped. Whatever is wrong
in a file is a ValueError that names the file, the line, the column and the value that came.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbl_gym import motion
from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number
from rbl_gym.geometry import rotations
from rbl_gym.recordings.units import check_units

__all__ = ["Recording", "Truth", "read_recording", "truth_at"]

AnyPath = str | os.PathLike[str]
IntArray = NDArray[np.intp]
_Ids = tuple[tuple[str, ...], tuple[str, ...]]  # of the anchors, of the tags
_Log = tuple[FloatArray, FloatArray, FloatArray | None]  # times, ranges (0: no link), range_std

_MAX_RANGE_M = 10e3
_MAX_COORDINATE_M = 1e8  # geocentric and map coordinates are in the world frame
_MAX_TAG_M = 1e4
_MAX_TIME_S = 1e11  # the year 5138
_MAX_YAW_DEG = 1e6
_TOO_LONG = f"must be at most {_MAX_RANGE_M:.0f} m (looks like millimetres?)"


class Truth(NamedTuple):
    """Reference poses of the body, ``p_world = rotation @ p_body + translation``."""

    times: FloatArray  # (L,) seconds, strictly increasing
    rotation: FloatArray  # (L, 3, 3)
    translation: FloatArray  # (L, 3) metres


class Recording(NamedTuple):
    """Ranges between M anchors and N tags over K epochs, and what is known beside them."""

    times: FloatArray  # (K,) seconds, strictly increasing, at any spacing
    ranges: FloatArray  # (K, M, N) metres, 0 where there is no link
    links: BoolArray  # (K, M, N) True where a range was measured
    range_std: FloatArray | None  # (K, M, N) metres, 0 where no link; None: not in the log
    anchors: FloatArray  # (M, 3) metres, world frame
    tags: FloatArray  # (N, 3) metres, body frame
    anchor_ids: tuple[str, ...]  # in the order of `anchors`
    tag_ids: tuple[str, ...]  # in the order of `tags`
    truth: Truth | None  # at times of its own, see `truth_at`


def read_recording(
    ranges: AnyPath,
    anchors: AnyPath,
    tags: AnyPath,
    truth: AnyPath | None = None,
    calibration: AnyPath | None = None,
) -> Recording:
    """Read a measurement log from its CSV files.

    Parameters
    ----------
    ranges
        Long, ``t,anchor,tag,range[,std][,valid]``: rows of equal `t` make an epoch, `t` does not
        decrease; where `valid` (0 or 1) is 0, range and std may be any number or empty. Or wide,
        ``t,a{anchor}t{tag},...``: a row is an epoch, `t` increases. Seconds and metres. A link
        whose range is empty, or that has no row or column, is missing.
    anchors, tags
        ``anchor,x,y,z`` and ``tag,x,y,z`` (or ``id,x,y,z``), metres; ids are any unique text.
    truth
        ``t,x,y,z,qw,qx,qy,qz`` or, planar, ``t,x,y[,z],yaw_deg`` with z = 0 where absent.
        Quaternions may be off unit norm by 0.01 and are normalised.
    calibration
        ``anchor,tag,bias_m,slope[,sigma_m]``: ``(range - bias) / (1 + slope)`` replaces the
        range of that link and ``std / (1 + slope)`` its std. A corrected range that is not
        positive cannot be a distance and becomes a missing link. Links without a row stay as
        they are; `sigma_m` is not read.

    Raises
    ------
    ValueError
        If a file is not as described or holds values that cannot be (NaN, ranges that are not
        positive, units that do not fit together), or if no epoch has a link.
    """
    anchor_ids, anchor_points = _read_points(anchors, "anchor")
    tag_ids, tag_points = _read_points(tags, "tag")
    ids = anchor_ids, tag_ids
    table = _read_table(ranges)
    is_wide = table.columns.keys().isdisjoint(("anchor", "tag", "range"))
    times, measured, std = (_read_wide if is_wide else _read_long)(table, ids)
    if calibration is not None:
        measured, std = _calibrated(measured, std, _read_table(calibration), ids)
    links = measured > 0
    if not links.any():
        raise ValueError(f"{table.path}: must have an epoch with a link, got none")
    paths = table.path, os.fspath(anchors), os.fspath(tags)
    check_units(paths, times, measured, links, anchor_points, tag_points)
    poses = None if truth is None else _read_truth(_read_table(truth))
    return Recording(times, measured, links, std, anchor_points, tag_points, *ids, poses)


def truth_at(
    truth: Truth, times: ArrayLike, max_gap_s: float = 0.5
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Truth at other times: linear in position, along the geodesic in rotation.

    Parameters
    ----------
    truth, times
        Reference poses; the times they are wanted at, (..., K) seconds.
    max_gap_s
        Longest gap between two reference poses that is bridged, seconds.

    Returns
    -------
    rotation, translation
        (..., K, 3, 3) and (..., K, 3) metres; finite but meaningless where not `valid`.
    valid
        (..., K) False outside the truth's time span and inside a gap longer than `max_gap_s`.

    Raises
    ------
    ValueError
        If `times` is empty or not finite, or `max_gap_s` is negative.
    """
    times = check_array("times", times, ("K",))
    max_gap_s = check_number("max_gap_s", max_gap_s, low=0.0)
    last = len(truth.times) - 1
    left = np.clip(np.searchsorted(truth.times, times, side="right") - 1, 0, last)
    right = np.minimum(left + 1, last)
    elapsed, gap = times - truth.times[left], truth.times[right] - truth.times[left]
    path = motion.interpolate(*truth, times)
    inside = (times >= truth.times[0]) & (times <= truth.times[-1])
    return path.rotation, path.translation, inside & ((gap <= max_gap_s) | (elapsed == 0))


class _Table(NamedTuple):
    """Cells of a CSV file by column, the line of the header and the lines of the rows."""

    path: str
    header_line: int
    lines: list[int]
    columns: dict[str, tuple[str, ...]]

    def check_columns(self, required: Iterable[str], optional: Iterable[str] = ()) -> None:
        """Raise unless all of `required` and nothing beyond `optional` is there."""
        required, got = list(required), list(self.columns)
        known = [*required, *optional]
        missing = [name for name in required if name not in got]
        unknown = [name for name in got if name not in known]
        if wrong := missing + unknown:
            what = f"{'missing' if missing else 'unknown'} column {wrong[0]!r}"
            where = f"{self.path}, line {self.header_line}"
            raise ValueError(f"{where}: {what}, must be of {known!r:.200}, got {got!r:.200}")

    def check(self, ok: BoolArray, column: str, must: str, got: Any = None) -> None:
        """Raise at the first row where `ok` is False; `got` replaces the cells in the message."""
        if not ok.all():
            row = int(np.argmin(ok))
            value = repr(self.columns[column][row]) if got is None else str(got[row])
            where = f"{self.path}, line {self.lines[row]}, column {column!r}"
            raise ValueError(f"{where}: {must}, got {value:.80}")

    def numbers(self, column: str, *, may_be_empty: bool = False) -> FloatArray:
        """(rows,) finite numbers, NaN for empty cells where these are allowed."""
        cells = self.columns[column]
        values = np.array([_number(cell) for cell in cells])
        ok = np.isfinite(values)
        if may_be_empty and not ok.all():
            ok |= np.array([not cell for cell in cells])
        self.check(ok, column, "must be a finite number")
        return values

    def times(self, *, may_repeat: bool = False) -> FloatArray:
        """(rows,) column `t`, increasing."""
        times = self.numbers("t")
        too_late = f"must be at most {_MAX_TIME_S:g} s (looks like milliseconds?)"
        self.check(np.abs(times) <= _MAX_TIME_S, "t", too_late)
        step = np.diff(times, prepend=-np.inf)
        ok, must = (step >= 0, "not decrease") if may_repeat else (step > 0, "increase")
        self.check(ok, "t", f"time must {must} from row to row")
        return times

    def points(self, columns: Iterable[str], most: float = _MAX_COORDINATE_M) -> FloatArray:
        """(rows, len(columns)) coordinates in metres, of magnitude `most` at most."""
        points = {column: self.numbers(column) for column in columns}
        too_far = f"must be at most {most:.0f} m (looks like millimetres?)"
        for column, values in points.items():
            self.check(np.abs(values) <= most, column, too_far)
        return np.stack([*points.values()], axis=-1)

    def ranges(self, column: str, valid: ArrayLike = 1) -> FloatArray:
        """(rows,) metres, 0 where the cell is empty or `valid` is 0."""
        ranges = self.numbers(column, may_be_empty=True)
        unused = np.isnan(ranges) | np.equal(valid, 0)
        self.check((ranges > 0) | unused, column, "range must be positive")
        self.check((ranges <= _MAX_RANGE_M) | unused, column, _TOO_LONG)
        return np.where(unused, 0.0, ranges)

    def links(self, ids: _Ids, epoch: IntArray | int = 0) -> tuple[IntArray, IntArray]:
        """Anchor and tag indices (rows,), every link at most once in an `epoch`."""
        anchor, tag = self.positions("anchor", ids[0]), self.positions("tag", ids[1])
        numbered = (epoch * len(ids[0]) + anchor) * len(ids[1]) + tag
        pairs = [*zip(self.columns["anchor"], self.columns["tag"], strict=True)]
        self.check(_is_first(numbered), "tag", "each link may come once at a time", got=pairs)
        return anchor, tag

    def positions(self, column: str, ids: tuple[str, ...]) -> IntArray:
        """(rows,) where in `ids` the cells of `column` stand."""
        index = {name: i for i, name in enumerate(ids)}
        positions = np.array([index.get(cell.strip(), -1) for cell in self.columns[column]])
        self.check(positions >= 0, column, f"unknown {column}, must be of {ids!r:.200}")
        return positions


def _read_table(path: AnyPath) -> _Table:
    name, lines, rows = os.fspath(path), [], []
    # A comment is turned into a blank line, an empty row: line numbers stay those of the file.
    text = ("" if line.lstrip()[:1] in ("", "#") else line for line in _read_lines(name))
    reader = csv.reader(text, skipinitialspace=True, strict=True)
    try:
        for row in filter(None, reader):
            rows.append(row)
            lines.append(reader.line_num)
            if len(row) != len(rows[0]):
                raise csv.Error(f"must have {len(rows[0])} cells like the header, got {len(row)}")
    except csv.Error as error:
        raise ValueError(f"{name}, line {reader.line_num}: {error}") from error
    if len(rows) < 2:
        raise ValueError(f"{name}: must have a header and rows, got {len(rows)} lines")
    header = [cell.strip() for cell in rows[0]]
    if not (first := _is_first(header)).all():
        column = header[first.argmin()]
        raise ValueError(f"{name}, line {lines[0]}: column {column!r} comes twice")
    columns = dict(zip(header, zip(*rows[1:], strict=True), strict=True))
    return _Table(name, lines[0], lines[1:], columns)


def _read_lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8-sig").split("\n")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read, {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: must be UTF-8 text, {error.reason} at {error.start}") from error


def _number(cell: str) -> float:
    try:
        return np.nan if "_" in cell or not cell else float(cell)  # float() reads 1_000
    except ValueError:
        return np.nan


def _is_first(values: ArrayLike) -> BoolArray:
    """(rows,) False where a value has come before."""
    values, first = np.asarray(values), np.unique(values, return_index=True)[1]
    return np.isin(np.arange(len(values)), first)


def _read_points(path: AnyPath, kind: str) -> tuple[tuple[str, ...], FloatArray]:
    table = _read_table(path)
    column = "id" if next(iter(table.columns)) == "id" else kind
    table.check_columns((column, "x", "y", "z"))
    ids = tuple(cell.strip() for cell in table.columns[column])
    table.check(np.array([*map(bool, ids)]), column, "id must not be empty")
    table.check(_is_first(ids), column, "id must be unique")
    return ids, table.points("xyz", _MAX_TAG_M if kind == "tag" else _MAX_COORDINATE_M)


def _read_wide(table: _Table, ids: _Ids) -> _Log:
    names = [f"a{anchor}t{tag}" for anchor in ids[0] for tag in ids[1]]
    if not (first := _is_first(names)).all():
        name = names[first.argmin()]
        raise ValueError(f"{table.path}: column {name!r} fits two pairs, use a long table")
    table.check_columns(("t",), names)
    times = table.times()
    ranges = np.zeros((len(times), len(names)))
    for link, name in enumerate(names):
        if name in table.columns:
            ranges[:, link] = table.ranges(name)
    return times, ranges.reshape(len(times), len(ids[0]), len(ids[1])), None


def _read_long(table: _Table, ids: _Ids) -> _Log:
    table.check_columns(("t", "anchor", "tag", "range"), ("std", "valid"))
    times = table.times(may_repeat=True)
    starts = np.diff(times, prepend=-np.inf) > 0
    epoch = np.cumsum(starts) - 1
    cells = (epoch, *table.links(ids, epoch))
    valid = table.numbers("valid") if "valid" in table.columns else np.ones(len(times))
    table.check(np.isin(valid, (0, 1)), "valid", "must be 0 or 1")
    measured = table.ranges("range", valid)
    ranges, range_std = np.zeros((epoch[-1] + 1, len(ids[0]), len(ids[1]))), None
    ranges[cells] = measured
    if "std" in table.columns:
        std = table.numbers("std", may_be_empty=True)
        table.check((std > 0) | (measured == 0), "std", "must be positive")
        table.check((std <= _MAX_RANGE_M) | (measured == 0), "std", _TOO_LONG)
        range_std = np.zeros_like(ranges)
        range_std[cells] = np.where(measured > 0, std, 0.0)
    return times[starts], ranges, range_std


def _calibrated(
    ranges: FloatArray, std: FloatArray | None, table: _Table, ids: _Ids
) -> tuple[FloatArray, FloatArray | None]:
    table.check_columns(("anchor", "tag", "bias_m", "slope"), ("sigma_m",))
    link = table.links(ids)
    slope = table.numbers("slope")
    table.check(slope > -1, "slope", "must be above -1")
    bias, scale = np.zeros(ranges.shape[1:]), np.ones(ranges.shape[1:])
    bias[link], scale[link] = table.numbers("bias_m"), 1 + slope
    with np.errstate(over="ignore"):
        corrected = (ranges - bias) / scale
    too_long = f"corrected ranges {_TOO_LONG}"
    table.check(corrected.max(axis=0)[link] <= _MAX_RANGE_M, "bias_m", too_long)
    links = (ranges > 0) & (corrected > 0)
    std = None if std is None else np.where(links, std / scale, 0.0)
    return np.where(links, corrected, 0.0), std


def _read_truth(table: _Table) -> Truth:
    if "yaw_deg" in table.columns:
        table.check_columns(("t", "x", "y", "yaw_deg"), ("z",))
        yaw = table.numbers("yaw_deg")
        must = f"must be at most {_MAX_YAW_DEG:g} in magnitude"
        table.check(np.abs(yaw) <= _MAX_YAW_DEG, "yaw_deg", must)
        rotation = rotations.exp(np.radians(yaw)[:, None] * (0.0, 0.0, 1.0))
        translation = table.points(axis for axis in "xyz" if axis in table.columns)
        missing = 3 - translation.shape[1]
        return Truth(table.times(), rotation, np.pad(translation, ((0, 0), (0, missing))))

    names = ("qw", "qx", "qy", "qz")
    table.check_columns(("t", "x", "y", "z", *names))
    q = np.stack([table.numbers(name) for name in names], axis=-1)
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(q, axis=-1)
    table.check(np.abs(norm - 1) <= 1e-2, "qw", "quaternion norm must be 1 within 0.01", got=norm)
    return Truth(table.times(), rotations.from_quaternion(q), table.points("xyz"))
