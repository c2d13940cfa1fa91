"""Noise laws: the variance of a range, and of a squared range, as functions of the range.

If the variance is the same for all tags of an anchor, its shape is (..., M, 1).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Protocol

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number

__all__ = [
    "NOISE_FORMS", "NOISE_LAWS", "LinkNoise", "NoiseLaw", "RangeNoise", "SquaredRangeNoise",
    "StackedNoise", "WeakenedNoise", "reference_range",
]  # fmt: skip


class NoiseLaw(Protocol):
    """Interface of noise laws; ranges (..., M, N) in metres, links their mask."""

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Return the variance of each range [m^2], (..., M, N).

        The shape is (..., M, 1) if the variance is the same for all tags.
        """
        ...

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Return the variance of each squared range [m^4], (..., M, N) or (..., M, 1)."""
        ...

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Return noisy ranges from true distances and standard normals of the same shape."""
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
        all tags of an anchor, as in the papers (static paper, eq. (2)).

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
            raise ValueError(
                "floor_m and proportional must not both be zero: the ranges would have no noise"
            )
        tag = self.reference_tag
        if tag is not None and (isinstance(tag, bool) or not isinstance(tag, Integral)):
            raise ValueError(f"reference_tag must be None or an int, got {tag!r}")

    @classmethod
    def from_reference_range_db(cls, db: float, reference_tag: int | None = 0) -> RangeNoise:
        """Return the law of the static paper for the reference range `db`: 100 dB = 1 mm at 100 m.

        The standard deviation is ``10^(-db / 20)`` times the range. By default this is the range of
        the first tag, for all tags of an anchor (its eq. (2)). With ``reference_tag=None`` it is
        the range of each link.
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
        """Return the law of the static paper from its physical parameters, its (1) and (2).

        The variance of a range r is ``3 c^2 r^2 / (N_s kappa SNR)``; the reference range is
        ``10 log10(N_s kappa SNR / (3 c^2))`` dB.

        Parameters
        ----------
        speed_m_s
            Propagation speed c, metres per second.
        n_samples
            Number of samples N_s per range.
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
        """Return the variance of the ranges [m^2]; see `NoiseLaw`."""
        r = self._scale(ranges, links)
        return self.floor_m**2 + (self.proportional * r) ** 2

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Return the variance ``4 r^2 var(r)`` of the squared ranges [m^4], to first order."""
        square = self._scale(ranges, links) ** 2
        if self.proportional == 0:
            return 4 * self.floor_m**2 * square
        variance = (4 * self.proportional**2) * square
        variance += 4 * self.floor_m**2
        variance *= square
        return variance

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Return ranges with noise of this law, never below zero."""
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

    @functools.cached_property
    def numbers(self) -> FloatArray | None:
        """Return the law (4,) as used by `rbl_gym.kernels.noise_laws`; None: unsupported."""
        tag = -1 if self.reference_tag is None else self.reference_tag
        if self.reference_tag is not None and tag < 0:
            return None
        return np.array([0.0, self.floor_m, self.proportional, tag])

    def _scale(self, ranges: FloatArray, links: BoolArray | None) -> FloatArray:
        if self.reference_tag is None:
            return ranges
        return reference_range(ranges, self.reference_tag, links)


