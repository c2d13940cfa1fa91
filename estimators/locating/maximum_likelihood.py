"""Maximum likelihood of the pose on raw ranges, its global search, and robust estimation.

Problems are flat here: one batch axis B, arrays (B, M, N), (B, M, 3), (B, N, 3).
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray, are_finite, kernel
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, Solution, minimize_pose
from rbl_gym.estimators.costs.range_cost import RangeCost, geman_mcclure, huber, squared_residuals
from rbl_gym.estimators.linear.least_squares import points_fit
from rbl_gym.estimators.linear.squared_range import statistic
from rbl_gym.estimators.locating.rotation_net import ROTATION_NET
from rbl_gym.measurements import ranging

# Behind the doors: what comes to these was checked, or made here.
_TAG_POSITIONS, _DISTANCES = kernel(ranging.tag_positions), kernel(ranging.distances)

# A cost this many standard deviations above its chi-square mean calls for a global search.
_SUSPICIOUS = 5.0
# So does a rotation that the ranges leave this uncertain (rad): there may be other minima.
_UNCERTAIN_RAD = 0.2
# Poses within 3 sigma of the best cost are alternatives to it.
_RIVAL_COST = 4.5
_MAX_ALTERNATIVES = 3
_HUBER = 1.5
# A robust fit that fewer of its ranges agree with is searched for again.
_TRUSTED_INLIERS = 0.65
_CHUNK = 128


class Alternatives(NamedTuple):
    """Other poses that explain the ranges about as well, best first.

    rotation (..., K, 3, 3), translation (..., K, 3), cost (..., K); infinite where there is none.
    """

    rotation: FloatArray
    translation: FloatArray
    cost: FloatArray


def no_alternatives(size: int) -> Alternatives:
    """`size` trials without any."""
    return Alternatives(
        np.tile(np.eye(3), (size, _MAX_ALTERNATIVES, 1, 1)),
        np.zeros((size, _MAX_ALTERNATIVES, 3)),
        np.full((size, _MAX_ALTERNATIVES), np.inf),
    )


def maximum_likelihood(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray, tag_std_m: float = 0.0
) -> tuple[Solution, Alternatives]:
    """The most likely pose, searched for globally where the first solution is in doubt.

    Parameters
    ----------
    cost
        Least squares of the ranges, batch axis (B,).
    rotation, translation
        Starts (B, 3, 3), (B, 3); rows that are not finite are started globally.
    tag_std_m
        Standard deviation of the tags' places on the body, marginalised.
    """
    rotation, translation, usable = _usable(cost, rotation, translation)
    solution = minimize_pose(cost, rotation, translation, iterations=12, tolerance=3e-6)
    judged = _with_tag_noise(cost, solution, tag_std_m)
    alternatives = no_alternatives(len(usable))
    doubtful = ~usable | ~judged.converged | in_doubt(cost, judged.at)
    if not doubtful.any():
        return judged, alternatives
    for part in _chunks(doubtful):
        found, others = search(cost.take(part), solution, part)
        solution = merge(solution, found, part)
        for mine, theirs in zip(alternatives, others, strict=True):
            mine[part] = theirs
    return _with_tag_noise(cost, solution, tag_std_m), alternatives


def _usable(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Starts with a stand-in where they are not finite, and the mask of those that are."""
    usable = are_finite(translation, 1) & are_finite(rotation, 2)
    return (
        np.where(usable[:, None, None], rotation, np.eye(3)),
        np.where(usable[:, None], translation, cost.anchors.mean(axis=-2)),
        usable,
    )


def _chunks(where: BoolArray) -> list[BoolArray]:
    """The mask in parts of at most `_CHUNK` trials: a net of starts multiplies the memory."""
    index = np.flatnonzero(where)
    parts = []
    for start in range(0, len(index), _CHUNK):
        part = np.zeros_like(where)
        part[index[start : start + _CHUNK]] = True
        parts.append(part)
    return parts


