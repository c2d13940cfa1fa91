"""Model a body with unknown twist: its law, simulated trajectories, and its 12 states.

The twist (angular velocity in the world frame, then velocity) is a random walk driven by white
acceleration. The pose follows it:

    Q[k+1] = exp(W[k] dt + n_w) Q[k],   t[k+1] = t[k] + V[k] dt + n_v,   twist[k+1] = twist[k] + n_a

with ``(n, n_a)`` of a step jointly Gaussian for an acceleration that is white over the step:
variances ``q dt^3 / 3`` and ``q dt``, covariance ``q dt^2 / 2``. A `ProcessNoise` is added to the
pose, on the twist side of the left Jacobian as in the rest of the package. The error of the 12
states is ``(w, v, dW, dV)``: the usual pose error, then estimate minus truth of the twist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    Axes,
    FloatArray,
    check_array,
    check_axes,
    check_count,
    check_generator,
    check_number,
    check_one_of,
)
from rbl_gym.geometry import rotations
from rbl_gym.motion.kinematics import ProcessNoise, check_process, six

__all__ = ["FRAMES", "TwistSensor", "WanderingPath", "WanderingTwist", "simulate_wandering"]

FRAMES = ("world", "body")


@dataclass(frozen=True)
class WanderingTwist:
    """The law of an unknown twist.

    All fields are a float, or three floats for the world axes (some are zero for a planar body).

    Parameters
    ----------
    turn_rate_rad_s, speed_m_s
        Standard deviations of the initial angular velocity and velocity about zero, per axis.
    turn_acceleration, acceleration
        Standard deviations of their change after 1 s (rad/s, m/s).

    Raises
    ------
    ValueError
        If a value is negative or not finite, or there are not 1 or 3 values.
    """

    turn_rate_rad_s: Axes = 0.5
    speed_m_s: Axes = 5.0
    turn_acceleration: Axes = 0.3
    acceleration: Axes = 1.0

    def __post_init__(self) -> None:
        for name in ("turn_rate_rad_s", "speed_m_s", "turn_acceleration", "acceleration"):
            object.__setattr__(self, name, check_axes(name, getattr(self, name)))

    def prior_std(self) -> FloatArray:
        """Return the standard deviations (6,) of the initial twist."""
        return six(self.turn_rate_rad_s, self.speed_m_s)

    def std(self) -> FloatArray:
        """Return the standard deviations (6,) of the change of the twist after 1 s."""
        return six(self.turn_acceleration, self.acceleration)


@dataclass(frozen=True)
class TwistSensor:
    """A gyroscope and a velocity sensor with white noise, read once per interval.

    Parameters
    ----------
    gyro_std_rad_s, speed_std_m_s
        Standard deviation of a reading, per axis; None: not measured.
    frame
        Axes of the readings: ``"world"``, as for all twists in this package, or ``"body"``, as for
        a sensor on the body.
    """

    gyro_std_rad_s: float | None = None
    speed_std_m_s: float | None = None
    frame: str = "world"

    def __post_init__(self) -> None:
        check_one_of("frame", self.frame, FRAMES)
        for name in ("gyro_std_rad_s", "speed_std_m_s"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), low=1e-12)

    def std(self) -> FloatArray:
        """Return the standard deviations (6,) of a twist reading, infinite if not measured."""
        values = (self.gyro_std_rad_s, self.speed_std_m_s)
        return np.repeat([np.inf if value is None else value for value in values], 3)

    def read(self, rotation: FloatArray, twist: FloatArray) -> FloatArray:
        """Return the noise-free reading (..., 6) of a twist (..., 6)."""
        if self.frame == "world":
            return twist
        return _turned(np.swapaxes(rotation, -1, -2), twist)

    def in_world(self, rotation: FloatArray, reading: FloatArray) -> FloatArray:
        """Return a reading (..., 6) rotated to world axes by a rotation (..., 3, 3)."""
        return reading if self.frame == "world" else _turned(rotation, reading)

    def jacobian(self, twist: FloatArray) -> FloatArray:
        """Return the derivative (..., 6, 12) of the reading, in world axes, by the state error.

        In the body frame the reading depends on the rotation: ``Q_hat Q^T W = W - w x W``.
        Therefore the error of the prediction is ``dW + W x w``.
        """
        H = np.zeros((*twist.shape[:-1], 6, 12))
        H[..., 6:] = np.eye(6)
        if self.frame == "body":
            H[..., :3, :3] = rotations.hat(twist[..., :3])
            H[..., 3:, :3] = rotations.hat(twist[..., 3:])
        return H

    def information(self, twist: FloatArray) -> FloatArray:
        """Return the Fisher information (..., 12, 12) of one reading about the states."""
        H = self.jacobian(twist)
        return np.swapaxes(H, -1, -2) @ (H / self.std()[:, None] ** 2)


class WanderingPath(NamedTuple):
    """Poses and twists at T + 1 epochs; each twist is that of the interval after the epoch."""

    rotation: FloatArray  # (..., T + 1, 3, 3)
    translation: FloatArray  # (..., T + 1, 3) metres
    twists: FloatArray  # (..., T + 1, 6)


def simulate_wandering(
    rotation: ArrayLike,
    translation: ArrayLike,
    law: WanderingTwist,
    process: ProcessNoise,
    dt: float,
    steps: int,
    rng: np.random.Generator,
) -> WanderingPath:
    """Simulate trajectories from the law, one for each start (..., 3, 3), (..., 3).

    Parameters
    ----------
    rotation, translation
        Start poses (..., 3, 3), (..., 3).
    law, process
        Law of the twist, and the process noise added to the pose.
    dt, steps
        Length of a step in seconds, and the number of steps.
    rng
        Source of all randomness.

    Raises
    ------
    ValueError
        If a shape or value is wrong, or a law or generator is invalid.
    """
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    dt = check_number("dt", dt, low=1e-12)
    steps = check_count("steps", steps)
    check_laws(law, process)
    check_generator("rng", rng)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    twists = np.empty((steps + 1, *batch, 6))
    twists[0] = law.prior_std() * rng.standard_normal((*batch, 6))
    Q = np.empty((steps + 1, *batch, 3, 3))
    t = np.empty((steps + 1, *batch, 3))
    Q[0], t[0] = rotation, translation
    for k in range(steps):
        z = rng.standard_normal((3, *batch, 6))
        change = np.sqrt(dt) * law.std() * z[0]
        # The change of velocity explains dt / 2 times itself of the change of position. The
        # remainder has the variance q dt^3 / 12.
        moved = 0.5 * dt * change + np.sqrt(dt**3 / 12) * law.std() * z[1]
        moved = moved + np.sqrt(dt) * process.std() * z[2] + dt * twists[k]
        Q[k + 1] = rotations.exp(moved[..., :3]) @ Q[k]
        t[k + 1] = t[k] + moved[..., 3:]
        twists[k + 1] = twists[k] + change
    axes = range(1, 1 + len(batch))
    return WanderingPath(
        Q.transpose((*axes, 0, -2, -1)),
        t.transpose((*axes, 0, -1)),
        twists.transpose((*axes, 0, -1)),
    )


def check_laws(law: WanderingTwist, process: ProcessNoise) -> None:
    """Raise ValueError if the law of the twist or the process noise has the wrong type."""
    if not isinstance(law, WanderingTwist):
        raise ValueError(f"law must be a WanderingTwist, got {law!r:.80}")
    check_process(process)


def _turned(rotation: FloatArray, twist: FloatArray) -> FloatArray:
    """Return a twist (..., 6) with both halves rotated."""
    halves = twist.reshape((*twist.shape[:-1], 2, 3)) @ np.swapaxes(rotation, -1, -2)
    return halves.reshape((*halves.shape[:-2], 6))
