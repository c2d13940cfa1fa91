"""The range model: distances from anchors to tags, noise laws, links that fail.

Shapes: anchors (..., M, 3), tags (..., N, 3) in the body frame, ranges and links (..., M, N).
A noise law knows the variance of a range and of a squared range; where the variance is
common to all tags of an anchor it comes back as (..., M, 1), which is how the estimators
recognise the papers' case.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    BoolArray,
    FloatArray,
    check_array,
    check_generator,
    check_number,
    checked,
    kernel,
)

__all__ = [
    "NOISE_LAWS", "LinkModel", "LinkNoise", "Measurement", "NoiseLaw", "RangeNoise",
    "SquaredRangeNoise", "distances", "measure", "reference_range", "simulate", "tag_positions",
]  # fmt: skip


class NoiseLaw(Protocol):
    """What every noise law offers; ranges (..., M, N) in metres, links the mask beside them."""

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Variance of each range [m^2], (..., M, N) or (..., M, 1) where common to the tags."""
        ...

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Variance of each squared range [m^4], (..., M, N) or (..., M, 1)."""
        ...

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Noisy ranges from true distances and standard normals of the same shape."""
        ...


@dataclass(frozen=True)
class RangeNoise:
    """Gaussian noise on the range, variance ``floor_m^2 + (proportional r)^2``.

    Parameters
    ----------
    floor_m
        Standard deviation at zero range, metres.
    proportional
        Growth of the standard deviation with the range, metres per metre.
    reference_tag
        None: ``r`` is each link's own range. An index: ``r`` is the range of that tag, for
        all tags of an anchor, as the papers do (static paper, eq. (2)).

    Raises
    ------
    ValueError
        If a parameter is negative or not finite, or both are zero.
    """

    floor_m: float = 0.05
    proportional: float = 0.0
    reference_tag: int | None = None

    def __post_init__(self) -> None:
        check_number("floor_m", self.floor_m, low=0.0)
        check_number("proportional", self.proportional, low=0.0)
        if self.floor_m == 0 and self.proportional == 0:
            raise ValueError("floor_m and proportional must not both be zero: noise-free ranges")
        tag = self.reference_tag
        if tag is not None and (isinstance(tag, bool) or not isinstance(tag, Integral)):
            raise ValueError(f"reference_tag must be None or an int, got {tag!r}")

    @classmethod
    def from_reference_range_db(cls, db: float, reference_tag: int | None = 0) -> RangeNoise:
        """The static paper's law: a reference range of `db` decibels, 100 dB = 1 mm at 100 m.

        The standard deviation is ``10^(-db / 20)`` of the range, by default that of the first
        tag for all tags of an anchor (its eq. (2)); ``reference_tag=None``: of each link.
        """
        return cls(0.0, 10 ** (-check_number("db", db) / 20), reference_tag)

    @classmethod
    def from_time_of_arrival(
        cls,
        speed_m_s: float,
        n_samples: float,
        kappa: float,
        snr: float,
        reference_tag: int | None = 0,
    ) -> RangeNoise:
        """The static paper's law from what makes it, its (1) and (2).

        The variance of a range r is ``3 c^2 r^2 / (N_s kappa SNR)``; the reference range is
        ``10 log10(N_s kappa SNR / (3 c^2))`` dB.

        Parameters
        ----------
        speed_m_s
            Speed c of the wave, metres per second.
        n_samples
            Samples N_s of a ranging.
        kappa
            The constant of the ranging method.
        snr
            Signal-to-noise ratio, a ratio and not decibels.
        reference_tag
            As in `from_reference_range_db`.
        """
        values = {"speed_m_s": speed_m_s, "n_samples": n_samples, "kappa": kappa, "snr": snr}
        c, n, k, ratio = (check_number(name, value, low=1e-300) for name, value in values.items())
        return cls(0.0, math.sqrt(3 / (n * k * ratio)) * c, reference_tag)

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Variance of the ranges [m^2]; see `NoiseLaw`."""
        r = self._scale(ranges, links)
        return self.floor_m**2 + (self.proportional * r) ** 2

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Variance ``4 r^2 var(r)`` of the squared ranges [m^4], to first order."""
        r = self._scale(ranges, links)
        return 4 * r**2 * (self.floor_m**2 + (self.proportional * r) ** 2)

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Ranges with noise of this law, never below zero."""
        if self.proportional == 0:
            std: Any = math.sqrt(self.floor_m**2)
        else:
            std = self.proportional * self._scale(distances, None)
            std *= std
            std += self.floor_m**2
            np.sqrt(std, out=std)
        fits = isinstance(std, np.ndarray) and std.shape == distances.shape == np.shape(normals)
        ranges = np.multiply(std, normals, out=std if fits else None)
        ranges += distances
        return np.maximum(ranges, 0.0, out=ranges)

    def _scale(self, ranges: FloatArray, links: BoolArray | None) -> FloatArray:
        if self.reference_tag is None:
            return ranges
        return reference_range(ranges, self.reference_tag, links)


@dataclass(frozen=True)
class SquaredRangeNoise:
    """The tracking paper's law: ``r^2 + n`` with ``n ~ N(0, (sigma_m |a_m - s_1|)^2)``.

    Parameters
    ----------
    sigma_m
        Ratio of the squared range's standard deviation to the range of the first tag, metres.
    """

    sigma_m: float = 0.0316

    def __post_init__(self) -> None:
        check_number("sigma_m", self.sigma_m, low=1e-300)

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Variance ``(sigma r_1 / 2 r)^2`` of the ranges [m^2], to first order; inf at zero."""
        r = ranges if links is None else np.where(links, ranges, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.squared_range_variance(ranges, links) / (4 * r**2)

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Variance of the squared ranges [m^4], (..., M, 1)."""
        return (self.sigma_m * reference_range(ranges, 0, links)) ** 2

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Ranges with noise of this law; a negative square counts as zero."""
        squares = self.sigma_m * distances[..., :1] * normals
        squares += distances**2
        np.maximum(squares, 0.0, out=squares)
        return np.sqrt(squares, out=squares)


@dataclass(frozen=True, eq=False)
class LinkNoise:
    """A standard deviation for every link, as radios report them.

    Parameters
    ----------
    std_m
        (..., M, N), metres; entries of links that are not measured do not matter.
    """

    std_m: FloatArray

    def __post_init__(self) -> None:
        std = check_array("std_m", self.std_m, ("M", "N"))
        if (std < 0).any():
            raise ValueError(f"std_m must not be negative, got {std.min()}")
        object.__setattr__(self, "std_m", std)

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Variance of the ranges [m^2]; see `NoiseLaw`."""
        return np.broadcast_to(self.std_m**2, np.broadcast_shapes(self.std_m.shape, ranges.shape))

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Variance ``4 r^2 var(r)`` of the squared ranges [m^4], to first order."""
        return 4 * ranges**2 * self.std_m**2

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Ranges with noise of this law, never below zero."""
        return np.maximum(distances + self.std_m * normals, 0.0)


def check_law(name: str, noise: Any) -> None:
    """A ValueError where something does not offer what a `NoiseLaw` does."""
    methods = ("variance", "squared_range_variance", "sample")
    if not all(callable(getattr(noise, method, None)) for method in methods):
        raise ValueError(f"{name} must have {', '.join(methods)}, got {noise!r:.80}")


# The laws of scenes by the names that scene files and overrides give them.
NOISE_LAWS: dict[str, type[NoiseLaw]] = {
    "range": RangeNoise,
    "squared-range": SquaredRangeNoise,
}
# Other ways to say a law of these.
NOISE_FORMS: dict[str, Callable[..., NoiseLaw]] = {
    **NOISE_LAWS,
    "reference-range": RangeNoise.from_reference_range_db,
    "time-of-arrival": RangeNoise.from_time_of_arrival,
}


def reference_range(ranges: FloatArray, tag: int, links: BoolArray | None = None) -> FloatArray:
    """Range (..., M, 1) of the reference tag to every anchor.

    Where that link is missing, the mean of the anchor's measured ranges stands in for it, and
    1 where an anchor has no link at all (its weight is zero anyway).

    Raises
    ------
    ValueError
        If there is no such tag.
    """
    n_tags = ranges.shape[-1]
    if not -n_tags <= tag < n_tags:
        raise ValueError(f"reference_tag must be below the number of tags {n_tags}, got {tag}")
    reference = ranges[..., tag : tag + 1 or None]
    if links is None or links.all():
        return reference
    ranges, links = np.broadcast_arrays(ranges, links)
    reference = ranges[..., tag : tag + 1 or None]
    count = links.sum(axis=-1, keepdims=True)
    mean = np.where(links, ranges, 0.0).sum(axis=-1, keepdims=True) / np.maximum(count, 1)
    stand_in = np.where(count > 0, mean, 1.0)
    return np.where(links[..., tag : tag + 1 or None], reference, stand_in)


@dataclass(frozen=True)
class LinkModel:
    """What happens to a link besides noise; the default is that nothing does.

    Parameters
    ----------
    drop_probability
        Chance that a link gives no range at an epoch.
    reach_m
        Distance beyond which there is no range; None: unlimited.
    nlos_probability
        Chance that a range is taken over a reflected path.
    nlos_bias_m
        What a reflected path adds to the range, metres.
    """

    drop_probability: float = 0.0
    reach_m: float | None = None
    nlos_probability: float = 0.0
    nlos_bias_m: float = 5.0

    def __post_init__(self) -> None:
        check_number("drop_probability", self.drop_probability, low=0.0, high=1.0)
        check_number("nlos_probability", self.nlos_probability, low=0.0, high=1.0)
        check_number("nlos_bias_m", self.nlos_bias_m, low=0.0)
        if self.reach_m is not None:
            check_number("reach_m", self.reach_m, low=0.0)

    @property
    def is_random(self) -> bool:
        """Whether uniforms are needed to decide the links."""
        return self.drop_probability > 0 or self.nlos_probability > 0


class Measurement(NamedTuple):
    """One epoch of ranges (..., M, N) [m], 0 where `links` is False; `nlos`: biased ones."""

    ranges: FloatArray
    links: BoolArray
    nlos: BoolArray


@checked(rotation=(3, 3), translation=(3,), tags=("N", 3))
def tag_positions(rotation: ArrayLike, translation: ArrayLike, tags: ArrayLike) -> FloatArray:
    """Tags in the world frame (..., N, 3): ``s_n = Q c_n + t``."""
    rotation, tags = np.asarray(rotation), np.asarray(tags)
    if tags.ndim == 2 and rotation.ndim > 2 and rotation.flags.f_contiguous:
        # Memory that runs along the trials: one product of the tags with rows of all trials.
        columns = rotation.T.reshape(3, -1)
        turned = (tags @ columns).reshape((len(tags), *rotation.T.shape[1:]))
        turned += np.asarray(translation).T
        return np.moveaxis(turned.T, -1, -2)
    if tags.ndim == 2:
        # Tags that all trials share: one matrix product in place of one for each trial.
        turned = (rotation.reshape(-1, 3) @ tags.T).reshape((*rotation.shape[:-1], len(tags)))
        turned = np.swapaxes(turned, -1, -2)
    else:
        turned = tags @ np.swapaxes(rotation, -1, -2)
    # One memory order whatever the way here: a sum over it gives the same last bits.
    return np.add(turned, np.asarray(translation)[..., None, :], order="C")


@checked(anchors=("M", 3), positions=("N", 3))
def distances(anchors: ArrayLike, positions: ArrayLike) -> FloatArray:
    """Distances (..., M, N) from anchors (..., M, 3) to positions (..., N, 3)."""
    positions, anchors = np.asarray(positions), np.asarray(anchors)
    positions, anchors = positions[..., None, :, :], anchors[..., :, None, :]
    # Summed axis by axis: the same last bits in every memory order.
    if positions.ndim == anchors.ndim == 3:
        gap = np.subtract(positions, anchors, dtype=np.float64)
        gap *= gap
        squared = gap[..., 0] + gap[..., 1]
        squared += gap[..., 2]
        return np.sqrt(squared, out=squared)
    # Of many worlds the three axes at once would not stay in the cache.
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
    """One epoch of measurements from true distances and given random numbers.

    Parameters
    ----------
    true_distances
        (..., M, N), metres.
    noise, link_model
        The laws; without a link model every link measures.
    normals
        Standard normals (..., M, N).
    uniforms
        Uniforms on [0, 1) of shape (..., 2, M, N), for drops and NLOS; needed where
        ``link_model.is_random``.
    """
    ranges = noise.sample(true_distances, normals)
    links = np.ones(ranges.shape, dtype=np.bool_)
    nlos = np.zeros(ranges.shape, dtype=np.bool_)
    if link_model is None or not (link_model.is_random or link_model.reach_m is not None):
        return Measurement(ranges, links, nlos)
    if link_model.is_random:
        if uniforms is None:
            raise ValueError("uniforms must be given for a link model with probabilities, got None")
        links &= uniforms[..., 0, :, :] >= link_model.drop_probability
        nlos = uniforms[..., 1, :, :] < link_model.nlos_probability
        ranges = ranges + np.where(nlos, link_model.nlos_bias_m, 0.0)
    if link_model.reach_m is not None:
        links &= true_distances <= link_model.reach_m
    return Measurement(np.where(links, ranges, 0.0), links, nlos & links)


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
    """Noisy ranges of bodies at given poses: `measure` with numbers drawn from `rng`.

    Parameters
    ----------
    anchors, tags, rotation, translation
        (..., M, 3), (..., N, 3), (..., 3, 3), (..., 3); metres.
    noise, link_model
        Laws of the ranges, and of what happens to links (None: nothing).
    rng
        Source of all randomness.

    Raises
    ------
    ValueError
        On wrong shapes, NaN, or laws and generators that are none.
    """
    check_law("noise", noise)
    check_generator("rng", rng)
    if not isinstance(link_model, LinkModel | None):
        raise ValueError(f"link_model must be a LinkModel or None, got {link_model!r:.80}")
    true = kernel(distances)(anchors, kernel(tag_positions)(rotation, translation, tags))
    normals = rng.standard_normal(true.shape)
    uniforms = None
    if link_model is not None and link_model.is_random:
        uniforms = rng.random((*true.shape[:-2], 2, *true.shape[-2:]))
    return measure(true, noise, normals, link_model, uniforms)
