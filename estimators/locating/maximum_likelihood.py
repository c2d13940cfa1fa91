"""Maximum-likelihood pose from raw ranges, with a search for other minima.

Problems here are flat: one batch axis B, arrays (B, M, N), (B, M, 3), (B, N, 3).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray, are_finite, kernel
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, Solution
from rbl_gym.estimators.costs.losses import loss_of
from rbl_gym.estimators.costs.map_problem import minimize, positive_inverse
from rbl_gym.estimators.costs.range_cost import RangeCost, squared_residuals
from rbl_gym.estimators.linear.least_squares import points_fit
from rbl_gym.estimators.linear.squared_range import statistic
from rbl_gym.estimators.locating.differences import places_of_differences
from rbl_gym.estimators.locating.rotation_net import ROTATION_NET
from rbl_gym.kernels import compiled
from rbl_gym.measurements import ranging

# Called without input checks: the inputs were checked before, or made here.
_TAG_POSITIONS = kernel(ranging.tag_positions)

# A cost this many standard deviations above its chi-square mean starts a global search.
_SUSPICIOUS = 5.0
# So does a rotation with this standard deviation (rad): there may be other minima.
_UNCERTAIN_RAD = 0.2
# So do fewer anchors than this, and anchors this flat.
_FEW_ANCHORS, _FLAT = 5, 0.05
# Numbers of rotations at each position, the best of the net, from which a search starts, and of
# approximate minima that it refines.
_STARTS, _MINIMA = 5, 8
# Poses whose tags are closer than these fractions of the body's size are the same: before
# convergence, and after it.
_NEAR, _SAME = 2e-2, 1e-3
# Poses within 3 sigma of the best cost are alternatives to it.
_RIVAL_COST = 4.5
_MAX_ALTERNATIVES = 3


class Alternatives(NamedTuple):
    """Other poses that explain the ranges about as well, best first.

    rotation (..., K, 3, 3), translation (..., K, 3), cost (..., K); infinite for none.
    """

    rotation: FloatArray
    translation: FloatArray
    cost: FloatArray


def no_alternatives(size: int) -> Alternatives:
    """Return empty alternatives for `size` trials."""
    return Alternatives(
        np.tile(np.eye(3), (size, _MAX_ALTERNATIVES, 1, 1)),
        np.zeros((size, _MAX_ALTERNATIVES, 3)),
        np.full((size, _MAX_ALTERNATIVES), np.inf),
    )


def maximum_likelihood(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray, tag_std_m: float = 0.0
) -> tuple[Solution, Alternatives]:
    """Return the most likely pose, with a global search if the first solution is in doubt.

    The cost is least squares of the ranges, batch axis (B,). Starts (B, 3, 3), (B, 3) that are not
    finite are found globally. `tag_std_m` is the standard deviation of the tags on the body, which
    is marginalised.
    """
    weights = cost.weights / (1 + tag_std_m**2 * cost.weights)
    if cost.offset is not None:
        found = _most_likely_pose(cost, rotation, translation, ROTATION_NET)
    else:
        found = most_likely_pose(
            cost.ranges, weights, cost.anchors, cost.tags, rotation, translation, ROTATION_NET,
            np.empty((_MAX_ALTERNATIVES, 6)),
        )  # fmt: skip
    solution = Solution(found[0], found[1], Linearization(*found[2:5]), found[5])
    return _with_tag_noise(cost, solution, tag_std_m), Alternatives(*found[6:])


def _with_tag_noise(cost: RangeCost, solution: Solution, tag_std_m: float) -> Solution:
    """Marginalise uncertain tag positions about the solution (twice, because it moves)."""
    if tag_std_m == 0:
        return solution
    for _ in range(2):
        positions = _TAG_POSITIONS(solution.rotation, solution.translation, cost.tags)
        unit = bounds.directions(cost.anchors, positions)[1]
        eased = dataclasses.replace(cost, tag_variance=tag_std_m**2, tag_unit=unit)
        solution = minimize(eased, solution.rotation, solution.translation, iterations=8)
    return solution


def linear_start(cost: RangeCost) -> tuple[FloatArray, FloatArray]:
    """Return `points_start` of a cost; NaN if the offsets leave no linear solution."""
    if cost.offset is None:
        return points_start(cost.ranges, cost.weights, cost.anchors, cost.tags)
    if cost.offset == "anchor":
        batch = cost.batch
        return np.full((*batch, 3, 3), np.nan), np.full((*batch, 3), np.nan)
    # The distances, which the weights of squared ranges need, are not known yet.
    stat = statistic(cost.ranges, cost.anchors, cost.tags, cost.weights, pseudo=True)
    return points_fit(stat)


@compiled("locating:points_start")
def points_start(
    ranges: FloatArray, weights: FloatArray, anchors: FloatArray, tags: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a pose (..., 3, 3), (..., 3) from squared ranges by `points_fit`; NaN if none."""
    # To first order var(r^2) = 4 r^2 var(r).
    ranges = np.where(weights > 0, ranges, 1.0)
    squared = weights / (4 * ranges**2)
    return points_fit(statistic(ranges, anchors, tags, squared))


