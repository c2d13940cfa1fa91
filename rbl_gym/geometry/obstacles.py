"""Model obstacles that reduce the information of links: boxes and prisms, batched.

A box is a row of six numbers, centre and half size of an axis-aligned box, metres. A prism is a
polygon in the plan between two heights. A segment that only touches an obstacle is not blocked.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, as_float, check_array, check_number
from rbl_gym.geometry.plan_grid import PlanGrid, one_cell, plan_grid
from rbl_gym.geometry.polygons import TOUCH_M, check_polygon, contains
from rbl_gym.kernels import compiled

__all__ = ["Obstacles", "Prisms", "box_bounds", "held_by", "in_sight", "inside", "share_behind"]

# A path inside a prism up to this length only touches it, metres: links begin at its faces.
_LEAST_WAY_M = 1e-6
# From this number of obstacles a link uses a grid to find those on its path: boxes only, all.
_MANY_BOXES, _MANY = 64, 12
# A link with a smaller length in the plan is vertical, metres.
_VERTICAL_M = 1e-12


def box_bounds(boxes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and the highest corners (..., 3) of boxes (..., 6), metres."""
    centre, half = boxes[..., :3], boxes[..., 3:]
    return centre - half, centre + half


@dataclass(frozen=True, eq=False)
class Prisms:
    """Polygons in the plan, each between two heights; construct with `of`, which checks them.

    Parameters
    ----------
    corners
        (K, V, 2), counter-clockwise, metres; the last corner is repeated up to V.
    low_m, high_m
        (K,), metres.
    share
        (K,): share of its information that a link through the prism keeps. NaN: the common share of
        obstacles.
    """

    corners: FloatArray = field(default_factory=lambda: np.empty((0, 1, 2)))
    low_m: FloatArray = field(default_factory=lambda: np.empty(0))
    high_m: FloatArray = field(default_factory=lambda: np.empty(0))
    share: FloatArray = field(default_factory=lambda: np.empty(0))

    @classmethod
    def of(
        cls,
        polygons: Sequence[ArrayLike],
        low_m: ArrayLike,
        high_m: ArrayLike,
        share: ArrayLike = np.nan,
    ) -> Prisms:
        """Return prisms from polygons (V, 2) of any numbers of corners; others (K,) or one for all.

        Raises
        ------
        ValueError
            If a polygon crosses itself or has no area, the heights do not increase, or a share is
            outside [0, 1].
        """
        rings = [check_polygon(f"polygons[{i}]", ring) for i, ring in enumerate(polygons)]
        found = cls.packed(rings, low_m, high_m, share)
        for index in range(len(rings)):
            bottom = check_number(f"low_m[{index}]", found.low_m[index])
            check_number(f"high_m[{index}]", found.high_m[index], low=bottom + 1e-6)
            if not np.isnan(found.share[index]):
                check_number(f"share[{index}]", found.share[index], low=0.0, high=1.0)
        return found

    @classmethod
    def packed(
        cls,
        rings: Sequence[FloatArray],
        low_m: ArrayLike,
        high_m: ArrayLike,
        share: ArrayLike = np.nan,
    ) -> Prisms:
        """Return prisms as `of` does, from checked arguments."""
        if not rings:
            return cls()
        most = max(map(len, rings))
        corners = np.array([[*ring, *[ring[-1]] * (most - len(ring))] for ring in rings])
        columns = (np.asarray(value, float) for value in (low_m, high_m, share))
        return cls(corners, *(np.broadcast_to(column, len(rings)).copy() for column in columns))

    def __len__(self) -> int:
        """Return the number of prisms."""
        return len(self.corners)

    def __eq__(self, other: object) -> bool:
        """Return whether all values are equal."""
        return isinstance(other, Prisms) and self._key == other._key

    def __hash__(self) -> int:
        """Return a hash of the values."""
        return hash(self._key)

    @functools.cached_property
    def _key(self) -> tuple[object, ...]:
        columns = self.corners, self.low_m, self.high_m, self.share
        return (self.corners.shape, *(column.tobytes() for column in columns))

    @functools.cached_property
    def limits(self) -> FloatArray:
        """Return (K, 7): minimum and maximum x, y, z of each, and its share, for `share_behind`.

        Heights are reduced by a nanometre, so that a link along a face only touches it.
        """
        low, high = self.corners.min(axis=1), self.corners.max(axis=1)
        heights = self.low_m + TOUCH_M, self.high_m - TOUCH_M
        pairs = (low[:, 0], high[:, 0], low[:, 1], high[:, 1], *heights)
        return np.stack([*pairs, self.share], axis=-1)


