"""Where anchors may stand: boxes, the walls and ceiling of a room, shells.

A region draws points from uniforms, and projects any point onto itself; arrays (..., 3).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rbl_gym.checks import FloatArray, check_array, check_number

Triple = tuple[float, float, float]


class Region(Protocol):
    """What every region offers."""

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner (3,) of the smallest box around it."""
        ...

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Points (..., 3) uniform over the region from uniforms (..., 3) on [0, 1)."""
        ...

    def project(self, points: FloatArray) -> FloatArray:
        """The nearest legal points (..., 3)."""
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
class Box:
    """A box (flat ones allowed, such as a water surface), corners in metres."""

    low: Triple
    high: Triple

    def __post_init__(self) -> None:
        _check_corners(self, flat=True)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner."""
        return np.array(self.low), np.array(self.high)

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Uniform in the box."""
        low, high = self.bounds()
        return low + uniforms * (high - low)

    def project(self, points: FloatArray) -> FloatArray:
        """Every coordinate clipped."""
        low, high = self._corners
        clipped = np.maximum(points, low)
        return np.minimum(clipped, high, out=clipped)

    @functools.cached_property
    def _corners(self) -> tuple[FloatArray, FloatArray]:
        return self.bounds()


@dataclass(frozen=True)
class Walls:
    """The four walls and the ceiling of a box-shaped room (no floor), corners in metres."""

    low: Triple
    high: Triple

    def __post_init__(self) -> None:
        _check_corners(self, flat=False)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the room."""
        return np.array(self.low), np.array(self.high)

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Uniform by area; the first uniform chooses the surface and its first coordinate."""
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
        for index, (axis, value) in enumerate(self._faces()):
            points[..., axis] = np.where(face == index, value, points[..., axis])
        return points

    def project(self, points: FloatArray) -> FloatArray:
        """The nearest point of a wall or the ceiling."""
        inside = np.clip(points, *self.bounds())
        outside = (points - inside) ** 2
        squares = outside.sum(axis=-1)
        # Squared distance to each surface; below the floor the nearest gap alone misleads.
        distances = [
            squares - outside[..., a] + (points[..., a] - v) ** 2 for a, v in self._faces()
        ]
        face = np.argmin(np.stack(distances, axis=-1), axis=-1)
        for index, (axis, value) in enumerate(self._faces()):
            inside[..., axis] = np.where(face == index, value, inside[..., axis])
        return inside

    def _faces(self) -> list[tuple[int, float]]:
        low, high = self.low, self.high
        return [(0, low[0]), (0, high[0]), (1, low[1]), (1, high[1]), (2, high[2])]


@dataclass(frozen=True)
class Shell:
    """The space between two spheres about the origin, radii in metres."""

    inner_m: float
    outer_m: float

    def __post_init__(self) -> None:
        inner_m = check_number("inner_m", self.inner_m, low=0.0)
        check_number("outer_m", self.outer_m, low=inner_m)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The cube around the outer sphere."""
        return np.full(3, -self.outer_m), np.full(3, self.outer_m)

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Uniform by volume."""
        z = 2 * uniforms[..., 0] - 1
        angle = 2 * np.pi * uniforms[..., 1]
        flat = np.sqrt(1 - z**2)
        direction = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=-1)
        cubes = self.inner_m**3 + uniforms[..., 2] * (self.outer_m**3 - self.inner_m**3)
        return np.cbrt(cubes)[..., None] * direction

    def project(self, points: FloatArray) -> FloatArray:
        """Radius clipped; the origin goes to the inner sphere along x."""
        radius = np.linalg.norm(points, axis=-1, keepdims=True)
        legal = np.clip(radius, self.inner_m, self.outer_m)
        outward = points * (legal / np.where(radius > 0, radius, 1.0))
        return np.where(radius > 0, outward, self.inner_m * np.eye(3)[0])
