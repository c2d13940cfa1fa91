"""Interpolate smooth motion, to simulate an inertial sensor along a path.

A path of poses at discrete times does not define an acceleration. Two curves do: cubic splines
through the poses (`through`), and uniform cubic B-splines with the poses as control points
(`bspline`), in the cumulative form on SO(3) (Sommer et al., CVPR 2020). The latter round the
corners of a polyline.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_number, kernel
from rbl_gym.geometry import rotations

__all__ = ["SmoothMotion", "bspline", "from_function", "through"]

# Internal functions without checks: their arguments were checked, or made here.
_EXP, _ERROR = kernel(rotations.exp), kernel(rotations.error)


class SmoothMotion(NamedTuple):
    """The motion of a body at times (..., T).

    Attributes
    ----------
    rotation, translation, velocity
        (..., T, 3, 3), (..., T, 3) metres, (..., T, 3) m/s.
    turn_rate
        (..., T, 3) rad/s in the body frame.
    acceleration
        (..., T, 3) m/s^2 in the world frame.
    """

    rotation: FloatArray
    translation: FloatArray
    velocity: FloatArray
    turn_rate: FloatArray
    acceleration: FloatArray


def bspline(
    rotation: ArrayLike, translation: ArrayLike, spacing_s: float, times: ArrayLike
) -> SmoothMotion:
    """Evaluate a uniform cubic B-spline of poses, which starts at the first one.

    It passes near the other poses. Position, velocity and acceleration are continuous, as are
    rotation, turn rate and its derivative. Poses with a constant twist are reproduced.

    Parameters
    ----------
    rotation, translation
        Control poses (..., K, 3, 3), (..., K, 3), K >= 2, consecutive rotations less than 180
        degrees apart.
    spacing_s
        Time between the poses, seconds; the first is at 0.
    times
        (T,) seconds from 0 to ``(K - 2) spacing_s``.

    Raises
    ------
    ValueError
        If a shape is wrong, or a time is outside.
    """
    R = rotations.check_rotation("rotation", rotation)
    p = check_array("translation", translation, ("K", 3))
    spacing_s = check_number("spacing_s", spacing_s, low=1e-9)
    times = check_array("times", times, ("T",))
    count = p.shape[-2]
    if R.ndim < 3 or R.shape[-3] != count or count < 2:
        raise ValueError(
            "rotation and translation must hold the same number of poses, at least 2, got shapes "
            f"{R.shape} and {p.shape}"
        )
    at = times / spacing_s
    if times.ndim != 1 or at.min() < 0 or at.max() > count - 2 + 1e-9:
        raise ValueError(
            f"times must be (T,) from 0 to {(count - 2) * spacing_s:g}, got {times.min():g} to "
            f"{times.max():g}"
        )
    # An extra pose before the first one, so that the curve starts there.
    p = np.concatenate([2 * p[..., :1, :] - p[..., 1:2, :], p], axis=-2)
    turns = _ERROR(R[..., 1:, :, :], R[..., :-1, :, :])
    before = _EXP(-turns[..., :1, :]) @ R[..., :1, :, :]
    R = np.concatenate([before, R], axis=-3)
    turns = np.concatenate([turns[..., :1, :], turns], axis=-2)
    moves = np.diff(p, axis=-2)
    # i is the first of the four poses around a time.
    i = np.clip(np.floor(at).astype(int), 0, max(count - 3, 0))
    u = (at - i)[:, None]
    shares = (5 + 3 * u - 3 * u**2 + u**3, 1 + 3 * u + 3 * u**2 - 2 * u**3, u**3)
    rates = (3 - 6 * u + 3 * u**2, 3 + 6 * u - 6 * u**2, 3 * u**2)
    changes = (6 * u - 6, 6 - 12 * u, 6 * u)
    Q, place = R[..., i, :, :], p[..., i, :]
    turn_rate = speed = acceleration = np.zeros_like(place)
    for k in range(3):
        # The last control pose may be missing if its weight is 0.
        j = np.minimum(i + k, count - 1)
        turn, move = turns[..., j, :], moves[..., j, :]
        step = _EXP(shares[k] / 6 * turn)
        Q = step @ Q
        turn_rate = rates[k] / 6 * turn + (step @ turn_rate[..., None])[..., 0]
        place = place + shares[k] / 6 * move
        speed = speed + rates[k] / 6 * move
        acceleration = acceleration + changes[k] / 6 * move
    turn_rate = (np.swapaxes(Q, -1, -2) @ turn_rate[..., None])[..., 0]
    return SmoothMotion(
        Q, place, speed / spacing_s, turn_rate / spacing_s, acceleration / spacing_s**2
    )


def through(
    times: ArrayLike, rotation: ArrayLike, translation: ArrayLike, at: ArrayLike
) -> SmoothMotion:
    """Evaluate cubic splines through the poses of one body, with continuous second derivatives.

    Noise of the poses is strongly amplified in the accelerations.

    Parameters
    ----------
    times, rotation, translation
        Known poses: (K,) seconds, increasing, K >= 2; (K, 3, 3) and (K, 3).
    at
        Times (T,) between the first and the last.

    Raises
    ------
    ValueError
        If a shape is wrong, times do not increase, or a time is outside.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    times, at = check_array("times", times, ("K",)), check_array("at", at, ("T",))
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, ("K", 3))
    count = len(times)
    if times.ndim != 1 or count < 2 or (np.diff(times) <= 0).any():
        raise ValueError(f"times must be two or more and increase strictly, got {times!s:.80}")
    if rotation.shape != (count, 3, 3) or translation.shape != (count, 3):
        raise ValueError(
            f"rotation and translation must hold {count} poses, one for each time, got shapes "
            f"{rotation.shape} and {translation.shape}"
        )
    if at.ndim != 1 or at.min() < times[0] or at.max() > times[-1]:
        raise ValueError(
            f"at must have shape (T,) and lie in [{times[0]:g}, {times[-1]:g}], got shape "
            f"{at.shape} from {at.min():g} to {at.max():g}"
        )
    line, turning = (
        CubicSpline(times, translation),
        RotationSpline(times, Rotation.from_matrix(rotation)),
    )
    return SmoothMotion(turning(at).as_matrix(), line(at), line(at, 1), turning(at, 1), line(at, 2))


def from_function(
    pose: Callable[[FloatArray], tuple[ArrayLike, ArrayLike]], at: ArrayLike, step_s: float = 1e-3
) -> SmoothMotion:
    """Return the motion of a smooth function of time, by fourth-order central differences.

    Parameters
    ----------
    pose
        Function from times (T,) to a rotation (..., T, 3, 3) and a translation (..., T, 3).
    at
        Times (T,), seconds.
    step_s
        Step of the differences: errors grow with its fourth power, rounding with 1 / step^2.

    Raises
    ------
    ValueError
        If the function does not return poses.
    """
    at = check_array("at", at, ("T",))
    step_s = check_number("step_s", step_s, low=1e-9)
    near = [pose(at + k * step_s) for k in (-2, -1, 0, 1, 2)]
    R = np.stack([rotations.check_rotation("rotation", one[0]) for one in near])
    p = np.stack([check_array("translation", one[1], ("T", 3)) for one in near])
    first = np.array([1, -8, 0, 8, -1]) / (12 * step_s)
    second = np.array([-1, 16, -30, 16, -1]) / (12 * step_s**2)
    turns = _ERROR(np.swapaxes(R[2], -1, -2) @ R, np.eye(3))
    return SmoothMotion(
        R[2], p[2], np.tensordot(first, p, 1), np.tensordot(first, turns, 1),
        np.tensordot(second, p, 1),
    )  # fmt: skip
