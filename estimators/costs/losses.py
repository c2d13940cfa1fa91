"""Losses of whitened residuals: squares, Huber's, and those that bound the pull of wrong ranges."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray

# A loss is five numbers (..., 5): threshold, cutoff and scale, infinite where they are not used,
# the power by which weights fall beyond the threshold, and what is left of the weight of a range
# that is late.
SQUARES = np.array([np.inf, np.inf, np.inf, 1.0, 1.0])


def huber(threshold: float) -> FloatArray:
    """Huber's loss: squares up to `threshold` standard deviations, straight lines beyond."""
    return np.array([threshold, np.inf, np.inf, 1.0, 1.0])


def redescending(threshold: float, late: float = 0.5) -> FloatArray:
    """Weights ``min(1, (h / |x|)^2)``, h the threshold, and of late ranges `late` times as much.

    Radio ranges err late, by reflections and obstacles, far more than early. The pull of a range
    falls with its residual x: the cost is ``x^2 / 2`` up to h, ``h^2 (1/2 + log(|x| / h))``
    beyond.
    """
    return np.array([threshold, np.inf, np.inf, 2.0, late])


def cut_huber(threshold: float, cutoff: ArrayLike) -> FloatArray:
    """Huber's loss up to `cutoff` (...) standard deviations, constant beyond: that is out."""
    return _stacked(huber(threshold), 1, cutoff)


def geman_mcclure(scale: ArrayLike) -> FloatArray:
    """Geman and McClure's loss, bounded: what is many `scale` (...) away hardly counts at all."""
    return _stacked(SQUARES, 2, scale)


# Of radio ranges: chosen on several public logs, whose figures hardly change from 0.8 to 1.
LATE = redescending(1.0, late=0.5)


def _stacked(loss: FloatArray, place: int, values: ArrayLike) -> FloatArray:
    """A loss (..., 5) with values (...) at a place."""
    values = np.asarray(values, dtype=np.float64)
    result = np.broadcast_to(loss, (*values.shape, len(loss))).copy()
    result[..., place] = values
    return result


def loss_of(
    squared: FloatArray, loss: FloatArray, late: BoolArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Cost of squared whitened residuals (..., M, N), and the share of their weight that is left.

    Parameters
    ----------
    squared
        ``x^2`` (..., M, N).
    loss
        (..., 5), from `huber`, `cut_huber`, `geman_mcclure`, `redescending`, or `SQUARES`.
        Huber's is ``x^2 / 2`` up to its threshold k, and ``k |x| - k^2 / 2`` beyond.
    late
        (..., M, N), which ranges are longer than expected; None: the loss does not ask.
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
