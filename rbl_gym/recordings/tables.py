"""Read the cells of a text file by column; errors name file, line and column."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbl_gym.checks import BoolArray, FloatArray, did_you_mean
from rbl_gym.recordings.column_units import METRES, UNIT, check_unit, name_and_unit
from rbl_gym.recordings.columns import Columns
from rbl_gym.recordings.stamps import TIME_UNITS, found_unit, iso_seconds, seconds_per
from rbl_gym.recordings.text import is_number, read_cells

AnyPath = str | os.PathLike[str]
IntArray = NDArray[np.intp]
Ids = tuple[tuple[str, ...], tuple[str, ...]]  # anchors, tags

MAX_RANGE_M = 10e3
MAX_COORDINATE_M = 1e8  # geocentric and map coordinates are in the world frame
MAX_TIME_S = 1e11  # the year 5138
TOO_LONG = f"must be at most {MAX_RANGE_M:.0f} m (looks like millimetres?)"

# What loggers write for a missing number.
_MISSING = frozenset(("", "nan", "na", "n/a", "none", "null", "-", "inf", "-inf", "+inf"))
# Common names of a column, in any case, with spaces for underscores. A unit may follow: time_ms.
_OTHER_NAMES = {
    "t": ("t", "time", "timestamp", "stamp"),
    "range": ("range", "distance", "dist"),
    "anchor": ("anchor", "anchor_id"),
    "tag": ("tag", "tag_id"),
    "run": ("run", "run_id"),
    "id": ("id", "name"),
    **{f"a{axis}": (f"a{axis}", f"anchor_{axis}") for axis in "xyz"},
    **{name: (name,) for name in (*"xyz", "std", "var", "valid")},
}
_QUANTITIES = {
    *_OTHER_NAMES, *itertools.chain(*_OTHER_NAMES.values()),
    "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz", "left", "right",
}  # fmt: skip


class Source(NamedTuple):
    """Column names of a file, and the rows to use.

    `columns` maps the content of a column to its name in the file. ``{"*": "B_*"}`` names all
    columns with this prefix. A unit may follow a name in brackets, ``"stamp[ms]"``. `where` gives,
    by column, the cell that the rows to use must have. `file` is the kind of the file in a
    `Format`, ``"ranges"`` or ``"anchors"``; empty if it is none of these.
    """

    columns: Mapping[str, str] = {}
    where: Mapping[str, str] = {}
    file: str = ""

    def given(self, **names: str) -> str:
        """Return the names of columns as `Format.columns` and the command line take them."""
        prefix = "" if self.file == "ranges" else f"{self.file}."
        return ",".join(
            f"{prefix}{'time' if content == 't' else content}={name}"
            for content, name in names.items()
        )


AS_NAMED = Source()


class Table(NamedTuple):
    """Cells of a text file by column, with the line of the header and the lines of the rows."""

    path: str
    header_line: int
    lines: NDArray[np.int64]
    columns: Columns  # by content, or else by name in the file
    names: dict[str, str]  # in the file, in its order
    units: dict[str, str]  # given in the header
    decimal: str  # "." or ","
    cut: int | None  # line of a last row that was cut off and left out
    chosen_by: tuple[str, ...]  # names in the file of the columns that selected the rows
    source: Source = AS_NAMED

    def require(self, *columns: str) -> None:
        """Raise ValueError unless all `columns` exist."""
        missing = [column for column in columns if column not in self.columns]
        if not missing:
            return
        several = len(missing) > 1
        text = (
            f"{self.path}, line {self.header_line}: missing column{'s' if several else ''} "
            f"{', '.join(map(repr, missing))}, got {[*self.names.values()]!r:.200}"
        )
        if self.source.file:
            names = self.source.given(**dict.fromkeys(missing, "NAME"))
            other = "they have other names" if several else "it has another name"
            text += f"; if {other}, give --columns {names}"
        raise ValueError(text)

    def name(self, column: str) -> str:
        """Return the name of `column` in the file."""
        return self.names.get(column, column)

    def place(self, row: int, column: str) -> str:
        """Return file, line and column as text."""
        return f"{self.path}, line {self.lines[row]}, column {self.name(column)!r}"

    def unit(self, column: str, known: Iterable[str]) -> str:
        """Return the unit of a column given in the header, one of `known`; "" if it gives none."""
        unit = self.units.get(column, "")
        if unit and unit not in known:
            raise ValueError(
                f"{self.path}, line {self.header_line}, column {self.name(column)!r}: unit must be "
                f"one of {', '.join(known)}, got {unit!r}"
            )
        return unit

    def check(self, ok: BoolArray, column: str, must: str, got: Any = None) -> None:
        """Raise at the first row where `ok` is False; `got` replaces the cells in the message."""
        if not ok.all():
            row = int(np.argmin(ok))
            value = repr(self.columns[column][row]) if got is None else f"{got[row]}"
            if got is not None and isinstance(got[row], float):
                value = f"{got[row]:.6g}"
            raise ValueError(f"{self.place(row, column)}: {must}, got {value:.80}")

    def select(self, rows: BoolArray) -> Table:
        """Return the table with some of the rows."""
        return self._replace(lines=self.lines[rows], columns=self.columns.select(rows))

    def text(self, column: str) -> list[str]:
        """Return (rows,) cells without surrounding space."""
        return [cell.strip() for cell in self.columns[column]]

    def numbers(self, column: str, *, may_be_missing: bool = False) -> FloatArray:
        """Return (rows,) finite numbers; NaN for empty cells if these are allowed."""
        values = self.columns.numbers(column)
        if values is None:
            values, missing = self._read_numbers(column)
        else:
            missing = np.isnan(values)
        ok = np.isfinite(values)
        if may_be_missing and not ok.all():
            ok |= missing
            values[~np.isfinite(values)] = np.nan
        self.check(ok, column, "must be a finite number")
        return values

    def _read_numbers(self, column: str) -> tuple[FloatArray, BoolArray]:
        """Return the numbers in the cells of a column, NaN for others, and which are missing."""
        cells = self.columns[column].tolist()
        if self.decimal == ",":
            cells = [cell.replace(",", ".") for cell in cells]
        try:
            if "_" in "".join(cells):  # float() reads 1_000
                raise ValueError
            values = np.array([*map(float, cells)])
        except ValueError:
            values = np.array([float(cell) if is_number(cell) else np.nan for cell in cells])
        missing = ~np.isfinite(values)
        for row in np.flatnonzero(missing).tolist():
            missing[row] = cells[row].strip().lower() in _MISSING
        return values, missing

    def is_numeric(self, column: str) -> bool:
        """Return whether the first cell of a column is a number."""
        return self.columns.numbers(column) is not None or is_number(self.columns[column][0])

    def empty(self, column: str, rows: IntArray) -> BoolArray:
        """Return which cells of some rows are empty."""
        values = self.columns.numbers(column)
        if values is not None:
            return np.isnan(values[rows])
        return np.array([not cell.strip() for cell in self.columns[column][rows]], np.bool_)

    def seconds(self, unit: str | None = None) -> tuple[FloatArray, str]:
        """Return (rows,) column `t` in seconds, and a note on its unit ("": none).

        `unit`: s, ms, us, ns or iso; None: the unit in the header, or else detected from the cells.
        """
        self.require("t")
        said = unit or self.unit("t", TIME_UNITS) or None
        if said == "iso" or (said is None and not self.is_numeric("t")):
            stamps = iso_seconds(self.columns["t"].tolist())
            if stamps is not None and (said == "iso" or np.isfinite(stamps[0])):
                self.check(np.isfinite(stamps), "t", "must be a time of ISO 8601")
                return stamps, "" if said else "times are read as ISO 8601"
        if self.columns.numbers("t") is None:
            self.check(
                np.array([":" not in cell for cell in self.columns["t"]]),
                "t",
                "times of day need a date, as in ISO 8601: 2024-05-01T12:00:00.5; or give seconds",
            )
        values, note = self.numbers("t"), ""
        if said is None:
            said, note = found_unit(values)
        elif unit is None and said != "s":
            note = f"times are in {said}, as the header states"
        times = values * seconds_per(said)
        too_late = f"must be at most {MAX_TIME_S:g} s (looks like milliseconds?)"
        self.check(np.abs(times) <= MAX_TIME_S, "t", too_late)
        return times, note

    def times(self) -> FloatArray:
        """Return (rows,) column `t` in seconds, increasing."""
        times, _ = self.seconds()
        step = np.diff(times, prepend=-np.inf)
        self.check(step > 0, "t", "time must increase from row to row")
        return times

    def points(self, columns: Iterable[str], most: float = MAX_COORDINATE_M) -> FloatArray:
        """Return (rows, len(columns)) coordinates in metres, of magnitude `most` at most."""
        points = {column: self.numbers(column) for column in columns}
        for column, values in points.items():
            values *= METRES[self.unit(column, METRES) or "m"]
            too_far = f"must be at most {most:.0f} m (looks like millimetres?"
            if self.source.file:
                told = self.source.given(**{column: f"{self.name(column)}[mm]"})
                too_far += f' then give --columns "{told}"'
            too_far += ")"
            self.check(np.abs(values) <= most, column, too_far)
        return np.stack([*points.values()], axis=-1)

    def positions(self, column: str, ids: tuple[str, ...]) -> IntArray:
        """Return (rows,) indices in `ids` of the cells of `column`, -1 for unknown ids.

        Ids are text. If there is no exact match, case and a ``.0`` that a spreadsheet has added to
        a number are ignored.
        """
        index = {name: i for i, name in enumerate(ids)}
        plain: dict[str, int] = {}
        for i, name in enumerate(ids):
            plain[_plain(name)] = -1 if _plain(name) in plain else i
        cells = self.text(column)
        found = {
            cell: index[cell] if cell in index else plain.get(_plain(cell), -1)
            for cell in set(cells)
        }
        return np.array([found[cell] for cell in cells], dtype=np.intp)

    def links(self, ids: Ids) -> tuple[IntArray, IntArray]:
        """Return the anchor and tag indices (rows,) of known ids, every link at most once."""
        found = []
        for column, known in zip(("anchor", "tag"), ids, strict=True):
            found.append(self.positions(column, known))
            self.check(found[-1] >= 0, column, f"{column} must be one of {', '.join(known)!s:.200}")
        pairs = [*zip(self.columns["anchor"], self.columns["tag"], strict=True)]
        once = is_first(found[0] * len(ids[1]) + found[1])
        self.check(once, "tag", "each link must be in the table once", got=pairs)
        return found[0], found[1]


def read_table(path: AnyPath, source: Source = AS_NAMED, headless: Sequence[str] = ()) -> Table:
    """Read the cells of a file with a header; `headless` names the columns of a table without one.

    If `source` names columns by numbers, from 1, the table has no header. ValueError if the file
    cannot be read, a row does not fit the header, a column named by `source` does not exist, or no
    row is left.
    """
    said = {role: name_and_unit(name, source.file) for role, name in source.columns.items()}
    asked = {name for name, _ in said.values()}
    numbered = bool(asked) and all(name.isdigit() for name in asked)
    cells = read_cells(os.fspath(path), headless, numbered)
    where = f"{cells.path}, line {cells.header_line}"
    header, units = [], {}
    for i, cell in enumerate(cells.header, 1):
        name, units_of = name_and_unit(cell, source.file)
        header.append(name or f"(column {i})")
        units[header[-1]] = units_of
    if not (first := is_first(header)).all():
        name = header[first.argmin()]
        raise ValueError(f"{where}: two columns have the name {name!r}: rename one")
    by_name = Columns({name: i for i, name in enumerate(header)}, cells.columns, cells.values)
    names = _roles(where, header, {role: name for role, (name, _) in said.items()}, source)
    for role, (name, unit) in said.items():
        if source.file and unit and source.columns[role].strip() != name:  # in brackets
            check_unit(where, source.file, role, name, unit)
    units |= {name: unit for name, unit in said.values() if unit}
    rows = np.ones(len(cells.lines), dtype=bool)
    for column, want in source.where.items():
        if (name := names.get(column, column)) not in by_name:
            raise ValueError(
                f"{where}: no column {column!r} to choose rows by, got {header!r:.200}"
            )
        rows &= np.array([cell.strip() == want for cell in by_name[name]])
        if not rows.any():
            got = sorted({cell.strip() for cell in by_name[name]})
            raise ValueError(f"{where}: no row has {column}={want}, got {got!r:.200}")
    table = Table(
        cells.path,
        cells.header_line,
        np.array(cells.lines),
        Columns(
            {role: header.index(name) for role, name in names.items()}, cells.columns, cells.values
        ),
        names,
        {role: units[name] for role, name in names.items() if units[name]}
        | {role: unit for role, (name, unit) in said.items() if "{" in name and unit},
        cells.decimal,
        cells.cut,
        tuple(names.get(column, column) for column in source.where),
        source,
    )
    return table if rows.all() else table.select(rows)


def _roles(
    where: str, header: list[str], columns: dict[str, str], source: Source
) -> dict[str, str]:
    """Return the names in the file by the content of the columns, in the order of the file."""
    if "time" in columns:
        columns["t"] = columns.pop("time")
    standard = source.file in ("anchors", "tags") and {*header} <= {source.file[:-1], *"xyz"}
    if standard and {*columns} <= {*header} and not {*columns.values()} & {*header}:
        columns = {}  # a file of `rbl-gym calibrate`, with the options for the user's own file
    names: dict[str, str] = {}
    pattern = columns.pop("*", None)
    if pattern is not None:
        before, star, after = pattern.partition("*")
        if not star:
            raise ValueError(f"{where}: the value of * must have a *, as in *=B_*, got {pattern!r}")
        for name in header:
            if name.startswith(before) and name.endswith(after) and len(name) > len(pattern) - 1:
                names[name[len(before) : len(name) - len(after)]] = name
        if not names:
            raise ValueError(f"{where}: no column fits {pattern!r}, got {header!r:.200}")
    absent, near = [], ""
    for role, name in columns.items():
        if "{" in name:
            continue  # a pattern of links
        if name not in header:
            if role in header and role not in _QUANTITIES and name in _QUANTITIES:
                swapped = source.given(**{name: role})
                raise ValueError(
                    f"{where}: {role!r} is not the name of a quantity; did you mean {swapped}?"
                )
            absent.append(f"{name!r} for {role}")
            if role not in _QUANTITIES and not near:
                near = did_you_mean(role, _QUANTITIES) or f"; {role!r} is not a known quantity"
        names[role] = name
    if absent:
        word = "column" if len(absent) == 1 else "columns"
        raise ValueError(f"{where}: missing {word} {', '.join(absent)}, got {header!r:.200}{near}")
    taken = set(names.values())
    for role, others in _OTHER_NAMES.items():
        if role in names or role in header:
            continue
        like = [
            name
            for name in header
            if name not in taken and re.sub(r"[\s-]+", "_", UNIT.sub("", name.lower())) in others
        ]
        if len(like) == 1:
            names[role] = like[0]
            taken.add(like[0])
    # A column whose name is used for another one is kept in brackets.
    left = [name for name in header if name not in taken]
    names |= {f"({name})" if name in names else name: name for name in left}
    return dict(sorted(names.items(), key=lambda pair: header.index(pair[1])))


def is_first(values: ArrayLike) -> BoolArray:
    """Return (rows,) booleans, False if the value occurred in an earlier row."""
    values, first = np.asarray(values), np.unique(values, return_index=True)[1]
    return np.isin(np.arange(len(values)), first)


def _plain(name: str) -> str:
    return re.sub(r"\.0+$", "", name.casefold())
