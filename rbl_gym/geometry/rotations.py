"""Compute with rotations as 3 x 3 matrices: exponential, logarithm, Jacobians; batched.

All functions broadcast over leading axes. A rotation vector ``w`` (rad) acts from the left
and in the world frame, ``exp(w) @ Q``, which is the error convention of the whole package:
``Q_hat = exp(w) Q``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, checked, kernel
from rbl_gym.kernels import compiled

__all__ = [
    "angle_between", "cayley", "error", "exp", "from_euler_zyx", "from_quaternion", "hat",
    "left_jacobian", "left_jacobian_inverse", "log", "nearest", "quaternion", "random", "vee",
    "yaw",
]  # fmt: skip

# Above this squared angle the closed forms are accurate.
_SMALL_SQUARED_ANGLE = 1e-4
# Up to this squared angle the Taylor series below are exact to rounding, and faster.
_SERIES_SQUARED_ANGLE = 0.25
# Series of sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 in x^2, highest power first.
_SERIES = [[(-1) ** n / math.factorial(2 * n + k) for n in range(6, -1, -1)] for k in (1, 2, 3)]


@checked(w=(3,))
def hat(w: ArrayLike) -> FloatArray:
    """Return the cross-product matrix ``[w]x`` (..., 3, 3): ``hat(w) @ v == cross(w, v)``."""
    w = np.asarray(w, dtype=np.float64)
    W = np.zeros((*w.shape, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    W[..., 1, 0], W[..., 2, 0], W[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return W


@checked(W=(3, 3))
def vee(W: ArrayLike) -> FloatArray:
    """Return the vector (..., 3) of the skew-symmetric part of ``W`` (..., 3, 3).

    Inverse of `hat`.
    """
    W = np.asarray(W, dtype=np.float64)
    return 0.5 * np.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]],
        axis=-1,
    )


def coefficients(squared: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 as functions (...) of x^2 (...)."""
    small = np.asarray(squared < _SERIES_SQUARED_ANGLE)
    if small.all():
        return _taylor(squared)
    any_small = small.any()
    safe = np.where(small, 1.0, squared) if any_small else squared
    x = np.sqrt(safe)
    sine, half = np.sin(x), np.sin(0.5 * x)
    closed = sine / x, 2 * half * half / safe, (x - sine) / (safe * x)
    if not any_small:
        return closed
    a, b, c = map(np.asarray, closed)
    a[small], b[small], c[small] = _taylor(squared[small])
    return a, b, c


def _taylor(s: Any) -> tuple[Any, Any, Any]:
    """Return `coefficients` for a small x^2, an array or a float."""
    sums = []
    for highest, *rest in _SERIES:
        total = highest * s
        for term in rest[:-1]:
            total += term
            total *= s
        sums.append(total + rest[-1])
    return sums[0], sums[1], sums[2]


def inverse_coefficient(squared: FloatArray) -> FloatArray:
    """Return (1 - x / (2 tan(x / 2))) / x^2 as a function (...) of x^2 (...)."""
    small = squared < _SMALL_SQUARED_ANGLE
    safe = np.where(small, 1.0, squared)
    x = np.sqrt(safe)
    series = 1 / 12 + squared * (1 / 720 + squared / 30240)
    return np.where(small, series, (1 - x / (2 * np.tan(0.5 * x))) / safe)


def _series(
    w: FloatArray, a: FloatArray, b: FloatArray, diagonal: FloatArray, out: FloatArray | None = None
) -> FloatArray:
    """Return ``diagonal * I + a [w]x + b w w^T``, the common form of exp and its Jacobians."""
    M = np.empty((*w.shape, 3)) if out is None else out
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        M[..., i, i] = diagonal + b * (w[..., i] * w[..., i])
        product, turn = b * (w[..., j] * w[..., k]), a * w[..., i]
        M[..., k, j] = product + turn
        M[..., j, k] = product - turn
    return M


def _one_series(w: FloatArray, a: float, b: float, diagonal: float) -> FloatArray:
    """Compute `_series` of one vector (3,) in plain floats: a tenth of the time of array calls."""
    x, y, z = w.tolist()
    xy, xz, yz = b * (x * y), b * (x * z), b * (y * z)
    ax, ay, az = a * x, a * y, a * z
    return np.array(
        [
            [diagonal + b * (x * x), xy - az, xz + ay],
            [xy + az, diagonal + b * (y * y), yz - ax],
            [xz - ay, yz + ax, diagonal + b * (z * z)],
        ]
    )


def _one_coefficients(w: FloatArray) -> tuple[float, float, float, float]:
    """Return x^2 and its `coefficients` for a single vector (3,)."""
    s = sum(x * x for x in w.tolist())
    if s < _SMALL_SQUARED_ANGLE:
        return s, *_taylor(s)
    x = math.sqrt(s)
    sine, half = math.sin(x), math.sin(0.5 * x)
    return s, sine / x, 2 * half * half / s, (x - sine) / (s * x)


