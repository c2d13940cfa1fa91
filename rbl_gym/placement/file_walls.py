"""Obstacles and mounts of a building from the tables of a file: walls, obstacles, slabs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, did_you_mean
from rbl_gym.geometry.obstacles import Obstacles, Prisms
from rbl_gym.geometry.polygons import TOUCH_M, check_polygon, rectangle
from rbl_gym.placement.file_keys import MATERIALS
from rbl_gym.placement.mounting import Mount

# Mitres longer than this many half thicknesses are cut off.
_LONGEST_MITRE = 4.0
# A mount is parallel to a wall if their directions differ by less than this, radians.
_PARALLEL = 1e-3


class WallPieces(NamedTuple):
    """Straight wall pieces: ends (W, 2) in plan, half thickness and heights (W,)."""

    start: FloatArray
    end: FloatArray
    half_m: FloatArray
    low_m: FloatArray
    high_m: FloatArray


class Solids(NamedTuple):
    """Polygons with heights and information fractions, collected from the tables."""

    rings: list[FloatArray]
    low: list[float]
    high: list[float]
    share: list[float]

    def add(self, ring: FloatArray, low: float, high: float, share: float) -> None:
        """Add a polygon."""
        self.rings.append(ring)
        self.low.append(low)
        self.high.append(high)
        self.share.append(share)


def read_obstacles(
    tables: Mapping[str, list[dict[str, Any]]], materials: Mapping[str, float], blocked: float
) -> tuple[Obstacles, WallPieces]:
    """Return all obstacles, and the walls piece by piece.

    `tables` are ``obstacles``, ``walls``, ``slabs``, and whether there are ``mounts``. `materials`
    are information fractions by name, which override those of the standard materials; `blocked` is
    that of obstacles without their own.
    """
    boxes, solids, walls = [], Solids([], [], [], []), []
    for name, table in _each(tables, "obstacles"):
        share = _share(name, table, materials)
        if "polygon" in table:
            _check_rises(name, table)
            solids.add(table["polygon"], table["low_m"], table["high_m"], share)
            continue
        low, high = np.array(table["low"]), np.array(table["high"])
        if not (high > low).all():
            raise ValueError(f"{name}: low must lie below high, got {show(low)}, {show(high)}")
        # A box includes its own faces, so that no anchor can be on them.
        is_box = math.isnan(share) and not tables.get("mounts")
        if not is_box and (high - low).min() < 1e-3:
            raise ValueError(f"{name} must be at least a millimetre wide, got {show(high - low)}")
        if is_box:
            boxes.append([*0.5 * (low + high), *0.5 * (high - low)])
        else:
            solids.add(rectangle(low, high), low[2], high[2], share)
    for name, table in _each(tables, "walls"):
        share = _share(name, table, materials)
        _check_rises(name, table)
        line, half = table["line"], 0.5 * table["thickness_m"]
        if table["closed"]:
            line = check_polygon(f"{name}.line", line)
        for ring in wall_pieces(line, half, table["closed"]):
            solids.add(ring, table["low_m"], table["high_m"], share)
        for start, end in segments(line, table["closed"]):
            walls.append((start, end, half, table["low_m"], table["high_m"]))
    for name, table in _each(tables, "slabs"):
        share = _share(name, table, materials)
        solids.add(table["polygon"], table["z_m"], table["z_m"] + table["thickness_m"], share)
    prisms = Prisms.packed(*solids)
    columns = (np.array(column) for column in zip(*walls, strict=True))
    pieces = WallPieces(*columns) if walls else WallPieces(*np.empty((2, 0, 2)), *np.empty((3, 0)))
    return Obstacles(np.array(boxes).reshape(-1, 6), blocked, prisms), pieces


def _each(tables: Mapping[str, Any], kind: str) -> list[tuple[str, dict[str, Any]]]:
    return [(f"{kind}[{i}]", table) for i, table in enumerate(tables.get(kind, []))]


def _share(name: str, table: Mapping[str, Any], materials: Mapping[str, float]) -> float:
    """Return the information fraction behind an obstacle; NaN: the common default."""
    material, share = table["material"], table["information"]
    if material is not None and share is not None:
        raise ValueError(f"{name} must have either material or information, got both")
    if material is not None:
        known = {**MATERIALS, **materials}
        if material not in known:
            raise ValueError(
                f"{name}.material must be one of [materials], which has "
                f"{', '.join(map(repr, materials)) or 'none'}, or a standard material: "
                f"{', '.join(map(repr, MATERIALS))}; got {material!r:.80}"
                f"{did_you_mean(material, known)}"
            )
        return known[material]
    return math.nan if share is None else share


def _check_rises(name: str, table: Mapping[str, Any]) -> None:
    if table["high_m"] - table["low_m"] < 1e-3:
        raise ValueError(
            f"{name}: low_m must lie below high_m, got {table['low_m']:g} and {table['high_m']:g}"
        )


def segments(line: FloatArray, closed: bool) -> list[tuple[FloatArray, FloatArray]]:
    """Return the straight pieces of a line (V, 2)."""
    ends = np.roll(line, -1, axis=0)
    return list(zip(line, ends, strict=True))[: None if closed else -1]


def wall_pieces(line: FloatArray, half: float, closed: bool) -> list[FloatArray]:
    """Return quadrilaterals (4, 2) around the pieces of a line, mitred at their joints."""
    found = []
    parts = segments(line, closed)
    along = np.array([(end - start) / np.hypot(*(end - start)) for start, end in parts])
    for i, (start, end) in enumerate(parts):
        left = half * _turned(along[i])
        joined = [closed or i > 0, closed or i + 1 < len(parts)]
        before, after = (
            _mitre(along[k % len(parts)], along[i], half) if join else left
            for k, join in zip((i - 1, i + 1), joined, strict=True)
        )
        ring = np.array([start - before, end - after, end + after, start + before])
        # Mitres of a piece that is shorter than them would cross.
        if min((ring[1] - ring[0]) @ along[i], (ring[2] - ring[3]) @ along[i]) < TOUCH_M:
            ring = np.array([start - left, end - left, end + left, start + left])
        found.append(ring)
    return found


def _mitre(one: FloatArray, other: FloatArray, half: float) -> FloatArray:
    """Return the vector from a corner of two directions to the intersection of their left sides."""
    middle = _turned(one) + _turned(other)
    square = middle @ middle
    # cos^2 of half the turn is square / 4.
    if square * _LONGEST_MITRE**2 < 4:
        return half * _turned(other)
    return 2 * half * middle / square


def _turned(direction: FloatArray) -> FloatArray:
    """Return vectors rotated by 90 degrees to the left."""
    return np.array([-direction[1], direction[0]])


def read_mounts(tables: list[dict[str, Any]], walls: WallPieces) -> list[Mount]:
    """Return the faces of all mounts; those along a wall are moved to its face."""
    found: list[Mount] = []
    for index, table in enumerate(tables):
        kind = table["kind"]
        faces = _SHAPES[kind](f"mounts[{index}]", table, walls)
        name, mark = (table["name"], " ") if table["name"] else (f"{kind} {index + 1}", ".")
        for k, face in enumerate(faces):
            label = f"{name}{mark}{k + 1}" if len(faces) > 1 and kind != "points" else name
            found.append(face._replace(cost=table["cost"], name=label))
    return found


def _wall(name: str, table: Mapping[str, Any], walls: WallPieces) -> list[Mount]:
    line = table["line"]
    if table["closed"]:
        line = check_polygon(f"{name}.line", line)
    found = []
    for side in ("left", "right"):
        if table["side"] not in (side, "both"):
            continue
        for start, end in segments(line, table["closed"]):
            ends = np.array([start, end] if side == "left" else [end, start])
            normal = _turned((ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0])))
            shift = table["offset_m"] + _in_wall(ends, normal, table, walls)
            found.append(_upright(ends + shift * normal, normal, table))
    return found


def _in_wall(
    ends: FloatArray, normal: FloatArray, table: Mapping[str, Any], walls: WallPieces
) -> float:
    """Return how far a face inside a wall, or on its other side, lies behind the wall's face."""
    direction = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    along = walls.end - walls.start
    turn = np.abs(along @ normal) / np.hypot(*along.T)
    behind = (ends.mean(axis=0) - 0.5 * (walls.start + walls.end)) @ normal
    places = np.stack([walls.start - ends[0], walls.end - ends[0]]) @ direction
    length = np.hypot(*(ends[1] - ends[0]))
    inside = (turn <= _PARALLEL) & (np.abs(behind) <= walls.half_m + 1e-6)
    inside &= (walls.low_m < table["high_m"]) & (walls.high_m > table["low_m"])
    inside &= (places.max(axis=0) > 1e-6) & (places.min(axis=0) < length - 1e-6)
    return float((walls.half_m - behind)[inside].max(initial=0.0))


