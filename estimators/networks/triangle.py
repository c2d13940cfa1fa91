"""Orientations of three nodes in space, and positions up to scale, from mutual bearings.

The interior angles of a triangle sum to pi, which is the only redundancy of the six bearings.
Maximum likelihood is therefore the least squares of a ring (12): each angle is corrected by a third
of the misfit, half of it at each of its two bearings. The frames are then exactly consistent,
``R_1^0 R_2^1 R_0^2 = I`` (3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number

# Edges in the order of the bearings: each node with the next one.
TRIANGLE_EDGES = ((0, 1), (1, 2), (2, 0))
_SMALLEST_SINE = 1e-9


class TriangleFrames(NamedTuple):
    """Orientations and positions of three nodes, in the frame of node 0.

    Attributes
    ----------
    rotation
        (..., 3, 3, 3), from the frame of each node to the frame of node 0.
    position
        (..., 3, 3), metres; NaN if no triangle fits.
    angle
        (..., 3), interior angles of the triangle, radians; their sum is pi.
    misfit
        (...), pi minus the sum of the measured angles, with the distribution N(0, 6 sigma^2).
    """

    rotation: FloatArray
    position: FloatArray
    angle: FloatArray
    misfit: FloatArray


def triangle_frames(bearings: ArrayLike, length_m: float = 1.0) -> TriangleFrames:
    """Estimate maximum-likelihood frames of three nodes in space from mutual bearings.

    Parameters
    ----------
    bearings
        (..., 3, 2, 3) directions along the edges (0, 1), (1, 2), (2, 0): of the second node in the
        frame of the first, then of the first in the frame of the second. They are normalised here.
        The noise is equal for all, and isotropic across the direction.
    length_m
        Distance of nodes 0 and 1, which bearings do not determine.

    Raises
    ------
    ValueError
        If a shape is wrong, a bearing is zero, or a node sees both others on one line, so that
        rotations about that line are not determined.
    """
    bearings = check_array("bearings", bearings, (3, 2, 3))
    length_m = check_number("length_m", length_m, low=1e-12)
    size = np.linalg.norm(bearings, axis=-1, keepdims=True)
    if not size.all():
        raise ValueError("bearings must be directions, got one of length 0")
    unit = bearings / size
    # For every node, the bearings of the next node and of the one before.
    ahead, behind = unit[..., 0, :], np.roll(unit[..., 1, :], 1, axis=-2)
    normal = np.cross(ahead, behind)
    sine = np.linalg.norm(normal, axis=-1)
    if (sine < _SMALLEST_SINE).any():
        raise ValueError(
            "bearings must span a triangle, got a node that sees both others on one line"
        )
    normal /= sine[..., None]
    measured = np.arctan2(sine, (ahead * behind).sum(axis=-1))
    misfit = np.pi - measured.sum(axis=-1)
    angle = measured + misfit[..., None] / 3
    middle = ahead + behind
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    seen = np.stack([middle, np.cross(normal, middle), normal], axis=-1)
    # The triangle in its plane: node 0 at the origin, node 1 on the x axis, node 2 to the left.
    turns = np.pi - angle
    heading = np.zeros_like(angle)
    heading[..., 1:] = np.cumsum(turns[..., 1:], axis=-1)
    bisector = heading + angle / 2
    c, s, zero = np.cos(bisector), np.sin(bisector), np.zeros_like(bisector)
    rows = [[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]]
    plane = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    to_plane = plane @ np.swapaxes(seen, -1, -2)
    to_first = np.swapaxes(to_plane[..., :1, :, :], -1, -2)
    proper = (angle > 0).all(axis=-1)
    far = length_m * np.sin(angle[..., 1]) / np.where(proper, np.sin(angle[..., 2]), np.nan)
    position = np.zeros((*angle.shape, 3))
    position[..., 1, 0] = length_m
    position[..., 2, 0], position[..., 2, 1] = (
        far * np.cos(angle[..., 0]),
        far * np.sin(angle[..., 0]),
    )
    position[~proper] = np.nan
    return TriangleFrames(
        to_first @ to_plane, position @ np.swapaxes(to_first, -1, -2)[..., 0, :, :], angle, misfit
    )
