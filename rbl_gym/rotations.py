"""Rotations as 3 x 3 matrices: exponential, logarithm, Jacobians, nearest rotation; batched.

All functions broadcast over leading axes. A rotation vector ``w`` (rad) acts from the left
and in the world frame, ``exp(w) @ Q``, which is the error convention of the whole package:
``Q_hat = exp(w) Q``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array

# Below this squared angle the Taylor series is exact to rounding; above it the closed form is.
_SMALL_SQUARED_ANGLE = 1e-4


def hat(w: ArrayLike) -> FloatArray:
    """Cross-product matrix ``[w]x`` of shape (..., 3, 3), with ``hat(w) @ v == cross(w, v)``."""
    w = np.asarray(w, dtype=np.float64)
    W = np.zeros((*w.shape, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    W[..., 1, 0], W[..., 2, 0], W[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return W


def vee(W: ArrayLike) -> FloatArray:
    """Vector (..., 3) of the skew-symmetric part of ``W`` (..., 3, 3); inverse of `hat`."""
    W = np.asarray(W, dtype=np.float64)
    return 0.5 * np.stack(
        [
            W[..., 2, 1] - W[..., 1, 2],
            W[..., 0, 2] - W[..., 2, 0],
            W[..., 1, 0] - W[..., 0, 1],
        ],
        axis=-1,
    )


def coefficients(squared: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 as functions of x^2, both branches finite."""
    small = squared < _SMALL_SQUARED_ANGLE
    safe = np.where(small, 1.0, squared)
    x = np.sqrt(safe)
    a = np.where(
        small, 1 + squared * (-1 / 6 + squared * (1 / 120 - squared / 5040)), np.sin(x) / x
    )
    half = np.sin(x / 2)
    b = np.where(
        small,
        0.5 + squared * (-1 / 24 + squared * (1 / 720 - squared / 40320)),
        2 * half * half / safe,
    )
    c = np.where(
        small,
        1 / 6 + squared * (-1 / 120 + squared * (1 / 5040 - squared / 362880)),
        (x - np.sin(x)) / (safe * x),
    )
    return a, b, c


def inverse_coefficient(squared: FloatArray) -> FloatArray:
    """(1 - x / (2 tan(x / 2))) / x^2 as a function of x^2: of ``w w^T`` in the inverse Jacobian."""
    small = squared < _SMALL_SQUARED_ANGLE
    safe = np.where(small, 1.0, squared)
    x = np.sqrt(safe)
    series = 1 / 12 + squared * (1 / 720 + squared / 30240)
    return np.where(small, series, (1 - x / (2 * np.tan(x / 2))) / safe)


def _series(w: FloatArray, a: FloatArray, b: FloatArray, diagonal: ArrayLike) -> FloatArray:
    """``diagonal * I + a [w]x + b w w^T``, the common form of exp and its Jacobians."""
    M = b[..., None, None] * (w[..., :, None] * w[..., None, :]) + hat(a[..., None] * w)
    index = np.arange(3)
    M[..., index, index] += np.asarray(diagonal)[..., None]
    return M


def exp(w: ArrayLike) -> FloatArray:
    """Rotation matrix (..., 3, 3) of the rotation vector ``w`` (..., 3) in radians (Rodrigues)."""
    w = np.asarray(w, dtype=np.float64)
    squared = np.einsum("...i,...i->...", w, w)
    a, b, _ = coefficients(squared)
    return _series(w, a, b, 1.0 - b * squared)


def left_jacobian(w: ArrayLike) -> FloatArray:
    """Left Jacobian (..., 3, 3): ``exp(w + d) = exp(Jl(w) d) exp(w)`` to first order in d."""
    w = np.asarray(w, dtype=np.float64)
    squared = np.einsum("...i,...i->...", w, w)
    _, b, c = coefficients(squared)
    return _series(w, b, c, 1.0 - c * squared)


def left_jacobian_inverse(w: ArrayLike) -> FloatArray:
    """Inverse of `left_jacobian`: ``log(exp(d) exp(w)) = w + Jl(w)^-1 d`` to first order in d.

    Finite for ``|w| < 2 pi``, hence for everything that `log` returns.
    """
    w = np.asarray(w, dtype=np.float64)
    squared = np.einsum("...i,...i->...", w, w)
    c = inverse_coefficient(squared)
    return _series(w, np.full_like(squared, -0.5), c, 1.0 - c * squared)


