"""Model the motion of a rigid body: kinematics of the tracking paper, process noise, paths.

A twist (..., 6) is the angular velocity in the world frame [rad/s] and the velocity [m/s].
Kinematics (tracking paper, (10)-(15)): ``Q_k = exp(omega tau) Q_{k-1}``, ``t_k = t_{k-1} + v tau``.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import Axes, FloatArray, check_axes, check_number, checked, kernel
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled

__all__ = ["Path", "ProcessNoise", "Trajectory", "propagate", "simulate", "twists_between"]

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
    return _propagate(rotation, translation, twist, dt)


@compiled("epoch:propagate")
def _propagate(
    rotation: FloatArray, translation: FloatArray, twist: FloatArray, dt: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Compute `propagate`."""
    dt = np.asarray(dt, dtype=np.float64)[..., None]
    return _EXP(twist[..., :3] * dt) @ rotation, translation + twist[..., 3:] * dt


def simulate(
    trajectory: Trajectory,
    dt: float,
    process: ProcessNoise,
    normals: FloatArray | None = None,
    out: Path | None = None,
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
    out
        Arrays for the result, in any memory order; None: new ones.
    """
    dt = check_number("dt", dt, low=1e-12)
    twists = trajectory.twists
    if normals is None:
        normals = np.zeros_like(twists)
    epochs = np.empty(twists.shape[-2] + 1)
    start = trajectory.rotation, trajectory.translation
    return Path(*_walk(*start, twists, normals, process.std(), dt, epochs, *(out or ())))


@compiled("epoch:walk")
def _walk(
    rotation: FloatArray,
    translation: FloatArray,
    twists: FloatArray,
    normals: FloatArray,
    std: FloatArray,
    dt: ArrayLike,
    like: FloatArray,
    *out: FloatArray,
) -> tuple[FloatArray, ...]:
    """Return poses (..., T + 1, 3, 3), (..., T + 1, 3): the start, and those after each step.

    `std` (..., 6) is that of the noise after 1 s. `like` (T + 1,) only gives a kernel the size of
    the results; `out` are arrays for them.
    """
    dt = np.asarray(dt, dtype=np.float64)[..., None, None]
    steps = dt * (twists + normals * (std[..., None, :] / np.sqrt(dt)))
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1], steps.shape[:-2])
    sizes = (*batch, *like.shape, 3, 3), (*batch, *like.shape, 3)
    rotations_of, translations_of = out or map(np.empty, sizes)
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
