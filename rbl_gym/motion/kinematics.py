"""Model the motion of a rigid body: kinematics of the tracking paper, noise, trajectories.

A twist (..., 6) is the angular velocity in the world frame [rad/s] and the velocity [m/s].
Kinematics (tracking paper, (10)-(15)): ``Q_k = exp(omega tau) Q_{k-1}``, ``t_k = t_{k-1} + v tau``.
"""

from __future__ import annotations

import functools
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
    check_number,
    checked,
    kernel,
)
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled

__all__ = [
    "Path", "ProcessNoise", "Trajectory", "constant_twist", "interpolate", "lawn_mower_points",
    "orbit", "propagate", "random_twist", "recorded", "simulate", "twists_between", "waypoints",
]  # fmt: skip

_MOST_STEPS = 10**9
# Internal functions without checks: their arguments were checked, or made here.
_EXP, _LEFT_JACOBIAN = kernel(rotations.exp), kernel(rotations.left_jacobian)


def six(rotation: Axes, translation: Axes) -> FloatArray:
    """Return six numbers (..., 6): for the axes of the rotation, then of the translation."""
    parts = [np.asarray(part, dtype=np.float64) for part in (rotation, translation)]
    batch = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*batch, 3)) for part in parts], axis=-1)


@dataclass(frozen=True)
class ProcessNoise:
    """Process noise of the motion: standard deviations after 1 s; the variance grows with time.

    Parameters
    ----------
    rotation_rad, translation_m
        A float, or three floats for the world axes (some are zero for a planar body), or (..., 3)
        with leading axes for individual trials (accepted by `IteratedEkf`).

    Raises
    ------
    ValueError
        If a value is negative or not finite, or there are not 1 or 3 values per trial.
    """

    rotation_rad: Axes = 0.0
    translation_m: Axes = 0.0

    def __post_init__(self) -> None:
        for name in ("rotation_rad", "translation_m"):
            object.__setattr__(self, name, check_axes(name, getattr(self, name), leading=True))
        shapes = np.shape(self.rotation_rad), np.shape(self.translation_m)
        try:
            np.broadcast_shapes(*shapes)
        except ValueError as error:
            raise ValueError(
                f"rotation_rad and translation_m must broadcast together, got shapes {shapes}"
            ) from error

    def std(self) -> FloatArray:
        """Return standard deviations (..., 6) after 1 s: rotation (rad), then translation (m)."""
        return self._std.copy()

    def covariance(self, twist: FloatArray, dt: ArrayLike) -> FloatArray:
        """Return the covariance (..., 6, 6) that one step adds to the pose error (w, v).

        It is ``dt blkdiag(Jl S_w Jl^T, S_v)`` with Jl the left Jacobian of the rotation of the
        step: the noise acts on the angular velocity, the error is that of the rotation.
        """
        dt = np.asarray(dt, dtype=np.float64)[..., None]
        jacobian = _LEFT_JACOBIAN(twist[..., :3] * dt)
        variance = dt * self._variance
        batch = np.broadcast_shapes(jacobian.shape[:-2], variance.shape[:-1])
        covariance = np.zeros((*batch, 6, 6))
        covariance[..., :3, :3] = (jacobian * variance[..., None, :3]) @ np.swapaxes(
            jacobian, -1, -2
        )
        # Every seventh of the 36 entries is on the diagonal.
        covariance.reshape((*covariance.shape[:-2], 36))[..., 21::7] = variance[..., 3:]
        return covariance

    @functools.cached_property
    def _std(self) -> FloatArray:
        return six(self.rotation_rad, self.translation_m)

    @functools.cached_property
    def _variance(self) -> FloatArray:
        """Return the six variances after 1 s."""
        return self._std**2


def check_process(process: ProcessNoise) -> None:
    """Raise ValueError if the argument is not a process noise."""
    if not callable(getattr(process, "covariance", None)):
        raise ValueError(f"process must be a motion.ProcessNoise, got {process!r:.80}")


class Trajectory(NamedTuple):
    """Nominal motion: start rotation (..., 3, 3), translation (..., 3), twists (..., T, 6)."""

    rotation: FloatArray
    translation: FloatArray
    twists: FloatArray


class Path(NamedTuple):
    """Poses at T + 1 epochs: rotation (..., T + 1, 3, 3), translation (..., T + 1, 3)."""

    rotation: FloatArray
    translation: FloatArray


