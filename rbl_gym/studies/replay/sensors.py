"""Settings of the sensors on a recorded body."""

from __future__ import annotations

import dataclasses
import math

from rbl_gym.checks import check_count, check_number
from rbl_gym.measurements.inertial import InertialSensor
from rbl_gym.measurements.odometry import OdometrySensor

__all__ = ["Inertial", "Odometry"]


@dataclasses.dataclass(frozen=True)
class Odometry:
    """Error model and clock of the odometry of a recording.

    Parameters
    ----------
    odometry_m, slip_m, odometry_deg
        Standard deviations of the error of dead reckoning after 1 s: forwards, sideways and
        vertically, and of the rotation.
    odometry_scale
        Standard deviation of the scale errors of speeds and turn rates, which are estimated.
    odometry_bias_deg_s
        Standard deviation of the biases of its turn rates, which are estimated (deg/s).
    odometry_offset_s
        How far its clock is ahead of that of the ranges, seconds.
    headings
        Number of start headings of the filter, if none is given.
    """

    odometry_m: float = 0.05
    slip_m: float = 0.03
    odometry_deg: float = 6.0
    odometry_scale: float = 0.03
    odometry_bias_deg_s: float = 0.5
    odometry_offset_s: float = 0.0
    headings: int = 12

    def __post_init__(self) -> None:
        for name in ("odometry_m", "slip_m", "odometry_deg"):
            check_number(name, getattr(self, name), low=1e-6)
        for name in ("odometry_scale", "odometry_bias_deg_s"):
            check_number(name, getattr(self, name), low=0.0)
        check_number("odometry_offset_s", self.odometry_offset_s)
        check_count("headings", self.headings)

    def sensor(self) -> OdometrySensor:
        """Return the error model of its readings."""
        return OdometrySensor(
            speed_noise=self.odometry_m,
            slip_noise=self.slip_m,
            turn_noise=math.radians(self.odometry_deg),
            speed_scale_std=self.odometry_scale,
            turn_scale_std=self.odometry_scale,
            turn_bias_rad_s=math.radians(self.odometry_bias_deg_s),
        )


@dataclasses.dataclass(frozen=True)
class Inertial:
    """Error model and clock of the inertial sensor of a recording.

    Its biases are 0.01 rad/s and 0.06 m/s^2 at the start, and wander by 1e-4 rad/s/sqrt(s) and
    2e-3 m/s^2/sqrt(s) (standard deviations).

    Parameters
    ----------
    gyro_noise, accel_noise
        Densities of its white noise, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz). The defaults are at
        least ten times those of a data sheet. They include vibration, and the lever arm of the
        sensor to the body origin.
    gravity_tilt_deg
        Standard deviation of the angle between the world z axis and the vertical.
    recorded_share
        The standard deviations of the ranges in a recording are multiplied by this factor, to that
        of the white noise. The rest of the errors are lasting biases, which the filter estimates.
    imu_offset_s
        How far its clock is ahead of that of the ranges, seconds.
    """

    gyro_noise: float = 3e-3
    accel_noise: float = 0.05
    gravity_tilt_deg: float = 1.0
    recorded_share: float = 0.5
    imu_offset_s: float = 0.0

    def __post_init__(self) -> None:
        check_number("imu_offset_s", self.imu_offset_s)
        check_number("gravity_tilt_deg", self.gravity_tilt_deg, low=0.0, high=20.0)
        check_number("recorded_share", self.recorded_share, low=1e-3)
        self.sensor()  # checks the densities

    def sensor(self) -> InertialSensor:
        """Return the error model of its readings."""
        return InertialSensor(
            gyro_noise=self.gyro_noise,
            accel_noise=self.accel_noise,
            gyro_walk=1e-4,
            gyro_bias_rad_s=0.01,
            accel_walk=2e-3,
            accel_bias_m_s2=0.06,
        )
