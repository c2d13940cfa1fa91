"""Boxes that block sight: the slab test, batched.

An obstacle is a row of six numbers, centre and half size of an axis-aligned box, metres.
"""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray, as_float, check_array


def check_obstacles(obstacles: object) -> FloatArray:
    """Obstacles (K, 6) as an array, K may be 0; or a ValueError."""
    array = as_float("obstacles", obstacles)
    if array.size == 0:
        return np.empty((0, 6))
    array = check_array("obstacles", array, ("K", 6))
    if array.ndim != 2:
        raise ValueError(f"obstacles must have shape (K, 6), got {array.shape}")
    if (array[:, 3:] <= 0).any():
        raise ValueError(f"obstacles must have positive half sizes, got {array[:, 3:].min():g} m")
    return array


def in_sight(anchors: FloatArray, points: FloatArray, obstacles: FloatArray) -> np.ndarray:
    """Which points each anchor sees, (..., P, M) booleans.

    Parameters
    ----------
    anchors, points
        (..., M, 3) and (..., P, 3), metres.
    obstacles
        (..., K, 6), centres and half sizes; K may be 0.

    A segment that only touches a box is not blocked; one that ends inside a box is.
    """
    batch = np.broadcast_shapes(anchors.shape[:-2], points.shape[:-2], obstacles.shape[:-2])
    free = np.ones((*batch, points.shape[-2], anchors.shape[-2]), dtype=np.bool_)
    if not obstacles.shape[-2]:
        return free
    along = [points[..., :, None, i] - anchors[..., None, :, i] for i in range(3)]
    # Along a face the quotients are 0/0, and NaN never blocks.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for k in range(obstacles.shape[-2]):
            # Places along the segment from anchor (0) to point (1) where it enters and leaves.
            enter, leave = np.float64(0), np.float64(1)
            for i in range(3):
                away = obstacles[..., k, None, None, i] - anchors[..., None, :, i]
                half = obstacles[..., k, None, None, 3 + i]
                low, high = (away - half) / along[i], (away + half) / along[i]
                enter = np.maximum(enter, np.minimum(low, high))
                leave = np.minimum(leave, np.maximum(low, high))
            free &= ~(enter < leave)
    return free