NO_PRISMS = Prisms()


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Boxes and prisms between anchors and tags, and the share of information of blocked links.

    Scenes, placement, its checks and transfer all use this class. A link through obstacles without
    an own share (all boxes) keeps `blocked_information`, whatever their number. Shares of prisms
    are multiplied with it and with each other. A prism counts once, even if a link enters it
    several times.

    Parameters
    ----------
    boxes
        (..., K, 6), centres and half sizes, metres; K may be 0.
    blocked_information
        Share of its information that a link without line of sight keeps. The variance of its
        ranges is divided by it. 0: such a link gives no range.
    prisms
        The prisms, the same for all leading axes of the boxes.
    """

    boxes: FloatArray
    blocked_information: float
    prisms: Prisms = field(default_factory=Prisms)

    def __bool__(self) -> bool:
        """Return whether there are any obstacles."""
        return self.boxes.shape[-2] > 0 or len(self.prisms) > 0

    def __len__(self) -> int:
        """Return the number of boxes and prisms."""
        return self.boxes.shape[-2] + len(self.prisms)

    def share(self, anchors: FloatArray, points: FloatArray) -> FloatArray:
        """Return the share (..., P, M) of its information that each link keeps.

        Links go from anchors (..., M, 3) to points (..., P, 3), metres. A point is the origin of a
        body, or a tag.
        """
        if self._are_few_boxes:
            return np.where(in_sight(anchors, points, self.boxes), 1.0, self.blocked_information)
        return self._share(anchors, points, self.blocked_information)

    def sees(self, anchors: FloatArray, points: FloatArray) -> BoolArray:
        """Return whether each link keeps all information, (..., P, M); arguments as in `share`."""
        if self._are_few_boxes:
            return in_sight(anchors, points, self.boxes)
        return self._share(anchors, points, 0.0) == 1.0

    def contain(self, points: FloatArray) -> BoolArray:
        """Return which points (..., 3) lie in or on one of the boxes (K, 6), or inside a prism."""
        if self._are_few_boxes:
            return inside(points, self.boxes)
        return held_by(points, self.boxes, self.prisms.corners, self.prisms.limits)

    @property
    def _are_few_boxes(self) -> bool:
        return not len(self.prisms) and (self.boxes.ndim > 2 or len(self.boxes) < _MANY_BOXES)

    def _share(self, anchors: FloatArray, points: FloatArray, blocked: float) -> FloatArray:
        prisms = self.prisms
        return share_behind(
            anchors, points, self.boxes, prisms.corners, prisms.limits, blocked, *self._grid
        )

    @functools.cached_property
    def _grid(self) -> PlanGrid:
        """Return the grid of obstacles, boxes first."""
        if self.boxes.ndim > 2 or len(self) < _MANY:
            return one_cell(len(self))
        low, high = (self.boxes[:, :2] + sign * self.boxes[:, 3:5] for sign in (-1, 1))
        limits = self.prisms.limits
        return plan_grid(
            np.concatenate([low, limits[:, [0, 2]]]), np.concatenate([high, limits[:, [1, 3]]])
        )


def check_obstacles(obstacles: object) -> FloatArray:
    """Return obstacles (K, 6) as an array, K may be 0; or raise ValueError."""
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
    """Return whether boxes leave each anchor in sight of each point, (..., P, M) booleans.

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
    # Parameters of entry and exit along the segment. Along a face the quotients are 0/0, and NaN
    # never blocks.
    enter = np.minimum(low, high).max(axis=-1, initial=0.0)
    leave = np.maximum(low, high).min(axis=-1, initial=1.0)
    return ~(enter < leave).any(axis=-1)


def inside(points: FloatArray, obstacles: FloatArray) -> BoolArray:
    """Return which points (..., 3) lie in or on a box of (K, 6)."""
    away = np.abs(points[..., None, :] - obstacles[:, :3]) - obstacles[:, 3:]
    return np.asarray((away.max(axis=-1) <= 1e-9).any(axis=-1))


@compiled("sight:held_by")
def held_by(
    points: FloatArray, boxes: FloatArray, corners: FloatArray, limits: FloatArray
) -> BoolArray:
    """Return which points (..., 3) lie in a box (K, 6), or in a prism deeper than a micrometre.

    Arguments as in `share_behind`.
    """
    found = np.asarray(inside(points, boxes))
    heights = points[..., 2]
    for polygon, limit in zip(corners, limits, strict=True):
        level = (heights > limit[4] + _LEAST_WAY_M) & (heights < limit[5] - _LEAST_WAY_M) & ~found
        found[level] = contains(polygon, points[level][..., :2], _LEAST_WAY_M)
    return found


