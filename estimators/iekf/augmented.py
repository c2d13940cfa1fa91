"""The iterated EKF with states besides the pose: an unknown twist, link biases.

Given the pose, an epoch is linear in the other states. They are eliminated, the pose is found by
the damped Gauss-Newton method of `levenberg_marquardt`, and the other states follow from it.
Ranges do not depend on an unknown twist. The pose update is then that of the plain `IteratedEkf`,
at its speed.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number
from rbl_gym.estimators.costs import bias_cost
from rbl_gym.estimators.costs.bias_cost import AugmentedState, update_augmented
from rbl_gym.estimators.costs.losses import LATE, SQUARES, huber
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.estimators.filter import PoseBelief
from rbl_gym.estimators.iekf.augmented_steps import carried, predict_augmented, track_augmented
from rbl_gym.estimators.iekf.directed import directed, undirected
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.iekf.pose_steps import as_state
from rbl_gym.estimators.inputs import check_batches, check_one_process, plain
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.direction_bias import DirectionLaw, direction_bias
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.unknown_twist import TwistSensor, WanderingTwist

# Losses of whitened innovations, by `robust`. Residuals of real ranges have heavier tails than
# Gaussian noise: Huber's threshold of 1.0 was measured to be better than 1.5.
LOSSES = {False: SQUARES, True: huber(1.0), "late": LATE}
_AT_REST = np.zeros(6)
# Linearisations of a law of directions in an update: at the start, and at the result.
_PASSES = 2


@dataclass(frozen=True, eq=False)
class AugmentedEkf:
    """Iterated extended Kalman filter of pose, twist and biases.

    Parameters
    ----------
    pose
        The filter of the pose: tags, noise, process, iterations, robustness.
    twist
        Law of an unknown twist. None: the twist is known and passed to `predict`.
    sensor
        Noisy sensor of an unknown twist; `predict` then gets its readings. None: no sensor.
    biases
        Laws of the link biases. The bias of a link is the sum over all laws. Empty: no biases.
    directions
        Bias of a range as a function of its direction, at the estimated pose. None: no such bias.
    """

    pose: IteratedEkf
    twist: WanderingTwist | None = None
    sensor: TwistSensor | None = None
    biases: tuple[LinkBias, ...] = ()
    directions: DirectionLaw | None = None

    def __post_init__(self) -> None:
        check_one_process(self.pose.process)

    @property
    def offset(self) -> str | None:
        """Return which ranges share an unknown offset, as in the pose filter."""
        return self.pose.offset

    @property
    def _n_twist(self) -> int:
        return 0 if self.twist is None else 6

    @property
    def _prior_std(self) -> FloatArray:
        """Return prior standard deviations of the states between pose and link biases."""
        return np.zeros(0) if self.twist is None else self.twist.prior_std()

    def initial(
        self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike
    ) -> AugmentedState:
        """Return the state of a prior of the pose, covariance (..., 6, 6).

        The other states are zero, with the covariance of their laws. Link biases are added with
        the first ranges.

        Raises
        ------
        ValueError
            As in `IteratedEkf.initial`.
        """
        pose = self.pose.initial(rotation, translation, covariance)
        nothing = np.zeros((*pose.translation.shape[:-1], 0))
        alone = AugmentedState(pose.rotation, pose.translation, nothing, pose.covariance)
        return bias_cost.extended(alone, np.diag(self._prior_std**2))

    def predict(self, state: AugmentedState, twist: ArrayLike | None, dt: float) -> AugmentedState:
        """Return the state after `dt` seconds.

        Parameters
        ----------
        twist
            (..., 6) of the interval: the known twist, if this filter does not estimate the twist.
            With a `sensor`: its reading, or None without a reading. Ignored if the twist is
            unknown and there is no sensor.
        """
        dt, state = check_number("dt", dt, low=0.0), plain(state)
        state, told = told_twist(self, state, twist)
        return AugmentedState(
            *predict_augmented(
                *state, told, dt, self._process, self._wander, self._laws, self._n_twist
            )
        )

    @functools.cached_property
    def _process(self) -> FloatArray:
        """Return the variances (6,) of the process noise of the pose after 1 s."""
        return self.pose.process.std() ** 2

    @functools.cached_property
    def _wander(self) -> FloatArray:
        """Return the variances (6,) of the change of an unknown twist after 1 s."""
        return np.zeros(6) if self.twist is None else self.twist.std() ** 2

    @functools.cached_property
    def _laws(self) -> FloatArray:
        """Return standard deviation, time and common standard deviation (n, 3) of the bias laws."""
        laws = [
            (law.std_m, math.inf if law.time_s is None else law.time_s, law.common_std_m)
            for law in self.biases
        ]
        return np.array(laws).reshape(-1, 3)

    def update(
        self,
        state: AugmentedState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> AugmentedState:
        """Return the state after one epoch of ranges (..., M, N); links True = measured.

        `noise` is the law of this epoch; None: the law of the pose filter.

        With biases, every update must have the same anchors in the same order. A vague prior is
        started as in `IteratedEkf`, with biases treated as noise.

        Raises
        ------
        ValueError
            As in `IteratedEkf.update`, and if the number of anchors changes with biases.
        """
        state = plain(state)
        pose = PoseState(state.rotation, state.translation, state.covariance[..., :6, :6])
        if not self.biases and self.directions is None:
            return carried(state, self.pose.update(pose, ranges, anchors, links, noise))
        ranges, variance, anchors, mask = self.pose.measured(state, ranges, anchors, links, noise)
        if ranges.shape != variance.shape:
            ranges, variance = np.broadcast_arrays(ranges, variance)
        check_batches(state=state.translation.shape[:-1], ranges=ranges.shape[:-2])
        state = self._with_biases(state, ranges.shape[-2:])
        weights = 1 / variance if mask is None else mask / variance
        start, covariance = (state.rotation, state.translation), state.covariance[..., :6, :6]
        vague = self.pose.is_sought(pose, ranges, weights, anchors)
        if vague.any():
            found = self._found_from_nothing(state, ranges, variance, anchors, mask)
            start = (
                np.where(vague[..., None, None], found.rotation, start[0]),
                np.where(vague[..., None], found.translation, start[1]),
            )
            covariance = np.where(vague[..., None, None], found.covariance, covariance)
        if self.directions is None:
            found = self._updated(state, ranges, weights, anchors, start, covariance)
        else:
            factor = direction_bias(self.directions, *start, anchors, self.pose.tags).log_std
            weights = weights * np.exp(-2 * factor)
            for _ in range(_PASSES):
                whole = directed(state, self.directions, start, anchors, self.pose.tags)
                found = self._updated(whole, ranges, weights, anchors, start, covariance)
                start, covariance = found[:2], found.covariance[..., :6, :6]
            count = ranges.shape[-2] * ranges.shape[-1]
            found = undirected(found, count)  # pyrefly: ignore[bad-argument-type, unbound-name]
        # A row suffices: all of them are NaN if the pose is not determined.
        as_state(*found[:2], found.covariance[..., 0, :])
        return found

    def track(
        self,
        state: AugmentedState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
        twist: ArrayLike | None = None,
        dt: ArrayLike = 0.0,
        level: Level | None = None,
    ) -> tuple[AugmentedState, AugmentedState] | None:
        """Predict and update over E epochs in one call; the same as one after the other.

        Parameters
        ----------
        state
            The state before the first prediction.
        ranges, anchors, links, noise
            As in `update`, with an axis of epochs: ranges (..., E, M, N), anchors (..., E, M, 3).
        twist, dt
            As in `predict`, (..., E, 6) and (E,), of the intervals that end at the epochs. With 0 s
            there is no prediction.
        level
            Known height and tilt, which every prediction is followed by (`hold_level`).

        Returns
        -------
        The states before and after the updates of the first e <= E epochs, arrays (..., e, ...);
        None if there are none. The track ends before an epoch that `predict` and `update` must take
        alone: the first one with biases, one with a vague rotation, one that raises an error. All
        epochs are alone if the filter has an offset, directions, a sensor, or no biases (`tracks`).

        Raises
        ------
        ValueError
            As in `update`.
        """
        states = self._n_twist + len(self.biases) * math.prod(np.shape(ranges)[-2:])
        if not self.tracks or state.extra.shape[-1] != states:
            return None
        ranges, variance, anchors, mask = self.pose.measured(state, ranges, anchors, links, noise)
        dt = check_array("dt", np.broadcast_to(dt, ranges.shape[-3:-2]), ("E",))
        told = _AT_REST if twist is None else check_array("twist", twist, (6,))
        *fields, count = track_augmented(
            *plain(state), np.broadcast_to(told, (*told.shape[:-2], len(dt), 6)), dt,
            self._process, self._wander, self._laws, self._n_twist,
            (Level() if level is None else level).numbers,
            *np.broadcast_arrays(ranges, 1 / variance if mask is None else mask / variance),
            np.broadcast_to(anchors, (*anchors.shape[:-3], len(dt), *anchors.shape[-2:])),
            self.pose.tags, self.pose.iterations, LOSSES[self.pose.robust],
        )  # fmt: skip
        if not (done := int(count.min())):
            return None
        ranks = 2 * (2, 1, 1, 2)
        kept = [
            field[(..., slice(done), *(slice(None),) * rank)]
            for field, rank in zip(fields, ranks, strict=True)
        ]
        before, after = AugmentedState(*kept[:4]), AugmentedState(*kept[4:])
        as_state(*after[:2], after.covariance[..., 0, :])
        return before, after

    @property
    def tracks(self) -> bool:
        """Return whether `track` takes epochs of this filter."""
        alone = self.directions is None and self.offset is None and self.sensor is None
        return type(self) is AugmentedEkf and bool(self.biases) and alone

    def _updated(
        self,
        state: AugmentedState,
        ranges: FloatArray,
        weights: FloatArray,
        anchors: FloatArray,
        start: tuple[FloatArray, FloatArray],
        covariance: FloatArray,
    ) -> AugmentedState:
        """Return the most likely state of an epoch near a start, and its pose covariance."""
        epoch: tuple[Any, ...] = (
            *state, ranges, weights, anchors, self.pose.tags, *start, covariance,
            self.pose.iterations, LOSSES[self.pose.robust], self._n_twist,
        )  # fmt: skip
        if self.offset is None:
            return AugmentedState(*update_augmented(*epoch))
        return AugmentedState(*update_augmented.textbook(*epoch, self.offset))

    def _with_biases(self, state: AugmentedState, shape: tuple[int, ...]) -> AugmentedState:
        """Return the state extended by the biases of (M, N) links."""
        links = shape[0] * shape[1]
        have = state.extra.shape[-1] - self._n_twist
        if have == links * len(self.biases):
            return state
        if have:
            n_tags = self.pose.tags.shape[-2]
            raise ValueError(
                f"the number of anchors must stay {have // len(self.biases) // n_tags}, as the "
                f"state has a bias of each link, got {shape[0]} anchors"
            )
        return bias_cost.extended(state, *(law.covariance(links) for law in self.biases))

    def _found_from_nothing(
        self,
        state: AugmentedState,
        ranges: FloatArray,
        variance: FloatArray,
        anchors: FloatArray,
        mask: BoolArray | None,
    ) -> PoseState:
        """Return the pose of the plain filter, with biases treated as range noise."""
        prior = PoseState(state.rotation, state.translation, state.covariance[..., :6, :6])
        links = math.prod(ranges.shape[-2:])
        sums = bias_cost.sums_of(self._n_twist, len(self.biases), links)
        biases = (state.extra @ sums.T).reshape((*state.extra.shape[:-1], *ranges.shape[-2:]))
        spread = np.einsum("lk,...kj,lj->...l", sums, state.covariance[..., 6:, 6:], sums)
        law = ranging.LinkNoise(np.sqrt(variance + spread.reshape(biases.shape)))
        left = ranges - biases
        if self.offset is None:
            left = np.maximum(left, 1e-6)
        return self.pose.update(prior, left, anchors, mask, law)

    def biases_of(
        self, state: AugmentedState, anchors: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return extra states, a covariance, and a derivative of the ranges.

        The extra states are (..., K). The covariance (..., 6 + K, 6 + K) is that of pose and extra
        states. The derivative (M N, K) of the ranges to anchors (..., M, 3) is with respect to the
        extra states.
        """
        shape, count = (anchors.shape[-2], self.pose.tags.shape[-2]), len(self.biases)
        if self.biases:
            state = self._with_biases(plain(state), shape)
        if self.directions is not None:
            about, count = (state.rotation, state.translation), count + 1
            state = directed(state, self.directions, about, anchors, self.pose.tags)
        sums = bias_cost.sums_of(self._n_twist, count, math.prod(shape))
        return state.extra, state.covariance, sums

    def belief(self, state: AugmentedState) -> PoseBelief:
        """Return the belief about the pose (copies)."""
        rotation = state.rotation.copy()
        covariance = state.covariance[..., :6, :6].copy()
        return PoseBelief(rotation, state.translation.copy(), covariance, rotation)


