"""Model biases of radio links, caused by cables, antennas and reflections.

A bias is a Gauss-Markov process: Gaussian, with the correlation ``exp(-dt / time_s)``. Real biases
are the sum of two kinds: constant antenna delays, and biases that change as the body moves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rbl_gym.checks import FloatArray, check_number

__all__ = ["LinkBias"]


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
