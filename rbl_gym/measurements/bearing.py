"""Model directions of arrival at one base station: alpha to its x axis, beta to its z axis.

The axes of the base station are those of the world frame. Angles (..., 2, N) hold alpha and beta of
N tags, in radians on [0, pi]; positions (..., N, 3) are relative to the base station unless a
station is given. The two angles do not determine the sign of y: a position and its mirror image
across the xz plane of the station have the same angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    FloatArray,
    check_array,
    check_finite,
    check_generator,
    check_number,
    check_shape,
    checked,
    kernel,
)
from rbl_gym.kernels import compiled
from rbl_gym.measurements.ranging import tag_positions

__all__ = [
    "AngleNoise", "angles", "curvature", "directions", "information", "jacobian", "linearize",
    "seen", "simulate",
]  # fmt: skip

# The reflection that leaves the angles unchanged.
MIRROR = np.array([1.0, -1.0, 1.0])
# Closer to the station (m) the direction is undefined: its gradient is set to zero.
_NOWHERE = 1e-50
_AXES = (0, 2)


@dataclass(frozen=True)
class AngleNoise:
    """Gaussian noise on both angles of every tag.

    Parameters
    ----------
    std_rad
        Standard deviation, radians.
    """

    std_rad: float = np.pi / 1800

    def __post_init__(self) -> None:
        check_number("std_rad", self.std_rad, low=1e-300)

    def variance(self, angles: FloatArray) -> FloatArray:
        """Return the variance of each angle [rad^2], with the shape of the angles."""
        return np.full(angles.shape, self.std_rad**2)

    def sample(self, true_angles: FloatArray, normals: FloatArray) -> FloatArray:
        """Return noisy angles, folded back into [0, pi]."""
        return fold(true_angles + self.std_rad * normals)


def fold(angles: FloatArray) -> FloatArray:
    """Fold angles of any size to angles to an axis, on [0, pi]."""
    return np.abs(angles - 2 * np.pi * np.round(angles / (2 * np.pi)))


def angles(positions: ArrayLike, station: ArrayLike | None = None) -> FloatArray:
    """Return angles (..., 2, N) of positions (..., N, 3) from a station (..., 3), None: the origin.

    They are computed by atan2, which is also accurate near 0 and pi, where the arc cosine loses
    half of the digits.
    """
    return np.moveaxis(seen(np.moveaxis(_relative(positions, station), -1, 0)), 0, -2)


def jacobian(positions: ArrayLike, station: ArrayLike | None = None) -> FloatArray:
    """Return the derivative (..., 2, N, 3) of the angles by the positions.

    On an axis its own angle has no derivative, because it increases in all directions. It is set to
    zero there.
    """
    _, gradient = linearize(np.moveaxis(_relative(positions, station), -1, 0))
    return np.moveaxis(gradient, (0, 1), (-3, -1))


def seen(x: FloatArray) -> FloatArray:
    """Return angles (2, ...) at positions (3, ...), components first."""
    return np.stack([np.arctan2(across, along) for along, across in _along_and_across(x)])


def linearize(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return angles (2, ...) and gradients (2, 3, ...) at positions (3, ...), components first.

    The gradient of the angle to the axis e is ``(x (e x) / a - e a) / |x|^2``, with the
    distance a from the axis. It is computed from quotients of at most 1, so no position overflows.
    """
    near = _nearness(x)
    found, gradient = np.empty((2, *near.shape)), np.empty((2, *x.shape))
    for row, (k, (along, across)) in enumerate(zip(_AXES, _along_and_across(x), strict=True)):
        np.arctan2(across, along, out=found[row])
        turn = along * near * near
        safe = _safe(across)
        for i in ((k + 1) % 3, (k + 2) % 3):
            np.multiply(x[i] / safe, turn, out=gradient[row, i])
        np.multiply(-across * near, near, out=gradient[row, k])
    return found, gradient


