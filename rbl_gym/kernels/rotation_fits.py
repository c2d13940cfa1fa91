"""Rotations nearest to a matrix, in Frobenius norm and in a weighted norm (9 x 9).

The textbook forms are `rbl_gym.geometry.rotations.nearest` and
`procrustes` in `estimators/linear/least_squares.py`.
"""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels import rotations
from rbl_gym.kernels.eigen import eigen
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.workspace import workspace

# Determinant at unit norm (at most 0.19) above which the polar iteration is exact to 1e-13.
_WELL_CONDITIONED = 1e-3
# After a step this short nothing more is gained; undamped Newton steps square the error.
_SHORT_STEP, _SHORT_NEWTON_STEP, _ITERATIONS = 1e-12, 1e-8, 30
# A step beyond a quarter turn leaves the region where the quadratic model is valid.
_LONGEST_STEP = 1.5


@gufunc("(d,d)->(d,d)")
def nearest(matrix: Any, rotation: Any) -> None:
    """Compute the proper rotation nearest to a matrix in Frobenius norm; NaN stays NaN."""
    nearest_rotation(matrix, rotation)


@helper
def nearest_rotation(matrix: Any, Q: Any) -> None:
    """Compute `nearest`; Q is not the same array as the matrix."""
    largest = total = norm = 0.0
    for i in range(3):
        for j in range(3):
            total += abs(matrix[i, j])
            largest = max(largest, abs(matrix[i, j]))
    for i in range(3):
        for j in range(3):
            Q[i, j] = matrix[i, j] / largest
            norm += Q[i, j] * Q[i, j]
    scale = 1 / math.sqrt(norm)
    for i in range(3):
        for j in range(3):
            Q[i, j] *= scale
    if _cofactor_row(Q, 0, 1, 2)[3] > _WELL_CONDITIONED:
        _polar(Q)
    elif 0 < norm < math.inf:
        _nearest_by_quaternion(Q)
    elif total == 0:
        for i in range(3):
            for j in range(3):
                Q[i, j] = 1.0 if i == j else 0.0


@helper
def _cofactor_row(Q: Any, i: int, j: int, k: int) -> tuple[float, float, float, float]:
    """Compute row i of the cofactors, the cross product of rows j and k; return the determinant."""
    x = Q[j, 1] * Q[k, 2] - Q[j, 2] * Q[k, 1]
    y = Q[j, 2] * Q[k, 0] - Q[j, 0] * Q[k, 2]
    z = Q[j, 0] * Q[k, 1] - Q[j, 1] * Q[k, 0]
    return x, y, z, Q[i, 0] * x + Q[i, 1] * y + Q[i, 2] * z


@helper
def _polar(Q: Any) -> None:
    """Compute the orthogonal polar factor by ``X <- (g X + X^-T / g) / 2`` (Higham), in place.

    The scale g makes the first steps long. The last steps converge quadratically without it.
    """
    change = 1.0
    while change > 1e-8:
        x0, y0, z0, determinant = _cofactor_row(Q, 0, 1, 2)
        x1, y1, z1, _ = _cofactor_row(Q, 1, 2, 0)
        x2, y2, z2, _ = _cofactor_row(Q, 2, 0, 1)
        g = 1.0
        if change > 0.1:
            norm = square = 0.0
            for i in range(3):
                for j in range(3):
                    norm += Q[i, j] * Q[i, j]
            square += x0 * x0 + y0 * y0 + z0 * z0
            square += x1 * x1 + y1 * y1 + z1 * z1
            square += x2 * x2 + y2 * y2 + z2 * z2
            g = math.sqrt(math.sqrt(square / norm) / determinant)
        a, b = 0.5 * g, 0.5 / (g * determinant)
        change = 0.0
        for i in range(3):
            if i == 0:
                x, y, z = x0, y0, z0
            elif i == 1:
                x, y, z = x1, y1, z1
            else:
                x, y, z = x2, y2, z2
            for j in range(3):
                cofactor = x if j == 0 else (y if j == 1 else z)
                new = a * Q[i, j] + b * cofactor
                change = max(change, abs(new - Q[i, j]))
                Q[i, j] = new


