"""Inertial navigation of one body: integration of readings, propagation of covariance.

The textbook form is in `rbl_gym.motion.navigation`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.jit import gufunc, helper, inlined
from rbl_gym.kernels.workspace import workspace


@inlined
def cross(x: float, y: float, z: float, M: Any, out: Any) -> None:
    """Compute ``out = [s]x M`` of s = (x, y, z)."""
    for j in range(3):
        a, b, c = M[0, j], M[1, j], M[2, j]
        out[0, j] = y * c - z * b
        out[1, j] = z * a - x * c
        out[2, j] = x * b - y * a


@helper
def integrate(
    readings: Any, steps: Any, extra: Any, law: Any, Q: Any, moved: Any, J: Any, N: Any, room: Any
) -> tuple[float, float]:
    """Preintegrate; return the time and the variance of the rotation; `room` is (6, 3, 3).

    moved (4, 3): position, velocity, l and m. J (5, 3, 3): derivatives of rotation, position and
    velocity by the gyroscope's bias, of position and velocity by the accelerometer's. The noise is
    isotropic. The covariance of the rotation is therefore a number, and those of position and
    velocity with it are ``-[l]x`` and ``-[m]x``. N (3, 3, 3): covariances tt, tv, vv.
    """
    half, A, B, D, E, U = room[0], room[1], room[2], room[3], room[4], room[5]
    seconds = turned = 0.0
    for i in range(3):
        for k in range(4):
            moved[k, i] = 0.0
        for j in range(3):
            Q[i, j] = 1.0 if i == j else 0.0
            for k in range(5):
                J[k, i, j] = 0.0
            for k in range(3):
                N[k, i, j] = 0.0
    for k in range(readings.shape[0]):
        h = steps[k]
        if h < 1e-100:  # zero length; 1 / h is finite above
            continue
        seconds += h
        hh = 0.5 * h * h
        x = h * (readings[k, 0] - extra[3])
        y = h * (readings[k, 1] - extra[4])
        z = h * (readings[k, 2] - extra[5])
        fx, fy, fz = readings[k, 3] - extra[6], readings[k, 4] - extra[7], readings[k, 5] - extra[8]
        # exp and left Jacobian of half the rotation, and the Jacobian of the whole rotation.
        s = x * x + y * y + z * z
        a, b, c = rotations.coefficients(0.25 * s)
        rotations.series(0.5 * x, 0.5 * y, 0.5 * z, a, b, 1 - 0.25 * b * s, E)
        rotations.compose(Q, E, half)
        rotations.series(0.5 * x, 0.5 * y, 0.5 * z, b, c, 1 - 0.25 * c * s, D)
        rotations.compose(Q, D, B)
        # The whole rotation, from its halves.
        b, c = 0.5 * a * a, 0.25 * (c + a * b)
        rotations.series(x, y, z, b, c, 1 - c * s, D)
        rotations.compose(Q, D, A)
        rotations.compose(half, E, Q)
        fx, fy, fz = (
            half[0, 0] * fx + half[0, 1] * fy + half[0, 2] * fz,
            half[1, 0] * fx + half[1, 1] * fy + half[1, 2] * fz,
            half[2, 0] * fx + half[2, 1] * fy + half[2, 2] * fz,
        )
        for i in range(3):
            for j in range(3):
                U[i, j] = 0.5 * h * B[i, j] - J[0, i, j]
                J[0, i, j] -= h * A[i, j]
        # Derivatives of the force, by the errors before the sample.
        cross(fx, fy, fz, U, D)
        for i in range(3):
            for j in range(3):
                J[1, i, j] += h * J[2, i, j] + hh * D[i, j]
                J[2, i, j] += h * D[i, j]
                J[3, i, j] += h * J[4, i, j] - hh * half[i, j]
                J[4, i, j] -= h * half[i, j]
        # Noise of the rotation, and of the force; W and X: covariances of the force with v and t.
        g, r = law[0] * h, law[1] / h
        share, square = turned + 0.25 * g, turned + 0.5 * g
        dot_l = fx * moved[2, 0] + fy * moved[2, 1] + fz * moved[2, 2]
        dot_m = fx * moved[3, 0] + fy * moved[3, 1] + fz * moved[3, 2]
        own = r + share * (fx * fx + fy * fy + fz * fz)
        for i in range(3):
            fi = fx if i == 0 else (fy if i == 1 else fz)
            for j in range(3):
                fj = fx if j == 0 else (fy if j == 1 else fz)
                X, Xt = -moved[2, i] * fj, -moved[2, j] * fi
                W, Wt = -moved[3, i] * fj, -moved[3, j] * fi
                Y = -share * fi * fj
                if i == j:
                    X, Xt, W, Wt, Y = X + dot_l, Xt + dot_l, W + dot_m, Wt + dot_m, Y + own
                U[i, j] = h * Xt + h * N[2, i, j] + h * h * Wt + hh * W + hh * h * Y
                B[i, j] = hh * (X + Xt) + h * h * N[2, i, j] + h * hh * (W + Wt) + hh * hh * Y
                D[i, j] = h * (W + Wt) + h * h * Y
        for i in range(3):
            for j in range(3):
                N[0, i, j] += h * (N[1, i, j] + N[1, j, i]) + B[i, j]
        for i in range(3):
            for j in range(3):
                N[1, i, j] += U[i, j]
                N[2, i, j] += D[i, j]
        for i in range(3):
            fi = fx if i == 0 else (fy if i == 1 else fz)
            moved[2, i] += h * moved[3, i] + hh * square * fi
            moved[3, i] += h * square * fi
            moved[0, i] += h * moved[1, i] + hh * fi
            moved[1, i] += h * fi
        turned += g
    return seconds, turned


@helper
def carry(F: Any, lean: Any, T: float, tilted: bool, gone: Any, M: Any, count: int, out: Any):
    """Compute the rows (9, count) that change over the interval, of columns of M."""
    for i in range(3):
        a, b, c = F[0, i, 0], F[0, i, 1], F[0, i, 2]
        for j in range(count):
            out[i, j] = M[i, j] + a * M[9, j] + b * M[10, j] + c * M[11, j]
        for block in range(2):
            row, k, m = 3 + 3 * block + i, (i + 1) % 3, (i + 2) % 3
            # Of row i of -[gone]x.
            p, q = gone[block, m], -gone[block, k]
            a, b, c = F[1 + block, i, 0], F[1 + block, i, 1], F[1 + block, i, 2]
            d, e, f = F[3 + block, i, 0], F[3 + block, i, 1], F[3 + block, i, 2]
            for j in range(count):
                out[row, j] = (
                    M[row, j]
                    + p * M[k, j]
                    + q * M[m, j]
                    + a * M[9, j]
                    + b * M[10, j]
                    + c * M[11, j]
                    + d * M[12, j]
                    + e * M[13, j]
                    + f * M[14, j]
                )
        for j in range(count):
            out[3 + i, j] += T * M[6 + i, j]
        if tilted:
            for j in range(count):
                fallen = lean[i, 0] * M[15, j] + lean[i, 1] * M[16, j]
                out[3 + i, j] += 0.5 * T * T * fallen
                out[6 + i, j] += T * fallen


@gufunc("(d,d),(d),(k),(p,p),(s,c),(s),(q)->(d,d),(d),(k),(p,p)")
def propagate(Q0, t0, extra, P0, readings, steps, law, Q, t, after, P):
    """Compute state and covariance after the samples of an interval."""
    n = P0.shape[0]
    # Fewer allocations: each takes as long as a small product.
    room, rows, before = workspace((25, 3, 3)), np.empty((2, 9, n)), np.empty((n, n))
    R, turned, half, lean = room[0], room[1], room[2], room[3]
    J, N, F, moves = room[4:9], room[9:12], room[12:17], workspace((8, 3))
    moved, gone = moves[:4], moves[4:]
    for i in range(3):
        for j in range(3):
            R[i, j] = Q0[i, j]
    T, variance = integrate(readings, steps, extra, law, turned, moved, J, N, room[17:])
    rotations.compose(R, turned, Q)
    tilted = law[5] != 0
    down_x, down_y, down_z = 0.0, 0.0, -law[4]
    if tilted:
        rotations.exp(extra[9], extra[10], 0.0, half)
        down_x, down_y, down_z = -law[4] * half[0, 2], -law[4] * half[1, 2], -law[4] * half[2, 2]
        rotations.left_jacobian(extra[9], extra[10], 0.0, half)
        for j in range(2):
            lean[0, j] = down_z * half[1, j] - down_y * half[2, j]
            lean[1, j] = down_x * half[2, j] - down_z * half[0, j]
            lean[2, j] = down_y * half[0, j] - down_x * half[1, j]
    for b in range(4):
        for i in range(3):
            gone[b, i] = R[i, 0] * moved[b, 0] + R[i, 1] * moved[b, 1] + R[i, 2] * moved[b, 2]
    for b in range(5):
        rotations.compose(R, J[b], F[b])
    for i in range(extra.shape[0]):
        after[i] = extra[i]
    for i in range(3):
        down = down_x if i == 0 else (down_y if i == 1 else down_z)
        t[i] = t0[i] + extra[i] * T + 0.5 * down * T * T + gone[0, i]
        after[i] += down * T + gone[1, i]
    # The rows of F P0 that change; then their columns. Contiguous copies are faster.
    for i in range(n):
        for j in range(n):
            before[i, j] = P0[i, j]
    carry(F, lean, T, tilted, gone, before, n, rows[0])
    for i in range(9):
        for j in range(n):
            before[j, i] = rows[0, i, j]
    carry(F, lean, T, tilted, gone, before, 9, rows[1])
    # Noise, rotated to the world frame; random walks of the biases.
    for b in range(3):
        row, column = (3, 6, 6)[b], (3, 3, 6)[b]
        rotations.compose(R, N[b], half)
        for i in range(3):
            for j in range(3):
                total = half[i, 0] * R[j, 0] + half[i, 1] * R[j, 1] + half[i, 2] * R[j, 2]
                if b == 1:
                    rows[1, row + j, column + i] += total
                else:
                    rows[1, row + i, column + j] += total
    for b in range(2):
        row, x, y, z = 3 + 3 * b, gone[2 + b, 0], gone[2 + b, 1], gone[2 + b, 2]
        rows[1, b, b] += variance
        rows[1, row, 1] += z
        rows[1, row, 2] -= y
        rows[1, row + 1, 0] -= z
        rows[1, row + 1, 2] += x
        rows[1, row + 2, 0] += y
        rows[1, row + 2, 1] -= x
    rows[1, 2, 2] += variance
    for i in range(9):
        for j in range(i + 1):
            P[i, j] = P[j, i] = rows[1, i, j]
        for j in range(9, n):
            P[i, j] = P[j, i] = rows[0, i, j]
    for i in range(9, n):
        for j in range(9, n):
            P[i, j] = P0[i, j]
    for i in range(3):
        P[9 + i, 9 + i] += law[2] * T
        P[12 + i, 12 + i] += law[3] * T
