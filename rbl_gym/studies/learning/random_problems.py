"""Common parts of random placement problems: bodies, noise, numbers of anchors."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import bodies
from rbl_gym.placement.tokens import Scenery

_TURN_STD = math.radians(60)


class Batch(NamedTuple):
    """Problems of one family as arrays with one leading axis.

    `scenery` is the input of the network, `count` the number of anchors to place; then rotations
    (B, P, 3, 3) and weights (B, P) of the poses at `Scenery.places`, and the prior information
    (B, P, 6, 6); the outer radius (B,) of shells; the shares of a link's information that boxes
    leave (B,), and of the links of fixed anchors (B, P, F).
    """

    scenery: Scenery
    count: int
    rotation: FloatArray
    weight: FloatArray
    prior: FloatArray
    outer: FloatArray
    left: FloatArray
    fixed_share: FloatArray


def log_uniform(rng: np.random.Generator, low: float, high: float, size: int) -> FloatArray:
    """Return numbers (size,) whose logarithms are uniform."""
    return np.exp(rng.uniform(math.log(low), math.log(high), size))


def draw_count(rng: np.random.Generator, fixed: int = 0) -> int:
    """Return the number of anchors to place: 3 to 16 with the fixed ones, mostly few."""
    most = 12 if rng.random() < 0.8 else 16
    return max(int(rng.integers(3, most + 1)) - fixed, 1)


def _tags(rng: np.random.Generator, radius: FloatArray) -> FloatArray:
    """Return bodies (B, N, 3) of one kind with the given root mean square radius."""
    kind = int(rng.integers(6))
    size = len(radius)
    known = (bodies.octahedron(), bodies.pyramid(), bodies.cube(), bodies.plate(1.0, 0.6))
    if kind < 4:
        scale = np.exp(rng.uniform(-0.3, 0.3, (size, 1, 3)))
        tags = scale * known[kind] if rng.random() < 0.5 else np.tile(known[kind], (size, 1, 1))
    else:
        tags = rng.standard_normal((size, int(rng.integers(3, 9)), 3))
        tags -= tags.mean(axis=1, keepdims=True)
        tags += 0.3 * rng.standard_normal((size, 1, 3)) * (rng.random((size, 1, 1)) < 0.3)
    return tags * (radius / np.sqrt((tags**2).sum(axis=2).mean(axis=1)))[:, None, None]


def body_and_noise(
    rng: np.random.Generator, size: int, reach: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return tags (B, N, 3) and noise (B, 2) of worlds of a size (B,)."""
    radius = reach * log_uniform(rng, 0.003, 0.4, size)
    floor = radius * log_uniform(rng, 0.01, 0.5, size)
    growth = log_uniform(rng, 1e-4, 1e-2, size) * (rng.random(size) < 0.75)
    return _tags(rng, radius), np.stack([floor, growth], axis=-1)


def priors(extent: FloatArray, n_poses: int) -> FloatArray:
    """Return prior information (B, P, 6, 6): 60 degrees, and half of the extent (B,)."""
    prior = np.zeros((len(extent), n_poses, 6, 6))
    axes = np.arange(3)
    prior[..., axes, axes] = _TURN_STD**-2
    prior[..., axes + 3, axes + 3] = ((0.5 * extent) ** -2)[:, None, None]
    return prior


def draw_fixed(rng: np.random.Generator) -> int:
    """Return the number of fixed anchors, often zero."""
    return int(rng.integers(1, 4)) if rng.random() < 0.2 else 0
