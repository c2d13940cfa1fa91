"""The iterated EKF of a pose and of anchor positions with survey errors.

Survey errors are the same at every epoch. If they are treated as range noise, the filter becomes
overconfident, because they do not average out over epochs. Here the anchor positions are states
besides the pose, and the survey is their prior.
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

# Number of linearisations by the positions: at the prior, and at the resulting pose.
_PASSES = 2


@dataclass(frozen=True, eq=False)
class SurveyedEkf(AugmentedEkf):
    """Iterated extended Kalman filter of the pose and of the anchor positions.

    The extra states (3 M) are the true position of each anchor minus the one given in an update.

    Parameters
    ----------
    pose, twist, sensor
        As in `AugmentedEkf`.
    biases
        Empty.
    anchor_std_m
        Standard deviation of the given positions: one, one per anchor (M,), or one per axis
        (M, 3).
    """

    anchor_std_m: ArrayLike = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.biases:
            raise ValueError(f"biases must be empty with anchor_std_m, got {self.biases!r:.80}")
        anchor_deviations(self.anchor_std_m, (*np.shape(self.anchor_std_m), 1)[0])

    @functools.cached_property
    def _laws(self) -> FloatArray:
        """Return the laws for a prediction: positions are constant biases."""
        return np.array([[0.0, math.inf, 0.0]])

    def update(
        self,
        state: AugmentedState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> AugmentedState:
        """Return the state after ranges (..., M, N) to anchors at given positions (..., M, 3).

        Other arguments as in `IteratedEkf`. Every update must have the same anchors in the same
        order. They may move, but the error of each must be constant.

        Raises
        ------
        ValueError
            As in `IteratedEkf.update`, and if the number of anchors changes.
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
        # The search for a start treats survey errors as range noise.
        own = np.diagonal(state.covariance, axis1=-2, axis2=-1)[..., 6 + self._n_twist :]
        spread = own.reshape((*own.shape[:-1], -1, 3)).mean(axis=-1)[..., None]
        seen = np.where(there, 1 / (variance + spread), 0.0)
        at = self.pose.start(pose, ranges, seen, places)
        weights = np.where(there, 1 / variance, 0.0)
        found = state
        for _ in range(_PASSES):
            # The extra states are relative to the point of linearisation.
            point = np.zeros_like(found.extra)
            point[..., self._n_twist :] = found.extra[..., self._n_twist :]
            prior = state._replace(extra=state.extra - point)
            found = AugmentedState(
                *bias_cost.update_augmented.textbook(
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
        """See `AugmentedEkf.biases_of`; innovations treat the given positions as true."""
        state, n = plain(state), self._n_twist
        less = state.extra[..., :n], state.covariance[..., : 6 + n, : 6 + n]
        return super().biases_of(AugmentedState(state.rotation, state.translation, *less), anchors)

    def _off(self, extra: FloatArray) -> FloatArray:
        """Return true minus given positions (..., M, 3) from the extra states."""
        off = extra[..., self._n_twist :]
        return off.reshape((*off.shape[:-1], -1, 3))

    def _sums(
        self, anchors: FloatArray, rotation: FloatArray, translation: FloatArray
    ) -> FloatArray:
        """Return the derivative (..., M N, K) of ranges at a pose by the extra states."""
        distance, J = bounds.range_jacobian(anchors, self.pose.tags, rotation, translation)
        M, N = distance.shape[-2:]
        unit = J[..., 3:, :].reshape((*J.shape[:-2], 3, M, N))
        own = -np.einsum("...imn,ml->...mnli", unit, np.eye(M))
        columns = own.reshape((*own.shape[:-4], M * N, 3 * M))
        nothing = np.zeros((*columns.shape[:-1], self._n_twist))
        return np.concatenate([nothing, columns], axis=-1)

    def _with_places(self, state: AugmentedState, anchors: int) -> AugmentedState:
        """Return the state extended by the positions of the anchors."""
        have = state.extra.shape[-1] - self._n_twist
        if have == 3 * anchors:
            return state
        if have:
            raise ValueError(
                f"the number of anchors must stay {have // 3}, as the state has a position of "
                f"each, got {anchors}"
            )
        std = anchor_deviations(self.anchor_std_m, anchors)
        std = np.zeros((anchors, 3)) if std is None else std
        return bias_cost.extended(state, np.diag(std.ravel() ** 2))
