"""Most likely pose of an epoch: the cost of the measurements, and a prior.

`minimize` is the entry point. It runs a kernel if the measurements are ranges only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, Solution, minimize_pose
from rbl_gym.estimators.costs.range_cost import Index, RangeCost, pick
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import offsets

# Called without input checks: the inputs were checked before, or made here.
_ERROR = kernel(rotations.error)
_LEFT_JACOBIAN_INVERSE = kernel(rotations.left_jacobian_inverse)


class PoseState(NamedTuple):
    """Pose and covariance, (..., 3, 3), (..., 3), (..., 6, 6) of the error (w, v)."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray


class Cost(Protocol):
    """Cost of measurements: callable on poses, with arrays that can be indexed."""

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at poses."""
        ...

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> Cost:
        """Apply a function of (array, number of trailing axes) to the arrays of the cost."""
        ...


@dataclass(frozen=True, eq=False)
class MapProblem:
    """Maximum a posteriori pose of one epoch; arrays with leading batch axes.

    `data` is the cost of the measurements (`RangeCost`, `doa_cost.DoaCost`, or a sum of costs). The
    cost is that of the measurements plus half the squared Mahalanobis distance to the prior, with
    residual ``(log(Q Q_pred^T), t - t_pred)``.
    """

    prior: PoseState
    prior_information: FloatArray
    data: Cost

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian by the pose error (w, v)."""
        of_data = self.data(rotation, translation)
        turn = _ERROR(rotation, self.prior.rotation)
        shift = translation - self.prior.translation
        error, D = pose_error(turn, shift)
        pull = (self.prior_information @ error[..., None])[..., 0]
        transposed = np.swapaxes(D, -1, -2)
        return Linearization(
            of_data.cost + 0.5 * np.einsum("...i,...i->...", error, pull),
            of_data.gradient + (transposed @ pull[..., None])[..., 0],
            of_data.hessian + transposed @ self.prior_information @ D,
        )

    def take(self, batch: tuple[int, ...], where: Index) -> MapProblem:
        """Return the trials (K, 1) at an index into the batch, with an axis of 1 for starts."""

        def some(array: FloatArray, trailing: int) -> FloatArray:
            return pick(array, batch, where, trailing)[:, None]

        prior = PoseState(
            some(self.prior.rotation, 2), some(self.prior.translation, 1),
            some(self.prior.covariance, 2),
        )  # fmt: skip
        return MapProblem(prior, some(self.prior_information, 2), self.data.each(some))


def pose_error(turn: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the error (..., 6) of a pose, and its derivative ``blkdiag(Jl^-1, I)`` by (w, v)."""
    shape = np.broadcast_shapes(turn.shape, shift.shape)
    error = np.concatenate([np.broadcast_to(turn, shape), np.broadcast_to(shift, shape)], axis=-1)
    D = np.zeros((*shape[:-1], 6, 6))
    D[..., :3, :3] = _LEFT_JACOBIAN_INVERSE(turn)
    D[..., 3:, 3:] = np.eye(3)
    return error, D


def map_problem(state: PoseState, data: Cost) -> MapProblem:
    """Return the problem of an update from a prior and the cost of the measurements."""
    return MapProblem(state, positive_inverse(state.covariance), data)


def minimize(
    problem: MapProblem | Cost,
    rotation: FloatArray,
    translation: FloatArray,
    iterations: int,
    tolerance: float = 1e-6,
) -> Solution:
    """Run `minimize_pose` on a problem, or a kernel if the measurements are ranges only."""
    prior, information, data = _NO_PRIOR, _NOTHING, problem
    if isinstance(problem, MapProblem):
        prior, information, data = problem.prior, problem.prior_information, problem.data
    if not isinstance(data, RangeCost) or data.tag_unit is not None:
        return minimize_pose(problem, rotation, translation, iterations, tolerance)
    found = minimize_ranges(
        rotation, translation, prior.rotation, prior.translation, information,
        data.ranges, data.weights, data.anchors, data.tags, data.loss,
        offsets.code_of(data.offset), iterations, tolerance,
    )  # fmt: skip
    return Solution(found[0], found[1], Linearization(*found[2:5]), found[5])


_NO_PRIOR = PoseState(np.eye(3), np.zeros(3), np.eye(6))
_NOTHING = np.zeros((6, 6))


@compiled("pose_solver:minimize")
def minimize_ranges(
    start_rotation: FloatArray,
    start_translation: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    information: FloatArray,
    ranges: FloatArray,
    weights: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    loss: FloatArray,
    offset: int,
    iterations: int,
    tolerance: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return the most likely pose near a start, from ranges and a prior of information (..., 6, 6).

    `offset` is the code of the kind of range offsets (`offsets.code_of`).

    Returns
    -------
    Rotation, translation, cost, gradient, Hessian, and whether it converged; see `Solution`.
    """
    prior, kind = PoseState(rotation, translation, information), offsets.name_of(offset)
    problem = MapProblem(
        prior, information, RangeCost(ranges, weights, anchors, tags, loss, offset=kind)
    )
    found = minimize_pose(problem, start_rotation, start_translation, iterations, tolerance)
    cost, gradient, hessian = found.at
    return found.rotation, found.translation, cost, gradient, hessian, found.converged


def positive_inverse(matrix: FloatArray) -> FloatArray:
    """Invert symmetric positive definite matrices (..., n, n); NaN for others.

    The units of the rows do not matter: the test uses the smallest eigenvalue of the matrix scaled
    to unit diagonal.
    """
    n = matrix.shape[-1]
    diagonal = np.einsum("...ii->...i", matrix)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    outer = scale[..., :, None] * scale[..., None, :]
    unit = matrix / outer
    known = np.isfinite(unit).all(axis=(-2, -1), keepdims=True)
    good = known & (np.linalg.eigvalsh(np.where(known, unit, np.eye(n)))[..., :1, None] > 1e-14)
    inverse = np.linalg.inv(np.where(good, unit, np.eye(n))) / outer
    return np.where(good, 0.5 * (inverse + np.swapaxes(inverse, -1, -2)), np.nan)
