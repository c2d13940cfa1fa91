"""Represent a drawing: shapes on named layers in metres, its units, and skipped entities."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

__all__ = ["UNITS", "Drawing", "Label", "Shape"]

# Metres per unit; degrees are projected (`geojson`).
UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
# A plan farther from its origin than this is moved to the origin, metres.
_FAR_M = 50_000.0
# Usual sizes of a building, metres. Other sizes make the unit doubtful.
_SMALL_M, _LARGE_M = 1.0, 5_000.0


class Shape(NamedTuple):
    """A line, a ring or a point of a drawing.

    Attributes
    ----------
    layer, kind
        Name of the layer; kind of the entity in the file.
    points
        Points (n, 2), metres. One point is a mark. A ring does not repeat its first point.
    closed
        Whether it is a ring.
    holes
        Holes (n, 2) of a ring.
    properties
        Properties of a GeoJSON feature, or `z_m` of a DXF mark.
    """

    layer: str
    kind: str
    points: FloatArray
    closed: bool = False
    holes: tuple[FloatArray, ...] = ()
    properties: dict[str, Any] = {}  # noqa: RUF012 - never changed


class Label(NamedTuple):
    """A text at a position (2,), metres."""

    layer: str
    text: str
    at: FloatArray


class Drawing(NamedTuple):
    """The content of a drawing file.

    Attributes
    ----------
    path, units
        Path of the file; unit of its coordinates, a key of `UNITS` or ``degrees``.
    zero
        The point of the file, in its own units, that is (0, 0) of the shapes.
    shapes, labels
        Shapes and texts in the order of the file.
    unread
        For each layer, the number of entities of each kind that were not read.
    said
        Notes for the user: units, shifts, skipped entities.
    """

    path: str
    units: str
    zero: tuple[float, float]
    shapes: list[Shape]
    labels: list[Label]
    unread: dict[str, Counter[str]]
    said: list[str]

    def layers(self) -> list[str]:
        """Return the names of all layers that are not empty, sorted."""
        return sorted({shape.layer for shape in self.shapes} | set(self.unread))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper corner (2,) of all shapes, metres."""
        points = np.concatenate([shape.points for shape in self.shapes])
        return points.min(axis=0), points.max(axis=0)


def scaled(drawing: Drawing, zero: tuple[float, float] | None) -> Drawing:
    """Convert a drawing from its own unit to metres from `zero`, and note a doubtful size."""
    if not drawing.shapes:
        kinds = sum(drawing.unread.values(), Counter())
        held = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())) or "nothing"
        raise ValueError(f"{drawing.path}: the drawing has no lines that can be read, only {held}")
    scale = UNITS[drawing.units]
    low, high = drawing.bounds()
    said = list(drawing.said)
    if zero is None:
        zero = (0.0, 0.0)
        if np.abs([low, high]).max() * scale > _FAR_M:
            step = 10 ** -math.floor(math.log10(scale)) if scale < 1 else 1.0
            zero = tuple((np.floor(low / step) * step).tolist())
            said.append(
                f"the drawing is far from its origin: its point ({zero[0]:.10g}, {zero[1]:.10g}) "
                f"{drawing.units} becomes (0, 0) in the file"
            )
    width, height = (high - low) * scale
    said.append(f"the plan is {width:.4g} x {height:.4g} m")
    if not _SMALL_M <= max(width, height) <= _LARGE_M:
        said.append("this is an unusual size for a building: check the unit (--units)")
    shift = np.array(zero)
    return drawing._replace(
        zero=zero,
        said=said,
        shapes=[
            shape._replace(
                points=(shape.points - shift) * scale,
                holes=tuple((hole - shift) * scale for hole in shape.holes),
            )
            for shape in drawing.shapes
        ],
        labels=[label._replace(at=(label.at - shift) * scale) for label in drawing.labels],
    )
