"""Define regions of allowed anchor positions: boxes, walls and ceiling of a room, shells.

A region draws points from uniforms, and projects any point onto itself; arrays (..., 3). Its faces
give the wall of a point, with orientation and name. `geometry.mounts` has regions of any shape.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number
from rbl_gym.kernels import compiled

__all__ = ["REGIONS", "Box", "Faces", "Region", "Shell", "Walls"]

Triple = tuple[float, float, float]
# A point at a larger distance from every face belongs to none, metres.
_NEAR_M = 0.01


class Faces(NamedTuple):
    """Boxes with one, two or three dimensions that contain a region.

    Attributes
    ----------
    origin
        (K, 3), a corner of each box, metres.
    axes, extents
        (K, 3, 3), unit directions of its sides in rows; (K, 3), their lengths, metres, 0 if flat.
    normal
        (K, 3): direction that anchors on it face, of unit length; zero: all directions.
    cost
        (K,): cost of an anchor on it.
    names
        K names.
    """

    origin: FloatArray
    axes: FloatArray
    extents: FloatArray
    normal: FloatArray
    cost: FloatArray
    names: tuple[str, ...]

    @classmethod
    def of(cls, rows: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike, str]]) -> Faces:
        """Return faces with cost 1, one row for each: origin, axes, extents, normal, name."""
        *arrays, names = zip(*rows, strict=True)
        origin, axes, extents, normal = (np.array(array, float) for array in arrays)
        return cls(origin, axes, extents, normal, np.ones(len(names)), names)

    def nearest(self, points: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Return index (...) and distance in metres of the face nearest to each point (..., 3)."""
        away = points[..., None, :] - self.origin
        along = np.einsum("kij,...kj->...ki", self.axes, away).clip(0.0, self.extents)
        away = away - np.einsum("kij,...ki->...kj", self.axes, along)
        distance = np.sqrt((away**2).sum(axis=-1))
        face = distance.argmin(axis=-1)
        return face, np.take_along_axis(distance, face[..., None], axis=-1)[..., 0]


class Region(Protocol):
    """Interface of regions of legal anchor positions. `faces` is a field or a cached property."""

    if TYPE_CHECKING:

        @property
        def faces(self) -> Faces:
            """Return the faces that contain the region."""
            ...

    def face_of(self, points: FloatArray) -> np.ndarray:
        """Return the index (...) of the face nearest to legal points (..., 3)."""
        return self.faces.nearest(points)[0]

    def normal(self, points: FloatArray) -> FloatArray:
        """Return the direction (..., 3) that anchors at points (..., 3) face.

        It is zero if the face has no direction, and at more than a centimetre from every face.
        """
        face, distance = self.faces.nearest(points)
        return np.where((distance <= _NEAR_M)[..., None], self.faces.normal[face], 0.0)

    def cost(self, points: FloatArray) -> FloatArray:
        """Return the cost (...) of anchors at points (..., 3)."""
        return self.faces.cost[self.face_of(points)]

    def names(self, points: FloatArray) -> list[str]:
        """Return the names of the faces of points (M, 3)."""
        return [self.faces.names[face] for face in self.face_of(points)]

    def listed(self) -> FloatArray | None:
        """Return all legal points (K, 3) if they are a list; None: a continuous region."""
        return None

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper corner (3,) of the bounding box."""
        ...

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Return points (..., 3), uniform over the region, from uniforms (..., 3) on [0, 1)."""
        ...

    def project(self, points: FloatArray) -> FloatArray:
        """Return the nearest legal points (..., 3)."""
        ...

    def place(self, action: FloatArray) -> FloatArray:
        """Return the legal points (..., 3) of actions (..., 3), which are clipped to [-1, 1]."""
        ...

    def action(self, points: FloatArray) -> FloatArray:
        """Return the actions (..., 3) that `place` maps to legal points (..., 3)."""
        ...


def _check_corners(region: Box | Walls, *, flat: bool) -> None:
    for name in ("low", "high"):
        value = check_array(name, getattr(region, name), (3,))
        if value.ndim != 1:
            raise ValueError(f"{name} must have no leading axes, got shape {value.shape}")
        object.__setattr__(region, name, tuple(value.tolist()))
    if any(h < lo or (h == lo and not flat) for lo, h in zip(region.low, region.high, strict=True)):
        raise ValueError(f"low must lie below high, got low {region.low}, high {region.high}")


