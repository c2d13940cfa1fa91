"""Bank of filters for an unknown initial heading, weighted by their likelihood.

Gravity gives roll and pitch at once. The ranges give the yaw; with one tag, only once it moves.
The hypotheses start at headings around the circle. Each epoch multiplies their weights by its
likelihood. Unlikely hypotheses are dropped, and equal ones are merged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_count
from rbl_gym.estimators.costs.bias_cost import AugmentedState
from rbl_gym.estimators.costs.losses import LATE, loss_of
from rbl_gym.estimators.filter import Filter, PoseBelief, reads, register
from rbl_gym.estimators.iekf.augmented import AugmentedEkf
from rbl_gym.estimators.iekf.inertial import InertialEkf
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.innovation import innovations
from rbl_gym.estimators.inputs import check_epoch, epoch_variance
from rbl_gym.geometry import rotations
from rbl_gym.measurements.direction_bias import DirectionLaw
from rbl_gym.measurements.inertial import InertialSensor
from rbl_gym.measurements.inertial import sensor as sensor_of
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.measurements.ranging import LinkNoise, NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

# Hypotheses with less than this fraction of the weight are dropped.
_LOST = 1e-8
# Standard deviation of a heading uniform on the circle.
_ANY_RAD = 1.8
# A hypothesis equals the leader below this squared distance, in the leader's standard deviations
# and over six states.
_SAME = 0.1
# Weight of the middle heading in the mean of all, for uniform headings.
_MIDDLE = 0.05


class HeadingState(NamedTuple):
    """Hypotheses (..., H): fields of `AugmentedState` and logarithms of their weights.

    `log_evidence` (...) is the log density of all ranges so far under the mixture.
    """

    rotation: FloatArray
    translation: FloatArray
    extra: FloatArray
    covariance: FloatArray
    log_weights: FloatArray
    log_evidence: FloatArray


@dataclass(frozen=True, eq=False)
class HeadingBank:
    """Bank of filters that start at several headings.

    The `headings` cover the circle, or five standard deviations of the prior's yaw if that is less.
    """

    filter: AugmentedEkf
    headings: int = 12

    @property
    def reads(self) -> str:
        """Inputs that `predict` takes, as those of the filter."""
        return reads(self.filter)

    def __post_init__(self) -> None:
        check_count("headings", self.headings, least=2)

    def initial(
        self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike
    ) -> HeadingState:
        """Return the state of a prior of the pose; its covariance (..., 6, 6) gives the yaw spread.

        Raises
        ------
        ValueError
            As in `IteratedEkf.initial`.
        """
        start = self.filter.initial(rotation, translation, covariance)
        std = np.sqrt(start.covariance[..., 2, 2])[..., None]
        spacing = np.minimum(5 * std, 2 * math.pi) / self.headings
        yaw = spacing * (np.arange(self.headings) - 0.5 * (self.headings - 1))
        # If the spread covers the circle, all headings are equally likely.
        log_weights = np.where(std < _ANY_RAD, -0.5 * (yaw / std) ** 2, 0.0)
        turn = rotations.exp(yaw[..., None] * np.array([0.0, 0.0, 1.0]))
        n = start.covariance.shape[-1]
        # The yaw of a hypothesis is known to its part of the spread; the rest follows.
        scale = np.ones((*std.shape[:-1], n))
        scale[..., 2] = np.minimum(0.7 * spacing / std, 1.0)[..., 0]
        P = start.covariance * scale[..., :, None] * scale[..., None, :]
        batch = (*start.translation.shape[:-1], self.headings)

        def each(field: FloatArray, trailing: int) -> FloatArray:
            field = np.expand_dims(field, -1 - trailing)
            return np.broadcast_to(field, (*batch, *field.shape[field.ndim - trailing :])).copy()

        return HeadingState(
            turn @ start.rotation[..., None, :, :], each(start.translation, 1),
            each(start.extra, 1), each(P, 2), _normal(np.broadcast_to(log_weights, batch)),
            np.zeros(batch[:-1]),
        )  # fmt: skip

    def predict(self, state: HeadingState, twist: ArrayLike, dt: Any) -> HeadingState:
        """Return the state of all hypotheses after `dt` seconds.

        The input of the filter is a twist (..., 6), or readings (..., S, 6) of a sensor.
        """
        trailing = 1 if self.reads == "twist" else 2
        told = np.asarray(twist, dtype=np.float64)
        if told.ndim < trailing:
            shape = "(..., 6)" if trailing == 1 else "(..., S, 6)"
            name = "twist" if trailing == 1 else "readings"
            raise ValueError(f"{name} must have shape {shape}, got {told.shape}")
        twist = np.expand_dims(told, -1 - trailing)
        steps = np.expand_dims(np.asarray(dt), -2) if np.ndim(dt) else dt
        moved: AugmentedState = self.filter.predict(_filtered(state), twist, steps)  # pyrefly: ignore[bad-argument-type]
        return HeadingState(*moved, *state[4:])

    def update(
        self,
        state: HeadingState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> HeadingState:
        """Update all hypotheses by the filter; weight, merge and drop them."""
        pose = self.filter.pose
        measured, places, mask = check_epoch(ranges, anchors, links, pose.tags)
        variance = epoch_variance(noise, pose.noise, measured, mask)
        std = np.sqrt(np.broadcast_to(variance, measured.shape))
        # Add an axis for the hypotheses.
        measured, places, std = (a[..., None, :, :] for a in (measured, places, std))
        mask, law = None if mask is None else mask[..., None, :, :], LinkNoise(std)
        before = _filtered(state)
        after = self.filter.update(before, measured, places, mask, law)
        if state.log_weights.shape[-1] == 1:
            return HeadingState(*after, *state[4:])
        epoch = measured, places, pose.tags
        told = innovations(self.filter, before, after, *epoch, law, mask)
        weights = state.log_weights + told.log_likelihood
        evidence = state.log_evidence + np.asarray(scipy.special.logsumexp(weights, axis=-1))
        if pose.robust == "late":
            # Use the robust weights of the update, so that a late range does not select a heading.
            residual, there = told.residual / std, told.residual != 0
            cost, share = loss_of(residual**2, LATE, residual > 0)
            wider = LinkNoise(std / np.sqrt(share))
            told = innovations(self.filter, before, after, *epoch, wider, mask)
            lost = 0.5 * np.log(share) + cost - 0.5 * share * residual**2
            weights = state.log_weights + told.log_likelihood
            weights = weights - np.where(there, lost, 0.0).sum(axis=(-2, -1))
        return _pruned(HeadingState(*after, _normal(weights), evidence))

    def belief(self, state: HeadingState) -> PoseBelief:
        """Return the mean pose of all hypotheses, with the covariance about it."""
        if state.log_weights.shape[-1] == 1:
            return self.filter.belief(self.leader(state))
        weights = np.exp(state.log_weights)[..., None, None]
        # The mean of uniform headings is undefined, so the middle heading gets a small weight.
        middle = state.rotation[..., state.rotation.shape[-3] // 2, :, :]
        rotation = rotations.nearest((weights * state.rotation).sum(axis=-3) + _MIDDLE * middle)
        translation = (weights[..., 0] * state.translation).sum(axis=-2)
        turn = rotations.error(rotation[..., None, :, :], state.rotation)
        gap = np.concatenate([turn, translation[..., None, :] - state.translation], axis=-1)
        spread = state.covariance[..., :6, :6] + gap[..., :, None] * gap[..., None, :]
        return PoseBelief(rotation, translation, (weights * spread).sum(axis=-3), rotation.copy())

    def leader(self, state: HeadingState) -> AugmentedState:
        """Return the most likely hypothesis."""
        best = np.argmax(state.log_weights, axis=-1)[..., None]
        return AugmentedState(
            *(
                np.take_along_axis(field, best.reshape(*best.shape, *[1] * n), -1 - n).squeeze(
                    -1 - n
                )
                for field, n in zip(state[:4], (2, 1, 1, 2), strict=True)
            )
        )


def _filtered(state: HeadingState) -> AugmentedState:
    return AugmentedState(*state[:4])


def _normal(log_weights: FloatArray) -> FloatArray:
    """Return weights that add up to 1."""
    log_weights = log_weights - log_weights.max(axis=-1, keepdims=True)
    return log_weights - np.log(np.exp(log_weights).sum(axis=-1, keepdims=True))


def _pruned(state: HeadingState) -> HeadingState:
    """Drop unlikely and duplicate hypotheses of one body; a batch keeps its shape."""
    batch = state.log_weights.shape[:-1]
    if math.prod(batch) != 1 or state.log_weights.shape[-1] == 1:
        return state
    kept = _kept(HeadingState(*(field[(0,) * len(batch)] for field in state)))
    return HeadingState(*(np.asarray(field)[(None,) * len(batch)] for field in kept))


def _kept(state: HeadingState) -> HeadingState:
    """Return one body's state (H, ...) with only the hypotheses kept."""
    best = int(np.argmax(state.log_weights))
    turn = rotations.error(state.rotation, state.rotation[best])
    gap = np.concatenate([turn, state.translation - state.translation[best]], axis=-1)
    scaled = np.linalg.solve(state.covariance[best, :6, :6], gap[..., None])
    same = np.einsum("hi,hi->h", gap, scaled[..., 0]) < 6 * _SAME
    kept = (state.log_weights > math.log(_LOST)) & ~same
    kept[best] = True
    if kept.all():
        return state
    weights = state.log_weights.copy()
    weights[best] = np.log(np.exp(weights[same]).sum())
    filtered = AugmentedState(*(field[kept] for field in state[:4]))
    return HeadingState(*filtered, _normal(weights[kept]), state.log_evidence)


