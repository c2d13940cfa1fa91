"""One covariance for all trials: they share anchors, fixed weights and prior covariance.

The covariance then does not depend on what is measured, and neither does the gain: a step of
the whole batch is one of 12 x 12 matrices, and one product of the squared ranges with it.
A covariance is known to be shared by its memory: no leading axes, or leading strides of zero.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rbl_gym.bounds import symmetric
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.squared_range import (
    extended,
    information,
    squares_times,
    statistic,
)

# From here on it pays to sum over the tags before the anchors.
_MANY_TAGS = 12


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
    model = _model(len(anchors), len(tags), anchors.tobytes(), tags.tobytes(), weights.tobytes())
    P = symmetric(np.linalg.solve(np.eye(12) + P @ model.matrix, P))
    *of_tags, slope = model.slopes
    rows = ranges.reshape(-1, anchors.shape[0] * tags.shape[0])
    told = squares_times(rows, [*of_tags, slope @ P], unchecked=ranges)
    kept = mean @ (np.eye(12) - model.matrix @ P)
    kept += model.constant @ P
    told = told.reshape(*ranges.shape[:-2], 12)
    if kept.shape == told.shape:
        return np.add(kept, told, out=kept), P
    return kept + told, P


class _Model(NamedTuple):
    """What an epoch tells, by its geometry: the matrix, and the vector of the squared ranges.

    The vector is the constant and the slopes' product with the squares, see `squares_times`.
    """

    matrix: FloatArray
    constant: FloatArray
    slopes: list[FloatArray]


@functools.lru_cache(maxsize=16)
def _model(n_anchors: int, n_tags: int, *memory: bytes) -> _Model:
    """The model of the memory of anchors, tags and weights: the same for epochs on end."""
    numbers = (np.frombuffer(part) for part in memory)
    anchors, tags, weights = (
        part.reshape(shape)
        for part, shape in zip(numbers, ((-1, 3), (-1, 3), (n_anchors, -1)), strict=True)
    )
    stat = statistic(np.zeros((n_anchors, n_tags)), anchors, tags, weights)
    mass = weights.sum(axis=0)
    centre = (weights / np.where(mass > 0, mass, 1.0)).T @ anchors
    spread = -2 * weights[..., None] * (anchors[:, None] - centre)
    of_tags = extended(tags)
    if stat.is_common and n_tags >= _MANY_TAGS:
        slopes: list[FloatArray] = [
            of_tags,
            np.einsum("kl,mi->mkli", np.eye(4), spread[:, 0]).reshape(-1, 12),
        ]
    else:
        slopes = [(of_tags[:, :, None] * spread[:, :, None]).reshape(-1, 12)]
    return _Model(*information(stat), slopes)


def spread_out(covariance: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    """The shared covariance as the read-only array (*batch, n, n) that a state carries."""
    return np.broadcast_to(covariance, (*batch, *covariance.shape[-2:]))
