"""A placement problem as it is: the building, where anchors may stand, where the body works.

`scene_files` reads one from a file or makes it of a named scene.
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

# What the body's attitude can be in a zone.
ATTITUDES = ("free", "level", "heading")
# Points on the edge of a zone count to it, metres.
_EDGE_M = 1e-6
# Irrational steps that fill the cube evenly (Roberts's sequence in three dimensions).
_STEPS = 1.22074408460575947536 ** -np.arange(1.0, 4.0)
# So many times the points asked for are looked at, at most, for those that are free.
_MOST_TRIES = 1024


@dataclass(frozen=True, eq=False)
class Zone:
    """Where the body works, and what is asked of its pose there.

    Parameters
    ----------
    name
        Of the zone.
    polygon
        (V, 2), counter-clockwise, metres. That of a box may have no area.
    low_m, high_m
        Heights between which the body's origin moves; they may be the same.
    weight
        How much the zone counts in the score, whatever its size.
    attitude
        ``"free"``: the body turns anyhow. ``"level"``: it stands upright at any heading, and all
        six numbers of its pose are estimated. ``"heading"``: its tilt is known, and its heading
        is estimated.
    position_m, height_m, heading_deg
        Requirements, each None where there is none: one sigma of the horizontal position, of the
        height, and of the heading, from one epoch of ranges.
    share
        In so much of the zone all of them must hold.
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
        """Lower and upper corner (3,) of the smallest box around it."""
        low, high = self.polygon.min(axis=0), self.polygon.max(axis=0)
        return np.array([*low, self.low_m]), np.array([*high, self.high_m])

    @functools.cached_property
    def is_box(self) -> bool:
        """Whether it fills its `bounds`."""
        low, high = self.polygon.min(axis=0), self.polygon.max(axis=0)
        at_corner = (self.polygon == low) | (self.polygon == high)
        return len(self.polygon) == 4 and bool(at_corner.all())

    def contains(self, points: FloatArray) -> BoolArray:
        """Which points (..., 3) lie in the zone or on its edge."""
        z = points[..., 2]
        level = (z >= self.low_m - _EDGE_M) & (z <= self.high_m + _EDGE_M)
        return level & contains(self.polygon, points[..., :2], -_EDGE_M)

    @property
    def has_requirement(self) -> bool:
        """Whether anything is asked of the pose."""
        return not self.position_m is self.height_m is self.heading_deg is None


class Prior(NamedTuple):
    """Standard deviations of what is known of the pose before the first range."""

    rotation_rad: float
    position_m: float


class Plan(NamedTuple):
    """The drawing behind a problem.

    Attributes
    ----------
    image, drawing
        Paths of a picture and of the drawing it was imported from, or None.
    metres_per_pixel, origin
        Scale of the picture, and the place (x, y) of its lower left corner, metres.
    units, zero
        Units of the drawing, and its point (x, y) in these that is the origin here.
    """

    image: str | None = None
    metres_per_pixel: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    drawing: str | None = None
    units: str = "m"
    zero: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is placed, where it may stand, and what for.

    Parameters
    ----------
    name
        Of the problem.
    tags
        (N, 3) in the body frame, metres.
    noise
        Law of the ranges.
    obstacles
        What takes information from links.
    mounts
        Where anchors may stand.
    zones
        Where the body works; at least one.
    n_anchors
        How many anchors there are in all.
    fixed
        (F, 3): anchors that stay where they are, metres; they count in `n_anchors`.
    gain
        How far and how wide an anchor reaches.
    prior
        What is known of the pose before the first range.
    plan
        The drawing behind it, if there is one.
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
        """Lower and upper corner (3,) of the smallest box around all zones."""
        low, high = zip(*(zone.bounds() for zone in self.zones), strict=True)
        return np.min(low, axis=0), np.max(high, axis=0)

    def free(self, points: FloatArray) -> BoolArray:
        """Which points (..., 3) lie in a zone and outside of the obstacles."""
        within = np.any([zone.contains(points) for zone in self.zones], axis=0)
        return within & ~self.obstacles.contain(points)

    def free_places(self, count: int) -> FloatArray:
        """Up to `count` points (n, 3) spread evenly over the zones, to each by its weight."""
        share = np.cumsum([0.0, *(zone.weight for zone in self.zones)])
        counts = np.diff(np.round(count * share / share[-1]).astype(int)).tolist()
        found = [
            free_places(zone, self.obstacles, n)
            for zone, n in zip(self.zones, counts, strict=True)
            if n
        ]
        return np.concatenate(found)

    def share(self, anchors: FloatArray, points: FloatArray) -> FloatArray:
        """Share (..., P, M) of its information that a link from each anchor to each point has.

        By what stands between them, and by the anchors' range and field of view. Anchors
        (..., M, 3) and points (..., P, 3), metres.
        """
        share = self.obstacles.share(anchors, points)
        if not self.gain:
            return share
        offsets = points[..., :, None, :] - anchors[..., None, :, :]
        normals = self.mounts.normal(anchors)[..., None, :, :]
        return share * self.gain.share(offsets, normals)

    @functools.cached_property
    def scene(self) -> Scene:
        """The problem as a world: its volume is the box around all zones.

        Prisms, range and field of view are not in it.
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
        """Box around all zones and boxes in the way, as `layouts` and `criteria` take them."""
        low, high = self.corners()
        return Context(0.5 * (low + high), 0.5 * (high - low), self.obstacles.boxes)

    def with_anchors(self, n_anchors: int) -> Problem:
        """The same problem with another number of anchors."""
        return dataclasses.replace(self, n_anchors=n_anchors)


def free_places(zone: Zone, obstacles: Obstacles, count: int) -> FloatArray:
    """Up to `count` points (n, 3) spread evenly over a zone, those inside obstacles left out.

    The first of them are those of a smaller count.
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
    """Points (count, 3) that fill the unit cube evenly."""
    return (0.5 + np.arange(1, count + 1)[:, None] * _STEPS) % 1.0
