"""The world as a frozen dataclass: numbers with units, checked when it is created."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import (
    FloatArray,
    as_tuples,
    check_array,
    check_count,
    check_number,
    check_one_of,
)
from rbl_gym.geometry import rotations
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import NO_PRISMS, Obstacles, Prisms, check_obstacles
from rbl_gym.geometry.regions import REGIONS, Box, Region
from rbl_gym.measurements import inertial
from rbl_gym.measurements.gain import EVERYWHERE, Gain
from rbl_gym.measurements.inertial import InertialSensor
from rbl_gym.measurements.ranging import NOISE_LAWS, LinkModel, NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

__all__ = ["Scene"]

_FIELD_KINDS: dict[str, tuple[type, ...]] = {
    "volume": (Box,),
    "anchor_region": (*REGIONS.values(), Mounts),
    "noise": tuple(NOISE_LAWS.values()),
    "process": (ProcessNoise,),
    "links": (LinkModel,),
    "prisms": (Prisms,),
    "gain": (Gain,),
}
# Smallest information fraction of a link if its noise must be bounded.
_LEAST_SHARE = 1e-6
TRAJECTORIES = ("waypoints", "constant", "random-twist", "orbit", "lawn-mower")
Points = tuple[tuple[float, float, float], ...]


class FlatScales(NamedTuple):
    """Scales of a scene that bring observations to order one.

    Centre and half size of the volume (..., 3), half the diagonal of the box around volume and
    anchors (...), all in metres, and the scales of a twist (..., 6): pi/10 per step, and the body's
    speed.
    """

    middle: FloatArray
    half: FloatArray
    extent: FloatArray
    rates: FloatArray

    def joined(self) -> FloatArray:
        """Return all scales as one array (..., 13)."""
        return np.concatenate([self.middle, self.half, self.extent[..., None], self.rates], axis=-1)

    @classmethod
    def split(cls, joined: FloatArray) -> FlatScales:
        """Return the inverse of `joined`."""
        return cls(joined[..., :3], joined[..., 3:6], joined[..., 6], joined[..., 7:])


@dataclass(frozen=True)
class Scene:
    """A world in which a rigid body is tracked. SI units; standard deviations are per axis.

    Parameters
    ----------
    name
        Name of the scene, or its title in pictures and errors.
    volume
        Region in which the body moves.
    anchor_region, n_anchors, anchors
        Region of the anchors, their number, and their positions (M, 3) at the start of every
        episode. With `anchors` None every reset draws them in the region.
    anchor_start_m
        Anchors are drawn at most this far from the body, on every axis; None: anywhere in their
        region.
    anchor_speed_m_s
        Speed limit of the anchors; 0 for fixed anchors.
    survey_std_m
        Standard deviation per axis of the survey errors of the anchor positions. The errors are
        constant over an episode. Observations and filters have the positions with errors.
    tags
        Positions (N, 3) in the body frame.
    noise, links
        Noise law of the ranges, and model of the links.
    obstacles, blocked_information
        Boxes (K, 6) that block the line of sight: centre and half size. A link is blocked if the
        anchor does not see the body's origin. A blocked link has more noise: it keeps the fraction
        `blocked_information` of its Fisher information. With 0 it gives no range.
    prisms
        Obstacles that are polygons in plan between two heights, such as walls. They come from
        building files.
    gain
        Reach and field of view of an anchor, also from building files.
    fixed
        Positions (F, 3) of the first anchors, if the others are drawn or placed.
    process
        Process noise: standard deviations after 1 s.
    dt, steps
        Seconds between epochs, and number of steps of an episode.
    trajectory, speed_m_s, spin_rad_s, twist
        ``"waypoints"``: straight lines between points uniform in the volume. ``"constant"``: the
        same `twist` (6) at every step. ``"random-twist"``: a new direction and rotation axis every
        10 steps, at `speed_m_s` and `spin_rad_s`. ``"orbit"``: a horizontal circle around the
        volume's centre with a radius of 0.35 of the shorter side, nose first. ``"lawn-mower"``:
        lanes along x, a fifth of the volume apart. With ``"waypoints"`` and ``"lawn-mower"`` each
        episode draws a turn rate with standard deviation `spin_rad_s`.
    start_rotation, start_translation, start_volume
        Initial pose. If the rotation is None, it is drawn uniformly on SO(3). If the translation is
        None, it is drawn uniformly in `start_volume`, or in `volume` if `start_volume` is None.
    initial_rotation_rad, initial_translation_m
        Standard deviations of the prior.
    prior
        ``"drawn"``: the prior mean is drawn around the true pose at epoch 0. ``"start"``, as in the
        tracking paper: one step before epoch 0 the prior mean is the true pose, and the standard
        deviations are those above; one prediction leads to epoch 0.
    inertial
        Inertial sensor on the body, with readings between epochs: an `InertialSensor`, or a name or
        a dict as in `measurements.inertial.sensor`. None: no sensor. With a sensor the body moves
        smoothly, see `worlds.inertial_motion`.
    """

    name: str
    volume: Box
    anchor_region: Region
    n_anchors: int
    tags: Points
    noise: NoiseLaw
    process: ProcessNoise
    dt: float
    initial_rotation_rad: float
    initial_translation_m: float
    anchors: Points | None = None
    anchor_start_m: float | None = None
    anchor_speed_m_s: float = 0.0
    obstacles: tuple[tuple[float, ...], ...] = ()
    blocked_information: float = 0.02
    prisms: Prisms = NO_PRISMS
    gain: Gain = EVERYWHERE
    fixed: Points = ()
    links: LinkModel = field(default_factory=LinkModel)
    steps: int = 100
    trajectory: str = "waypoints"
    speed_m_s: float = 0.0
    spin_rad_s: float = 0.0
    twist: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    start_rotation: Points | None = None
    start_translation: tuple[float, float, float] | None = None
    start_volume: Box | None = None
    prior: str = "drawn"
    inertial: InertialSensor | None = None
    survey_std_m: float = 0.0

    def __post_init__(self) -> None:
        for name, kinds in _FIELD_KINDS.items():
            if not isinstance(getattr(self, name), kinds):
                raise ValueError(f"{name} must be {_names(kinds)}, got {getattr(self, name)!r:.80}")
        check_number("dt", self.dt, low=1e-9)
        if self.process.std().ndim > 1:
            shape = self.process.std().shape[:-1]
            raise ValueError(f"process must be the same for all worlds, got leading axes {shape}")
        for name in ("initial_rotation_rad", "initial_translation_m"):
            check_number(name, getattr(self, name), low=1e-9)
        for name in ("anchor_speed_m_s", "speed_m_s", "spin_rad_s", "survey_std_m"):
            check_number(name, getattr(self, name), low=0.0)
        check_number("blocked_information", self.blocked_information, low=0.0, high=1.0)
        if self.anchor_start_m is not None:
            check_number("anchor_start_m", self.anchor_start_m, low=0.0)
        if not isinstance(self.start_volume, Box | None):
            raise ValueError(f"start_volume must be a Box or None, got {self.start_volume!r:.80}")
        object.__setattr__(self, "obstacles", as_tuples(check_obstacles(self.obstacles)))
        check_one_of("trajectory", self.trajectory, TRAJECTORIES)
        check_one_of("prior", self.prior, ("drawn", "start"))
        for name in ("n_anchors", "steps"):
            object.__setattr__(self, name, check_count(name, getattr(self, name)))
        shapes: dict[str, tuple[int | str, ...]] = {
            "tags": ("N", 3), "anchors": ("M", 3), "twist": (6,), "start_translation": (3,),
        }  # fmt: skip
        for name, shape in shapes.items():
            if name == "tags" or getattr(self, name) is not None:
                value = check_array(name, getattr(self, name), shape)
                if value.ndim != len(shape):
                    raise ValueError(f"{name} must have no leading axes, got shape {value.shape}")
                object.__setattr__(self, name, as_tuples(value))
        if self.start_rotation is not None:
            value = rotations.check_rotation("start_rotation", self.start_rotation)
            if value.ndim != 2:
                raise ValueError(f"start_rotation must have no leading axes, got {value.shape}")
            object.__setattr__(self, "start_rotation", as_tuples(value))
        if self.anchors is not None and len(self.anchors) != self.n_anchors:
            raise ValueError(
                f"anchors must hold n_anchors = {self.n_anchors} positions, got {len(self.anchors)}"
            )
        if self.fixed:
            fixed = check_array("fixed", self.fixed, ("F", 3))
            if self.anchors is not None or fixed.ndim != 2 or len(fixed) > self.n_anchors:
                raise ValueError(
                    f"fixed must hold positions of at most n_anchors = {self.n_anchors} anchors, "
                    f"and needs anchors=None; got {self.fixed!r:.80}"
                )
            object.__setattr__(self, "fixed", as_tuples(fixed))
        else:
            object.__setattr__(self, "fixed", ())
        self._check_trajectory()
        if self.inertial is not None:
            object.__setattr__(self, "inertial", inertial.sensor(self.inertial))
            self.inertial.samples(self.dt)
            if self.prior == "start":
                raise ValueError(
                    "prior must be 'drawn' in a scene with an inertial sensor, got 'start'"
                )
        if self.anchors is not None and self.anchor_speed_m_s > 0:
            anchors, region = np.array(self.anchors), self.anchor_region
            # The kernel of a box would import numba with the named scenes.
            box = isinstance(region, Box)
            legal = np.clip(anchors, *region.bounds()) if box else region.project(anchors)
            moved = np.abs(legal - anchors)
            if moved.max() > 1e-6:
                raise ValueError(
                    "anchors that move must start in anchor_region, but "
                    f"anchors[{int(moved.max(axis=1).argmax())}] is {moved.max():g} m outside: "
                    "change anchors or anchor_region"
                )
        reference = getattr(self.noise, "reference_tag", None)
        if reference is not None and not 0 <= reference < len(self.tags):
            raise ValueError(
                f"reference_tag must be below the number of tags, {len(self.tags)}, got {reference}"
            )

    def _check_trajectory(self) -> None:
        """Check the trajectory: orbit and lawn-mower define their start and need a volume."""
        if self.trajectory not in ("orbit", "lawn-mower"):
            return
        stated = "start_translation" if self.start_translation is not None else None
        if self.trajectory == "orbit" and self.start_rotation is not None:
            stated = "start_rotation"
        if stated is not None:
            raise ValueError(f"{stated} must be None for trajectory {self.trajectory!r}")
        low, high = self.volume.bounds()
        if not (high > low)[:2].all():
            raise ValueError(
                f"volume must have low below high in x and y for trajectory {self.trajectory!r}, "
                f"got low {low}, high {high}"
            )

    @functools.cached_property
    def obstruction(self) -> Obstacles:
        """The obstacles, and the information of blocked links."""
        boxes = np.array(self.obstacles).reshape(-1, 6)
        return Obstacles(boxes, self.blocked_information, self.prisms)

    @functools.cached_property
    def weakens(self) -> bool:
        """Whether anything reduces the information of links; links then have a `quality`."""
        return bool(self.obstruction) or bool(self.gain)

    @functools.cached_property
    def body(self) -> FloatArray:
        """The tags as a read-only array (N, 3)."""
        body = np.array(self.tags)
        body.flags.writeable = False
        return body

    @functools.cached_property
    def prior_covariance(self) -> FloatArray:
        """Pose covariance (6, 6) of the prior, read-only."""
        std = [self.initial_rotation_rad] * 3 + [self.initial_translation_m] * 3
        covariance = np.diag(np.square(std))
        covariance.flags.writeable = False
        return covariance

    @functools.cached_property
    def scales(self) -> FlatScales:
        """Scales that bring observations to order one."""
        low, high = self.volume.bounds()
        corners = np.array([low, high, *self.anchor_region.bounds()])
        extent = np.linalg.norm(np.ptp(corners, axis=0)) / 2
        half = np.maximum(0.5 * (high - low), 1e-3 * extent)
        speed = max(self.speed_m_s, float(np.abs(self.twist[3:]).max()), 1e-3)
        rates = np.array([np.pi / 10 / self.dt] * 3 + [speed] * 3)
        return FlatScales(0.5 * (low + high), half, np.asarray(extent), rates)

    @functools.cached_property
    def speed_std_m_s(self) -> float:
        """Standard deviation per axis of the body's velocity, without further knowledge."""
        speed = max(self.speed_m_s, float(np.linalg.norm(self.twist[3:])))
        return max(speed / math.sqrt(3), 1e-3)

    @property
    def steps_of_motion(self) -> int:
        """Number of motion steps of an episode, one more if the prior is older than epoch 0."""
        return self.steps + (self.prior == "start")

    @functools.cached_property
    def n_waypoints(self) -> int:
        """Number of points that an episode draws in the volume, including the start."""
        if self.trajectory != "waypoints":
            return 1
        extent = max(float(np.linalg.norm(np.ptp(self.volume.bounds(), axis=0))), 1e-9)
        # Legs average more than a quarter of the extent: draw four times the resulting number, and
        # 8.
        travelled = self.speed_m_s * self.dt * self.steps_of_motion
        return 8 + int(np.ceil(16 * travelled / extent))

    @functools.cached_property
    def range_limit_m(self) -> float:
        """Limit of all measurements of this scene without offsets (measurements are clipped)."""
        duration = self.steps * self.dt
        places = (*(self.anchors or ()), *filter(None, [self.start_translation]))
        corners = np.array([*self.volume.bounds(), *self.anchor_region.bounds(), *places])
        extent = float(np.linalg.norm(np.ptp(corners, axis=0)))
        speed = max(self.speed_m_s, float(np.linalg.norm(self.twist[3:])))
        body = float(np.linalg.norm(self.tags, axis=-1).max())
        spread = 10 * float(self.process.std()[3:].max()) * math.sqrt(duration)
        reach = np.full((1, len(self.tags)), extent + speed * (duration + self.dt) + spread + body)
        noise = 10 * float(np.sqrt(self.noise.variance(reach).max()))
        if self.gain:
            noise /= math.sqrt(_LEAST_SHARE)
        elif self.obstruction:
            shares = np.array([self.blocked_information, *self.prisms.share])
            noise /= math.sqrt(max(shares[shares > 0].prod(), _LEAST_SHARE))
        return float(reach[0, 0]) + noise + self.links.nlos_bias_m

    @property
    def range_bounds_m(self) -> tuple[float, float]:
        """Lower and upper limit of all ranges: with offsets they may be negative."""
        if self.links.offset is None:
            return 0.0, self.range_limit_m
        offset = 6 * self.links.offset_std_m
        return -offset - 1e-9, self.range_limit_m + offset


def _names(kinds: tuple[type, ...]) -> str:
    return " or ".join(kind.__name__ for kind in kinds)
