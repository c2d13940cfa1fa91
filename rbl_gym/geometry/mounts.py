"""Define the allowed anchor positions in a building: walls, ceilings, columns, areas, points.

Mounts are split into pieces: a segment, a triangle or a point in the plan, between two heights.
`placement.mounting` makes them from a file, without forbidden or covered parts.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.regions import Faces, Region
from rbl_gym.kernels import compiled

__all__ = ["Mounts"]

# Points are drawn from a lower strip of wall as if it had this height, metres.
_LEAST_HEIGHT_M = 0.1


@dataclass(frozen=True, eq=False)
class Mounts(Region):
    """A region that consists of pieces.

    Parameters
    ----------
    pieces
        (K, 8): three corners in the plan, x, y each, and the lower and upper height, metres. The
        corners of a triangle differ; the last two of a segment are equal; all of a point are equal.
    piece_face
        (K,) int: the face of each piece.
    faces
        The mounts before parts were removed.
    """

    pieces: FloatArray
    piece_face: np.ndarray
    faces: Faces

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper corner (3,) of the bounding box."""
        return self._corners

    @functools.cached_property
    def _corners(self) -> tuple[FloatArray, FloatArray]:
        plan = self.pieces[:, :6].reshape(-1, 2)
        low = np.array([*plan.min(axis=0), self.pieces[:, 6].min()])
        high = np.array([*plan.max(axis=0), self.pieces[:, 7].max()])
        for corner in (low, high):
            corner.flags.writeable = False
        return low, high

    @functools.cached_property
    def measure(self) -> FloatArray:
        """Return the weight (K,) of each piece when points are drawn.

        It is the area in square metres, of wall or of plan; a point has the weight one.
        """
        a, b, c = self._plan
        height = np.maximum(self.pieces[:, 7] - self.pieces[:, 6], _LEAST_HEIGHT_M)
        (ux, uy), (vx, vy) = (b - a).T, (c - a).T
        triangle, length = 0.5 * np.abs(ux * vy - uy * vx), np.hypot(ux, uy)
        flat = np.where(length > 0, length * height, 1.0)
        return np.where((b == c).all(axis=1), flat, triangle)

    @property
    def _plan(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the three corners (K, 2) of the pieces."""
        return self.pieces[:, 0:2], self.pieces[:, 2:4], self.pieces[:, 4:6]

    def draw(self, uniforms: FloatArray) -> FloatArray:
        """Return points (..., 3) from uniforms (..., 3); pieces are weighted by `measure`."""
        total = np.cumsum(self.measure)
        place = uniforms[..., 0] * total[-1]
        # Rounding must not lead beyond the last.
        piece = np.minimum(np.searchsorted(total, place, side="right"), len(total) - 1)
        along = (1 - (total[piece] - place) / self.measure[piece]).clip(0.0, 1.0)[..., None]
        a, b, c = (corner[piece] for corner in self._plan)
        line = (b == c).all(axis=-1, keepdims=True)
        across = uniforms[..., 1:2]
        root = np.where(line, along, np.sqrt(along))
        plan = a + root * ((b - a) + np.where(line, 0.0, across) * (c - b))
        up = np.where(line[..., 0], uniforms[..., 1], uniforms[..., 2])
        low, high = self.pieces[piece, 6], self.pieces[piece, 7]
        return np.concatenate([plan, (low + up * (high - low))[..., None]], axis=-1)

    def project(self, points: FloatArray) -> FloatArray:
        """Return the nearest legal points (..., 3)."""
        return nearest_point(points, self.pieces)[0]

    def place(self, action: FloatArray) -> FloatArray:
        """Return the legal points (..., 3) nearest to those of actions.

        [-1, 1]^3 maps to `bounds`.
        """
        low, high = self.bounds()
        cut = np.minimum(np.maximum(action, -1.0, dtype=np.float64), 1.0)
        return self.project(0.5 * (low + high) + cut * (0.5 * (high - low)))

    def action(self, points: FloatArray) -> FloatArray:
        """Return actions that `place` maps to the points: in units of the half size of `bounds`."""
        low, high = self.bounds()
        half = 0.5 * (high - low)
        away = points - 0.5 * (low + high)
        return np.where(half > 0, away / np.where(half > 0, half, 1.0), 0.0)

    def face_of(self, points: FloatArray) -> np.ndarray:
        """Return the index (...) of the face nearest to legal points (..., 3)."""
        return self.piece_face[nearest_point(points, self.pieces)[1]]

    def normal(self, points: FloatArray) -> FloatArray:
        """Return the direction (..., 3) that anchors at points (..., 3) face.

        It is zero if the mount has no direction, and at more than a centimetre from every piece.
        """
        legal, piece = nearest_point(points, self.pieces)
        near = np.sqrt(((legal - points) ** 2).sum(axis=-1, keepdims=True)) <= 0.01
        return np.where(near, self.faces.normal[self.piece_face[piece]], 0.0)

    def listed(self) -> FloatArray | None:
        """Return all legal points (K, 3) if every mount is a list of points; else None."""
        if (self.pieces[:, 0:4] != self.pieces[:, 2:6]).any():
            return None
        if (self.pieces[:, 6] != self.pieces[:, 7]).any():
            return None
        return self.pieces[:, [0, 1, 6]].copy()


@compiled("mounts:nearest_point")
def nearest_point(points: FloatArray, pieces: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Return the point of the pieces nearest to each point (..., 3), and the piece index (...).

    Arguments as in `Mounts`.
    """
    a, b, c = (pieces[:, i : i + 2] for i in (0, 2, 4))
    p = points[..., None, :2]
    best, least = a + 0 * p, np.full((*points.shape[:-1], len(pieces)), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along, away = end - start, p - start
        square = (along**2).sum(axis=-1)
        share = (away * along).sum(axis=-1) / np.where(square > 0, square, 1.0)
        spot = start + np.minimum(np.maximum(share, 0.0), 1.0)[..., None] * along
        off = ((spot - p) ** 2).sum(axis=-1)
        best = np.where((off < least)[..., None], spot, best)
        least = np.minimum(off, least)
    sides = [
        (end - start)[..., 0] * (p - start)[..., 1] - (end - start)[..., 1] * (p - start)[..., 0]
        for start, end in ((a, b), (b, c), (c, a))
    ]
    within = np.all([side > 0 for side in sides], axis=0) | np.all(
        [side < 0 for side in sides], axis=0
    )
    best, least = np.where(within[..., None], p, best), np.where(within, 0.0, least)
    z = points[..., None, 2]
    height = np.minimum(np.maximum(z, pieces[:, 6]), pieces[:, 7])
    piece = (least + (height - z) ** 2).argmin(axis=-1)
    where = piece[..., None]
    plan = np.take_along_axis(best, where[..., None], axis=-2)[..., 0, :]
    return np.concatenate([plan, np.take_along_axis(height, where, axis=-1)], axis=-1), piece