def _ceiling(name: str, table: Mapping[str, Any], walls: WallPieces) -> list[Mount]:
    height = table["height_m"]
    return [Mount(table["polygon"], height, height, np.array([0.0, 0, -1]))]


def _column(name: str, table: Mapping[str, Any], walls: WallPieces) -> list[Mount]:
    found = []
    for start, end in segments(table["polygon"], closed=True):
        normal = -_turned((end - start) / np.hypot(*(end - start)))
        found.append(_upright(np.array([start, end]), normal, table))
    return found


def _area(name: str, table: Mapping[str, Any], walls: WallPieces) -> list[Mount]:
    normal = _axis(name, table)
    low, high = table["low_m"], table["high_m"]
    return [Mount(table["polygon"], low, high, normal, on_surface=False)]


def _points(name: str, table: Mapping[str, Any], walls: WallPieces) -> list[Mount]:
    if not len(table["points"]):
        raise ValueError(f"{name}.points must not be empty")
    normal = _axis(name, table)
    return [
        Mount(spot[None, :2], spot[2], spot[2], normal, on_surface=False)
        for spot in table["points"]
    ]


_SHAPES = {
    "wall": _wall, "ceiling": _ceiling, "column": _column, "area": _area, "points": _points,
}  # fmt: skip


def _upright(ends: FloatArray, normal: FloatArray, table: Mapping[str, Any]) -> Mount:
    return Mount(ends, table["low_m"], table["high_m"], np.array([*normal, 0.0]))


def _axis(name: str, table: Mapping[str, Any]) -> FloatArray:
    """Return the unit vector of the anchors' view; zero for all directions."""
    if table["axis"] is None:
        return np.zeros(3)
    axis = np.array(table["axis"])
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise ValueError(f"{name}.axis must not be zero")
    return axis / length


def show(corner: FloatArray) -> str:
    """Return a point as text."""
    return "(" + ", ".join(f"{value:g}" for value in corner) + ")"
