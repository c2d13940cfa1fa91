"""Plans of a small office, 12 x 8 m with two rooms on the right, as the tests write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

OUTER = [(0, 0), (12, 0), (12, 8), (0, 8)]
INNER = [[(6, 0), (6, 3)], [(6, 4.2), (6, 8)], [(6, 5), (12, 5)]]
OPEN_PLAN = [(0.5, 0.5), (5.5, 0.5), (5.5, 7.5), (0.5, 7.5)]
MEETING = [(6.5, 0.5), (11.5, 0.5), (11.5, 4.5), (6.5, 4.5)]
DESK = [(0, 0), (1.6, 0), (1.6, 0.8), (0, 0.8)]


def write_dxf(path: Path, insunits: int = 4, scale: float = 1000.0) -> str:
    """The office by ezdxf, in units of 1 / `scale` metres, on layers as architects call them."""
    from ezdxf.filemanagement import new

    document = new("R2010")
    document.header["$INSUNITS"] = insunits
    model = document.modelspace()

    def points(line: Any) -> list[tuple[float, float]]:
        return [(x * scale, y * scale) for x, y in line]

    model.add_lwpolyline(points(OUTER), close=True, dxfattribs={"layer": "A-WALL-EXT"})
    for line in INNER:
        model.add_line(*points(line), dxfattribs={"layer": "A-WALL-INT"})
    # A lens of two bulges, a circle, and a block turned by 90 degrees, drawn on layer 0.
    bulged = [(2 * scale, 6 * scale, 0.5), (3 * scale, 6 * scale, 0.5)]
    model.add_lwpolyline(bulged, "xyb", close=True, dxfattribs={"layer": "FURNITURE"})
    model.add_circle((4 * scale, 4 * scale), 0.3 * scale, dxfattribs={"layer": "FURNITURE"})
    block = document.blocks.new("DESK")
    block.add_lwpolyline(points(DESK), close=True, dxfattribs={"layer": "0"})
    at = {"layer": "FURNITURE", "rotation": 90.0}
    model.add_blockref("DESK", (9 * scale, 6 * scale), dxfattribs=at)
    hatch = model.add_hatch(dxfattribs={"layer": "ZONES"})
    hatch.paths.add_polyline_path(points(OPEN_PLAN), is_closed=True)
    # The other zone as four lines, in no order, and its name inside.
    corners = points(MEETING)
    for start, end in ((0, 1), (3, 2), (1, 2), (3, 0)):
        model.add_line(corners[start], corners[end], dxfattribs={"layer": "ZONES"})
    at = {"layer": "ZONES", "insert": (8 * scale, 2 * scale)}
    model.add_mtext("meeting\\Proom", dxfattribs=at)
    model.add_linear_dim(
        base=(0, -scale), p1=(0, 0), p2=(12 * scale, 0), dxfattribs={"layer": "DIM"}
    ).render()
    model.add_text("Office", dxfattribs={"layer": "DIM"})
    document.saveas(path)
    return str(path)


def write_geojson(path: Path, place: Any = None) -> str:
    """The office as GeoJSON, its layers named by `kind`; `place` turns points into coordinates."""

    def ring(line: Any) -> Any:
        array = np.array([*line, line[0]], float)
        return (array if place is None else place(array)).tolist()

    features = [
        _feature("Polygon", [ring(OUTER)], kind="wall", material="concrete", height=3.2),
        *(
            _feature("LineString", ring(line)[:-1], kind="wall", material="drywall", thickness=0.1)
            for line in INNER
        ),
        _feature("Polygon", [ring(OPEN_PLAN)], kind="zone", name="open plan", position_m=0.2),
        _feature("Polygon", [ring(MEETING)], kind="zone", name="meeting room", height=1.8),
        _feature(
            "Polygon", [ring((np.array(DESK) + (2, 2)).tolist())], kind="obstacle", height=1.1
        ),
        _feature("Polygon", [ring(OUTER)], kind="mounts"),
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return str(path)


def _feature(form: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    geometry = {"type": form, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def write_png(path: Path) -> str:
    """A picture of 240 x 160 pixels: walls black on white, 5 cm a pixel."""
    from matplotlib.image import imsave

    image = np.ones((160, 240, 3))
    image[[0, -1]] = image[:, [0, -1]] = image[:100, 119:121] = 0.0
    imsave(path, image)
    return str(path)
