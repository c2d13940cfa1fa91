"""Robust localization from ranges with outliers; flat problems, batch axis (B,)."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, are_finite
from rbl_gym.estimators.costs.levenberg_marquardt import Solution
from rbl_gym.estimators.costs.losses import LATE, geman_mcclure, huber
from rbl_gym.estimators.costs.map_problem import minimize
from rbl_gym.estimators.costs.range_cost import RangeCost, squared_residuals
from rbl_gym.estimators.linear.least_squares import points_fit
from rbl_gym.estimators.linear.squared_range import statistic
from rbl_gym.estimators.locating.maximum_likelihood import (
    Alternatives,
    cheapest,
    chunks,
    local_minima,
    maximum_likelihood,
    merge,
)
from rbl_gym.estimators.locating.rotation_net import ROTATION_NET
from rbl_gym.kernels.constants import HUBER

# Final scale of the Geman-McClure loss, in standard deviations.
_NARROWEST = 3.0
# A robust fit with a smaller fraction of inliers is searched for again.
_TRUSTED_INLIERS = 0.65


def robust(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray
) -> tuple[Solution, Alternatives]:
    """Return the pose from ranges with outliers: Huber, Geman-McClure, a refit on inliers.

    The scale of the Geman-McClure loss decreases step by step (graduated non-convexity), so that
    the start need not be near. If few ranges agree with the result, many starts are tried and the
    one with the least bounded loss is kept. Ranges beyond 4 standard deviations of that fit are
    left out of the maximum-likelihood refit.
    """
    rotation, translation = _stand_ins(rotation, translation, cost.anchors)
    easy = dataclasses.replace(cost, loss=huber(HUBER))
    solution = minimize(easy, rotation, translation, iterations=20, tolerance=1e-2)
    solution = _narrow(easy, solution.rotation, solution.translation, widest=1.0)
    links = np.maximum((cost.weights > 0).sum(axis=(-2, -1)), 1)
    doubtful = _inliers(cost, solution).sum(axis=(-2, -1)) < _TRUSTED_INLIERS * links
    for rows in chunks(doubtful):
        part = easy.rows(rows)
        first = solution.rotation[rows], solution.translation[rows]
        usable = np.ones(len(rows), bool)
        minima = local_minima(part, first, usable, ROTATION_NET, starts=len(ROTATION_NET))[:2]
        starts = zip(minima, _without_pairs_of_anchors(part), strict=True)
        # Start at the median residual: a wide loss would lead all starts to the same wrong pose.
        narrowed = _narrow(part, *(np.concatenate(pair, axis=1) for pair in starts), widest=0.5)
        solution = merge(solution, cheapest(narrowed), rows)
    weights = np.where(_inliers(cost, solution), cost.weights, 0.0)
    refit = dataclasses.replace(cost, weights=weights)
    return maximum_likelihood(refit, solution.rotation, solution.translation)


def robust_late(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray
) -> tuple[Solution, Alternatives]:
    """Return the pose from ranges with late outliers: `robust`, then the redescending loss."""
    found, alternatives = robust(cost, rotation, translation)
    late = dataclasses.replace(cost, loss=LATE)
    better = minimize(late, found.rotation, found.translation, iterations=20)
    return better, alternatives


def _stand_ins(
    rotation: FloatArray, translation: FloatArray, anchors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Replace poses that are not finite by the identity at the anchors' centre."""
    known = are_finite(translation, 1) & are_finite(rotation, 2)
    return (
        np.where(known[..., None, None], rotation, np.eye(3)),
        np.where(known[..., None], translation, anchors.mean(axis=-2)),
    )


def _inliers(cost: RangeCost, solution: Solution) -> BoolArray:
    """Return links (..., M, N) within 4 standard deviations of a solution."""
    # Least squares would give an offset biased by outliers.
    cost = dataclasses.replace(cost, loss=geman_mcclure(_NARROWEST))
    squared = squared_residuals(cost, solution.rotation, solution.translation)
    return (squared < 16.0) & (cost.weights > 0)


def _narrow(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray, widest: float
) -> Solution:
    """Minimise Geman-McClure, from the quantile `widest` of residuals to 3 standard deviations."""
    residuals = np.sqrt(squared_residuals(cost, rotation, translation))
    scale = np.maximum(np.quantile(residuals, widest, axis=(-2, -1)), _NARROWEST)
    while True:
        narrowed = dataclasses.replace(cost, loss=geman_mcclure(scale))
        solution = minimize(narrowed, rotation, translation, iterations=4, tolerance=1e-3)
        if (scale <= _NARROWEST).all():
            return solution
        rotation, translation = solution.rotation, solution.translation
        scale = np.maximum(scale / 1.6, _NARROWEST)


def _without_pairs_of_anchors(part: RangeCost) -> tuple[FloatArray, FloatArray]:
    """Return linear solutions (K, S, ...), each without two anchors, so that one has no bad anchor.

    These are all pairs among the first 10 anchors. With fewer than 6 anchors none is left out.
    """
    n_anchors = part.anchors.shape[-2]
    if n_anchors < 6 or part.offset is not None:
        return (np.empty((len(part.ranges), 0, 3, 3)), np.empty((len(part.ranges), 0, 3)))
    pairs = np.array(list(itertools.combinations(range(min(n_anchors, 10)), 2)))
    kept = np.ones((len(pairs), n_anchors, 1), bool)
    kept[np.arange(len(pairs))[:, None], pairs, 0] = False
    squared = part.weights / (4 * np.where(part.weights > 0, part.ranges, 1.0) ** 2)
    found = points_fit(statistic(part.ranges, part.anchors, part.tags, squared * kept))
    # If the remaining anchors are coplanar, there is no linear solution.
    return _stand_ins(*found, part.anchors)