@compiled("locating:most_likely_pose")
def most_likely_pose(
    ranges: FloatArray,
    weights: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    net: FloatArray,
    room: FloatArray,
) -> tuple[Any, ...]:
    """Return `maximum_likelihood` as plain arrays, for the kernel.

    Arrays are as in `RangeCost`; starts are NaN for none; `net` (S, 3, 3) are rotations to search
    from; of `room` (K, 6), for K alternatives, only the shape is used. Returns rotation,
    translation, cost, gradient, Hessian, converged, and three arrays of alternatives.
    """
    return _most_likely_pose(RangeCost(ranges, weights, anchors, tags), rotation, translation, net)


def _most_likely_pose(
    cost: RangeCost, rotation: FloatArray, translation: FloatArray, net: FloatArray
) -> tuple[Any, ...]:
    usable = are_finite(translation, 1) & are_finite(rotation, 2)
    found = minimize(
        cost,
        np.where(usable[:, None, None], rotation, np.eye(3)),
        np.where(usable[:, None], translation, 0.0),
        iterations=12,
        tolerance=3e-6,
    )
    alternatives = no_alternatives(len(usable))
    doubtful = ~usable | ~found.converged | in_doubt(cost, found.at)
    for part in chunks(doubtful):
        first = found.rotation[part], found.translation[part]
        best, others = search(cost.rows(part), first, usable[part], net)
        found = merge(found, best, part)
        for mine, theirs in zip(alternatives, others, strict=True):
            mine[part] = theirs
    return found.rotation, found.translation, *found.at, found.converged, *alternatives


def chunks(where: BoolArray) -> list[np.ndarray]:
    """Split a mask into parts as indices, because the starts of a search multiply the memory."""
    index = np.flatnonzero(where)
    return [index[k : k + 128] for k in range(0, len(index), 128)]


def in_doubt(cost: RangeCost, at: Linearization) -> BoolArray:
    """Return whether a solution may not be global: poor geometry, or too high a cost."""
    free = (cost.weights > 0).sum(axis=(-2, -1)) - 6 - cost.offsets()
    excess = 2 * at.cost - free
    high = excess > _SUSPICIOUS * np.sqrt(2 * np.maximum(free, 1))
    # Square root of the covariance's trace: at most sqrt(3) times the largest standard deviation.
    trace = np.einsum("...ii->...", positive_inverse(at.hessian)[..., :3, :3])
    spread = cost.anchors - cost.anchors.mean(axis=-2, keepdims=True)
    squares = np.linalg.eigvalsh(np.swapaxes(spread, -1, -2) @ spread)
    flat = squares[..., 0] < _FLAT**2 * squares[..., 2]
    few = cost.anchors.shape[-2] < _FEW_ANCHORS + (cost.offset is not None)
    return high | ~(trace < _UNCERTAIN_RAD**2) | flat | few


