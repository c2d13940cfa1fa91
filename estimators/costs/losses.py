"""Losses of whitened residuals: squares, Huber, and losses that bound the effect of outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.kernels.constants import CUTOFF, LATE_HUBER, LATE_SHARE, SCALE

# A loss is five numbers (..., 5). Threshold, cutoff and scale are infinite if not used. The others
# are the power by which weights fall beyond the threshold, and the factor on the weight of a late
# range.
SQUARES = np.array([np.inf, np.inf, np.inf, 1.0, 1.0])


def huber(threshold: float) -> FloatArray:
    """Return Huber's loss: quadratic up to `threshold` standard deviations, linear beyond."""
    return np.array([threshold, np.inf, np.inf, 1.0, 1.0])


def redescending(threshold: float, late: float = 0.5) -> FloatArray:
    """Return the loss of weights ``min(1, (h / |x|)^2)``, h the threshold, times `late` if late.

    Radio ranges are late, by reflections and obstacles, far more often than early. The influence of
    a range falls with its residual x. The cost is ``x^2 / 2`` up to h, and
    ``h^2 (1/2 + log(|x| / h))`` beyond.
    """
    return np.array([threshold, np.inf, np.inf, 2.0, late])


def cut_huber(threshold: float, cutoff: ArrayLike) -> FloatArray:
    """Return Huber's loss up to `cutoff` (...) standard deviations, constant (weight 0) beyond."""
    return _stacked(huber(threshold), CUTOFF, cutoff)


def geman_mcclure(scale: ArrayLike) -> FloatArray:
    """Return the bounded Geman-McClure loss; residuals far beyond `scale` (...) hardly count."""
    return _stacked(SQUARES, SCALE, scale)


# For radio ranges.
LATE = redescending(LATE_HUBER, LATE_SHARE)


def _stacked(loss: FloatArray, place: int, values: ArrayLike) -> FloatArray:
    """Return a loss (..., 5) with values (...) at one index."""
    values = np.asarray(values, dtype=np.float64)
    result = np.broadcast_to(loss, (*values.shape, len(loss))).copy()
    result[..., place] = values
    return result


def expected_square(loss: FloatArray) -> FloatArray:
    """Return the mean (...) of a weighted squared residual ``w(x) x^2`` for a Gaussian x.

    It is 1 for `SQUARES`. The weights of a robust loss make it smaller.
    """
    x = np.linspace(-8.0, 8.0, 4001)
    weight = loss_of(x[None] ** 2, np.asarray(loss), x[None] > 0)[1][..., 0, :]
    density = np.exp(-0.5 * x**2)
    return (weight * x**2 * density).sum(axis=-1) / density.sum()


def loss_of(
    squared: FloatArray, loss: FloatArray, late: BoolArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the cost of squared whitened residuals (..., M, N), and their weights in [0, 1].

    `loss` (..., 5) is from `huber`, `cut_huber`, `geman_mcclure`, `redescending`, or `SQUARES`.
    Huber's is ``x^2 / 2`` up to its threshold k, and ``k |x| - k^2 / 2`` beyond. `late` (..., M,
    N): which ranges are longer than expected; None: not used by the loss.
    """
    threshold, cutoff, scale, power, of_late = (loss[..., i, None, None] for i in range(5))
    held = np.minimum(squared, cutoff**2)
    share = np.minimum(1.0, threshold / np.sqrt(np.maximum(held, 1e-300)))
    cost = share * held * (1 - 0.5 * share)
    if late is not None and (power == 2).any():
        beyond = (power == 2) & (share < 1)
        square = np.where(beyond, threshold, 0.0) ** 2
        cost = np.where(beyond, square * (0.5 - np.log(share)), cost)
        kept = np.where((power == 2) & late, of_late, 1.0)
        cost, share = kept * cost, kept * share**power
    bounded = np.isfinite(scale)
    square = np.where(bounded, scale, 1.0) ** 2
    left = square / (squared + square)
    return (
        np.where(bounded, 0.5 * squared * left, cost),
        np.where(bounded, left**2, np.where(squared <= cutoff**2, share, 0.0)),
    )
