"""Small matrices by components: matrix axes first, trials last, so that calls run along memory.

In public every array has its trials first. A view with its axes moved costs nothing, so the
estimators keep that shape and lay only the memory out the other way; here both orders meet.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rbl_gym.checks import FloatArray, kernel
from rbl_gym.geometry import rotations

# Behind the doors: what comes to these was checked, or made here.
_EXP, _LOG = kernel(rotations.exp), kernel(rotations.log)
_LEFT_JACOBIAN_INVERSE = kernel(rotations.left_jacobian_inverse)


@contextlib.contextmanager
def whole_rows() -> Iterator[None]:
    """Let numpy compute on rows of trials where they are.

    It copies operands into its buffer (8192 numbers) when their rows are shorter and do not
    join up, which takes longer than the arithmetic.
    """
    before = np.setbufsize(256)
    try:
        yield
    finally:
        np.setbufsize(before)


def first(array: NDArray[Any], trailing: int, batch: int = 0) -> NDArray[Any]:
    """View (n, ..., batch) of (batch, n, ...): the `trailing` axes first, the batch axes last.

    Fewer batch axes than `batch` are filled up with axes of 1, so that views broadcast.
    """
    lead = array.ndim - trailing
    if lead == 0 and batch == 0:
        return array
    view = array.transpose((*range(lead, array.ndim), *range(lead)))
    if batch <= lead:
        return view
    return view.reshape((*view.shape[:trailing], *(1,) * (batch - lead), *view.shape[trailing:]))


def last(array: FloatArray, leading: int) -> FloatArray:
    """View (batch, n, ...) of (n, ..., batch): inverse of `first`."""
    if leading == array.ndim:
        return array
    return array.transpose((*range(leading, array.ndim), *range(leading)))


def trials_last(array: FloatArray, trailing: int) -> FloatArray:
    """The array (batch, n, ...) with its memory laid out as (n, ..., batch)."""
    if array.ndim == trailing:
        return array
    return last(np.ascontiguousarray(first(array, trailing)), trailing)


def product(A: FloatArray, B: FloatArray) -> FloatArray:
    """``A B`` (i, k, ...) of matrices (i, j, ...) and (j, k, ...)."""
    return A @ B if A.ndim == B.ndim == 2 else np.einsum("ij...,jk...->ik...", A, B)


def exp(w: FloatArray) -> FloatArray:
    """Rotation matrices (3, 3, ...) of rotation vectors (3, ...); `rotations.exp`."""
    if w.ndim == 1:
        return _EXP(w)
    squared = np.einsum("i...,i...->...", w, w)
    a, b, _ = rotations.coefficients(squared)
    return _series(w, a, b, 1.0 - b * squared)


def exp_and_left_jacobian(w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`exp` and `rotations.left_jacobian` (3, 3, ...) of rotation vectors (3, ...), trials last."""
    squared = np.einsum("i...,i...->...", w, w)
    a, b, c = rotations.coefficients(squared)
    return _series(w, a, b, 1.0 - b * squared), _series(w, b, c, 1.0 - c * squared)


def log(Q: FloatArray) -> FloatArray:
    """Rotation vectors (3, ...) of rotation matrices (3, 3, ...); `rotations.log`."""
    return np.ascontiguousarray(first(_LOG(last(Q, 2)), 1))


def left_jacobian_inverse(w: FloatArray) -> FloatArray:
    """``Jl(w)^-1`` (3, 3, ...) of rotation vectors (3, ...); `rotations.left_jacobian_inverse`."""
    if w.ndim == 1:
        return _LEFT_JACOBIAN_INVERSE(w)
    squared = np.einsum("i...,i...->...", w, w)
    c = rotations.inverse_coefficient(squared)
    return _series(w, np.full_like(squared, -0.5), c, 1.0 - c * squared)


def _series(w: FloatArray, a: FloatArray, b: FloatArray, diagonal: FloatArray) -> FloatArray:
    """``diagonal * I + a [w]x + b w w^T`` (3, 3, ...)."""
    M = (b * w)[:, None] * w
    turn = a * w
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        M[i, i] += diagonal
        M[k, j] += turn[i]
        M[j, k] -= turn[i]
    return M


