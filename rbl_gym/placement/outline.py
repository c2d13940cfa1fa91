"""Notes on zones, mounts and fixed anchors outside the walls of a building.

Such parts are often due to a wrong unit, axis or sign. They are not errors: a yard may be a zone.
Needs shapely (extra ``placement``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.building import Problem
from rbl_gym.placement.file_walls import WallPieces
from rbl_gym.placement.mounting import Mount, shapely_module

# Gaps in the outer wall that are closed to find the outline, metres: none, doors, gates.
_GAPS_M = 0.0, 2.0, 6.0
# The outline is that of the building if this share of the zones or of the mounts lies inside.
_MOST = 0.5
# Parts this near to the outline are not outside, metres.
_NEAR_M = 0.05
# Maximum number of notes.
_MOST_NOTES = 6


def outside(problem: Problem, walls: WallPieces, mounts: list[Mount]) -> tuple[str, ...]:
    """Return notes on what lies outside the walls, above or below them; by how much.

    There are no notes if the walls do not enclose most of the zones or of the mounts.

    Parameters
    ----------
    problem, walls, mounts
        The problem, and the walls and mounts of its file.
    """
    shapely = shapely_module()
    zones = [(_title(zone.name), _shape(shapely, zone.polygon)) for zone in problem.zones]
    faces = [(f"Mount {mount.name!r}", _shape(shapely, mount.shape)) for mount in mounts]
    building = _outline(shapely, walls, [shape for _, shape in zones], [s for _, s in faces])
    if building is None:
        return ()
    found = list(_beside(shapely, building, zones + faces))
    spots = [
        (f"anchors.fixed[{k}]", shapely.Point(*place[:2])) for k, place in enumerate(problem.fixed)
    ]
    found += _beside(shapely, building, spots)
    heights = [(_title(zone.name), zone.low_m, zone.high_m) for zone in problem.zones]
    heights += [(f"Mount {mount.name!r}", mount.low_m, mount.high_m) for mount in mounts]
    found += _above_or_below(heights, float(walls.low_m.min()), float(walls.high_m.max()))
    if len(found) > _MOST_NOTES:
        more = len(found) - _MOST_NOTES
        found = [*found[:_MOST_NOTES], f"{more} more zones or mounts lie outside the walls."]
    return tuple(found)


def _title(name: str) -> str:
    return "The region" if name == "region" else f"Zone {name!r}"


def _shape(shapely: Any, corners: FloatArray) -> Any:
    """Return corners (V, 2) as a shape with or without area."""
    if len(corners) > 2:
        shape = shapely.make_valid(shapely.Polygon(corners))
        if shape.area > 0:
            return shape
    return shapely.LineString(corners) if len(corners) > 1 else shapely.Point(corners[0])


def _outline(shapely: Any, walls: WallPieces, zones: list[Any], mounts: list[Any]) -> Any:
    """Return what the walls enclose, with the walls; None if it is not the building."""
    if not len(walls.start):
        return None
    lines = shapely.linestrings(np.stack([walls.start, walls.end], axis=1))
    union = shapely.union_all(shapely.buffer(lines, walls.half_m, cap_style="square"))
    for gap in _GAPS_M:
        # Growing by half the gap closes it.
        grown = shapely.buffer(union, 0.5 * gap, join_style="mitre")
        parts = shapely.get_parts(grown)
        filled = shapely.union_all(shapely.polygons(shapely.get_exterior_ring(parts)))
        filled = shapely.buffer(filled, -0.5 * gap, join_style="mitre")
        inner = shapely.buffer(filled, -1e-3)
        if any(_share(inner, shapes) >= _MOST for shapes in (zones, mounts)):
            return filled
    return None


def _share(inner: Any, shapes: list[Any]) -> float:
    """Return the share of shapes inside, by the largest measure they all have: area or length."""
    for measure in ("area", "length"):
        whole = sum(getattr(shape, measure) for shape in shapes)
        if whole > 0:
            return sum(getattr(shape.intersection(inner), measure) for shape in shapes) / whole
    return sum(shape.intersects(inner) for shape in shapes) / max(len(shapes), 1)


def _beside(shapely: Any, building: Any, shapes: list[tuple[str, Any]]) -> Iterator[str]:
    """Yield a note for every shape that is partly outside in plan."""
    for name, shape in shapes:
        rest = shape.difference(building)
        if rest.is_empty:
            continue
        corners = shapely.points(shapely.get_coordinates(rest))
        reach = float(shapely.distance(corners, building).max())
        if reach <= _NEAR_M:
            continue
        part = ""
        if shape.area > 0:
            share = rest.area / shape.area
            part = f"{100 * share:.2g} % of its area, " if share < 1 else "all of it, "
        yield f"{name} lies outside the walls: {part}up to {reach:.3g} m away from them."


def _above_or_below(
    heights: list[tuple[str, float, float]], floor: float, top: float
) -> Iterator[str]:
    for name, low, high in heights:
        if high > top + _NEAR_M:
            yield f"{name} reaches {high - top:.3g} m above the walls, which end at {top:g} m."
        if low < floor - _NEAR_M:
            yield f"{name} reaches {floor - low:.3g} m below the walls, which begin at {floor:g} m."