@dataclass(frozen=True)
class Box(Region):
    """A box (flat ones allowed, such as a water surface), corners in metres."""

    low: Triple
    high: Triple

    def __post_init__(self) -> None:
        _check_corners(self, flat=True)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper corner; read-only."""
        return self._corners

    @functools.cached_property
    def faces(self) -> Faces:
        """Return one face, the box itself."""
        low, high = self.bounds()
        return Faces.of([(low, np.eye(3), high - low, np.zeros(3), "box")])

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Return points uniform in the box."""
        low, high = self.bounds()
        return low + uniforms * (high - low)

    def project(self, points: FloatArray) -> FloatArray:
        """Return points with every coordinate clipped."""
        return _project_to_box(points, *self._corners)

    @functools.cached_property
    def _corners(self) -> tuple[FloatArray, FloatArray]:
        return _fixed(self.low), _fixed(self.high)

    def place(self, action: FloatArray) -> FloatArray:
        """Return points of actions; [-1, 1]^3 maps to the box."""
        return _place_in_box(action, *self._middle)

    @functools.cached_property
    def _middle(self) -> tuple[FloatArray, FloatArray]:
        return _middle(*self._corners)

    def action(self, points: FloatArray) -> FloatArray:
        """Return actions of points, the inverse of `place`; zero along an axis without extent."""
        return _unscaled(points, *self.bounds())


@dataclass(frozen=True)
class Walls(Region):
    """The four walls and the ceiling of a box-shaped room (no floor), corners in metres."""

    low: Triple
    high: Triple

    def __post_init__(self) -> None:
        _check_corners(self, flat=False)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper corner of the room; read-only."""
        return self._corners

    @functools.cached_property
    def _corners(self) -> tuple[FloatArray, FloatArray]:
        return _fixed(self.low), _fixed(self.high)

    @functools.cached_property
    def faces(self) -> Faces:
        """Return the walls to the west, east, south and north, and the ceiling."""
        low, high = self.bounds()
        names = ("west wall", "east wall", "south wall", "north wall", "ceiling")
        rows = []
        for axis, value, name in zip(*_faces(low, high), names, strict=True):
            flat = np.arange(3) != axis
            sign = 1.0 if value == low[axis] else -1.0
            corner, extents = np.where(flat, low, value), flat * (high - low)
            rows.append((corner, np.eye(3), extents, sign * ~flat, name))
        return Faces.of(rows)

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Return points uniform by area; the first uniform selects the surface and a coordinate."""
        low, high = self.bounds()
        x, y, z = high - low
        area = np.cumsum([y * z, y * z, x * z, x * z, x * y])
        place = uniforms[..., 0] * area[-1]
        face = np.searchsorted(area, place, side="right")
        along = 1 - (area[face] - place) / np.diff(area, prepend=0.0)[face]
        up = uniforms[..., 1]
        # x walls run along y, y walls and the ceiling along x; the ceiling's "up" is y.
        inside = np.stack([along, np.where(face < 2, along, up), up], axis=-1)
        points = low + inside * (high - low)
        (axes, values), face = _faces(low, high), face[..., None]
        return np.where(axes[face] == np.arange(3), values[face], points)

    def project(self, points: FloatArray) -> FloatArray:
        """Return the nearest points of a wall or the ceiling."""
        return _project_on_walls(points, *self._corners)

    def place(self, action: FloatArray) -> FloatArray:
        """Return the point where the ray from the room centre along the action meets a surface.

        A ray that would meet a wall below the floor ends on it at the height of the floor. A ray
        straight down gives the nearest legal point.
        """
        return place_on_walls(action, *self._corners)

    def action(self, points: FloatArray) -> FloatArray:
        """Return actions that `place` maps to points: the points in units of the half size."""
        return _unscaled(points, *self.bounds())


def _faces(low: FloatArray, high: FloatArray) -> tuple[np.ndarray, FloatArray]:
    """Return the axis (5,) normal to each wall and the ceiling, and its coordinate (..., 5)."""
    values = low[..., 0], high[..., 0], low[..., 1], high[..., 1], high[..., 2]
    return np.array([0, 0, 1, 1, 2]), np.stack(values, axis=-1)


