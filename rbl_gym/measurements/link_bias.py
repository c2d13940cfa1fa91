"""Model biases of radio links, caused by cables, antennas and reflections.

A bias is a Gauss-Markov process: Gaussian, with the correlation ``exp(-dt / time_s)``. Real biases
are the sum of two kinds: constant antenna delays, and biases that change as the body moves.
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
    """Law of link biases: every link has its own bias, and all links share another one.

    Parameters
    ----------
    std_m
        Standard deviation of a link's bias, metres.
    time_s
        Correlation time, seconds; None: the bias is constant.
    common_std_m
        Standard deviation of the common bias of all links, metres.
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
        """Return the covariance (links, links) of the biases at any time."""
        return self.std_m**2 * np.eye(links) + self.common_std_m**2

    def decay(self, dt: float) -> float:
        """Return the correlation over `dt` seconds."""
        return 1.0 if self.time_s is None else math.exp(-dt / self.time_s)


def simulate_biases(
    law: LinkBias,
    times: ArrayLike,
    links: int,
    rng: np.random.Generator,
    batch: tuple[int, ...] = (),
) -> FloatArray:
    """Simulate biases (..., K, links) in metres at times (K,).

    Parameters
    ----------
    law, times, links
        `LinkBias`, seconds (K,) that do not decrease, and the number of links.
    rng, batch
        Source of the normals, and the leading axes.

    Raises
    ------
    ValueError
        If the times decrease, or the law, the number of links or the generator is invalid.
    """
    if not isinstance(law, LinkBias):
        raise ValueError(f"law must be a LinkBias, got {law!r:.80}")
    times = check_array("times", times, ("K",))
    if times.ndim != 1 or (np.diff(times) < 0).any():
        raise ValueError(f"times must have shape (K,) and not decrease, got {times!r:.80}")
    links = check_count("links", links)
    check_generator("rng", rng)
    normals = rng.standard_normal((len(times), *batch, links + 1))
    drawn = law.std_m * normals[..., :links] + law.common_std_m * normals[..., links:]
    for k, step in enumerate(np.diff(times)):
        kept = law.decay(step)
        drawn[k + 1] = kept * drawn[k] + math.sqrt(1 - kept**2) * drawn[k + 1]
    return np.moveaxis(drawn, 0, -2)
