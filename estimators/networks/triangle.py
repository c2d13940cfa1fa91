"""Three nodes in space: orientations, and places up to scale, from the bearings of one another.

The interior angles of a triangle sum to pi, and that is all that six bearings know twice. So the
maximum likelihood is the ring's least squares (12) over again: every angle takes a third of what is
missing, half of it at either bearing; then the frames fit without a rest, ``R_1^0 R_2^1 R_0^2 = I``
(3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number

# The layout of bearings: each row of the nodes 0, 1, 2 and the next one.
TRIANGLE_EDGES = ((0, 1), (1, 2), (2, 0))
_SMALLEST_SINE = 1e-9


class TriangleFrames(NamedTuple):
    """The frames of three nodes relative to node 0's."""

    rotation: FloatArray  # (..., 3, 3, 3) from each node's frame to node 0's
    position: FloatArray  # (..., 3, 3) in node 0's frame, metres; NaN where no triangle fits
    angle: FloatArray  # (..., 3) interior angles, radians, sum pi
    misfit: FloatArray  # (...), pi less the sum of the measured angles: N(0, 6 sigma^2)


def triangle_frames(bearings: ArrayLike, length_m: float = 1.0) -> TriangleFrames:
    """Maximum-likelihood frames of three nodes in space from their mutual bearings.

    Parameters
    ----------
    bearings
        (..., 3, 2, 3) directions along the edges (0, 1), (1, 2), (2, 0): of the second node in the
        frame of the first, then of the first in the frame of the second. Made unit here. Noise of
        all of them alike, isotropic across the direction.
    length_m
        Distance of nodes 0 and 1, which bearings do not tell.

    Raises
    ------
    ValueError
        On another shape, a bearing of no length, or a node that sees both others on one line:
        turns about that line stay free.
    """
    bearings = check_array("bearings", bearings, (3, 2, 3))
    length_m = check_number("length_m", length_m, low=1e-12)
    size = np.linalg.norm(bearings, axis=-1, keepdims=True)
    if not size.all():
        raise ValueError("bearings must be directions, got one of length 0")
    unit = bearings / size
    # Of every node, what it sees of the next one and of the one before.
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
