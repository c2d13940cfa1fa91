"""Measure where an anchor is from the walls that can be seen from it, as with a tape.

Everything is in the plan. Edges are the sides of obstacles that reach up to the anchor, and the
lines of walls for mounts. If fewer than two of them are seen, the outline of the mounts serves.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.polygons import area, contains, rectangle
from rbl_gym.placement.building import Problem

__all__ = ["measured_from"]

# An obstacle is a floor slab if it is at most this thick and at least this large. Floors above z =
# 0 begin on one.
_SLAB_M, _SLAB_M2 = 0.6, 20.0
# Obstacles that end this far below the anchor, or below this height above the floor, are racks and
# furniture, over which a tape passes.
_BELOW_M, _FURNITURE_M = 0.5, 1.8
# A tape runs this far in front of a wall; edges closer than this are the wall itself, metres.
_FREE_M, _SAME_M = 0.005, 0.02
# Points closer than this are the same, metres.
_TOUCH_M = 1e-6
# Two tapes fix a position only if the sine of the angle between them is not smaller.
_ACROSS = 0.5


def floor_below(problem: Problem, point: FloatArray) -> float:
    """Return the height of the floor below a point (3,): the top of the highest slab, or 0."""
    return slab_below(problem, point)[0]


class Slab(NamedTuple):
    """A slab: its outline (V, 2), lower and upper height, and name."""

    ring: FloatArray
    low_m: float
    high_m: float
    name: str


def slabs_of(problem: Problem) -> list[Slab]:
    """Return the slabs above z = 0: obstacles as large and as thin as a floor."""
    prisms, boxes = problem.obstacles.prisms, len(problem.obstacles.boxes)
    found = []
    for k, ring in enumerate(prisms.corners):
        low, high = float(prisms.low_m[k]), float(prisms.high_m[k])
        if high - low <= _SLAB_M and abs(area(ring)) >= _SLAB_M2 and high > 0:
            names = problem.obstacle_names
            # Without its position in the plan, which the names of a file end with.
            name = names[boxes + k].rpartition(" (")[0] if names else "slab"
            found.append(Slab(ring, low, high, name))
    return found


def slab_below(problem: Problem, point: FloatArray) -> tuple[float, str]:
    """Return the top and the name of the highest slab between z = 0 and a point; 0, "" if none."""
    top, found = 0.0, ""
    for ring, _, high, name in slabs_of(problem):
        if top < high <= point[2] and contains(ring, point[None, :2], -1e-3)[0]:
            top, found = high, name
    return top, found


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


def measured_from(problem: Problem, anchor: FloatArray, normal: FloatArray) -> list[dict[str, Any]]:
    """Return up to two distances in the plan that fix where an anchor (3,) is.

    Each has ``side``, ``to``, ``x_m``, ``y_m`` and ``distance_m``. The point (x, y) can be seen
    from the anchor. For an anchor on a wall, the sides are ``left`` and ``right`` as one faces the
    wall, and `to` is the next wall in the corner, or ``end of the wall``. For others the distances
    are at right angles to two walls, or to an ``edge of the mount`` where no wall is seen, and the
    side is the direction of the wall. A wall or obstacle of a file has the name of
    `Problem.obstacle_names`; the line of a mount is called ``wall``.

    Parameters
    ----------
    problem, anchor
        The problem, and the position of the anchor, metres.
    normal
        Direction (3,) in which the anchor faces; zero for all directions.
    """
    place, (edges, names) = anchor[:2], _edges(problem, anchor)
    if abs(normal[2]) < 0.5 and normal.any():
        found = _along_wall(place, normal[:2] / np.linalg.norm(normal[:2]), edges, names)
    else:
        found = _at_right_angles(place, edges, names)
        if len(found) < 2:
            more = _outline(problem)
            names += ["edge of the mount"] * len(more)
            found = _at_right_angles(place, np.concatenate([edges, more]), names)
    rows = []
    for side, to, point in found:
        x, y = (round(float(value), 3) + 0.0 for value in point)
        away = round(float(np.linalg.norm(point - place)), 3)
        rows.append({"side": side, "to": to, "x_m": x, "y_m": y, "distance_m": away})
    return rows


def _along_wall(
    place: FloatArray, normal: FloatArray, edges: FloatArray, names: list[str]
) -> list[tuple[str, str, FloatArray]]:
    """Return the ends of the wall of a position, to the left and to the right of it."""
    left = np.array([normal[1], -normal[0]])
    sides = [("left", left), ("right", -left)]
    ends = [_end(place, along, edges) for _, along in sides]
    found: list[tuple[str, str, FloatArray]] = []
    for (side, along), end in zip(sides, ends, strict=True):
        # An anchor in the corner touches the next wall: only edges that the tape would enter.
        across = edges[:, 1] - edges[:, 0]
        ahead = np.flatnonzero(along[1] * across[:, 0] - along[0] * across[:, 1] > 0)
        start = place + _FREE_M * normal - _TOUCH_M * along
        hit, k = _first_hit(start, along, edges[ahead])
        hit = max(hit - _TOUCH_M, 0.0)
        if hit <= end + _SAME_M:
            found.append((side, names[ahead[k]], place + hit * along))
        elif max(ends) > 0:
            found.append((side, "end of the wall", place + end * along))
    return found


def _end(place: FloatArray, along: FloatArray, edges: FloatArray) -> float:
    """Return the distance to the end of the edges on the line through a position."""
    off = edges - place
    on_line = (np.abs(off @ np.array([-along[1], along[0]])) < 1e-3).all(axis=1)
    reaches = np.sort(off[on_line] @ along, axis=1)
    end = 0.0
    while True:
        joined = reaches[(reaches[:, 0] <= end + _SAME_M) & (reaches[:, 1] > end + 1e-9)]
        if not len(joined):
            return end
        end = float(joined[:, 1].max())


def _first_hit(start: FloatArray, along: FloatArray, edges: FloatArray) -> tuple[float, int]:
    """Return the distance along a ray to the first edge, and its index; infinite if none."""
    side = edges[:, 1] - edges[:, 0]
    off = edges[:, 0] - start
    turn = along[0] * side[:, 1] - along[1] * side[:, 0]
    crosses = np.abs(turn) > 1e-9
    safe = np.where(crosses, turn, 1.0)
    reach = (off[:, 0] * side[:, 1] - off[:, 1] * side[:, 0]) / safe
    share = (off[:, 0] * along[1] - off[:, 1] * along[0]) / safe
    hit = crosses & (reach > 1e-9) & (share >= -1e-9) & (share <= 1 + 1e-9)
    least = float(reach[hit].min(initial=np.inf))
    return least, int((hit & (reach <= least + _TOUCH_M)).argmax()) if hit.any() else -1


def _at_right_angles(
    place: FloatArray, edges: FloatArray, names: list[str]
) -> list[tuple[str, str, FloatArray]]:
    """Return the nearest visible wall, and the nearest one across it, at right angles to each."""
    side = edges[:, 1] - edges[:, 0]
    length = np.linalg.norm(side, axis=1)
    side = side / np.maximum(length, 1e-9)[:, None]
    share = ((place - edges[:, 0]) * side).sum(axis=1)
    feet = edges[:, 0] + share[:, None] * side
    distance = np.linalg.norm(feet - place, axis=1)
    on_edge = (length > 1e-6) & (share >= -1e-9) & (share <= length + 1e-9)
    found: list[tuple[str, str, FloatArray]] = []
    first: FloatArray | None = None
    for k in np.argsort(np.round(distance, 6), kind="stable").tolist():
        if not on_edge[k]:
            continue
        # The wall is to the left of its edge; an anchor may touch it.
        inward = np.array([-side[k, 1], side[k, 0]])
        along = inward if distance[k] < _SAME_M else (feet[k] - place) / distance[k]
        if first is not None and abs(along[0] * first[1] - along[1] * first[0]) < _ACROSS:
            continue
        if _first_hit(place, along, edges)[0] < distance[k] - _TOUCH_M:
            continue
        found.append((direction(np.array([*along, 0.0])), names[k], feet[k]))
        if first is not None:
            break
        first = along
    return found


def _edges(problem: Problem, anchor: FloatArray) -> tuple[FloatArray, list[str]]:
    """Return edges (K, 2, 2) of the obstacles that reach an anchor, and of mounts on walls.

    The solid side is to the left of an edge. The second result are the names of what is there.
    """
    prisms = problem.obstacles.prisms
    lows, highs = box_bounds(problem.obstacles.boxes)
    rings = [*rectangle(lows, highs), *prisms.corners]
    bottom, top = np.append(lows[:, 2], prisms.low_m), np.append(highs[:, 2], prisms.high_m)
    z = float(anchor[2])
    head = min(z - 1e-6, max(z - _BELOW_M, floor_below(problem, anchor) + _FURNITURE_M))
    names = problem.obstacle_names or [f"obstacle {k + 1}" for k in range(len(rings))]
    found, titles = [], []
    for k in np.flatnonzero((bottom < z) & (top > head)).tolist():
        found.append(np.stack([rings[k], np.roll(rings[k], -1, axis=0)], axis=1))
        titles += [names[k]] * len(rings[k])
    faces = problem.mounts.faces
    upright = (np.abs(faces.axes[..., 2]) > 0.5) & (faces.extents > 0)
    for k in np.flatnonzero(upright.any(axis=1)).tolist():
        flat = [i for i in range(3) if faces.extents[k, i] > 0 and not upright[k, i]]
        if len(flat) == 1:
            end = faces.origin[k] + faces.extents[k, flat[0]] * faces.axes[k, flat[0]]
            line = np.array([faces.origin[k][:2], end[:2]])
            away = line[1] - line[0]
            faces_left = away[0] * faces.normal[k, 1] > away[1] * faces.normal[k, 0]
            found.append(line[None, ::-1] if faces_left else line[None])
            titles.append("wall")
    return np.concatenate([*found, np.empty((0, 2, 2))]), titles


def _outline(problem: Problem) -> FloatArray:
    """Return the outline (K, 2, 2) of mounts that are areas in the plan."""
    if not isinstance(problem.mounts, Mounts):
        return np.empty((0, 2, 2))
    corners = np.round(problem.mounts.pieces[:, :6].reshape(-1, 3, 2), 6)
    corners = corners[(corners[:, 1] != corners[:, 2]).any(axis=1)]
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)
    # A side of two triangles is inside.
    keys = [tuple(sorted(map(tuple, side.tolist()))) for side in sides]
    count = Counter(keys)
    return sides[[count[key] == 1 for key in keys]]