@checked(rotation=(3, 3), translation=(3,), twist=(6,), dt=())
def propagate(
    rotation: FloatArray, translation: FloatArray, twist: FloatArray, dt: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return `rotation` (..., 3, 3), `translation` (..., 3) after `dt` s of a `twist` (..., 6)."""
    dt = np.asarray(dt, dtype=np.float64)[..., None]
    return _EXP(twist[..., :3] * dt) @ rotation, translation + twist[..., 3:] * dt


def simulate(
    trajectory: Trajectory, dt: float, process: ProcessNoise, normals: FloatArray | None = None
) -> Path:
    """Simulate true poses along a trajectory with process noise on every step.

    Parameters
    ----------
    trajectory
        Start and nominal twists.
    dt
        Step, seconds; ValueError if it is not positive.
    process
        Process noise; it acts on the twist, with a variance that grows with time.
    normals
        Standard normals (..., T, 6); None: no process noise.
    """
    dt = check_number("dt", dt, low=1e-12)
    twists = trajectory.twists
    if normals is None:
        normals = np.zeros_like(twists)
    epochs = np.empty(twists.shape[-2] + 1)
    start = trajectory.rotation, trajectory.translation
    return Path(*_walk(*start, twists, normals, process.std(), dt, epochs))


@compiled("epoch:walk")
def _walk(
    rotation: FloatArray,
    translation: FloatArray,
    twists: FloatArray,
    normals: FloatArray,
    std: FloatArray,
    dt: ArrayLike,
    like: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return poses (..., T + 1, 3, 3), (..., T + 1, 3): the start, and those after each step.

    `std` (..., 6) is that of the noise after 1 s. `like` (T + 1,) only gives a kernel the size of
    the results.
    """
    dt = np.asarray(dt, dtype=np.float64)[..., None, None]
    steps = dt * (twists + normals * (std[..., None, :] / np.sqrt(dt)))
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1], steps.shape[:-2])
    rotations_of = np.empty((*batch, *like.shape, 3, 3))
    translations_of = np.empty((*batch, *like.shape, 3))
    rotations_of[..., 0, :, :], translations_of[..., 0, :] = rotation, translation
    turns = _EXP(steps[..., :3])
    for k in range(steps.shape[-2]):
        rotations_of[..., k + 1, :, :] = turns[..., k, :, :] @ rotations_of[..., k, :, :]
    moves = np.cumsum(steps[..., 3:], axis=-2)
    translations_of[..., 1:, :] = translation[..., None, :] + moves
    return rotations_of, translations_of


def twists_between(rotation: FloatArray, translation: FloatArray, dt: ArrayLike) -> FloatArray:
    """Return the twists (..., T, 6) from each pose to the next; dt is a scalar or (..., T)."""
    dt = np.asarray(dt, dtype=np.float64)[..., None]
    turn = rotations.error(rotation[..., 1:, :, :], rotation[..., :-1, :, :])
    return np.concatenate([turn / dt, np.diff(translation, axis=-2) / dt], axis=-1)


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


def random_twist(
    rotation: ArrayLike,
    translation: ArrayLike,
    speed_m_s: float,
    turn_rate_rad_s: float,
    steps: int,
    rng: np.random.Generator,
    hold: int = 10,
) -> Trajectory:
    """Return a trajectory whose direction and rotation axis are redrawn every `hold` steps.

    Speed and turn rate are constant and directions are uniform on the sphere. The distance from the
    start is therefore bounded by ``speed * time``.

    It starts at a pose (`rotation`, `translation`), with `speed_m_s` and `turn_rate_rad_s`; `rng`
    is the source of randomness.
    """
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    steps = check_count("steps", steps, most=_MOST_STEPS)
    hold = check_count("hold", hold, most=_MOST_STEPS)
    speed_m_s = check_number("speed_m_s", speed_m_s, low=0.0)
    turn_rate_rad_s = check_number("turn_rate_rad_s", turn_rate_rad_s, low=0.0)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    directions = rng.standard_normal((*batch, -(-steps // hold), 2, 3))
    twists = held_twists(directions, turn_rate_rad_s, speed_m_s, steps, hold)
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
    places = _along(points, speed_m_s * dt * np.arange(steps + 1))
    velocity = (places[..., 1:, :] - places[..., :-1, :]) / dt
    batch = np.broadcast_shapes(spin.shape[:-1], velocity.shape[:-2])
    twists = np.empty((*batch, steps, 6))
    twists[..., :3], twists[..., 3:] = spin[..., None, :], velocity
    return Trajectory(rotation, points[..., 0, :], twists)


@compiled("epoch:along")
def _along(points: FloatArray, travelled: FloatArray) -> FloatArray:
    """Return positions (..., T, 3) on polylines (..., K, 3) at distances `travelled` (T,)."""
    step = np.diff(points, axis=-2)
    legs = np.linalg.norm(step, axis=-1)
    reached = np.cumsum(legs, axis=-1)
    # The segment at an epoch is the number of segment ends passed by then.
    leg = (reached[..., None, :] <= travelled[:, None]).sum(axis=-1)
    leg = np.minimum(leg, legs.shape[-1] - 1)
    before = np.take_along_axis(reached - legs, leg, axis=-1)
    length = np.maximum(np.take_along_axis(legs, leg, axis=-1), 1e-12)
    share = np.clip((travelled - before) / length, 0.0, 1.0)[..., None]
    start, way = (np.take_along_axis(of_legs, leg[..., None], -2) for of_legs in (points, step))
    return start + share * way


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
            raise ValueError(f"{name} must have shape {shape} as times, got {value.shape}")
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
