"""Errors of links that last: white noise and a slow part, found in residuals and whitened.

Multipath moves as the body does: errors of one link are alike for a while. They are taken as the
sum of white noise and a first-order Gauss-Markov process. The scalar Kalman filter of that process
whitens residuals and the columns of a Jacobian alike, which makes least squares the maximum
likelihood of the correlated errors.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.calibration import robust

# Longest lag that is looked at, in epochs; fewest pairs of residuals of a lag.
_LONGEST, _FEWEST = 3000, 30
# Correlations below these are none.
_NONE, _END = 0.1, 0.05
# Time between epochs of more than so many of the usual ends a stretch.
_GAP = 20.0
_MOST_SHARE = 0.98


class Drift(NamedTuple):
    """The slow part of the errors: its share of the variance, and for how many seconds it lasts."""

    share: float
    time_s: float


NO_DRIFT = Drift(0.0, 1.0)


def stretches(times: FloatArray) -> list[slice]:
    """Epochs (K,) without gaps or steps back in time between them."""
    step = np.diff(times)
    forward = step[step > 0]
    usual = float(np.median(forward)) if len(forward) else 1.0
    cuts = np.flatnonzero((step <= 0) | (step > _GAP * usual)) + 1
    edges = [0, *cuts.tolist(), len(times)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def find_drift(z: FloatArray, used: BoolArray, times: FloatArray) -> Drift:
    """The slow part of whitened residuals z (K, L), by their autocorrelation over all links."""
    parts = stretches(times)
    lags = min(max(part.stop - part.start for part in parts), _LONGEST)
    psi = np.where(used, z * robust.share_of(z), 0.0)
    products, pairs = np.zeros(lags), np.zeros(lags)
    for part in parts:
        n = part.stop - part.start
        products[:n] += _lagged(psi[part])[:lags]
        pairs[:n] += _lagged(used[part].astype(float))[:lags]
    told = pairs >= _FEWEST
    if not told[0] or told.sum() < 4:
        return NO_DRIFT
    rho = products / np.maximum(pairs, 1.0)
    rho, pairs = (rho / rho[0])[told][1:], pairs[told][1:]
    lag_s = float(np.mean([np.diff(times[p]).mean() for p in parts if p.stop - p.start > 1]))
    lag_s *= np.flatnonzero(told)[1:]
    noise = 3.0 / np.sqrt(pairs)
    near = rho[: max(3, int((rho > _END).argmin()))]
    if near.mean() < max(_NONE, float(noise[: len(near)].mean())):
        return NO_DRIFT
    # To the first lag without correlation, and as far again.
    end = 2 * (int(np.argmax(rho < _END)) if (rho < _END).any() else len(rho)) + 2
    rho, lag_s, weight = rho[:end], lag_s[:end], 1 / (1 + np.arange(end))[: len(rho[:end])]
    best, found = np.inf, NO_DRIFT
    for time_s in np.geomspace(lag_s[0], 3 * lag_s[-1], 60):
        shape = np.exp(-lag_s / time_s)
        share = float(np.clip((weight * shape) @ rho / ((weight * shape) @ shape), 0, _MOST_SHARE))
        left = float(weight @ (rho - share * shape) ** 2)
        if left < best:
            best, found = left, Drift(share, float(time_s))
    return found


def _lagged(a: FloatArray) -> FloatArray:
    """Sums over columns of products (K,) of a (K, L) with itself, lag by lag."""
    K = len(a)
    spectrum = np.fft.rfft(a, 1 << (2 * K - 1).bit_length(), axis=0)
    return np.fft.irfft((np.abs(spectrum) ** 2).sum(axis=1))[:K]


class Whitener:
    """The scalar Kalman filters of the slow parts of L links, epoch after epoch, in pieces.

    Parameters
    ----------
    std
        (L,) standard deviations of the errors, white and slow together.
    drift
        The slow part.
    times
        (K,) of all epochs.
    """

    def __init__(self, std: FloatArray, drift: Drift, times: FloatArray) -> None:
        self._white, self._slow = std**2 * (1 - drift.share), std**2 * drift.share
        self._decay = np.exp(-np.diff(times, prepend=times[0]) / drift.time_s)
        for part in stretches(times):
            self._decay[part.start] = 0.0
        self._variance = self._slow.copy()
        self._mean: FloatArray | None = None
        self._epoch = 0

    def whitened(self, columns: FloatArray, used: BoolArray, share: FloatArray) -> FloatArray:
        """The next columns (k, L, C) with white errors of variance 1; 0 where not `used` (k, L).

        `share` (k, L) of its weight that each range keeps.
        """
        if not self._slow.any():
            return columns * np.sqrt(used * share / self._white)[..., None]
        result = np.empty_like(columns)
        mean = np.zeros(columns.shape[1:]) if self._mean is None else self._mean
        variance = self._variance
        noise = self._white / share
        for k in range(len(columns)):
            a = self._decay[self._epoch + k]
            variance = a * a * variance + (1 - a * a) * self._slow
            mean = a * mean
            total = variance + noise[k]
            gain = np.where(used[k], variance / total, 0.0)
            ahead = columns[k] - mean
            result[k] = ahead * (used[k] / np.sqrt(total))[:, None]
            mean = mean + gain[:, None] * ahead
            variance = (1 - gain) * variance
        self._mean, self._variance, self._epoch = mean, variance, self._epoch + len(columns)
        return result
