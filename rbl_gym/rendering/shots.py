"""Data of frames: poses, the visible part of an epoch, the static part."""

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
    """The visible part of B worlds at an epoch: anchors (B, M, 3), and which of them measure.

    `truth` has the bound as covariance, if there is one.
    """

    anchors: FloatArray
    measuring: BoolArray
    truth: Pose


@dataclass(frozen=True)
class Stage:
    """The static part of the frames of a scene: corners, body, obstacles, seconds per step."""

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    tags: Points
    obstacles: tuple[tuple[float, ...], ...]
    steps: int
    dt: float
    prisms: Prisms = NO_PRISMS
