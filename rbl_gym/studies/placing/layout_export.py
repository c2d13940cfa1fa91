"""Export a layout for mounting: a list, and files for tables, maps or drawing programs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.polygons import area, contains, rectangle
from rbl_gym.placement.plans.drawing import UNITS
from rbl_gym.placement.scene_files import Problem
from rbl_gym.recordings.writing import write_table

__all__ = ["LAYER", "SUFFIXES", "mounting_list", "write_layout"]

SUFFIXES = (".csv", ".geojson", ".dxf")
# Layer of the written DXF file; its previous content is replaced.
LAYER = "RBL-ANCHORS"
# An obstacle is a floor slab if it is at most this thick and at least this large. Floors above z =
# 0 begin on one.
_SLAB_M, _SLAB_M2 = 0.6, 20.0
# Radius of the circle that marks an anchor in a drawing, metres.
_MARK_M = 0.15


def mounting_list(
    problem: Problem, anchors: FloatArray, names: list[str] | None = None
) -> list[dict[str, Any]]:
    """Return what is needed to mount each anchor, as plain values.

    Keys: ``name``, ``x_m``, ``y_m``, ``z_m``, ``mount`` (name), ``above_floor_m`` (height above z =
    0, or above the top of the slab below), ``faces`` (``down``, ``+x``, an angle from +x in
    degrees, or ``any``), and ``corners``: up to two dicts with ``x_m``, ``y_m`` of a corner of the
    mount and the distance ``distance_m`` to it along the wall or ceiling.

    Parameters
    ----------
    problem, anchors
        The placement problem, and the anchor positions (M, 3), metres.
    names
        Names of the anchors; None: numbers from 1, in their order.
    """
    anchors = check_array("anchors", anchors, ("M", 3))
    names = [str(k + 1) for k in range(len(anchors))] if names is None else names
    mounts, normals = problem.mounts.names(anchors), problem.mounts.normal(anchors)
    rows = []
    for name, anchor, mount, normal in zip(names, anchors, mounts, normals, strict=True):
        x, y, z = (round(value, 3) + 0.0 for value in anchor.tolist())
        rows.append(
            {
                "name": name,
                "x_m": x,
                "y_m": y,
                "z_m": z,
                "mount": mount,
                "above_floor_m": round(z - floor_below(problem, anchor), 3),
                "faces": direction(normal),
                "corners": _corners(problem, anchor, normal),
            }
        )
    return rows


def floor_below(problem: Problem, point: FloatArray) -> float:
    """Return the height of the floor below a point (3,): the top of the highest slab, or 0."""
    prisms = problem.obstacles.prisms
    tops = [0.0]
    for ring, low, high in zip(prisms.corners, prisms.low_m, prisms.high_m, strict=True):
        slab = high - low <= _SLAB_M and abs(area(ring)) >= _SLAB_M2
        if slab and high <= point[2] and contains(ring, point[None, :2], -1e-3)[0]:
            tops.append(float(high))
    return max(tops) if point[2] >= 0 else 0.0


def direction(normal: FloatArray) -> str:
    """Return the direction an anchor faces, in words."""
    if not normal.any():
        return "any"
    if abs(normal[2]) > 0.99:
        return "down" if normal[2] < 0 else "up"
    angle = math.degrees(math.atan2(normal[1], normal[0])) % 360
    nearest = round(angle / 90)
    if abs(angle - 90 * nearest) < 0.5:
        return ("+x", "+y", "-x", "-y")[nearest % 4]
    return f"{angle:.0f} deg"


def _corners(problem: Problem, anchor: FloatArray, normal: FloatArray) -> list[dict[str, float]]:
    """Return both ends of the wall, or two near corners of a flat mount; none for points."""
    faces, plan = problem.mounts.faces, anchor[:2]
    if not len(faces.origin) or not normal.any():
        return []
    face = int(problem.mounts.face_of(anchor[None])[0])
    axes, extents = faces.axes[face], faces.extents[face]
    flat = [k for k in range(3) if extents[k] > 0 and abs(axes[k, 2]) < 0.5]
    if isinstance(problem.mounts, Mounts):
        # Free part of the face around the anchor, up to the walls that meet it.
        pieces = problem.mounts.pieces[problem.mounts.piece_face == face]
        pieces = pieces[(pieces[:, 6] - 1e-6 <= anchor[2]) & (anchor[2] <= pieces[:, 7] + 1e-6)]
        corners = _joined(pieces[:, :6].reshape(-1, 3, 2), plan)
    else:
        corners = faces.origin[face, None, :2]
        for k in flat:
            corners = np.concatenate([corners, corners + extents[k] * axes[k, :2]])
    distance = np.linalg.norm(corners - plan, axis=-1)
    nearest = np.argsort(distance, kind="stable").tolist() if len(corners) > 1 else []
    if len(flat) == 2 and nearest:
        # Two tape measures fix a position only if they are not parallel.
        to = (corners - plan) / np.maximum(distance, 1e-9)[:, None]
        sine = np.abs(to[:, 0] * to[nearest[0], 1] - to[:, 1] * to[nearest[0], 0])
        across = [k for k in nearest[1:] if sine[k] >= 0.5] or [int(sine.argmax())]
        nearest = [nearest[0], across[0]]
    return [
        {
            "x_m": round(float(corners[k, 0]), 3),
            "y_m": round(float(corners[k, 1]), 3),
            "distance_m": round(float(distance[k]), 3),
        }
        for k in nearest[:2]
    ]


def _joined(pieces: FloatArray, place: FloatArray) -> FloatArray:
    """Return corners (K, 2) of the pieces (N, 3, 2) of a face that connect to a position (2,)."""
    corners = np.round(pieces, 6)
    if not (corners[:, 1] == corners[:, 2]).all():
        return np.unique(corners.reshape(-1, 2), axis=0)
    ends = corners[:, :2]
    away = ends[:, 1] - ends[:, 0]
    share = ((place - ends[:, 0]) * away).sum(-1) / np.maximum((away**2).sum(-1), 1e-12)
    off = np.linalg.norm(place - ends[:, 0] - share.clip(0, 1)[:, None] * away, axis=-1)
    together = off <= off.min() + 1e-6
    while True:
        near = np.abs(ends[:, None, :, None] - ends[None, together][:, :, None]).max(-1)
        grown = (near < 1e-5).any(axis=(1, 2, 3))
        if (grown == together).all():
            break
        together = grown
    found = ends[together].reshape(-1, 2)
    along = (found - place) @ away[off.argmin()]
    return found[[along.argmin(), along.argmax()]]


def write_layout(
    problem: Problem, anchors: FloatArray, path: str, names: list[str] | None = None
) -> None:
    """Write a layout to a file; create its folder if necessary.

    Parameters
    ----------
    problem, anchors, names
        As in `mounting_list`.
    path
        ``.csv``: the mounting list, which ``place --layout`` can read. ``.geojson``: points, in the
        coordinates of the drawing if the problem was read from GeoJSON, else in metres. ``.dxf``:
        the layer `LAYER`, in a copy of the drawing if the problem was read from a DXF file, else
        with the outlines of the building in metres.

    Raises
    ------
    ValueError
        If the file has another suffix.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: the name of a layout must end in one of {', '.join(SUFFIXES)}")
    rows = mounting_list(problem, anchors, names)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    {".csv": _write_csv, ".geojson": _write_geojson, ".dxf": _write_dxf}[suffix](
        problem, rows, path
    )