def iekf_imu(
    tags: FloatArray,
    noise: NoiseLaw,
    process: ProcessNoise,
    iterations: int = 4,
    robust: bool | str = False,
    inertial: str | Mapping[str, Any] | InertialSensor = "consumer",
    speed_m_s: float = 1.0,
    gravity_tilt_rad: float = 0.0,
    bias_std_m: float = 0.0,
    common_std_m: float = 0.0,
    drift_std_m: float = 0.0,
    drift_time_s: float = 20.0,
    headings: int = 1,
    offset: str | None = None,
    directions: DirectionLaw | None = None,
) -> Filter:
    """Return the filter ``"iekf-imu"`` for pose, velocity and the biases of an inertial sensor.

    Parameters
    ----------
    tags, noise, iterations, robust, offset
        As in `IteratedEkf`. `offset` requires one heading.
    process
        Not used, because the motion is measured.
    inertial
        As `measurements.inertial.sensor` takes it.
    speed_m_s, gravity_tilt_rad
        As in `InertialEkf`.
    bias_std_m, common_std_m
        Standard deviations of constant biases: one per link, and one common to all links, metres.
    drift_std_m, drift_time_s
        Standard deviation and correlation time of drifting link biases, as in `LinkBias`; 0: none.
    headings
        Number of heading hypotheses at the start; 1 for a known heading.
    directions
        As in `AugmentedEkf`.
    """
    if offset is not None and headings != 1:
        raise ValueError(f"headings must be 1 if offset is given, got {headings!r}")
    biases = []
    if bias_std_m or common_std_m:
        biases.append(LinkBias(bias_std_m, None, common_std_m))
    if drift_std_m:
        biases.append(LinkBias(drift_std_m, drift_time_s))
    filter = InertialEkf(
        IteratedEkf(tags, noise, process, iterations, robust, offset),
        biases=tuple(biases),
        directions=directions,
        inertial=sensor_of(inertial),
        speed_m_s=speed_m_s,
        gravity_tilt_rad=gravity_tilt_rad,
    )
    found = filter if check_count("headings", headings) == 1 else HeadingBank(filter, headings)
    return found  # pyrefly: ignore[bad-return]


register("iekf-imu", iekf_imu)
