"""Odometry: speed and turn rate of a body in its own axes, with noise, scale and bias.

A reading is ``y = (1 + s) x + b + n`` of the body's twist x (turn rate, then speed): one scale of
all turn rates and one of all speeds, a bias of each turn rate, white noise. What wheels cannot do,
sideways and vertical speed, reads as zero, with a noise of its own.
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
    """What readings of odometry are worth.

    Noise is white: what it adds to the way in 1 s, so that a reading that counts for dt seconds
    has ``1 / sqrt(dt)`` times that, at whatever rate the sensor reads.

    Parameters
    ----------
    speed_noise, slip_noise
        Forwards, and sideways and vertical: by how much dead reckoning is off after 1 s (m).
    turn_noise
        The same of the rotation about each axis (rad).
    speed_scale_std, turn_scale_std
        Standard deviation of the scale errors, which are constant: 0.01 is one per cent.
    turn_bias_rad_s
        Of the biases of the turn rates, which are constant, per axis.

    Raises
    ------
    ValueError
        On a value that is negative or not finite, and noise that is not positive.
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
        """What the noise of each axis (6,) adds in 1 s: turns (rad), then ways (m)."""
        return np.array([self.turn_noise] * 3 + [self.speed_noise] + [self.slip_noise] * 2)

    def calibration_std(self) -> FloatArray:
        """Standard deviations (5,) of the scales of turn and speed, and of the biases."""
        return np.array([self.turn_scale_std, self.speed_scale_std, *[self.turn_bias_rad_s] * 3])

    def read(
        self,
        twists: ArrayLike,
        dt: float,
        rng: np.random.Generator,
        calibration: ArrayLike | None = None,
    ) -> FloatArray:
        """Readings (..., 6) of twists (..., 6) in the body frame, one every `dt` seconds.

        Parameters
        ----------
        twists
            Turn rate (rad/s), then speed (m/s).
        dt
            Seconds for which each reading counts.
        rng
            Source of all randomness.
        calibration
            (5,) scales and biases, as of `calibration_std`; None: drawn.

        Raises
        ------
        ValueError
            On wrong shapes and values.
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
    """Readings (..., 6) without noise of twists (..., 6), of scales and biases (..., 5)."""
    scale = 1 + np.repeat(calibration[..., :2], 3, axis=-1)
    bias = np.concatenate([calibration[..., 2:], np.zeros(calibration[..., 2:].shape)], axis=-1)
    return scale * twist + bias
