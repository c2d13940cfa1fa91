"""Shapes of pictures and pages of a placement: outlines, filled maps, label positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.polygons import contains, rectangle, to_segment
from rbl_gym.geometry.regions import Shell
from rbl_gym.placement.building import Problem, Zone
from rbl_gym.studies.placing.accuracy import Map, accuracy_map
from rbl_gym.studies.placing.answer import Placed
from rbl_gym.studies.placing.judging import limits_of
from rbl_gym.studies.placing.tape import floor_below
from rbl_gym.studies.placing.undetermined import has_heading

# Blue and vermilion of Okabe and Ito, distinguishable by everyone, and in grey.
WITHIN, BEYOND, NOTHING = "#56b4e9", "#d55e00", "#c9ced2"
# If anchors are more than this many half sizes of the zones away, maps would be too small.
_FAR = 4.0
# The colours of a map span at least this ratio, so that small variations look small.
_LEAST_CONTRAST = 1.15
# The colours of a map end at this many times the limit.
_MOST_OF_LIMIT = 3.0
# An obstacle over a whole zone is a floor if it is at most this thick, metres.
_FLOOR_M = 0.6
# An obstacle that begins this far above the floor is overhead, metres.
_HEAD_M = 1.8
# A hole of a zone is joined to its outline by a slit of this width, metres.
_SLIT_M = 0.003


class Quantity(NamedTuple):
    """A mapped quantity: a field of `Map`, its name and unit, the key of its requirement."""

    field: str
    name: str
    unit: str
    limit: str | None

    def limit_of(self, zone: Zone) -> float | None:
        """Return the limit that a zone requires; None without one."""
        return getattr(zone, self.limit) if self.limit else None


_ASKED = (
    Quantity("horizontal", "horizontal position", "m", "position_m"),
    Quantity("heading", "heading", "deg", "heading_deg"),
    Quantity("height", "height", "m", "height_m"),
)
_PLAIN = (
    Quantity("position", "position", "m", None),
    Quantity("rotation", "orientation", "deg", None),
)


def quantities(problem: Problem) -> list[Quantity]:
    """Return the quantities to map: the required ones, otherwise position and orientation."""
    asked = {q.field for q in _ASKED for z in problem.zones if q.limit_of(z) is not None}
    # What the tags do not determine would be a map of the prior.
    known = 2 if has_heading(problem) else 1
    if not asked and all(zone.attitude == "free" for zone in problem.zones):
        return list(_PLAIN[:known])
    found = [q for q in _ASKED if q.field in asked and (known == 2 or q.field != "heading")]
    return found or list(_ASKED[:known])


def has_requirement(problem: Problem) -> bool:
    """Return whether any zone has a requirement."""
    return any(limits_of(zone).any() for zone in problem.zones)


class Solid(NamedTuple):
    """An obstacle in plan: corners (V, 2), heights, information fraction behind it."""

    corners: FloatArray
    low_m: float
    high_m: float
    share: float


def solids(problem: Problem) -> list[Solid]:
    """Return all obstacles, the lowest first."""
    obstacles = problem.obstacles
    common, (lows, highs) = obstacles.blocked_information, box_bounds(obstacles.boxes)
    found = [
        Solid(rectangle(low, high), low[2], high[2], common)
        for low, high in zip(lows, highs, strict=True)
    ]
    prisms = obstacles.prisms
    for corners, low, high, share in zip(
        prisms.corners, prisms.low_m, prisms.high_m, prisms.share, strict=True
    ):
        found.append(Solid(corners, low, high, common if np.isnan(share) else share))
    return sorted(found, key=lambda solid: solid.high_m)


def solids_in_plan(problem: Problem) -> list[Solid]:
    """Return the obstacles to draw in a plan: all but floors, which would hide what is below."""
    return [
        solid
        for solid in solids(problem)
        if solid.high_m - solid.low_m > _FLOOR_M
        or not any(contains(solid.corners, zone.polygon).all() for zone in problem.zones)
    ]


def is_overhead(problem: Problem, solid: Solid) -> bool:
    """Return whether one can walk below an obstacle, such as the wall above a door."""
    middle = np.array([*solid.corners.mean(axis=0), solid.low_m])
    return solid.low_m - floor_below(problem, middle) >= _HEAD_M


def grey(share: float) -> str:
    """Return a grey level, darker for smaller information fractions."""
    return f"{0.32 + 0.36 * min(max(share, 0.0), 1.0):.2f}"


def mount_shapes(problem: Problem) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return mounts in plan as lines (2, 2) and areas (V, 2); points are lines."""
    if isinstance(problem.mounts, Shell):
        return [], []
    if isinstance(problem.mounts, Mounts):
        plan = problem.mounts.pieces[:, :6].reshape(-1, 3, 2)
        flat = (plan[:, 1] == plan[:, 2]).all(axis=-1)
        return list(plan[flat, :2]), list(plan[~flat])
    corners = rectangle(*problem.mounts.bounds())
    return list(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)), []