def log(Q: ArrayLike) -> FloatArray:
    """Rotation vector (..., 3), ``|w| <= pi``, of the rotation matrix ``Q`` (..., 3, 3).

    Accurate near the identity by the skew-symmetric part, near pi by the unit quaternion.
    """
    Q = np.asarray(Q, dtype=np.float64)
    vector = vee(Q)
    sine = np.sqrt(np.einsum("...i,...i->...", vector, vector))
    cosine = 0.5 * (np.einsum("...ii->...", Q) - 1)
    if (cosine < -0.9).any():
        # The sine alone no longer carries the axis: go by the half angle, whose sine is large.
        q = quaternion(Q)
        vector = q[..., 1:]
        sine = np.sqrt(np.einsum("...i,...i->...", vector, vector))
        angle = 2 * np.arctan2(sine, q[..., 0])
        limit = 2.0
    else:
        angle = np.arctan2(sine, cosine)
        limit = 1.0
    small = sine < 1e-9
    scale = np.where(small, limit, angle / np.where(small, 1.0, sine))
    return scale[..., None] * vector


def quaternion(Q: ArrayLike) -> FloatArray:
    """Unit quaternion (..., 4) as (w, x, y, z) with w >= 0 of the rotation ``Q`` (..., 3, 3)."""
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
    """Rotation matrix (..., 3, 3) of a quaternion (..., 4) in the order (w, x, y, z).

    Raises
    ------
    ValueError
        If the shape is not (..., 4) or a quaternion is zero or not finite.
    """
    q = check_array("quaternion", q, (4,))
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if (norm < 1e-12).any():
        raise ValueError("quaternion must not be zero")
    w, x, y, z = np.moveaxis(q / norm, -1, 0)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def from_euler_zyx(yaw: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:
    """Rotation ``Rz(yaw) Ry(pitch) Rx(roll)``, angles in radians, broadcast together."""
    yaw, pitch, roll = np.broadcast_arrays(yaw, pitch, roll)
    axes = np.eye(3)
    angles = (yaw[..., None] * axes[2], pitch[..., None] * axes[1], roll[..., None] * axes[0])
    return exp(angles[0]) @ exp(angles[1]) @ exp(angles[2])


def yaw(Q: ArrayLike) -> FloatArray:
    """Heading of the body's x axis in the world's xy plane, radians, ``atan2(Q10, Q00)``."""
    Q = np.asarray(Q, dtype=np.float64)
    return np.arctan2(Q[..., 1, 0], Q[..., 0, 0])


def nearest(M: ArrayLike) -> FloatArray:
    """Proper rotation nearest to ``M`` (..., 3, 3) in Frobenius norm.

    The polar factor with the smallest singular direction flipped where it would be a
    reflection, ``U diag(1, 1, det(U V^T)) V^T``.
    """
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return U @ Vt


def error(Q_hat: ArrayLike, Q: ArrayLike) -> FloatArray:
    """Global rotation error ``w`` (..., 3) with ``Q_hat = exp(w) Q``; its norm is the angle."""
    return log(np.asarray(Q_hat) @ np.swapaxes(np.asarray(Q), -1, -2))


def angle_between(u: ArrayLike, v: ArrayLike) -> FloatArray:
    """Angle in radians between vectors (..., 3), by atan2: exact near 0 and pi."""
    u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.einsum("...i,...i->...", u, v))


def random(rng: np.random.Generator, shape: tuple[int, ...] = ()) -> FloatArray:
    """Rotations (\\*shape, 3, 3), uniform on SO(3)."""
    return from_quaternion(rng.standard_normal((*shape, 4)))


def check_rotation(name: str, Q: ArrayLike, *, tolerance: float = 1e-6) -> FloatArray:
    """`Q` as float64 (..., 3, 3) proper rotations, or a ValueError that says what is wrong."""
    Q = check_array(name, Q, (3, 3))
    defect = np.abs(Q @ np.swapaxes(Q, -1, -2) - np.eye(3)).max(initial=0.0)
    if defect > tolerance:
        raise ValueError(f"{name} must be orthogonal, Q Q^T is off the identity by {defect:.3g}")
    if (np.linalg.det(Q) < 0).any():
        raise ValueError(f"{name} must be a proper rotation, got a reflection (determinant -1)")
    return Q
