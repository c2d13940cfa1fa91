"""Robust updates: Huber's loss, and exclusion of links that contradict the others.

Huber's loss alone tolerates wrong ranges, but each of them still has the influence of 1.5 standard
deviations. With one range in ten over a reflected path, this doubles the error.

For late ranges, the redescending loss replaces both.
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
from rbl_gym.kernels.constants import CUTOFFS, GATE, HUBER, LARGEST_SHARE_OUT

# Codes of `robust` for the kernel.
ROBUST = {False: 0, True: 1, "late": 2}


def robust_solution(
    problem: MapProblem, rotation: FloatArray, translation: FloatArray, iterations: int
) -> Solution:
    """Return the pose of the consistent links, by `minimize_pose` of a `RangeCost`.

    Links whose innovation no consistent prior explains are excluded at the start. If the resulting
    pose disagrees, for links in or out, they are selected again from a solution with Huber's loss,
    successively at `CUTOFFS`. Each stage has so many Gauss-Newton iterations; the problem's own
    loss is ignored.
    """
    data: RangeCost = problem.data  # pyrefly: ignore[bad-assignment]
    data = dataclasses.replace(data, loss=huber(HUBER))
    out = _beyond_gate(problem.prior, data)
    kept = dataclasses.replace(data, weights=np.where(out, 0.0, data.weights))
    first = minimize_pose(_with(problem, kept), rotation, translation, iterations)
    squared = squared_residuals(data, first.rotation, first.translation)
    wrong = np.asarray(((squared > GATE**2) != out).any(axis=(-2, -1)))
    if not wrong.any():
        return first
    found = minimize_pose(_with(problem, data), rotation, translation, iterations, 1e-2)
    for cutoff in CUTOFFS:
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
    """Return the pose of the redescending loss, started at Huber's; see `robust_solution`."""
    data: RangeCost = problem.data  # pyrefly: ignore[bad-assignment]
    easy = _with(problem, dataclasses.replace(data, loss=huber(HUBER)))
    found = minimize_pose(easy, rotation, translation, iterations, 1e-2)
    hard = _with(problem, dataclasses.replace(data, loss=LATE))
    return minimize_pose(hard, found.rotation, found.translation, iterations)


def check_robust(robust: Any) -> int:
    """Return the kernel code of `robust`, or raise ValueError."""
    if not isinstance(robust, bool | str) or robust not in ROBUST:
        raise ValueError(f"robust must be True, False or 'late', got {robust!r:.80}")
    return ROBUST[robust]


def _with(problem: MapProblem, data: RangeCost) -> MapProblem:
    return dataclasses.replace(problem, data=data)


def _beyond_gate(prior: PoseState, data: RangeCost) -> BoolArray:
    """Return the links (..., M, N) that contradict the prior; none if too many do.

    The variance of an innovation is at most that of the range and the square of ``sqrt(tr P_v) +
    |c| sqrt(tr P_w)``: it is cheap and conservative.
    """
    of_rotation, of_place = (
        np.sqrt(np.einsum("...ii->...", prior.covariance[..., block, block]))[..., None]
        for block in (slice(0, 3), slice(3, 6))
    )
    reach = of_place + np.linalg.norm(data.tags, axis=-1) * of_rotation
    if data.offset is not None:
        # An offset is determined by the other ranges, which are equally uncertain.
        reach = 2 * reach
    allowed = GATE**2 * (1 + data.weights * np.square(reach)[..., None, :])
    out = squared_residuals(data, prior.rotation, prior.translation) > allowed
    return out & ~_contradicted(out, data.weights)[..., None, None]


def _contradicted(out: BoolArray, weights: FloatArray) -> BoolArray:
    """Return whether (...) more than `LARGEST_SHARE_OUT` of the links are out."""
    links = (weights > 0).sum(axis=(-2, -1))
    return np.asarray(out.sum(axis=(-2, -1)) > LARGEST_SHARE_OUT * links)