def search(
    part: RangeCost, first: tuple[FloatArray, FloatArray], usable: BoolArray, net: FloatArray
) -> tuple[Solution, Alternatives]:
    """Return the best of many local searches of trials (K, 1, ...), and its rivals.

    `first` are known solutions (K, 3, 3), (K, 3), where `usable`; `net` (S, 3, 3) the rotations to
    start from.
    """
    fine = local_minima(part, first, usable, net)
    best = cheapest(fine)
    # In a flat valley of many nearly equal poses, convergence is slow.
    polished = minimize(part, best.rotation[:, None], best.translation[:, None], 100)
    return cheapest(polished), rivals(part.tags, fine)


def local_minima(
    part: RangeCost,
    first: tuple[FloatArray, FloatArray],
    usable: BoolArray,
    net: FloatArray,
    starts: int = _STARTS,
) -> Solution:
    """Return distinct minima (K, 8), least cost first; infinite cost for unused slots.

    Starts are the first solution and, at each of three positions, the best `starts` rotations of
    the net. Other arguments as in `search`.
    """
    rotation, translation = _starts(part, net, starts)
    rotation = np.concatenate([rotation, first[0][:, None]], axis=1)
    translation = np.concatenate([translation, first[1][:, None]], axis=1)
    coarse = minimize(part, rotation, translation, 10, 1e-2)
    cost = np.array(coarse.at.cost)
    cost[~usable, -1] = np.inf
    order = np.argsort(cost, axis=-1, kind="stable")
    coarse = _rows(coarse, order)
    cost = np.take_along_axis(cost, order, axis=-1)
    distinct = _first_of_each(part.tags, coarse, cost < np.inf, _NEAR)
    # Distinct minima first, in their order.
    keep = np.argsort(~distinct, axis=-1, kind="stable")[:, :_MINIMA]
    kept = _rows(coarse, keep)
    fine = minimize(part, kept.rotation, kept.translation, 100, 1e-4)
    there = np.take_along_axis(distinct, keep, axis=-1)
    at = fine.at._replace(cost=np.where(there, fine.at.cost, np.inf))
    fine = fine._replace(at=at, converged=fine.converged & there)
    return _rows(fine, np.argsort(at.cost, axis=-1, kind="stable"))


