"""Planar pose graphs and networks from files: g2o, or CSV of edges.

A pose graph's edge measures the pose of j in the frame of i; its turn is the edge angle of a
sensing network. Whatever is wrong in a file is a ValueError that names the file, the line, the
column and the value that came.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.sensing_network import IntArray, edge_angles, proj

__all__ = ["PoseGraph", "read_graph"]

_G2O_EDGE = ("i", "j", "dx", "dy", "dtheta", "I11", "I12", "I13", "I22", "I23", "I33")
_INFORMATION = _G2O_EDGE[5:]
_PASSED_OVER = ("VERTEX_SE2", "FIX")


class PoseGraph(NamedTuple):
    """Edges between n planar poses, which are numbered 0 to n - 1 here."""

    ids: IntArray  # (n,) what the file calls them, ascending
    edges: IntArray  # (m, 2)
    y: FloatArray  # (m,) angle of j's frame in that of i, radians in [-pi, pi)
    displacement: FloatArray | None  # (m, 2) place of j in the frame of i, metres
    information: FloatArray | None  # (m, 3, 3) of (dx, dy, dtheta)


def read_graph(path: str | os.PathLike[str]) -> PoseGraph:
    """Read a planar graph: ``.g2o``, else CSV.

    g2o: lines ``EDGE_SE2 i j dx dy dtheta I11 I12 I13 I22 I23 I33``; vertices and FIX are
    passed over, so are lines that start with ``#``. CSV: a header; columns ``i,j`` and one of
    ``dtheta`` (or ``y``), radians, or ``a,b``, the two bearings of an edge, radians; beside
    ``dtheta`` may stand ``dx,dy`` (metres) and ``I11`` to ``I33``.

    Raises
    ------
    ValueError
        If the file cannot be read, is not as described, joins a node to itself, or holds no
        edge.
    """
    path = os.fspath(path)
    is_g2o = path.lower().endswith(".g2o")
    names, lines, values = (_g2o_rows if is_g2o else _csv_rows)(path)
    columns = dict(zip(names, values.T, strict=True))
    whole = np.column_stack([columns["i"], columns["j"]])
    for column, ends in zip("ij", whole.T, strict=True):
        _check(path, lines, (ends >= 0) & (ends == np.floor(ends)) & (ends < 2**53), column,
               "must be a whole number, not negative", ends)  # fmt: skip
    _check(path, lines, whole[:, 0] != whole[:, 1], "j", "must differ from i", whole[:, 1])
    ids, edges = np.unique(whole.astype(np.intp), return_inverse=True)
    y = edge_angles(values[:, [names.index("a"), names.index("b")]]) if "a" in columns else \
        proj(columns["dtheta" if "dtheta" in columns else "y"])  # fmt: skip
    displacement = information = None
    if "dx" in columns:
        displacement = np.column_stack([columns["dx"], columns["dy"]])
    if "I11" in columns:
        upper = [columns[name] for name in _INFORMATION]
        information = np.stack(upper, axis=-1)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        for k in range(3):
            _check(path, lines, information[:, k, k] >= 0, f"I{k + 1}{k + 1}",
                   "must not be negative", information[:, k, k])  # fmt: skip
    return PoseGraph(ids, edges.reshape(-1, 2), y, displacement, information)


_Rows = tuple[tuple[str, ...], list[int], FloatArray]  # columns' names, rows' lines, numbers


def _g2o_rows(path: str) -> _Rows:
    lines, rows = [], []
    for number, line in _lines(path):
        tag, *cells = line.split()
        if tag in _PASSED_OVER:
            continue
        if tag != "EDGE_SE2":
            raise ValueError(f"{path}, line {number}: must be EDGE_SE2, VERTEX_SE2 or FIX (planar "
                             f"poses only), got {tag!r:.40}")  # fmt: skip
        lines.append(number)
        rows.append(_numbers(path, number, _G2O_EDGE, cells))
    return _G2O_EDGE, lines, _table(path, rows)


def _csv_rows(path: str) -> _Rows:
    content = _lines(path)
    number, header = next(content, (1, ""))
    names = tuple(cell.strip() for cell in header.split(","))
    angle = [*({"dtheta", "y"} & set(names))] or ["a", "b"]
    wanted = ["i", "j", *angle]
    extra = ["dx", "dy"] if {"dx", "dy"} & set(names) else []
    extra += list(_INFORMATION) if set(_INFORMATION) & set(names) else []
    if sorted(names) != sorted([*wanted, *extra]):
        raise ValueError(
            f"{path}, line {number}: columns must be i, j and dtheta (or y; or a, b), then dx, "
            f"dy, I11 to I33 or not, got {', '.join(names)!r:.120}"
        )
    lines, rows = [], []
    for number, line in content:
        lines.append(number)
        rows.append(_numbers(path, number, names, line.split(",")))
    return names, lines, _table(path, rows)


def _lines(path: str) -> Iterator[tuple[int, str]]:
    """Lines with something on them, and their numbers."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read, {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: must be UTF-8 text, {error.reason} at {error.start}") from error
    for number, line in enumerate(text.split("\n"), start=1):
        line = line.strip()
        if line and not line.startswith("#"):
            yield number, line


def _numbers(path: str, line: int, names: tuple[str, ...], cells: list[str]) -> list[float]:
    if len(cells) != len(names):
        raise ValueError(f"{path}, line {line}: must have {len(names)} values, got {len(cells)}")
    row = []
    for name, cell in zip(names, cells, strict=True):
        try:
            value = math.nan if "_" in cell else float(cell)  # float() reads 1_000
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(f"{path}, line {line}, column {name!r}: must be a finite number, "
                             f"got {cell.strip()!r:.40}")  # fmt: skip
        row.append(value)
    return row


def _table(path: str, rows: list[list[float]]) -> FloatArray:
    if not rows:
        raise ValueError(f"{path}: must have an edge, got none")
    return np.array(rows)


def _check(path: str, lines: list[int], ok: np.ndarray, column: str, must: str,
           values: FloatArray) -> None:  # fmt: skip
    if not ok.all():
        row = int(np.argmin(ok))
        raise ValueError(f"{path}, line {lines[row]}, column {column!r}: {must}, "
                         f"got {values[row]:g}")  # fmt: skip
