"""The world as a frozen dataclass: numbers with units, checked when it is made."""

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
# No less than this is left of a link where its noise is bounded.
_LEAST_SHARE = 1e-6
TRAJECTORIES = ("waypoints", "constant", "random-twist", "orbit", "lawn-mower")
Points = tuple[tuple[float, float, float], ...]


class FlatScales(NamedTuple):
    """What is large in a scene, for observations of order one.

    Attributes
    ----------
    middle, half
        Of the volume (..., 3), metres.
    extent
        Half the diagonal of the box around volume and anchors (...), metres.
    rates
        Of a twist (..., 6): pi/10 in a step, and the body's speed.
    """

    middle: FloatArray
    half: FloatArray
    extent: FloatArray
    rates: FloatArray

    def joined(self) -> FloatArray:
        """All of them as one array (..., 13)."""
        return np.concatenate([self.middle, self.half, self.extent[..., None], self.rates], axis=-1)

    @classmethod
    def split(cls, joined: FloatArray) -> FlatScales:
        """The inverse of `joined`."""
        return cls(joined[..., :3], joined[..., 3:6], joined[..., 6], joined[..., 7:])


@dataclass(frozen=True)
class Scene:
    """A world to track a rigid body in. SI units; every standard deviation is per axis.

    Parameters
    ----------
    name
        Under which it is registered.
    volume
        Where the body moves.
    anchor_region, n_anchors, anchors
        Where anchors may stand, how many, and their places (M, 3) at the start of every
        episode; `anchors` None draws them anew in the region at every reset.
    anchor_start_m
        Anchors that are drawn start within so much of the body on every axis; None: anywhere
        in their region.
    anchor_speed_m_s
        Limit on the anchors' speed; 0: they are fixed.
    survey_std_m
        Standard deviation per axis of the anchors' surveyed places about the true ones: constant
        over an episode. Observations and filters are told the surveyed ones.
    tags
        Places (N, 3) on the body, in the body frame.
    noise, links
        The range law and what else happens to a link.
    obstacles, blocked_information
        Boxes (K, 6) that block sight, centre and half size; a link without line of sight from
        the anchor to the body's origin keeps this share of its information: its noise is
        stronger. 0: it gives no range.
    prisms
        Obstacles that are polygons in the plan between two heights, such as walls; they come with
        the files of buildings.
    gain
        How far and how wide an anchor reaches; this too comes with files.
    fixed
        Places (F, 3) of the first anchors, where the others are drawn or placed.
    process
        Noise of the motion: standard deviations after 1 s.
    dt, steps
        Seconds between epochs, steps of an episode.
    trajectory, speed_m_s, spin_rad_s, twist
        ``"waypoints"``: straight lines between points uniform in the volume.
        ``"constant"``: the same `twist` (6) at every step. ``"random-twist"``: a new direction
        and turn axis every 10 steps, at `speed_m_s` and `spin_rad_s`. ``"orbit"``: a level
        circle about the volume's centre, its radius 0.35 of the shorter side, nose first.
        ``"lawn-mower"``: lanes along x, a fifth of the volume apart. On way-points and lanes
        the body turns at a rate drawn once an episode with standard deviation `spin_rad_s`.
    start_rotation, start_translation, start_volume
        Pose at the start; None: drawn (uniform on SO(3), uniform in the start volume, which
        None takes to be the volume).
    initial_rotation_rad, initial_translation_m
        Standard deviations of the prior.
    prior
        ``"drawn"``: the prior mean is drawn around the true pose at epoch 0. ``"start"``: the
        prior is exact one step before epoch 0, as wide as stated, and predicted once (the
        tracking paper).
    inertial
        Inertial sensor on the body, which is then read between epochs: an `InertialSensor`, a
        name or a dict as `measurements.inertial.sensor` takes it; None: there is none. With one
        the body moves smoothly, as `worlds.inertial_motion` describes.
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
    inertial: inertial.InertialSensor | None = None
    survey_std_m: float = 0.0

    def __post_init__(self) -> None:
        for name, kinds in _FIELD_KINDS.items():
            if not isinstance(getattr(self, name), kinds):
                raise ValueError(f"{name} must be {_names(kinds)}, got {getattr(self, name)!r:.80}")
        check_number("dt", self.dt, low=1e-9)
        if self.process.std().ndim > 1:
            shape = self.process.std().shape[:-1]
            raise ValueError(f"process must be that of all worlds, got leading axes {shape}")
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
                f"anchors must hold n_anchors = {self.n_anchors} places, got {len(self.anchors)}"
            )
        if self.fixed:
            fixed = check_array("fixed", self.fixed, ("F", 3))
            if self.anchors is not None or fixed.ndim != 2 or len(fixed) > self.n_anchors:
                raise ValueError(
                    f"fixed must be places of at most n_anchors = {self.n_anchors} anchors, and "
                    f"anchors None, got {self.fixed!r:.80}"
                )
            object.__setattr__(self, "fixed", as_tuples(fixed))
        else:
            object.__setattr__(self, "fixed", ())
        self._check_trajectory()
        if self.inertial is not None:
            object.__setattr__(self, "inertial", inertial.sensor(self.inertial))
            self.inertial.samples(self.dt)
            if self.prior == "start":
                raise ValueError("prior must be 'drawn' in a scene with an inertial sensor")
        if self.anchors is not None and self.anchor_speed_m_s > 0:
            moved = np.abs(self.anchor_region.project(np.array(self.anchors)) - self.anchors)
            if moved.max() > 1e-6:
                raise ValueError(
                    f"anchors that move must start in their region, got one {moved.max():g} m off"
                )
        reference = getattr(self.noise, "reference_tag", None)
        if reference is not None and not 0 <= reference < len(self.tags):
            raise ValueError(f"reference_tag must be below {len(self.tags)} tags, got {reference}")

    def _check_trajectory(self) -> None:
        """An orbit and a lawn-mower bring their own start, and need a volume to be in."""
        if self.trajectory not in ("orbit", "lawn-mower"):
            return
        stated = "start_translation" if self.start_translation is not None else None
        if self.trajectory == "orbit" and self.start_rotation is not None:
            stated = "start_rotation"
        if stated is not None:
            raise ValueError(f"{stated} must be None for trajectory {self.trajectory!r}")
        low, high = self.volume.bounds()
        if not (high > low)[:2].all():
            raise ValueError(f"volume must have an extent in x and y for {self.trajectory!r}")

    @functools.cached_property
    def obstruction(self) -> Obstacles:
        """The obstacles, and what they leave of a link."""
        boxes = np.array(self.obstacles).reshape(-1, 6)
        return Obstacles(boxes, self.blocked_information, self.prisms)

    @functools.cached_property
    def weakens(self) -> bool:
        """Whether anything takes information from links: then they have a `quality`."""
        return bool(self.obstruction) or bool(self.gain)

    @functools.cached_property
    def body(self) -> FloatArray:
        """The tags as an array (N, 3), not to be written to."""
        body = np.array(self.tags)
        body.flags.writeable = False
        return body

    @functools.cached_property
    def prior_covariance(self) -> FloatArray:
        """Pose covariance (6, 6) of the prior, not to be written to."""
        std = [self.initial_rotation_rad] * 3 + [self.initial_translation_m] * 3
        covariance = np.diag(np.square(std))
        covariance.flags.writeable = False
        return covariance

    @functools.cached_property
    def scales(self) -> FlatScales:
        """What is large in it."""
        low, high = self.volume.bounds()
        corners = np.array([low, high, *self.anchor_region.bounds()])
        extent = np.linalg.norm(np.ptp(corners, axis=0)) / 2
        half = np.maximum(0.5 * (high - low), 1e-3 * extent)
        speed = max(self.speed_m_s, float(np.abs(self.twist[3:]).max()), 1e-3)
        rates = np.array([np.pi / 10 / self.dt] * 3 + [speed] * 3)
        return FlatScales(0.5 * (low + high), half, np.asarray(extent), rates)

    @functools.cached_property
    def speed_std_m_s(self) -> float:
        """Standard deviation of the body's velocity per axis, where nothing else is known of it."""
        speed = max(self.speed_m_s, float(np.linalg.norm(self.twist[3:])))
        return max(speed / math.sqrt(3), 1e-3)

    @property
    def steps_of_motion(self) -> int:
        """Steps of an episode, one more where the prior is older than epoch 0."""
        return self.steps + (self.prior == "start")

    @functools.cached_property
    def n_waypoints(self) -> int:
        """Points that an episode draws in the volume, the start among them."""
        if self.trajectory != "waypoints":
            return 1
        extent = max(float(np.linalg.norm(np.ptp(self.volume.bounds(), axis=0))), 1e-9)
        # Legs average above a quarter of the extent: four times as many as that calls for, and 8.
        travelled = self.speed_m_s * self.dt * self.steps_of_motion
        return 8 + int(np.ceil(16 * travelled / extent))

    @functools.cached_property
    def range_limit_m(self) -> float:
        """What no measurement of this scene exceeds, but for offsets (measurements are clipped)."""
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
        """Between which all ranges lie: with offsets they may be negative."""
        if self.links.offset is None:
            return 0.0, self.range_limit_m
        offset = 6 * self.links.offset_std_m
        return -offset - 1e-9, self.range_limit_m + offset


def _names(kinds: tuple[type, ...]) -> str:
    return " or ".join(kind.__name__ for kind in kinds)
