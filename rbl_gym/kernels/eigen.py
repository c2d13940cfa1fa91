"""Eigenvectors of small symmetric matrices by Jacobi rotations."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import helper

_SWEEPS = 30


@helper
def eigen(A: Any, V: Any) -> None:
    """Replace a symmetric matrix by its eigenvalues, on the diagonal; write the vectors to V.

    The columns of V correspond to the values, in no particular order.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        off, size = 0.0, 0.0
        for i in range(n):
            size = max(size, abs(A[i, i]))
            for j in range(i):
                off = max(off, abs(A[i, j]))
        # Also false for NaN.
        if not off > 1e-16 * size:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if abs(A[p, q]) <= 1e-300:
                    continue
                ratio = (A[q, q] - A[p, p]) / (2 * A[p, q])
                tangent = 1 / (abs(ratio) + math.sqrt(ratio * ratio + 1))
                if ratio < 0:
                    tangent = -tangent
                cosine = 1 / math.sqrt(tangent * tangent + 1)
                sine = tangent * cosine
                for k in range(n):
                    x, y = A[k, p], A[k, q]
                    A[k, p], A[k, q] = cosine * x - sine * y, sine * x + cosine * y
                for k in range(n):
                    x, y = A[p, k], A[q, k]
                    A[p, k], A[q, k] = cosine * x - sine * y, sine * x + cosine * y
                    x, y = V[k, p], V[k, q]
                    V[k, p], V[k, q] = cosine * x - sine * y, sine * x + cosine * y
