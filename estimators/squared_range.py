"""The papers' linear model of squared ranges, and the small statistic that is all of it.

With ``d_mn = r_mn^2 - |a_m|^2`` the tag places obey ``d_mn = |s_n|^2 - 2 a_m^T s_n + noise``.
Projecting ``|s_n|^2`` out with ``Pi = W - W 1 1^T W / (1^T W 1)`` (W the inverse variances of
the squared ranges) leaves a linear model in ``x = [vec Q; t]``, ``s_n = Q c_n + t``, whose
information is ``sum_n (c_e c_e^T) kron G_n`` with ``c_e = [c_n; 1]`` and

    ``G_n = 4 A Pi_n A^T``,    ``b_n = -2 A Pi_n d_n``    (A = 3 x M, as in the papers).

No matrix larger than 12 x 12 is ever made, whatever the number of anchors and tags.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym.bounds import weighted_spread
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.inputs import (
    check_ranges,
    matrix_rank,
    spanned_dimensions,
)

# Ranges that are squared at a time: a quarter of a megabyte stays in the cache.
_CHUNK = 1 << 15
# Anchors x trials that `moments` takes at a time, eight numbers each.
_COLUMNS = 1 << 13


class Statistic(NamedTuple):
    """Sufficient statistic of one epoch of squared ranges.

    Attributes
    ----------
    G
        (..., 1, 3, 3) where all tags share their weights, else (..., N, 3, 3).
    b
        (..., N, 3).
    tags
        (..., N, 3), as given.
    """

    G: FloatArray
    b: FloatArray
    tags: FloatArray

    @property
    def is_common(self) -> bool:
        """Whether all tags share their weights: the papers' case."""
        return self.G.shape[-3] == 1


def statistic(
    ranges: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    weights: FloatArray,
    links: BoolArray | None = None,
) -> Statistic:
    """G and b of one epoch.

    Parameters
    ----------
    ranges
        (..., M, N), metres.
    anchors, tags
        (..., M, 3) and (..., N, 3), metres.
    weights
        Inverse variances of the squared ranges [1/m^4], (..., M, 1) where common to the tags.
    links
        Mask (..., M, N); a missing link has weight zero.
    """
    if links is not None and not links.all():
        weights = np.where(links, weights, 0.0)
        ranges = np.where(links, ranges, 0.0)
    total = weights.sum(axis=-2, keepdims=True)
    share = weights / np.where(total > 0, total, 1.0)
    spread, weighted = weighted_spread(anchors, weights)
    G = 4 * np.swapaxes(weighted, -1, -2) @ spread
    d = ranges**2 - np.einsum("...mi,...mi->...m", anchors, anchors)[..., None]
    d = d - (share * d).sum(axis=-2, keepdims=True)
    if weights.shape[-1] == 1:
        b = -2 * np.swapaxes(d, -1, -2) @ weighted[..., 0, :, :]
    else:
        b = -2 * (np.swapaxes(d, -1, -2)[..., None, :] @ weighted)[..., 0, :]
    return Statistic(G, b, tags)


