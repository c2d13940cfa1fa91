"""Model inertial sensors: a gyroscope and an accelerometer on the body, with noise and biases.

A reading (6,) is the angular velocity [rad/s], then the specific force [m/s^2], both in the body
frame. The specific force is the acceleration minus gravity: a body at rest reads ``+9.81 m/s^2``
upwards. Each reading belongs to a short interval, a sample, in which it is taken as constant:

    gyroscope      w + b_g + n_g,               n_g white of density `gyro_noise`
    accelerometer  Q^T (a - g) + b_a + n_a,     n_a white of density `accel_noise`

White noise of density s has the variance ``s^2 / dt`` in a sample of dt seconds. The biases start
with a standard deviation and walk: the variance of their change is ``walk^2 dt``.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    FloatArray,
    check_array,
    check_generator,
    check_number,
    check_one_of,
    did_you_mean,
)
from rbl_gym.geometry import rotations

__all__ = [
    "GRAVITY_M_S2", "SENSORS", "InertialReadings", "InertialSensor", "sensor", "simulate",
    "specific_force", "turned",
]  # fmt: skip

# Standard gravity; it varies by 0.3 % over the earth.
GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class InertialSensor:
    """A 3-axis gyroscope and a 3-axis accelerometer; the defaults are of consumer grade.

    Parameters
    ----------
    rate_hz
        Samples per second.
    gyro_noise, accel_noise
        Densities of the white noise: rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
    gyro_walk, accel_walk
        Random walks of the biases: standard deviation of their change after 1 s, rad/s and m/s^2.
    gyro_bias_rad_s, accel_bias_m_s2
        Standard deviations of the biases at the start, per axis.
    gyro_limit_rad_s, accel_limit_m_s2
        Largest reading of an axis; larger values are clipped.

    Raises
    ------
    ValueError
        If a value is negative or not finite, or a density, a standard deviation or a limit is zero.
    """

    rate_hz: float = 100.0
    gyro_noise: float = 3e-4
    accel_noise: float = 4e-3
    gyro_walk: float = 3e-5
    accel_walk: float = 1e-3
    gyro_bias_rad_s: float = 0.01
    accel_bias_m_s2: float = 0.1
    gyro_limit_rad_s: float = 34.9
    accel_limit_m_s2: float = 78.5

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            low = 0.0 if name.endswith("_walk") else 1e-12
            object.__setattr__(self, name, check_number(name, getattr(self, name), low=low))

    @functools.cached_property
    def prior_std(self) -> FloatArray:
        """Return the initial standard deviations (6,) of the biases; read-only."""
        return _fixed([self.gyro_bias_rad_s] * 3 + [self.accel_bias_m_s2] * 3)

    @functools.cached_property
    def numbers(self) -> FloatArray:
        """Return arguments of `motion.navigation` (5,): variances of noises and walks after 1 s, g.

        The array is read-only.
        """
        std = (self.gyro_noise, self.accel_noise, self.gyro_walk, self.accel_walk)
        return _fixed([*np.square(std), GRAVITY_M_S2])

    def samples(self, dt: float) -> int:
        """Return the number of samples in an interval of `dt` seconds.

        Raises
        ------
        ValueError
            If it is not an integer.
        """
        count = round(self.rate_hz * dt)
        if count < 1 or abs(count / (self.rate_hz * dt) - 1) > 1e-6:
            raise ValueError(
                f"rate_hz must give a whole number of samples in dt = {dt:g} s, got "
                f"{self.rate_hz:g}"
            )
        return count


def _fixed(values: list[float]) -> FloatArray:
    array = np.array(values)
    array.flags.writeable = False
    return array


# From data sheets: the sensor of a phone or drone; fibre-optic or the best MEMS sensors.
SENSORS: dict[str, InertialSensor] = {
    "consumer": InertialSensor(),
    "tactical": InertialSensor(
        gyro_noise=4.4e-5,
        accel_noise=1e-3,
        gyro_walk=1e-6,
        accel_walk=5e-5,
        gyro_bias_rad_s=1e-4,
        accel_bias_m_s2=0.015,
        gyro_limit_rad_s=7.0,
        accel_limit_m_s2=98.0,
    ),
}


def sensor(value: str | Mapping[str, Any] | InertialSensor) -> InertialSensor:
    """Return an inertial sensor from its name, or from a mapping as in JSON and TOML files.

    Parameters
    ----------
    value
        A name in `SENSORS`; or a mapping with the fields that differ from the sensor named by
        ``"kind"`` (default ``"consumer"``); or an `InertialSensor`.

    Raises
    ------
    ValueError
        If a name or field is unknown, or a value is invalid.
    """
    if isinstance(value, InertialSensor):
        return value
    if isinstance(value, str):
        value = {"kind": value}
    if not isinstance(value, Mapping):
        raise ValueError(f"inertial must be a name or a dict of its fields, got {value!r:.80}")
    kind = check_one_of("inertial.kind", value.get("kind", "consumer"), list(SENSORS))
    fields = {**vars(SENSORS[kind])}
    known = list(InertialSensor.__dataclass_fields__)
    for key, number in value.items():
        if key != "kind" and key not in known:
            raise ValueError(
                f"inertial has no field {key!r}; its fields are {', '.join(known)}"
                f"{did_you_mean(key, known)}"
            )
        fields[key] = number
    return InertialSensor(**{key: fields[key] for key in known})


def specific_force(rotation: ArrayLike, acceleration: ArrayLike) -> FloatArray:
    """Return the reading (..., 3) of an ideal accelerometer, in the body frame.

    Parameters
    ----------
    rotation, acceleration
        (..., 3, 3), and (..., 3) in the world frame, m/s^2; the z axis of the world frame points
        upwards.
    """
    rotation = check_array("rotation", rotation, (3, 3))
    force = check_array("acceleration", acceleration, (3,)) + np.array([0, 0, GRAVITY_M_S2])
    return (np.swapaxes(rotation, -1, -2) @ force[..., None])[..., 0]


class InertialReadings(NamedTuple):
    """Readings of a sensor, and their biases.

    Attributes
    ----------
    readings
        (..., K, 6), rad/s and m/s^2, noisy, clipped to the limits.
    bias
        (..., K, 6), the bias of each reading.
    """

    readings: FloatArray
    bias: FloatArray


def simulate(
    sensor: InertialSensor,
    turn_rate: ArrayLike,
    force: ArrayLike,
    rng: np.random.Generator,
    dt: float | None = None,
) -> InertialReadings:
    """Simulate the readings of a moving body.

    Parameters
    ----------
    sensor
        The sensor.
    turn_rate, force
        True angular velocity and `specific_force` (..., K, 3) in the body frame in the middle of
        each sample, as from `motion.smooth`.
    rng
        Source of all randomness.
    dt
        Duration of a sample, seconds; None: ``1 / rate_hz``.

    Raises
    ------
    ValueError
        If a shape or value is wrong, or the sensor or generator is invalid.
    """
    if not isinstance(sensor, InertialSensor):
        raise ValueError(f"sensor must be an InertialSensor, got {sensor!r:.80}")
    check_generator("rng", rng)
    turn_rate, force = (
        check_array("turn_rate", turn_rate, ("K", 3)),
        check_array("force", force, ("K", 3)),
    )
    felt = np.concatenate(np.broadcast_arrays(turn_rate, force), axis=-1)
    dt = 1 / sensor.rate_hz if dt is None else check_number("dt", dt, low=1e-12)
    start = rng.standard_normal((*felt.shape[:-2], 6))
    normals = rng.standard_normal((*felt.shape[:-2], 2 * felt.shape[-2], 6))
    return disturbed(sensor, felt, start, normals, dt)


def disturbed(
    sensor: InertialSensor, felt: FloatArray, start: FloatArray, normals: FloatArray, dt: float
) -> InertialReadings:
    """Add errors to true readings (..., K, 6), from standard normals (..., 6) and (..., 2 K, 6)."""
    count = felt.shape[-2]
    white, walk = (np.sqrt(np.repeat(pair, 3)) for pair in np.split(sensor.numbers[:4], 2))
    bias = np.cumsum(walk * np.sqrt(dt) * normals[..., count:, :], axis=-2)
    # The first reading has the initial bias.
    bias = np.concatenate([np.zeros_like(bias[..., :1, :]), bias[..., :-1, :]], axis=-2)
    bias += (sensor.prior_std * start)[..., None, :]
    limit = np.repeat([sensor.gyro_limit_rad_s, sensor.accel_limit_m_s2], 3)
    noisy = felt + bias + white / np.sqrt(dt) * normals[..., :count, :]
    return InertialReadings(np.clip(noisy, -limit, limit), bias)


def turned(readings: ArrayLike, rotation: ArrayLike) -> FloatArray:
    """Rotate readings (..., 6) from the sensor frame to the body frame.

    Parameters
    ----------
    readings
        (..., 6) in the sensor frame.
    rotation
        (3, 3) from the sensor frame to the body frame.
    """
    readings = check_array("readings", readings, (6,))
    rotation = rotations.check_rotation("rotation", rotation)
    pairs = readings.reshape(*readings.shape[:-1], 2, 3) @ rotation.T
    return pairs.reshape(readings.shape)
