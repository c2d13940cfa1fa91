"""Read text files as cells: encoding, comments, header and delimiter."""

from __future__ import annotations

import csv
import functools
import re
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from rbl_gym.checks import FloatArray
from rbl_gym.recordings.columns import plain_numbers

# Possible delimiters; white space only if the header has none of the others.
_DELIMITERS = ("\t", ";", ",")
# A first line by which spreadsheets declare the delimiter.
_SEPARATOR = re.compile(r"sep=.\r?$", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"\d,\d")
_DECIMAL_POINT = re.compile(r"\d\.\d")


class Cells(NamedTuple):
    """A header and the cells below it by column, with their line numbers."""

    path: str
    header_line: int
    header: list[str]
    lines: list[int]
    columns: Callable[[], list[tuple[str, ...]]]
    values: FloatArray | None  # (rows, columns), if all cells are numbers or empty (NaN)
    decimal: str  # "." or ","
    cut: int | None  # line of a last row that was cut off and left out


def is_number(cell: str) -> bool:
    """Return whether `cell` is a number, including NaN and infinities."""
    try:
        return bool(cell) and "_" not in cell and isinstance(float(cell), float)
    except ValueError:
        return False


def read_cells(path: str, headless: Sequence[str] = (), numbered: bool = False) -> Cells:
    """Read a text file: UTF-8 with or without a byte order mark, any line ending.

    Cells are separated by commas, semicolons or tabs, or by white space if the header has none of
    these. With semicolons and tabs, a comma may be the decimal point. Blank lines and lines that
    begin with ``#`` are skipped. There is one exception: if the first row holds numbers, the header
    is the last comment above it whose cells fit the row. If there is no such comment either,
    columns separated by white space get the names `headless`, if their number fits. With
    `numbered`, the columns of any table without a header are 1, 2 and so on. ValueError if the file
    cannot be read, has no header or no row, or a row does not fit the header.
    """
    lines = _read_lines(path)
    if _SEPARATOR.match(lines[0]):
        lines[0] = ""
    shown = (i for i, line in enumerate(lines) if line.lstrip()[:1] not in ("", "#"))
    first, second = [*islice(shown, 2), -1, -1][:2]
    count = 0 if first < 0 else 1 if second < 0 else 2
    above = range(0 if first < 0 else first)
    if first < 0:
        raise ValueError(
            f"{path}: the file is empty; it must have a header with the names of the columns, "
            "and rows"
        )
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
                    f"{path}, line {first + 1}: must have the names of the columns, got "
                    f"{lines[first]!r:.80}"
                )
    header = [cell.strip() for cell in header]
    values = plain_numbers("\n".join(lines[start + 1 :]).rstrip("\n"), len(header), comma)
    if values is not None:
        numbers = [*range(start + 2, start + 2 + len(values))]

        @functools.cache
        def columns() -> list[tuple[str, ...]]:
            return [*zip(*_rows(path, lines, start, header, comma)[0], strict=True)]

        return Cells(path, start + 1, header, numbers, columns, values, ".", None)
    rows, numbers, cut = _rows(path, lines, start, header, comma)
    if not rows:
        raise ValueError(f"{path}: must have rows below the header, got none")
    decimal = "."
    if comma != "," and _DECIMAL_COMMA.search(text := "\n".join(lines[first:])):
        decimal = ","
        if _DECIMAL_POINT.search(text):
            _check_decimals(path, rows, numbers)
    found = [*zip(*rows, strict=True)]
    return Cells(path, start + 1, header, numbers, lambda: found, None, decimal, cut)


def _rows(
    path: str, lines: list[str], start: int, header: list[str], comma: str | None
) -> tuple[list[list[str]], list[int], int | None]:
    """Return the rows below the header, their lines, and the line of a row that was cut off."""
    # A comment becomes an empty row, so that line numbers remain those of the file.
    text = [
        line if "#" < line[:1] < "\x7f" or line.lstrip()[:1] not in ("", "#") else ""
        for line in lines[start + 1 :]
    ]
    while text and not text[-1]:
        text.pop()
    width, line = len(header), start + 1
    reader = _reader(text, comma)
    try:
        rows = [*map(str.split, text)] if reader is None else [*reader]
        numbers = [*range(start + 2, start + 2 + len(rows))]
        # Usually every line is a full row.
        if len(rows) == len(text) and {*map(len, rows)} == {width}:
            return rows, numbers, None
        rows, numbers, reader = [], [], _reader(text, comma)
        for i, row in enumerate(map(str.split, text) if reader is None else reader, 1):
            line = start + 1 + (i if reader is None else reader.line_num)
            if not row:
                continue
            if len(row) > width and not any(row[width:]):
                row = row[:width]  # trailing delimiter
            if len(row) < width and line == len(lines) and rows:
                return rows, numbers, line  # no line feed at the end
            if len(row) != width:
                hint = ""
                if comma == "," and len(row) > width and any(map(is_number, row)):
                    hint = "; with commas in numbers the separator must be a semicolon or a tab"
                elif not rows:
                    hint = f"; lines above the header, which is taken to be line {start + 1}, must "
                    hint += "begin with #"
                raise csv.Error(f"must have {width} cells like the header, got {len(row)}{hint}")
            rows.append(row)
            numbers.append(line)
    except csv.Error as error:
        line = line if reader is None else start + 1 + reader.line_num
        raise ValueError(f"{path}, line {line}: {error}") from error
    return rows, numbers, None


def _reader(text: list[str], comma: str | None) -> Any:
    """Return a reader of rows; None: they are separated by white space."""
    return comma and csv.reader(text, delimiter=comma, skipinitialspace=True, strict=True)


def _check_decimals(path: str, rows: list[list[str]], numbers: list[int]) -> None:
    """Raise ValueError if a table uses both commas and points as decimal points."""
    pointed = {i for row in rows for i, c in enumerate(row) if is_number(c) and "." in c}
    for row, line in zip(rows, numbers, strict=True):
        for i in pointed:
            if "," in row[i]:
                raise ValueError(
                    f"{path}, line {line}: must not mix points and commas as decimal points, got "
                    f"{row[i]!r:.80} in a column with points"
                )


def _read_lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8-sig").split("\n")
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: must be UTF-8 text, {error.reason} at byte {error.start}; save it as UTF-8"
        ) from error


def _delimiter(header: str, row: str) -> str | None:
    """Return the delimiter of the cells of two lines; None: white space."""
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
    """Return whether a cell looks like a number, with a point or a comma, or like a time stamp."""
    cell = cell.strip().replace(",", ".")
    return is_number(cell) or bool(re.match(r"\d{4}-\d\d-\d\d[T ]", cell))
