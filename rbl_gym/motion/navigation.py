"""Inertial navigation: compute pose and velocity from gyroscope and accelerometer readings.

Over a sample of h seconds the readings minus their biases, (w, f), are taken as constant:

    Q' = Q exp(w h)
    s  = Q exp(w h / 2) f              (specific force in the world frame, at mid-rotation)
    v' = v + (g + s) h
    t' = t + v h + (g + s) h^2 / 2

Readings between two epochs are preintegrated (Forster et al., IEEE T-RO 33, 2017): integrated from
``Q = I, t = v = 0`` without gravity. The result depends only on the biases. The error of a state is
estimate minus truth; for the rotation it is global, ``Q_hat = exp(e) Q``. The order is rotation,
position, velocity, gyroscope bias, accelerometer bias, and further states.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number, kernel
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements.inertial import InertialSensor

__all__ = ["Preintegrated", "attitude", "gravity", "preintegrate"]

# Internal functions without checks: their arguments were checked, or made here.
_EXP, _HAT = kernel(rotations.exp), kernel(rotations.hat)
_LEFT_JACOBIAN = kernel(rotations.left_jacobian)
# Standard deviation of the mean acceleration of a body whose attitude is estimated, per axis.
_ACCELERATION_M_S2 = 0.5


class Preintegrated(NamedTuple):
    """The motion between two epochs from readings, in the body frame at the first epoch.

    Attributes
    ----------
    rotation, translation, velocity
        (..., 3, 3), (..., 3), (..., 3): the state reached from the identity, without gravity.
    jacobian
        (..., 9, 6): derivative of the errors of rotation (global), translation and velocity by
        the biases of gyroscope and accelerometer.
    covariance
        (..., 9, 9) of these errors due to the white noise of the readings.
    duration
        Seconds (...).
    bias
        (..., 6) that was subtracted from the readings.
    """

    rotation: FloatArray
    translation: FloatArray
    velocity: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    duration: FloatArray
    bias: FloatArray

    def corrected(self, bias: FloatArray) -> Preintegrated:
        """Return the first-order result for other biases (..., 6)."""
        change = (self.jacobian @ (bias - self.bias)[..., None])[..., 0]
        return self._replace(
            rotation=_EXP(change[..., :3]) @ self.rotation,
            translation=self.translation + change[..., 3:6],
            velocity=self.velocity + change[..., 6:],
        )


def preintegrate(
    readings: ArrayLike, steps: ArrayLike, bias: ArrayLike, sensor: InertialSensor
) -> Preintegrated:
    """Preintegrate the readings between two epochs.

    Parameters
    ----------
    readings
        (..., S, 6), rad/s and m/s^2 in the body frame.
    steps
        Duration of each sample, seconds, (..., S) or one for all; samples of zero duration have
        no effect.
    bias
        (..., 6) to subtract.
    sensor
        Noise of the sensor.

    Raises
    ------
    ValueError
        If a shape is wrong, a step is negative, or a value is NaN.
    """
    if not isinstance(sensor, InertialSensor):
        raise ValueError(f"sensor must be an InertialSensor, got {sensor!r:.80}")
    readings = check_array("readings", readings, ("S", 6))
    steps = check_steps(steps, readings)
    bias = check_array("bias", bias, (6,))
    return integrate(readings, steps, bias, sensor.numbers)


def check_steps(steps: ArrayLike, readings: FloatArray, name: str = "steps") -> FloatArray:
    """Return durations (..., S) of the samples of readings (..., S, 6), or raise with `name`."""
    steps = check_array(name, steps, ())
    if (steps < 0).any():
        raise ValueError(f"{name} must not be negative, got {steps.min():g}")
    count = readings.shape[-2]
    if steps.ndim and steps.shape[-1] != count:
        raise ValueError(
            f"{name} must be one number, or one for each of {count} samples, got shape "
            f"{steps.shape}"
        )
    return steps if steps.ndim else np.full(count, steps)


def steps_of(dt: ArrayLike, readings: FloatArray) -> FloatArray:
    """Return durations (..., S) of samples: `dt` of each, or of an interval that they share."""
    if isinstance(dt, list | tuple) or getattr(dt, "ndim", 0):
        return check_steps(dt, readings, "dt")
    count = readings.shape[-2]
    return np.full(count, check_number("dt", dt, low=0.0) / max(count, 1))


def integrate(
    readings: FloatArray, steps: FloatArray, bias: FloatArray, law: FloatArray
) -> Preintegrated:
    """Compute `preintegrate` without checks; `law` is `InertialSensor.numbers`.

    The noise of a sample acts at mid-rotation, where it is nearly isotropic.
    """
    batch = np.broadcast_shapes(readings.shape[:-2], steps.shape[:-1], bias.shape[:-1])
    rotation: FloatArray = np.broadcast_to(np.eye(3), (*batch, 3, 3))
    velocity: FloatArray = np.zeros((*batch, 3))
    translation = velocity
    J: FloatArray = np.zeros((*batch, 9, 6))
    N: FloatArray = np.zeros((*batch, 9, 9))
    I3 = np.eye(3)
    for k in range(readings.shape[-2]):
        h = steps[..., k, None]
        hh = h[..., None]
        reading = readings[..., k, :] - bias
        turn = reading[..., :3] * h
        half = rotation @ _EXP(0.5 * turn)
        force = (half @ reading[..., 3:, None])[..., 0]
        S = _HAT(force)
        # Errors: e' = e - A b_g;  force: -S e - half b_a + D b_g;  v' and t' follow from it.
        A = hh * rotation @ _LEFT_JACOBIAN(turn)
        D = 0.5 * hh * S @ rotation @ _LEFT_JACOBIAN(0.5 * turn)
        F = np.zeros((*batch, 9, 9))
        F[..., :, :] = np.eye(9)
        F[..., 3:6, 6:9] = hh * I3
        F[..., 3:6, :3], F[..., 6:9, :3] = -0.5 * hh**2 * S, -hh * S
        B = np.zeros((*batch, 9, 6))
        B[..., :3, :3] = -A
        B[..., 3:6, :3], B[..., 6:9, :3] = 0.5 * hh**2 * D, hh * D
        B[..., 3:6, 3:], B[..., 6:9, 3:] = -0.5 * hh**2 * half, -hh * half
        G = np.zeros((*batch, 9, 6))
        G[..., :3, :3] = -I3
        G[..., 3:6, :3], G[..., 6:9, :3] = 0.25 * hh**2 * S, 0.5 * hh * S
        G[..., 3:6, 3:], G[..., 6:9, 3:] = 0.5 * hh * I3, I3
        J = F @ J + B
        white = hh * np.repeat(law[:2], 3)
        N = F @ N @ np.swapaxes(F, -1, -2) + (G * white) @ np.swapaxes(G, -1, -2)
        translation = translation + velocity * h + 0.5 * force * h**2
        velocity = velocity + force * h
        rotation = rotation @ _EXP(turn)
    duration = np.broadcast_to(steps.sum(axis=-1), batch)
    bias = np.broadcast_to(bias, (*batch, 6))
    return Preintegrated(rotation, translation, velocity, J, N, duration, bias)


def gravity(tilt: ArrayLike, magnitude: float) -> FloatArray:
    """Return gravity (..., 3) in a world frame tilted from the vertical by ``exp((tilt, 0))``.

    Parameters
    ----------
    tilt
        The x and y components (..., 2) of the rotation vector, radians.
    magnitude
        m/s^2.
    """
    return -magnitude * _EXP(_level(check_array("tilt", tilt, (2,))))[..., 2]


def _level(tilt: FloatArray) -> FloatArray:
    """Return rotation vectors (..., 3) about the x and y axes of the world."""
    return np.concatenate([tilt, np.zeros_like(tilt[..., :1])], axis=-1)


def gravity_jacobian(tilt: FloatArray, magnitude: float) -> FloatArray:
    """Return the derivative (..., 3, 2) of `gravity` by the tilt."""
    down = gravity(tilt, magnitude)
    return -(_HAT(down) @ _LEFT_JACOBIAN(_level(tilt)))[..., :2]


@compiled("navigation:propagate")
def propagate(
    rotation: FloatArray,
    translation: FloatArray,
    extra: FloatArray,
    covariance: FloatArray,
    readings: FloatArray,
    steps: FloatArray,
    law: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return state and covariance after the samples of an interval.

    `extra` (..., K) are velocity, biases, the tilt of gravity (2) if the last entry of `law` is not
    0, and constant states; `covariance` is (..., 6 + K, 6 + K). `readings` (..., S, 6) last `steps`
    (..., S) seconds each. `law` (6,) is `InertialSensor.numbers`, and whether the tilt is a state.
    """
    tilted = law[5] != 0
    down = np.array([0.0, 0.0, -law[4]])
    if tilted:
        down = gravity(extra[..., 9:11], law[4])
    moved = integrate(readings, steps, extra[..., 3:9], law)
    T = np.asarray(moved.duration)[..., None]
    velocity = extra[..., :3]
    gone = (rotation @ moved.translation[..., None])[..., 0]
    sped = (rotation @ moved.velocity[..., None])[..., 0]
    n = covariance.shape[-1]
    batch = moved.rotation.shape[:-2]
    batch = np.broadcast_shapes(batch, rotation.shape[:-2], covariance.shape[:-2])
    F = np.broadcast_to(np.eye(n), (*batch, n, n)).copy()
    F[..., 3:6, :3], F[..., 6:9, :3] = -_HAT(gone), -_HAT(sped)
    F[..., 3:6, 6:9] = T[..., None] * np.eye(3)
    turn = np.zeros((*batch, 9, 9))
    for block in (slice(0, 3), slice(3, 6), slice(6, 9)):
        turn[..., block, block] = rotation
    F[..., :9, 9:15] += turn @ moved.jacobian
    if tilted:
        lean = gravity_jacobian(extra[..., 9:11], law[4])
        F[..., 3:6, 15:17] = 0.5 * T[..., None] ** 2 * lean
        F[..., 6:9, 15:17] = T[..., None] * lean
    P = F @ covariance @ np.swapaxes(F, -1, -2)
    P[..., :9, :9] += turn @ moved.covariance @ np.swapaxes(turn, -1, -2)
    P[..., range(9, 15), range(9, 15)] += T * np.repeat(law[2:4], 3)
    after = np.broadcast_to(extra, (*batch, extra.shape[-1])).copy()
    after[..., :3] += down * T + sped
    return (
        rotation @ moved.rotation,
        translation + velocity * T + 0.5 * down * T**2 + gone,
        after,
        0.5 * (P + np.swapaxes(P, -1, -2)),
    )


