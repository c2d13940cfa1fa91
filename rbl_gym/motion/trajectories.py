"""Trajectories: constant, random and circular motion, way-points, recorded tracks.

Twists and their integration are those of `rbl_gym.motion.kinematics`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_count, check_number
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.motion.kinematics import Path, Trajectory, twists_between

__all__ = [
    "constant_twist", "interpolate", "lawn_mower_points", "orbit", "recorded", "waypoints",
]  # fmt: skip

_MOST_STEPS = 10**9


def constant_twist(
    rotation: ArrayLike, translation: ArrayLike, twist: ArrayLike, steps: int
) -> Trajectory:
    """Return `steps` of one `twist` from `rotation`, `translation`, as in the tracking paper."""
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    twist = check_array("twist", twist, (6,))
    steps = check_count("steps", steps, most=_MOST_STEPS)
    twists = np.repeat(twist[..., None, :], steps, axis=-2)
    return Trajectory(rotation, translation, twists)


def held_twists(
    directions: FloatArray, turn_rate_rad_s: float, speed_m_s: float, steps: int, hold: int
) -> FloatArray:
    """Return twists (..., T, 6) for axes and directions (..., K, 2, 3), `hold` steps for each."""
    units = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    twists = units * np.array([turn_rate_rad_s, speed_m_s])[:, None]
    twists = twists.reshape((*directions.shape[:-2], 6))
    return np.repeat(twists, hold, axis=-2)[..., :steps, :]


def waypoints(
    rotation: ArrayLike,
    points: ArrayLike,
    speed_m_s: float,
    dt: float,
    steps: int,
    spin_rad_s: ArrayLike = (0.0, 0.0, 0.0),
) -> Trajectory:
    """Return a trajectory with constant speed and spin along a polyline, at rest at its end.

    Parameters
    ----------
    rotation
        Start rotation (..., 3, 3).
    points
        (..., K, 3), K >= 2; the first is the start.
    speed_m_s, dt, steps
        Speed along the line, step in seconds, number of steps.
    spin_rad_s
        Angular velocity (..., 3) in the world frame.
    """
    rotation = rotations.check_rotation("rotation", rotation)
    points = check_array("points", points, ("K", 3))
    if points.shape[-2] < 2:
        raise ValueError(f"points must hold at least 2 way-points, got shape {points.shape}")
    speed_m_s = check_number("speed_m_s", speed_m_s, low=0.0)
    dt = check_number("dt", dt, low=1e-12)
    spin = check_array("spin_rad_s", spin_rad_s, (3,))
    steps = check_count("steps", steps, most=_MOST_STEPS)
    return between_waypoints(rotation, points, speed_m_s, dt, steps, spin)


def between_waypoints(
    rotation: FloatArray, points: FloatArray, speed_m_s: float, dt: float, steps: int,
    spin: FloatArray,
) -> Trajectory:  # fmt: skip
    """Compute `waypoints` from arguments that the caller has checked."""
    travelled = speed_m_s * dt * np.arange(1, steps + 1)
    turn = np.zeros((*spin.shape[:-1], 6))
    turn[..., :3] = spin
    return Trajectory(rotation, points[..., 0, :], _follow(points, travelled, turn, dt))


@compiled("epoch:follow")
def _follow(
    points: FloatArray, travelled: FloatArray, spin: FloatArray, dt: ArrayLike
) -> FloatArray:
    """Return twists (..., T, 6) of steps along polylines (..., K, 3), at rest at the end.

    `travelled` (..., T) are the distances from the start after each step. A spin (..., 6) is added
    to each twist.
    """
    travelled = np.insert(travelled, 0, 0.0, axis=-1)
    step = np.diff(points, axis=-2)
    legs = np.linalg.norm(step, axis=-1)
    reached = np.cumsum(legs, axis=-1)
    # The segment at an epoch is the number of segment ends passed by then.
    leg = (reached[..., None, :] <= travelled[..., :, None]).sum(axis=-1)
    leg = np.minimum(leg, legs.shape[-1] - 1)
    before = np.take_along_axis(reached - legs, leg, axis=-1)
    length = np.maximum(np.take_along_axis(legs, leg, axis=-1), 1e-12)
    share = np.clip((travelled - before) / length, 0.0, 1.0)[..., None]
    start, way = (np.take_along_axis(of_legs, leg[..., None], -2) for of_legs in (points, step))
    velocity = np.diff(start + share * way, axis=-2) / np.asarray(dt)[..., None, None]
    batch = np.broadcast_shapes(spin.shape[:-1], velocity.shape[:-2])
    twists = np.full((*batch, *velocity.shape[-2:-1], 6), spin[..., None, :])
    twists[..., 3:] += velocity
    return twists


def lawn_mower_points(low: ArrayLike, high: ArrayLike, spacing_m: float) -> FloatArray:
    """Return way-points (K, 3) of parallel lanes along x, `spacing_m` apart, at the mid height."""
    low, high = check_array("low", low, (3,)), check_array("high", high, (3,))
    spacing_m = check_number("spacing_m", spacing_m, low=1e-9)
    if (low > high).any():
        raise ValueError(f"low must not lie above high, got low {low}, high {high}")
    lanes = int(np.floor((high[1] - low[1]) / spacing_m + 1e-9)) + 1
    y = np.repeat(low[1] + spacing_m * np.arange(lanes), 2)
    x = np.where(np.arange(2 * lanes) % 4 % 3 == 0, low[0], high[0])
    return np.stack([x, y, np.full(2 * lanes, 0.5 * (low[2] + high[2]))], axis=-1)


def orbit(
    centre: ArrayLike,
    radius_m: float,
    speed_m_s: float,
    dt: float,
    steps: int,
    phase: ArrayLike = 0.0,
) -> Trajectory:
    """Return a horizontal circle, the body x axis along the motion; `phase` (rad) may be batched.

    `centre` (..., 3), `radius_m`, `speed_m_s`; `steps` of `dt` seconds.
    """
    centre = check_array("centre", centre, (3,))
    radius_m = check_number("radius_m", radius_m, low=1e-9)
    dt = check_number("dt", dt, low=1e-12)
    rate = check_number("speed_m_s", speed_m_s, low=0.0) / radius_m
    steps = check_count("steps", steps, most=_MOST_STEPS)
    angle = check_array("phase", phase, ())[..., None] + rate * dt * np.arange(steps + 1)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    places = centre[..., None, :] + radius_m * circle
    twists = np.zeros((*places.shape[:-2], steps, 6))
    twists[..., 2] = rate
    twists[..., 3:] = np.diff(places, axis=-2) / dt
    heading = np.zeros((*angle.shape[:-1], 3))
    heading[..., 2] = angle[..., 0] + np.pi / 2
    return Trajectory(rotations.exp(heading), places[..., 0, :], twists)


def recorded(
    times: ArrayLike, rotation: ArrayLike, translation: ArrayLike, dt: float
) -> Trajectory:
    """Resample a recorded track every `dt` seconds: linear in position, geodesic in rotation.

    Parameters
    ----------
    times
        (L,), seconds, strictly increasing, L >= 2.
    rotation, translation
        (L, 3, 3) and (L, 3).
    """
    times = check_array("times", times, ("L",))
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, ("L", 3))
    if times.ndim != 1 or len(times) < 2 or (np.diff(times) <= 0).any():
        raise ValueError(f"times must be two or more and increase strictly, got {times!s:.80}")
    for name, value, shape in (
        ("rotation", rotation, (len(times), 3, 3)),
        ("translation", translation, (len(times), 3)),
    ):
        if value.shape != shape:
            raise ValueError(
                f"{name} must have shape {shape}, one for each time, got {value.shape}"
            )
    dt = check_number("dt", dt, low=1e-12)
    at = np.arange(times[0], times[-1] + 1e-9 * dt, dt)
    if len(at) < 2:
        raise ValueError(f"times must span at least one step of dt = {dt}, got {np.ptp(times)}")
    path = interpolate(times, rotation, translation, at)
    return Trajectory(path.rotation[0], path.translation[0], twists_between(*path, dt))


def interpolate(
    times: FloatArray, rotation: FloatArray, translation: FloatArray, at: FloatArray
) -> Path:
    """Interpolate poses at times `at`: linear in position, geodesic in rotation; ends are held.

    The known poses are `times` (K,), `rotation` (K, 3, 3), `translation` (K, 3).
    """
    final = len(times) - 1
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, final)
    after = np.minimum(before + 1, final)
    gap = times[after] - times[before]
    # The last pose has no successor: its gap is 0, and so is the fraction.
    fraction = (at - times[before]) / np.where(gap > 0, gap, np.inf)
    fraction = np.clip(fraction, 0.0, 1.0)[..., None]
    turn = rotations.error(rotation[after], rotation[before])
    step = translation[after] - translation[before]
    return Path(
        rotations.exp(fraction * turn) @ rotation[before], translation[before] + fraction * step
    )