def sides_of(polygon: FloatArray) -> list[FloatArray]:
    """Return sides (2, 2) of a zone, without the slits that join its holes to its outline."""
    sides = np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1)
    apart = np.abs(sides[:, None] - sides[None, :, ::-1]).max(axis=(-1, -2))
    return list(sides[~(apart < _SLIT_M).any(axis=1)])


def inner_point(polygon: FloatArray, blocked: list[Solid], anchors: FloatArray) -> FloatArray:
    """Return a label position inside a zone: wide, off obstacles and anchors, near the centre."""
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    middle = 0.5 * (low + high)
    if not (high > low).all():
        return middle
    grid = np.stack(np.meshgrid(*[np.arange(1, 24) / 24] * 2), axis=-1).reshape(-1, 2)
    inside = low + grid * (high - low)
    inside = inside[contains(polygon, inside)]
    if not len(inside):
        return middle
    near = [s.corners for s in blocked if (s.corners.max(0) > low).all()]
    near = [corners for corners in near if (corners.min(0) < high).all()]
    clear = np.min([_to_edge(inside, ring) for ring in (polygon, *near)], axis=0)
    for ring in near:
        clear[contains(ring, inside)] = 0.0
    away = np.linalg.norm((inside - middle) / (high - low), axis=-1)
    # Labels are wider than high: anchors beside a name are closer than those above it.
    for anchor in anchors[:, :2]:
        off = (inside - anchor) * (0.5, 1.0)
        clear = np.minimum(clear, np.linalg.norm(off, axis=-1))
    return inside[(clear / max(clear.max(), 1e-9) - away).argmax()]


def zone_labels(problem: Problem, anchors: FloatArray) -> list[tuple[str, FloatArray]]:
    """Return labels of the zones and where to write them, (2,).

    Maps show the last one of zones that are one above the other. Its label names the others, too.
    """
    zones, blocked = problem.zones, solids_in_plan(problem)
    spots = [inner_point(zone.polygon, blocked, anchors) for zone in zones]
    hidden: dict[int, list[int]] = {k: [] for k in range(len(zones))}
    for k, spot in enumerate(spots):
        over = [j for j in hidden if j > k and contains(zones[j].polygon, spot[None])[0]]
        if over:
            hidden[over[-1]] += [k, *hidden.pop(k)]
    heights = [f"{zone.name}, z {zone.low_m:g} to {zone.high_m:g} m" for zone in zones]
    return [
        (
            f"{heights[k]}\nnot shown: {'; '.join(heights[j] for j in others)}"
            if others
            else zones[k].name,
            spots[k],
        )
        for k, others in hidden.items()
    ]


def _to_edge(points: FloatArray, ring: FloatArray) -> FloatArray:
    """Return the distance from points (P, 2) to the edge of a ring."""
    return to_segment(points[:, None], ring, np.roll(ring, -1, axis=0)).min(axis=1)


