"""A placement problem of a building: obstacles, mounts, and zones in which the body works.

`scene_files` reads one from a file or makes one from a named scene.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.polygons import contains
from rbl_gym.geometry.regions import Box, Region
from rbl_gym.measurements.gain import Gain
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.placement.problem import Context, PlacementTask, link_shares
from rbl_gym.worlds.scene import Scene

__all__ = ["ATTITUDES", "Plan", "Problem", "Zone", "free_places"]

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
class Problem(PlacementTask):
    """The placement task of one building: its work region is that of its zones.

    Parameters
    ----------
    scene
        Scene with the body, the noise, the obstacles, the mounts (`anchor_region`), the anchors'
        reach and field of view, and the prior. Its volume is the box around all zones.
    n_anchors
        Total number of anchors, including `fixed`.
    racks
        0: the boxes are obstacles of the scene.
    n_poses
        Number of poses in the zones, for `layouts` and `criteria`.
    zones
        Zones in which the body works; at least one.
    fixed
        Fixed anchors (F, 3), metres.
    plan
        The drawing of the building, or None.
    notes
        Doubtful parts of the file, in words.
    obstacle_names
        Names of the obstacles with their positions in the plan, boxes first; empty if unknown.
    """

    n_poses: int = 64
    zones: tuple[Zone, ...] = ()
    fixed: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    plan: Plan | None = None
    notes: tuple[str, ...] = ()
    obstacle_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check nothing: `file_checks` does, and a drawing may show any scene."""

    def __eq__(self, other: object) -> bool:
        """Return whether it is the same object, as zones have arrays."""
        return self is other

    __hash__ = object.__hash__

    @classmethod
    def of(
        cls,
        zones: tuple[Zone, ...],
        n_anchors: int,
        fixed: ArrayLike = (),
        plan: Plan | None = None,
        **scene: Any,
    ) -> Problem:
        """Return the problem of zones, and of the other fields of its scene."""
        low, high = zip(*(zone.bounds() for zone in zones), strict=True)
        volume = Box(tuple(np.min(low, axis=0).tolist()), tuple(np.max(high, axis=0).tolist()))
        still: dict[str, Any] = {"process": ProcessNoise(), "dt": 1.0}
        whole = Scene(volume=volume, n_anchors=n_anchors, **(still | scene))
        fixed = np.array(fixed, float).reshape(-1, 3)
        return cls(whole, n_anchors, zones=zones, fixed=fixed, plan=plan)

    @property
    def name(self) -> str:
        """Name of the problem."""
        return self.scene.name

    @property
    def tags(self) -> FloatArray:
        """Tags (N, 3) in the body frame, metres."""
        return self.scene.body

    @property
    def noise(self) -> NoiseLaw:
        """Noise law of the ranges."""
        return self.scene.noise

    @property
    def obstacles(self) -> Obstacles:
        """Obstacles, which reduce the information of links."""
        return self.scene.obstruction

    @property
    def mounts(self) -> Region:
        """Region of legal anchor positions."""
        return self.scene.anchor_region

    @property
    def gain(self) -> Gain:
        """Reach and field of view of an anchor."""
        return self.scene.gain

    @functools.cached_property
    def context(self) -> Context:
        """The box around all zones, and the boxes that block sight."""
        low, high = self.corners()
        return Context(0.5 * (low + high), 0.5 * (high - low), self.obstacles.boxes)

    @functools.cached_property
    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Rotations (P, 3, 3), and offsets (P, 3) spread evenly over the free space."""
        # If fewer positions are free than needed, they are repeated.
        places = np.resize(self.free_places(self.n_poses), (self.n_poses, 3))
        centre, half, _ = self.context
        return super().poses[0], (places - centre) / np.where(half > 0, half, 1.0)

    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper corner (3,) of the bounding box of all zones."""
        return self.scene.volume.bounds()

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
        return link_shares(self.scene, self.obstacles, anchors, points)

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
