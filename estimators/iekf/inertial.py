"""The iterated EKF with prediction by an inertial sensor between epochs of ranges.

Error states: rotation (global), position, velocity, biases of gyroscope and accelerometer (15);
optionally the tilt of gravity (2), if the z axis of the world is not exactly vertical; then link
biases. Readings between two epochs are integrated by `motion.navigation`; ranges update the
pose as in `AugmentedEkf`, and the other states by correlation.
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
    """Iterated extended Kalman filter of pose, velocity and biases with an inertial sensor.

    Parameters
    ----------
    pose, biases
        As in `AugmentedEkf`. The `process` of the pose filter is not used, because the motion is
        measured with the noise of the sensor.
    twist, sensor
        None.
    inertial
        The sensor.
    speed_m_s
        Standard deviation of the initial velocity about zero, per axis.
    gravity_tilt_rad
        Standard deviation per axis of the angle between the world z axis and the vertical; 0: no
        tilt, and no states for it.
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
        """Return the law for `navigation.propagate`."""
        return np.append(self.inertial.numbers, self.gravity_tilt_rad > 0)

    @functools.cached_property
    def _prior_std(self) -> FloatArray:
        tilt = [self.gravity_tilt_rad] * (self._n_twist - _NAVIGATION)
        return np.concatenate([[self.speed_m_s] * 3, self.inertial.prior_std, tilt])

    def predict(  # pyrefly: ignore[bad-override-param-name]
        self, state: AugmentedState, readings: ArrayLike, dt: ArrayLike
    ) -> AugmentedState:
        """Return the state after the samples of an interval.

        Parameters
        ----------
        readings
            (..., S, 6): angular velocity (rad/s) and specific force (m/s^2) in the body frame.
        dt
            Duration of the interval, shared equally by its samples, or of each sample, (..., S),
            seconds.

        Raises
        ------
        ValueError
            If a shape is wrong, a value is NaN, or a time is negative.
        """
        readings = check_array("readings", readings, ("S", 6))
        steps, state = navigation.steps_of(dt, readings), plain(state)
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
    """Return extra states and covariance after `dt` seconds (...), over which biases decorrelate.

    `laws` (n, 3) are the biases' standard deviation, time (infinite: constant), and common standard
    deviation. `n_twist` is the number of extra states that are not biases.
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
