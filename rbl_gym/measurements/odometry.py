"""Model odometry: velocity and turn rate of a body in its own axes, with noise, scale and bias.

A reading is ``y = (1 + s) x + b + n`` with the twist x of the body (turn rate, then velocity): one
scale error for all turn rates and one for all velocities, a bias of each turn rate, and white
noise. Sideways and vertical velocity, which wheels cannot have, read as zero with their own noise.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_generator, check_number

__all__ = ["OdometrySensor"]


@dataclass(frozen=True)
class OdometrySensor:
    """Error model of odometry readings.

    Noise is white. It is given as the error accumulated in 1 s. A reading over dt seconds has
    ``1 / sqrt(dt)`` times this standard deviation, for any rate of the sensor.

    Parameters
    ----------
    speed_noise, slip_noise
        Standard deviation of dead reckoning after 1 s (m): forwards, and sideways and vertical.
    turn_noise
        The same for the rotation about each axis (rad).
    speed_scale_std, turn_scale_std
        Standard deviation of the scale errors, which are constant: 0.01 is one per cent.
    turn_bias_rad_s
        Standard deviation of the constant biases of the turn rates, per axis.

    Raises
    ------
    ValueError
        If a value is negative or not finite, or a noise is not positive.
    """

    speed_noise: float = 0.05
    slip_noise: float = 0.03
    turn_noise: float = 0.05
    speed_scale_std: float = 0.05
    turn_scale_std: float = 0.05
    turn_bias_rad_s: float = 0.01

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            low = 1e-9 if field.name.endswith("noise") else 0.0
            check_number(field.name, getattr(self, field.name), low=low)

    def noise(self) -> FloatArray:
        """Return the noise accumulated in 1 s on each axis (6,): rotation (rad), distance (m)."""
        return np.array([self.turn_noise] * 3 + [self.speed_noise] + [self.slip_noise] * 2)

    def calibration_std(self) -> FloatArray:
        """Return standard deviations (5,) of the scales of turn rate and speed, and the biases."""
        return np.array([self.turn_scale_std, self.speed_scale_std, *[self.turn_bias_rad_s] * 3])

    def read(
        self,
        twists: ArrayLike,
        dt: float,
        rng: np.random.Generator,
        calibration: ArrayLike | None = None,
    ) -> FloatArray:
        """Simulate readings (..., 6) of twists (..., 6) in the body frame, one every `dt` seconds.

        Parameters
        ----------
        twists
            Turn rate (rad/s), then speed (m/s).
        dt
            Duration of each reading, seconds.
        rng
            Source of all randomness.
        calibration
            (5,) scales and biases, in the order of `calibration_std`; None: drawn.

        Raises
        ------
        ValueError
            If a shape or value is wrong.
        """
        twists = check_array("twists", twists, (6,))
        dt = check_number("dt", dt, low=1e-9)
        check_generator("rng", rng)
        if calibration is None:
            calibration = self.calibration_std() * rng.standard_normal(5)
        calibration = check_array("calibration", calibration, (5,))
        noise = self.noise() / np.sqrt(dt) * rng.standard_normal(twists.shape)
        return expected(twists, calibration) + noise


def expected(twist: FloatArray, calibration: FloatArray) -> FloatArray:
    """Return noise-free readings (..., 6) of twists (..., 6), for scales and biases (..., 5)."""
    scale = 1 + np.repeat(calibration[..., :2], 3, axis=-1)
    bias = np.concatenate([calibration[..., 2:], np.zeros(calibration[..., 2:].shape)], axis=-1)
    return scale * twist + bias
