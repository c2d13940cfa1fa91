"""Time offset between a path and ranges, from the changes of the ranges.

The change of a range shows when the body moved, whatever the bias. Changes over a fraction of a
second do not depend on slower errors: biases, slow multipath, small errors of lever arms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.calibration import robust

__all__ = ["Clock", "find_clock"]

# Changes are over one of these intervals (s), or between successive ranges of a link, up to this
# multiple of it. Longer ones carry more information, shorter ones contain less of slow errors.
_LAGS_S, _LONGEST = (0.2, 0.4, 0.8), 3.0
_SEARCH_STEP_S, _FEWEST, _BLOCK_S = 0.1, 30, 2.0
# Half-widths (s) of two finite differences for rates. The noise of the path makes each of them look
# large, but it is not the same in both: their product tells how much the ranges really change.
_NEAR_S, _FAR_S = 0.05, 0.1
_LEAST_M = 1e-4
# Gauss-Newton steps at most, the step (s) below which they end, and how often rates are renewed.
_STEPS, _CLOSE_S, _ROUNDS = 20, 1e-5, 2

Places = Callable[[float], tuple[FloatArray, BoolArray]]


class Clock(NamedTuple):
    """Seconds by which the path's time stamps are ahead of the ranges', with standard deviation."""

    offset_s: float
    std_s: float


def find_clock(
    times: FloatArray, ranges: FloatArray, links: BoolArray, distances: Places,
    search_s: float,
    moves: Callable[[float], FloatArray] | None = None,
) -> Clock | None:  # fmt: skip
    """Estimate the time shift at which distances along a path change as the ranges do.

    Parameters
    ----------
    times
        (K,) seconds of the ranges.
    ranges, links
        (K, M, N) metres, and a mask of the measured ranges.
    distances
        Function of a shift. It returns distances (K, M, N) at ``times + shift`` along the path, and
        a mask (K,) of epochs with known distances.
    search_s
        Shifts up to this are tried, in both directions.
    moves
        Function of a shift. It returns the derivatives (K, M, N, D) of the distances with respect
        to D unknowns of the tags, times their prior standard deviations. These are estimated too: a
        tag further ahead on the body looks like a later clock where the speed is constant.

    Returns
    -------
    Clock
        An event at time t of the ranges is at ``t + offset_s`` on the path. None if too few ranges
        change to estimate it.
    """
    K = len(times)
    flat, used = ranges.reshape(K, -1), links.reshape(K, -1)
    grid = np.arange(-search_s, search_s + 1e-9, _SEARCH_STEP_S) if search_s > 0 else np.zeros(1)
    found: list[Clock] = []
    start: float | None = None
    for lag in _LAGS_S[::-1]:  # the longest is the surest start of the search
        changes = _changes(times, used, flat, distances, lag)
        if changes is None:
            continue
        if start is None:
            spreads = [changes.spread(float(shift)) for shift in grid]
            if not np.isfinite(spreads).any():
                continue
            start = float(grid[int(np.argmin(spreads))])
        tags = np.zeros((K, 0)) if moves is None else moves(start)
        clock = _refined(changes, start, tags.reshape(*flat.shape, -1))
        if clock is not None:
            found.append(clock)
    return min(found, key=lambda clock: clock.std_s, default=None)


class _Changes(NamedTuple):
    """Changes of P ranges, and a function of the predicted changes at a shift."""

    times: FloatArray  # (P,)
    change: FloatArray  # (P,) metres
    foretold: Callable[[float], tuple[FloatArray, BoolArray]]
    of: Callable[[FloatArray], FloatArray]  # changes (P, ...) of values (K, L, ...)

    def left(self, shift: float) -> tuple[FloatArray, BoolArray]:
        """Return the residual changes at a shift, and a mask of the known ones."""
        foretold, known = self.foretold(shift)
        return self.change - foretold, known

    def rate(self, shift: float, half_s: float) -> FloatArray:
        """Return the rates (P,) of the predicted changes by a finite difference."""
        return (self.left(shift - half_s)[0] - self.left(shift + half_s)[0]) / (2 * half_s)

    def spread(self, shift: float) -> float:
        """Return the robust standard deviation of the residual changes."""
        e, known = self.left(shift)
        return float(robust.spread(e, known, _LEAST_M)) if known.sum() >= _FEWEST else np.inf


def _refined(changes: _Changes, start: float, moves: FloatArray) -> Clock | None:
    """Return the shift near `start` with the least residuals, and its standard deviation.

    Gauss-Newton with iterated weights, jointly with the moves (K, L, D) of the tags.
    """
    half = 1.5 * _SEARCH_STEP_S
    # One set of changes for all shifts: the loss would jump where a change enters or leaves.
    ends = start - half - _FAR_S, start, start + half + _FAR_S
    known = np.all([changes.left(shift)[1] for shift in ends], axis=0)
    if known.sum() < _FEWEST:
        return None
    std = float(robust.spread(changes.left(start)[0], known, _LEAST_M))
    moved = changes.of(moves)[known] / std
    offset, move = start, np.zeros(moved.shape[-1])
    z = share = rate = other = np.empty(0)  # of the last step
    for _ in range(_ROUNDS):
        rate, other = (changes.rate(offset, h)[known] / std for h in (_NEAR_S, _FAR_S))
        for _ in range(_STEPS):
            z = changes.left(offset)[0][known] / std - moved @ move
            share = robust.share_of(z)
            # The part of the rates that no move of the tags explains tells the clock.
            weighted = moved * share[:, None]
            inverse = np.linalg.inv(weighted.T @ moved + np.eye(len(move)))
            own = rate - moved @ (inverse @ (weighted.T @ rate))
            information = float((share * own * other).sum())
            if not information > 0:
                return None
            step = float((own * share * (z + moved @ move)).sum()) / information
            step = float(np.clip(step, -_SEARCH_STEP_S, _SEARCH_STEP_S))
            offset += step
            move = inverse @ (weighted.T @ (z + moved @ move - other * step))
            if abs(offset - start) > half:
                return None
            if abs(step) < _CLOSE_S:
                break
    rates = np.stack([np.column_stack([one, moved]) for one in (rate, other)])
    return _jackknifed(offset, changes.times[known], z, share, rates)


def _jackknifed(
    offset: float, times: FloatArray, z: FloatArray, share: FloatArray, rates: FloatArray
) -> Clock | None:
    """Return an offset with its standard deviation from estimates without each block of time.

    Changes overlap and their errors are correlated, so whole blocks are left out. Blocks in which
    the body turns or stops determine the offset and the tags more than others: unlike the sum of
    squared scores, the jackknife allows for this. `rates` (2, P, 1 + D) are two estimates of the
    derivatives of the residuals z (P,) by the offset and the moves of the tags.
    """
    block = np.unique((times // _BLOCK_S).astype(int), return_inverse=True)[1]
    count, width = int(block.max()) + 1, rates.shape[-1]
    freedom = count - 1 - width
    if freedom <= 2:
        return None
    # Late ranges lower the curvature of the loss.
    curvature = max(float(np.where(share < 1, -share, 1.0).mean()), 0.1)
    prior = np.diag([0.0, *np.ones(width - 1)])
    score, information = np.zeros((count, width)), np.zeros((count, width, width))
    np.add.at(score, block, (share * z)[:, None] * rates[0])
    for i in range(count):
        one, other = rates[:, block == i]
        information[i] = curvature * one.T @ other
    left = information.sum(axis=0) - information + prior
    if not (np.linalg.eigvalsh(left + np.swapaxes(left, -1, -2))[:, 0] > 0).all():
        return None
    without = np.linalg.solve(left, -score[..., None])[:, 0, 0]
    variance = (count - 1) / count * np.square(without - without.mean()).sum()
    # Few blocks: the variance is itself uncertain, and the error has Student's distribution.
    variance *= freedom / (freedom - 2)
    return Clock(offset, float(np.sqrt(variance)))


def _changes(
    times: FloatArray, links: BoolArray, ranges: FloatArray, distances: Places, lag_s: float
) -> _Changes | None:
    """Return the changes of the ranges (K, L) of each link over a lag; None if too few."""
    found = []
    for link in range(links.shape[1]):
        at = np.flatnonzero(links[:, link])
        later = np.searchsorted(times[at], times[at] + lag_s - 1e-9)
        inside = later < len(at)
        a, b = at[inside], at[later[inside]]
        apart = times[b] - times[a]
        near = (apart > 0) & (apart <= _LONGEST * lag_s)
        found.append((a[near], b[near], np.full(near.sum(), link)))
    first, second, link = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if len(first) < _FEWEST:
        return None

    def of(values: FloatArray) -> FloatArray:
        return values[second, link] - values[first, link]

    def foretold(shift: float) -> tuple[FloatArray, BoolArray]:
        d, known = distances(shift)
        return of(d.reshape(len(times), -1)), known[first] & known[second]

    return _Changes(times[first], of(ranges), foretold, of)
