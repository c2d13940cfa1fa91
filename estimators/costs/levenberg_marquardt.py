"""Damped Gauss-Newton on SO(3) x R^3, batched; every estimator of poses uses this loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.geometry import rotations

# Called without input checks: the input was made here.
_EXP = kernel(rotations.exp)

# Largest step (rad, m) on any axis.
_LONGEST = 1e12


class Linearization(NamedTuple):
    """Cost (...), gradient (..., 6) and Gauss-Newton Hessian (..., 6, 6) by (w, v) at a pose."""

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray


class Solution(NamedTuple):
    """Pose, its linearization, and whether the last step was below the tolerance (...)."""

    rotation: FloatArray
    translation: FloatArray
    at: Linearization
    converged: BoolArray


def minimize_pose(
    linearize: Callable[[FloatArray, FloatArray], Linearization],
    rotation: FloatArray,
    translation: FloatArray,
    iterations: int,
    tolerance: float = 1e-6,
) -> Solution:
    """Minimise a sum of squares over poses, ``Q <- exp(w) Q``, ``t <- t + v``.

    This is plain Gauss-Newton while the cost falls. If a step would raise the cost, it is rejected
    and the damping grows tenfold (Marquardt's scaling).

    Parameters
    ----------
    linearize
        The problem: pose to `Linearization`.
    rotation, translation
        Starts, (..., 3, 3) and (..., 3).
    iterations
        Maximum number of iterations; a converged trial no longer changes.
    tolerance
        Tolerance on the length of the step in standard deviations, with the Hessian as information.
        The last step is still taken; near the minimum the remaining error is of second order.
    """
    at = linearize(rotation, translation)
    batch = at.cost.shape
    pose = np.broadcast_to(rotation, (*batch, 3, 3)), np.broadcast_to(translation, (*batch, 3))
    found, damping = Solution(*pose, at, np.zeros(batch, bool)), np.zeros(batch)
    for _ in range(iterations):
        found, damping = _stepped(linearize, found, damping, tolerance)
        if found.converged.all():
            break
    return found


def _stepped(
    linearize: Callable[[FloatArray, FloatArray], Linearization],
    found: Solution,
    damping: FloatArray,
    tolerance: float,
) -> tuple[Solution, FloatArray]:
    """Return the solution after one more step, and the damping of the next."""
    rotation, translation, at, converged = found
    step = -damped_solution(at.hessian, at.gradient, damping)
    # With almost no information, the square of a step may overflow.
    step = np.clip(step, -_LONGEST, _LONGEST)
    turned, moved = _EXP(step[..., :3]) @ rotation, translation + step[..., 3:]
    new = linearize(turned, moved)
    # Damping shortens the step by about 1 + damping, so a short step does not show convergence.
    decrease = -np.einsum("...i,...i->...", at.gradient, step) * (1 + damping)
    # A step of 1e-4 standard deviations changes the cost by less than rounding can.
    better = (new.cost <= at.cost * (1 + 1e-12)) | (decrease < 1e-8)
    taken = better & ~converged
    at = Linearization(
        np.where(taken, new.cost, at.cost),
        np.where(taken[..., None], new.gradient, at.gradient),
        np.where(taken[..., None, None], new.hessian, at.hessian),
    )
    rotation = np.where(taken[..., None, None], turned, rotation)
    translation = np.where(taken[..., None], moved, translation)
    eased = np.where(damping > 1e-5, 0.1 * damping, 0.0)
    damping = np.where(better, eased, np.maximum(10 * damping, 1e-3))
    return Solution(rotation, translation, at, converged | (decrease < tolerance**2)), damping


def damped_solution(A: FloatArray, b: FloatArray, damping: FloatArray) -> FloatArray:
    """Solve ``(A + damping diag(A)) x = b`` for x (..., n), A (..., n, n) positive semidefinite.

    Nonzero diagonal entries grow by 1e-14 of themselves, so that singular matrices solve too.
    """
    diagonal = np.einsum("...ii->...i", A)
    raised = (damping[..., None] + 1e-14) * diagonal + 1e-300
    return np.linalg.solve(A + raised[..., None] * np.eye(A.shape[-1]), b[..., None])[..., 0]