@compiled("room_walls:project_to_box")
def _project_to_box(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Compute `Box.project` in boxes between two corners (..., 3)."""
    return np.minimum(np.maximum(points, low), high)


@compiled("room_walls:place_in_box")
def _place_in_box(action: FloatArray, middle: FloatArray, half: FloatArray) -> FloatArray:
    """Compute `Box.place`; centres and half sizes (..., 3)."""
    return middle + _cut(action) * half


@compiled("room_walls:project")
def _project_on_walls(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Compute `Walls.project` in rooms between two corners (..., 3)."""
    axes, values = _faces(low, high)
    inside = _project_to_box.textbook(points, low, high)
    outside = (points - inside) ** 2
    # Squared distance to each surface. Below the floor, the smallest gap alone is misleading.
    squares = outside.sum(axis=-1)[..., None] - outside[..., axes]
    face = (squares + (points[..., axes] - values) ** 2).argmin(axis=-1)[..., None]
    chosen = np.take_along_axis(np.broadcast_to(values, squares.shape), face, axis=-1)
    return np.where(axes[face] == np.arange(3), chosen, inside)


@compiled("room_walls:place")
def place_on_walls(action: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Compute `Walls.place` in rooms between two corners (..., 3)."""
    action = _cut(action)
    middle, half = _middle(low, high)
    reach = np.maximum(np.abs(action[..., :2]).max(axis=-1), action[..., 2])
    points = middle + _cut(action / np.maximum(reach, 1e-3)[..., None]) * half
    projected = _project_on_walls.textbook(points, low, high)
    return np.where(reach[..., None] < 1e-3, projected, points)


@dataclass(frozen=True)
class Shell(Region):
    """The space between two spheres about the origin, radii in metres."""

    inner_m: float
    outer_m: float

    def __post_init__(self) -> None:
        inner_m = check_number("inner_m", self.inner_m, low=0.0)
        check_number("outer_m", self.outer_m, low=inner_m)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the cube around the outer sphere."""
        return np.full(3, -self.outer_m), np.full(3, self.outer_m)

    @functools.cached_property
    def faces(self) -> Faces:
        """Return one face, the cube around the outer sphere."""
        low, high = self.bounds()
        return Faces.of([(low, np.eye(3), high - low, np.zeros(3), "shell")])

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Return points uniform by volume."""
        z = 2 * uniforms[..., 0] - 1
        angle = 2 * np.pi * uniforms[..., 1]
        flat = np.sqrt(1 - z**2)
        direction = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=-1)
        cubes = self.inner_m**3 + uniforms[..., 2] * (self.outer_m**3 - self.inner_m**3)
        return np.cbrt(cubes)[..., None] * direction

    def project(self, points: FloatArray) -> FloatArray:
        """Return points with clipped radius; the origin goes to the inner sphere along x."""
        radius = np.linalg.norm(points, axis=-1, keepdims=True)
        legal = np.clip(radius, self.inner_m, self.outer_m)
        scaled = points * (legal / np.where(radius > 0, radius, 1.0))
        return np.where(radius > 0, scaled, self.inner_m * np.eye(3)[0])

    def place(self, action: FloatArray) -> FloatArray:
        """Return points in the direction of actions (zero: along x); the length sets the radius."""
        action = _cut(action)
        length = np.linalg.norm(action, axis=-1, keepdims=True)
        far = length > 1e-150  # The squares of shorter ones underflow.
        direction = np.where(far, action / np.where(far, length, 1), np.eye(3)[0])
        return (self.inner_m + (self.outer_m - self.inner_m) * np.minimum(length, 1.0)) * direction

    def action(self, points: FloatArray) -> FloatArray:
        """Return the inverse of `place`; a point on the inner sphere gives a tiny action."""
        radius = np.linalg.norm(points, axis=-1, keepdims=True)
        length = (radius - self.inner_m) / max(self.outer_m - self.inner_m, 1e-12)
        return points / np.where(radius > 0, radius, 1.0) * np.clip(length, 1e-12, 1.0)


# Regions by their names in scene files and overrides.
REGIONS = {"box": Box, "walls": Walls, "shell": Shell}


def _fixed(corner: Triple) -> FloatArray:
    array = np.array(corner)
    array.flags.writeable = False
    return array


def _cut(action: FloatArray) -> FloatArray:
    """Return the action clipped to [-1, 1]^3, in full precision."""
    return np.minimum(np.maximum(action, -1.0, dtype=np.float64), 1.0)


def _middle(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centre and half size of a box."""
    return 0.5 * (low + high), 0.5 * (high - low)


def _unscaled(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return points in units of the half size of a box; zero along an axis without extent."""
    middle, half = _middle(low, high)
    return np.where(half > 0, (points - middle) / np.where(half > 0, half, 1.0), 0.0)
