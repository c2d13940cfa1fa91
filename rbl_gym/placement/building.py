"""A placement problem of a building: obstacles, mounts, and zones in which the body works.

`scene_files` reads one from a file or makes one from a named scene.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.polygons import contains
from rbl_gym.geometry.regions import Box, Region
from rbl_gym.measurements.gain import Gain
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.placement.problem import Context
from rbl_gym.worlds.scene import Scene

__all__ = ["ATTITUDES", "Plan", "Prior", "Problem", "Zone", "free_places"]

# Possible attitudes of the body in a zone.
ATTITUDES = ("free", "level", "heading")
# Points this close to the edge of a zone are in it, metres.
_EDGE_M = 1e-6
# Irrational steps that fill the cube evenly (Roberts's sequence in three dimensions).
_STEPS = 1.22074408460575947536 ** -np.arange(1.0, 4.0)
# At most this many times the requested number of points is tried to find free ones.
_MOST_TRIES = 1024


@dataclass(frozen=True, eq=False)
class Zone:
    """A zone in which the body works, and the requirements on its pose there.

    Parameters
    ----------
    name
        Name of the zone.
    polygon
        Corners (V, 2), counter-clockwise, metres. A box may have zero area.
    low_m, high_m
        Lowest and highest height of the body's origin; they may be equal.
    weight
        Weight of the zone in the score, independent of its size.
    attitude
        ``"free"``: any rotation. ``"level"``: the body is upright at any heading, and all six pose
        parameters are estimated. ``"heading"``: its tilt is known, and its heading is estimated.
    position_m, height_m, heading_deg
        Requirements, None for no requirement: standard deviation of the horizontal position, of the
        height, and of the heading, from one epoch of ranges.
    share
        Fraction of the zone in which all requirements must hold.
    """

    name: str
    polygon: FloatArray
    low_m: float
    high_m: float
    weight: float = 1.0
    attitude: str = "free"
    position_m: float | None = None
    height_m: float | None = None
    heading_deg: float | None = None
    share: float = 0.95

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper corner (3,) of the bounding box."""
        low, high = self.polygon.min(axis=0), self.polygon.max(axis=0)
        return np.array([*low, self.low_m]), np.array([*high, self.high_m])

    @functools.cached_property
    def is_box(self) -> bool:
        """Whether the zone fills its `bounds`."""
        low, high = self.polygon.min(axis=0), self.polygon.max(axis=0)
        at_corner = (self.polygon == low) | (self.polygon == high)
        return len(self.polygon) == 4 and bool(at_corner.all())

    def contains(self, points: FloatArray) -> BoolArray:
        """Return which points (..., 3) lie in the zone or on its edge."""
        z = points[..., 2]
        level = (z >= self.low_m - _EDGE_M) & (z <= self.high_m + _EDGE_M)
        return level & contains(self.polygon, points[..., :2], -_EDGE_M)

    @property
    def has_requirement(self) -> bool:
        """Whether the zone has any requirement on the pose."""
        return not self.position_m is self.height_m is self.heading_deg is None


class Prior(NamedTuple):
    """Standard deviations of the pose known before the first range."""

    rotation_rad: float
    position_m: float


