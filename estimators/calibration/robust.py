"""Robust weights and spread of the residuals of links."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray

# Threshold (standard deviations) beyond which the weights of residuals fall.
_THRESHOLD = 2.0
# Median absolute deviation of a standard Gaussian.
_MAD = 0.6744897501960817
# Least number of residuals for a separate spread.
_FEWEST = 10


def share_of(z: FloatArray) -> FloatArray:
    """Return the weight ``min(1, (h / z)^2)`` of a residual of z standard deviations.

    Beyond h = 2 the influence of a residual falls as 1/z, so that late ranges hardly change the
    fit. The loss is symmetric, so the mean of a Gaussian remains unbiased.
    """
    return np.minimum(1.0, (_THRESHOLD / np.maximum(np.abs(z), 1e-9)) ** 2)


def spread(residual: FloatArray, used: BoolArray, least: float) -> FloatArray:
    """Return robust standard deviations (...) of residuals (K, ...).

    They come from the median absolute deviation. Columns with fewer than ten residuals get that of
    all columns together. None is below `least`.
    """
    held = np.where(used, np.abs(residual), np.nan)
    if not used.any():
        return np.full(residual.shape[1:], least)
    together = np.nanmedian(held) / _MAD
    enough = used.sum(axis=0) >= _FEWEST
    held = np.where(enough, held, 0.0)
    return np.maximum(np.where(enough, np.nanmedian(held, axis=0) / _MAD, together), least)


def variance_factor(z: FloatArray, used: BoolArray) -> FloatArray:
    """Return the variance (...) of a mean estimated from z (K, ...), in units of sigma^2 / K.

    It is ``mean(psi^2) / mean(psi')^2`` of the M-estimator (Huber, "Robust Statistics", 1981). For
    a Gaussian it is slightly above 1.
    """
    count = np.maximum(used.sum(axis=0), 1)
    psi = np.where(used, z * share_of(z), 0.0)
    slope = np.where(used, np.where(np.abs(z) <= _THRESHOLD, 1.0, -share_of(z)), 0.0)
    squared, mean = (psi**2).sum(axis=0) / count, slope.sum(axis=0) / count
    few = used.sum(axis=0) < _FEWEST
    return np.where(few, 1.0, squared / np.maximum(mean, 0.1) ** 2)


def loss_of(z: FloatArray) -> FloatArray:
    """Return the loss with the weights `share_of`: ``z^2 / 2``, then ``h^2 (1/2 + log(z / h))``."""
    z, h = np.abs(z), _THRESHOLD
    return np.where(z <= h, 0.5 * z**2, h**2 * (0.5 + np.log(np.maximum(z, h) / h)))
