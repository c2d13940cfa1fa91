"""Export a layout for mounting: a list, and files for tables, maps or drawing programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.polygons import rectangle
from rbl_gym.placement.plans.drawing import UNITS
from rbl_gym.placement.scene_files import Problem
from rbl_gym.recordings.writing import write_table
from rbl_gym.studies.placing.given import mount_names
from rbl_gym.studies.placing.tape import direction, measured_from, slab_below

__all__ = ["LAYER", "SUFFIXES", "mounting_list", "write_layout"]

SUFFIXES = (".csv", ".geojson", ".dxf")
# Layer of the written DXF file; its previous content is replaced.
LAYER = "RBL-ANCHORS"
# Radius of the circle that marks an anchor in a drawing, metres.
_MARK_M = 0.15


def mounting_list(
    problem: Problem, anchors: FloatArray, names: list[str] | None = None
) -> list[dict[str, Any]]:
    """Return what is needed to mount each anchor, as plain values.

    Keys: ``name``, ``x_m``, ``y_m``, ``z_m``, ``mount`` (name, or ``no mount``), ``above_floor_m``
    (height above the floor of the building, z = 0), ``above_slab_m`` and ``slab`` (height above the
    slab between that floor and the anchor, and its name; empty texts without one), ``faces``
    (``down``, ``+x``, an angle from +x in degrees, or ``any``), and ``measured``: up to two
    distances from walls (`tape.measured_from`).

    Parameters
    ----------
    problem, anchors
        The placement problem, and the anchor positions (M, 3), metres.
    names
        Names of the anchors; None: numbers from 1, in their order.
    """
    anchors = check_array("anchors", anchors, ("M", 3))
    names = [str(k + 1) for k in range(len(anchors))] if names is None else names
    mounts, normals = mount_names(problem, anchors), problem.mounts.normal(anchors)
    rows = []
    for name, anchor, mount, normal in zip(names, anchors, mounts, normals, strict=True):
        x, y, z = (round(value, 3) + 0.0 for value in anchor.tolist())
        top, slab = slab_below(problem, anchor)
        rows.append(
            {
                "name": name,
                "x_m": x,
                "y_m": y,
                "z_m": z,
                "mount": mount,
                "above_floor_m": z,
                "above_slab_m": round(z - top, 3) if slab else "",
                "slab": slab,
                "faces": direction(normal),
                "measured": measured_from(problem, anchor, normal),
            }
        )
    return rows


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
    columns = [key for key in rows[0] if key != "measured"]
    keys = ("side", "to", "to_x_m", "to_y_m", "distance_m")
    ends = [f"{key}_{n}" for n in (1, 2) for key in keys]
    cells = []
    for row in rows:
        values = [value for one in row["measured"] for value in one.values()]
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
                **{key: value for key, value in row.items() if key != "measured"},
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