@checked(w=(3,))
def exp(w: ArrayLike, out: FloatArray | None = None) -> FloatArray:
    """Return the rotation matrix (..., 3, 3) of the rotation vector ``w`` (..., 3) in radians.

    Rodrigues' formula. `out`: an array for the result, in any memory order.
    """
    w = np.asarray(w, dtype=np.float64)
    if w.ndim == 1 and out is None:
        s, a, b, _ = _one_coefficients(w)
        return _one_series(w, a, b, 1.0 - b * s)
    squared = np.einsum("...i,...i->...", w, w)
    a, b, _ = coefficients(squared)
    return _series(w, a, b, 1.0 - b * squared, out)


@checked(w=(3,))
def cayley(w: ArrayLike) -> FloatArray:
    """Return the Cayley transform of ``w`` (..., 3): a rotation by ``2 atan(|w| / 2)`` about it.

    The result (..., 3, 3) is ``(I - X)^-1 (I + X)`` with ``X = hat(w) / 2``. It agrees with `exp`
    to second order in w, needs no sine, and does not reach rotations by 180 degrees.
    """
    w = np.asarray(w, dtype=np.float64)
    quarter = 0.25 * np.einsum("...i,...i->...", w, w)
    scale = 1 / (1 + quarter)
    return _series(w, scale, 0.5 * scale, (1 - quarter) * scale)


@checked(w=(3,))
def left_jacobian(w: ArrayLike) -> FloatArray:
    """Return the left Jacobian (..., 3, 3): ``exp(w + d) = exp(Jl(w) d) exp(w)`` to first order."""
    w = np.asarray(w, dtype=np.float64)
    if w.ndim == 1:
        s, _, b, c = _one_coefficients(w)
        return _one_series(w, b, c, 1.0 - c * s)
    squared = np.einsum("...i,...i->...", w, w)
    _, b, c = coefficients(squared)
    return _series(w, b, c, 1.0 - c * squared)


@checked(w=(3,))
def left_jacobian_inverse(w: ArrayLike) -> FloatArray:
    """Return the inverse of `left_jacobian`: ``log(exp(d) exp(w)) = w + Jl(w)^-1 d``, first order.

    Finite for ``|w| < 2 pi``, hence for everything that `log` returns.
    """
    w = np.asarray(w, dtype=np.float64)
    if w.ndim == 1:
        s = sum(x * x for x in w.tolist())
        if s < _SMALL_SQUARED_ANGLE:
            c = 1 / 12 + s * (1 / 720 + s / 30240)
        else:
            x = math.sqrt(s)
            c = (1 - x / (2 * math.tan(0.5 * x))) / s
        return _one_series(w, -0.5, c, 1.0 - c * s)
    squared = np.einsum("...i,...i->...", w, w)
    c = inverse_coefficient(squared)
    return _series(w, np.full_like(squared, -0.5), c, 1.0 - c * squared)


@checked(Q=(3, 3))
def log(Q: ArrayLike) -> FloatArray:
    """Return the rotation vector (..., 3), ``|w| <= pi``, of the rotation matrix ``Q`` (..., 3, 3).

    Near the identity it is computed from the skew-symmetric part, near pi from the unit quaternion,
    and so is accurate at both.
    """
    Q = np.asarray(Q, dtype=np.float64)
    if Q.ndim == 2:
        return _one_log(Q)
    vector = kernel(vee)(Q)
    sine = np.sqrt(np.einsum("...i,...i->...", vector, vector))
    cosine = 0.5 * (np.einsum("...ii->...", Q) - 1)
    vector *= (np.arctan2(sine, cosine) / np.maximum(sine, 1e-300))[..., None]
    wide = cosine < -0.9
    if wide.any():
        vector[wide] = _wide_log(Q[wide])
    return vector


