"""Biases of radio links: what cables, antennas and reflections add to a range, link by link.

A bias is a Gauss-Markov process: Gaussian, forgotten at the rate ``exp(-dt / time_s)``. Real ones
are of two kinds, which add up: antenna delays that stay, and what moves as the body does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_count, check_generator, check_number

__all__ = ["LinkBias", "simulate_biases"]


@dataclass(frozen=True)
class LinkBias:
    """Law of the links' biases: every link has its own, and one is common to all.

    Parameters
    ----------
    std_m
        Standard deviation of a link's bias, metres.
    time_s
        Seconds after which the correlation has fallen to 1/e; None: it is constant.
    common_std_m
        Standard deviation of what all links have in common, metres.
    """

    std_m: float = 0.05
    time_s: float | None = None
    common_std_m: float = 0.0

    def __post_init__(self) -> None:
        check_number("std_m", self.std_m, low=0.0)
        check_number("common_std_m", self.common_std_m, low=0.0)
        if self.time_s is not None:
            check_number("time_s", self.time_s, low=1e-9)

    def covariance(self, links: int) -> FloatArray:
        """Of the biases of so many links, (links, links), at any time."""
        return self.std_m**2 * np.eye(links) + self.common_std_m**2

    def decay(self, dt: float) -> float:
        """Correlation over `dt` seconds."""
        return 1.0 if self.time_s is None else math.exp(-dt / self.time_s)


def simulate_biases(
    law: LinkBias,
    times: ArrayLike,
    links: int,
    rng: np.random.Generator,
    batch: tuple[int, ...] = (),
) -> FloatArray:
    """Biases (..., K, links) in metres at times (K,), drawn from the law.

    Parameters
    ----------
    law, times, links
        `LinkBias`, seconds (K,) that do not decrease, and how many links there are.
    rng, batch
        Source of the normals, and the leading axes.

    Raises
    ------
    ValueError
        On times that decrease, and on a law, a number of links or a generator that is none.
    """
    if not isinstance(law, LinkBias):
        raise ValueError(f"law must be a LinkBias, got {law!r:.80}")
    times = check_array("times", times, ("K",))
    if times.ndim != 1 or (np.diff(times) < 0).any():
        raise ValueError(f"times must be (K,) and not decrease, got {times!r:.80}")
    links = check_count("links", links)
    check_generator("rng", rng)
    normals = rng.standard_normal((len(times), *batch, links + 1))
    drawn = law.std_m * normals[..., :links] + law.common_std_m * normals[..., links:]
    for k, step in enumerate(np.diff(times)):
        kept = law.decay(step)
        drawn[k + 1] = kept * drawn[k] + math.sqrt(1 - kept**2) * drawn[k + 1]
    return np.moveaxis(drawn, 0, -2)
