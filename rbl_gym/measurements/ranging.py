"""Model ranges: distances from anchors to tags, missing links, simulated ranges.

Shapes: anchors (..., M, 3), tags (..., N, 3) in the body frame, ranges and links (..., M, N).
The noise laws of `noise_laws` are also exported here.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_generator, check_number, checked, kernel
from rbl_gym.kernels import compiled
from rbl_gym.measurements import offsets
from rbl_gym.measurements.noise_laws import (
    NOISE_LAWS,
    LinkNoise,
    NoiseLaw,
    RangeNoise,
    SquaredRangeNoise,
    check_law,
    law_of,
    numbers_of,
    reference_range,
)

__all__ = [
    "NOISE_LAWS", "LinkModel", "LinkNoise", "Measurement", "NoiseLaw", "RangeNoise",
    "SquaredRangeNoise", "distances", "measure", "reference_range", "simulate", "tag_positions",
]  # fmt: skip


@dataclass(frozen=True)
class LinkModel:
    """Link errors besides noise; by default there are none.

    Parameters
    ----------
    drop_probability
        Probability that a link gives no range at an epoch.
    reach_m
        Distance beyond which there is no range; None: unlimited.
    nlos_probability
        Probability that a range is measured along a reflected path.
    nlos_bias_m
        Bias of a range along a reflected path, metres.
    offset, offset_std_m
        Ranges of one ``"tag"``, ``"anchor"`` or ``"epoch"`` share an unknown offset, independent at
        every epoch (`offsets`); None: there is no offset. Its standard deviation, metres;
        estimators treat the offset as fully unknown.
    """

    drop_probability: float = 0.0
    reach_m: float | None = None
    nlos_probability: float = 0.0
    nlos_bias_m: float = 5.0
    offset: str | None = None
    offset_std_m: float = 30.0

    def __post_init__(self) -> None:
        check_number("drop_probability", self.drop_probability, low=0.0, high=1.0)
        check_number("nlos_probability", self.nlos_probability, low=0.0, high=1.0)
        check_number("nlos_bias_m", self.nlos_bias_m, low=0.0)
        if self.reach_m is not None:
            check_number("reach_m", self.reach_m, low=0.0)
        offsets.check_offset(self.offset)
        check_number("offset_std_m", self.offset_std_m, low=0.0)

    @property
    def options(self) -> dict[str, str]:
        """Return the options of an estimator for these links: ``offset``, if they have one."""
        return {} if self.offset is None else {"offset": self.offset}

    def n_offsets(self, anchors: int, tags: int) -> int:
        """Return the number of offsets of an epoch."""
        return 0 if self.offset is None else math.prod(self.offset_shape(anchors, tags))

    def offset_shape(self, anchors: int, tags: int) -> tuple[int, int]:
        """Return the shape of the offsets, which broadcasts against (M, N)."""
        assert self.offset is not None
        return offsets.group_shape(self.offset, anchors, tags)

    @functools.cached_property
    def never_fails(self) -> bool:
        """Return whether every link gives a range without a bias."""
        return not self.is_random and self.reach_m is None

    @property
    def is_random(self) -> bool:
        """Return whether uniforms are needed to draw the links."""
        return self.drop_probability > 0 or self.nlos_probability > 0


class Measurement(NamedTuple):
    """One epoch of ranges (..., M, N) [m], 0 if `links` is False; `nlos`: biased ranges."""

    ranges: FloatArray
    links: BoolArray
    nlos: BoolArray


@checked(rotation=(3, 3), translation=(3,), tags=("N", 3))
def tag_positions(rotation: ArrayLike, translation: ArrayLike, tags: ArrayLike) -> FloatArray:
    """Return tag positions in the world frame (..., N, 3): ``s_n = Q c_n + t``."""
    rotation, tags = np.asarray(rotation), np.asarray(tags)
    if tags.ndim == 2 and rotation.ndim > 2 and rotation.flags.f_contiguous:
        # If memory runs along the trials: one product of the tags with rows of all trials.
        columns = rotation.T.reshape(3, -1)
        turned = (tags @ columns).reshape((len(tags), *rotation.T.shape[1:]))
        turned += np.asarray(translation).T
        return np.moveaxis(turned.T, -1, -2)
    if tags.ndim == 2:
        # If all trials share the tags: one matrix product instead of one for each trial.
        turned = (rotation.reshape(-1, 3) @ tags.T).reshape((*rotation.shape[:-1], len(tags)))
        turned = np.swapaxes(turned, -1, -2)
    else:
        turned = tags @ np.swapaxes(rotation, -1, -2)
    # One memory order in all cases, so that sums over it have the same last bits.
    return np.add(turned, np.asarray(translation)[..., None, :], order="C")


@checked(anchors=("M", 3), positions=("N", 3))
def distances(anchors: ArrayLike, positions: ArrayLike) -> FloatArray:
    """Return distances (..., M, N) from anchors (..., M, 3) to positions (..., N, 3)."""
    positions, anchors = np.asarray(positions), np.asarray(anchors)
    positions, anchors = positions[..., None, :, :], anchors[..., :, None, :]
    # Summed axis by axis, for the same last bits in every memory order.
    if positions.ndim == anchors.ndim == 3:
        gap = np.subtract(positions, anchors, dtype=np.float64)
        gap *= gap
        squared = gap[..., 0] + gap[..., 1]
        squared += gap[..., 2]
        return np.sqrt(squared, out=squared)
    # For many worlds, all three axes at once do not fit in the cache.
    squared = np.subtract(positions[..., 0], anchors[..., 0], dtype=np.float64)
    squared *= squared
    gap = np.empty_like(squared)
    for axis in (1, 2):
        np.subtract(positions[..., axis], anchors[..., axis], out=gap)
        gap *= gap
        squared += gap
    return np.sqrt(squared, out=squared)


def measure(
    true_distances: FloatArray,
    noise: NoiseLaw,
    normals: FloatArray,
    link_model: LinkModel | None = None,
    uniforms: FloatArray | None = None,
) -> Measurement:
    """Return one epoch of ranges from true distances and given random numbers, without offsets.

    Parameters
    ----------
    true_distances
        (..., M, N), metres.
    noise, link_model
        Noise law and link model; without a link model every link gives a range.
    normals
        Standard normals (..., M, N).
    uniforms
        Uniforms on [0, 1) of shape (..., 2, M, N), for drops and NLOS; required if
        ``link_model.is_random``.
    """
    return lose_links(noise.sample(true_distances, normals), true_distances, link_model, uniforms)


def lose_links(
    ranges: FloatArray,
    true_distances: FloatArray | None,
    link_model: LinkModel | None = None,
    uniforms: FloatArray | None = None,
) -> Measurement:
    """Apply a link model to noisy ranges of all links; arguments as in `measure`.

    Only a model with `reach_m` needs the distances.
    """
    links = np.ones(ranges.shape, dtype=np.bool_)
    nlos = np.zeros(ranges.shape, dtype=np.bool_)
    if link_model is None or link_model.never_fails:
        return Measurement(ranges, links, nlos)
    if link_model.is_random:
        if uniforms is None:
            raise ValueError("uniforms must be given for a link model with probabilities, got None")
        links &= uniforms[..., 0, :, :] >= link_model.drop_probability
        nlos = uniforms[..., 1, :, :] < link_model.nlos_probability
        ranges = ranges + np.where(nlos, link_model.nlos_bias_m, 0.0)
    if link_model.reach_m is not None and true_distances is not None:
        links &= true_distances <= link_model.reach_m
    return Measurement(np.where(links, ranges, 0.0), links, nlos & links)


def with_offsets(
    measurement: Measurement, link_model: LinkModel, normals: FloatArray
) -> Measurement:
    """Add offsets to ranges, from standard normals (..., 1 or M, 1 or N).

    The normals are clipped to +-6, so an offset has at most six standard deviations.
    """
    ranges, links, nlos = measurement
    added = link_model.offset_std_m * np.clip(normals, -6.0, 6.0)
    return Measurement(np.where(links, ranges + added, 0.0), links, nlos)


def sample(
    rotation: FloatArray,
    translation: FloatArray,
    tags: FloatArray,
    anchors: FloatArray,
    normals: FloatArray,
    noise: NoiseLaw,
    longest: FloatArray | float,
) -> FloatArray:
    """Return noisy ranges (..., M, N) of all links at given poses, clipped to `longest`."""
    numbers = numbers_of(noise, tags.shape[-2])
    if numbers is not None:
        return _sample(rotation, translation, tags, anchors, normals, numbers, longest)
    ranges = noise.sample(true_distances(rotation, translation, tags, anchors), normals)
    return np.minimum(ranges, np.asarray(longest)[..., None, None])


@compiled("epoch:measure")
def _sample(
    rotation: FloatArray,
    translation: FloatArray,
    tags: FloatArray,
    anchors: FloatArray,
    normals: FloatArray,
    law: FloatArray,
    longest: FloatArray | float,
) -> FloatArray:
    """Compute `sample` for a law given by its numbers."""
    true = true_distances.textbook(rotation, translation, tags, anchors)
    ranges = law_of(law).sample(true, normals)
    return np.minimum(ranges, np.asarray(longest)[..., None, None])


@compiled("epoch:distances")
def true_distances(
    rotation: FloatArray, translation: FloatArray, tags: FloatArray, anchors: FloatArray
) -> FloatArray:
    """Return the distances (..., M, N) of anchors and the tags of bodies at given poses."""
    return kernel(distances)(anchors, kernel(tag_positions)(rotation, translation, tags))


@checked(anchors=("M", 3), tags=("N", 3), rotation=(3, 3), translation=(3,))
def simulate(
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: NoiseLaw,
    rng: np.random.Generator,
    link_model: LinkModel | None = None,
) -> Measurement:
    """Simulate ranges of bodies at given poses: `measure` with random numbers from `rng`.

    Parameters
    ----------
    anchors, tags, rotation, translation
        (..., M, 3), (..., N, 3), (..., 3, 3), (..., 3); metres.
    noise, link_model
        Noise law of the ranges, and link model (None: every link gives a range).
    rng
        Source of all randomness.

    Raises
    ------
    ValueError
        If a shape is wrong, a value is NaN, or a law or generator is invalid.
    """
    check_law("noise", noise)
    check_generator("rng", rng)
    if not isinstance(link_model, LinkModel | None):
        raise ValueError(f"link_model must be a LinkModel or None, got {link_model!r:.80}")
    true = true_distances(rotation, translation, tags, anchors)
    normals = rng.standard_normal(true.shape)
    uniforms = None
    if link_model is not None and link_model.is_random:
        uniforms = rng.random((*true.shape[:-2], 2, *true.shape[-2:]))
    measured = measure(true, noise, normals, link_model, uniforms)
    if link_model is None or link_model.offset is None:
        return measured
    shape = link_model.offset_shape(*true.shape[-2:])
    return with_offsets(measured, link_model, rng.standard_normal((*true.shape[:-2], *shape)))