def _one_log(Q: FloatArray) -> FloatArray:
    """Compute `log` of a single matrix (3, 3), in plain floats."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = Q.tolist()
    cosine = 0.5 * (xx + yy + zz - 1)
    if cosine < -0.9:
        return _wide_log(Q)
    x, y, z = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 if sine < 1e-9 else math.atan2(sine, cosine) / sine
    return np.array([scale * x, scale * y, scale * z])


def _wide_log(Q: FloatArray) -> FloatArray:
    """Compute `log` above 154 degrees: the sine of the half angle determines the axis."""
    q = kernel(quaternion)(Q)
    sine = np.sqrt(np.einsum("...i,...i->...", q[..., 1:], q[..., 1:]))
    return (2 * np.arctan2(sine, q[..., 0]) / sine)[..., None] * q[..., 1:]


@checked(Q=(3, 3))
def quaternion(Q: ArrayLike) -> FloatArray:
    """Return the unit quaternion (..., 4), (w, x, y, z) with w >= 0, of ``Q`` (..., 3, 3)."""
    Q = np.asarray(Q, dtype=np.float64)
    x, y, z = Q[..., 0, 0], Q[..., 1, 1], Q[..., 2, 2]
    # The symmetric 4 x 4 matrix 4 q q^T; its row of largest diagonal is q up to scale.
    K = np.empty((*Q.shape[:-2], 4, 4))
    K[..., 0, 0] = 1 + x + y + z
    K[..., 1, 1] = 1 + x - y - z
    K[..., 2, 2] = 1 - x + y - z
    K[..., 3, 3] = 1 - x - y + z
    K[..., 0, 1] = K[..., 1, 0] = Q[..., 2, 1] - Q[..., 1, 2]
    K[..., 0, 2] = K[..., 2, 0] = Q[..., 0, 2] - Q[..., 2, 0]
    K[..., 0, 3] = K[..., 3, 0] = Q[..., 1, 0] - Q[..., 0, 1]
    K[..., 1, 2] = K[..., 2, 1] = Q[..., 0, 1] + Q[..., 1, 0]
    K[..., 1, 3] = K[..., 3, 1] = Q[..., 0, 2] + Q[..., 2, 0]
    K[..., 2, 3] = K[..., 3, 2] = Q[..., 1, 2] + Q[..., 2, 1]
    largest = np.argmax(np.diagonal(K, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(K, largest[..., None, None], axis=-2)[..., 0, :]
    q = np.where(q[..., :1] < 0, -q, q)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def from_quaternion(q: ArrayLike) -> FloatArray:
    """Return the rotation matrix (..., 3, 3) of a quaternion (..., 4) in the order (w, x, y, z).

    Raises
    ------
    ValueError
        If the shape is not (..., 4) or a quaternion is zero or not finite.
    """
    q = check_array("q", q, (4,))
    norm = np.sqrt(np.einsum("...i,...i->...", q, q))
    if np.count_nonzero(norm < 1e-12):
        index = tuple(int(i) for i in np.argwhere(norm < 1e-12)[0])
        raise ValueError(f"q must not be zero, got {q[index].tolist()} at index {index}")
    unit = q / norm[..., None]
    if unit.ndim == 1:
        w = float(unit[0])
        return _one_series(unit[1:], 2 * w, 2.0, 2 * w * w - 1)
    w, v = unit[..., 0], unit[..., 1:]
    return _series(v, 2 * w, np.asarray(2.0), 2 * w * w - 1)


@checked(yaw=(), pitch=(), roll=())
def from_euler_zyx(yaw: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:
    """Return the rotation ``Rz(yaw) Ry(pitch) Rx(roll)``, angles in radians, broadcast together."""
    yaw, pitch, roll = np.broadcast_arrays(yaw, pitch, roll)
    axes = np.eye(3)
    angles = (yaw[..., None] * axes[2], pitch[..., None] * axes[1], roll[..., None] * axes[0])
    return exp(angles[0]) @ exp(angles[1]) @ exp(angles[2])


@checked(Q=(3, 3))
def yaw(Q: ArrayLike) -> FloatArray:
    """Return the heading of the body x axis in the world xy plane, radians, ``atan2(Q10, Q00)``."""
    Q = np.asarray(Q, dtype=np.float64)
    return np.arctan2(Q[..., 1, 0], Q[..., 0, 0])


@checked(M=(3, 3))
def nearest(M: ArrayLike) -> FloatArray:
    """Return the proper rotation nearest to ``M`` (..., 3, 3) in the Frobenius norm.

    It is the polar factor, with the smallest singular direction flipped if it would be a
    reflection: ``U diag(1, 1, det(U V^T)) V^T``.
    """
    return _nearest(M)


@compiled("rotation_fits:nearest")
def _nearest(M: FloatArray) -> FloatArray:
    """Compute `nearest` from the singular value decomposition."""
    U, _, Vt = np.linalg.svd(M)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return U @ Vt


@checked(Q_hat=(3, 3), Q=(3, 3))
def error(Q_hat: ArrayLike, Q: ArrayLike) -> FloatArray:
    """Return the global rotation error ``w`` (..., 3), ``Q_hat = exp(w) Q``.

    Its norm is the angle between the two rotations.
    """
    return kernel(log)(np.asarray(Q_hat) @ np.swapaxes(np.asarray(Q), -1, -2))


@checked(u=(3,), v=(3,))
def angle_between(u: ArrayLike, v: ArrayLike) -> FloatArray:
    """Return the angle in radians between vectors (..., 3), by atan2: exact near 0 and pi."""
    u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.einsum("...i,...i->...", u, v))


def random(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> FloatArray:
    """Return random rotations (\\*shape, 3, 3), uniform on SO(3)."""
    return from_quaternion(rng.standard_normal((*shape, 4)))


# Tolerance on the entries of Q Q^T minus the identity.
ORTHOGONAL = 1e-6


def check_rotation(name: str, Q: ArrayLike, *, tolerance: float = ORTHOGONAL) -> FloatArray:
    """Return `Q` as float64 (..., 3, 3) proper rotations, or raise ValueError."""
    Q = check_array(name, Q, (3, 3))
    defect = np.abs(Q @ np.swapaxes(Q, -1, -2) - np.eye(3)).max(initial=0.0)
    if defect > tolerance:
        raise ValueError(
            f"{name} must be orthogonal (a rotation matrix), but {name} times its transpose "
            f"differs from the identity by {defect:.3g}"
        )
    if (np.linalg.det(Q) < 0).any():
        raise ValueError(f"{name} must be a proper rotation, got a reflection (determinant -1)")
    return Q