@helper
def _nearest_by_quaternion(Q: Any) -> None:
    """Compute the nearest rotation of any matrix, also reflected or singular, in place.

    Its quaternion is the eigenvector of the largest eigenvalue of Horn's 4 x 4 matrix.
    """
    work = workspace((2, 4, 4))
    K, V = work[0], work[1]
    xx, yy, zz = Q[0, 0], Q[1, 1], Q[2, 2]
    K[0, 0], K[1, 1], K[2, 2], K[3, 3] = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    K[0, 1], K[0, 2], K[0, 3] = Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1]
    K[1, 2], K[1, 3], K[2, 3] = Q[0, 1] + Q[1, 0], Q[0, 2] + Q[2, 0], Q[1, 2] + Q[2, 1]
    for i in range(4):
        for j in range(i):
            K[i, j] = K[j, i]
    eigen(K, V)
    best = 0
    for i in range(1, 4):
        if K[i, i] > K[best, best]:
            best = i
    w, x, y, z = V[0, best], V[1, best], V[2, best], V[3, best]
    Q[0, 0], Q[0, 1], Q[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    Q[1, 0], Q[1, 1], Q[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    Q[2, 0], Q[2, 1], Q[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@gufunc("(p,p),(p),(d,d)->(d,d),()")
def procrustes(weight: Any, target: Any, start: Any, rotation: Any, cost: Any) -> None:
    """Find a rotation minimizing ``(vec Q - q)^T W (vec Q - q) / 2`` near a start; its cost."""
    for i in range(3):
        for j in range(3):
            rotation[i, j] = start[i, j]
    cost[0] = fit_rotation(weight, target, rotation)


@helper
def fit_rotation(W: Any, target: Any, Q: Any) -> float:
    """Run Newton's method on SO(3) from Q, in place; return the cost of `procrustes`.

    The Hessian is exact, and damped if it is not positive definite or the cost would increase. ``Q
    <- exp(w) Q``.
    """
    work = workspace((5, 9))
    pull, new_pull = work[0], work[1]
    T, step = work[2:5], workspace((2, 3, 3))
    turn, candidate = step[0], step[1]
    cost = _pull(W, target, Q, pull)
    damping = 0.0
    for _ in range(_ITERATIONS):
        # Rows of T: the derivatives of vec Q by a rotation about each axis.
        g0 = g1 = g2 = 0.0
        c00 = c01 = c02 = c11 = c12 = c22 = 0.0
        for k in range(3):
            x, y, z = Q[0, k], Q[1, k], Q[2, k]
            a, b, c = pull[3 * k], pull[3 * k + 1], pull[3 * k + 2]
            T[0, 3 * k], T[0, 3 * k + 1], T[0, 3 * k + 2] = 0.0, -z, y
            T[1, 3 * k], T[1, 3 * k + 1], T[1, 3 * k + 2] = z, 0.0, -x
            T[2, 3 * k], T[2, 3 * k + 1], T[2, 3 * k + 2] = -y, x, 0.0
            g0 += y * c - z * b
            g1 += z * a - x * c
            g2 += x * b - y * a
            # The curvature of vec Q along the rotations, sym(q p^T) - (q^T p) I.
            c00 -= y * b + z * c
            c11 -= x * a + z * c
            c22 -= x * a + y * b
            c01 += 0.5 * (x * b + y * a)
            c02 += 0.5 * (x * c + z * a)
            c12 += 0.5 * (y * c + z * b)
        h00, h01, h02, h11, h12, h22 = _gauss(W, T)
        scale = h00 + h11 + h22
        h00, h11, h22 = h00 + c00, h11 + c11, h22 + c22
        h01, h02, h12 = h01 + c01, h02 + c02, h12 + c12
        largest = max(abs(h00), abs(h01), abs(h02), abs(h11), abs(h12), abs(h22))
        lack = 1e-9 * scale - _smallest_eigenvalue(h00, h01, h02, h11, h12, h22)
        # If the weight is only rounding errors, as for coincident tags, nothing else is certain.
        shift = 1.5 * max(0.0, lack) + damping * scale + 1e-15 * largest + 1e-300
        h00, h11, h22 = h00 + shift, h11 + shift, h22 + shift
        # The inverse by cofactors.
        a00, a01, a02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
        a11, a12, a22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
        inverse = -1 / (h00 * a00 + h01 * a01 + h02 * a02)
        x = inverse * (a00 * g0 + a01 * g1 + a02 * g2)
        y = inverse * (a01 * g0 + a11 * g1 + a12 * g2)
        z = inverse * (a02 * g0 + a12 * g1 + a22 * g2)
        length = math.sqrt(x * x + y * y + z * z)
        cut = min(1.0, _LONGEST_STEP / max(length, 1e-300))
        rotations.exp(cut * x, cut * y, cut * z, turn)
        for i in range(3):
            for k in range(3):
                candidate[i, k] = turn[i, 0] * Q[0, k] + turn[i, 1] * Q[1, k] + turn[i, 2] * Q[2, k]
        short = _SHORT_NEWTON_STEP if damping == 0 and lack <= 0 else _SHORT_STEP
        new_cost = _pull(W, target, candidate, new_pull)
        if new_cost <= cost * (1 + 1e-12):
            cost = new_cost
            damping *= 0.1
            for i in range(3):
                for k in range(3):
                    Q[i, k] = candidate[i, k]
            for i in range(9):
                pull[i] = new_pull[i]
        else:
            damping = max(10 * damping, 1e-3)
        if not length > short:
            break
    return cost


@helper
def _pull(W: Any, target: Any, Q: Any, pull: Any) -> float:
    """Compute ``W (vec Q - q)``; return the cost."""
    cost = 0.0
    for i in range(9):
        total = 0.0
        for k in range(3):
            for j in range(3):
                total += W[i, 3 * k + j] * (Q[j, k] - target[3 * k + j])
        pull[i] = total
        cost += 0.5 * total * (Q[i % 3, i // 3] - target[i])
    return cost


@helper
def _gauss(W: Any, T: Any) -> tuple[float, float, float, float, float, float]:
    """Compute the upper triangle of ``T W T^T``."""
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(9):
        a = b = c = 0.0
        for j in range(9):
            w = W[i, j]
            a += w * T[0, j]
            b += w * T[1, j]
            c += w * T[2, j]
        xx += T[0, i] * a
        xy += T[0, i] * b
        xz += T[0, i] * c
        yy += T[1, i] * b
        yz += T[1, i] * c
        zz += T[2, i] * c
    return xx, xy, xz, yy, yz, zz


@helper
def _smallest_eigenvalue(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """Return it for a symmetric matrix with rows (a, b, c), (b, d, e), (c, e, f), by angle."""
    mean = (a + d + f) / 3
    x, y, z = a - mean, d - mean, f - mean
    p = math.sqrt((x * x + y * y + z * z + 2 * (b * b + c * c + e * e)) / 6)
    if p == 0:
        return mean
    x, y, z, b, c, e = x / p, y / p, z / p, b / p, c / p, e / p
    half = 0.5 * (x * (y * z - e * e) - b * (b * z - e * c) + c * (b * e - y * c))
    angle = math.acos(min(1.0, max(-1.0, half))) / 3
    return mean + 2 * p * math.cos(angle + 2 * math.pi / 3)