def cross(c: FloatArray, X: FloatArray) -> FloatArray:
    """``[c]x X`` for vectors (3, ...) and matrices (3, k, ...)."""
    c1, c2 = c[[1, 2, 0]][:, None], c[[2, 0, 1]][:, None]
    return c1 * X[[2, 0, 1]] - c2 * X[[1, 2, 0]]


def solve(A: FloatArray, b: FloatArray, damping: FloatArray) -> FloatArray:
    """Solution (n, ...) of ``(A + damping diag(A)) x = b``, A (n, n, ...) positive semidefinite.

    Elimination without exchange of rows, which such a matrix does not need. A pivot that
    rounding leaves below 1e-14 of its diagonal entry is raised to it.
    """
    n = len(A)
    diagonal = _diagonal(A)
    if A.ndim == 2:
        return np.linalg.solve(A + np.diag((damping + 1e-14) * diagonal + 1e-300), b)
    L, U = np.empty_like(A), np.empty((n, n + 1, *A.shape[2:]))
    U[:, :n], U[:, n] = A, b
    if damping.any():
        U[range(n), range(n)] += damping * diagonal
    floor = 1e-14 * diagonal + 1e-300
    for k in range(n):
        if k:
            U[k, k:] -= _combined(L[k, :k], U[:k, k:])
        np.maximum(U[k, k], floor[k], out=U[k, k])
        np.divide(U[k, k + 1 : n], U[k, k], out=L[k + 1 :, k])
    x = U[:, n] / _diagonal(U[:, :n])
    for k in reversed(range(n - 1)):
        x[k] -= np.einsum("j...,j...->...", L[k + 1 :, k], x[k + 1 :])
    return x


def inverse(A: FloatArray) -> FloatArray:
    """Inverse (n, n, ...) of symmetric positive definite matrices, ``L^-T D^-1 L^-1``.

    The factors are inverted, not blocks of A: those lose a vague prior's digits.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a matrix is not positive definite.
    """
    if A.ndim == 2:
        inverted = np.linalg.inv(A)
        return 0.5 * (inverted + inverted.T)
    n = len(A)
    # [A, I], of which elimination makes [D^1/2 L^T, D^-1/2 L^-1].
    U = np.empty((n, 2 * n, *A.shape[2:]))
    U[:, :n], U[:, n:] = A, 0.0
    pivots, products = np.empty_like(U[:, 0]), np.empty_like(U[1:, :n])
    with whole_rows(), np.errstate(divide="ignore", invalid="ignore"):
        for k in range(n):
            U[k, n + k] = 1.0
            pivots[k] = U[k, k]
            # What changes: below row k the columns after k, up to where I has begun to fill.
            row = U[k, k + 1 : n + k + 1]
            row *= 1 / np.sqrt(pivots[k])
            below = np.multiply(U[k, k + 1 : n, None], row, out=products[k:])
            U[k + 1 :, k + 1 : n + k + 1] -= below
    smallest = pivots.min(initial=np.inf)
    if not smallest > 0:
        raise np.linalg.LinAlgError(f"matrix must be positive definite, got a pivot {smallest:g}")
    rows, inverted = U[:, n:], np.empty_like(U[:, :n])
    for i in range(n):
        # Columns of the factor are zero above their diagonal.
        np.einsum("k...,kj...->j...", rows[i:, i], rows[i:, : i + 1], out=inverted[i, : i + 1])
        inverted[:i, i] = inverted[i, :i]
    return inverted


def _combined(weights: FloatArray, rows: FloatArray) -> FloatArray:
    """Sum (n, ...) of rows (k, n, ...) by their weights (k, ...)."""
    return np.einsum("j...,ji...->i...", weights, rows)


def _diagonal(A: FloatArray) -> FloatArray:
    """The diagonal (n, ...) of (n, n, ...) as a view where the memory allows it."""
    n = len(A)
    return A.reshape((n * n, *A.shape[2:]))[:: n + 1]
