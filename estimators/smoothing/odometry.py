"""Odometry readings between neighbouring epochs, as a factor of the smoother."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, kernel
from rbl_gym.estimators.smoothing.equations import LogState, Rows
from rbl_gym.geometry import rotations
from rbl_gym.measurements.odometry import OdometrySensor, expected
from rbl_gym.motion import navigation

__all__ = ["OdometryMotion", "padded"]

# Called without input checks: the inputs were checked before, or made here.
_EXP, _LOG, _HAT = kernel(rotations.exp), kernel(rotations.log), kernel(rotations.hat)
_LEFT_JACOBIAN = kernel(rotations.left_jacobian)
_LEFT_JACOBIAN_INVERSE = kernel(rotations.left_jacobian_inverse)


@dataclass(frozen=True, eq=False)
class OdometryMotion:
    """Motion of a pose by odometry readings: a `Motion` of a `LogModel`.

    Constants of the log are estimated too: the scales of turn rate and speed, and the biases of
    the turn rates. The readings between two epochs are integrated. Axes without readings move by a
    random walk.

    Parameters
    ----------
    readings, steps
        (..., K - 1, S, 6) and seconds (..., K - 1, S), of the intervals between epochs: turn rate
        (rad/s), then speed (m/s), in the body frame, NaN if not measured. An interval with fewer
        than S readings is padded with readings of zero duration.
    sensor
        Error model of the readings.
    unread
        Standard deviation of the motion in 1 s of an axis without readings: rotation (rad),
        translation (m).
    """

    readings: ArrayLike
    steps: ArrayLike
    sensor: OdometrySensor
    unread: tuple[float, float] = (1.0, 1.0)

    extra_std = np.zeros(0)
    turning = False

    def __post_init__(self) -> None:
        readings = np.asarray(self.readings, dtype=np.float64)
        if readings.ndim < 3 or readings.shape[-1] != 6:
            raise ValueError(f"readings must have shape (..., K - 1, S, 6), got {readings.shape}")
        if np.isinf(readings).any():
            raise ValueError("readings must be finite, or NaN where there is none, got inf")
        object.__setattr__(self, "readings", readings)
        object.__setattr__(self, "steps", navigation.check_steps(self.steps, readings))
        if not isinstance(self.sensor, OdometrySensor):
            raise ValueError(f"sensor must be an OdometrySensor, got {self.sensor!r:.80}")

    @property
    def constants_std(self) -> FloatArray:
        """Standard deviations (5,) of scales and biases."""
        return np.maximum(self.sensor.calibration_std(), 1e-9)

    def linearize(self, state: LogState, times: FloatArray, constants: FloatArray) -> Rows:
        """Return whitened rows of the motion between two poses less the integrated readings."""
        turn, way, by = _together(self.readings, self.steps, constants)  # pyrefly: ignore[bad-argument-type]
        Q, Q_new = state.rotation[..., :-1, :, :], state.rotation[..., 1:, :, :]
        back = np.swapaxes(Q, -1, -2)
        error = _LOG(np.swapaxes(turn, -1, -2) @ back @ Q_new)
        moved = _times(back, np.diff(state.translation, axis=-2))
        residual = np.concatenate([error, moved - way], axis=-1)
        # E = R^T Q^T Q'; an error w' of Q' rotates it by (Q R)^T w', an error of Q by the negative.
        inner = _LEFT_JACOBIAN_INVERSE(error) @ np.swapaxes(Q @ turn, -1, -2)
        A, B = (np.zeros((*residual.shape, 6)) for _ in range(2))
        A[..., :3, :3], B[..., :3, :3] = -inner, inner
        A[..., 3:, :3] = back @ _HAT(_times(Q, moved))
        A[..., 3:, 3:], B[..., 3:, 3:] = -back, back
        C = np.zeros((*residual.shape, 5))
        C[..., :3, :] = -_LEFT_JACOBIAN_INVERSE(error) @ by[..., :3, :]
        C[..., 3:, :] = -by[..., 3:, :]
        L = self._whitener
        return Rows(_times(L, residual), L @ A, L @ B, L @ C)

    @functools.cached_property
    def _whitener(self) -> FloatArray:
        """Return inverse Cholesky factors (..., K - 1, 6, 6) of the integrated noise."""
        _, way, _ = _together(self.readings, self.steps, np.zeros(5))  # pyrefly: ignore[bad-argument-type]
        steps = np.asarray(self.steps)[..., None]
        known = np.isfinite(np.asarray(self.readings))
        unread = np.repeat(self.unread, 3)
        variance = (np.where(known, self.sensor.noise(), unread) ** 2 * steps).sum(axis=-2)
        variance = np.maximum(variance, 1e-12)
        P = variance[..., None] * np.eye(6)
        # A rotation at an unknown time moves the end point by the rotation times the way that
        # remains.
        lever = -0.5 * _HAT(way)
        P[..., 3:, :3] = lever * variance[..., None, :3]
        P[..., :3, 3:] = np.swapaxes(P[..., 3:, :3], -1, -2)
        # The mean square of the remaining fraction is a third.
        P[..., 3:, 3:] += 4 / 3 * (P[..., 3:, :3] @ np.swapaxes(lever, -1, -2))
        return np.linalg.inv(np.linalg.cholesky(P))


def padded(intervals: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Pad readings and seconds of J intervals to arrays (J, S, 6) and (J, S).

    Parameters
    ----------
    intervals
        Readings (S, 6) and seconds (S,) of each. Shorter intervals are padded with readings of zero
        duration.
    """
    most = max((len(steps) for _, steps in intervals), default=0)
    readings, seconds = np.zeros((len(intervals), most, 6)), np.zeros((len(intervals), most))
    for k, (values, steps) in enumerate(intervals):
        readings[k, : len(steps)], seconds[k, : len(steps)] = values, steps
    return readings, seconds