def is_far(problem: Problem, anchors: FloatArray) -> bool:
    """Return whether the anchors are so far away that only the zones can be shown."""
    low, high = problem.corners()
    reach = np.abs(anchors - 0.5 * (low + high))[:, :2].max(initial=0.0)
    return bool(reach > _FAR * 0.5 * (high - low)[:2].max())


def limits(problem: Problem, anchors: FloatArray) -> FloatArray:
    """Return lower and upper corner (2, 2) of the plan."""
    points = [corner[:2] for corner in problem.corners()]
    far = is_far(problem, anchors)
    if not far:
        points += [anchor[:2] for anchor in anchors]
        points += [corner for solid in solids(problem) for corner in solid.corners]
        lines, areas = mount_shapes(problem)
        points += [corner for shape in (*lines, *areas) for corner in shape]
    array = np.array(points)
    extent = np.ptp(array, axis=0)
    around = (0.2 if far else 0.03) * np.maximum(extent, 0.2 * extent.max())
    return np.array([array.min(axis=0) - around, array.max(axis=0) + around])


def is_kept(problem: Problem, anchor: FloatArray) -> bool:
    """Return whether an anchor (3,) is one of those that stay."""
    return bool((np.abs(problem.fixed - anchor).max(axis=-1, initial=0.0) < 1e-6).any())


def shown_place(place: FloatArray, edges: FloatArray) -> tuple[FloatArray, bool]:
    """Return where to draw an anchor (2,): its position, or the edge of the plan towards it."""
    if (place >= edges[0]).all() and (place <= edges[1]).all():
        return place, False
    centre = edges.mean(axis=0)
    away = place - centre
    edge = 0.93 * np.where(away > 0, edges[1] - centre, centre - edges[0])
    return centre + (edge / np.maximum(np.abs(away), 1e-12)).min() * away, True


# --- maps ------------------------------------------------------------------------------------


class Layer(NamedTuple):
    """A filled map of a zone: edges of its columns and rows (2,), values (rows, columns)."""

    zone: Any
    left: float
    right: float
    bottom: float
    top: float
    values: FloatArray
    free: Any


def maps_of(placed: Placed, share: float = 0.5) -> list[Map]:
    """Return the map of each zone at this fraction of its height; of the worst loss if asked."""
    problem, anchors, survive = placed.problem, placed.design.anchors, placed.result["survive"]
    return [accuracy_map(problem, anchors, share, zone, survive) for zone in problem.zones]


def layers(problem: Problem, maps: list[Map], field: str) -> list[Layer]:
    """Return the layers of one field, or of ``"relative"``: the largest error-to-limit ratio."""
    return [
        layer_of(zone, one, values_of(zone, one, field))
        for zone, one in zip(problem.zones, maps, strict=True)
    ]


def values_of(zone: Any, one: Map, field: str) -> FloatArray:
    """Return values (rows, columns) of a map; NaN off the zone, in obstacles, without limits."""
    if field != "relative":
        return getattr(one, field)
    limits = [(q.field, q.limit_of(zone)) for q in _ASKED]
    ratios = [getattr(one, name) / limit for name, limit in limits if limit is not None]
    return np.max(ratios, axis=0) if ratios else np.full(one.position.shape, np.nan)


def layer_of(zone: Any, one: Map, values: FloatArray) -> Layer:
    """Return a map with holes filled from nearest neighbours; obstacles are drawn on top."""
    values, free = filled(values)
    (left, right), (bottom, top) = (_edges(axis) for axis in (one.columns, one.rows))
    return Layer(zone, left, right, bottom, top, values, free)


