"""The iterated EKF of a pose and of the places of anchors that are known to centimetres.

What a survey is off is the same at every epoch: taken for noise of the ranges, it makes a filter
overconfident, as the errors of one epoch do not average out over the next. Here the anchors'
places are states beside the pose, whose prior is the survey.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import bounds
from rbl_gym.bounds.information import anchor_deviations
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.costs import bias_cost
from rbl_gym.estimators.costs.bias_cost import AugmentedState
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.estimators.iekf.augmented import LOSSES, AugmentedEkf
from rbl_gym.estimators.iekf.pose_steps import as_state
from rbl_gym.estimators.inputs import check_batches, check_epoch, epoch_variance, plain
from rbl_gym.measurements import ranging
from rbl_gym.measurements.ranging import NoiseLaw

# How often the derivative by the places is taken: at the prior, and at what follows from it.
_PASSES = 2


@dataclass(frozen=True, eq=False)
class SurveyedEkf(AugmentedEkf):
    """Iterated extended Kalman filter of the pose and of its anchors' places.

    The extra states (3 M) are the true place of each anchor less the one that an update tells.

    Parameters
    ----------
    pose, twist, sensor
        As `AugmentedEkf`.
    biases
        Empty.
    anchor_std_m
        Standard deviation of the told places: one, one for each anchor (M,), or for each of their
        axes (M, 3).
    """

    anchor_std_m: ArrayLike = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.biases:
            raise ValueError(f"biases must be empty beside anchor_std_m, got {self.biases!r:.80}")
        anchor_deviations(self.anchor_std_m, (*np.shape(self.anchor_std_m), 1)[0])

    @functools.cached_property
    def _laws(self) -> FloatArray:
        """To a prediction the places are biases that stay."""
        return np.array([[0.0, math.inf, 0.0]])

    def update(
        self,
        state: AugmentedState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> AugmentedState:
        """State after one epoch of ranges (..., M, N) to anchors at told places (..., M, 3).

        Other arguments as `IteratedEkf`. Every update must name the same anchors in the same
        order; they may move, each with the same error all the time.

        Raises
        ------
        ValueError
            As `IteratedEkf.update`, and where the number of anchors changes.
        """
        state, tags = plain(state), self.pose.tags
        signed = self.offset is not None
        ranges, anchors, mask = check_epoch(ranges, anchors, links, tags, signed=signed)
        check_batches(state=state.translation.shape[:-1], ranges=ranges.shape[:-2])
        state = self._with_places(state, anchors.shape[-2])
        places = anchors + self._off(state.extra)
        pose = PoseState(state.rotation, state.translation, state.covariance[..., :6, :6])
        distance = ranging.distances(places, ranging.tag_positions(*pose[:2], tags))
        ranges, distance = np.broadcast_arrays(ranges, distance)
        there = np.broadcast_to(True if mask is None else mask, ranges.shape)
        variance = epoch_variance(noise, self.pose.noise, distance if signed else ranges, mask)
        # A start is sought as if the survey's errors were noise of the ranges.
        own = np.diagonal(state.covariance, axis1=-2, axis2=-1)[..., 6 + self._n_twist :]
        spread = own.reshape((*own.shape[:-1], -1, 3)).mean(axis=-1)[..., None]
        seen = np.where(there, 1 / (variance + spread), 0.0)
        at = self.pose.start(pose, ranges, seen, places)
        weights = np.where(there, 1 / variance, 0.0)
        found = state
        for _ in range(_PASSES):
            # The extra states are told from where their derivative is taken.
            point = np.zeros_like(found.extra)
            point[..., self._n_twist :] = found.extra[..., self._n_twist :]
            prior = state._replace(extra=state.extra - point)
            found = AugmentedState(
                *bias_cost.update_any(
                    *prior, ranges, weights, places, tags, *at, pose.covariance,
                    self.pose.iterations, LOSSES[self.pose.robust], self._n_twist, self.offset,
                    self._sums(places, *at),
                )
            )  # fmt: skip
            found = found._replace(extra=found.extra + point)
            at = found.rotation, found.translation
            places = anchors + self._off(found.extra)
        as_state(*found[:2], found.covariance)
        return found

    def biases_of(
        self, state: AugmentedState, anchors: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As `AugmentedEkf.biases_of`: innovations are judged as if the told places were right."""
        state, n = plain(state), self._n_twist
        less = state.extra[..., :n], state.covariance[..., : 6 + n, : 6 + n]
        return super().biases_of(AugmentedState(state.rotation, state.translation, *less), anchors)

    def _off(self, extra: FloatArray) -> FloatArray:
        """True places less told ones (..., M, 3), of extra states."""
        off = extra[..., self._n_twist :]
        return off.reshape((*off.shape[:-1], -1, 3))

    def _sums(
        self, anchors: FloatArray, rotation: FloatArray, translation: FloatArray
    ) -> FloatArray:
        """By how much the extra states lengthen every range at a pose, (..., M N, K)."""
        distance, J = bounds.range_jacobian(anchors, self.pose.tags, rotation, translation)
        M, N = distance.shape[-2:]
        unit = J[..., 3:, :].reshape((*J.shape[:-2], 3, M, N))
        own = -np.einsum("...imn,ml->...mnli", unit, np.eye(M))
        columns = own.reshape((*own.shape[:-4], M * N, 3 * M))
        nothing = np.zeros((*columns.shape[:-1], self._n_twist))
        return np.concatenate([nothing, columns], axis=-1)

    def _with_places(self, state: AugmentedState, anchors: int) -> AugmentedState:
        """The state with room for the places of so many anchors."""
        have = state.extra.shape[-1] - self._n_twist
        if have == 3 * anchors:
            return state
        if have:
            raise ValueError(
                f"anchors must be the {have // 3} whose places the state holds, got {anchors}"
            )
        std = anchor_deviations(self.anchor_std_m, anchors)
        std = np.zeros((anchors, 3)) if std is None else std
        n, batch = state.covariance.shape[-1], state.extra.shape[:-1]
        P = np.zeros((*batch, n + 3 * anchors, n + 3 * anchors))
        P[..., :n, :n] = state.covariance
        P[..., range(n, n + 3 * anchors), range(n, n + 3 * anchors)] = std.ravel() ** 2
        extra = np.concatenate([state.extra, np.zeros((*batch, 3 * anchors))], axis=-1)
        return state._replace(extra=extra, covariance=P)
