"""Read DXF files with ezdxf (extra ``placement``): blocks are exploded, arcs become short lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.extras import require
from rbl_gym.geometry.polygons import area, contains
from rbl_gym.placement.plans.drawing import UNITS, Drawing, Label, Shape, scaled

# Values of $INSUNITS in the header, for the units of buildings.
_INSUNITS = {1: "in", 2: "ft", 4: "mm", 5: "cm", 6: "m", 7: "km"}
# Maximum distance of an arc from the lines that replace it, metres.
_FLATTENING_M = 0.02
# Entities that ezdxf converts to paths; all others are counted as unread.
_PATHS = {"LINE", "LWPOLYLINE", "POLYLINE", "CIRCLE", "ARC", "ELLIPSE", "SPLINE", "SOLID", "TRACE",
          "3DFACE"}  # fmt: skip
_TEXTS = {"TEXT", "MTEXT"}
# Maximum depth of nested blocks.
_DEPTH = 16


def read_dxf(path: str, units: str | None, zero: tuple[float, float] | None) -> Drawing:
    """Return the shapes of the model space. Arguments and errors as in `reading.read_drawing`."""
    document = _open(path)
    code = int(document.header.get("$INSUNITS", 0))
    named = _INSUNITS.get(code)
    model = document.modelspace()
    said = []
    if units is None:
        if named is None:
            size = _rough_size(model)
            raise ValueError(
                f"{path}: the drawing does not state its unit ($INSUNITS = {code}){size}: give "
                f"--units, one of {', '.join(UNITS)}"
            )
        units = named
        said.append(f"unit of the drawing: {units} ($INSUNITS = {code})")
    else:
        other = f"{named} ($INSUNITS = {code})" if named else f"$INSUNITS = {code}"
        said.append(
            f"unit of the drawing: {units}, as given"
            + ("" if named == units else f"; the drawing itself states {other}")
        )
    found = _Found(_FLATTENING_M / UNITS[units])
    for entity in model:
        found.take(entity, str(entity.dxf.get("layer", "0")), 0)
    for what, count in sorted(found.skipped.items()):
        said.append(f"{count} {what}")
    hidden = [layer.dxf.name for layer in document.layers if layer.is_off() or layer.is_frozen()]
    used = {shape.layer for shape in found.shapes}
    if hidden := sorted(used & set(hidden)):
        said.append(f"layers that are off or frozen in the drawing: {', '.join(hidden)}")
    drawing = Drawing(path, units, (0.0, 0.0), found.shapes, found.labels, found.unread, said)
    return scaled(drawing, zero)


class _Found:
    """Collect shapes, labels and unread entities of a drawing and its blocks."""

    def __init__(self, distance: float) -> None:
        self.distance = distance
        self.shapes: list[Shape] = []
        self.labels: list[Label] = []
        self.unread: dict[str, Counter[str]] = {}
        self.skipped: Counter[str] = Counter()

    def take(self, entity: Any, layer: str, depth: int) -> None:
        kind = entity.dxftype()
        try:
            shapes = list(self.shapes_of(entity, kind, layer, depth))
        except (TypeError, ValueError, ArithmeticError, LookupError, AttributeError):
            # ezdxf cannot read a damaged entity.
            shapes = None
        if shapes is None:
            self.unread.setdefault(layer, Counter())[kind] += 1
        else:
            self.shapes += shapes

    def shapes_of(self, entity: Any, kind: str, layer: str, depth: int) -> Iterator[Shape]:
        from ezdxf import path as paths

        if kind == "INSERT":
            self.explode(entity, layer, depth)
        elif kind == "MLINE":
            for part in entity.virtual_entities():
                self.take(part, layer, depth)
        elif kind in _TEXTS:
            text = entity.plain_text() if kind == "MTEXT" else entity.dxf.text
            self.labels.append(Label(layer, " ".join(text.split()), _middle(entity, kind)))
        elif kind == "POINT":
            yield _mark(entity.dxf.location, layer, kind)
        elif kind == "HATCH":
            rings = [
                ring
                for path in paths.from_hatch(entity)
                if (ring := self.flat(path)[0]) is not None
            ]
            yield from _with_holes(rings, layer, kind)
        elif kind in _PATHS:
            whole = paths.make_path(entity)
            parts = whole.sub_paths() if whole.has_sub_paths else [whole]
            for part in parts:
                points, closed = self.flat(part)
                if points is not None:
                    yield Shape(layer, kind, points, closed)
        else:
            raise TypeError(kind)

    def explode(self, insert: Any, layer: str, depth: int) -> None:
        """Add the content of a block; shapes on layer 0 go to the layer of the insert."""
        block = insert.block()
        if block is None or depth >= _DEPTH:
            raise ValueError("no block")
        if block.block.is_xref:
            what = f"references to another drawing ({block.name}): bind or read that drawing"
            self.skipped[what] += 1
            return
        if not len(block):
            return
        self.shapes.append(_mark(insert.dxf.insert, layer, "INSERT"))
        for one in insert.multi_insert() if insert.mcount > 1 else [insert]:
            for part in one.virtual_entities(
                skipped_entity_callback=lambda e, _: self.skip(e, layer)
            ):
                own = str(part.dxf.get("layer", "0"))
                self.take(part, layer if own == "0" else own, depth + 1)

    def skip(self, entity: Any, layer: str) -> None:
        self.unread.setdefault(layer, Counter())[entity.dxftype()] += 1

    def flat(self, path: Any) -> tuple[FloatArray | None, bool]:
        """Return a path in plan, (n, 2), and whether it is a ring; None for a single point."""
        points = np.array([point.vec2 for point in path.flattening(self.distance, 2)])
        if len(points) < 2:
            return None, False
        step = np.abs(np.diff(points, axis=0)).max(axis=1) > 1e-9 * max(1.0, np.abs(points).max())
        points = points[np.append(True, step)]
        closed = bool(path.is_closed) and len(points) > 3
        if closed:
            points = points[:-1]
        return (points, closed) if len(points) > 1 else (None, False)


def _with_holes(rings: list[FloatArray], layer: str, kind: str) -> Iterator[Shape]:
    """Yield the shapes of a hatch, with their holes.

    A ring inside an odd number of others is a hole of the smallest of them.
    """
    inside = [
        [k for k, other in enumerate(rings) if k != j and contains(other, ring[:1])[0]]
        for j, ring in enumerate(rings)
    ]
    for j, ring in enumerate(rings):
        if len(inside[j]) % 2 or len(ring) < 3:
            continue
        holes = tuple(
            other
            for k, other in enumerate(rings)
            if len(inside[k]) == len(inside[j]) + 1
            and j == min(inside[k], key=lambda i: abs(area(rings[i])))
        )
        yield Shape(layer, kind, ring, True, holes)


def _mark(at: Any, layer: str, kind: str) -> Shape:
    return Shape(layer, kind, np.array([[at.x, at.y]]), properties={"z": float(at.z)})


def _middle(entity: Any, kind: str) -> FloatArray:
    at = entity.dxf.insert
    if kind == "TEXT" and entity.dxf.hasattr("align_point") and entity.dxf.get("halign", 0):
        at = entity.dxf.align_point
    return np.array([at.x, at.y])


def _open(path: str) -> Any:
    """Open the document; a damaged one is repaired if possible."""
    require("ezdxf", "placement", "a drawing (.dxf)")
    from ezdxf import recover
    from ezdxf.filemanagement import readfile
    from ezdxf.lldxf.const import DXFError

    with Path(path).open("rb"):  # an OSError names the file
        pass
    try:
        return readfile(path)
    except (OSError, DXFError, UnicodeError, ValueError):
        pass
    try:
        document, auditor = recover.readfile(path)
    except (OSError, DXFError, UnicodeError, ValueError, LookupError) as error:
        raise ValueError(f"{path}: not a DXF file: {error}") from error
    if auditor.has_errors:
        raise ValueError(f"{path}: the DXF file is damaged: {auditor.errors[0].message}")
    return document


def _rough_size(model: Any) -> str:
    """Return the size in units, for an error message."""
    from ezdxf import bbox

    box = bbox.extents(model, fast=True)
    if not box.has_data:
        return ""
    return f" and is {box.size.x:.6g} x {box.size.y:.6g} units"
