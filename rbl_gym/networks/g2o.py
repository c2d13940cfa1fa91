"""Read planar pose graphs and networks from files: g2o, or CSV of edges.

An edge of a pose graph measures the pose of j in the frame of i; its rotation is the edge angle of
a sensing network. Errors in a file raise a ValueError that names the file, the line, the column and
the value.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbl_gym.checks import FloatArray
from rbl_gym.networks.edges import IntArray
from rbl_gym.networks.sensing import edge_angles, proj

__all__ = ["PoseGraph", "read_graph"]

_POSE = ("dx", "dy", "dtheta")
_INFORMATION = ("I11", "I12", "I13", "I22", "I23", "I33")
_LONE = "VERTEX_SE2 without an edge"
# Lines of a g2o file that are not planar poses: landmarks, SE(3), parameters, priors.
_OTHER = ("EDGE", "VERTEX", "PARAMS")
_LARGEST_ID = 2**64 - 1


class PoseGraph(NamedTuple):
    """Edges between n planar poses, numbered 0 to n - 1."""

    ids: NDArray[np.integer[Any]]  # (n,) ids in the file, ascending
    edges: IntArray  # (m, 2)
    y: FloatArray  # (m,) angle of frame j in frame i, radians in [-pi, pi)
    displacement: FloatArray | None  # (m, 2) position of j in the frame of i, metres
    information: FloatArray | None  # (m, 3, 3) of (dx, dy, dtheta); NaN for edges without it
    skipped: dict[str, int]  # number of lines of each kind that were not read


class _Rows(NamedTuple):
    lines: list[int]  # of the edges
    ends: list[tuple[int, int]]
    columns: dict[str, FloatArray]
    skipped: dict[str, int]
    vertices: set[int]


def read_graph(path: str | os.PathLike[str]) -> PoseGraph:
    """Read a planar graph: ``.g2o``, else CSV.

    g2o: lines ``EDGE_SE2 i j dx dy dtheta I11 I12 I13 I22 I23 I33``, or without the information.
    Values of vertices, FIX, and lines that start with ``#`` are ignored. Lines of other kinds
    (``EDGE_SE3:QUAT``, ``EDGE_SE2_XY``, ...) are not read; `skipped` counts them, and the planar
    vertices without an edge.

    CSV: a header; columns ``i,j`` and one of ``dtheta`` (or ``y``), radians, or ``a,b``, the two
    bearings of an edge, radians; with ``dtheta``, optional columns are ``dx,dy`` (metres) and
    ``I11`` to ``I33``, which are empty for edges without information.

    Nodes are integers up to 2^64 - 1, as the keys of GTSAM.

    Raises
    ------
    ValueError
        If the file cannot be read, is not as described, joins a node to itself, or holds no
        edge.
    """
    path = os.fspath(path)
    rows = (_g2o_rows if path.lower().endswith(".g2o") else _csv_rows)(path)
    columns = rows.columns
    for line, (i, j) in zip(rows.lines, rows.ends, strict=True):
        if i == j:
            raise ValueError(f"{path}, line {line}, column 'j': must differ from i, got {j}")
    joined = {node for ends in rows.ends for node in ends}
    ids = np.array(sorted(joined), dtype=np.int64 if max(joined) < 2**63 else np.uint64)
    index = {int(node): k for k, node in enumerate(ids)}
    edges = np.array([(index[i], index[j]) for i, j in rows.ends], dtype=np.intp)
    y = (
        edge_angles(np.column_stack([columns["a"], columns["b"]]))
        if "a" in columns
        else proj(columns["dtheta" if "dtheta" in columns else "y"])
    )
    displacement = np.column_stack([columns["dx"], columns["dy"]]) if "dx" in columns else None
    skipped = dict(rows.skipped)
    if lone := len(rows.vertices - joined):
        skipped[_LONE] = lone
    return PoseGraph(ids, edges, y, displacement, _information(path, rows), skipped)


def _information(path: str, rows: _Rows) -> FloatArray | None:
    if "I11" not in rows.columns:
        return None
    upper = np.stack([rows.columns[name] for name in _INFORMATION], axis=-1)
    information = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    for k in range(3):
        negative = information[:, k, k] < 0
        if negative.any():
            row = int(np.argmax(negative))
            raise ValueError(
                f"{path}, line {rows.lines[row]}, column 'I{k + 1}{k + 1}': must not "
                f"be negative, got {information[row, k, k]:g}"
            )
    return None if np.isnan(information).all() else information


def _g2o_rows(path: str) -> _Rows:
    names = (*_POSE, *_INFORMATION)
    lines, ends, values = [], [], []
    skipped: Counter[str] = Counter()
    vertices: set[int] = set()
    for number, line in _lines(path):
        tag, *cells = line.split()
        if tag == "VERTEX_SE2" and cells:
            vertices.add(_node(path, number, "id", cells[0]))
        elif tag == "EDGE_SE2":
            if len(cells) == 5:
                cells += [""] * len(_INFORMATION)
            _count(
                path, number, cells, 11, " (5 values are allowed too: an edge without information)"
            )
            lines.append(number)
            ends.append(_ends(path, number, cells))
            values.append(_numbers(path, number, names, cells[2:]))
        elif tag != "FIX" and tag.startswith(_OTHER):
            skipped[tag] += 1
        elif tag != "FIX":
            raise ValueError(
                f"{path}, line {number}: must start with EDGE_SE2 or another keyword of g2o, got "
                f"{tag!r:.40}"
            )
    if not lines:
        told = ", ".join(f"{n} {tag}" for tag, n in skipped.items())
        raise ValueError(
            f"{path}: must have an edge, got no EDGE_SE2" + (f"; skipped: {told}" if told else "")
        )
    return _Rows(lines, ends, dict(zip(names, np.array(values).T, strict=True)), skipped, vertices)


def _csv_rows(path: str) -> _Rows:
    content = _lines(path)
    number, header = next(content, (1, ""))
    names = [cell.strip() for cell in header.split(",")]
    angle = [*({"dtheta", "y"} & set(names))] or ["a", "b"]
    wanted = ["i", "j", *angle]
    extra = ["dx", "dy"] if {"dx", "dy"} & set(names) else []
    extra += list(_INFORMATION) if set(_INFORMATION) & set(names) else []
    if sorted(names) != sorted([*wanted, *extra]):
        raise ValueError(
            f"{path}, line {number}: columns must be i, j and dtheta (or in its place y, or "
            f"both a and b), and optionally dx, dy and I11 to I33; got {', '.join(names)!r:.120}"
        )
    order = [names.index(name) for name in ("i", "j", *angle, *extra)]
    others = (*angle, *extra)
    lines, ends, values = [], [], []
    for number, line in content:
        cells = line.split(",")
        _count(path, number, cells, len(names))
        cells = [cells[k].strip() for k in order]
        lines.append(number)
        ends.append(_ends(path, number, cells))
        values.append(_numbers(path, number, others, cells[2:]))
    if not lines:
        raise ValueError(f"{path}: must have an edge, got none")
    return _Rows(lines, ends, dict(zip(others, np.array(values).T, strict=True)), {}, set())


def _lines(path: str) -> Iterator[tuple[int, str]]:
    """Return the lines that are not blank, and their numbers."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: must be UTF-8 text, {error.reason} at byte {error.start}"
        ) from error
    for number, line in enumerate(text.split("\n"), start=1):
        line = line.strip()
        if line and not line.startswith("#"):
            yield number, line


