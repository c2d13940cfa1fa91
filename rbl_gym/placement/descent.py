"""Descent along the gradient of the score of layouts, each anchor within its face.

`descend` goes to the end for one layout, by scipy. `follow` takes few steps of many layouts at
once, where the time between the evaluations matters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.regions import Region, Shell
from rbl_gym.placement.setting import Setting

__all__ = ["descend", "follow"]

# Unit of length of the search: a fraction of the region's largest extent.
_UNIT = 0.1
# Of `follow`: length of the first step, of all anchors together, in this unit; pairs of steps and
# changes of the gradient that are remembered; limits of the factor of a step that failed.
_FIRST, _MEMORY, _SHORTER = 1.0, 6, (0.1, 0.5)
_TINY = 1e-12


class _Chart(NamedTuple):
    """Coordinates of anchors: along the axes of their faces, or of free points around a shell."""

    region: Region
    unit: float
    origin: FloatArray
    axes: FloatArray

    def points(self, x: FloatArray) -> FloatArray:
        """Return anchors (..., M, 3) of coordinates."""
        if isinstance(self.region, Shell):
            return self.region.project(self.unit * x)
        return self.origin + np.einsum("...a,...ai->...i", self.unit * x, self.axes)

    def slope(self, x: FloatArray, points: FloatArray, gradient: FloatArray) -> FloatArray:
        """Return the derivative by the coordinates x of points, from that by the points."""
        if not isinstance(self.region, Shell):
            return self.unit * np.einsum("...ai,...i->...a", self.axes, gradient)
        length = np.linalg.norm(self.unit * x, axis=-1, keepdims=True)
        ratio, outward = (
            np.linalg.norm(points, axis=-1, keepdims=True) / length,
            self.unit * x / length,
        )
        along = (gradient * outward).sum(axis=-1, keepdims=True) * outward
        held = np.where(np.abs(ratio - 1) < 1e-9, along, 0.0)
        return self.unit * (ratio * (gradient - along) + held)


def _chart(region: Region, anchors: FloatArray) -> tuple[_Chart, FloatArray, FloatArray | None]:
    """Return coordinates, their values for anchors (..., M, 3), and their upper limits.

    The lower limits are 0. None: no limits.
    """
    unit = _UNIT * float(np.ptp(region.bounds(), axis=0).max())
    face = region.face_of(anchors)
    origin, axes, extents = (array[face] for array in region.faces[:3])
    chart = _Chart(region, unit, origin, axes)
    if isinstance(region, Shell):
        return chart, anchors / unit, None
    x = np.einsum("...ai,...i->...a", axes, anchors - origin).clip(0.0, extents)
    return chart, x / unit, extents / unit


def descend(
    setting: Setting, anchors: FloatArray, evaluations: int = 30
) -> tuple[FloatArray, float]:
    """Minimize the log of the score of all anchors (M, 3) by L-BFGS-B, each within its face.

    Parameters
    ----------
    setting, anchors
        The problem, and where to begin.
    evaluations
        Number of evaluations of score and gradient. The last line search is finished.

    Returns
    -------
    The best evaluated legal layout, including the start, and its score.
    """
    from scipy import optimize  # slow to import

    chart, start, most = _chart(setting.region, anchors)
    best: list[Any] = [anchors, np.inf]

    def evaluate(values: FloatArray) -> tuple[float, FloatArray]:
        x = values.reshape(-1, 3)
        layout = chart.points(x)
        score, gradient = setting.score_and_gradient(layout)
        if score < best[1]:
            best[:] = layout, float(score)
        return float(np.log(score)), (chart.slope(x, layout, gradient) / score).ravel()

    limits = None
    if most is not None:
        limits = np.stack([np.zeros(most.shape), most], axis=-1).reshape(-1, 2)
    optimize.minimize(
        evaluate,
        start.ravel(),
        jac=True,
        method="L-BFGS-B",
        bounds=limits,
        options={"maxfun": evaluations, "maxiter": evaluations, "ftol": 1e-7, "gtol": 1e-6},
    )
    found, score = best
    legal = setting.legal(found)
    if legal.all():
        return found, score
    # Anchors that ended in an obstacle or where mounting is forbidden keep their position.
    found = np.where(legal[:, None], found, anchors)
    before, score = setting.score(anchors), setting.score(found)
    return (found, score) if score < before else (anchors, before)


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
    chart, x, limit = _chart(region, anchors)
    least, most = (-np.inf, np.inf) if limit is None else (0.0, limit)

    def judged(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        points = chart.points(x)
        score, gradient = evaluate(points)
        return np.log(score), chart.slope(x, points, gradient) / score[:, None, None]

    def next_step() -> FloatArray:
        # A coordinate stays at a bound that the gradient pushes against.
        held = ((x <= least) & (slope > 0)) | ((x >= most) & (slope < 0))
        return _direction(slope, ~held, pairs)

    value, slope = judged(x)
    pairs: list[tuple[FloatArray, FloatArray]] = []
    step = next_step()
    for _ in range(evaluations - 1):
        tried = np.clip(x + step, least, most)
        new, new_slope = judged(tried)
        if legal is not None:
            new = np.where(legal(chart.points(tried)).all(axis=-1), new, np.inf)
        better = new < value
        # Otherwise the minimum of a parabola along the step.
        first = _dot(slope, tried - x)
        rise = np.maximum(np.where(better, np.inf, new - value - first), _TINY)
        shorter = step * np.clip(-0.5 * first / rise, *_SHORTER)[:, None, None]
        kept = better[:, None, None]
        pairs = [*pairs, (kept * (tried - x), kept * (new_slope - slope))][-_MEMORY:]
        x, slope = np.where(kept, tried, x), np.where(kept, new_slope, slope)
        value = np.where(better, new, value)
        step = np.where(kept, next_step(), shorter)
    return chart.points(x)


def _direction(
    slope: FloatArray, free: BoolArray, pairs: list[tuple[FloatArray, FloatArray]]
) -> FloatArray:
    """Return steps (B, M, 3) of L-BFGS in the free coordinates (Nocedal's two loops)."""
    q = steepest = np.where(free, slope, 0.0)
    first = scale = (_FIRST / np.maximum(np.sqrt(_dot(q, q)), _TINY))[:, None, None]
    saved = []
    for s, y in pairs:
        sy, yy = _dot(s, y)[:, None, None], _dot(y, y)[:, None, None]
        real = sy > _TINY  # not so in a layout that did not take the step
        scale = np.where(real, sy / np.maximum(yy, _TINY), scale)
        saved.append((s, y, np.where(real, 1 / np.where(real, sy, 1.0), 0.0)))
    steps = []
    for s, y, rho in reversed(saved):
        steps.append(rho * _dot(s, q)[:, None, None])
        q = q - steps[-1] * y
    q = scale * q
    for (s, y, rho), a in zip(saved, reversed(steps), strict=True):
        q = q + (a - rho * _dot(y, q)[:, None, None]) * s
    q = np.where(free, q, 0.0)
    return -np.where(_dot(q, steepest)[:, None, None] > 0, q, first * steepest)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.einsum("bmi,bmi->b", a, b)