def _write_csv(problem: Problem, rows: list[dict[str, Any]], path: str) -> None:
    columns = [key for key in rows[0] if key != "corners"]
    ends = [f"{key}_{n}" for n in (1, 2) for key in ("corner_x_m", "corner_y_m", "distance_m")]
    cells = []
    for row in rows:
        values = [value for corner in row["corners"] for value in corner.values()]
        values += [""] * (len(ends) - len(values))
        cells.append([*(row[key] for key in columns), *values])
    write_table(path, [*columns, *ends], cells)


def _write_geojson(problem: Problem, rows: list[dict[str, Any]], path: str) -> None:
    places = np.array([[row["x_m"], row["y_m"]] for row in rows])
    plan, digits = problem.plan, 4
    if plan is not None and plan.drawing and not plan.drawing.lower().endswith(".dxf"):
        if plan.units == "degrees":
            from rbl_gym.placement.plans.geojson import to_degrees

            places, digits = to_degrees(places, plan.zero), 9
        else:
            places = places / UNITS[plan.units] + np.array(plan.zero)
    features = [
        {
            "type": "Feature",
            "geometry": {
                "type": "Point",
                "coordinates": [*(round(x, digits) for x in place), row["z_m"]],
            },
            "properties": {
                "kind": "fixed",
                **{key: value for key, value in row.items() if key != "corners"},
            },
        }
        for place, row in zip(places.tolist(), rows, strict=True)
    ]
    text = json.dumps({"type": "FeatureCollection", "features": features}, indent=1)
    Path(path).write_text(text + "\n", encoding="utf-8")


def _write_dxf(problem: Problem, rows: list[dict[str, Any]], path: str) -> None:
    from ezdxf.filemanagement import new, readfile

    plan = problem.plan
    if plan is not None and plan.drawing and plan.drawing.lower().endswith(".dxf"):
        document = readfile(plan.drawing)
        scale, zero = 1 / UNITS[plan.units], np.array(plan.zero)
    else:
        document, scale, zero = new(), 1.0, np.zeros(2)
        document.header["$INSUNITS"] = 6
        _draw_building(document, problem)
    model: Any = document.modelspace()
    if LAYER in document.layers:
        for entity in model.query(f'*[layer=="{LAYER}"]'):
            model.delete_entity(entity)
    else:
        document.layers.add(LAYER, color=1)
    at = {"layer": LAYER}
    for row in rows:
        x, y = np.array([row["x_m"], row["y_m"]]) * scale + zero
        model.add_point((x, y, row["z_m"] * scale), dxfattribs=at)
        model.add_circle((x, y), _MARK_M * scale, dxfattribs=at)
        text = model.add_text(
            f"{row['name']}  z {row['z_m']:g} m", height=_MARK_M * scale, dxfattribs=at
        )
        text.set_placement((x + 1.4 * _MARK_M * scale, y + 0.4 * _MARK_M * scale))
    document.saveas(path)


def _draw_building(document: Any, problem: Problem) -> None:
    """Add outlines of obstacles and zones, on layers that `rbl-gym plan` recognises."""
    model = document.modelspace()
    obstacles = problem.obstacles
    rings = [*rectangle(*box_bounds(obstacles.boxes)), *obstacles.prisms.corners]
    for layer, outlines in (
        ("OBSTACLES", rings),
        ("ZONES", [zone.polygon for zone in problem.zones]),
    ):
        document.layers.add(layer)
        for ring in outlines:
            model.add_lwpolyline(ring.tolist(), close=True, dxfattribs={"layer": layer})
