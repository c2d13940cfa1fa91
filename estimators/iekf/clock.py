"""The iterated EKF of a pose and of drifting clocks, which cause lasting range offsets.

A white offset is eliminated in its epoch (`IteratedEkf.offset`). If clocks are stable, the offset
of one epoch is informative for the next. Offset and drift are then states besides the pose: two
for every tag, for every anchor, or for all. They act on the ranges as link biases do.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.twist import covariance_after
from rbl_gym.checks import FloatArray, check_number, kernel
from rbl_gym.estimators.costs import bias_cost
from rbl_gym.estimators.costs.bias_cost import AugmentedState
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.estimators.iekf.augmented import LOSSES, AugmentedEkf, told_twist
from rbl_gym.estimators.iekf.pose_steps import as_state
from rbl_gym.estimators.inputs import check_batches, check_epoch, epoch_variance, plain
from rbl_gym.measurements import offsets, ranging
from rbl_gym.measurements.offsets import Clock
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import propagate

# Internal functions without checks: their arguments were checked, or made here.
_TAG_POSITIONS, _DISTANCES = kernel(ranging.tag_positions), kernel(ranging.distances)


@dataclass(frozen=True, eq=False)
class ClockEkf(AugmentedEkf):
    """Iterated extended Kalman filter of the pose, and of the offsets and drifts of clocks.

    The extra states are those of `AugmentedEkf`, then offsets and drifts of the G clocks. These and
    the biases are added with the first ranges.

    Parameters
    ----------
    pose
        The filter of the pose, without an offset.
    twist, sensor, biases
        As in `AugmentedEkf`.
    clock
        Law of the offsets.
    """

    clock: Clock = field(default_factory=Clock)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.clock, Clock):
            raise ValueError(f"clock must be a Clock, got {self.clock!r:.80}")
        if self.pose.offset is not None:
            raise ValueError(f"offset must be None with a clock, got {self.pose.offset!r}")

    def predict(self, state: AugmentedState, twist: ArrayLike | None, dt: float) -> AugmentedState:
        """Return the state, with clocks, after `dt` seconds.

        Arguments as in `AugmentedEkf.predict`.
        """
        dt, state = check_number("dt", dt, low=0.0), plain(state)
        state, told = told_twist(self, state, twist)
        known = self.twist is None
        moving = told if known else state.extra[..., :6]
        moved = propagate(state.rotation, state.translation, moving, dt)
        wander = None if known else self._wander
        P = covariance_after(state.covariance, moving, dt, self._process, wander)
        F, Q = self._transition(state.extra.shape[-1], dt)
        T, noise = (np.zeros(P.shape[-2:]) for _ in range(2))
        T[:6, :6], T[6:, 6:], noise[6:, 6:] = np.eye(6), F, Q
        extra = np.broadcast_to(state.extra @ F.T, (*moved[1].shape[:-1], len(F)))
        return AugmentedState(*moved, extra, T @ P @ T.T + noise)

    def _transition(self, extra: int, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return F and Q of biases and clocks."""
        F, Q = np.eye(extra), np.zeros((extra, extra))
        clocks = self._n_clocks(extra)
        if not clocks:
            return F, Q
        last = slice(extra - 2 * clocks, extra)
        F[last, last], Q[last, last] = (
            np.kron(a, np.eye(clocks)) for a in self.clock.transition(dt)
        )
        first, size = self._n_twist, (last.start - self._n_twist) // max(1, len(self.biases))
        for law in self.biases:
            where, kept = slice(first, first + size), law.decay(dt)
            F[where, where] *= kept
            Q[where, where] = (1 - kept**2) * law.covariance(size)
            first += size
        return F, Q

    def _n_clocks(self, extra: int) -> int:
        """Return the number of clocks in the extra states: zero before the first ranges."""
        return 0 if extra == self._n_twist else self._clocks_of(extra - self._n_twist)

    def _clocks_of(self, more: int) -> int:
        """Return the number of clocks from that of states, for M N links and N tags."""
        n, laws = self.pose.tags.shape[-2], len(self.biases)
        if self.clock.offset == "anchor":
            return more // (laws * n + 2)
        count = n if self.clock.offset == "tag" else 1
        return count if more >= 2 * count else 0

    def update(
        self,
        state: AugmentedState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> AugmentedState:
        """Return the state after ranges (..., M, N) of any sign; arguments as in `AugmentedEkf`.

        Raises
        ------
        ValueError
            As in `IteratedEkf.update`, and if the number of anchors with clocks changes.
        """
        state = plain(state)
        pose = PoseState(state.rotation, state.translation, state.covariance[..., :6, :6])
        ranges, anchors, mask = check_epoch(ranges, anchors, links, self.pose.tags, signed=True)
        check_batches(state=state.translation.shape[:-1], ranges=ranges.shape[:-2])
        distance = _DISTANCES(anchors, _TAG_POSITIONS(*pose[:2], self.pose.tags))
        ranges, distance = np.broadcast_arrays(ranges, distance)
        there = np.broadcast_to(True if mask is None else mask, ranges.shape)
        variance = epoch_variance(noise, self.pose.noise, distance, mask)
        # The search for a start treats biases as noise.
        spread = sum(law.std_m**2 + law.common_std_m**2 for law in self.biases)
        seen = np.where(there, 1 / (variance + spread), 0.0)
        white = dataclasses.replace(self.pose, offset=self.clock.offset)
        start = white.start(pose, ranges, seen, anchors)
        here = _DISTANCES(anchors, _TAG_POSITIONS(*start, self.pose.tags))
        state = self._with_clocks(state, ranges - here, there)
        found = AugmentedState(
            *bias_cost.update_augmented.textbook(
                *state, ranges, np.where(there, 1 / variance, 0.0), anchors, self.pose.tags,
                *start, pose.covariance, self.pose.iterations, LOSSES[self.pose.robust],
                self._n_twist, None, self._sums(ranges.shape[-2:]),
            )
        )  # fmt: skip
        as_state(*found[:2], found.covariance)
        return found

    @property
    def offset(self) -> str | None:
        """Return which ranges share a clock.

        Innovations are those after the offsets are removed.
        """
        return self.clock.offset

    def biases_of(
        self, state: AugmentedState, anchors: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `AugmentedEkf.biases_of`; clocks are not included."""
        state = plain(state)
        n = state.extra.shape[-1]
        n -= 2 * self._n_clocks(n)
        less = state.extra[..., :n], state.covariance[..., : 6 + n, : 6 + n]
        return super().biases_of(AugmentedState(state.rotation, state.translation, *less), anchors)

    def _sums(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the derivative (M N, K) of ranges by biases, offsets and drifts (zero)."""
        links = shape[0] * shape[1]
        own = bias_cost.sums_of(self._n_twist, len(self.biases), links)
        columns = offsets.columns(self.clock.offset, shape[0], shape[1])
        return np.concatenate([own, columns, np.zeros_like(columns)], axis=1)

    def _with_clocks(
        self, state: AugmentedState, gaps: FloatArray, there: np.ndarray
    ) -> AugmentedState:
        """Return the state with biases and clocks, from ranges minus distances (..., M, N)."""
        guess = offsets.median(gaps, there, self.clock.offset)
        links = gaps.shape[-2] * gaps.shape[-1]
        biases = len(self.biases) * links
        n = guess.shape[-2] * guess.shape[-1]
        have, first = state.extra.shape[-1], self._n_twist
        if have == first + biases + 2 * n:
            return state
        if have > first:
            held = self._n_clocks(have)
            raise ValueError(
                f"the number of anchors must stay {held}, as the state has a clock of each, got {n}"
            )
        clocks = np.diag(np.repeat([self.clock.std_m, self.clock.drift_m_s], n) ** 2)
        state = bias_cost.extended(state, *(law.covariance(links) for law in self.biases), clocks)
        batch = guess.shape[:-2]
        extra = np.broadcast_to(state.extra, (*batch, state.extra.shape[-1])).copy()
        extra[..., first + biases : first + biases + n] = guess.reshape((*batch, n))
        return state._replace(extra=extra)
