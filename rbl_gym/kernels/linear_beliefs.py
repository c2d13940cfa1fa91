"""Poses from the 12 states of the linear filters: the constraint of UC-KF, and beliefs.

The textbook forms are in `estimators/linear/`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.linear_algebra import cholesky6, invert_factored6, of_size
from rbl_gym.kernels.linear_filter import innovation, spread
from rbl_gym.kernels.rotation_fits import fit_rotation, nearest_rotation
from rbl_gym.kernels.workspace import workspace, zeros

_cholesky3, _, _invert_factored3 = of_size(3)
_cholesky9, _solve_factored9, _invert_factored9 = of_size(9)
_cholesky12, _, _ = of_size(12)


@helper
def _split(state: Any, translation: Any, matrix: Any) -> None:
    """Return the translation and the matrix of a state."""
    for k in range(3):
        translation[k] = state[9 + k]
        for i in range(3):
            matrix[i, k] = state[3 * k + i]


@helper
def _rotation_of(state: Any, Q: Any) -> None:
    """Compute the proper rotation nearest to the columns in a state; Q may not share its memory."""
    work = workspace((4, 3))
    _split(state, work[3], work[:3])
    nearest_rotation(work[:3], Q)


@helper
def _store(Q: Any, state: Any) -> None:
    for k in range(3):
        for i in range(3):
            state[3 * k + i] = Q[i, k]


@gufunc("(p),(p,p)->(p)")
def coupled_fit(mean: Any, P: Any, fitted: Any) -> None:
    """Fit the pose to a linear posterior in its covariance's norm, (23) of the tracking paper."""
    work = workspace((21, 9))
    L, W, Q = work[:9], work[9:18], work[18:21, :3]
    _cholesky9(P, L)
    _invert_factored9(L, W)
    _rotation_of(mean, Q)
    fit_rotation(W, mean[:9], Q)
    _store(Q, fitted)
    for i in range(9, 12):
        fitted[i] = mean[i]
    for k in range(9):
        moved = 0.0
        for j in range(9):
            moved += W[k, j] * (fitted[j] - mean[j])
        for i in range(9, 12):
            fitted[i] += P[i, k] * moved


@gufunc("(p),(p,p),(m,n),(m,d),(n,d),(m,w)->(p)")
def decoupled_fit(
    mean: Any, P: Any, ranges: Any, anchors: Any, tags: Any, weights: Any, fitted: Any
) -> None:
    """Fit the rotation of centred tags (26), then the translation (27), to prior and epoch.

    Weights are the same for all tags.
    """
    work = workspace((30, 9))
    L, W, Q, V = work[:9], work[9:18], work[18:21, :3], work[21:24, :3]
    y, G, target, small = work[24:28, :3], work[28, :6], work[29], work[18:21, 3:6]
    spread(anchors, weights, 0, G)
    # The rotation: target = q + W^-1 y of the tags relative to their centroid.
    centred = np.empty_like(tags)
    for i in range(3):
        centre = 0.0
        for n in range(tags.shape[0]):
            centre += tags[n, i]
        for n in range(tags.shape[0]):
            centred[n, i] = tags[n, i] - centre / tags.shape[0]
    innovation(mean, ranges, anchors, tags, weights, centred, y)
    _cholesky9(P, L)
    _invert_factored9(L, W)
    for k in range(3):
        for m in range(3):
            gram = 0.0
            for n in range(tags.shape[0]):
                gram += centred[n, k] * centred[n, m]
            _add_symmetric(W[3 * k : 3 * k + 3, 3 * m : 3 * m + 3], gram, G)
    _cholesky9(W, L)
    for k in range(3):
        for j in range(3):
            target[3 * k + j] = y[k, j]
    _solve_factored9(L, target, target)
    for i in range(9):
        target[i] += mean[i]
    _rotation_of(target, Q)
    fit_rotation(W, target, Q)
    _store(Q, fitted)
    # The translation: t + (P_t^-1 + N G)^-1 times the rest of the squared ranges.
    for i in range(9, 12):
        fitted[i] = mean[i]
    innovation(fitted, ranges, anchors, tags, weights, tags, y)
    _cholesky3(P[9:, 9:], small)
    _invert_factored3(small, V)
    _add_symmetric(V, tags.shape[0], G)
    _cholesky3(V, small)
    _invert_factored3(small, V)
    for i in range(3):
        fitted[9 + i] += V[i, 0] * y[3, 0] + V[i, 1] * y[3, 1] + V[i, 2] * y[3, 2]