class Plan(NamedTuple):
    """The drawing of a problem.

    Attributes
    ----------
    image, drawing
        Paths of a picture and of the imported drawing, or None.
    metres_per_pixel, origin
        Scale of the picture, and the position (x, y) of its lower left corner, metres.
    units, zero
        Units of the drawing, and the point (x, y) in these units that is the origin here.
    """

    image: str | None = None
    metres_per_pixel: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    drawing: str | None = None
    units: str = "m"
    zero: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Problem:
    """A placement problem: number of anchors, mounts, obstacles and zones.

    Parameters
    ----------
    name
        Name of the problem.
    tags
        Tags (N, 3) in the body frame, metres.
    noise
        Noise law of the ranges.
    obstacles
        Obstacles, which reduce the information of links.
    mounts
        Region of legal anchor positions.
    zones
        Zones in which the body works; at least one.
    n_anchors
        Total number of anchors.
    fixed
        Fixed anchors (F, 3), metres; they count in `n_anchors`.
    gain
        Reach and field of view of an anchor.
    prior
        Knowledge of the pose before the first range.
    plan
        The drawing of the building, or None.
    """

    name: str
    tags: FloatArray
    noise: NoiseLaw
    obstacles: Obstacles
    mounts: Region
    zones: tuple[Zone, ...]
    n_anchors: int
    fixed: FloatArray
    gain: Gain
    prior: Prior
    plan: Plan | None = None

    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper corner (3,) of the bounding box of all zones."""
        low, high = zip(*(zone.bounds() for zone in self.zones), strict=True)
        return np.min(low, axis=0), np.max(high, axis=0)

    def free(self, points: FloatArray) -> BoolArray:
        """Return which points (..., 3) lie in a zone and outside of the obstacles."""
        within = np.any([zone.contains(points) for zone in self.zones], axis=0)
        return within & ~self.obstacles.contain(points)

    def free_places(self, count: int) -> FloatArray:
        """Return up to `count` points (n, 3) spread evenly over the zones, shared by weight."""
        share = np.cumsum([0.0, *(zone.weight for zone in self.zones)])
        counts = np.diff(np.round(count * share / share[-1]).astype(int)).tolist()
        found = [
            free_places(zone, self.obstacles, n)
            for zone, n in zip(self.zones, counts, strict=True)
            if n
        ]
        return np.concatenate(found)

    def share(self, anchors: FloatArray, points: FloatArray) -> FloatArray:
        """Return the information fraction (..., P, M) of links from each anchor to each point.

        It depends on the obstacles between them, and on the anchors' reach and field of view.
        Anchors (..., M, 3) and points (..., P, 3), metres.
        """
        share = self.obstacles.share(anchors, points)
        if not self.gain:
            return share
        offsets = points[..., :, None, :] - anchors[..., None, :, :]
        normals = self.mounts.normal(anchors)[..., None, :, :]
        return share * self.gain.share(offsets, normals)

    @functools.cached_property
    def scene(self) -> Scene:
        """Return the problem as a scene: its volume is the box around all zones.

        Prisms, reach and field of view are not included.
        """
        boxes = self.obstacles.boxes
        return Scene(
            name=self.name,
            volume=Box(*(tuple(corner.tolist()) for corner in self.corners())),
            anchor_region=self.mounts,
            n_anchors=self.n_anchors,
            tags=tuple(map(tuple, self.tags.tolist())),
            noise=self.noise,
            obstacles=tuple(map(tuple, boxes.tolist())),
            blocked_information=self.obstacles.blocked_information,
            process=ProcessNoise(),
            dt=1.0,
            initial_rotation_rad=self.prior.rotation_rad,
            initial_translation_m=self.prior.position_m,
        )

    @functools.cached_property
    def context(self) -> Context:
        """Return the box around all zones, and the boxes, for `layouts` and `criteria`."""
        low, high = self.corners()
        return Context(0.5 * (low + high), 0.5 * (high - low), self.obstacles.boxes)

    def with_anchors(self, n_anchors: int) -> Problem:
        """Return the same problem with another number of anchors."""
        return dataclasses.replace(self, n_anchors=n_anchors)


def free_places(zone: Zone, obstacles: Obstacles, count: int) -> FloatArray:
    """Return up to `count` points (n, 3) spread evenly over a zone, without those in obstacles.

    The first ones are those of a smaller count.
    """
    low, high = zone.bounds()
    tries = 4 * count if obstacles or not zone.is_box else count
    while True:
        points = low + cube(tries) * (high - low)
        free = points if zone.is_box else points[zone.contains(points)]
        free = free[~obstacles.contain(free)]
        if len(free) >= count or tries >= _MOST_TRIES * count:
            return free[:count]
        tries *= 4


def cube(count: int) -> FloatArray:
    """Return points (count, 3) that fill the unit cube evenly."""
    return (0.5 + np.arange(1, count + 1)[:, None] * _STEPS) % 1.0
