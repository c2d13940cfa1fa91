"""The iterated EKF of a body with odometry: states are the body twist and the sensor errors.

Error states: rotation (global), position, turn rate and velocity in body axes (12); constant scale
errors of turn rate and speed and biases of the turn rates (5); then link biases. The twist is a
random walk driven by white acceleration, and every odometry reading measures it. Without readings,
the predicted twist stays constant.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, kernel
from rbl_gym.estimators.costs.bias_cost import AugmentedState
from rbl_gym.estimators.iekf.augmented import AugmentedEkf
from rbl_gym.estimators.iekf.inertial import fade
from rbl_gym.estimators.inputs import check_batches, plain
from rbl_gym.geometry import rotations
from rbl_gym.measurements.odometry import OdometrySensor, expected
from rbl_gym.motion import navigation
from rbl_gym.motion.unknown_twist import WanderingTwist

_EXP, _HAT = kernel(rotations.exp), kernel(rotations.hat)
_LEFT_JACOBIAN = kernel(rotations.left_jacobian)
_TWIST, _CALIBRATION = slice(6, 12), slice(12, 17)
_STATES = 11


@dataclass(frozen=True, eq=False)
class OdometryEkf(AugmentedEkf):
    """Iterated extended Kalman filter of pose, twist in the body frame, odometry and biases.

    Parameters
    ----------
    pose, biases
        As in `AugmentedEkf`.
    twist
        Law of the twist, per axis of the body.
    sensor
        None.
    odometry
        Error model of the readings.
    """

    twist: WanderingTwist | None = field(default_factory=WanderingTwist)
    odometry: OdometrySensor = field(default_factory=OdometrySensor)
    reads: ClassVar[str] = "odometry"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.twist, WanderingTwist):
            raise ValueError(f"twist must be a WanderingTwist, got {self.twist!r:.80}")
        if not isinstance(self.odometry, OdometrySensor):
            raise ValueError(f"odometry must be an OdometrySensor, got {self.odometry!r:.80}")

    @property
    def _n_twist(self) -> int:
        return _STATES

    @property
    def _prior_std(self) -> FloatArray:
        assert self.twist is not None
        return np.concatenate([self.twist.prior_std(), self.odometry.calibration_std()])

    def predict(  # pyrefly: ignore[bad-override-param-name]
        self, state: AugmentedState, readings: ArrayLike, dt: ArrayLike
    ) -> AugmentedState:
        """Return the state after the readings of an interval.

        Parameters
        ----------
        readings
            (..., S, 6): turn rate (rad/s) and velocity (m/s) in the body frame, NaN if not
            measured.
        dt
            Duration of the interval, shared equally by its readings, or of each reading, (..., S),
            seconds.

        Raises
        ------
        ValueError
            If a shape is wrong, a reading is infinite, or a time is negative.
        """
        readings = np.asarray(readings, dtype=np.float64)
        if readings.ndim < 2 or readings.shape[-1] != 6:
            raise ValueError(f"readings must have shape (..., S, 6), got {readings.shape}")
        if np.isinf(readings).any():
            raise ValueError("readings must be finite, or NaN where there is none, got inf")
        steps, state = navigation.steps_of(dt, readings), plain(state)
        check_batches(state=state.translation.shape[:-1], readings=readings.shape[:-2])
        for k in range(readings.shape[-2]):
            step = steps[..., k]
            state = self._jumped(state, step)
            # A reading of zero duration has no information.
            told = np.where(step[..., None] > 0, readings[..., k, :], np.nan)
            if not np.isnan(told).all():
                state = _sensed(state, told, step, self.odometry)
            state = self._moved(state, step)
        if any(law.time_s is not None for law in self.biases):
            faded = fade(*state[2:], self._laws, steps.sum(axis=-1), _STATES)
            state = AugmentedState(*state[:2], *faded)
        return state

    def _jumped(self, state: AugmentedState, dt: FloatArray) -> AugmentedState:
        """Return the state after the random walk of the twist over `dt` seconds (...)."""
        P = state.covariance
        P = np.broadcast_to(P, (*np.broadcast_shapes(P.shape[:-2], np.shape(dt)), *P.shape[-2:]))
        P = P.copy()
        P[..., _TWIST, _TWIST] += np.asarray(dt)[..., None, None] * np.diag(self._wander)
        return state._replace(covariance=P)

    def _moved(self, state: AugmentedState, dt: FloatArray) -> AugmentedState:
        """Return the state after `dt` seconds (...) with a constant twist."""
        Q, extra = state.rotation, state.extra
        dt = np.asarray(dt)[..., None]
        turn, speed = extra[..., :3] * dt, extra[..., 3:6]
        J = Q @ _LEFT_JACOBIAN(turn)
        way = _times(J, speed) * dt
        dt = dt[..., None]
        P = state.covariance
        batch = np.broadcast_shapes(P.shape[:-2], dt.shape[:-2])
        F = np.zeros((*batch, 6, 12))
        F[..., :, :6] = np.eye(6)
        F[..., :3, 6:9] = F[..., 3:, 9:] = J * dt
        F[..., 3:, :3] = -_HAT(way)
        F[..., 3:, 6:9] = -0.5 * dt**2 * Q @ _HAT(speed)
        P = np.broadcast_to(P, (*batch, *P.shape[-2:])).copy()
        P[..., :6, :] = F @ P[..., :12, :]
        P[..., :, :6] = P[..., :, :12] @ np.swapaxes(F, -1, -2)
        P[..., :6, :6] += dt * np.diag(self._process)
        translation = state.translation + way
        extra = np.broadcast_to(extra, (*translation.shape[:-1], extra.shape[-1]))
        return AugmentedState(Q @ _EXP(turn), translation, extra, P)


def _sensed(
    state: AugmentedState, reading: FloatArray, dt: FloatArray, sensor: OdometrySensor
) -> AugmentedState:
    """Return the state after a reading (..., 6) with the duration `dt` seconds (...)."""
    known, P = np.isfinite(reading), state.covariance
    twist, calibration = state.extra[..., :6], state.extra[..., 6:11]
    scale = 1 + np.repeat(calibration[..., :2], 3, axis=-1)
    error = np.where(known, reading, 0.0) - np.where(known, expected(twist, calibration), 0.0)
    variance = sensor.noise() ** 2 / np.where(dt > 0, dt, 1.0)[..., None]
    # The scales are linearised at the twist of the reading, because the prior may be at rest.
    own = np.diagonal(P, axis1=-2, axis2=-1)[..., _TWIST]
    likely = twist + own * scale / (own * scale**2 + variance) * error
    H = np.zeros((*np.broadcast_shapes(error.shape, scale.shape), _STATES))
    axes = np.arange(6)
    H[..., axes, axes] = scale
    H[..., :3, 6], H[..., 3:, 7] = likely[..., :3], likely[..., 3:]
    H[..., range(3), range(8, 11)] = 1.0
    H = np.where(known[..., None], H, 0.0)
    crossed = P[..., :, 6 : 6 + _STATES] @ np.swapaxes(H, -1, -2)
    S = H @ crossed[..., 6 : 6 + _STATES, :]
    S[..., axes, axes] += variance
    gain = np.swapaxes(np.linalg.solve(S, np.swapaxes(crossed, -1, -2)), -1, -2)
    step = _times(gain, error)
    P = P - gain @ np.swapaxes(crossed, -1, -2)
    return AugmentedState(
        _EXP(step[..., :3]) @ state.rotation,
        state.translation + step[..., 3:6],
        state.extra + step[..., 6:],
        0.5 * (P + np.swapaxes(P, -1, -2)),
    )


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    return (matrix @ vector[..., None])[..., 0]
