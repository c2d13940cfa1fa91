"""Rotations of one trial: exponential, logarithm, left Jacobian and its inverse.

`rbl_gym.geometry.rotations` has the textbook forms, and tests compare both.
"""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import helper, inlined

# Below this squared angle series replace the closed forms.
_SMALL = 0.25


# Taylor coefficients of sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 by -x^2.
_A = tuple(1 / math.factorial(2 * k + 1) for k in range(7))
_B = tuple(1 / math.factorial(2 * k + 2) for k in range(7))
_C = tuple(1 / math.factorial(2 * k + 3) for k in range(7))


@inlined
def coefficients(s: float) -> tuple[float, float, float]:
    """Return sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 of s = x^2."""
    if s < _SMALL:
        return _polynomial(-s, _A), _polynomial(-s, _B), _polynomial(-s, _C)
    return _closed_forms(s)


@inlined
def _polynomial(s: float, c: Any) -> float:
    return c[0] + s * (c[1] + s * (c[2] + s * (c[3] + s * (c[4] + s * (c[5] + s * c[6])))))


@helper
def _closed_forms(s: float) -> tuple[float, float, float]:
    """Compute `coefficients` of angles that are not small."""
    x = math.sqrt(s)
    sine, half = math.sin(x), math.sin(0.5 * x)
    return sine / x, 2 * half * half / s, (x - sine) / (s * x)


@inlined
def series(x: float, y: float, z: float, a: float, b: float, diagonal: float, out: Any) -> None:
    """Compute ``diagonal I + a [w]x + b w w^T``, w = (x, y, z): form of exp and its Jacobians."""
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    out[0, 0] = diagonal + b * x * x
    out[1, 1] = diagonal + b * y * y
    out[2, 2] = diagonal + b * z * z
    out[0, 1], out[1, 0] = xy - a * z, xy + a * z
    out[2, 0], out[0, 2] = xz - a * y, xz + a * y
    out[1, 2], out[2, 1] = yz - a * x, yz + a * x


@inlined
def compose(A: Any, B: Any, out: Any) -> None:
    """Compute ``out = A B`` of 3 x 3 matrices; `out` is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@inlined
def exp(x: float, y: float, z: float, out: Any) -> None:
    """Compute the rotation matrix of the rotation vector (x, y, z)."""
    s = x * x + y * y + z * z
    a, b, _ = coefficients(s)
    series(x, y, z, a, b, 1 - b * s, out)


@inlined
def left_jacobian(x: float, y: float, z: float, out: Any) -> None:
    """Compute the left Jacobian of exp at (x, y, z)."""
    s = x * x + y * y + z * z
    _, b, c = coefficients(s)
    series(x, y, z, b, c, 1 - c * s, out)


@inlined
def left_jacobian_inverse(x: float, y: float, z: float, out: Any) -> None:
    """Compute the inverse of the left Jacobian at (x, y, z), of length below 2 pi."""
    s = x * x + y * y + z * z
    if s < _SMALL:
        c = 1 + s * (691 / 27300) * (1 + s * (35 / 1382) * (1 + s * (3617 / 142800)))
        c = 1 + s * (1 / 42) * (1 + s * (1 / 40) * (1 + s * (5 / 198) * c))
        c = (1 + s * (1 / 60) * c) * (1 / 12)
    else:
        half = 0.5 * math.sqrt(s)
        c = (1 - half * math.cos(half) / math.sin(half)) / s
    series(x, y, z, -0.5, c, 1 - c * s, out)


@inlined
def log(Q: Any) -> tuple[float, float, float]:
    """Compute the rotation vector of a rotation matrix, of length at most pi."""
    x, y, z = 0.5 * (Q[2, 1] - Q[1, 2]), 0.5 * (Q[0, 2] - Q[2, 0]), 0.5 * (Q[1, 0] - Q[0, 1])
    sine, cosine = math.sqrt(x * x + y * y + z * z), 0.5 * (Q[0, 0] + Q[1, 1] + Q[2, 2] - 1)
    if cosine > -0.9:
        scale = 1.0 if sine < 1e-9 else math.atan2(sine, cosine) / sine
        return scale * x, scale * y, scale * z
    return _log_of_half_turn(Q, x, y, z)


@helper
def _log_of_half_turn(Q: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Compute `log` near pi, where the symmetric part determines the axis, by the quaternion.

    (x, y, z) is the axis times the sine. Any row of ``4 q q^T`` that is not small gives q.
    """
    if Q[0, 0] >= Q[1, 1] and Q[0, 0] >= Q[2, 2]:
        w = 2 * x
        i, j, k = 1 + Q[0, 0] - Q[1, 1] - Q[2, 2], Q[0, 1] + Q[1, 0], Q[0, 2] + Q[2, 0]
    elif Q[1, 1] >= Q[2, 2]:
        w = 2 * y
        i, j, k = Q[0, 1] + Q[1, 0], 1 - Q[0, 0] + Q[1, 1] - Q[2, 2], Q[1, 2] + Q[2, 1]
    else:
        w = 2 * z
        i, j, k = Q[0, 2] + Q[2, 0], Q[1, 2] + Q[2, 1], 1 - Q[0, 0] - Q[1, 1] + Q[2, 2]
    sine = math.sqrt(i * i + j * j + k * k)
    scale = 2 * math.atan2(sine, abs(w)) / sine
    if w < 0:
        scale = -scale
    return scale * i, scale * j, scale * k