def _with_tag_noise(cost: RangeCost, solution: Solution, tag_std_m: float) -> Solution:
    """The solution with uncertain tag places marginalised about it (twice, as they move it)."""
    if tag_std_m == 0:
        return solution
    for _ in range(2):
        positions = _TAG_POSITIONS(solution.rotation, solution.translation, cost.tags)
        unit = bounds.directions(cost.anchors, positions)[1]
        eased = dataclasses.replace(cost, tag_variance=tag_std_m**2, tag_unit=unit)
        solution = minimize_pose(eased, solution.rotation, solution.translation, iterations=8)
    return solution


def in_doubt(cost: RangeCost, at: Linearization) -> BoolArray:
    """Whether a solution may not be the global one: poor geometry, or a cost too high."""
    links = (cost.weights > 0).sum(axis=(-2, -1))
    excess = 2 * at.cost - (links - 6)
    high = excess > _SUSPICIOUS * np.sqrt(2 * np.maximum(links - 6, 1))
    vague = rotation_std(at.hessian) > _UNCERTAIN_RAD
    spread = cost.anchors - cost.anchors.mean(axis=-2, keepdims=True)
    squares = np.linalg.eigvalsh(np.swapaxes(spread, -1, -2) @ spread)
    flat = squares[:, 0] < 0.05**2 * squares[:, 2]
    return high | vague | flat | (cost.anchors.shape[-2] < 5)


def rotation_std(hessian: FloatArray) -> FloatArray:
    """Bound (B,) on the rotation's standard deviation (rad), inf where nothing determines it.

    The root of the covariance's trace: at most sqrt(3) times the largest standard deviation.
    """
    singular = bounds.information_rank(hessian) < 6
    covariance = np.linalg.inv(np.where(singular[:, None, None], np.eye(6), hessian))
    trace = np.einsum("bii->b", covariance[:, :3, :3])
    return np.where(singular, np.inf, np.sqrt(np.maximum(trace, 0.0)))


def search(part: RangeCost, first: Solution, where: BoolArray) -> tuple[Solution, Alternatives]:
    """Best of many local solves, and its rivals; arguments as `local_minima`."""
    fine = local_minima(part, first, where)
    best = cheapest(fine)
    # Where many poses are nearly as good the way along the valley is long.
    polished = minimize_pose(part, best.rotation[:, None], best.translation[:, None], 100)
    return cheapest(polished), rivals(part.tags, fine)


def local_minima(part: RangeCost, first: Solution, where: BoolArray) -> Solution:
    """The 8 cheapest local solves from 24 rotations x 3 positions and the first solution.

    Parameters
    ----------
    part
        The doubtful trials (K, 1, ...), from `RangeCost.take`.
    first
        Solution of all trials.
    where
        Which of them `part` holds.

    Returns
    -------
    Solutions (K, 8), in no order.
    """
    places = _positions(part)
    centre = part.tags.mean(axis=-2)
    net = ROTATION_NET[None, :, None]
    turned = (net @ centre[:, :, None, :, None])[..., 0]
    translation = (places[:, None] - turned).reshape(len(places), -1, 3)
    rotation = np.broadcast_to(net, (len(places), 24, 3, 3, 3)).reshape(len(places), -1, 3, 3)
    rotation = np.concatenate([first.rotation[where][:, None], rotation], axis=1)
    translation = np.concatenate([first.translation[where][:, None], translation], axis=1)
    coarse = minimize_pose(part, rotation, translation, iterations=10, tolerance=1e-2)
    keep = np.argsort(coarse.at.cost, axis=-1)[:, :8]
    return minimize_pose(
        part,
        np.take_along_axis(coarse.rotation, keep[..., None, None], axis=1),
        np.take_along_axis(coarse.translation, keep[..., None], axis=1),
        iterations=25,
    )