def moments(
    ranges: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    weights: FloatArray,
    unchecked: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """G and ``B = sum_n b_n c_n^T`` of common weights, without the b of each tag; trials last.

    Parameters
    ----------
    ranges, anchors, weights
        (B, M, N), (B or 1, M, 3) and (B or 1, M, 1).
    tags
        Extended tags (N, 4), in any frame.
    unchecked
        As of `squares_times`.

    Returns
    -------
    G (3, 3, B) and B (3, 4, B).
    """
    n_trials, n_anchors, n_tags = ranges.shape
    size = max(1, min(n_trials, _COLUMNS // n_anchors))
    G, B = np.empty((3, 3, n_trials)), np.empty((3, 4, n_trials))
    columns = np.empty((8, n_anchors, size))
    of_tags = tags.sum(axis=0)
    for begin in range(0, n_trials, size):
        part = slice(begin, begin + size)
        here = ranges[part]
        w = np.ascontiguousarray((weights[part] if len(weights) > 1 else weights)[..., 0].T)
        sums, spread, squared = np.split(columns[..., : len(here)], (4, 7))
        product = squares_times(here.reshape(-1, n_tags), [tags], unchecked)
        sums[:] = product.reshape(-1, n_anchors, 4).T
        spread[:] = (anchors[part] if len(anchors) > 1 else anchors).T
        total = w.sum(axis=0)
        mean = np.einsum("imb,mb->ib", spread, w / np.where(total > 0, total, 1.0))
        spread -= mean[:, None]
        np.einsum("imb,imb->mb", spread, spread, out=squared[0])
        # With the anchors about their mean a, |a_m|^2 - |a|^2 is |spread|^2 + 2 a^T spread.
        moment = np.einsum("imb,jmb->ijb", w * spread, columns[..., : len(here)])
        gram = moment[:, 4:7]
        about = moment[:, 7] + 2 * np.einsum("ijb,jb->ib", gram, mean)
        np.multiply(4, gram, out=G[..., part])
        np.multiply(-2, moment[:, :4] - of_tags[:, None] * about[:, None], out=B[..., part])
    return G, B


def squares_times(
    ranges: FloatArray, matrices: list[FloatArray], unchecked: FloatArray | None = None
) -> FloatArray:
    """``(r * r) @ matrix`` for ranges (K, n) and a matrix (n, p), a few rows at a time.

    Of two matrices (n / q, s) and (q s, p) the first is for each of q parts of a row, and the
    second for what comes of them. `unchecked` is the array that the ranges are rows of, if it
    has yet to pass `check_ranges`: each part is looked at while it is in the cache. A range
    that is not finite shows in the product, which is smaller.
    """
    *first, last = matrices
    product = np.empty((len(ranges), last.shape[1]))
    size = max(1, _CHUNK // ranges.shape[1])
    squares = np.empty((min(size, len(ranges)), ranges.shape[1]))
    with np.errstate(invalid="ignore"):
        for begin in range(0, len(ranges), size):
            part = ranges[begin : begin + size]
            if unchecked is not None and not part.min() > 0:
                check_ranges(unchecked)
            here = np.multiply(part, part, out=squares[: len(part)])
            for matrix in first:
                here = here.reshape(-1, len(matrix)) @ matrix
            np.matmul(here.reshape(len(part), -1), last, out=product[begin : begin + size])
        if unchecked is not None and not math.isfinite(np.vdot(product, product)):
            check_ranges(unchecked)
    return product


def extended(tags: FloatArray) -> FloatArray:
    """Tags with a fourth coordinate 1, ``c_e`` (..., N, 4)."""
    return np.concatenate([tags, np.ones((*tags.shape[:-1], 1))], axis=-1)


def paper_matrices(stat: Statistic) -> tuple[FloatArray, FloatArray]:
    """G (..., 3, 3) and ``B = sum_n b_n c_e^T`` (..., 3, 4) of the common-weight case."""
    return stat.G[..., 0, :, :], np.swapaxes(stat.b, -1, -2) @ extended(stat.tags)


def information(stat: Statistic) -> tuple[FloatArray, FloatArray]:
    """Information matrix (..., 12, 12) and vector (..., 12) about ``x = [vec Q; t]``."""
    ce = extended(stat.tags)
    if stat.is_common:
        gram = np.swapaxes(ce, -1, -2) @ ce
        matrix = np.einsum("...kl,...ij->...kilj", gram, stat.G[..., 0, :, :])
    else:
        gram = ce[..., :, None] * ce[..., None, :]
        matrix = np.einsum("...nkl,...nij->...kilj", gram, stat.G)
    vector = np.einsum("...nk,...ni->...ki", ce, stat.b)
    return matrix.reshape(*matrix.shape[:-4], 12, 12), vector.reshape(*vector.shape[:-2], 12)


def information_of_moments(
    G: FloatArray, B: FloatArray, tags: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`information`, trials first, from the `moments` of extended tags (N, 4)."""
    gram = tags.T @ tags
    # One product with a matrix of the tags, which is a fraction of the time of an einsum.
    kron = np.einsum("kl,ia,jb->abkilj", gram, np.eye(3), np.eye(3)).reshape(9, 144)
    matrix = (G.reshape(9, -1).T @ kron).reshape(-1, 12, 12)
    return matrix, B.T.reshape(-1, 12)


def compressed(stat: Statistic) -> tuple[FloatArray, FloatArray]:
    """Measurement z (..., 12) and matrix H (..., 12, 12) with unit noise and the same information.

    ``H^T H`` and ``H^T z`` are those of `information`: twelve rows in place of M x N, for any
    Kalman filter that wants a measurement. Directions without information are rows of zeros.
    """
    matrix, vector = information(stat)
    values, vectors = np.linalg.eigh(matrix)
    seen = values > 1e-14 * values[..., -1:]
    root = np.sqrt(np.where(seen, values, 0.0))
    transposed = np.swapaxes(vectors, -1, -2)
    projected = (transposed @ vector[..., None])[..., 0]
    z = np.where(seen, projected / np.where(seen, root, 1.0), 0.0)
    return z, root[..., None] * transposed


def geometric_rank(anchors: FloatArray, tags: FloatArray) -> np.ndarray:
    """How many of the 12 states full links would determine: anchors' rank (<= 3) x tags' (<= 4)."""
    size = np.linalg.norm(tags, axis=-1).max(axis=-1)[..., None, None]
    unit_tags = extended(tags / np.where(size > 0, size, 1.0))
    return spanned_dimensions(anchors) * matrix_rank(unit_tags)
