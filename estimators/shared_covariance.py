"""One covariance for all trials: they share anchors, fixed weights and prior covariance.

The covariance then does not depend on what is measured, and neither does the gain: a step of
the whole batch is one of 12 x 12 matrices, and one product of the squared ranges with it.
A covariance is known to be shared by its memory: no leading axes, or leading strides of zero.
"""

from __future__ import annotations

import numpy as np

from rbl_gym.bounds import symmetric
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.squared_range import (
    extended,
    information,
    squares_times,
    statistic,
)


def shared(covariance: FloatArray) -> FloatArray | None:
    """The (n, n) covariance of all trials, None where each may have its own."""
    leading = covariance.ndim - 2
    if any(covariance.strides[:leading]) or 0 in covariance.shape:
        return None
    return covariance[(0,) * leading]


def update(
    mean: FloatArray,
    P: FloatArray,
    ranges: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    weights: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Mean (..., 12) and the shared covariance (12, 12) after an epoch.

    Parameters
    ----------
    mean, P
        (..., 12) and (12, 12).
    ranges
        (..., M, N), metres; checked in passing.
    anchors, tags, weights
        (M, 3), (N, 3), (M, 1) or (M, N): the same for all trials.
    """
    # The information vector is linear in the squared ranges; this is its constant part.
    matrix, constant = information(statistic(np.zeros(ranges.shape[-2:]), anchors, tags, weights))
    P = symmetric(np.linalg.solve(np.eye(12) + P @ matrix, P))
    mass = weights.sum(axis=0)
    centre = (weights / np.where(mass > 0, mass, 1.0)).T @ anchors
    spread = weights[..., None] * (anchors[:, None] - centre)
    slope = -2 * (extended(tags)[:, :, None] * spread[:, :, None]).reshape(-1, 12)
    batch = np.broadcast_shapes(mean.shape[:-1], ranges.shape[:-2])
    moved = squares_times(ranges.reshape(-1, len(slope)), slope @ P, unchecked=ranges)
    moved = moved.reshape(*ranges.shape[:-2], 12)
    kept = mean @ (np.eye(12) - matrix @ P) + constant @ P
    return np.broadcast_to(kept, (*batch, 12)) + moved, P


def spread_out(covariance: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    """The shared covariance as the read-only array (*batch, n, n) that a state carries."""
    return np.broadcast_to(covariance, (*batch, *covariance.shape[-2:]))
