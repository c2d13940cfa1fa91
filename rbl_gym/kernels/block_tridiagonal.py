"""Block-tridiagonal systems: solution, and diagonal blocks of the inverse; plain loops.

Blocks are copied to contiguous arrays. The innermost loops add multiples of rows to rows, which
compilers vectorize.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.jit import gufunc, helper


@helper
def _factor(D: Any) -> None:
    """Replace the upper half of D by the upper factor R of ``D = R^T R``; NaN if not positive."""
    n = D.shape[0]
    for p in range(n):
        pivot = D[p, p]
        root = math.sqrt(pivot) if pivot > 0.0 else math.nan
        inverse = 1.0 / root
        for j in range(p, n):
            D[p, j] *= inverse
        for i in range(p + 1, n):
            share = D[p, i]
            if share != 0.0:
                for j in range(i, n):
                    D[i, j] -= share * D[p, j]


@helper
def _forward(R: Any, B: Any) -> None:
    """Replace B by ``R^-T B``, where R is upper triangular."""
    n, m = B.shape
    for i in range(n):
        for k in range(i):
            share = R[k, i]
            if share != 0.0:
                for j in range(m):
                    B[i, j] -= share * B[k, j]
        inverse = 1.0 / R[i, i]
        for j in range(m):
            B[i, j] *= inverse


@helper
def _backward(R: Any, B: Any) -> None:
    """Replace B by ``R^-1 B``, where R is upper triangular."""
    n, m = B.shape
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            share = R[i, k]
            if share != 0.0:
                for j in range(m):
                    B[i, j] -= share * B[k, j]
        inverse = 1.0 / R[i, i]
        for j in range(m):
            B[i, j] *= inverse


@helper
def _subtract_product(A: Any, B: Any, out: Any, upper: bool) -> None:
    """Compute ``out -= A^T B``, or only its upper half."""
    for p in range(A.shape[0]):
        for i in range(A.shape[1]):
            share = A[p, i]
            if share != 0.0:
                for j in range(i if upper else 0, B.shape[1]):
                    out[i, j] -= share * B[p, j]


@helper
def _factor_all(diagonal: Any, above: Any, R: Any, W: Any) -> None:
    """Return factors R (K, n, n) of the pivots, and ``W = R^-T above`` (K, n, n)."""
    K, n = diagonal.shape[0], diagonal.shape[1]
    for k in range(K):
        for i in range(n):
            for j in range(n):
                R[k, i, j] = diagonal[k, i, j]
        if k > 0:
            _subtract_product(W[k - 1], W[k - 1], R[k], True)
        _factor(R[k])
        if k + 1 < K:
            for i in range(n):
                for j in range(n):
                    W[k, i, j] = above[k, i, j]
            _forward(R[k], W[k])


@gufunc("(k,n,n),(k,n,n),(k,n,c)->(k,n,c)")
def solve(diagonal: Any, above: Any, right: Any, solution: Any) -> None:
    """See `rbl_gym.bounds.tridiagonal.solve_blocks`."""
    K, n, c = right.shape
    R, W, x = np.empty((K, n, n)), np.empty((K, n, n)), np.empty((K, n, c))
    _factor_all(diagonal, above, R, W)
    for k in range(K):
        for i in range(n):
            for j in range(c):
                x[k, i, j] = right[k, i, j]
        if k > 0:
            _subtract_product(W[k - 1], x[k - 1], x[k], False)
        _forward(R[k], x[k])
    for k in range(K - 1, -1, -1):
        if k + 1 < K:
            for i in range(n):
                for p in range(n):
                    share = W[k, i, p]
                    if share != 0.0:
                        for j in range(c):
                            x[k, i, j] -= share * x[k + 1, p, j]
        _backward(R[k], x[k])
        for i in range(n):
            for j in range(c):
                solution[k, i, j] = x[k, i, j]


@gufunc("(k,n,n),(k,n,n)->(k,n,n)")
def invert(diagonal: Any, above: Any, inverse: Any) -> None:
    """See `rbl_gym.bounds.tridiagonal.inverse_blocks`."""
    K, n = diagonal.shape[0], diagonal.shape[1]
    R, W = np.empty((K, n, n)), np.empty((K, n, n))
    _factor_all(diagonal, above, R, W)
    P, new, T, G = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for k in range(K - 1, -1, -1):
        # Rows of R^-T: its product with itself is the inverse of the pivot.
        for i in range(n):
            for j in range(n):
                T[i, j] = 1.0 if i == j else 0.0
                new[i, j] = 0.0
        _forward(R[k], T)
        for p in range(n):
            for i in range(p + 1):
                share = T[p, i]
                for j in range(p + 1):
                    new[i, j] += share * T[p, j]
        if k + 1 < K:
            # With G = pivot^-1 above, the block is pivot^-1 + G P G^T; G stores its transpose.
            _backward(R[k], W[k])
            for i in range(n):
                for j in range(n):
                    G[j, i] = W[k, i, j]
                    T[i, j] = 0.0
            for i in range(n):
                for p in range(n):
                    share = P[i, p]
                    for j in range(n):
                        T[i, j] -= share * G[p, j]
            _subtract_product(G, T, new, False)
        for i in range(n):
            for j in range(i + 1):
                mean = 0.5 * (new[i, j] + new[j, i])
                P[i, j] = mean
                P[j, i] = mean
                inverse[k, i, j] = mean
                inverse[k, j, i] = mean