def attitude(readings: ArrayLike, sensor: InertialSensor) -> tuple[FloatArray, FloatArray]:
    """Estimate the attitude of a body, without heading, from the mean specific force of readings.

    Parameters
    ----------
    readings
        (..., S, 6), while the mean acceleration of the body is small: a standard deviation of 0.5
        m/s^2 per axis is assumed.
    sensor
        Sensor with the standard deviation of its bias.

    Returns
    -------
    rotation
        (..., 3, 3), with yaw 0: ``exp((0, 0, yaw)) @ rotation`` is equally likely.
    covariance
        (..., 3, 3) of its global error, radians. About z it is the variance of a uniform heading.

    Raises
    ------
    ValueError
        If a shape is wrong, or the mean force is far from gravity: the body falls, or the units
        are wrong.
    """
    readings = check_array("readings", readings, ("S", 6))
    force = readings[..., 3:].mean(axis=-2)
    magnitude, usual = np.linalg.norm(force, axis=-1, keepdims=True), float(sensor.numbers[4])
    if (np.abs(magnitude / usual - 1) > 0.5).any():
        raise ValueError(
            f"readings must have a mean specific force near {usual:.2f} m/s^2, got "
            f"{float(magnitude.flat[0]):.3g} (are they in units of g, or was gravity removed?)"
        )
    up = force / magnitude
    # The row of the rotation that is the world vertical. Yaw 0: the body x axis has no y component.
    roll = np.arctan2(up[..., 1], up[..., 2])
    pitch = np.arctan2(-up[..., 0], np.hypot(up[..., 1], up[..., 2]))
    rotation = rotations.from_euler_zyx(0.0, pitch, roll)
    variance = (_ACCELERATION_M_S2**2 + sensor.accel_bias_m_s2**2) / usual**2
    covariance = np.diag([variance, variance, np.pi**2 / 3])
    return rotation, np.broadcast_to(covariance, rotation.shape).copy()
