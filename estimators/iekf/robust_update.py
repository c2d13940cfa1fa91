"""The robust update: Huber's loss, and no pull at all of links that contradict the rest.

Huber's loss alone survives wrong ranges, but each of them still pulls with the force of 1.5
standard deviations: with one range in ten over a reflected path that doubles the error.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, Solution, minimize_pose
from rbl_gym.estimators.costs.range_cost import Loss, cut_huber, squared_residuals

# Whitened residual at which Huber's loss turns from squares to absolute values.
HUBER = 1.5
# Standard deviations beyond which a link contradicts a pose.
GATE = 4.0
# Where the gate at the prior was wrong: first with care, as Huber's pose is biased.
_CUTOFFS = (6.0, GATE)
# A pose that more than this share of the links contradict is itself in doubt: all links count.
_LARGEST_SHARE_OUT = 0.5


def robust_solution(
    problem: Any, rotation: FloatArray, translation: FloatArray, iterations: int
) -> Solution:
    """The pose of most links, `minimize_pose` of a problem whose loss is Huber's.

    Links whose innovation no honest prior explains are left out from the start. Where the pose
    that follows tells otherwise, of links in or out, they are chosen anew from a solution by
    Huber's loss, at `_CUTOFFS` one after the other.

    Parameters
    ----------
    problem
        A `manifold.MapProblem` on ranges.
    rotation, translation
        The starts, (..., 3, 3) and (..., 3).
    iterations
        Gauss-Newton iterations of each stage.
    """
    data = problem.data
    out = _beyond_gate(problem)
    gated = problem
    if out.any():
        weights = np.where(out, 0.0, data.weights)
        gated = dataclasses.replace(problem, data=dataclasses.replace(data, weights=weights))
    found = minimize_pose(gated, rotation, translation, iterations)
    squared = squared_residuals(data, found.rotation, found.translation)
    wrong = ((squared > GATE**2) != out).any(axis=(-2, -1))
    if not wrong.any():
        return found
    batch = found.at.cost.shape
    axes = batch or (1,)
    where = np.broadcast_to(wrong, axes).nonzero()
    found = _of_shape(found, axes)
    better = _narrowed(problem.take(axes, where), *found[:2], where, iterations)
    for old, new in zip(_arrays(found), _arrays(better), strict=True):
        old[where] = new
    return _of_shape(found, batch)


def _narrowed(
    part: Any,
    rotation: FloatArray,
    translation: FloatArray,
    where: tuple[np.ndarray, ...],
    iterations: int,
) -> Solution:
    """Some of the trials (K,) by Huber's loss, then without the links beyond each cutoff."""
    found = minimize_pose(part, rotation[where], translation[where], iterations, tolerance=1e-2)
    for cutoff in _CUTOFFS:
        squared = squared_residuals(part.data, found.rotation, found.translation)
        doubted = _contradicted(squared > cutoff**2, part.data.weights)
        loss = cut_loss(np.where(doubted, np.inf, cutoff))
        narrowed = dataclasses.replace(part, data=dataclasses.replace(part.data, loss=loss))
        found = minimize_pose(narrowed, found.rotation, found.translation, iterations)
    return found


def cut_loss(cutoff: FloatArray) -> Loss:
    """Huber's loss that ends at cutoffs (...), one for each trial."""
    return cut_huber(HUBER, cutoff[..., None, None])


def _beyond_gate(problem: Any) -> BoolArray:
    """Links (..., M, N) that contradict the prior; none where too many do.

    The variance of an innovation is at most that of the range and the square of
    ``sqrt(tr P_v) + |c| sqrt(tr P_w)``: cheap, and never too narrow.
    """
    data, P = problem.data, problem.prior.covariance
    spread = [
        np.sqrt(np.einsum("...ii->...", P[..., block, block]))
        for block in (slice(0, 3), slice(3, 6))
    ]
    arm = np.sqrt(np.einsum("...ni,...ni->...n", data.tags, data.tags))
    reach = spread[1][..., None] + arm * spread[0][..., None]
    allowed = GATE**2 * (1 + data.weights * np.square(reach)[..., None, :])
    squared = squared_residuals(data, problem.prior.rotation, problem.prior.translation)
    out = squared > allowed
    if out.any():
        out &= ~_contradicted(out, data.weights)[..., None, None]
    return np.asarray(out)


def _contradicted(out: BoolArray, weights: FloatArray) -> BoolArray:
    """Whether (...) more than `_LARGEST_SHARE_OUT` of the links are out."""
    links = (weights > 0).sum(axis=(-2, -1))
    return np.asarray(out.sum(axis=(-2, -1)) > _LARGEST_SHARE_OUT * links)


def _arrays(solution: Solution) -> tuple[Any, ...]:
    return solution.rotation, solution.translation, *solution.at, solution.converged


def _of_shape(solution: Solution, batch: tuple[int, ...]) -> Solution:
    """A copy of the solution with this batch shape."""
    trailing = (2, 1, 0, 1, 2, 0)
    fields = [
        np.array(a).reshape((*batch, *a.shape[a.ndim - n :]))
        for a, n in zip(_arrays(solution), trailing, strict=True)
    ]
    return Solution(fields[0], fields[1], Linearization(*fields[2:5]), fields[5])
