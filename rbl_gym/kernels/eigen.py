"""Eigenvectors of small symmetric matrices by Jacobi rotations, and their applications."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import helper
from rbl_gym.kernels.workspace import workspace

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


@helper
def nearest_rotation(M: Any, Q: Any) -> None:
    """Return the proper rotation Q nearest to M (3, 3): largest eigenvector of Horn's matrix."""
    K, V = workspace((4, 4)), workspace((4, 4))
    K[0, 0] = M[0, 0] + M[1, 1] + M[2, 2]
    K[1, 1] = M[0, 0] - M[1, 1] - M[2, 2]
    K[2, 2] = -M[0, 0] + M[1, 1] - M[2, 2]
    K[3, 3] = -M[0, 0] - M[1, 1] + M[2, 2]
    K[0, 1] = K[1, 0] = M[2, 1] - M[1, 2]
    K[0, 2] = K[2, 0] = M[0, 2] - M[2, 0]
    K[0, 3] = K[3, 0] = M[1, 0] - M[0, 1]
    K[1, 2] = K[2, 1] = M[1, 0] + M[0, 1]
    K[1, 3] = K[3, 1] = M[0, 2] + M[2, 0]
    K[2, 3] = K[3, 2] = M[2, 1] + M[1, 2]
    eigen(K, V)
    best = 0
    for i in range(1, 4):
        if K[i, i] > K[best, best]:
            best = i
    w, x, y, z = V[0, best], V[1, best], V[2, best], V[3, best]
    scale = 2 / (w * w + x * x + y * y + z * z)
    Q[0, 0] = 1 - scale * (y * y + z * z)
    Q[1, 1] = 1 - scale * (x * x + z * z)
    Q[2, 2] = 1 - scale * (x * x + y * y)
    Q[0, 1], Q[1, 0] = scale * (x * y - w * z), scale * (x * y + w * z)
    Q[0, 2], Q[2, 0] = scale * (x * z + w * y), scale * (x * z - w * y)
    Q[1, 2], Q[2, 1] = scale * (y * z - w * x), scale * (y * z + w * x)