def _together(
    readings: FloatArray, steps: FloatArray, constants: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rotation (..., 3, 3), way (..., 3) in the first frame, derivatives by constants.

    The derivatives are (..., 6, 5). That of the rotation refers to the error d in ``R exp(d)``.
    """
    constants = constants[..., None, :]
    scale = 1 + np.repeat(constants[..., :2], 3, axis=-1)
    known = np.isfinite(readings)
    batch = np.broadcast_shapes(readings.shape[:-2], constants.shape[:-1])
    R, p = np.broadcast_to(np.eye(3), (*batch, 3, 3)), np.zeros((*batch, 3))
    D = np.zeros((*batch, 6, 5))
    none = expected(np.zeros(6), constants)
    for s in range(readings.shape[-2]):
        dt = steps[..., s, None]
        seen = known[..., s, :]
        twist = np.where(seen, (readings[..., s, :] - none) / scale, 0.0)
        moved = twist * dt
        # Derivatives by the constants: the scales, then the biases.
        slope = np.zeros((*twist.shape, 5))
        slope[..., :3, 0], slope[..., 3:, 1] = -twist[..., :3], -twist[..., 3:]
        slope[..., range(3), range(2, 5)] = -1.0
        slope = np.where(seen[..., None], slope / scale[..., None] * dt[..., None], 0.0)
        J = _LEFT_JACOBIAN(moved[..., :3])
        step = _EXP(moved[..., :3])
        way = _times(J, moved[..., 3:])
        bent = -0.5 * _HAT(moved[..., 3:]) @ slope[..., :3, :]
        new = np.empty_like(D)
        new[..., 3:, :] = D[..., 3:, :] + R @ (
            J @ slope[..., 3:, :] + bent - _HAT(way) @ D[..., :3, :]
        )
        back = np.swapaxes(step, -1, -2)
        new[..., :3, :] = back @ (D[..., :3, :] + J @ slope[..., :3, :])
        p, R, D = p + _times(R, way), R @ step, new
    return R, p, D


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    return (matrix @ vector[..., None])[..., 0]
