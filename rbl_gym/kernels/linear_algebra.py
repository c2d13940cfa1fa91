"""Small symmetric positive matrices: Cholesky factor, solution, inverse; plain loops."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import helper

# A pivot that rounding leaves below this share of its diagonal entry is raised to it.
PIVOT_FLOOR = 1e-14


@helper
def cholesky(A: Any, L: Any) -> bool:
    """Lower factor of A into L, its upper part untouched; whether all pivots were good.

    A is read below and on the diagonal. A pivot that is not positive is raised to a floor, so
    that a singular matrix has an enormous inverse; a NaN stays one.
    """
    n = A.shape[0]
    good = True
    for j in range(n):
        pivot = A[j, j]
        floor = PIVOT_FLOOR * pivot + 1e-300
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        if not pivot > floor:
            good = False
            if pivot == pivot:
                pivot = max(floor, 1e-300)
        root = math.sqrt(pivot)
        L[j, j] = root
        inverse = 1 / root
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total * inverse
    return good


@helper
def solve_factored(L: Any, b: Any, x: Any) -> None:
    """The solution x of ``L L^T x = b``; x may be b."""
    n = L.shape[0]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]


@helper
def invert_factored(L: Any, P: Any) -> None:
    """``P = (L L^T)^-1``, both halves; L becomes its own inverse.

    The factor is inverted, not blocks of the matrix: those lose a vague prior's digits.
    """
    n = L.shape[0]
    for i in range(n):
        L[i, i] = 1 / L[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= L[i, k] * L[k, j]
            L[i, j] = total * L[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += L[k, i] * L[k, j]
            P[i, j] = total
            P[j, i] = total


@helper
def multiply(A: Any, B: Any, out: Any) -> None:
    """``out = A B`` of matrices; `out` is neither of them."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[k, j]
            out[i, j] = total


@helper
def multiply_transposed(A: Any, B: Any, out: Any) -> None:
    """``out = A B^T`` of matrices; `out` is neither of them."""
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[j, k]
            out[i, j] = total
