"""Gradient descent of the score of layouts, each anchor within its face."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.regions import Shell
from rbl_gym.placement.setting import Setting

__all__ = ["descend"]

# Unit of length of the search: a fraction of the region's largest extent.
UNIT = 0.1


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

    region = setting.region
    unit = UNIT * float(np.ptp(region.bounds(), axis=0).max())
    face = region.face_of(anchors)
    origin, axes, extents = (array[face] for array in region.faces[:3])
    start, limits = anchors, None
    if not isinstance(region, Shell):
        start = np.einsum("mai,mi->ma", axes, anchors - origin).clip(0.0, extents)
        limits = np.stack([np.zeros(start.shape), extents / unit], axis=-1).reshape(-1, 2)
    best: list[Any] = [anchors, np.inf]

    def evaluate(values: FloatArray) -> tuple[float, FloatArray]:
        values = unit * values.reshape(-1, 3)
        if limits is None:
            layout = region.project(values)
        else:
            layout = origin + np.einsum("ma,mai->mi", values, axes)
        score, gradient = setting.score_and_gradient(layout)
        if score < best[1]:
            best[:] = layout, score
        if limits is None:
            slope = pulled_back(gradient, values, layout)
        else:
            slope = np.einsum("mai,mi->ma", axes, gradient)
        return float(np.log(score)), (slope * (unit / score)).ravel()

    optimize.minimize(
        evaluate,
        (start / unit).ravel(),
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


def pulled_back(gradient: FloatArray, free: FloatArray, points: FloatArray) -> FloatArray:
    """Return the derivative with respect to free points, from that at the nearest shell points."""
    length = np.linalg.norm(free, axis=-1, keepdims=True)
    ratio = np.linalg.norm(points, axis=-1, keepdims=True) / length
    outward = free / length
    along = (gradient * outward).sum(axis=-1, keepdims=True) * outward
    return ratio * (gradient - along) + np.where(np.abs(ratio - 1) < 1e-9, along, 0.0)
