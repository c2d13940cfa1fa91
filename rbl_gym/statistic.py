"""Epochs of squared ranges as the 3 x 4 statistic that filters read, drawn without any range.

With the tracking paper's noise (`SquaredRangeNoise`) and weights from the true ranges, a linear
filter needs no more of an epoch than ``G = 4 A Pi A^T`` and ``B = -2 A Pi D C_e^T`` (A = 3 x M,
``C_e = [C; 1]`` = 4 x N). Since ``A Pi 1 = 0`` and ``Pi W^-1 Pi = Pi``, B is Gaussian, exactly:

    ``B = G [Q t] C_e C_e^T + L Z F^T``,   ``L L^T = G``,   ``F F^T = C_e C_e^T``,

Z of 3 x 4 standard normals: twelve of them in place of M x N, and no range is ever formed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import rotations
from rbl_gym.checks import FloatArray, check_array
from rbl_gym.ranging import NoiseLaw, SquaredRangeNoise

__all__ = ["EpochStatistic", "measure_statistic", "simulate_statistic"]

# A pivot this small beside its diagonal is rounding: the matrix has no rank there.
_NO_PIVOT = 1e-14
# Numbers of anchor coordinates that are worked on at a time: they stay in the cache.
_BLOCK = 1 << 15


class EpochStatistic(NamedTuple):
    """What an epoch of squared ranges tells: G (..., 3, 3) [1/m^2] and B (..., 3, 4) [1/m, 1/m^2].

    The columns of B belong to the tags' three coordinates and to the constant 1.
    """

    G: FloatArray
    B: FloatArray


def simulate_statistic(
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: NoiseLaw,
    rng: np.random.Generator,
) -> EpochStatistic:
    """The statistic of one epoch of ranges of every trial, twelve normals each.

    The same law as that of ranges drawn by `ranging.simulate` and compressed with the inverse
    variances at the true ranges (tracking paper, Section 3), as long as no squared range is
    drawn below zero, which the ranges cannot show. All links measure.

    Parameters
    ----------
    anchors, tags
        (..., M, 3) and (..., N, 3), metres; any of them may be coplanar, or too few.
    rotation, translation
        True poses (..., 3, 3) and (..., 3).
    noise
        A `SquaredRangeNoise`: for no other law is the statistic all there is to know.
    rng
        Source of the normals, (..., 3, 4) in one call.

    Raises
    ------
    ValueError
        On wrong shapes, NaN or inf, another noise law, an anchor that stands on the first tag.
    """
    anchors = check_array("anchors", anchors, ("M", 3))
    tags = check_array("tags", tags, ("N", 3))
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    batch = _batch(anchors, tags, rotation, translation)
    normals = rng.standard_normal((*batch, 3, 4))
    return measure_statistic(anchors, tags, rotation, translation, noise, normals)


def measure_statistic(
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    noise: NoiseLaw,
    normals: FloatArray,
) -> EpochStatistic:
    """`simulate_statistic` of given standard normals (..., 3, 4); shapes are taken as they come.

    Arguments as `simulate_statistic`.
    """
    if not isinstance(noise, SquaredRangeNoise):
        raise ValueError(f"noise must be a SquaredRangeNoise to have a statistic, got {noise!r}")
    batch = np.broadcast_shapes(_batch(anchors, tags, rotation, translation), normals.shape[:-2])
    n_trials = math.prod(batch)
    flat = [
        # Shared by all trials, an array stays one; the rest gets its leading axes in one.
        array
        if array.ndim == 2
        else np.broadcast_to(array, (*batch, *array.shape[-2:])).reshape(-1, *array.shape[-2:])
        for array in (anchors, tags)
    ]
    pose = np.broadcast_to(rotation, (*batch, 3, 3)).reshape(-1, 3, 3)
    place = np.broadcast_to(translation, (*batch, 3)).reshape(-1, 3)
    draws = np.broadcast_to(normals, (*batch, 3, 4)).reshape(-1, 3, 4)
    G, B = np.empty((3, 3, n_trials)), np.empty((3, 4, n_trials))
    factor = _tag_factor(tags[..., None]) if tags.ndim == 2 else None
    # A quarter of a megabyte of anchors, and no more trials than keep the rest in the cache.
    size = max(1, _BLOCK // max(anchors.shape[-2] * 3, 12))
    for begin in range(0, n_trials, size):
        rows = slice(begin, begin + size)
        A, C = (array if array.ndim == 2 else array[rows] for array in flat)
        C = np.moveaxis(C, 0, -1) if C.ndim == 3 else C[..., None]
        F = _tag_factor(C) if factor is None else factor
        G[..., rows], B[..., rows] = _block(
            A, C[0], F, pose[rows], place[rows], noise.sigma_m, draws[rows]
        )
    return EpochStatistic(*(np.moveaxis(x.reshape(*x.shape[:2], *batch), (0, 1), (-2, -1))
                            for x in (G, B)))  # fmt: skip


def _block(
    anchors: FloatArray,
    first: FloatArray,
    F: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    sigma_m: float,
    normals: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """G (3, 3, b) and B (3, 4, b) of b trials, which are the last axis of what is inside here.

    The first tag (3, b or 1) and the tags' factor F (4, 4, b or 1) come that way.
    """
    Q, t = (np.ascontiguousarray(np.moveaxis(x, 0, -1)) for x in (rotation, translation))
    Z = np.ascontiguousarray(normals.T)
    place = Q[:, 0] * first[0] + Q[:, 1] * first[1] + Q[:, 2] * first[2] + t
    A = anchors.T if anchors.ndim == 3 else anchors.T[..., None]
    G = _spread(np.subtract(A, place[:, None], order="C"), sigma_m)
    L = _factor(G)
    # Columns first: x_k is the k-th column of [Q t], whitened as B is, (4, 3, b).
    X = np.empty((4, *t.shape))
    X[:3], X[3] = Q.swapaxes(0, 1), t
    X = _mixed(F.swapaxes(0, 1), X)
    Y = Z + np.stack([sum(L[j, i] * X[:, j] for j in range(i, 3)) for i in range(3)], axis=1)
    B = np.stack([sum(L[i, j] * Y[:, j] for j in range(i + 1)) for i in range(3)], axis=1)
    return G, _mixed(F, B).swapaxes(0, 1)


def _spread(offsets: FloatArray, sigma_m: float) -> FloatArray:
    """``4 A Pi A^T`` (3, 3, b) of anchors relative to the first tag (3, M, b)."""
    squared = np.einsum("imb,imb->mb", offsets, offsets)
    if not squared.min() > 0:
        raise ValueError("anchors must not stand on the first tag: its range gives the weights")
    weights = 1 / (sigma_m**2 * squared)
    mean = np.einsum("mb,imb->ib", weights, offsets) / weights.sum(axis=0)
    spread = offsets - mean[:, None]
    weighted = weights * spread
    G = np.empty((3, 3, squared.shape[-1]))
    for i in range(3):
        for j in range(i + 1):
            G[i, j] = G[j, i] = 4 * np.einsum("mb,mb->b", weighted[i], spread[j])
    return G


def _tag_factor(tags: FloatArray) -> FloatArray:
    """F (4, 4, b) of ``C_e C_e^T`` for tags (N, 3, b)."""
    extended = np.concatenate([tags, np.ones_like(tags[:, :1])], axis=1)
    return _factor(np.einsum("nkb,nlb->klb", extended, extended))


def _mixed(matrix: FloatArray, columns: FloatArray) -> FloatArray:
    """``sum_l matrix_kl column_l`` (4, 3, b) of a matrix (4, 4, b or 1)."""
    if matrix.shape[-1] > 1:
        return np.einsum("klb,lib->kib", matrix, columns)
    return (matrix[..., 0] @ columns.reshape(4, -1)).reshape(columns.shape)


def _factor(matrix: FloatArray) -> FloatArray:
    """Lower triangular ``L L^T`` of semidefinite matrices (n, n, b), of any rank (Cholesky).

    A column without a pivot is zero: of a semidefinite matrix nothing is left in it.
    """
    rest, L = matrix.copy(), np.zeros_like(matrix)
    for k in range(len(matrix)):
        seen = rest[k, k] > _NO_PIVOT * matrix[k, k]
        root = np.sqrt(np.where(seen, rest[k, k], 1.0))
        L[k:, k] = np.where(seen, rest[k:, k] / root, 0.0)
        for j in range(k + 1, len(matrix)):
            rest[j:, j] -= L[j:, k] * L[j, k]
    return L


def _batch(
    anchors: FloatArray, tags: FloatArray, rotation: FloatArray, translation: FloatArray
) -> tuple[int, ...]:
    return np.broadcast_shapes(
        anchors.shape[:-2], tags.shape[:-2], rotation.shape[:-2], translation.shape[:-1]
    )