def told_twist(
    filter: AugmentedEkf, state: AugmentedState, twist: ArrayLike | None
) -> tuple[AugmentedState, FloatArray]:
    """Return the state after a sensor reading, and the twist (..., 6) if it is known."""
    known = filter.twist is None
    if twist is None and known:
        raise ValueError("twist must be given, as this filter does not estimate it, got None")
    told = _AT_REST if twist is None else check_array("twist", twist, (6,))
    if twist is not None and filter.sensor is not None and not known:
        state = _sensed(state, told, filter.sensor)
    return state, told


def _sensed(state: AugmentedState, reading: FloatArray, sensor: TwistSensor) -> AugmentedState:
    """Return the state after a reading (..., 6) of the twist."""
    rows = np.isfinite(sensor.std())
    H = sensor.jacobian(state.extra[..., :6])[..., rows, :]
    n = H.shape[-1]
    crossed = state.covariance[..., :n] @ np.swapaxes(H, -1, -2)
    S = H @ crossed[..., :n, :] + np.diag(sensor.std()[rows] ** 2)
    gain = np.swapaxes(np.linalg.solve(S, np.swapaxes(crossed, -1, -2)), -1, -2)
    innovation = (sensor.in_world(state.rotation, reading) - state.extra[..., :6])[..., rows]
    step = (gain @ innovation[..., None])[..., 0]
    covariance = state.covariance - gain @ np.swapaxes(crossed, -1, -2)
    return AugmentedState(
        rotations.exp(step[..., :3]) @ state.rotation,
        state.translation + step[..., 3:6],
        state.extra + step[..., 6:],
        0.5 * (covariance + np.swapaxes(covariance, -1, -2)),
    )
