"""Cells of a text file by column, checked: what is wrong is named with file, line and column."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbl_gym.checks import BoolArray, FloatArray

AnyPath = str | os.PathLike[str]
IntArray = NDArray[np.intp]
Ids = tuple[tuple[str, ...], tuple[str, ...]]  # of the anchors, of the tags

MAX_RANGE_M = 10e3
MAX_COORDINATE_M = 1e8  # geocentric and map coordinates are in the world frame
MAX_TIME_S = 1e11  # the year 5138
TOO_LONG = f"must be at most {MAX_RANGE_M:.0f} m (looks like millimetres?)"


class Table(NamedTuple):
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
        too_late = f"must be at most {MAX_TIME_S:g} s (looks like milliseconds?)"
        self.check(np.abs(times) <= MAX_TIME_S, "t", too_late)
        step = np.diff(times, prepend=-np.inf)
        ok, must = (step >= 0, "not decrease") if may_repeat else (step > 0, "increase")
        self.check(ok, "t", f"time must {must} from row to row")
        return times

    def points(self, columns: Iterable[str], most: float = MAX_COORDINATE_M) -> FloatArray:
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
        self.check((ranges <= MAX_RANGE_M) | unused, column, TOO_LONG)
        return np.where(unused, 0.0, ranges)

    def links(self, ids: Ids, epoch: IntArray | int = 0) -> tuple[IntArray, IntArray]:
        """Anchor and tag indices (rows,), every link at most once in an `epoch`."""
        anchor, tag = self.positions("anchor", ids[0]), self.positions("tag", ids[1])
        numbered = (epoch * len(ids[0]) + anchor) * len(ids[1]) + tag
        pairs = [*zip(self.columns["anchor"], self.columns["tag"], strict=True)]
        self.check(is_first(numbered), "tag", "each link may come once at a time", got=pairs)
        return anchor, tag

    def positions(self, column: str, ids: tuple[str, ...]) -> IntArray:
        """(rows,) where in `ids` the cells of `column` stand."""
        index = {name: i for i, name in enumerate(ids)}
        positions = np.array([index.get(cell.strip(), -1) for cell in self.columns[column]])
        self.check(positions >= 0, column, f"unknown {column}, must be of {ids!r:.200}")
        return positions


def read_table(path: AnyPath) -> Table:
    """The cells of a file with a header.

    Raises
    ------
    ValueError
        If it cannot be read, or a row does not fit the header.
    """
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
    if not (first := is_first(header)).all():
        column = header[first.argmin()]
        raise ValueError(f"{name}, line {lines[0]}: column {column!r} comes twice")
    columns = dict(zip(header, zip(*rows[1:], strict=True), strict=True))
    return Table(name, lines[0], lines[1:], columns)


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


def is_first(values: ArrayLike) -> BoolArray:
    """(rows,) False where a value has come before."""
    values, first = np.asarray(values), np.unique(values, return_index=True)[1]
    return np.isin(np.arange(len(values)), first)
