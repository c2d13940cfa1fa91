"""The robust updates: Huber's loss, and no pull at all of links that contradict the rest.

Huber's loss alone survives wrong ranges, but each of them still pulls with the force of 1.5
standard deviations: with one range in ten over a reflected path that doubles the error.

Where ranges err late, the redescending loss for late ranges takes the place of both.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, Solution, minimize_pose
from rbl_gym.estimators.costs.losses import LATE, cut_huber, huber
from rbl_gym.estimators.costs.map_problem import MapProblem, PoseState
from rbl_gym.estimators.costs.range_cost import RangeCost, squared_residuals

# Whitened residual at which Huber's loss turns from squares to absolute values.
HUBER = 1.5
# Standard deviations beyond which a link contradicts a pose.
GATE = 4.0
# Where the gate at the prior was wrong: first with care, as Huber's pose is biased.
_CUTOFFS = (6.0, GATE)
# What `robust` may be, to the kernel.
ROBUST = {False: 0, True: 1, "late": 2}
# A pose that more than this share of the links contradict is itself in doubt: all links count.
_LARGEST_SHARE_OUT = 0.5


def robust_solution(
    problem: MapProblem, rotation: FloatArray, translation: FloatArray, iterations: int
) -> Solution:
    """The pose of most links, `minimize_pose` of a problem on ranges (`RangeCost`).

    Links whose innovation no honest prior explains are left out from the start. Where the pose
    that follows tells otherwise, of links in or out, they are chosen anew from a solution by
    Huber's loss, at `_CUTOFFS` one after the other.

    Parameters
    ----------
    problem
        Its loss is not looked at.
    rotation, translation
        The starts, (..., 3, 3) and (..., 3).
    iterations
        Gauss-Newton iterations of each stage.
    """
    data: RangeCost = problem.data  # pyright: ignore[reportAssignmentType]
    data = dataclasses.replace(data, loss=huber(HUBER))
    out = _beyond_gate(problem.prior, data)
    kept = dataclasses.replace(data, weights=np.where(out, 0.0, data.weights))
    first = minimize_pose(_with(problem, kept), rotation, translation, iterations)
    squared = squared_residuals(data, first.rotation, first.translation)
    wrong = np.asarray(((squared > GATE**2) != out).any(axis=(-2, -1)))
    if not wrong.any():
        return first
    found = minimize_pose(_with(problem, data), rotation, translation, iterations, 1e-2)
    for cutoff in _CUTOFFS:
        squared = squared_residuals(data, found.rotation, found.translation)
        doubted = _contradicted(squared > cutoff**2, data.weights)
        loss = cut_huber(HUBER, np.where(doubted, np.inf, cutoff))
        narrowed = _with(problem, dataclasses.replace(data, loss=loss))
        found = minimize_pose(narrowed, found.rotation, found.translation, iterations)
    return Solution(
        np.where(wrong[..., None, None], found.rotation, first.rotation),
        np.where(wrong[..., None], found.translation, first.translation),
        Linearization(
            np.where(wrong, found.at.cost, first.at.cost),
            np.where(wrong[..., None], found.at.gradient, first.at.gradient),
            np.where(wrong[..., None, None], found.at.hessian, first.at.hessian),
        ),
        np.where(wrong, found.converged, first.converged),
    )


def late_solution(
    problem: MapProblem, rotation: FloatArray, translation: FloatArray, iterations: int
) -> Solution:
    """The pose by the redescending loss, from that of Huber's; arguments as `robust_solution`."""
    data: RangeCost = problem.data  # pyright: ignore[reportAssignmentType]
    easy = _with(problem, dataclasses.replace(data, loss=huber(HUBER)))
    found = minimize_pose(easy, rotation, translation, iterations, 1e-2)
    hard = _with(problem, dataclasses.replace(data, loss=LATE))
    return minimize_pose(hard, found.rotation, found.translation, iterations)


def check_robust(robust: Any) -> int:
    """`robust` as the kernel takes it, or a ValueError."""
    if not isinstance(robust, bool | str) or robust not in ROBUST:
        raise ValueError(f"robust must be True, False or 'late', got {robust!r:.80}")
    return ROBUST[robust]


def _with(problem: MapProblem, data: RangeCost) -> MapProblem:
    return dataclasses.replace(problem, data=data)


def _beyond_gate(prior: PoseState, data: RangeCost) -> BoolArray:
    """Links (..., M, N) that contradict the prior; none where too many do.

    The variance of an innovation is at most that of the range and the square of
    ``sqrt(tr P_v) + |c| sqrt(tr P_w)``: cheap, and never too narrow.
    """
    of_rotation, of_place = (
        np.sqrt(np.einsum("...ii->...", prior.covariance[..., block, block]))[..., None]
        for block in (slice(0, 3), slice(3, 6))
    )
    reach = of_place + np.linalg.norm(data.tags, axis=-1) * of_rotation
    if data.offset is not None:
        # An offset is told by the other ranges, which are as uncertain.
        reach = 2 * reach
    allowed = GATE**2 * (1 + data.weights * np.square(reach)[..., None, :])
    out = squared_residuals(data, prior.rotation, prior.translation) > allowed
    return out & ~_contradicted(out, data.weights)[..., None, None]


def _contradicted(out: BoolArray, weights: FloatArray) -> BoolArray:
    """Whether (...) more than `_LARGEST_SHARE_OUT` of the links are out."""
    links = (weights > 0).sum(axis=(-2, -1))
    return np.asarray(out.sum(axis=(-2, -1)) > _LARGEST_SHARE_OUT * links)