def _starts(part: RangeCost, net: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the best poses (K, 3 count), `count` rotations of a net at each of three positions."""
    if part.offset is None:
        places = candidate_places(part.ranges[:, 0], part.weights[:, 0], part.anchors[:, 0])
    else:
        places = places_of_differences(part, net)
    centre = part.tags.mean(axis=-2)[:, :, None]
    translation = places[:, :, None] - (net @ centre[..., None])[..., 0]
    rotation = np.broadcast_to(net, (*translation.shape[:-1], 3, 3))
    grid = part.each(lambda array, _: array[:, None])
    cost = loss_of(squared_residuals(grid, rotation, translation), grid.loss)[0].sum(axis=(-2, -1))
    order = np.argsort(cost, axis=-1, kind="stable")[..., :count]
    rotation = np.take_along_axis(rotation, order[..., None, None], axis=2)
    translation = np.take_along_axis(translation, order[..., None], axis=2)
    return rotation.reshape((len(places), -1, 3, 3)), translation.reshape((len(places), -1, 3))


def candidate_places(ranges: FloatArray, weights: FloatArray, anchors: FloatArray) -> FloatArray:
    """Return positions (K, 3, 3) of the tags' centre: linear, and on both sides of the plane.

    They come from the mean squared range of every anchor. The plane is the best fit to the
    anchors; the linear solution determines little or nothing across it.
    """
    measured = weights > 0
    count = np.maximum(measured.sum(axis=-1), 1)
    squared = np.where(measured, ranges**2, 0.0).sum(axis=-1) / count
    seen = np.asarray(measured.any(axis=-1))
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
    # The remainder of the squared ranges in the plane is the squared height over it.
    in_plane = (axes @ flat[..., None])[..., 0]
    gaps = np.sum((anchors - mean[:, None] - in_plane[:, None]) ** 2, axis=-1)
    height = np.sqrt(np.maximum((((squared - gaps) * seen).sum(axis=-1) / total[:, 0]), 0.0))
    normal = axes[..., 0] * height[:, None]
    # The order of the sides must not depend on the sign of an eigenvector.
    largest = np.take_along_axis(normal, np.abs(normal).argmax(axis=-1)[:, None], axis=-1)
    normal = np.where(largest < 0, -normal, normal)
    linear = (axes @ along[..., None])[..., 0]
    return mean[:, None] + np.stack([linear, in_plane + normal, in_plane - normal], axis=1)


def _first_of_each(tags: FloatArray, poses: Solution, there: BoolArray, share: float) -> BoolArray:
    """Return which poses (K, S) differ from all kept poses before them.

    Two poses are the same if their tags (K, 1, N, 3) are closer than a `share` of the body's size.
    Only poses marked in `there` count.
    """
    positions = _TAG_POSITIONS(poses.rotation, poses.translation, tags)
    gap = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1).max(axis=-1)
    extent = np.linalg.norm(tags - tags.mean(axis=-2, keepdims=True), axis=-1).max(axis=(-2, -1))
    far = gap > share * np.maximum(extent, 1e-12)[:, None, None]
    chosen = np.zeros(there.shape, bool)
    for k in range(there.shape[1]):
        chosen[:, k] = there[:, k] & (far[:, k] | ~chosen).all(axis=-1)
    return chosen


def _rows(poses: Solution, order: np.ndarray) -> Solution:
    """Return poses (K, S) in the order (K, n) of each trial."""
    rows = np.arange(len(order))[:, None]
    at = Linearization(*(field[rows, order] for field in poses.at))
    return Solution(
        poses.rotation[rows, order],
        poses.translation[rows, order],
        at,
        poses.converged[rows, order],
    )


def cheapest(solutions: Solution) -> Solution:
    """Return the solution of least cost among the starts (K, S) of every trial."""
    best = _rows(solutions, np.argmin(solutions.at.cost, axis=-1)[:, None])
    at = Linearization(*(field[:, 0] for field in best.at))
    return Solution(best.rotation[:, 0], best.translation[:, 0], at, best.converged[:, 0])


def rivals(tags: FloatArray, solutions: Solution) -> Alternatives:
    """Return distinct minima (K, S) about as likely as the best; tags (K, 1, N, 3)."""
    # Stable sort, because `cheapest` also takes the first of exact mirror images.
    order = np.argsort(solutions.at.cost, axis=-1, kind="stable")
    sorted_ = _rows(solutions, order)
    cost = sorted_.at.cost
    there = sorted_.converged & (cost < cost[:, :1] + _RIVAL_COST)
    there[:, 0] = True
    chosen = _first_of_each(tags, sorted_, there, _SAME)
    chosen[:, 0] = False
    result = no_alternatives(len(cost))
    place = np.cumsum(chosen, axis=-1) - 1
    trial, start = np.nonzero(chosen & (place < _MAX_ALTERNATIVES))
    slot = place[trial, start]
    result.rotation[trial, slot] = sorted_.rotation[trial, start]
    result.translation[trial, slot] = sorted_.translation[trial, start]
    result.cost[trial, slot] = cost[trial, start]
    return result


def merge(solution: Solution, found: Solution, where: np.ndarray) -> Solution:
    """Return `solution` with the trials at an index replaced by `found`."""

    def put(old: Any, new: Any) -> Any:
        result = np.array(old)
        result[where] = new
        return result

    return Solution(
        put(solution.rotation, found.rotation),
        put(solution.translation, found.translation),
        Linearization._make(put(*pair) for pair in zip(solution.at, found.at, strict=True)),
        put(solution.converged, found.converged),
    )
