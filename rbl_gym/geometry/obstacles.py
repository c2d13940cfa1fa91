"""Boxes that block sight: what they leave of a link's information, by the slab test, batched.

An obstacle is a row of six numbers, centre and half size of an axis-aligned box, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, as_float, check_array

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
        return self._share(in_sight(anchors, points, self.boxes))

    def share_along(self, start: Sequence[FloatArray], along: Sequence[FloatArray]) -> FloatArray:
        """`share` (P, M, B) by the components of `clear`, boxes (B, K, 6)."""
        return self._share(self.clear_along(start, along))

    def clear_along(self, start: Sequence[FloatArray], along: Sequence[FloatArray]) -> BoolArray:
        """Which segments (P, M, B) pass by all boxes (B, K, 6), K at least 1; see `clear`."""
        return clear(start, along, self.boxes.transpose(1, 2, 0).copy())

    def contain(self, points: FloatArray) -> BoolArray:
        """Which points (..., 3) lie in or on one of the boxes (K, 6)."""
        return inside(points, self.boxes)

    def _share(self, sight: BoolArray) -> FloatArray:
        return np.where(sight, 1.0, self.blocked_information)


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
    batch = np.broadcast_shapes(anchors.shape[:-2], points.shape[:-2], obstacles.shape[:-2])
    free = np.ones((*batch, points.shape[-2], anchors.shape[-2]), dtype=np.bool_)
    if not obstacles.shape[-2]:
        return free
    start = [anchors[..., None, :, i] for i in range(3)]
    along = [points[..., :, None, i] - start[i] for i in range(3)]
    boxes = np.moveaxis(obstacles, (-2, -1), (0, 1))[..., None, None]
    return free & clear(start, along, boxes)


def inside(points: FloatArray, obstacles: FloatArray) -> BoolArray:
    """Which points (..., 3) lie in or on a box of (K, 6)."""
    away = np.abs(points[..., None, :] - obstacles[:, :3]) - obstacles[:, 3:]
    return np.asarray((away.max(axis=-1) <= 1e-9).any(axis=-1))


def clear(
    start: Sequence[FloatArray], along: Sequence[FloatArray], boxes: FloatArray
) -> np.ndarray:
    """Whether segments pass by all boxes.

    Parameters
    ----------
    start, along
        Three components (...) each: one end, and the other end less it.
    boxes
        (K, 6, ...), K at least 1.
    """
    free: Any = True
    # Along a face the quotients are 0/0, and NaN never blocks.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for box in boxes:
            # Places along the segment where it enters and leaves.
            enter, leave = np.float64(0), np.float64(1)
            for i in range(3):
                away, half = box[i] - start[i], box[3 + i]
                low, high = (away - half) / along[i], (away + half) / along[i]
                enter = np.maximum(enter, np.minimum(low, high))
                leave = np.minimum(leave, np.maximum(low, high))
            free = free & ~(enter < leave)
    return free
