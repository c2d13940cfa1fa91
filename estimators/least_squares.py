"""Weighted orthogonal Procrustes: the rotation that fits a 9-vector in a given 9 x 9 weight."""

from __future__ import annotations

import numpy as np

from rbl_gym import rotations
from rbl_gym.checks import FloatArray

# The generators of SO(3): E[i] = [e_i]x.
_E = rotations.hat(np.eye(3))
# Symmetrised products (E_i E_j + E_j E_i) / 2, the second-order term of exp.
_EE = 0.5 * (np.einsum("iab,jbc->ijac", _E, _E) + np.einsum("jab,ibc->ijac", _E, _E))


def vec(matrix: FloatArray) -> FloatArray:
    """Columns of (..., 3, k) stacked, (..., 3 k)."""
    columns = np.swapaxes(matrix, -1, -2)
    return columns.reshape(*columns.shape[:-2], -1)


def unvec(vector: FloatArray) -> FloatArray:
    """Inverse of `vec` for 3 x 3 matrices."""
    return np.swapaxes(vector.reshape(*vector.shape[:-1], 3, 3), -1, -2)


def procrustes(
    weight: FloatArray, target: FloatArray, start: FloatArray, iterations: int = 30
) -> tuple[FloatArray, FloatArray]:
    """Rotation that minimises ``(vec Q - q)^T W (vec Q - q) / 2`` by Newton's method on SO(3).

    Exact Hessian, damped where it is not positive or the cost would rise; the update is
    ``Q <- exp(w) Q``. Local: the caller chooses the starts (put them on a batch axis).

    Parameters
    ----------
    weight, target
        W (..., 9, 9), positive semidefinite, and q (..., 9).
    start
        Rotation (..., 3, 3) to start from.
    iterations
        At the most; it stops when all trials stand still.

    Returns
    -------
    The rotation (..., 3, 3) and its cost (...).
    """
    batch = np.broadcast_shapes(weight.shape[:-2], target.shape[:-1], start.shape[:-2])
    Q = np.broadcast_to(start, (*batch, 3, 3))
    residual = vec(Q) - target
    pull = (weight @ residual[..., None])[..., 0]
    cost = 0.5 * np.einsum("...i,...i->...", residual, pull)
    damping = np.zeros(batch)
    for _ in range(iterations):
        tangent = vec(_E @ Q[..., None, :, :])  # (..., 3, 9): derivative of vec Q
        gradient = (tangent @ pull[..., None])[..., 0]
        gauss = tangent @ weight @ np.swapaxes(tangent, -1, -2)
        curvature = np.einsum("...k,...ijk->...ij", pull, vec(_EE @ Q[..., None, None, :, :]))
        hessian = gauss + curvature
        smallest = np.linalg.eigvalsh(hessian)[..., 0]
        scale = np.trace(gauss, axis1=-2, axis2=-1)
        shift = np.maximum(0.0, 1e-9 * scale - smallest) * 1.5 + damping * scale + 1e-300
        step = -np.linalg.solve(hessian + shift[..., None, None] * np.eye(3), gradient[..., None])
        step = step[..., 0]
        # A step past a quarter turn leaves the region the quadratic model speaks of.
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        step = step * np.minimum(1.0, 1.5 / np.maximum(length, 1e-300))
        candidate = rotations.exp(step) @ Q
        new_residual = vec(candidate) - target
        new_pull = (weight @ new_residual[..., None])[..., 0]
        new_cost = 0.5 * np.einsum("...i,...i->...", new_residual, new_pull)
        better = new_cost <= cost * (1 + 1e-12)
        Q = np.where(better[..., None, None], candidate, Q)
        pull = np.where(better[..., None], new_pull, pull)
        cost = np.where(better, new_cost, cost)
        damping = np.where(better, 0.1 * damping, np.maximum(10 * damping, 1e-3))
        if (length[..., 0] < 1e-13).all():
            break
    return Q, cost
