"""The iterated EKF of a pose and of clocks that drift: offsets of the ranges that last.

A white offset is eliminated in its epoch (`IteratedEkf.offset`). Where clocks are good, what one
epoch tells of an offset holds for the next: offset and drift are then states beside the pose, two
for every tag, every anchor or one pair for all, and biases of the ranges as those of links are.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number, kernel
from rbl_gym.estimators.costs import bias_cost
from rbl_gym.estimators.costs.bias_cost import AugmentedState
from rbl_gym.estimators.costs.losses import LATE, SQUARES, huber
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.estimators.filter import PoseBelief
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.iekf.pose_steps import as_state, predict_pose
from rbl_gym.estimators.inputs import check_epoch, check_one_process, epoch_variance, plain
from rbl_gym.geometry import rotations
from rbl_gym.measurements import offsets, ranging
from rbl_gym.measurements.offsets import Clock
from rbl_gym.measurements.ranging import NoiseLaw

# Behind the doors: what comes to these was checked, or made here.
_TAG_POSITIONS, _DISTANCES = kernel(ranging.tag_positions), kernel(ranging.distances)
_EXP = kernel(rotations.exp)
_LOSSES = {False: SQUARES, True: huber(1.5), "late": LATE}


@dataclass(frozen=True, eq=False)
class ClockEkf:
    """Iterated extended Kalman filter of the pose, of clocks' offsets and of their drifts.

    Parameters
    ----------
    pose
        The filter of the pose alone, without an offset.
    clock
        Law of the offsets.
    """

    pose: IteratedEkf
    clock: Clock

    def __post_init__(self) -> None:
        check_one_process(self.pose.process)
        if not isinstance(self.clock, Clock):
            raise ValueError(f"clock must be a Clock, got {self.clock!r:.80}")
        if self.pose.offset is not None:
            raise ValueError(f"offset must be None beside a clock, got {self.pose.offset!r}")

    def initial(
        self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike
    ) -> AugmentedState:
        """State of a prior of the pose, covariance (..., 6, 6); clocks come with the first ranges.

        Raises
        ------
        ValueError
            As `IteratedEkf.initial`.
        """
        pose = self.pose.initial(rotation, translation, covariance)
        extra = np.zeros((*pose.translation.shape[:-1], 0))
        return AugmentedState(pose.rotation, pose.translation, extra, pose.covariance)

    def predict(self, state: AugmentedState, twist: ArrayLike, dt: float) -> AugmentedState:
        """State after `dt` seconds of the twist (..., 6), the clocks running on."""
        dt, twist, state = (
            check_number("dt", dt, low=0.0),
            check_array("twist", twist, (6,)),
            plain(state),
        )
        variance = self.pose.process.std() ** 2
        moved = predict_pose(
            state.rotation, state.translation, state.covariance[..., :6, :6], twist, dt, variance
        )
        n = state.extra.shape[-1] // 2
        F, Q = (np.kron(a, np.eye(n)) for a in self.clock.transition(dt))
        cross = state.covariance[..., :6, 6:] @ F.T
        turn = _EXP(twist[..., :3] * dt)
        batch = moved[1].shape[:-1]
        P = np.zeros((*batch, 6 + 2 * n, 6 + 2 * n))
        P[..., :6, :6] = moved[2]
        P[..., :3, 6:], P[..., 3:6, 6:] = turn @ cross[..., :3, :], cross[..., 3:, :]
        P[..., 6:, :6] = np.swapaxes(P[..., :6, 6:], -1, -2)
        P[..., 6:, 6:] = F @ state.covariance[..., 6:, 6:] @ F.T + Q
        extra = np.broadcast_to(state.extra @ F.T, (*batch, 2 * n))
        return AugmentedState(moved[0], moved[1], extra, P)

    def update(
        self,
        state: AugmentedState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> AugmentedState:
        """State after one epoch of ranges (..., M, N) of any sign; arguments as `IteratedEkf`.

        Raises
        ------
        ValueError
            As `IteratedEkf.update`, and where the number of anchors changes under their clocks.
        """
        state = plain(state)
        pose = PoseState(state.rotation, state.translation, state.covariance[..., :6, :6])
        ranges, anchors, mask = check_epoch(ranges, anchors, links, self.pose.tags, signed=True)
        distance = _DISTANCES(anchors, _TAG_POSITIONS(*pose[:2], self.pose.tags))
        ranges, distance = np.broadcast_arrays(ranges, distance)
        there = np.broadcast_to(True if mask is None else mask, ranges.shape)
        variance = epoch_variance(noise, self.pose.noise, distance, mask)
        weights = np.where(there, 1 / variance, 0.0)
        white = dataclasses.replace(self.pose, offset=self.clock.offset)
        start = white.start(pose, ranges, weights, anchors)
        here = _DISTANCES(anchors, _TAG_POSITIONS(*start, self.pose.tags))
        state = self._with_clocks(state, ranges - here, there)
        found = AugmentedState(
            *bias_cost.update_any(
                *state, ranges, weights, anchors, self.pose.tags, *start, pose.covariance,
                self.pose.iterations, _LOSSES[self.pose.robust], 0, None,
                self._sums(ranges.shape[-2:]),
            )
        )  # fmt: skip
        as_state(*found[:2], found.covariance)
        return found

    def _sums(self, shape: tuple[int, ...]) -> FloatArray:
        """Which offset, and no drift, each of (M, N) ranges has: (M N, 2 G)."""
        columns = offsets.columns(self.clock.offset, shape[0], shape[1])
        return np.concatenate([columns, np.zeros_like(columns)], axis=1)

    def _with_clocks(
        self, state: AugmentedState, gaps: FloatArray, there: np.ndarray
    ) -> AugmentedState:
        """The state with clocks, at first set by the ranges less distances (..., M, N)."""
        guess = offsets.median(gaps, there, self.clock.offset)
        n = guess.shape[-2] * guess.shape[-1]
        have = state.extra.shape[-1] // 2
        if have == n:
            return state
        if have:
            raise ValueError(f"anchors must be the {have} whose clocks the state holds, got {n}")
        batch = guess.shape[:-2]
        P = np.zeros((*batch, 6 + 2 * n, 6 + 2 * n))
        P[..., :6, :6] = state.covariance
        std = np.repeat([self.clock.std_m, self.clock.drift_m_s], n)
        P[..., range(6, 6 + 2 * n), range(6, 6 + 2 * n)] = std**2
        extra = np.concatenate([guess.reshape((*batch, n)), np.zeros((*batch, n))], axis=-1)
        return AugmentedState(state.rotation, state.translation, extra, P)

    def belief(self, state: AugmentedState) -> PoseBelief:
        """What the state says about the pose (copies)."""
        rotation = state.rotation.copy()
        covariance = state.covariance[..., :6, :6].copy()
        return PoseBelief(rotation, state.translation.copy(), covariance, rotation)
