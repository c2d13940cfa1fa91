"""Pose update from ranges with biases: eliminate the biases, then recover them from the pose.

Let x be the states besides the pose, and e the pose error in the chart of the prior. The prior is
``x = x0 + G e + N(0, C)``, ``G = P_xp P_pp^-1``. The ranges are ``d(pose) + S x + noise``, where S
sums the biases of every link. Given the pose, ``nu = r - d - S (x0 + G e)`` has covariance
``S C S^T + R``. Its inverse is a dense weight on the ranges, constant over the iterations.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, Solution, minimize_pose
from rbl_gym.estimators.costs.losses import loss_of
from rbl_gym.estimators.costs.map_problem import positive_inverse
from rbl_gym.estimators.costs.unseen_directions import kept_wide
from rbl_gym.estimators.filter import inverse
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import offsets

# Called without input checks: the inputs were checked before, or made here.
_ERROR = kernel(rotations.error)
_LEFT_JACOBIAN_INVERSE = kernel(rotations.left_jacobian_inverse)
# Weights that change by no more than this between two poses count as equal.
_SAME_SHARE = 0.01


class AugmentedState(NamedTuple):
    """Pose, extra states, and the covariance of all errors, with leading batch axes.

    Attributes
    ----------
    rotation, translation
        (..., 3, 3) and (..., 3).
    extra
        (..., K): the twist (6) if it is unknown, then for each bias model the biases of the M N
        links, in the order of the anchors. There are no biases before the first ranges, which fix
        M.
    covariance
        (..., 6 + K, 6 + K) of ``(w, v)`` and the errors of the extra states, estimate minus truth.
    """

    rotation: FloatArray
    translation: FloatArray
    extra: FloatArray
    covariance: FloatArray


def extended(state: AugmentedState, *blocks: FloatArray) -> AugmentedState:
    """Return the state with further extra states of zero; a covariance (n, n) for each block."""
    n = state.covariance.shape[-1]
    batch, ends = state.extra.shape[:-1], np.cumsum([n, *map(len, blocks)])
    P = np.zeros((*batch, ends[-1], ends[-1]))
    P[..., :n, :n] = state.covariance
    for block, end in zip(blocks, ends[1:], strict=True):
        P[..., end - len(block) : end, end - len(block) : end] = block
    extra = np.concatenate([state.extra, np.zeros((*batch, ends[-1] - n))], axis=-1)
    return state._replace(extra=extra, covariance=P)


@dataclass(frozen=True, eq=False)
class BiasProblem:
    """Maximum a posteriori pose of one epoch of ranges with biases; leading batch axes.

    The prior has the pose, the inverse covariance of the pose `information` (..., 6, 6), x0 (...,
    K), G (..., K, 6), C (..., K, K), and `sums` S (..., L, K), the derivative of the ranges by the
    extra states. `ranges`, `variance`, `links` (..., L) are of the L = M N links, in metres and
    m^2. `weight` (..., L, L) is the inverse covariance of nu; it is zero for missing links, and
    common offsets are projected out. `offset` is their kind, as in `measurements.offsets`, or None.
    """

    rotation: FloatArray
    translation: FloatArray
    information: FloatArray
    extra: FloatArray
    gain: FloatArray
    spread: FloatArray
    sums: FloatArray
    ranges: FloatArray
    variance: FloatArray
    links: BoolArray
    anchors: FloatArray
    tags: FloatArray
    weight: FloatArray
    offset: str | None = None

    def innovation(
        self, rotation: FloatArray, translation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return nu (..., L), H = -dnu (..., L, 6), e (..., 6), and D = de (..., 6, 6)."""
        turn = _ERROR(rotation, self.rotation)
        e = np.concatenate([turn, translation - self.translation], axis=-1)
        D = np.zeros((*turn.shape[:-1], 6, 6))
        D[..., :3, :3] = _LEFT_JACOBIAN_INVERSE(turn)
        D[..., 3:, 3:] = np.eye(3)
        distance, J = bounds.range_jacobian(self.anchors, self.tags, rotation, translation)
        distance = distance.reshape((*distance.shape[:-2], -1))
        nu = np.where(self.links, self._unbiased - distance - _times(self._slope, e), 0.0)
        H = np.swapaxes(J, -1, -2) + self._slope @ D
        return nu, H, e, D

    @functools.cached_property
    def _unbiased(self) -> FloatArray:
        """Return the ranges less the biases expected at the prior pose."""
        return self.ranges - _times(self.sums, self.extra)

    @functools.cached_property
    def _slope(self) -> FloatArray:
        """Return the derivative (..., L, 6) of the expected biases by the pose."""
        return self.sums @ self.gain

    @functools.cached_property
    def _own(self) -> FloatArray:
        """Return the covariance (..., L, L) of the biases given the pose."""
        return self.sums @ self.spread @ np.swapaxes(self.sums, -1, -2)

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian by the pose error (w, v)."""
        nu, H, e, D = self.innovation(rotation, translation)
        Wnu, pull = _times(self.weight, nu), _times(self.information, e)
        cost = 0.5 * np.einsum("...i,...i->...", nu, Wnu)
        cost = cost + 0.5 * np.einsum("...i,...i->...", e, pull)
        transposed = np.swapaxes(H, -1, -2), np.swapaxes(D, -1, -2)
        gradient = _times(transposed[1], pull) - _times(transposed[0], Wnu)
        hessian = transposed[1] @ self.information @ D + transposed[0] @ self.weight @ H
        return Linearization(cost, gradient, hessian)

    def weighed(self, share: FloatArray) -> BiasProblem:
        """Return the problem with its `weight`, where each link keeps a `share` (..., L)."""
        S = self._own
        n = S.shape[-1]
        own = np.diagonal(S, axis1=-2, axis2=-1)
        S = S + ((own + self.variance) / share - own)[..., None] * np.eye(n)
        both = self.links[..., None] & self.links[..., None, :]
        weight = np.where(both, inverse(np.where(both, S, np.eye(n))), 0.0)
        if self.offset is not None:
            # W - W U (U^T W U)^-1 U^T W: U maps offsets to links.
            U = offsets.columns(self.offset, self.anchors.shape[-2], self.tags.shape[-2])
            taken = weight @ U
            total = U.T @ taken
            empty = np.diagonal(total, axis1=-2, axis2=-1)[..., None] == 0
            total = total + np.where(empty, np.eye(U.shape[1]), 0.0)
            weight = weight - taken @ np.linalg.solve(total, np.swapaxes(taken, -1, -2))
        return dataclasses.replace(self, weight=weight)

    def shares(
        self,
        rotation: FloatArray,
        translation: FloatArray,
        loss: FloatArray,
        P: FloatArray | None = None,
    ) -> FloatArray:
        """Return weights (..., L) by a loss of the innovations at a pose of covariance P or 0."""
        nu, H, _, _ = self.innovation(rotation, translation)
        if self.offset is not None:
            grid = (*nu.shape[:-1], self.anchors.shape[-2], self.tags.shape[-2])
            common = offsets.median(nu.reshape(grid), self.links.reshape(grid), self.offset)
            nu = nu - np.broadcast_to(common, grid).reshape(nu.shape)
        variance = np.diagonal(self._own, axis1=-2, axis2=-1) + self.variance
        if P is not None:
            variance = variance + np.einsum("...la,...ab,...lb->...l", H, P, H)
        return loss_of((nu**2 / variance)[..., None], loss, (nu > 0)[..., None])[1][..., 0]


@compiled("augmented_filter:update")
def update_augmented(
    rotation: FloatArray,
    translation: FloatArray,
    extra: FloatArray,
    covariance: FloatArray,
    ranges: FloatArray,
    weights: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    start_rotation: FloatArray,
    start_translation: FloatArray,
    start_covariance: FloatArray,
    iterations: int,
    loss: FloatArray,
    n_twist: int,
    offset: str | None = None,
    sums: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the most likely pose of an epoch near a start, and the other states given it.

    Parameters
    ----------
    rotation, translation, extra, covariance
        The prior, as in `AugmentedState`.
    ranges, weights, anchors, tags
        As in `RangeCost`; the variances exclude the biases.
    start_rotation, start_translation, start_covariance
        Start of Gauss-Newton, and its covariance. The weights of the loss are evaluated there, and
        once more at the resulting pose.
    iterations
        Maximum number of Gauss-Newton iterations.
    loss
        (5,), of the innovations whitened by their full covariance.
    n_twist
        Number of extra states that are not biases.
    offset
        Which ranges share an unknown offset; the kernel does not take it.
    sums
        (..., M N, K), the derivative of the ranges by the extra states, if these are not biases of
        single links; the kernel does not take it.

    Returns
    -------
    The fields of the state. The covariance is NaN if the information about the pose is not
    positive definite.
    """
    n_links = ranges.shape[-2] * ranges.shape[-1]
    if sums is None:
        sums = sums_of(n_twist, (extra.shape[-1] - n_twist) // n_links, n_links)
    batch = np.broadcast_shapes(
        extra.shape[:-1], ranges.shape[:-2], weights.shape[:-2], anchors.shape[:-2]
    )
    state = AugmentedState(
        *(
            np.broadcast_to(field, (*batch, *field.shape[field.ndim - n :]))
            for field, n in zip(
                (rotation, translation, extra, covariance), (2, 1, 1, 2), strict=True
            )
        )
    )
    links = weights > 0
    problem = _problem(state, sums, ranges, weights, anchors, tags)
    problem = dataclasses.replace(problem, offset=offset)
    start = start_rotation, start_translation
    share = problem.shares(*start, loss, start_covariance)
    problem = problem.weighed(share)
    found = minimize_pose(problem, *start, iterations=iterations)
    again = problem.shares(found.rotation, found.translation, loss)
    changed = (np.abs(again - share) > _SAME_SHARE) & problem.links
    if changed.any():
        changed = np.asarray(changed.any(axis=-1))
        second = problem.weighed(np.where(changed[..., None], again, share))
        better = minimize_pose(second, found.rotation, found.translation, iterations)
        found, problem = _chosen(changed, better, found), second
    return _solved(problem, found, np.asarray(links.any(axis=-2)))


def sums_of(n_twist: int, n_laws: int, links: int) -> FloatArray:
    """Return S (links, K), which adds up the biases of each link."""
    return np.concatenate([np.zeros((links, n_twist)), *[np.eye(links)] * n_laws], axis=1)


def _problem(
    state: AugmentedState,
    sums: FloatArray,
    ranges: FloatArray,
    weights: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
) -> BiasProblem:
    """Return the problem of ranges and weights (..., M, N), for a state of the same batch."""
    ranges, weights = (a.reshape((*a.shape[:-2], -1)) for a in (ranges, weights))
    links = weights > 0
    P = state.covariance
    information = positive_inverse(P[..., :6, :6])
    gain = P[..., 6:, :6] @ information
    return BiasProblem(
        state.rotation, state.translation, information, state.extra, gain,
        P[..., 6:, 6:] - gain @ P[..., :6, 6:], sums, np.where(links, ranges, 0.0),
        1 / np.where(links, weights, 1.0), links, anchors, tags, weight=np.zeros(()),
    )  # fmt: skip


def _chosen(where: BoolArray, first: Solution, second: Solution) -> Solution:
    """Return the first solution for some trials (...), the second for the others."""
    at = Linearization(
        np.where(where, first.at.cost, second.at.cost),
        np.where(where[..., None], first.at.gradient, second.at.gradient),
        np.where(where[..., None, None], first.at.hessian, second.at.hessian),
    )
    return Solution(
        np.where(where[..., None, None], first.rotation, second.rotation),
        np.where(where[..., None], first.translation, second.translation),
        at,
        np.where(where, first.converged, second.converged),
    )


def _solved(
    problem: BiasProblem, found: Solution, heard: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the fields of the state at the solution; `heard` (..., N): tags with any link."""
    rotation, translation = found.rotation, found.translation
    nu, H, e, D = problem.innovation(rotation, translation)
    # Covariance of the extra states: given the pose, then from the pose.
    gain = problem.spread @ np.swapaxes(problem.sums, -1, -2) @ problem.weight
    slope = problem.gain @ D - gain @ H
    pose = kept_wide(
        AugmentedState(
            problem.rotation,
            problem.translation,
            problem.extra,
            positive_inverse(problem.information),
        ),
        AugmentedState(rotation, translation, problem.extra, positive_inverse(found.at.hessian)),
        heard,
        problem.tags,
    ).covariance
    K = problem.extra.shape[-1]
    P = np.empty((*nu.shape[:-1], 6 + K, 6 + K))
    P[..., :6, :6] = pose
    P[..., 6:, :6] = slope @ pose
    P[..., :6, 6:] = np.swapaxes(P[..., 6:, :6], -1, -2)
    left = problem.spread - gain @ problem.sums @ problem.spread
    P[..., 6:, 6:] = bounds.symmetric(left + P[..., 6:, :6] @ np.swapaxes(slope, -1, -2))
    extra = problem.extra + _times(problem.gain, e) + _times(gain, nu)
    return np.array(rotation), np.array(translation), extra, P


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    return (matrix @ vector[..., None])[..., 0]