def _positions(part: RangeCost) -> FloatArray:
    """Candidate places (K, 3, 3) of the tags' centre: linear, and on both sides of the plane.

    From the mean squared range of every anchor; the plane is that of least spread of the
    anchors, across which the linear solution knows little or nothing.
    """
    measured = part.weights[:, 0] > 0
    count = np.maximum(measured.sum(axis=-1), 1)
    squared = np.where(measured, part.ranges[:, 0] ** 2, 0.0).sum(axis=-1) / count
    seen = np.asarray(measured.any(axis=-1))
    anchors = part.anchors[:, 0]
    total = np.maximum(seen.sum(axis=-1), 1)[:, None]
    mean = (anchors * seen[..., None]).sum(axis=-2) / total
    spread = (anchors - mean[:, None]) * seen[..., None]
    d = squared - np.sum((anchors - mean[:, None]) ** 2, axis=-1)
    d = (d - ((d * seen).sum(axis=-1) / total[:, 0])[:, None]) * seen
    values, axes = np.linalg.eigh(np.swapaxes(spread, -1, -2) @ spread)
    pull = -0.5 * np.einsum("kmi,km->ki", spread, d)
    along = np.einsum("kij,ki->kj", axes, pull)
    known = values > 1e-9 * values[:, 2:]
    along = np.where(known, along / np.where(known, values, 1.0), 0.0)
    flat = along * [0, 1, 1]
    # What is left of the squared ranges in the plane is the squared height over it.
    in_plane = (axes @ flat[..., None])[..., 0]
    gaps = np.sum((anchors - mean[:, None] - in_plane[:, None]) ** 2, axis=-1)
    height = np.sqrt(np.maximum((((squared - gaps) * seen).sum(axis=-1) / total[:, 0]), 0.0))
    normal = axes[..., 0] * height[:, None]
    linear = (axes @ along[..., None])[..., 0]
    return mean[:, None] + np.stack([linear, in_plane + normal, in_plane - normal], axis=1)


def cheapest(solutions: Solution) -> Solution:
    """The cheapest of the starts (K, S) of every trial."""
    row, best = np.arange(len(solutions.at.cost)), np.argmin(solutions.at.cost, axis=-1)
    at = Linearization(*(field[row, best] for field in solutions.at))
    return Solution(
        solutions.rotation[row, best],
        solutions.translation[row, best],
        at,
        solutions.converged[row, best],
    )


def rivals(tags: FloatArray, solutions: Solution) -> Alternatives:
    """Distinct minima (K, S) that are about as cheap as the best; tags (K, 1, N, 3)."""
    size = len(solutions.at.cost)
    result = no_alternatives(size)
    # Stable: of exact mirror images `cheapest` takes the first too.
    order = np.argsort(solutions.at.cost, axis=-1, kind="stable")
    rotation = np.take_along_axis(solutions.rotation, order[..., None, None], axis=1)
    translation = np.take_along_axis(solutions.translation, order[..., None], axis=1)
    cost = np.take_along_axis(solutions.at.cost, order, axis=1)
    converged = np.take_along_axis(solutions.converged, order, axis=1)
    positions = _TAG_POSITIONS(rotation, translation, tags)
    gap = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1).max(axis=-1)
    extent = np.linalg.norm(tags - tags.mean(axis=-2, keepdims=True), axis=-1)
    far = gap > 1e-3 * np.maximum(extent.max(axis=(-2, -1)), 1e-12)[:, None, None]
    chosen = np.zeros(cost.shape, bool)
    chosen[:, 0] = True
    count = np.zeros(size, int)
    for k in range(1, cost.shape[1]):
        new = (far[:, k] | ~chosen).all(axis=-1) & converged[:, k]
        new &= (cost[:, k] < cost[:, 0] + _RIVAL_COST) & (count < _MAX_ALTERNATIVES)
        row = np.flatnonzero(new)
        result.rotation[row, count[row]] = rotation[row, k]
        result.translation[row, count[row]] = translation[row, k]
        result.cost[row, count[row]] = cost[row, k]
        chosen[row, k] = True
        count[row] += 1
    return result


def merge(solution: Solution, found: Solution, where: BoolArray) -> Solution:
    """`solution` with the trials of the mask replaced by `found`."""

    def put(old: Any, new: Any) -> Any:
        result = old.copy()
        result[where] = new
        return result

    return Solution(
        put(solution.rotation, found.rotation),
        put(solution.translation, found.translation),
        Linearization._make(put(*pair) for pair in zip(solution.at, found.at, strict=True)),
        put(solution.converged, found.converged),
    )


