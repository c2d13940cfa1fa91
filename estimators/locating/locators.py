"""Methods of `locate`: functions of a flat `StaticEpoch` that return a `Fit`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.bounds.pose import regular_inverse
from rbl_gym.checks import BoolArray, FloatArray, are_finite
from rbl_gym.estimators.costs.levenberg_marquardt import Solution
from rbl_gym.estimators.costs.map_problem import minimize
from rbl_gym.estimators.costs.range_cost import RangeCost
from rbl_gym.estimators.linear import least_squares
from rbl_gym.estimators.linear.squared_range import Statistic, information, statistic
from rbl_gym.estimators.linear.unitary import state_jacobian
from rbl_gym.estimators.locating.maximum_likelihood import (
    Alternatives,
    linear_start,
    maximum_likelihood,
    no_alternatives,
)
from rbl_gym.estimators.locating.robust_location import robust, robust_late
from rbl_gym.estimators.locating.rotation_net import ROTATION_NET
from rbl_gym.geometry import rotations

# A matrix with unit diagonal and at least this determinant has no eigenvalue below 1e-12.
_REGULAR = 1e-12 * 6**5


class StaticEpoch(NamedTuple):
    """Checked arrays of B trials: ranges (B, M, N), anchors (B, M, 3), tags (B, N, 3).

    `weights` (B, M, N) are inverse variances of the ranges, 0 for missing links. `squared_weights`
    are inverse variances of the squared ranges, (B, M, 1) if common to the tags. `tag_std_m` is the
    standard deviation of the tag positions, `retraction` the retraction of Newton's method in
    ``procrustes``, and `offset` the kind of unknown range offset.
    """

    ranges: FloatArray
    anchors: FloatArray
    tags: FloatArray
    weights: FloatArray
    squared_weights: FloatArray
    tag_std_m: float
    retraction: str = "exponential"
    offset: str | None = None

    @property
    def stat(self) -> Statistic:
        """Return the statistic of the squared ranges."""
        offset = self.offset is not None
        return statistic(self.ranges, self.anchors, self.tags, self.squared_weights, pseudo=offset)


class Fit(NamedTuple):
    """Result of a method, (B, ...): pose, covariance, convergence and optional fields."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    converged: BoolArray
    cost: FloatArray | None = None
    information: FloatArray | None = None
    alternatives: Alternatives | None = None
    matrix: FloatArray | None = None
    iterations: np.ndarray | None = None


def _ls(epoch: StaticEpoch) -> Fit:
    stat = epoch.stat
    matrix, translation = least_squares.linear_fit(stat)
    rotation = _nearest(matrix)
    pinv = np.swapaxes(state_jacobian(rotation), -1, -2) * np.array([0.5] * 3 + [1.0] * 3)[:, None]
    covariance = _propagated(pinv, stat)
    return _linear(rotation, translation, covariance, matrix)


def _ls_projected(epoch: StaticEpoch) -> Fit:
    stat = epoch.stat
    matrix, _ = least_squares.linear_fit(stat)
    rotation = _nearest(matrix)
    translation = least_squares.translation_fit(stat, rotation)
    # w = Jq^+ dq, v = dt + K (dq - Jq w), K = I_tt^-1 I_tq of the linear information.
    J = state_jacobian(rotation)[:, :9, :3]
    info, _ = information(stat)
    K = np.linalg.solve(least_squares.loaded(info[:, 9:, 9:]), info[:, 9:, :9])
    T = np.zeros((len(rotation), 6, 12))
    T[:, :3, :9] = 0.5 * np.swapaxes(J, -1, -2)
    T[:, 3:, :9] = K - K @ J @ T[:, :3, :9]
    T[:, 3:, 9:] = np.eye(3)
    return _linear(rotation, translation, _propagated(T, stat))


def _cls(epoch: StaticEpoch) -> Fit:
    stat = epoch.stat
    rotation, translation = least_squares.points_fit(stat)
    # Unweighted fit of points: (J^T J)^-1 (sum J_n^T S_n J_n) (J^T J)^-1, S_n = G_n^-1.
    regular = bounds.information_rank(stat.G) == 3
    safe = np.where(regular[..., None, None], stat.G, np.eye(3))
    known = np.broadcast_to(regular, epoch.tags.shape[:-1])[..., None, None]
    J = (
        bounds.tag_jacobian(np.where(np.isfinite(rotation), rotation, np.eye(3)), epoch.tags)
        * known
    )
    stacked = J.reshape(len(J), -1, 6)
    spread = np.linalg.inv(least_squares.loaded(np.swapaxes(stacked, 1, 2) @ stacked))
    middle = bounds.lift(J, np.broadcast_to(np.linalg.inv(safe), (*J.shape[:2], 3, 3)))
    return _linear(rotation, translation, spread @ middle @ spread)


