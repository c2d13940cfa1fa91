"""Cramer-Rao bounds of a pose: Fisher information, posterior recursion, score.

The textbook forms are `rbl_gym.bounds`. The pose error is (w, v), ``Q_hat = exp(w) Q``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.epoch import tag_position
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.linear_algebra import (
    cholesky,
    cholesky6,
    factor_semidefinite,
    fill,
    invert_factored,
    invert_factored6,
)
from rbl_gym.kernels.noise_laws import reference_of, weight
from rbl_gym.kernels.workspace import workspace


@gufunc("(s,s),(m,d),(n,d),(d,d),(d),(l),(m,n)->(s,s)")
def range_information(
    prior: Any, anchors: Any, tags: Any, rotation: Any, translation: Any, law: Any, share: Any,
    information: Any,
) -> None:  # fmt: skip
    """Add the information of ranges, times each link's fraction, to a prior's information."""
    for i in range(6):
        for j in range(6):
            information[i, j] = prior[i, j]
    add_range_information(information, anchors, tags, rotation, translation, law, share)


@helper
def add_range_information(
    information: Any, anchors: Any, tags: Any, rotation: Any, translation: Any, law: Any, share: Any
) -> None:
    """Add ``sum_n J_n^T U_n J_n``, ``U_n = sum_m share / (var r^2) d d^T``, ``d = s_n - a_m``."""
    for n in range(tags.shape[0]):
        x, y, z = tag_position(rotation, translation, tags, n)
        reference = reference_of(law, n)
        a, b, c = x, y, z
        if reference != n:
            a, b, c = tag_position(rotation, translation, tags, reference)
        xx = xy = xz = yy = yz = zz = 0.0
        for m in range(anchors.shape[0]):
            p, q, r = anchors[m, 0], anchors[m, 1], anchors[m, 2]
            dx, dy, dz = x - p, y - q, z - r
            square = dx * dx + dy * dy + dz * dz
            of_reference = square
            if reference != n:
                of_reference = (a - p) * (a - p) + (b - q) * (b - q) + (c - r) * (c - r)
            w = share[m, n] * weight(law, square, of_reference)
            xx += w * dx * dx
            xy += w * dx * dy
            xz += w * dx * dz
            yy += w * dy * dy
            yz += w * dy * dz
            zz += w * dz * dz
        _add_lifted(
            information,
            x - translation[0], y - translation[1], z - translation[2], xx, xy, xz, yy, yz, zz,
        )  # fmt: skip
    _mirror_upper(information)


@helper
def _add_lifted(
    H: Any, x: float, y: float, z: float,
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float,
) -> None:  # fmt: skip
    """Add ``J^T U J`` to the upper half of H, with ``J = [-[c]x, I]`` of c = (x, y, z)."""
    # Rows of [c]x U.
    a0, a1, a2 = y * xz - z * xy, y * yz - z * yy, y * zz - z * yz
    b0, b1, b2 = z * xx - x * xz, z * xy - x * yz, z * xz - x * zz
    c0, c1, c2 = x * xy - y * xx, x * yy - y * xy, x * yz - y * xz
    H[0, 0] += y * a2 - z * a1
    H[0, 1] += z * a0 - x * a2
    H[0, 2] += x * a1 - y * a0
    H[1, 1] += z * b0 - x * b2
    H[1, 2] += x * b1 - y * b0
    H[2, 2] += x * c1 - y * c0
    H[0, 3] += a0
    H[0, 4] += a1
    H[0, 5] += a2
    H[1, 3] += b0
    H[1, 4] += b1
    H[1, 5] += b2
    H[2, 3] += c0
    H[2, 4] += c1
    H[2, 5] += c2
    H[3, 3] += xx
    H[3, 4] += xy
    H[3, 5] += xz
    H[4, 4] += yy
    H[4, 5] += yz
    H[5, 5] += zz


@helper
def _mirror_upper(H: Any) -> None:
    """Copy the upper half of a symmetric matrix to its lower half."""
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]


@helper
def _predict(J: Any, twist: Any, dt: float, std: Any, work: Any, predicted: Any) -> None:
    """Compute ``(F J^-1 F^T + Q)^-1`` as ``L (I + L^T Q L)^-1 L^T`` with ``L L^T = F J F^T``.

    All steps are symmetric and also valid for a singular J. work is (4, 6, 6).
    """
    turned, L, A, small = work[0], work[1], work[2], work[3]
    R, jacobian, Q = small[:3, :3], small[:3, 3:], small[3:, :3]
    x, y, z = dt * twist[0], dt * twist[1], dt * twist[2]
    rotations.exp(x, y, z, R)
    rotations.left_jacobian(x, y, z, jacobian)
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += dt * std[k] * std[k] * jacobian[i, k] * jacobian[j, k]
            Q[i, j] = total
    # Rotate rows, then columns.
    for i in range(3):
        for j in range(6):
            A[i, j] = R[i, 0] * J[0, j] + R[i, 1] * J[1, j] + R[i, 2] * J[2, j]
    for i in range(3):
        for j in range(3):
            turned[i, j] = A[i, 0] * R[j, 0] + A[i, 1] * R[j, 1] + A[i, 2] * R[j, 2]
            turned[i, 3 + j] = A[i, 3 + j]
            turned[3 + j, i] = A[i, 3 + j]
            turned[3 + i, 3 + j] = J[3 + i, 3 + j]
    factor_semidefinite(turned, L)
    # turned = Q L, A = I + L^T Q L.
    for j in range(6):
        for i in range(3):
            turned[i, j] = Q[i, 0] * L[0, j] + Q[i, 1] * L[1, j] + Q[i, 2] * L[2, j]
            turned[3 + i, j] = dt * std[3 + i] * std[3 + i] * L[3 + i, j]
    for i in range(6):
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for k in range(i, 6):
                total += L[k, i] * turned[k, j]
            A[i, j] = total
    cholesky6(A, turned)
    # Columns of C^-1 L^T, whose square is the result.
    for j in range(6):
        for i in range(6):
            total = L[j, i]
            for k in range(i):
                total -= turned[i, k] * A[k, j]
            A[i, j] = total * turned[i, i]
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(6):
                total += A[k, i] * A[k, j]
            predicted[i, j] = total
            predicted[j, i] = total


@helper
def tag_square(P: Any, rotation: Any, tags: Any) -> float:
    """Return the mean of ``tr(J_n P J_n^T)`` over the tags, from the lower triangle of P."""
    total = 0.0
    for n in range(tags.shape[0]):
        a, b, c = tags[n, 0], tags[n, 1], tags[n, 2]
        x = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
        y = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
        z = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
        total += P[0, 0] * (y * y + z * z) + P[1, 1] * (x * x + z * z) + P[2, 2] * (x * x + y * y)
        total -= 2 * (P[1, 0] * x * y + P[2, 0] * x * z + P[2, 1] * y * z)
        total -= 2 * (x * (P[5, 1] - P[4, 2]) + y * (P[3, 2] - P[5, 0]) + z * (P[4, 0] - P[3, 1]))
    return total / tags.shape[0] + P[3, 3] + P[4, 4] + P[5, 5]


@helper
def square_of_information(J: Any, rotation: Any, tags: Any, work: Any) -> float:
    """Return `tag_square` of J^-1; NaN if J is not positive definite. work is (2, 6, 6)."""
    L, P = work[0], work[1]
    if not cholesky6(J, L):
        return math.nan
    invert_factored6(L, P)
    return tag_square(P, rotation, tags)


@gufunc("(s,s),(s),(),(s),(m,d),(n,d),(d,d),(d),(l),(m,n)->(s,s),()")
def step_of_ranges(
    prior: Any, twist: Any, dt: float, std: Any, anchors: Any, tags: Any, rotation: Any,
    translation: Any, law: Any, share: Any, information: Any, score: Any,
) -> None:  # fmt: skip
    """Do a step of the posterior Cramer-Rao recursion with ranges; compute the score after it."""
    work = workspace((4, 6, 6))
    _predict(prior, twist, dt, std, work, information)
    add_range_information(information, anchors, tags, rotation, translation, law, share)
    score[0] = math.sqrt(square_of_information(information, rotation, tags, work))


@gufunc("(s,s),(s),(),(s),(d),(n,d),(d,d),(d),()->(s,s),()")
def step_of_angles(
    prior: Any, twist: Any, dt: float, std: Any, station: Any, tags: Any, rotation: Any,
    translation: Any, angle_std: float, information: Any, score: Any,
) -> None:  # fmt: skip
    """Do a step of the posterior Cramer-Rao recursion with angles; compute the score after it."""
    work = workspace((4, 6, 6))
    _predict(prior, twist, dt, std, work, information)
    _add_angle_information(
        information, station, tags, rotation, translation, 1 / (angle_std * angle_std)
    )
    score[0] = math.sqrt(square_of_information(information, rotation, tags, work))


# Closer to the station (m) than this a direction is undefined: its gradient counts as zero.
_NOWHERE = 1e-50


@helper
def _add_angle_information(
    information: Any, station: Any, tags: Any, rotation: Any, translation: Any, weight: float
) -> None:
    """Add the information of the angles to the x and the z axis about the pose."""
    for n in range(tags.shape[0]):
        a, b, c = tag_position(rotation, translation, tags, n)
        x, y, z = a - station[0], b - station[1], c - station[2]
        square = x * x + y * y + z * z
        xx = xy = xz = yy = yz = zz = 0.0
        for axis in range(2):
            # The gradient (x (e x) / across - e across) / |x|^2 of the angle to the axis e.
            along, across = (x, math.hypot(y, z)) if axis == 0 else (z, math.hypot(x, y))
            scale = square * across
            f = along / scale if scale > _NOWHERE**3 else 0.0
            last = -across / square if square > _NOWHERE**2 else 0.0
            g, h, k = x * f, y * f, z * f
            if axis == 0:
                g = last
            else:
                k = last
            xx += weight * g * g
            xy += weight * g * h
            xz += weight * g * k
            yy += weight * h * h
            yz += weight * h * k
            zz += weight * k * k
        _add_lifted(
            information,
            a - translation[0], b - translation[1], c - translation[2], xx, xy, xz, yy, yz, zz,
        )  # fmt: skip
    _mirror_upper(information)


@gufunc("(n,n),()->(n,n),()", "fffb")
def regular_inverse(matrix: Any, least: float, inverse: Any, regular: Any) -> None:
    """Compute the inverse; NaN if the determinant at unit diagonal is below `least`."""
    n = matrix.shape[0]
    scale, unit, L = np.empty(n), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        scale[i] = 1.0 if matrix[i, i] <= 0 else math.sqrt(matrix[i, i])
        for j in range(i + 1):
            unit[i, j] = matrix[i, j] / (scale[i] * scale[j])
    good, determinant = cholesky(unit, L), 1.0
    for i in range(n):
        determinant /= L[i, i] * L[i, i]
    # NaN stays NaN.
    regular[0] = determinant != determinant or (good and determinant > least)
    if not regular[0]:
        fill(math.nan, inverse)
        return
    invert_factored(L, inverse)
    for i in range(n):
        for j in range(n):
            inverse[i, j] /= scale[i] * scale[j]
