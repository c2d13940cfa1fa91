"""Read layouts of anchors from CSV files: one anchor per line, columns by name."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

__all__ = ["Layout", "read_layout"]

_AXES = ("x_m", "y_m", "z_m")
# Headings of the files of anchors of `rbl-gym replay` and `rbl-gym calibrate`.
_SAME = {"x": "x_m", "y": "y_m", "z": "z_m", "anchor": "name", "id": "name"}


class Layout(NamedTuple):
    """Anchors of a file: names (M), positions (M, 3) in metres."""

    names: tuple[str, ...]
    positions: FloatArray


def read_layout(path: str) -> Layout:
    """Read anchors from a CSV file with the columns x_m, y_m, z_m and optionally name.

    The columns may also be called x, y, z and anchor or id, as for `rbl-gym replay`. They may be in
    any order, and other columns are ignored. Separators are commas or semicolons. Without names the
    anchors are called 1, 2, ...

    Parameters
    ----------
    path
        Path of the file.

    Raises
    ------
    ValueError
        If the file is invalid; the message has the file, the line and the column.
    """
    return parse_layout(path, Path(path).read_bytes())


def parse_layout(path: str, content: bytes) -> Layout:
    """Return `read_layout` of a file's bytes; `path` is its name in errors."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: must be a text in UTF-8, {error.reason}") from error
    first = text.partition("\n")[0]
    lines = csv.reader(io.StringIO(text), delimiter=";" if ";" in first else ",", strict=True)
    try:
        rows = [(lines.line_num, row) for row in lines if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise ValueError(f"{path}, line {lines.line_num}: {error}") from error
    header = [cell.strip().lower() for cell in rows[0][1]] if rows else []
    header = [name if _SAME.get(name, name) in header else _SAME.get(name, name) for name in header]
    missing = [name for name in _AXES if name not in header]
    if missing:
        raise ValueError(
            f"{path}: the first line must name the columns x_m, y_m, z_m (or x, y, z) and "
            f"optionally name; {', '.join(missing)} not found in {first.strip()[:80]!r}"
        )
    columns = [header.index(name) for name in _AXES]
    at_name = header.index("name") if "name" in header else None
    names, positions = [], []
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise ValueError(
                f"{path}, line {line}: must have {len(header)} cells like the header, got "
                f"{len(row)}"
            )
        positions.append([_number(path, line, rows[0][1][k].strip(), row[k]) for k in columns])
        names.append(str(len(names) + 1) if at_name is None else row[at_name].strip())
        if not names[-1] or names.index(names[-1]) < len(names) - 1:
            raise ValueError(
                f"{path}, line {line}, column name: every anchor must have its own name, "
                f"got {names[-1]!r}"
            )
    if not positions:
        raise ValueError(f"{path}: must have at least one anchor, got none")
    return Layout(tuple(names), np.array(positions))


def _number(path: str, line: int, column: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{path}, line {line}, column {column}: must be a number, got {cell!r}")
    return value
