"""A body whose twist nobody tells: its law, trajectories drawn from it, the bound of 12 states.

The twist (angular velocity in the world frame, then velocity) wanders by white acceleration;
the pose follows it:

    Q[k+1] = exp(W[k] dt + n_w) Q[k],   t[k+1] = t[k] + V[k] dt + n_v,   twist[k+1] = twist[k] + n_a

with ``(n, n_a)`` of a step jointly Gaussian as an acceleration that is white over the step makes
them: variances ``q dt^3 / 3`` and ``q dt``, covariance ``q dt^2 / 2``. What a `ProcessNoise` adds
to the pose comes on top, on the twist's side of the left Jacobian as everywhere. The error of the
12 states is ``(w, v, dW, dV)``: that of the pose as everywhere, then estimate less truth.
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

__all__ = [
    "FRAMES",
    "TwistSensor",
    "WanderingPath",
    "WanderingTwist",
    "simulate_wandering",
]

FRAMES = ("world", "body")


@dataclass(frozen=True)
class WanderingTwist:
    """Law of an unknown twist.

    All fields are a float, or three of them for the world's axes (a planar body has zeros among
    them).

    Parameters
    ----------
    turn_rate_rad_s, speed_m_s
        Standard deviations of the first angular velocity and velocity about zero, per axis.
    turn_acceleration, acceleration
        By how much they wander: standard deviations of their change after 1 s (rad/s, m/s).

    Raises
    ------
    ValueError
        If a value is negative or not finite, or there are neither 1 nor 3.
    """

    turn_rate_rad_s: Axes = 0.5
    speed_m_s: Axes = 5.0
    turn_acceleration: Axes = 0.3
    acceleration: Axes = 1.0

    def __post_init__(self) -> None:
        for name in ("turn_rate_rad_s", "speed_m_s", "turn_acceleration", "acceleration"):
            object.__setattr__(self, name, check_axes(name, getattr(self, name)))

    def prior_std(self) -> FloatArray:
        """Standard deviations (6,) of the first twist."""
        return six(self.turn_rate_rad_s, self.speed_m_s)

    def std(self) -> FloatArray:
        """Standard deviations (6,) of the twist's change after 1 s."""
        return six(self.turn_acceleration, self.acceleration)


@dataclass(frozen=True)
class TwistSensor:
    """A gyroscope and a speedometer with white noise, read once an interval.

    Parameters
    ----------
    gyro_std_rad_s, speed_std_m_s
        Standard deviation of a reading, per axis; None: not measured.
    frame
        Axes of the readings: ``"world"``, as twists are everywhere in this package, or
        ``"body"``, as a sensor on the body has them.
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
        """Standard deviations (6,) of a reading of the twist, infinite where it is not measured."""
        values = (self.gyro_std_rad_s, self.speed_std_m_s)
        return np.repeat([np.inf if value is None else value for value in values], 3)

    def read(self, rotation: FloatArray, twist: FloatArray) -> FloatArray:
        """What the sensor would read (..., 6) of a twist (..., 6) without noise."""
        if self.frame == "world":
            return twist
        return _turned(np.swapaxes(rotation, -1, -2), twist)

    def in_world(self, rotation: FloatArray, reading: FloatArray) -> FloatArray:
        """A reading (..., 6) turned to the world's axes by a rotation (..., 3, 3)."""
        return reading if self.frame == "world" else _turned(rotation, reading)

    def jacobian(self, twist: FloatArray) -> FloatArray:
        """Derivative (..., 6, 12) of the reading, turned to the world, by the error of the states.

        In the body frame the reading depends on the rotation: ``Q_hat Q^T W = W - w x W``, so that
        the error of the prediction is ``dW + W x w``.
        """
        H = np.zeros((*twist.shape[:-1], 6, 12))
        H[..., 6:] = np.eye(6)
        if self.frame == "body":
            H[..., :3, :3] = rotations.hat(twist[..., :3])
            H[..., 3:, :3] = rotations.hat(twist[..., 3:])
        return H

    def information(self, twist: FloatArray) -> FloatArray:
        """Fisher information (..., 12, 12) of one reading about the states."""
        H = self.jacobian(twist)
        return np.swapaxes(H, -1, -2) @ (H / self.std()[:, None] ** 2)


class WanderingPath(NamedTuple):
    """Poses and twists at T + 1 epochs; the twist is that of the interval that begins there."""

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
    """Trajectories drawn from the law, one for each start (..., 3, 3), (..., 3).

    Parameters
    ----------
    rotation, translation
        The starts (..., 3, 3), (..., 3).
    law, process
        Of the twist, and what comes on top of the pose.
    dt, steps
        Seconds of a step, and how many.
    rng
        Source of all randomness.

    Raises
    ------
    ValueError
        On wrong shapes or values, and on laws or generators that are none.
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
        # Of the place an acceleration reaches, half the change of speed times dt is explained by
        # that change; what is left has variance q dt^3 / 12.
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
    """Raise ValueError where the law of the twist or the process noise is of the wrong type."""
    if not isinstance(law, WanderingTwist):
        raise ValueError(f"law must be a WanderingTwist, got {law!r:.80}")
    check_process(process)


def _turned(rotation: FloatArray, twist: FloatArray) -> FloatArray:
    """Both halves (..., 6) of a twist turned."""
    halves = twist.reshape((*twist.shape[:-1], 2, 3)) @ np.swapaxes(rotation, -1, -2)
    return halves.reshape((*halves.shape[:-2], 6))
