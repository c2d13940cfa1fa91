"""The update of a pose whose ranges carry biases: these are eliminated, then follow from it.

With x the states besides the pose and e the pose's error in the chart of the prior, the prior
says ``x = x0 + G e + N(0, C)``, ``G = P_xp P_pp^-1``; the ranges are ``d(pose) + S x + noise``,
S summing the biases of every link. Given the pose, ``nu = r - d - S (x0 + G e)`` has covariance
``S C S^T + R``: a dense weight on the ranges, constant over the iterations.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, minimize_pose
from rbl_gym.estimators.costs.range_cost import huber, loss_of
from rbl_gym.estimators.costs.unseen_directions import kept_wide
from rbl_gym.estimators.filter import inverse
from rbl_gym.geometry import rotations


class AugmentedState(NamedTuple):
    """Pose, further states, and the covariance of all errors, with leading batch axes.

    Attributes
    ----------
    rotation, translation
        (..., 3, 3) and (..., 3).
    extra
        (..., K): the twist (6) where it is unknown, then the biases of the M N links, by anchors,
        of one law after the other (none before the first ranges have said how many anchors).
    covariance
        (..., 6 + K, 6 + K) of ``(w, v)`` and the extra states, estimate less truth.
    """

    rotation: FloatArray
    translation: FloatArray
    extra: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class BiasProblem:
    """Maximum a posteriori pose of one epoch whose ranges carry biases; leading batch axes.

    Attributes
    ----------
    rotation, translation
        The prior's.
    information
        (..., 6, 6), inverse of the prior's covariance of the pose.
    extra, gain, spread
        x0 (..., K), G (..., K, 6), C (..., K, K).
    sums
        S (L, K): of which extra states every link is biased.
    ranges, variance, links
        (..., L), metres, of the links that matter; `links` None where all were measured.
    chosen
        Which of the M N links these are, (L,), or all.
    anchors, tags
        (..., M, 3), (N, 3).
    weight
        (..., L, L), inverse covariance of nu; zero where a link is missing.
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
    links: BoolArray | None
    chosen: np.ndarray | slice
    anchors: FloatArray
    tags: FloatArray
    weight: FloatArray

    def innovation(
        self, rotation: FloatArray, translation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """nu (..., L), H = -dnu (..., L, 6), e (..., 6), and e's derivative D (..., 6, 6)."""
        turn = rotations.error(rotation, self.rotation)
        e = np.concatenate([turn, translation - self.translation], axis=-1)
        D = np.zeros((*turn.shape[:-1], 6, 6))
        D[..., :3, :3] = rotations.left_jacobian_inverse(turn)
        D[..., 3:, 3:] = np.eye(3)
        distance, J = bounds.range_jacobian(self.anchors, self.tags, rotation, translation)
        distance = distance.reshape((*distance.shape[:-2], -1))[..., self.chosen]
        nu = self._unbiased - distance - _times(self._slope, e)
        H = np.swapaxes(J[..., self.chosen], -1, -2) + self._slope @ D
        return nu, H, e, D

    @functools.cached_property
    def _unbiased(self) -> FloatArray:
        """The ranges less the biases expected at the prior's pose."""
        return self.ranges - self.extra @ self.sums.T

    @functools.cached_property
    def _slope(self) -> FloatArray:
        """By how much the expected biases (..., L, 6) change with the pose."""
        return self.sums @ self.gain

    @functools.cached_property
    def _own(self) -> FloatArray:
        """Covariance (..., L, L) of the biases given the pose."""
        return self.sums @ self.spread @ self.sums.T

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Cost, gradient and Gauss-Newton Hessian by the pose error (w, v)."""
        nu, H, e, D = self.innovation(rotation, translation)
        Wnu, pull = _times(self.weight, nu), _times(self.information, e)
        cost = 0.5 * np.einsum("...i,...i->...", nu, Wnu)
        cost = cost + 0.5 * np.einsum("...i,...i->...", e, pull)
        transposed = np.swapaxes(H, -1, -2), np.swapaxes(D, -1, -2)
        gradient = _times(transposed[1], pull) - _times(transposed[0], Wnu)
        hessian = transposed[1] @ self.information @ D + transposed[0] @ self.weight @ H
        return Linearization(cost, gradient, hessian)

    def weighed(self, share: FloatArray | None = None) -> BiasProblem:
        """The problem with its `weight`, each link of it worth a `share` (..., L) of its own."""
        S = self._own
        n = S.shape[-1]
        variance = self.variance
        if share is not None:
            own = np.diagonal(S, axis1=-2, axis2=-1)
            variance = (own + variance) / share - own
        S = S + variance[..., None] * np.eye(n)
        if self.links is None:
            return dataclasses.replace(self, weight=inverse(S))
        both = self.links[..., None] & self.links[..., None, :]
        weight = np.where(both, inverse(np.where(both, S, np.eye(n))), 0.0)
        return dataclasses.replace(self, weight=weight)

    def shares(
        self, rotation: FloatArray, translation: FloatArray, threshold: float, P: FloatArray | None
    ) -> FloatArray:
        """Huber's weights (..., L) of the innovations at a pose whose covariance is P (None: 0)."""
        nu, H, _, _ = self.innovation(rotation, translation)
        variance = np.diagonal(self._own, axis1=-2, axis2=-1) + self.variance
        if P is not None:
            variance = variance + np.einsum("...la,...ab,...lb->...l", H, P, H)
        return loss_of((nu**2 / variance)[..., None], huber(threshold))[1][..., 0]


def sums_of(n_twist: int, n_laws: int, links: int) -> FloatArray:
    """S (links, K): the biases of a link add up, whatever else the extra states hold."""
    return np.concatenate([np.zeros((links, n_twist)), *[np.eye(links)] * n_laws], axis=1)


def problem(
    state: AugmentedState,
    sums: FloatArray,
    ranges: FloatArray,
    variance: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    links: BoolArray | None,
) -> BiasProblem:
    """The problem of ranges and their variances (..., M, N), for a state of the same batch."""
    flat = (*ranges.shape[:-2], -1)
    ranges, variance = ranges.reshape(flat), variance.reshape(flat)
    chosen: np.ndarray | slice = slice(None)
    if links is not None:
        links = links.reshape((*links.shape[:-2], -1))
        if links.ndim == 1:
            # The same for all trials: what is missing need not be carried along.
            chosen, links = links.nonzero()[0], None
    P = state.covariance
    information = inverse(P[..., :6, :6])
    gain = P[..., 6:, :6] @ information
    found = BiasProblem(
        state.rotation, state.translation, information, state.extra, gain,
        P[..., 6:, 6:] - gain @ P[..., :6, 6:], sums[chosen], ranges[..., chosen],
        variance[..., chosen], links, chosen, anchors, tags, weight=np.zeros(()),
    )  # fmt: skip
    return found.weighed()


def solve(
    problem: BiasProblem,
    start: tuple[FloatArray, FloatArray],
    covariance: FloatArray | None,
    iterations: int,
    threshold: float | None,
    heard: BoolArray | np.bool_,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The fields of the state at the most likely pose near a start.

    `heard` (..., N): which tags had any link.

    Huber's weights (`threshold`; None: least squares) are taken at the start, whose pose has a
    `covariance` (..., 6, 6; None: not to be counted), and once more at the pose found from them.
    """
    if threshold is not None:
        share = problem.shares(*start, threshold, covariance)
        problem = problem.weighed(share)
    found = minimize_pose(problem, *start, iterations=iterations)
    if threshold is not None:
        again = problem.shares(found.rotation, found.translation, threshold, None)
        if (np.abs(again - share) > 0.01).any():
            problem = problem.weighed(again)
            found = minimize_pose(problem, found.rotation, found.translation, iterations)
    rotation, translation = found.rotation, found.translation
    nu, H, e, D = problem.innovation(rotation, translation)
    # Of the extra states: what the ranges tell given the pose, then what the pose tells.
    gain = problem.spread @ problem.sums.T @ problem.weight
    slope = problem.gain @ D - gain @ H
    pose = kept_wide(
        AugmentedState(
            problem.rotation, problem.translation, problem.extra, inverse(problem.information)
        ),
        AugmentedState(rotation, translation, problem.extra, inverse(found.at.hessian)),
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