@dataclass(frozen=True)
class SquaredRangeNoise:
    """The law of the tracking paper: ``r^2 + n`` with ``n ~ N(0, (sigma_m |a_m - s_1|)^2)``.

    Parameters
    ----------
    sigma_m
        Ratio of the standard deviation of the squared range to the range of the first tag, metres.
    """

    sigma_m: float = 0.0316

    def __post_init__(self) -> None:
        check_number("sigma_m", self.sigma_m, low=1e-300)

    @functools.cached_property
    def numbers(self) -> FloatArray:
        """Return the law (4,) as `RangeNoise.numbers` does."""
        return np.array([1.0, self.sigma_m, 0.0, 0.0])

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Return the first-order variance ``(sigma r_1 / 2 r)^2`` of ranges [m^2]; inf at zero."""
        r = ranges if links is None else np.where(links, ranges, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.squared_range_variance(ranges, links) / (4 * r**2)

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Return the variance of the squared ranges [m^4], (..., M, 1)."""
        return (self.sigma_m * reference_range(ranges, 0, links)) ** 2

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Return ranges with noise of this law; negative squared ranges are set to zero."""
        squares = self.sigma_m * distances[..., :1] * normals
        squares += distances**2
        np.maximum(squares, 0.0, out=squares)
        return np.sqrt(squares, out=squares)


@dataclass(frozen=True, eq=False)
class StackedNoise:
    """The laws of a batch of worlds, which may be of different kinds.

    Parameters
    ----------
    numbers
        (..., 4), each row from `RangeNoise.numbers` or `SquaredRangeNoise.numbers`.
    """

    numbers: FloatArray

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Return the variance of the ranges [m^2], (..., M, N); see `NoiseLaw`."""
        squared, first, second = self._parts
        scale = self._scale(ranges, links)
        r = ranges if links is None else np.where(links, ranges, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            of_squares = (first * scale) ** 2 / (4 * r**2)
        return np.where(squared, of_squares, first**2 + (second * scale) ** 2)

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Return the variance of the squared ranges [m^4], (..., M, N); see `NoiseLaw`."""
        squared, first, second = self._parts
        scale = self._scale(ranges, links)
        of_ranges = 4 * scale**2 * (first**2 + (second * scale) ** 2)
        return np.where(squared, (first * scale) ** 2, of_ranges)

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Return ranges with noise of these laws, never below zero."""
        squared, first, second = self._parts
        scale = self._scale(distances, None)
        of_ranges = distances + np.sqrt(first**2 + (second * scale) ** 2) * normals
        squares = np.maximum(distances**2 + first * scale * normals, 0.0)
        return np.where(squared, np.sqrt(squares), np.maximum(of_ranges, 0.0))

    @property
    def _parts(self) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Return whether a law is for squared ranges, and its two parameters, (..., 1, 1)."""
        kind, first, second, _ = np.moveaxis(self.numbers, -1, 0)[..., None, None]
        return kind == 1, first, second

    def _scale(self, ranges: FloatArray, links: BoolArray | None) -> FloatArray:
        """Return the range (..., M, N) that scales the noise: of the link or the reference tag."""
        reference, scale = self.numbers[..., 3, None, None], ranges
        for tag in np.unique(reference[reference >= 0]).astype(int).tolist():
            scale = np.where(reference == tag, reference_range(ranges, tag, links), scale)
        return scale


@dataclass(frozen=True, eq=False)
class LinkNoise:
    """A standard deviation for every link, as reported by radios.

    Parameters
    ----------
    std_m
        (..., M, N), metres; entries of links that are not measured have no effect.
    """

    std_m: FloatArray

    def __post_init__(self) -> None:
        std = check_array("std_m", self.std_m, ("M", "N"))
        if (std < 0).any():
            raise ValueError(f"std_m must not be negative, got {std.min()}")
        object.__setattr__(self, "std_m", std)

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Return the variance of the ranges [m^2]; see `NoiseLaw`."""
        return np.broadcast_to(self.std_m**2, np.broadcast_shapes(self.std_m.shape, ranges.shape))

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Return the variance ``4 r^2 var(r)`` of the squared ranges [m^4], to first order."""
        return 4 * ranges**2 * self.std_m**2

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Return ranges with noise of this law, never below zero."""
        return np.maximum(distances + self.std_m * normals, 0.0)


@dataclass(frozen=True, eq=False)
class WeakenedNoise:
    """A noise law whose links have only a share of the information.

    It models a receiver that knows the quality of the link of every range.

    Parameters
    ----------
    law
        The law of links with full information.
    share
        (..., M), 0 to 1; 0 gives an infinite variance.
    """

    law: NoiseLaw
    share: FloatArray

    def variance(self, ranges: FloatArray, links: BoolArray | None = None) -> FloatArray:
        """Return the variance of the ranges [m^2]; see `NoiseLaw`."""
        return self._weakened(self.law.variance(ranges, links))

    def squared_range_variance(
        self, ranges: FloatArray, links: BoolArray | None = None
    ) -> FloatArray:
        """Return the variance of the squared ranges [m^4]; see `NoiseLaw`."""
        return self._weakened(self.law.squared_range_variance(ranges, links))

    def sample(self, distances: FloatArray, normals: FloatArray) -> FloatArray:
        """Return ranges with noise of this law, never below zero."""
        return self.law.sample(distances, normals / np.sqrt(self.share)[..., None])

    def _weakened(self, variance: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return variance / self.share[..., None]


def numbers_of(noise: NoiseLaw, n_tags: int) -> FloatArray | None:
    """Return the law of N tags as used by the kernels; None if they do not support it.

    ValueError if the reference tag does not exist.
    """
    numbers = getattr(noise, "numbers", None)
    if numbers is not None and numbers.ndim == 1 and numbers.item(3) >= n_tags:
        _check_reference(int(numbers[3]), n_tags)
    return numbers


def law_of(numbers: FloatArray) -> NoiseLaw:
    """Return the law with these `numbers` (4,), or the laws of many worlds (..., 4)."""
    if numbers.ndim > 1:
        return StackedNoise(numbers)
    kind, first, second, reference = numbers.tolist()
    if kind == 1:
        return SquaredRangeNoise(first)
    return RangeNoise(first, second, None if reference < 0 else int(reference))


def check_law(
    name: str,
    noise: Any,
    methods: tuple[str, ...] = ("variance", "squared_range_variance", "sample"),
) -> None:
    """Raise ValueError if an object does not have the methods of `NoiseLaw`, or these of them."""
    if not all(callable(getattr(noise, method, None)) for method in methods):
        raise ValueError(
            f"{name} must be a noise law such as ranging.RangeNoise(floor_m=0.1), with the method"
            f"{'s' * (len(methods) > 1)} {', '.join(methods)}; got {noise!r:.80}"
        )


# Noise laws by their names in scene files and overrides.
NOISE_LAWS: dict[str, type[NoiseLaw]] = {"range": RangeNoise, "squared-range": SquaredRangeNoise}
# Other ways to specify one of these laws.
NOISE_FORMS: dict[str, Callable[..., NoiseLaw]] = {
    **NOISE_LAWS,
    "reference-range": RangeNoise.from_reference_range_db,
    "time-of-arrival": RangeNoise.from_time_of_arrival,
}


def reference_range(ranges: FloatArray, tag: int, links: BoolArray | None = None) -> FloatArray:
    """Return the range (..., M, 1) of the reference tag to every anchor.

    If that link is missing, the mean of the measured ranges of the anchor is used instead. If an
    anchor has no link, the value is 1; its weight is zero.

    Raises
    ------
    ValueError
        If the tag does not exist.
    """
    _check_reference(tag, ranges.shape[-1])
    reference = ranges[..., tag : tag + 1 or None]
    if links is None or links.all():
        return reference
    ranges, links = np.broadcast_arrays(ranges, links)
    reference = ranges[..., tag : tag + 1 or None]
    count = links.sum(axis=-1, keepdims=True)
    mean = np.where(links, ranges, 0.0).sum(axis=-1, keepdims=True) / np.maximum(count, 1)
    stand_in = np.where(count > 0, mean, 1.0)
    return np.where(links[..., tag : tag + 1 or None], reference, stand_in)


def _check_reference(tag: int, n_tags: int) -> None:
    if not -n_tags <= tag < n_tags:
        raise ValueError(f"reference_tag must be below the number of tags {n_tags}, got {tag}")
