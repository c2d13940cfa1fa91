"""Convert the shapes of a layer to lists of numbers: lines, positions of marks, outlines."""

from __future__ import annotations

from collections import Counter
from typing import Any

from rbl_gym.checks import FloatArray
from rbl_gym.placement.plans.drawing import Shape
from rbl_gym.placement.plans.rings import joined, opened
from rbl_gym.placement.plans.uses import Use, number

# Line ends within this distance are joined, metres.
_TOLERANCE_M = 0.01


def lines_of(shapes: list[Shape]) -> tuple[list[Shape], list[Shape]]:
    """Return lines and rings, where loose lines with common ends are joined, and marks."""
    marks = [shape for shape in shapes if len(shape.points) == 1]
    rings = [shape for shape in shapes if shape.closed]
    loose = [shape for shape in shapes if not shape.closed and len(shape.points) > 1]
    plain = [shape for shape in loose if not shape.properties]
    lines = [shape for shape in loose if shape.properties]
    for points, closed in joined([shape.points for shape in plain], _TOLERANCE_M):
        lines.append(Shape(plain[0].layer, "joined", points, closed))
    return rings + lines, marks


def spots_of(marks: list[Shape], lines: list[Shape], use: Use) -> list[list[float]]:
    """Return positions (x, y, z) of marks or, if there are none, of the centres of rings."""
    rings = [
        shape._replace(points=shape.points.mean(axis=0)[None]) for shape in lines if shape.closed
    ]
    spots = []
    for mark in marks or rings:
        height = mark.properties.get("height", mark.properties.get("z", 0.0))
        height = number(f"{use.layer}: height", use.values.get("height_m", height))
        spots.append([*points_of(mark.points)[0], rounded(height)])
    return spots


def outline_of(shape: Shape) -> FloatArray:
    """Return a ring with its holes connected to it, as far as possible."""
    ring = opened(shape.points, shape.holes) if shape.holes else shape.points
    return shape.points if ring is None else ring


def numbered(rows: list[dict[str, Any]]) -> None:
    """Number the names of rows that have the same name: COLUMNS 1, COLUMNS 2."""
    counts = Counter(row["name"] for row in rows if "name" in row)
    done: Counter[str] = Counter()
    for row in rows:
        name = row.get("name", "")
        if counts[name] > 1:
            done[name] += 1
            row["name"] = f"{name} {done[name]}"


def count_blocks(marks: list[Shape]) -> int:
    """Return the number of marks from blocks."""
    return sum(mark.kind == "INSERT" for mark in marks)


def points_of(points: FloatArray) -> list[list[float]]:
    """Return points (n, 2) as lists."""
    return [[rounded(x) for x in point] for point in points.tolist()]


def rounded(value: float) -> float:
    """Round to a tenth of a millimetre, without minus zero."""
    return round(float(value), 4) + 0.0
