"""Obstacles and mounts of a building from the tables of a file: walls, openings, slabs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, did_you_mean
from rbl_gym.geometry.obstacles import Obstacles, Prisms
from rbl_gym.geometry.polygons import check_polygon, rectangle
from rbl_gym.placement.file_keys import MATERIALS
from rbl_gym.placement.mounting import Mount
from rbl_gym.placement.wall_lines import Opening, Wall, opened, segments, turned, wall_pieces

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
    """Polygons with heights, information fractions and names, collected from the tables."""

    rings: list[FloatArray]
    low: list[float]
    high: list[float]
    share: list[float]
    names: list[str]

    def add(self, ring: FloatArray, low: float, high: float, share: float, name: str) -> None:
        """Add a polygon."""
        self.rings.append(ring)
        self.low.append(low)
        self.high.append(high)
        self.share.append(share)
        self.names.append(name)


class Built(NamedTuple):
    """The obstacles of a file.

    Attributes
    ----------
    obstacles, names
        All obstacles, and their names with their positions in the plan.
    walls
        The walls piece by piece, with their openings.
    gaps
        The openings: ``polygon``, ``low_m`` and ``high_m`` of each.
    """

    obstacles: Obstacles
    names: tuple[str, ...]
    walls: WallPieces
    gaps: list[dict[str, Any]]


def read_obstacles(
    tables: Mapping[str, list[dict[str, Any]]], materials: Mapping[str, float], blocked: float
) -> Built:
    """Return all obstacles, and the walls piece by piece.

    `tables` are ``obstacles``, ``walls``, ``openings``, ``slabs``, and whether there are
    ``mounts``. `materials` are information fractions by name, which override those of the standard
    materials; `blocked` is that of obstacles without their own.
    """
    boxes, of_boxes, solids = [], [], Solids([], [], [], [], [])
    for name, title, table in _each(tables, "obstacles"):
        share = _share(name, table, materials)
        if "polygon" in table:
            _check_rises(name, table)
            ring = table["polygon"]
            title += _ends(ring.min(axis=0), ring.max(axis=0))
            solids.add(ring, table["low_m"], table["high_m"], share, title)
            continue
        low, high = np.array(table["low"]), np.array(table["high"])
        if not (high > low).all():
            raise ValueError(f"{name}: low must lie below high, got {show(low)}, {show(high)}")
        # A box includes its own faces, so that no anchor can be on them.
        is_box = math.isnan(share) and not tables.get("mounts")
        if not is_box and (high - low).min() < 1e-3:
            raise ValueError(f"{name} must be at least a millimetre wide, got {show(high - low)}")
        title += _ends(low, high)
        if is_box:
            boxes.append([*0.5 * (low + high), *0.5 * (high - low)])
            of_boxes.append(title)
        else:
            solids.add(rectangle(low, high), low[2], high[2], share, title)
    walls, gaps = _walls(tables, materials, solids)
    for name, title, table in _each(tables, "slabs"):
        share, ring = _share(name, table, materials), table["polygon"]
        title += _ends(ring.min(axis=0), ring.max(axis=0))
        solids.add(ring, table["z_m"], table["z_m"] + table["thickness_m"], share, title)
    prisms = Prisms.packed(*solids[:4])
    obstacles = Obstacles(np.array(boxes).reshape(-1, 6), blocked, prisms)
    return Built(obstacles, (*of_boxes, *solids.names), walls, gaps)


def _walls(
    tables: Mapping[str, Any], materials: Mapping[str, float], solids: Solids
) -> tuple[WallPieces, list[dict[str, Any]]]:
    """Add the walls to the solids, without their openings; return their pieces, and the gaps."""
    openings = _openings(tables)
    walls, gaps, unused = [], [], {opening.table for opening in openings}
    for name, title, table in _each(tables, "walls"):
        share = _share(name, table, materials)
        _check_rises(name, table)
        line, half = table["line"], 0.5 * table["thickness_m"]
        if table["closed"]:
            line = check_polygon(f"{name}.line", line)
        parts = segments(line, table["closed"])
        for (start, end), ring in zip(parts, wall_pieces(line, half, table["closed"]), strict=True):
            walls.append(Wall(start, end, half, table["low_m"], table["high_m"]))
            rest, cut = opened(ring, walls[-1], openings)
            for solid in rest:
                solids.add(*solid, share, title + _ends(start, end))
            for opening, gap in zip(openings, cut, strict=True):
                if gap is not None:
                    gaps.append(dict(zip(("polygon", "low_m", "high_m"), gap, strict=True)))
                    unused.discard(opening.table)
    if unused:
        index = min(unused)
        ends = tables["openings"][index]["line"][[0, -1]]
        raise ValueError(
            f"openings[{index}] must lie in one of [[walls]], along its line and between its "
            f"heights, got a line from {show(ends[0])} to {show(ends[1])}"
        )
    columns = (np.array(column) for column in zip(*walls, strict=True))
    pieces = WallPieces(*columns) if walls else WallPieces(*np.empty((2, 0, 2)), *np.empty((3, 0)))
    return pieces, gaps


def _each(tables: Mapping[str, Any], kind: str) -> list[tuple[str, str, dict[str, Any]]]:
    """Return each table of a kind, with its name in errors and its name in the results."""
    return [
        (f"{kind}[{i}]", table.get("name") or f"{kind.removesuffix('s')} {i + 1}", table)
        for i, table in enumerate(tables.get(kind, []))
    ]


def _ends(start: FloatArray, end: FloatArray) -> str:
    """Return two points in the plan, to the centimetre, to find an obstacle by."""
    x0, y0, x1, y1 = (f"{round(float(value), 2) + 0.0:.9g}" for value in (*start[:2], *end[:2]))
    return f" ({x0}, {y0} to {x1}, {y1})"


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


def _openings(tables: Mapping[str, Any]) -> list[Opening]:
    """Return the straight pieces of all openings."""
    found = []
    for index, (name, _, table) in enumerate(_each(tables, "openings")):
        _check_rises(name, table)
        for ends in segments(table["line"], closed=False):
            found.append(Opening(np.array(ends), table["low_m"], table["high_m"], index))
    return found


def _check_rises(name: str, table: Mapping[str, Any]) -> None:
    if table["high_m"] - table["low_m"] < 1e-3:
        raise ValueError(
            f"{name}: low_m must lie below high_m, got {table['low_m']:g} and {table['high_m']:g}"
        )


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
            normal = turned((ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0])))
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
        normal = -turned((end - start) / np.hypot(*(end - start)))
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
