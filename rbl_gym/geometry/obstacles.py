"""Boxes that block sight: what they leave of a link's information, by the slab test, batched.

An obstacle is a row of six numbers, centre and half size of an axis-aligned box, metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, as_float, check_array
from rbl_gym.kernels import compiled

__all__ = ["Obstacles", "in_sight", "inside"]


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Boxes in the way of links, and what is left of a link behind one.

    Scenes, placement, its checks and transfer all ask this class.

    Parameters
    ----------
    boxes
        (..., K, 6), centres and half sizes, metres; K may be 0.
    blocked_information
        Share of its information that a link without line of sight keeps: the variance of its
        ranges is divided by it. 0: such a link gives no range.
    """

    boxes: FloatArray
    blocked_information: float

    def __bool__(self) -> bool:
        """Whether there are any."""
        return self.boxes.shape[-2] > 0

    def share(self, anchors: FloatArray, points: FloatArray) -> FloatArray:
        """Share (..., P, M) of its information that a link from each anchor to each point has.

        Anchors (..., M, 3) and points (..., P, 3), metres: the link is that of a body with its
        origin there.
        """
        return np.where(in_sight(anchors, points, self.boxes), 1.0, self.blocked_information)

    def contain(self, points: FloatArray) -> BoolArray:
        """Which points (..., 3) lie in or on one of the boxes (K, 6)."""
        return inside(points, self.boxes)


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


@compiled("sight:in_sight")
def in_sight(anchors: FloatArray, points: FloatArray, obstacles: FloatArray) -> BoolArray:
    """Which points each anchor sees, (..., P, M) booleans.

    A segment that only touches a box is not blocked; one that ends inside a box is.

    Parameters
    ----------
    anchors, points
        (..., M, 3) and (..., P, 3), metres.
    obstacles
        (..., K, 6), centres and half sizes; K may be 0.
    """
    start, end = anchors[..., None, :, None, :], points[..., :, None, None, :]
    boxes = obstacles[..., None, None, :, :]
    along, away = end - start, boxes[..., :3] - start
    low, high = (away - boxes[..., 3:]) / along, (away + boxes[..., 3:]) / along
    # Places along the segment where it enters and leaves; along a face the quotients are 0/0,
    # and NaN never blocks.
    enter = np.minimum(low, high).max(axis=-1, initial=0.0)
    leave = np.maximum(low, high).min(axis=-1, initial=1.0)
    return ~(enter < leave).any(axis=-1)


def inside(points: FloatArray, obstacles: FloatArray) -> BoolArray:
    """Which points (..., 3) lie in or on a box of (K, 6)."""
    away = np.abs(points[..., None, :] - obstacles[:, :3]) - obstacles[:, 3:]
    return np.asarray((away.max(axis=-1) <= 1e-9).any(axis=-1))
