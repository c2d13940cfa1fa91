"""Motion measured by an inertial sensor, as a factor of the smoother."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.smoothing import LEAST_STD
from rbl_gym.checks import FloatArray, check_array, check_number, kernel
from rbl_gym.estimators.smoothing.equations import LogState, Rows
from rbl_gym.geometry import rotations
from rbl_gym.measurements.inertial import InertialSensor
from rbl_gym.motion import navigation

__all__ = ["InertialMotion"]

# Called without input checks: the inputs were checked before, or made here.
_LOG, _HAT = kernel(rotations.log), kernel(rotations.hat)
_LEFT_JACOBIAN_INVERSE = kernel(rotations.left_jacobian_inverse)


@dataclass(frozen=True, eq=False)
class InertialMotion:
    """Motion of a pose by the readings of an inertial sensor: a `Motion` of a `LogModel`.

    Velocity and sensor biases are estimated at every epoch too, in the order of
    `motion.navigation`. The tilt of gravity is one constant of the log, if it is not zero.

    Parameters
    ----------
    readings, steps
        (..., K - 1, S, 6) and seconds (..., K - 1, S), of the intervals between epochs. An interval
        with fewer than S samples is padded with samples of zero duration.
    sensor
        Error model of the readings.
    speed_m_s, gravity_tilt_rad
        As in the filter ``"iekf-imu"``.
    """

    readings: ArrayLike
    steps: ArrayLike
    sensor: InertialSensor
    speed_m_s: float = 1.0
    gravity_tilt_rad: float = 0.0

    turning = False

    def __post_init__(self) -> None:
        if not isinstance(self.sensor, InertialSensor):
            raise ValueError(f"sensor must be an InertialSensor, got {self.sensor!r:.80}")
        readings = check_array("readings", self.readings, ("K", "S", 6))
        object.__setattr__(self, "readings", readings)
        object.__setattr__(self, "steps", navigation.check_steps(self.steps, readings))
        check_number("speed_m_s", self.speed_m_s, low=1e-9)
        check_number("gravity_tilt_rad", self.gravity_tilt_rad, low=0.0, high=0.5)

    @property
    def extra_std(self) -> FloatArray:
        """Standard deviations (9,) of velocity and biases at the first epoch."""
        return np.concatenate([[self.speed_m_s] * 3, self.sensor.prior_std])

    @property
    def constants_std(self) -> FloatArray:
        """Standard deviations of the tilt, (2,) or (0,)."""
        return np.full(2 * (self.gravity_tilt_rad > 0), self.gravity_tilt_rad)

    @functools.cached_property
    def _whitener(self) -> FloatArray:
        """Return inverse Cholesky factors (..., K - 1, 9, 9) of the preintegrated noise."""
        moved = navigation.integrate(self.readings, self.steps, np.zeros(6), self.sensor.numbers)  # pyrefly: ignore[bad-argument-type]
        return np.linalg.inv(np.linalg.cholesky(moved.covariance + LEAST_STD**2 * np.eye(9)))

    def linearize(self, state: LogState, times: FloatArray, constants: FloatArray) -> Rows:
        """Return whitened rows of each epoch less its prediction from the epoch before."""
        Q, Q_new = state.rotation[..., :-1, :, :], state.rotation[..., 1:, :, :]
        x, x_new = state.extra[..., :-1, :9], state.extra[..., 1:, :9]
        moved = navigation.integrate(self.readings, self.steps, x[..., 3:], self.sensor.numbers)  # pyrefly: ignore[bad-argument-type]
        T = moved.duration[..., None]
        tilt = constants if len(self.constants_std) else np.zeros(2)
        down = navigation.gravity(tilt, float(self.sensor.numbers[4]))[..., None, :]
        back = np.swapaxes(Q, -1, -2)
        turn = _LOG(Q_new @ np.swapaxes(Q @ moved.rotation, -1, -2))
        inner = _LEFT_JACOBIAN_INVERSE(turn)
        gone, sped = ((Q @ a[..., None])[..., 0] for a in (moved.translation, moved.velocity))
        place = np.diff(state.translation, axis=-2) - x[..., :3] * T - 0.5 * down * T**2 - gone
        speed = x_new[..., :3] - x[..., :3] - down * T - sped
        # In the body frame at the earlier epoch, in which the noise is known.
        residual = np.concatenate(
            [(back @ a[..., None])[..., 0] for a in (turn, place, speed)], axis=-1
        )
        A, B = (np.zeros((*residual.shape[:-1], 15, 15)) for _ in range(2))
        T = T[..., None]
        outer = back @ np.swapaxes(inner, -1, -2)
        # The frame rotates with the earlier rotation, which adds these terms.
        A[..., :3, :3] = back @ _HAT(turn) - outer
        A[..., :3, 9:12] = -outer @ Q @ moved.jacobian[..., :3, :3]
        B[..., :3, :3] = back @ inner
        A[..., 3:6, :3] = back @ _HAT(gone + place)
        A[..., 6:9, :3] = back @ _HAT(sped + speed)
        A[..., 3:6, 3:6], A[..., 3:6, 6:9], A[..., 6:9, 6:9] = -back, -T * back, -back
        A[..., 3:9, 9:] = -moved.jacobian[..., 3:, :]
        B[..., 3:6, 3:6], B[..., 6:9, 6:9] = back, back
        A[..., 9:, 9:], B[..., 9:, 9:] = -np.eye(6), np.eye(6)
        L = np.zeros(A.shape)
        L[..., :9, :9] = self._whitener
        walk = np.sqrt(moved.duration[..., None] * np.repeat(self.sensor.numbers[2:4], 3) + 1e-20)
        L[..., range(9, 15), range(9, 15)] = 1 / np.maximum(walk, LEAST_STD)
        residual = np.concatenate([residual, x_new[..., 3:] - x[..., 3:]], axis=-1)
        C = None
        if len(self.constants_std):
            lean = (
                back
                @ navigation.gravity_jacobian(tilt, float(self.sensor.numbers[4]))[..., None, :, :]
            )
            C = np.zeros((*residual.shape, 2))
            C[..., 3:6, :], C[..., 6:9, :] = -0.5 * T**2 * lean, -T * lean
            C = L @ C
        return Rows((L @ residual[..., None])[..., 0], L @ A, L @ B, C)