def filled(values: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return values (rows, columns) with gaps filled from nearest neighbours, and where not."""
    free = np.isfinite(values)
    if free.any() and not free.all():
        nearest: Any = ndimage.distance_transform_edt(
            ~free, return_distances=False, return_indices=True
        )
        values = values[tuple(nearest)]
    return values, free


def enlarged(values: FloatArray, zoom: int) -> FloatArray:
    """Enlarge every cell to zoom x zoom pixels, linear between the centres of cells."""
    # Ten times as fast as `ndimage.zoom`.
    for axis in (0, 1):
        count = values.shape[axis]
        at = ((np.arange(count * zoom) + 0.5) / zoom - 0.5).clip(0, count - 1)
        below = np.minimum(at.astype(int), max(count - 2, 0))
        above = np.minimum(below + 1, count - 1)
        part = np.expand_dims(at - below, axis=1 - axis)
        values = (1 - part) * values.take(below, axis) + part * values.take(above, axis)
    return values


def _edges(centres: FloatArray) -> tuple[float, float]:
    half = 0.5 * float(centres[1] - centres[0]) if len(centres) > 1 else 0.05
    return float(centres[0]) - half, float(centres[-1]) + half


def colour_range(shown: list[Layer], limit: float | None) -> tuple[float, float]:
    """Return the colour range of all zones; it shows a limit that is close to it.

    Errors far above the limit all have the last colour, so that those near it can be told apart.
    """
    values = np.concatenate([layer.values[layer.free] for layer in shown])
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(np.quantile(values, 0.99))
    if limit is not None:
        high = min(high, _MOST_OF_LIMIT * max(limit, low))
    # Include a close limit; a far one would make the map one colour.
    if limit is not None and limit < 1.5 * high:
        low, high = min(low, limit), max(high, 1.1 * limit)
    return low, max(high, _LEAST_CONTRAST * low, low + 1e-12)


# --- labels ----------------------------------------------------------------------------------


def spread_labels(
    points: FloatArray,
    sizes: FloatArray,
    edges: FloatArray,
    marker: float,
    taken: Sequence[tuple[FloatArray, FloatArray]] = (),
) -> FloatArray:
    """Return centres (K, 2) of labels next to points (K, 2), without overlaps; all in pixels.

    `sizes` are widths and heights of the labels, `edges` the corners (2, 2) of the view, `marker`
    half the size of a marker, `taken` centres and half sizes of existing objects.
    """
    placed: list[FloatArray] = []
    angles = np.deg2rad([25, 155, -25, -155, 90, -90, 0, 180, 60, 120, -60, -120])
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for k, point in enumerate(points):
        half = 0.5 * sizes[k]
        best, least = point, math.inf
        for step, reach in enumerate((1.0, 2.2, 3.6, 5.5, 8.0)):
            for turn, direction in enumerate(directions):
                centre = point + direction * (half + marker * (0.6 + reach))
                cost = 3.0 * step + 0.1 * turn
                cost += 40.0 * sum(
                    _overlap(centre, half, other, 0.5 * sizes[j]) for j, other in enumerate(placed)
                )
                cost += 12.0 * sum(_overlap(centre, half, other, marker) for other in points)
                cost += 30.0 * sum(_overlap(centre, half, *other) for other in taken)
                outside = np.maximum(edges[0] - (centre - half), centre + half - edges[1])
                cost += 30.0 * float((outside > 0).any())
                if cost < least:
                    best, least = centre, cost
            if least < 3.0 * (step + 1):
                break
        placed.append(best)
    return np.array(placed).reshape(-1, 2)


def needs_leader(
    place: FloatArray, size: FloatArray, point: FloatArray, points: FloatArray, far: float
) -> bool:
    """Return whether a label needs a line to its marker: it is far, or near another marker, too.

    `place` and `size` are centre and size of the label, `point` its marker, `points` (K, 2) the
    markers of all labels, `far` the distance beyond the label that is far; all in pixels.
    """
    gaps = np.linalg.norm(np.maximum(np.abs(points - place) - 0.5 * size, 0.0), axis=-1)
    own = (points == point).all(axis=-1)
    gap = gaps[own].min()
    return bool(gap > far or (gaps[~own] < 1.5 * gap).any())


def _overlap(a: FloatArray, half_a: FloatArray, b: FloatArray, half_b: Any) -> bool:
    return bool((np.abs(a - b) < half_a + half_b - 0.5).all())
