"""Descent of the score of many layouts at once, by a given number of evaluations.

`descent.descend` is for one layout and its end. Here the number of evaluations is small and strict,
and the time between them matters.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.regions import Region, Shell
from rbl_gym.placement.descent import UNIT, pulled_back

__all__ = ["follow"]

# Length of the first step, of all anchors together, in the unit of `descent`; pairs of steps and
# changes of the gradient that are remembered; limits of the factor of a step that failed.
_FIRST, _MEMORY, _SHORTER = 1.0, 6, (0.1, 0.5)
_TINY = 1e-12


def follow(
    evaluate: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    region: Region,
    anchors: FloatArray,
    evaluations: int,
    legal: Callable[[FloatArray], BoolArray] | None = None,
) -> FloatArray:
    """Return layouts (B, M, 3) after steps along the gradient of the log score.

    Steps are those of L-BFGS, projected on the bounds of each anchor's face (Bertsekas, SIAM J.
    Control and Optimization 20, 1982). Each takes one evaluation of all layouts. A layout that did
    not get better tries a shorter step.

    Parameters
    ----------
    evaluate
        Returns positive scores (B,) and gradients (B, M, 3) of layouts.
    region
        Legal positions; an anchor keeps its face.
    anchors
        Layouts at the beginning.
    evaluations
        Number of evaluations; at least 1, for the layouts at the beginning.
    legal
        Returns which positions (B, M) are legal; None: all of the region are. A step to others is
        not taken.
    """
    unit = UNIT * float(np.ptp(region.bounds(), axis=0).max())
    face = region.face_of(anchors)
    origin, axes, extents = (array[face] for array in region.faces[:3])
    free = isinstance(region, Shell)
    if free:
        x, most = anchors / unit, np.inf
    else:
        local = np.einsum("...ai,...i->...a", axes, anchors - origin)
        x, most = local.clip(0.0, extents) / unit, extents / unit
    least = -most if free else 0.0

    def position(x: FloatArray) -> FloatArray:
        if free:
            return region.project(unit * x)
        return origin + np.einsum("...a,...ai->...i", unit * x, axes)

    def judged(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        points = position(x)
        score, slope = evaluate(points)
        if free:
            slope = pulled_back(slope, unit * x, points)
        else:
            slope = np.einsum("...ai,...i->...a", axes, slope)
        return np.log(score), slope * (unit / score)[:, None, None]

    value, slope = judged(x)
    pairs: list[tuple[FloatArray, FloatArray]] = []
    step = _direction(slope, ~_held(x, slope, least, most), pairs)
    for _ in range(evaluations - 1):
        tried = np.clip(x + step, least, most)
        new, new_slope = judged(tried)
        if legal is not None:
            new = np.where(legal(position(tried)).all(axis=-1), new, np.inf)
        better = new < value
        # Otherwise the minimum of a parabola along the step.
        first = _dot(slope, tried - x)
        rise = np.maximum(np.where(better, np.inf, new - value - first), _TINY)
        shorter = step * np.clip(-0.5 * first / rise, *_SHORTER)[:, None, None]
        kept = better[:, None, None]
        pairs = [*pairs, (kept * (tried - x), kept * (new_slope - slope))][-_MEMORY:]
        x, slope = np.where(kept, tried, x), np.where(kept, new_slope, slope)
        value = np.where(better, new, value)
        step = _direction(slope, ~_held(x, slope, least, most), pairs)
        step = np.where(kept, step, shorter)
    return position(x)


def _held(
    x: FloatArray, slope: FloatArray, least: FloatArray | float, most: FloatArray | float
) -> BoolArray:
    """Return which coordinates are at a bound that the gradient pushes against."""
    return ((x <= least) & (slope > 0)) | ((x >= most) & (slope < 0))


def _direction(
    slope: FloatArray, free: BoolArray, pairs: list[tuple[FloatArray, FloatArray]]
) -> FloatArray:
    """Return steps (B, M, 3) of L-BFGS in the free coordinates."""
    steepest = np.where(free, slope, 0.0)
    length = np.sqrt(_dot(steepest, steepest))
    q = steepest
    scale = _FIRST / np.maximum(length, _TINY)
    saved = []
    for s, y in reversed(pairs):
        sy = _dot(s, y)
        real = sy > _TINY
        rho = np.where(real, 1 / np.where(real, sy, 1.0), 0.0)
        a = rho * _dot(s, q)
        q = q - a[:, None, None] * y
        saved.append((s, y, rho, a))
    known = np.zeros(len(slope), dtype=np.bool_)
    for _, y, rho, _ in saved:  # the latest pair gives the scale
        scale = np.where(~known & (rho > 0), 1 / np.maximum(rho * _dot(y, y), _TINY), scale)
        known |= rho > 0
    q = scale[:, None, None] * q
    for s, y, rho, a in reversed(saved):
        q = q + (a - rho * _dot(y, q))[:, None, None] * s
    q = np.where(free, q, 0.0)
    downhill = (_dot(q, steepest) > 0)[:, None, None]
    return -np.where(downhill, q, steepest * (_FIRST / np.maximum(length, _TINY))[:, None, None])


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("bmi,bmi->b", a, b)
