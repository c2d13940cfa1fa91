"""The linear model of squared ranges of the papers, and its sufficient statistic.

Sources: static paper (ICASSP 2013), (3)-(13); tracking paper (CAMSAP 2013), (1)-(9).

With ``d_mn = r_mn^2 - |a_m|^2`` the tag positions satisfy ``d_mn = |s_n|^2 - 2 a_m^T s_n + noise``.
Projecting ``|s_n|^2`` out with ``Pi = W - W 1 1^T W / (1^T W 1)`` (W the inverse variances of
the squared ranges) gives a linear model in ``x = [vec Q; t]``, ``s_n = Q c_n + t``, whose
information is ``sum_n (c_e c_e^T) kron G_n`` with ``c_e = [c_n; 1]`` and

    ``G_n = 4 A Pi_n A^T``,    ``b_n = -2 A Pi_n d_n``    (A = 3 x M, as in the papers).

No matrix larger than 12 x 12 is formed, for any number of anchors and tags.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.bounds.tag_information import weighted_spread
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.inputs import matrix_rank, spanned_dimensions


class Statistic(NamedTuple):
    """Sufficient statistic of one epoch of squared ranges.

    Attributes
    ----------
    G
        (..., 1, 3, 3) if all tags share their weights, else (..., N, 3, 3).
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
        """Return whether all tags share their weights, as in the papers."""
        return self.G.shape[-3] == 1


def statistic(
    ranges: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    weights: FloatArray,
    links: BoolArray | None = None,
    pseudo: bool = False,
) -> Statistic:
    """Return the statistic G, b of one epoch.

    Parameters
    ----------
    ranges
        (..., M, N), metres.
    anchors, tags
        (..., M, 3) and (..., N, 3), metres.
    weights
        Inverse variances of the squared ranges [1/m^4], (..., M, 1) if common to the tags.
    links
        Mask (..., M, N); a missing link has weight zero.
    pseudo
        Whether the ranges of a tag share an unknown offset c, ``r = d + c + noise``. Then
        ``d_mn = |s_n|^2 - c^2 - 2 a_m^T s_n + 2 c r_mn``: the part proportional to r is projected
        out too, and the weights are those of ``(r - c)^2``. This needs five anchors.
    """
    if links is not None and not links.all():
        weights = np.where(links, weights, 0.0)
        ranges = np.where(links, ranges, 0.0)
    total = weights.sum(axis=-2, keepdims=True)
    share = weights / np.where(total > 0, total, 1.0)
    spread, weighted = weighted_spread(anchors, weights)
    if pseudo:
        # Only the spread must be orthogonal to r: the part of d along r then cancels.
        r = np.swapaxes(ranges - (share * ranges).sum(axis=-2, keepdims=True), -1, -2)[..., None]
        square = (np.swapaxes(weights, -1, -2)[..., None] * r**2).sum(axis=-2, keepdims=True)
        along = np.swapaxes(weighted, -1, -2) @ r / np.where(square > 0, square, 1.0)
        spread = spread - r @ np.swapaxes(along, -1, -2)
        weighted = np.swapaxes(np.broadcast_to(weights, ranges.shape), -1, -2)[..., None] * spread
    G = 4 * np.swapaxes(weighted, -1, -2) @ spread
    d = ranges**2 - np.einsum("...mi,...mi->...m", anchors, anchors)[..., None]
    d = d - (share * d).sum(axis=-2, keepdims=True)
    if weights.shape[-1] == 1 and not pseudo:
        b = -2 * np.swapaxes(d, -1, -2) @ weighted[..., 0, :, :]
    else:
        b = -2 * (np.swapaxes(d, -1, -2)[..., None, :] @ weighted)[..., 0, :]
    return Statistic(G, b, tags)


def extended(tags: FloatArray) -> FloatArray:
    """Return tags with a fourth coordinate 1, ``c_e`` (..., N, 4)."""
    return np.concatenate([tags, np.ones((*tags.shape[:-1], 1))], axis=-1)


def information(stat: Statistic) -> tuple[FloatArray, FloatArray]:
    """Return the information matrix (..., 12, 12) and vector (..., 12) about ``x = [vec Q; t]``."""
    ce = extended(stat.tags)
    if stat.is_common:
        gram = np.swapaxes(ce, -1, -2) @ ce
        matrix = np.einsum("...kl,...ij->...kilj", gram, stat.G[..., 0, :, :])
    else:
        gram = ce[..., :, None] * ce[..., None, :]
        matrix = np.einsum("...nkl,...nij->...kilj", gram, stat.G)
    vector = np.einsum("...nk,...ni->...ki", ce, stat.b)
    return matrix.reshape(*matrix.shape[:-4], 12, 12), vector.reshape(*vector.shape[:-2], 12)


def compressed(stat: Statistic) -> tuple[FloatArray, FloatArray]:
    """Return z (..., 12) and H (..., 12, 12) with unit noise and the same information.

    ``H^T H`` and ``H^T z`` are those of `information`: twelve rows instead of M x N, for any
    Kalman filter with a measurement update. Directions without information are rows of zeros.
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
    """Return how many of 12 states all links determine: rank of anchors (<= 3) x tags (<= 4)."""
    size = np.linalg.norm(tags, axis=-1).max(axis=-1)[..., None, None]
    unit_tags = extended(tags / np.where(size > 0, size, 1.0))
    return spanned_dimensions(anchors) * matrix_rank(unit_tags)
