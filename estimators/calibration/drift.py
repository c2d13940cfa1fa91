"""Correlated errors of links: estimate white noise and a slow part from residuals, and whiten them.

Multipath changes as the body moves, so errors of one link are correlated for some time. The model
is the sum of white noise and a first-order Gauss-Markov process. The scalar Kalman filter of that
process whitens both residuals and the columns of a Jacobian. Least squares is then maximum
likelihood under the correlated errors.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.calibration import robust

# Longest lag, in epochs; least number of pairs of residuals at a lag.
_LONGEST, _FEWEST = 3000, 30
# Correlations below these count as zero.
_NONE, _END = 0.1, 0.05
# A gap longer than this multiple of the usual interval ends a stretch.
_GAP = 20.0
_MOST_SHARE = 0.98


class Drift(NamedTuple):
    """The slow part of the errors: its fraction of the variance, and its correlation time (s)."""

    share: float
    time_s: float


NO_DRIFT = Drift(0.0, 1.0)


def stretches(times: FloatArray) -> list[slice]:
    """Split epochs (K,) into slices without gaps or backward steps in time."""
    step = np.diff(times)
    forward = step[step > 0]
    usual = float(np.median(forward)) if len(forward) else 1.0
    cuts = np.flatnonzero((step <= 0) | (step > _GAP * usual)) + 1
    edges = [0, *cuts.tolist(), len(times)]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def find_drift(z: FloatArray, used: BoolArray, times: FloatArray) -> Drift:
    """Estimate the slow part of whitened residuals z (K, L) by autocorrelation over all links."""
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
    # Use lags up to twice the first lag without correlation.
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
    """Return the autocorrelation sums (K,) of the columns of (K, L), lag by lag."""
    K = len(a)
    spectrum = np.fft.rfft(a, 1 << (2 * K - 1).bit_length(), axis=0)
    return np.fft.irfft((np.abs(spectrum) ** 2).sum(axis=1))[:K]


class Whitener:
    """Scalar Kalman filters of the slow parts of L links, run in successive blocks of epochs.

    `std` (L,) are the standard deviations of the errors, white and slow parts together; `times`
    (K,) those of all epochs.
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
        """Whiten the next columns (k, L, C) to unit-variance errors; 0 if not `used` (k, L).

        `share` (k, L) is the fraction of its weight that each range keeps.
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
