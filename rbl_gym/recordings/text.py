"""Text files as cells: encoding, comments, the header, what stands between cells."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

# What may stand between cells; white space only where the header has none of the others.
_DELIMITERS = ("\t", ";", ",")
# A first line by which spreadsheets say what does.
_SEPARATOR = re.compile(r"sep=.\r?$", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"\d,\d")
_DECIMAL_POINT = re.compile(r"\d\.\d")


class Cells(NamedTuple):
    """A header and the cells below it by column, and the lines where they stand."""

    path: str
    header_line: int
    header: list[str]
    lines: list[int]
    columns: list[tuple[str, ...]]
    decimal: str  # "." or ","
    cut: int | None  # line of a last row that was cut off and is not here


def is_number(cell: str) -> bool:
    """Whether `cell` reads as a number; NaN and infinities do."""
    try:
        return bool(cell) and "_" not in cell and isinstance(float(cell), float)
    except ValueError:
        return False


def read_cells(path: str, headless: Sequence[str] = (), numbered: bool = False) -> Cells:
    """Read a text file: UTF-8 with or without a byte order mark, any line ending.

    Cells are separated by commas, semicolons, tabs or, where the header has none of these, by
    white space; with semicolons and tabs, a comma may be the decimal point. Blank lines and lines
    that begin with ``#`` are skipped, unless the first row below holds numbers only a comment can
    name: then the last comment above it whose cells fit the row is the header. A file of numbers
    between white space with neither has the names `headless`, if there are as many. With `numbered`
    the columns of any table without a header are 1, 2 and so on.

    Raises
    ------
    ValueError
        If the file cannot be read, has no header or no row, or a row does not fit the header.
    """
    lines = _read_lines(path)
    if _SEPARATOR.match(lines[0]):
        lines[0] = ""
    shown = (i for i, line in enumerate(lines) if line.lstrip()[:1] not in ("", "#"))
    first, second = [*islice(shown, 2), -1, -1][:2]
    count = 0 if first < 0 else 1 if second < 0 else 2
    above = range(0 if first < 0 else first)
    if first < 0:
        raise ValueError(f"{path}: must have a header and rows, got 0 lines")
    comma = _delimiter(lines[first], lines[second] if count == 2 else lines[first])
    start, header = first, _split(lines[first], comma)
    if numbered and any(map(_is_numeric, header)):
        start, header = first - 1, [str(k + 1) for k in range(len(header))]
    elif any(map(_is_numeric, header)):
        for i in reversed(above):
            words = _split(lines[i].strip().lstrip("#").strip(), comma)
            if len(words) == len(header) and not any(map(_is_numeric, words)):
                start, header = i, words
                break
        else:
            row = _split(lines[second], comma) if count == 2 else []
            if headless and comma in (None, "\t") and len(header) == len(headless):
                start, header = first - 1, [*headless]
            elif not any(
                not _is_numeric(a) and _is_numeric(b) for a, b in zip(header, row, strict=False)
            ):
                raise ValueError(
                    f"{path}, line {first + 1}: must name the columns, got {lines[first]!r:.80}; "
                    "no comment above it names them either"
                )
    rows, numbers, cut = _rows(path, lines, start, header, comma)
    if not rows:
        raise ValueError(f"{path}: must have a header and rows, got 1 lines")
    decimal = "."
    if comma != "," and _DECIMAL_COMMA.search(text := "\n".join(lines[first:])):
        decimal = ","
        if _DECIMAL_POINT.search(text):
            _check_decimals(path, rows, numbers)
    columns = [*zip(*rows, strict=True)]
    return Cells(path, start + 1, [cell.strip() for cell in header], numbers, columns, decimal, cut)


def _rows(
    path: str, lines: list[str], start: int, header: list[str], comma: str | None
) -> tuple[list[list[str]], list[int], int | None]:
    """The rows below the header, their lines, and the line of a last row that was cut off."""
    # A comment is turned into a blank line, an empty row: line numbers stay those of the file.
    text = ("" if line.lstrip()[:1] in ("", "#") else line for line in lines[start + 1 :])
    rows: list[list[str]] = []
    numbers: list[int] = []
    width, line = len(header), start + 1
    reader = (
        None
        if comma is None
        else csv.reader(text, delimiter=comma, skipinitialspace=True, strict=True)
    )
    try:
        for i, row in enumerate(map(str.split, text) if reader is None else reader, 1):
            line = start + 1 + (i if reader is None else reader.line_num)
            if not row:
                continue
            if len(row) > width and not any(row[width:]):
                row = row[:width]  # a delimiter at the end of the line
            if len(row) < width and line == len(lines) and rows:
                return rows, numbers, line  # no line feed behind it
            if len(row) != width:
                raise csv.Error(f"must have {width} cells like the header, got {len(row)}")
            rows.append(row)
            numbers.append(line)
    except csv.Error as error:
        line = line if reader is None else start + 1 + reader.line_num
        raise ValueError(f"{path}, line {line}: {error}") from error
    return rows, numbers, None


def _check_decimals(path: str, rows: list[list[str]], numbers: list[int]) -> None:
    """Raise where commas and points are both decimal points of a table."""
    pointed = {i for row in rows for i, c in enumerate(row) if is_number(c) and "." in c}
    for row, line in zip(rows, numbers, strict=True):
        for i in pointed:
            if "," in row[i]:
                raise ValueError(
                    f"{path}, line {line}: must have points or commas as decimal points, got "
                    f"{row[i]!r:.80} in a column with points"
                )


def _read_lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8-sig").split("\n")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read, {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: must be UTF-8 text, {error.reason} at {error.start}") from error


def _delimiter(header: str, row: str) -> str | None:
    """What stands between the cells of two lines; None: white space."""
    counts = {d: (len(_split(header, d)), len(_split(row, d))) for d in _DELIMITERS}
    for d, (one, other) in counts.items():
        if one == other > 1:
            return d
    for d, (one, _) in counts.items():
        if one > 1:
            return d
    return None if len(header.split()) > 1 else ","


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return line.split(delimiter)


def _is_numeric(cell: str) -> bool:
    """Whether a cell looks like a number, with a point or a comma, or like a time stamp."""
    cell = cell.strip().replace(",", ".")
    return is_number(cell) or bool(re.match(r"\d{4}-\d\d-\d\d[T ]", cell))