def robust(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray
) -> tuple[Solution, Alternatives]:
    """Pose from ranges of which some are wrong: Huber, Geman-McClure, a refit on the inliers.

    Geman and McClure's loss is narrowed step by step (graduated non-convexity), so that the
    start need not be near. Where few ranges agree with the outcome, many starts are tried and
    the one with the least bounded loss is kept. Ranges beyond 4 standard deviations of that fit
    are left out of the maximum-likelihood refit.
    """
    rotation, translation, _ = _usable(cost, rotation, translation)
    easy = dataclasses.replace(cost, loss=huber(_HUBER))
    solution = minimize_pose(easy, rotation, translation, iterations=20, tolerance=1e-2)
    solution = _narrow(cost, solution.rotation, solution.translation, widest=1.0)
    links = np.maximum((cost.weights > 0).sum(axis=(-2, -1)), 1)
    doubtful = _inliers(cost, solution).sum(axis=(-2, -1)) < _TRUSTED_INLIERS * links
    for chunk in _chunks(doubtful):
        part = easy.take(chunk)
        minima = local_minima(part, solution, chunk)[:2]
        starts = zip(minima, _without_pairs_of_anchors(part), strict=True)
        # From the median residual on: a wide loss would lead them all to the same wrong place.
        narrowed = _narrow(part, *(np.concatenate(pair, axis=1) for pair in starts), widest=0.5)
        solution = merge(solution, cheapest(narrowed), chunk)
    weights = np.where(_inliers(cost, solution), cost.weights, 0.0)
    refit = dataclasses.replace(cost, weights=weights)
    return maximum_likelihood(refit, solution.rotation, solution.translation)


def _inliers(cost: RangeCost, solution: Solution) -> BoolArray:
    """Links (..., M, N) within 4 standard deviations of a solution."""
    squared = squared_residuals(cost, solution.rotation, solution.translation)
    return (squared < 16.0) & (cost.weights > 0)


def _narrow(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray, widest: float
) -> Solution:
    """Geman-McClure from the quantile `widest` of the residuals to 3 standard deviations."""
    residuals = np.sqrt(squared_residuals(cost, rotation, translation))
    scale = np.maximum(np.quantile(residuals, widest, axis=(-2, -1)), 3.0)
    while True:
        narrowed = dataclasses.replace(cost, loss=geman_mcclure(scale[..., None, None]))
        solution = minimize_pose(narrowed, rotation, translation, iterations=4, tolerance=1e-3)
        if (scale <= 3.0).all():
            return solution
        rotation, translation = solution.rotation, solution.translation
        scale = np.maximum(scale / 1.6, 3.0)


def _without_pairs_of_anchors(part: RangeCost) -> tuple[FloatArray, FloatArray]:
    """Linear solutions (K, S, ...) with two anchors left out: one of them has no bad anchor.

    All pairs among the first 10 anchors; with fewer than 6 anchors nothing can be left out.
    """
    n_anchors = part.anchors.shape[-2]
    if n_anchors < 6:
        return (np.empty((len(part.ranges), 0, 3, 3)), np.empty((len(part.ranges), 0, 3)))
    pairs = np.array(list(itertools.combinations(range(min(n_anchors, 10)), 2)))
    kept = np.ones((len(pairs), n_anchors, 1), bool)
    kept[np.arange(len(pairs))[:, None], pairs, 0] = False
    squared = part.weights / (4 * np.where(part.weights > 0, part.ranges, 1.0) ** 2)
    rotation, translation = points_fit(
        statistic(part.ranges, part.anchors, part.tags, squared * kept)
    )
    # The anchors that are left may lie in a plane: then there is no linear solution.
    known = are_finite(translation, 1) & are_finite(rotation, 2)
    return (
        np.where(known[..., None, None], rotation, np.eye(3)),
        np.where(known[..., None], translation, part.anchors.mean(axis=-2)),
    )