@helper
def _add_symmetric(A: Any, s: float, G: Any) -> None:
    """Compute ``A += s G`` of 3 x 3 matrices, G by its upper triangle."""
    A[0, 0] += s * G[0]
    A[0, 1] += s * G[1]
    A[0, 2] += s * G[2]
    A[1, 0] += s * G[1]
    A[1, 1] += s * G[3]
    A[1, 2] += s * G[4]
    A[2, 0] += s * G[2]
    A[2, 1] += s * G[4]
    A[2, 2] += s * G[5]


@gufunc("(p),(p,p),(d),(s)->(d,d),(d),(s,s),(d,d)")
def projected_belief(
    mean: Any, P: Any, like: Any, size: Any, rotation: Any, translation: Any, covariance: Any,
    matrix: Any,
) -> None:  # fmt: skip
    """Compute the pose with the nearest rotation, its covariance ``J^+ P J^+T``, and the matrix.

    `like` (3,) and `size` (6,) only define the shapes of the results.
    """
    _split(mean, translation, matrix)
    nearest_rotation(matrix, rotation)
    work = workspace((6, 12))
    for j in range(12):
        for i in range(3):
            work[i, j] = 0.0
            work[3 + i, j] = P[9 + i, j]
        for k in range(3):
            x, y, z = rotation[0, k], rotation[1, k], rotation[2, k]
            a, b, c = P[3 * k, j], P[3 * k + 1, j], P[3 * k + 2, j]
            work[0, j] += 0.5 * (y * c - z * b)
            work[1, j] += 0.5 * (z * a - x * c)
            work[2, j] += 0.5 * (x * b - y * a)
    for i in range(6):
        for j in range(3):
            covariance[i, j] = 0.0
            covariance[i, 3 + j] = work[i, 9 + j]
        for k in range(3):
            x, y, z = rotation[0, k], rotation[1, k], rotation[2, k]
            a, b, c = work[i, 3 * k], work[i, 3 * k + 1], work[i, 3 * k + 2]
            covariance[i, 0] += 0.5 * (y * c - z * b)
            covariance[i, 1] += 0.5 * (z * a - x * c)
            covariance[i, 2] += 0.5 * (x * b - y * a)
    _make_symmetric(covariance)


@gufunc("(p),(p,p),(d),(s)->(d,d),(d),(s,s),(d,d)")
def constrained_belief(
    mean: Any, P: Any, like: Any, size: Any, rotation: Any, translation: Any, covariance: Any,
    matrix: Any,
) -> None:  # fmt: skip
    """Compute the pose in the state, its covariance ``(J^T P^-1 J)^-1`` on SO(3), and the matrix.

    Arguments as in `projected_belief`.
    """
    _split(mean, translation, matrix)
    nearest_rotation(matrix, rotation)
    L, Z = workspace((12, 12)), zeros((12, 6))
    for k in range(3):
        x, y, z = rotation[0, k], rotation[1, k], rotation[2, k]
        Z[3 * k, 1], Z[3 * k, 2] = z, -y
        Z[3 * k + 1, 0], Z[3 * k + 1, 2] = -z, x
        Z[3 * k + 2, 0], Z[3 * k + 2, 1] = y, -x
        Z[9 + k, 3 + k] = 1.0
    _cholesky12(P, L)
    information = zeros((6, 6))
    for i in range(12):
        for j in range(6):
            total = Z[i, j]
            for k in range(i):
                total -= L[i, k] * Z[k, j]
            Z[i, j] = total * L[i, i]
        for a in range(6):
            for b in range(a + 1):
                information[a, b] += Z[i, a] * Z[i, b]
    cholesky6(information, L)
    invert_factored6(L, covariance)


@helper
def _make_symmetric(A: Any) -> None:
    for i in range(A.shape[0]):
        for j in range(i):
            A[i, j] = A[j, i] = 0.5 * (A[i, j] + A[j, i])