@compiled("sight:share_behind")
def share_behind(
    anchors: FloatArray,
    points: FloatArray,
    boxes: FloatArray,
    corners: FloatArray,
    limits: FloatArray,
    blocked: FloatArray,
    cells: FloatArray,
    starts: np.ndarray,
    members: np.ndarray,
) -> FloatArray:
    """Return the share (..., P, M) of link information left by boxes and prisms.

    A link meets a prism if, between the heights, its path in the plan runs inside the polygon for
    more than a micrometre.

    Parameters
    ----------
    anchors, points, boxes
        As in `in_sight`.
    corners, limits
        (K, V, 2) and (K, 7), of `Prisms`.
    blocked
        Share left by all obstacles without an own share together.
    cells, starts, members
        Arrays of a `plan_grid.PlanGrid` of the boxes and prisms; only used by the kernel.
    """
    free = in_sight.textbook(anchors, points, boxes)
    start, end = np.broadcast_arrays(anchors[..., None, :, :], points[..., :, None, :])
    own = np.ones(start.shape[:-1])
    least, most = np.minimum(start, end), np.maximum(start, end)
    for polygon, limit in zip(corners, limits, strict=True):
        # Most links miss its bounding box.
        near = ((least < limit[1:6:2]) & (most > limit[0:6:2])).all(axis=-1)
        met = np.zeros_like(near)
        met[near] = _meets(start[near], end[near], polygon, limit[4], limit[5])
        if np.isnan(limit[6]):
            free = free & ~met
        else:
            own = np.where(met, limit[6] * own, own)
    return np.where(free, 1.0, np.asarray(blocked)[..., None, None]) * own


def _meets(
    start: FloatArray, end: FloatArray, polygon: FloatArray, low: float, high: float
) -> BoolArray:
    """Return which segments (S, 3) run inside a prism.

    The line of the segment is shifted slightly to the left and to the right. A shifted line enters
    the polygon at its odd crossings of edges and leaves it at its even ones. The segment is inside
    if both shifted lines are. If the segment runs along an edge, one of them is outside.
    """
    along = end - start
    length = np.sqrt((along**2).sum(axis=-1))
    to_low, to_high = (low - start[:, 2]) / along[:, 2], (high - start[:, 2]) / along[:, 2]
    level = along[:, 2] == 0.0
    enter = np.where(level, 0.0, np.maximum(0.0, np.minimum(to_low, to_high)))
    leave = np.where(level, 1.0, np.minimum(1.0, np.maximum(to_low, to_high)))
    square = along[:, 0] ** 2 + along[:, 1] ** 2
    vertical = square < _VERTICAL_M**2
    dx, dy = (np.where(vertical, unit, along[:, i])[:, None] for i, unit in ((0, 1.0), (1, 0.0)))
    x, y = polygon[:, 0] - start[:, :1], polygon[:, 1] - start[:, 1:2]
    # Position of each corner along the line, and its side.
    ahead, side = dx * x + dy * y, dx * y - dy * x
    reach = np.sqrt(dx * dx + dy * dy)
    side = np.where(np.abs(side) <= TOUCH_M * reach, 0.0, side)
    next_ahead, next_side = np.roll(ahead, -1, axis=1), np.roll(side, -1, axis=1)
    first = np.abs(side) <= np.abs(next_side)
    base, other = np.where(first, ahead, next_ahead), np.where(first, next_ahead, ahead)
    near, far = np.where(first, side, next_side), np.where(first, next_side, side)
    at = (base + near / (near - far) * (other - base)) / (reach * reach)
    left = np.where((side > 0) != (next_side > 0), at, np.inf)
    right = np.where((side >= 0) != (next_side >= 0), at, np.inf)
    stops = np.concatenate([left, right, enter[:, None], leave[:, None]], axis=1)
    stops = np.sort(stops.clip(enter[:, None], leave[:, None]), axis=1)
    middle = 0.5 * (stops[:, 1:] + stops[:, :-1])[:, :, None]
    within = ((left[:, None] < middle).sum(axis=-1) % 2 == 1) & (
        (right[:, None] < middle).sum(axis=-1) % 2 == 1
    )
    found = ((np.diff(stops, axis=1) * length[:, None] > _LEAST_WAY_M) & within).any(axis=1)
    # A vertical link is one point in the plan.
    through = (leave - enter) * length > _LEAST_WAY_M
    return np.where(vertical, through & contains(polygon, start[:, :2], TOUCH_M), found)
