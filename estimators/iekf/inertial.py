"""The iterated EKF that an inertial sensor carries from one epoch of ranges to the next.

Error states: rotation (global), place, velocity, biases of gyroscope and accelerometer (15); if
asked for the tilt of gravity (2), where the world's z axis is not quite vertical; then biases of
the links. Readings between two epochs are integrated by `motion.navigation`; ranges update the
pose as in `AugmentedEkf`, and the other states follow from it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number
from rbl_gym.estimators.costs.bias_cost import AugmentedState
from rbl_gym.estimators.iekf.augmented import AugmentedEkf
from rbl_gym.estimators.inputs import check_batches, plain
from rbl_gym.kernels import compiled
from rbl_gym.measurements.inertial import SENSORS, InertialSensor
from rbl_gym.motion import navigation

# Velocity and the two biases.
_NAVIGATION = 9


@dataclass(frozen=True, eq=False)
class InertialEkf(AugmentedEkf):
    """Iterated extended Kalman filter of pose, velocity and biases, moved by an inertial sensor.

    Parameters
    ----------
    pose, biases
        As `AugmentedEkf`; the `process` of the filter of the pose is not used: what moves the body
        is measured, and its noise is the sensor's.
    twist, sensor
        None.
    inertial
        The sensor.
    speed_m_s
        Standard deviation of the first velocity about zero, per axis.
    gravity_tilt_rad
        Standard deviation per axis of the angle between the world's z axis and the vertical;
        0: there is none, and no states for it.
    """

    inertial: InertialSensor = field(default_factory=lambda: SENSORS["consumer"])
    speed_m_s: float = 1.0
    gravity_tilt_rad: float = 0.0
    reads: ClassVar[str] = "inertial"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("speed_m_s", self.speed_m_s, low=1e-9)
        check_number("gravity_tilt_rad", self.gravity_tilt_rad, low=0.0, high=0.5)

    @property
    def _n_twist(self) -> int:
        return _NAVIGATION + 2 * (self.gravity_tilt_rad > 0)

    @functools.cached_property
    def _law(self) -> FloatArray:
        """As `navigation.propagate` takes it."""
        return np.append(self.inertial.numbers, self.gravity_tilt_rad > 0)

    @functools.cached_property
    def _prior_std(self) -> FloatArray:
        tilt = [self.gravity_tilt_rad] * (self._n_twist - _NAVIGATION)
        return np.concatenate([[self.speed_m_s] * 3, self.inertial.prior_std, tilt])

    def predict(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, state: AugmentedState, readings: ArrayLike, dt: ArrayLike
    ) -> AugmentedState:
        """State after the samples of an interval.

        Parameters
        ----------
        readings
            (..., S, 6): angular velocity (rad/s) and specific force (m/s^2) in the body frame.
        dt
            Seconds of the interval, which its samples share alike; or of each sample, (..., S).

        Raises
        ------
        ValueError
            On wrong shapes, NaN, negative times.
        """
        readings = check_array("readings", readings, ("S", 6))
        if isinstance(dt, list | tuple) or getattr(dt, "ndim", 0):
            steps = navigation.check_steps(dt, readings, "dt")
        else:
            count = readings.shape[-2]
            steps = np.full(count, check_number("dt", dt, low=0.0) / count)
        state = plain(state)
        check_batches(state=state.translation.shape[:-1], readings=readings.shape[:-2])
        moved = navigation.propagate(*state, readings, steps, self._law)
        if any(law.time_s is not None for law in self.biases):
            faded = fade(*moved[2:], self._laws, steps.sum(axis=-1), self._n_twist)
            moved = (*moved[:2], *faded)
        return AugmentedState(*moved)


@compiled("carried_states:fade")
def fade(
    extra: FloatArray, covariance: FloatArray, laws: FloatArray, dt: FloatArray, n_twist: int
) -> tuple[FloatArray, FloatArray]:
    """Extra states and covariance after `dt` seconds (...): biases of the links are forgotten.

    Parameters
    ----------
    extra, covariance
        As of `AugmentedState`.
    laws
        (n, 3) of the biases: standard deviation, time (infinite: constant), common deviation.
    dt, n_twist
        Seconds (...), and how many of the extra states are no biases.
    """
    start = 6 + n_twist
    links = (covariance.shape[-1] - start) // len(laws)
    dt = np.asarray(dt)[..., None]
    rates = 1 / laws[:, 1]
    kept = np.exp(-dt * np.concatenate([np.zeros(start), np.repeat(rates, links)]))
    P = covariance * kept[..., :, None] * kept[..., None, :]
    for k, (std, _, common) in enumerate(laws):
        block = slice(start + k * links, start + (k + 1) * links)
        fresh = (1 - np.exp(-2 * rates[k] * dt))[..., None]
        P[..., block, block] += fresh * (std**2 * np.eye(links) + common**2)
    return extra * kept[..., 6:], P