def _count(path: str, line: int, cells: list[str], wanted: int, more: str = "") -> None:
    if len(cells) != wanted:
        raise ValueError(f"{path}, line {line}: must have {wanted} values, got {len(cells)}{more}")


def _ends(path: str, line: int, cells: list[str]) -> tuple[int, int]:
    return _node(path, line, "i", cells[0]), _node(path, line, "j", cells[1])


def _node(path: str, line: int, column: str, cell: str) -> int:
    """Return the number of a node, also exact above 2^53."""
    value: Any = None
    if len(cell) <= 40 and "_" not in cell:  # int() reads 1_000
        try:
            value = int(cell)
        except ValueError:
            number = _number(cell)
            if abs(number) < 2**53 and number == math.floor(number):
                value = int(number)
    if value is None or not 0 <= value <= _LARGEST_ID:
        raise ValueError(
            f"{path}, line {line}, column {column!r}: must be a whole number, not "
            f"negative and below 2^64, got {cell:.40}"
        )
    return value


def _number(cell: str) -> float:
    """Return a finite number, or inf."""
    try:
        value = math.inf if "_" in cell else float(cell)  # float() reads 1_000
    except ValueError:
        return math.inf
    return value if math.isfinite(value) else math.inf


def _numbers(path: str, line: int, names: tuple[str, ...], cells: list[str]) -> list[float]:
    known = dict(zip(names, cells, strict=True))
    without = "I11" in known and not any(known[name] for name in _INFORMATION)
    row = []
    for name, cell in known.items():
        value = math.nan if without and name in _INFORMATION else _number(cell)
        if math.isinf(value):
            raise ValueError(
                f"{path}, line {line}, column {name!r}: must be a finite number, got {cell!r:.40}"
            )
        row.append(value)
    return row
