"""What frames are drawn from: poses, what is seen of an epoch, what stays the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.obstacles import NO_PRISMS, Prisms
from rbl_gym.worlds.scene import Points


class Pose(NamedTuple):
    """Poses of B worlds and covariances of their errors, or None."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray | None


class Shot(NamedTuple):
    """What there is to see of B worlds at an epoch: anchors (B, M, 3) and which of them measure.

    `truth` carries the bound, if there is one.
    """

    anchors: FloatArray
    measuring: BoolArray
    truth: Pose


@dataclass(frozen=True)
class Stage:
    """What stays the same in the frames of a scene: corners, body, obstacles, seconds a step."""

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    tags: Points
    obstacles: tuple[tuple[float, ...], ...]
    steps: int
    dt: float
    prisms: Prisms = NO_PRISMS
