"""Innovations of one epoch, their covariance and statistic.

The textbook form is `whitened` in `estimators/innovation.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.jit import gufunc
from rbl_gym.kernels.linear_algebra import cholesky, factor_semidefinite


@gufunc("(l,p),(l,k),(s,s),(s),(l),(l),(l),(l)->(l),(l),(),(),()", "ffffffbbffffb")
def whiten(
    H: Any, S: Any, P: Any, moved: Any, residual: Any, variance: Any, links: Any, used: Any,
    v: Any, own: Any, squares: Any, log_det: Any, sound: Any,
) -> None:  # fmt: skip
    """Compute innovations, variances added by the state, NIS and determinant of the used ones."""
    rows, size = H.shape[0], P.shape[0]
    A, AP, u = np.empty((rows, size)), np.zeros((rows, size)), np.empty(rows)
    count, good = 0, True
    for k in range(rows):
        scale = 1 / math.sqrt(variance[k]) if links[k] else 0.0
        v[k], own[k] = residual[k], 0.0
        # Rows that are used come first.
        a = count if used[k] else rows - 1 - k + count
        for i in range(size):
            slope = H[k, i] if i < 6 else S[k, i - 6]
            v[k] += slope * moved[i]
            A[a, i] = slope * scale
            AP[a, i] = 0.0
        for i in range(size):
            # Most links have few biases.
            if A[a, i] != 0:
                for j in range(size):
                    AP[a, j] += A[a, i] * P[i, j]
        for i in range(size):
            own[k] += AP[a, i] * A[a, i]
        u[a] = v[k] * scale
        good = good and math.isfinite(own[k]) and math.isfinite(residual[k])
        count += 1 if used[k] else 0
    n = min(count, size)
    total, right = np.zeros((n, n)), np.zeros(n)
    squares[0], log_det[0], sound[0] = 0.0, 0.0, good
    if not good:
        return
    if count <= size:
        # I + A P A^T.
        for b in range(n):
            right[b] = u[b]
            for i in range(size):
                if A[b, i] != 0:
                    for a in range(b, n):
                        total[a, b] += AP[a, i] * A[b, i]
    else:
        # Woodbury's identity with P = F F^T: I + F^T A^T A F.
        F, AF = np.zeros((size, size)), np.zeros((count, size))
        factor_semidefinite(P, F)
        for a in range(count):
            squares[0] += u[a] * u[a]
            for i in range(size):
                for j in range(i + 1):
                    AF[a, j] += A[a, i] * F[i, j]
            for i in range(size):
                right[i] += AF[a, i] * u[a]
                for j in range(i + 1):
                    total[i, j] += AF[a, i] * AF[a, j]
    for a in range(n):
        total[a, a] += 1.0
    sound[0] = cholesky(total, total)
    sign = 1.0 if count <= size else -1.0
    for a in range(n):
        for b in range(a):
            right[a] -= total[a, b] * right[b]
        right[a] *= total[a, a]
        squares[0] += sign * right[a] * right[a]
        log_det[0] -= 2 * math.log(total[a, a])
