"""The simulation of an epoch: motion of the body, ranges and angles.

Random numbers are given as standard normals. The textbook forms are `rbl_gym.motion.simulate`,
`rbl_gym.worlds.simulation` and `rbl_gym.measurements.bearing`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.jit import gufunc, helper, inlined
from rbl_gym.kernels.noise_laws import sample
from rbl_gym.kernels.workspace import workspace


@gufunc("(d,d),(d),(t,s),(t,s),(s),(),(e)->(e,d,d),(e,d)")
def walk(
    rotation: Any, translation: Any, twists: Any, normals: Any, std: Any, dt: float, like: Any,
    rotations_of: Any, translations_of: Any,
) -> None:  # fmt: skip
    """Return the start and the poses after each of T steps of twists with noise.

    std (6,) is that of the noise after 1 s. `like` (T + 1,) only defines the shapes of the results.
    """
    turn, now, after = workspace((3, 3)), workspace((3, 3)), workspace((3, 3))
    share = workspace((6,))
    for i in range(6):
        share[i] = std[i] / math.sqrt(dt)
    x = y = z = 0.0
    for i in range(3):
        translations_of[0, i] = translation[i]
        for j in range(3):
            now[i, j] = rotations_of[0, i, j] = rotation[i, j]
    for k in range(twists.shape[0]):
        rotations.exp(
            (normals[k, 0] * share[0] + twists[k, 0]) * dt,
            (normals[k, 1] * share[1] + twists[k, 1]) * dt,
            (normals[k, 2] * share[2] + twists[k, 2]) * dt,
            turn,
        )
        rotations.compose(turn, now, after)
        for i in range(3):
            for j in range(3):
                now[i, j] = rotations_of[k + 1, i, j] = after[i, j]
        x += (normals[k, 3] * share[3] + twists[k, 3]) * dt
        y += (normals[k, 4] * share[4] + twists[k, 4]) * dt
        z += (normals[k, 5] * share[5] + twists[k, 5]) * dt
        translations_of[k + 1, 0] = translation[0] + x
        translations_of[k + 1, 1] = translation[1] + y
        translations_of[k + 1, 2] = translation[2] + z


@gufunc("(d,d),(d),(s),()->(d,d),(d)")
def propagate(
    rotation: Any, translation: Any, twist: Any, dt: float, turned: Any, moved: Any
) -> None:
    """Return the pose after dt seconds of a twist."""
    turn = workspace((3, 3))
    rotations.exp(twist[0] * dt, twist[1] * dt, twist[2] * dt, turn)
    rotations.compose(turn, rotation, turned)
    for i in range(3):
        moved[i] = translation[i] + twist[3 + i] * dt


@gufunc("(k,d),(t),(s),()->(t,s)")
def follow(points: Any, travelled: Any, spin: Any, dt: float, twists: Any) -> None:
    """Return the twists of steps along a polyline, at rest at its end.

    `travelled` are the distances from the start after each step; spin (6,) is added to each twist.
    """
    leg, reached, length = -1, 0.0, 0.0
    x, y, z = points[0, 0], points[0, 1], points[0, 2]
    a = b = c = 0.0
    for k in range(travelled.shape[0]):
        while leg < 0 or (travelled[k] >= reached and leg < points.shape[0] - 2):
            leg += 1
            a = points[leg + 1, 0] - points[leg, 0]
            b = points[leg + 1, 1] - points[leg, 1]
            c = points[leg + 1, 2] - points[leg, 2]
            length = math.sqrt(a * a + b * b + c * c)
            reached += length
        share = (travelled[k] - (reached - length)) / max(length, 1e-12)
        share = min(max(share, 0.0), 1.0)
        before = x, y, z
        x, y, z = points[leg, 0] + share * a, points[leg, 1] + share * b, points[leg, 2] + share * c
        twists[k, 0], twists[k, 1], twists[k, 2] = spin[0], spin[1], spin[2]
        twists[k, 3] = spin[3] + (x - before[0]) / dt
        twists[k, 4] = spin[4] + (y - before[1]) / dt
        twists[k, 5] = spin[5] + (z - before[2]) / dt


@gufunc("(m,d),(m,d),()->(m,d)")
def move(places: Any, velocity: Any, reach: float, moved: Any) -> None:
    """Return positions after a step of `reach` along each velocity, cut to length 1."""
    for m in range(places.shape[0]):
        x, y, z = velocity[m, 0], velocity[m, 1], velocity[m, 2]
        step = reach / max(math.sqrt(x * x + y * y + z * z), 1.0)
        moved[m, 0] = x * step + places[m, 0]
        moved[m, 1] = y * step + places[m, 1]
        moved[m, 2] = z * step + places[m, 2]


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
def _square(x: float, y: float, z: float, points: Any, k: int) -> float:
    dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
    return dx * dx + dy * dy + dz * dz


@inlined
def _in_body(rotation: Any, translation: Any, anchors: Any, m: int) -> tuple[float, float, float]:
    """Return an anchor in the body frame, ``Q^T (a_m - t)``."""
    a, b, c = anchors[m, 0], anchors[m, 1], anchors[m, 2]
    a, b, c = a - translation[0], b - translation[1], c - translation[2]
    return (
        rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c,
        rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c,
        rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c,
    )


@gufunc("(d,d),(d),(n,d),(m,d),(m,n),(l),()->(m,n)")
def measure(
    rotation: Any, translation: Any, tags: Any, anchors: Any, normals: Any, law: Any,
    longest: float, ranges: Any,
) -> None:  # fmt: skip
    """Measure noisy ranges of all links, clipped to the longest."""
    reference = int(law[3])
    for m in range(anchors.shape[0]):
        x, y, z = _in_body(rotation, translation, anchors, m)
        of_reference = _square(x, y, z, tags, reference) if reference >= 0 else 0.0
        for n in range(tags.shape[0]):
            square = _square(x, y, z, tags, n)
            noisy = sample(law, square, of_reference if reference >= 0 else square, normals[m, n])
            ranges[m, n] = min(noisy, longest)


@gufunc("(d,d),(d),(n,d),(m,d)->(m,n)")
def distances(rotation: Any, translation: Any, tags: Any, anchors: Any, result: Any) -> None:
    """Compute the distances of all links."""
    for m in range(anchors.shape[0]):
        x, y, z = _in_body(rotation, translation, anchors, m)
        for n in range(tags.shape[0]):
            result[m, n] = math.sqrt(_square(x, y, z, tags, n))


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
