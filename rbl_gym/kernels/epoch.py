"""The simulation of an epoch: motion of the body, ranges and angles.

Random numbers are given as standard normals. The textbook forms are `rbl_gym.motion.simulate`,
`rbl_gym.worlds.simulation` and `rbl_gym.measurements.bearing`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.noise_laws import reference_of, sample


@gufunc("(d,d),(d),(t,s),(t,s),(s),(),(e)->(e,d,d),(e,d)")
def walk(
    rotation: Any, translation: Any, twists: Any, normals: Any, std: Any, dt: float, like: Any,
    rotations_of: Any, translations_of: Any,
) -> None:  # fmt: skip
    """Return the start and the poses after each of T steps of twists with noise.

    std (6,) is that of the noise after 1 s. `like` (T + 1,) only defines the shapes of the results.
    """
    turn = np.empty((3, 3))
    root = math.sqrt(dt)
    x = y = z = 0.0
    for i in range(3):
        translations_of[0, i] = translation[i]
        for j in range(3):
            rotations_of[0, i, j] = rotation[i, j]
    for k in range(twists.shape[0]):
        rotations.exp(
            (normals[k, 0] * (std[0] / root) + twists[k, 0]) * dt,
            (normals[k, 1] * (std[1] / root) + twists[k, 1]) * dt,
            (normals[k, 2] * (std[2] / root) + twists[k, 2]) * dt,
            turn,
        )
        rotations.compose(turn, rotations_of[k], rotations_of[k + 1])
        x += (normals[k, 3] * (std[3] / root) + twists[k, 3]) * dt
        y += (normals[k, 4] * (std[4] / root) + twists[k, 4]) * dt
        z += (normals[k, 5] * (std[5] / root) + twists[k, 5]) * dt
        translations_of[k + 1, 0] = translation[0] + x
        translations_of[k + 1, 1] = translation[1] + y
        translations_of[k + 1, 2] = translation[2] + z


@gufunc("(k,d),(t)->(t,d)")
def along(points: Any, travelled: Any, places: Any) -> None:
    """Return positions on a polyline at increasing distances from its start; clipped to its end."""
    leg, reached, length = -1, 0.0, 0.0
    for k in range(travelled.shape[0]):
        while leg < 0 or (travelled[k] >= reached and leg < points.shape[0] - 2):
            leg += 1
            length = 0.0
            for i in range(points.shape[1]):
                length += (points[leg + 1, i] - points[leg, i]) ** 2
            length = math.sqrt(length)
            reached += length
        share = (travelled[k] - (reached - length)) / max(length, 1e-12)
        share = min(max(share, 0.0), 1.0)
        for i in range(points.shape[1]):
            places[k, i] = points[leg, i] + share * (points[leg + 1, i] - points[leg, i])


@gufunc("(m,d),(m,d),()->(m,d)")
def move(places: Any, velocity: Any, reach: float, moved: Any) -> None:
    """Return positions after a step of `reach` along each velocity, cut to length 1."""
    for m in range(places.shape[0]):
        square = 0.0
        for i in range(places.shape[1]):
            square += velocity[m, i] * velocity[m, i]
        step = reach / max(math.sqrt(square), 1.0)
        for i in range(places.shape[1]):
            moved[m, i] = velocity[m, i] * step + places[m, i]


@helper
def tag_position(rotation: Any, translation: Any, tags: Any, n: int) -> tuple[float, float, float]:
    """``s_n = Q c_n + t``."""
    a, b, c = tags[n, 0], tags[n, 1], tags[n, 2]
    return (
        rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c + translation[0],
        rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c + translation[1],
        rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c + translation[2],
    )


@helper
def _square(x: float, y: float, z: float, anchors: Any, m: int) -> float:
    dx, dy, dz = x - anchors[m, 0], y - anchors[m, 1], z - anchors[m, 2]
    return dx * dx + dy * dy + dz * dz


@gufunc("(d,d),(d),(n,d),(m,d),(m,n),(l),()->(m,n),(m,n)")
def measure(
    rotation: Any, translation: Any, tags: Any, anchors: Any, normals: Any, law: Any,
    longest: float, ranges: Any, distances: Any,
) -> None:  # fmt: skip
    """Measure noisy ranges of all links, clipped to the longest, and return true distances."""
    for n in range(tags.shape[0]):
        x, y, z = tag_position(rotation, translation, tags, n)
        reference = reference_of(law, n)
        a, b, c = x, y, z
        if reference != n:
            a, b, c = tag_position(rotation, translation, tags, reference)
        for m in range(anchors.shape[0]):
            square = _square(x, y, z, anchors, m)
            of_reference = square if reference == n else _square(a, b, c, anchors, m)
            distances[m, n] = math.sqrt(square)
            ranges[m, n] = min(sample(law, square, of_reference, normals[m, n]), longest)


@gufunc("(d,d),(d),(n,d),(d),(k,n),()->(k,n)")
def measure_angles(
    rotation: Any, translation: Any, tags: Any, station: Any, normals: Any, std: float, angles: Any
) -> None:
    """Measure noisy angles to the x and z axis of all tags, folded into [0, pi]; k is 2."""
    for n in range(tags.shape[0]):
        x, y, z = tag_position(rotation, translation, tags, n)
        x, y, z = x - station[0], y - station[1], z - station[2]
        alpha = math.atan2(math.hypot(y, z), x) + std * normals[0, n]
        beta = math.atan2(math.hypot(x, y), z) + std * normals[1, n]
        angles[0, n] = abs(alpha - 2 * math.pi * np.rint(alpha / (2 * math.pi)))
        angles[1, n] = abs(beta - 2 * math.pi * np.rint(beta / (2 * math.pi)))