def curvature(x: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the sum (3, 3, ...) of second derivatives at positions (3, ...), weights (2, ...).

    In cylindrical coordinates about the axis e, with h along it, a across it and u the unit vector
    away from it, the angle is ``atan2(a, h)``. The circle about the axis adds ``h / (a |x|^2)`` in
    the direction perpendicular to both.
    """
    near = _nearness(x)
    total = np.zeros((3, *x.shape))
    for k, (along, across), weight in zip(_AXES, _along_and_across(x), weights, strict=True):
        safe = _safe(across)
        u = np.zeros_like(x)
        for i in ((k + 1) % 3, (k + 2) % 3):
            u[i] = x[i] / safe
        cosine, sine = along * near, across * near
        both = 2 * cosine * sine * near * near
        mixed = (sine + cosine) * (sine - cosine) * near * near
        around = cosine * near / safe
        total += (weight * -(both + around)) * u[:, None] * u
        total[k] += weight * mixed * u
        total[:, k] += weight * mixed * u
        for i in range(3):
            total[i, i] += weight * (both if i == k else around)
    return total


def _along_and_across(x: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return for each axis of the angles the coordinate along it and the distance from it."""
    return [(x[k], np.hypot(x[(k + 1) % 3], x[(k + 2) % 3])) for k in _AXES]


def _nearness(x: FloatArray) -> FloatArray:
    """Return the inverse distance (...) of positions (3, ...), 0 if the direction is undefined."""
    return 1 / _safe(np.hypot(x[0], np.hypot(x[1], x[2])))


def _safe(distance: FloatArray) -> FloatArray:
    """Return distances to divide by: infinite if the direction is undefined."""
    return np.where(distance > _NOWHERE, distance, np.inf)


def directions(angles: FloatArray, sign: ArrayLike = 1.0) -> FloatArray:
    """Return unit vectors (..., N, 3) of angles (..., 2, N), with the given sign of y (..., N).

    Angles that belong to no direction (``cos^2 alpha + cos^2 beta > 1``: noise near y = 0) give the
    nearest direction with y = 0.
    """
    x, z = np.cos(angles[..., 0, :]), np.cos(angles[..., 1, :])
    planar = x * x + z * z
    y = np.sqrt(np.maximum(1 - planar, 0.0))
    shrink = 1 / np.sqrt(np.maximum(planar, 1.0))
    return np.stack([x * shrink, sign * y, z * shrink], axis=-1)


def information(positions: FloatArray, noise: AngleNoise) -> FloatArray:
    """Return the Fisher information (..., N, 3, 3) of the angles about the position of each tag."""
    found, J = linearize(np.moveaxis(positions, -1, 0))
    weight = 1 / noise.variance(found)
    return np.moveaxis(np.einsum("k...,ki...,kj...->ij...", weight, J, J), (0, 1), (-2, -1))


@compiled("epoch:measure_angles")
def sample(
    rotation: FloatArray,
    translation: FloatArray,
    tags: FloatArray,
    station: FloatArray,
    normals: FloatArray,
    std_rad: float,
) -> FloatArray:
    """Return noisy angles (..., 2, N) of bodies at given poses, without checks of the arguments.

    Parameters
    ----------
    rotation, translation, tags, station
        (..., 3, 3), (..., 3), (..., N, 3), (..., 3); metres.
    normals, std_rad
        Standard normals (..., 2, N), and the standard deviation of `AngleNoise`.
    """
    positions = kernel(tag_positions)(rotation, translation - station, tags)
    return fold(angles(positions) + std_rad * normals)


@checked(tags=("N", 3), rotation=(3, 3), translation=(3,))
def simulate(
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: AngleNoise,
    rng: np.random.Generator,
    station: ArrayLike | None = None,
) -> FloatArray:
    """Simulate noisy angles (..., 2, N) of bodies at given poses.

    Parameters
    ----------
    tags, rotation, translation
        (..., N, 3), (..., 3, 3), (..., 3); metres.
    noise, rng
        Noise law of the angles, and the source of randomness.
    station
        Position (..., 3) of the base station; None: the origin.
    """
    if not isinstance(noise, AngleNoise):
        raise ValueError(f"noise must be an AngleNoise, got {noise!r:.80}")
    check_generator("rng", rng)
    true = angles(kernel(tag_positions)(rotation, translation, tags), station)
    return noise.sample(true, rng.standard_normal(true.shape))


def check_angles(value: ArrayLike, n_tags: int) -> FloatArray:
    """Return angles (..., 2, N) on [0, pi], or raise ValueError.

    Noisy angles outside [0, pi] by less than 0.1 rad are folded back.
    """
    checked = check_finite("angles", check_shape("angles", value, (2, n_tags)))
    wrong = (checked < -0.1) | (checked > np.pi + 0.1)
    if wrong.any():
        index = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(
            f"angles must be angles in radians on [0, pi], got {checked[index]} at {index}"
        )
    return fold(checked)


def _relative(positions: ArrayLike, station: ArrayLike | None) -> FloatArray:
    x = check_array("positions", positions, ("N", 3))
    return x if station is None else x - check_array("station", station, (3,))[..., None, :]
