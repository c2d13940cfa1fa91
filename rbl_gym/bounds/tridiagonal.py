"""Solve with block-tridiagonal information, as of a chain of states coupled to neighbours.

``H`` has diagonal blocks ``D_k`` (n, n) and blocks ``U_k = H_{k,k+1}`` above them. Elimination from
the first block gives the pivots ``S_k = D_k - U_{k-1}^T S_{k-1}^-1 U_{k-1}``; the blocks of the
inverse follow backwards from the last one, ``P_k = S_k^-1 + G_k P_{k+1} G_k^T`` with ``G_k = S_k^-1
U_k``: the recursion of Rauch, Tung and Striebel in terms of information.
"""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.kernels import compiled

__all__ = ["inverse_blocks", "solve_blocks"]


@compiled("block_tridiagonal:solve")
def solve_blocks(diagonal: FloatArray, above: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution (..., K, n, c) of ``H x = right``; NaN if H is not positive definite.

    Parameters
    ----------
    diagonal, above
        D and U, (..., K, n, n); the last block of `above` is not used.
    right
        (..., K, n, c).
    """
    batch = np.broadcast_shapes(diagonal.shape[:-3], above.shape[:-3], right.shape[:-3])
    x = np.broadcast_to(right, (*batch, *right.shape[-3:])).copy()
    pivots = _inverse_pivots(diagonal, above)
    for k in range(1, x.shape[-3]):
        U = above[..., k - 1, :, :]
        x[..., k, :, :] -= np.swapaxes(U, -1, -2) @ (pivots[k - 1] @ x[..., k - 1, :, :])
    for k in reversed(range(x.shape[-3])):
        if k + 1 < x.shape[-3]:
            x[..., k, :, :] -= above[..., k, :, :] @ x[..., k + 1, :, :]
        x[..., k, :, :] = pivots[k] @ x[..., k, :, :]
    return x


@compiled("block_tridiagonal:invert")
def inverse_blocks(diagonal: FloatArray, above: FloatArray) -> FloatArray:
    """Return the diagonal blocks (..., K, n, n) of ``H^-1``; NaN if H is not positive definite.

    Arguments as in `solve_blocks`.
    """
    P = _inverse_pivots(diagonal, above)
    for k in reversed(range(len(P) - 1)):
        G = P[k] @ above[..., k, :, :]
        P[k] = P[k] + G @ P[k + 1] @ np.swapaxes(G, -1, -2)
        P[k] = 0.5 * (P[k] + np.swapaxes(P[k], -1, -2))
    return np.stack(P, axis=-3)


def _inverse_pivots(diagonal: FloatArray, above: FloatArray) -> list[FloatArray]:
    pivots: list[FloatArray] = []
    for k in range(diagonal.shape[-3]):
        S = diagonal[..., k, :, :]
        if k > 0:
            U = above[..., k - 1, :, :]
            S = S - np.swapaxes(U, -1, -2) @ pivots[-1] @ U
        pivots.append(_inverse(S))
    return pivots


def _inverse(S: FloatArray) -> FloatArray:
    """Return the inverse (..., n, n), by Cholesky factorisation with a unit diagonal."""
    diagonal = np.einsum("...ii->...i", S)
    good = np.isfinite(S).all(axis=(-2, -1)) & (diagonal > 0).all(axis=-1)
    scale = np.sqrt(np.where(good[..., None], diagonal, 1.0))
    outer = scale[..., :, None] * scale[..., None, :]
    unit = np.where(good[..., None, None], S, np.eye(S.shape[-1])) / outer
    try:
        root = np.linalg.cholesky(unit)
    except np.linalg.LinAlgError:
        good &= np.linalg.eigvalsh(unit)[..., 0] > 1e-14
        unit = np.where(good[..., None, None], unit, np.eye(S.shape[-1]))
        root = np.linalg.cholesky(unit)
    half = np.linalg.inv(root)
    return np.where(good[..., None, None], np.swapaxes(half, -1, -2) @ half / outer, np.nan)