def _procrustes(epoch: StaticEpoch) -> Fit:
    stat = epoch.stat
    first, _ = least_squares.points_fit(stat)
    first = np.where(np.isfinite(first), first, np.eye(3))[:, None]
    net = np.broadcast_to(ROTATION_NET, (len(first), 24, 3, 3))
    starts = np.concatenate([first, net], axis=1)
    rotation, translation = least_squares.procrustes_fit(stat, starts, epoch.retraction)
    G = np.broadcast_to(stat.G, (*epoch.tags.shape[:2], 3, 3))
    covariance = covariance_of(bounds.lift(bounds.tag_jacobian(rotation, epoch.tags), G))
    return _linear(rotation, translation, covariance)


def _ml(epoch: StaticEpoch) -> Fit:
    cost = _range_cost(epoch)
    return _from_solution(*maximum_likelihood(cost, *linear_start(cost), epoch.tag_std_m))


def _two_step(epoch: StaticEpoch) -> Fit:
    rotation, translation = least_squares.points_fit(epoch.stat)
    usable = are_finite(translation, 1)
    solution = minimize(
        _range_cost(epoch),
        np.where(usable[:, None, None], rotation, np.eye(3)),
        np.where(usable[:, None], translation, 0.0),
        iterations=2,
    )
    blank = np.where(usable, 1.0, np.nan)
    return _from_solution(
        solution._replace(
            rotation=solution.rotation * blank[:, None, None],
            translation=solution.translation * blank[:, None],
            converged=usable,
        ),
        no_alternatives(len(usable)),
    )


def _robust(epoch: StaticEpoch) -> Fit:
    cost = _range_cost(epoch)
    return _from_solution(*robust(cost, *linear_start(cost)))


def _robust_late(epoch: StaticEpoch) -> Fit:
    cost = _range_cost(epoch)
    return _from_solution(*robust_late(cost, *linear_start(cost)))


def _range_cost(epoch: StaticEpoch) -> RangeCost:
    return RangeCost(epoch.ranges, epoch.weights, epoch.anchors, epoch.tags, offset=epoch.offset)


def _from_solution(solution: Solution, alternatives: Alternatives) -> Fit:
    return Fit(
        solution.rotation,
        solution.translation,
        covariance_of(solution.at.hessian),
        solution.converged,
        solution.at.cost,
        solution.at.hessian,
        alternatives,
    )


def _linear(
    rotation: FloatArray,
    translation: FloatArray,
    covariance: FloatArray,
    matrix: FloatArray | None = None,
) -> Fit:
    found = are_finite(translation, 1) & are_finite(rotation, 2)
    return Fit(rotation, translation, covariance, found, matrix=matrix)


def _nearest(matrix: FloatArray) -> FloatArray:
    known = are_finite(matrix, 2)[:, None, None]
    return np.where(known, rotations.nearest(np.where(known, matrix, np.eye(3))), np.nan)


def _propagated(T: FloatArray, stat: Statistic) -> FloatArray:
    """Return ``T I^-1 T^T`` with the information of the 12 linear states."""
    info, _ = information(stat)
    return bounds.symmetric(T @ np.linalg.solve(least_squares.loaded(info), np.swapaxes(T, -1, -2)))


def covariance_of(hessian: FloatArray) -> FloatArray:
    """Invert information (..., 6, 6); undetermined directions get 1e12 of the rest."""
    inverse, regular = regular_inverse(hessian, _REGULAR)
    if not regular.all():
        inverse[~regular] = _wide_covariance(hessian[~regular])
    return inverse


def _wide_covariance(hessian: FloatArray) -> FloatArray:
    """Return `covariance_of` by eigenvalues, at least 1e-12 for a matrix with unit diagonal."""
    scale = np.sqrt(np.maximum(np.diagonal(hessian, axis1=-2, axis2=-1), 0.0))
    largest = scale.max(axis=-1, keepdims=True)
    scale = np.where(scale > 1e-9 * largest, scale, np.where(largest > 0, largest, 1.0))
    outer = scale[..., :, None] * scale[..., None, :]
    values, vectors = np.linalg.eigh(hessian / outer)
    inverse = vectors / np.maximum(values, 1e-12)[..., None, :] @ np.swapaxes(vectors, -1, -2)
    return bounds.symmetric(inverse / outer)


METHODS: dict[str, Callable[[StaticEpoch], Fit]] = {
    "ls": _ls,
    "ls-projected": _ls_projected,
    "cls": _cls,
    "ctls": _cls,
    "procrustes": _procrustes,
    "uc-ls": _procrustes,
    "two-step": _two_step,
    "ml": _ml,
    "robust": _robust,
    "robust-late": _robust_late,
}
