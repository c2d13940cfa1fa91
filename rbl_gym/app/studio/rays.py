"""The mount under the pointer."""

from __future__ import annotations

import numpy as np

from rbl_gym.app.studio.world import World
from rbl_gym.checks import FloatArray

# Mounts whose directions from the camera differ by less than this count as equal, radians.
_SAME_RAD = 2e-3


def under_pointer(
    world: World, camera: FloatArray, point: FloatArray, near: FloatArray
) -> FloatArray:
    """Return the mount (3,) that a line of sight meets; of several, the one nearest to `near`.

    If the line meets no mount, return the mount with the smallest angle from the line. `camera` and
    `point` are two points (3,) of the line.
    """
    mounts = world.problem.mounts
    direction = point - camera
    direction = direction / max(float(np.linalg.norm(direction)), 1e-12)
    faces = mounts.faces
    flat = np.flatnonzero((faces.extents > 0).sum(axis=1) == 2)
    found = [point[None], near[None]]
    if len(flat):
        axes, extents = faces.axes[flat], faces.extents[flat]
        # The axis along which each face has no extent; for an oblique wall, the cross product.
        first = np.take_along_axis(axes, np.argsort(-extents, axis=1)[:, :2, None], axis=1)
        normal = np.cross(first[:, 0], first[:, 1])
        slope = normal @ direction
        meets = np.abs(slope) > 1e-9
        reach = ((faces.origin[flat] - camera) * normal).sum(axis=1)[meets] / slope[meets]
        found.append(camera + reach[reach > 0, None] * direction)
    listed = mounts.listed()
    legal = mounts.project(np.concatenate(found)) if listed is None else listed
    away = legal - camera
    along = np.maximum(away @ direction, 1e-9)
    off = np.linalg.norm(away - along[:, None] * direction, axis=1) / along
    best = off <= off.min() + _SAME_RAD
    distance = np.where(best, np.linalg.norm(legal - near, axis=1), np.inf)
    return legal[int(distance.argmin())]


def on_plane(camera: FloatArray, point: FloatArray, axis: int, at: float) -> FloatArray:
    """Return the intersection with the plane where a coordinate equals `at`, else the point."""
    slope = point[axis] - camera[axis]
    share = (at - camera[axis]) / slope if abs(slope) > 1e-9 else 0.0
    return camera + share * (point - camera) if share > 0 else point
