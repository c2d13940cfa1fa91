"""Mounts of a building: faces cut into pieces, without forbidden or covered parts.

Needs shapely (extra ``placement``).
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.extras import require
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import Obstacles, Prisms, box_bounds
from rbl_gym.geometry.polygons import rectangle
from rbl_gym.geometry.regions import Faces

# An obstacle this close in front of a face covers it, metres.
_BEFORE_M = 1e-3
# Forbidden prisms include their own faces, with this tolerance, metres.
_GROWN_M = 1e-6
# Smaller pieces are left out, metres and square metres.
_LEAST_M, _LEAST_M2 = 1e-3, 1e-4


class Mount(NamedTuple):
    """A face as given in a file: a segment (2, 2), a polygon (V, 2) or a point (1, 2) in plan.

    `normal` is the unit vector of the view of its anchors; zero for all directions. `cost` and
    `name` are those of an anchor on it. `on_surface`: whether it has a front side, and is not a
    volume.
    """

    shape: FloatArray
    low_m: float
    high_m: float
    normal: FloatArray
    cost: float = 1.0
    name: str = ""
    on_surface: bool = True


def cut_mounts(mounts: list[Mount], obstacles: Obstacles, forbidden: Prisms) -> Mounts | None:
    """Return the region of all mounts without forbidden or covered parts; None if it is empty.

    A position on a surface is covered if the point a millimetre in front of it lies in an obstacle.
    Other positions are covered if they lie in an obstacle themselves.
    """
    shapely = shapely_module()
    covers = _solids(shapely, _prisms_of(obstacles), 0.0)
    bans = _solids(shapely, forbidden, _GROWN_M)
    pieces, face = [], []
    for index, mount in enumerate(mounts):
        found = _pieces(shapely, mount, covers, bans)
        pieces += found
        face += [index] * len(found)
    if not pieces:
        return None
    return Mounts(np.array(pieces), np.array(face), faces_of(mounts))


def faces_of(mounts: list[Mount]) -> Faces:
    """Return the mounts as boxes with one, two or three sides."""
    rows = []
    for mount in mounts:
        axes, extents = np.zeros((3, 3)), np.zeros(3)
        origin = np.array([*mount.shape.min(axis=0), mount.low_m])
        if len(mount.shape) == 2:
            along = mount.shape[1] - mount.shape[0]
            extents[0] = np.hypot(*along)
            axes[0, :2] = along / extents[0]
            origin[:2] = mount.shape[0]
        elif len(mount.shape) > 2:
            axes[:2] = np.eye(3)[:2]
            extents[:2] = np.ptp(mount.shape, axis=0)
        if mount.high_m > mount.low_m:
            axes[2], extents[2] = (0, 0, 1), mount.high_m - mount.low_m
        rows.append((origin, axes, extents, mount.normal, mount.name))
    return Faces.of(rows)._replace(cost=np.array([mount.cost for mount in mounts]))


class _Solids(NamedTuple):
    """Prisms as polygons of shapely, and their heights (K,)."""

    shapes: Any
    low: FloatArray
    high: FloatArray

    def at(self, shapely: Any, shape: Any, low: float, high: float) -> _Solids:
        """Return those that meet a shape in plan between two heights."""
        near = (self.low < high) & (self.high > low)
        near[near] = shapely.intersects(self.shapes[near], shape)
        return _Solids(self.shapes[near], self.low[near], self.high[near])


def _prisms_of(obstacles: Obstacles) -> Prisms:
    """Return all obstacles as prisms."""
    (low, high), prisms = box_bounds(obstacles.boxes), obstacles.prisms
    rings = [*rectangle(low, high), *prisms.corners]
    return Prisms.packed(rings, [*low[:, 2], *prisms.low_m], [*high[:, 2], *prisms.high_m])


def _solids(shapely: Any, prisms: Prisms, grown: float) -> _Solids:
    shapes = np.array([shapely.Polygon(ring) for ring in prisms.corners], dtype=object)
    if grown:
        shapes = shapely.buffer(shapes, grown, join_style="mitre")
    return _Solids(shapes, prisms.low_m - grown, prisms.high_m + grown)


def _pieces(shapely: Any, mount: Mount, covers: _Solids, bans: _Solids) -> list[list[float]]:
    """Return the remaining pieces of a mount, rows as for `Mounts`."""
    make = {1: shapely.Point, 2: shapely.LineString}.get(len(mount.shape), shapely.Polygon)
    shape = make(mount.shape)
    ahead = _BEFORE_M * mount.normal * mount.on_surface
    # Moved by this vector, an obstacle in front of the face covers the face.
    low, high = mount.low_m + ahead[2], mount.high_m + ahead[2]
    near = covers.at(shapely, make(mount.shape + ahead[:2]), low, high)
    bans = bans.at(shapely, shape, mount.low_m, mount.high_m)
    moved = shapely.transform(near.shapes, lambda corners: corners - ahead[:2])
    solids = _Solids(
        np.concatenate([moved, bans.shapes]),
        np.concatenate([near.low - ahead[2], bans.low]),
        np.concatenate([near.high - ahead[2], bans.high]),
    )
    rows: list[list[float]] = []
    for bottom, top, left in _layers(shapely, shape, mount, solids):
        for corners in _simplices(shapely, left):
            rows.append([*corners.ravel(), bottom, top])
    return rows


def _layers(
    shapely: Any, shape: Any, mount: Mount, solids: _Solids
) -> list[tuple[float, float, Any]]:
    """Yield heights, and the remaining shape between them."""
    stops = np.unique([mount.low_m, mount.high_m, *solids.low, *solids.high])
    stops = stops[(stops >= mount.low_m) & (stops <= mount.high_m)]
    layers: list[tuple[float, float, Any]] = []
    # A horizontal face is one layer without height.
    stops = np.resize(stops, 2) if len(stops) == 1 else stops
    for bottom, top in itertools.pairwise(stops):
        middle = 0.5 * (bottom + top)
        here = (solids.low < middle) & (solids.high > middle)
        left = shape.difference(shapely.union_all(solids.shapes[here])) if here.any() else shape
        if layers and left.equals(layers[-1][2]):
            layers[-1] = (layers[-1][0], float(top), left)
        elif top - bottom > _LEAST_M or top == bottom:
            layers.append((float(bottom), float(top), left))
    return layers


def _simplices(shapely: Any, shape: Any) -> list[FloatArray]:
    """Return a shape as triangles, segments and points, each (3, 2), repeating the last corner."""
    found = []
    for part in () if shape.is_empty else shapely.get_parts(shape):
        if part.geom_type == "Point":
            found.append(np.repeat(shapely.get_coordinates(part), 3, axis=0))
        elif part.geom_type == "LineString":
            for a, b in zip(part.coords[:-1], part.coords[1:], strict=True):
                if np.hypot(b[0] - a[0], b[1] - a[1]) > _LEAST_M:
                    found.append(np.array([a, b, b]))
        elif part.geom_type == "Polygon":
            for triangle in shapely.get_parts(shapely.constrained_delaunay_triangles(part)):
                if triangle.area > _LEAST_M2:
                    found.append(np.array(triangle.exterior.coords)[:3])
    return found


def shapely_module() -> Any:
    """Return shapely; the error without it names the extra."""
    require("shapely", "placement", "a building file with [[mounts]]")
    import shapely

    return shapely
