"""A drawing as plain shapes on named layers, in metres; its units, and what could not be read."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

__all__ = ["UNITS", "Drawing", "Label", "Shape", "read_drawing"]

# Metres per unit; degrees are projected (`geojson`).
UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
_SUFFIXES = (".dxf", ".geojson", ".json")
# A plan further from its origin than this is moved to it, metres.
_FAR_M = 50_000.0
# Sizes of a building outside of which its unit is doubtful, metres.
_SMALL_M, _LARGE_M = 1.0, 5_000.0


class Shape(NamedTuple):
    """A line, a ring or a point of a drawing.

    Attributes
    ----------
    layer, kind
        Name of the layer; kind of the entity, as the file calls it.
    points
        (n, 2), metres. One point: a mark. A ring does not repeat its first point.
    closed
        Whether it is a ring.
    holes
        Rings (n, 2) that are cut out of a ring.
    properties
        What the file says besides (GeoJSON), and `z_m` of a mark (DXF).
    """

    layer: str
    kind: str
    points: FloatArray
    closed: bool = False
    holes: tuple[FloatArray, ...] = ()
    properties: dict[str, Any] = {}  # noqa: RUF012 - never changed


class Label(NamedTuple):
    """A text at a place (2,), metres."""

    layer: str
    text: str
    at: FloatArray


class Drawing(NamedTuple):
    """What a file holds.

    Attributes
    ----------
    path, units
        Where it stands; the unit its coordinates are in: a key of `UNITS`, or ``degrees``.
    zero
        The point of the file, in its own units, that is (0, 0) of the shapes.
    shapes, labels
        In the order of the file.
    unread
        For each layer, how many entities of each kind hold no line that could be read.
    said
        What a reader should know: units, what was moved, what was skipped.
    """

    path: str
    units: str
    zero: tuple[float, float]
    shapes: list[Shape]
    labels: list[Label]
    unread: dict[str, Counter[str]]
    said: list[str]

    def layers(self) -> list[str]:
        """Names of all layers that hold anything, sorted."""
        return sorted({shape.layer for shape in self.shapes} | set(self.unread))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner (2,) of all shapes, metres."""
        points = np.concatenate([shape.points for shape in self.shapes])
        return points.min(axis=0), points.max(axis=0)


def read_drawing(
    path: str,
    units: str | None = None,
    zero: tuple[float, float] | None = None,
    layer_property: str | None = None,
) -> Drawing:
    """Read a plan, DXF or GeoJSON.

    Parameters
    ----------
    path
        The file: `.dxf`, `.geojson` or `.json`.
    units
        Unit of its coordinates: a key of `UNITS`, or ``degrees`` (GeoJSON). None: what the file
        says.
    zero
        The point of the file, in its own units, that becomes (0, 0). None: the file's own origin,
        or the lower left corner where that is far away or in degrees.
    layer_property
        GeoJSON: the property that names the layer of a feature. None: the first of `layer`,
        `kind`, `class` that there is.

    Raises
    ------
    ValueError
        Naming the file, where it is none of these, has no unit, or holds no line.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".dwg":
        raise ValueError(f"{path}: DWG cannot be read: save the drawing as DXF")
    if suffix not in _SUFFIXES:
        raise ValueError(f"{path}: a drawing ends in {', '.join(_SUFFIXES)}")
    known = (*UNITS, "degrees")
    if units is not None and units not in known:
        raise ValueError(f"units must be one of {', '.join(known)}, got {units!r}")
    if suffix == ".dxf":
        if units == "degrees":
            raise ValueError(f"{path}: units of a DXF must be a length, got degrees")
        from rbl_gym.placement.plans import dxf

        return dxf.read_dxf(path, units, zero)
    if layer_property is not None and suffix == ".dxf":
        raise ValueError("layer_property is of GeoJSON only")
    from rbl_gym.placement.plans import geojson

    return geojson.read_geojson(path, units, zero, layer_property)


def scaled(drawing: Drawing, zero: tuple[float, float] | None) -> Drawing:
    """A drawing in its own unit of length as metres about `zero`, and doubts about its size."""
    if not drawing.shapes:
        kinds = sum(drawing.unread.values(), Counter())
        held = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())) or "nothing"
        raise ValueError(f"{drawing.path}: there is no line in it; it holds {held}")
    scale = UNITS[drawing.units]
    low, high = drawing.bounds()
    said = list(drawing.said)
    if zero is None:
        zero = (0.0, 0.0)
        if np.abs([low, high]).max() * scale > _FAR_M:
            step = 10 ** -math.floor(math.log10(scale)) if scale < 1 else 1.0
            zero = tuple((np.floor(low / step) * step).tolist())
            said.append(
                f"the plan is far from its origin: ({zero[0]:.10g}, {zero[1]:.10g}) "
                f"{drawing.units} of it is (0, 0) here"
            )
    width, height = (high - low) * scale
    said.append(f"the plan is {width:.4g} x {height:.4g} m")
    if not _SMALL_M <= max(width, height) <= _LARGE_M:
        said.append("this is an odd size for a building: check the unit (--units)")
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
