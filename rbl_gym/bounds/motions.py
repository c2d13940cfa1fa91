"""Propagate information on body states over an interval, for three laws of motion.

Each law has a number of states, and `predict`s the joint information of these and of further
constant states. The pose is first among the states; its error is global.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds import twist
from rbl_gym.bounds.pose import symmetric
from rbl_gym.bounds.posterior import predict_information
from rbl_gym.checks import FloatArray, check_array, check_number
from rbl_gym.measurements.inertial import InertialSensor
from rbl_gym.motion import navigation
from rbl_gym.motion.kinematics import ProcessNoise, check_process
from rbl_gym.motion.unknown_twist import TwistSensor, WanderingTwist, check_laws

__all__ = ["InertialMotion", "KnownTwist", "Motion", "UnknownTwist"]


class Motion(Protocol):
    """The motion of the interval that ends at an epoch."""

    def checked(self) -> Motion:
        """Return the motion with its values as arrays; raise ValueError if one is invalid."""
        ...

    @property
    def sizes(self) -> tuple[int, ...]:
        """Return the possible numbers of body states."""
        ...

    @property
    def seconds(self) -> FloatArray:
        """Return the length (...) of the interval."""
        ...

    def predict(self, J: FloatArray, states: int, rotation: FloatArray) -> FloatArray:
        """Return the information (..., n, n) after the interval, which ends at this rotation.

        The first `states` of the n states of J are those of the body. NaN if J is singular but must
        be regular.
        """
        ...


class KnownTwist(NamedTuple):
    """Motion with known twist: 6 states, those of the pose.

    Attributes
    ----------
    twist
        (..., 6), rad/s and m/s.
    dt
        Seconds.
    process
        Process noise.
    """

    twist: ArrayLike
    dt: ArrayLike
    process: ProcessNoise

    sizes = (6,)

    def checked(self) -> KnownTwist:
        """See `Motion`."""
        dt = check_array("dt", self.dt, ())
        if (dt < 0).any():
            raise ValueError(f"dt must not be negative, got {self.dt}")
        check_process(self.process)
        return KnownTwist(check_array("twist", self.twist, (6,)), dt, self.process)

    @property
    def seconds(self) -> FloatArray:
        """See `Motion`."""
        return np.asarray(self.dt, dtype=np.float64)

    def predict(self, J: FloatArray, states: int, rotation: FloatArray) -> FloatArray:
        """See `posterior.predict_information`; J may be singular."""
        return predict_information(J, np.asarray(self.twist), self.dt, self.process)


class UnknownTwist(NamedTuple):
    """Motion with unknown twist, possibly measured by a sensor: 12 states, pose and twist.

    Attributes
    ----------
    twist
        True twist (..., 6) of the interval.
    dt, process, law
        Seconds, one number (`smoothing.smoothing_crb` takes one for each interval), and the laws of
        pose and twist.
    sensor
        Sensor of the twist of the interval; None: not measured.
    """

    twist: ArrayLike
    dt: ArrayLike
    process: ProcessNoise
    law: WanderingTwist
    sensor: TwistSensor | None = None

    sizes = (12,)

    def checked(self) -> UnknownTwist:
        """See `Motion`."""
        move, dt = check_array("twist", self.twist, (6,)), check_number("dt", self.dt, low=0.0)
        check_laws(self.law, self.process)
        if not isinstance(self.sensor, TwistSensor | None):
            raise ValueError(f"sensor must be a TwistSensor or None, got {self.sensor!r:.80}")
        return self._replace(twist=move, dt=dt)

    @property
    def seconds(self) -> FloatArray:
        """See `Motion`."""
        return np.asarray(self.dt, dtype=np.float64)

    def predict(self, J: FloatArray, states: int, rotation: FloatArray) -> FloatArray:
        """Return the inverse of `twist.predict_covariance`, after the sensor update."""
        move = np.asarray(self.twist)
        if self.sensor is not None:
            told = self.sensor.information(move)
            batch = np.broadcast_shapes(J.shape[:-2], told.shape[:-2])
            J = np.broadcast_to(J, (*batch, *J.shape[-2:])).copy()
            J[..., :12, :12] += told
        P = inverse(J)
        return inverse(
            twist.predict_covariance(P, move, float(self.seconds), self.process, self.law)
        )


class InertialMotion(NamedTuple):
    """Motion with an inertial sensor: 15 states of `motion.navigation`, 17 with gravity tilt.

    Attributes
    ----------
    readings, steps
        Readings (..., S, 6) without bias, and the duration of each sample in seconds, as in
        `navigation.preintegrate`.
    sensor
        Noise of the sensor.
    """

    readings: ArrayLike
    steps: ArrayLike
    sensor: InertialSensor

    sizes = (15, 17)

    def checked(self) -> InertialMotion:
        """See `Motion`."""
        readings = check_array("readings", self.readings, ("S", 6))
        if not isinstance(self.sensor, InertialSensor):
            raise ValueError(f"sensor must be an InertialSensor, got {self.sensor!r:.80}")
        return InertialMotion(readings, navigation.check_steps(self.steps, readings), self.sensor)

    @property
    def seconds(self) -> FloatArray:
        """See `Motion`."""
        return np.asarray(self.steps).sum(axis=-1)

    def predict(self, J: FloatArray, states: int, rotation: FloatArray) -> FloatArray:
        """Return the inverse of the covariance that `navigation.propagate` computes from J^-1."""
        readings, steps = np.asarray(self.readings), np.asarray(self.steps)
        law, no_bias = self.sensor.numbers, np.zeros(6)
        moved = navigation.integrate(readings, steps, no_bias, law)
        before = rotation @ np.swapaxes(moved.rotation, -1, -2)
        at_rest = np.zeros(J.shape[-1] - 6)
        P = navigation.propagate(
            before, np.zeros(3), at_rest, inverse(J), readings, steps, np.append(law, states > 15)
        )[3]
        return inverse(P)


def inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric matrix (..., n, n), NaN if it is singular."""
    try:
        with np.errstate(all="ignore"):
            return symmetric(np.linalg.inv(matrix))
    except np.linalg.LinAlgError:
        return np.full(matrix.shape, np.nan)
