"""Starts of an anchor survey: poses from approximate anchors, or anchors from ranges alone."""

from __future__ import annotations

import numpy as np
import scipy

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.calibration.survey import SurveyState
from rbl_gym.geometry import rotations

__all__ = ["anchors_from_pairs", "anchors_from_points", "start_from_anchors"]


def start_from_anchors(
    ranges: FloatArray,
    links: BoolArray,
    anchors: FloatArray,
    tags: FloatArray,
    bias_m: float = 0.0,
    planar: bool = False,
    height_m: float = 0.0,
) -> SurveyState:
    """Estimate poses from approximate anchors: tags from squared ranges, the body from its tags.

    An epoch without any tag has its tags' centre at 0, and no rotation.

    Parameters
    ----------
    ranges, links
        (K, M, N) metres, and a mask of the measured ranges.
    anchors, tags
        (M, 3) and (N, 3), metres.
    bias_m
        Bias to subtract from the ranges.
    planar, height_m
        Whether the body is level, and the height of its origin.
    """
    points = _multilaterated(ranges - bias_m, links, anchors, planar)
    K, N = points.shape[:2]
    if planar:
        points[..., 2] = height_m + tags[:, 2]
    told: BoolArray = np.asarray(np.isfinite(points).all(axis=-1), dtype=np.bool_)
    points = np.where(told[..., None], points, np.nan)
    centre = np.nanmean(np.where((told.sum(axis=1) > 0)[:, None, None], points, 0.0), axis=1)
    rotation = np.broadcast_to(np.eye(3), (K, 3, 3)).copy()
    if N > 1:
        arms = tags - tags.mean(axis=0)
        apart = np.where(told[..., None], points - centre[:, None], 0.0)
        spread = np.einsum("kni,nj->kij", apart, arms)
        if planar:
            angle = np.arctan2(spread[:, 1, 0] - spread[:, 0, 1], spread[:, 0, 0] + spread[:, 1, 1])
            rotation = rotations.exp(angle[:, None] * np.array([0.0, 0.0, 1.0]))
        else:
            rotation = rotations.nearest(spread)
    translation = centre - np.einsum("kij,j->ki", rotation, tags.mean(axis=0))
    if planar:
        translation[:, 2] = height_m
    return SurveyState(anchors.copy(), rotation, translation, bias_m, np.zeros(ranges.shape[1:]))


def _multilaterated(
    ranges: FloatArray, links: BoolArray, anchors: FloatArray, planar: bool
) -> FloatArray:
    """Return tags (K, N, 3) by linear least squares of squared ranges; NaN if too few."""
    D = 2 if planar else 3
    centre = anchors.mean(axis=0)
    A = (anchors - centre)[:, :D]
    # r^2 - |a|^2 = -2 a s + c, with c = |s|^2 plus terms of the heights.
    columns = np.concatenate([-2 * A, np.ones((len(A), 1))], axis=1)
    y = ranges**2 - (A**2).sum(axis=1)[:, None]
    w = links / np.maximum(ranges, 0.1) ** 2
    H = np.einsum("kmn,mi,mj->knij", w, columns, columns)
    g = np.einsum("kmn,mi,kmn->kni", w, columns, y)
    enough = links.sum(axis=1) > D
    H = np.where(enough[..., None, None], H, np.eye(D + 1))
    # With collinear or coplanar anchors, undetermined coordinates remain at the centre.
    H = H + 1e-9 * np.trace(H, axis1=-2, axis2=-1)[..., None, None] * np.eye(D + 1)
    s = np.linalg.solve(H, g[..., None])[..., :D, 0]
    points = np.full((*s.shape[:2], 3), centre)
    points[..., :D] += s
    points[~enough] = np.nan
    return points


def anchors_from_points(
    ranges: FloatArray, links: BoolArray, bias_m: float = 0.0, planar: bool = False
) -> FloatArray | None:
    """Estimate anchors (M, 3) from ranges (P, M) to unknown points.

    The matrix of squared distances, with rows and columns centred, has the dimension of space as
    rank. Its factors are anchors and points up to an affine map, which follows linearly from the
    anchors' squared norms.

    Parameters
    ----------
    ranges, links
        (P, M) metres, and a mask of the measured ranges. Points that miss an anchor are left out.
    bias_m
        Bias to subtract from the ranges.
    planar
        Whether anchors are at one height, and points at another.

    Returns
    -------
    anchors
        Relative to their centre, with arbitrary rotation and possibly mirrored; height 0 if
        `planar`. None without a solution: fewer than 6 anchors (10 in space), or ranges too noisy.

    Notes
    -----
    Crocco, Del Bue, Murino, "A bilinear approach to the position self-calibration of multiple
    sensors", IEEE TSP 60 (2012).
    """
    D = 2 if planar else 3
    full = links.all(axis=1)
    squared = (ranges[full] - bias_m) ** 2
    M, need = ranges.shape[1], D + D * (D + 1) // 2
    if need > M - 1 or len(squared) < 2 * need:
        return None
    centred = squared - squared.mean(axis=1, keepdims=True)
    middle = centred.mean(axis=0)
    right = np.linalg.svd(centred - middle, full_matrices=False)[2]
    factor = right[:D].T  # (M, D): anchors about their centre are factor @ C
    # Mean over points: |a_m|^2 - 2 a_m s0 + const, quadratic in the factor by B = C C^T.
    upper = np.triu_indices(D)
    products = factor[:, upper[0]] * factor[:, upper[1]] * np.where(upper[0] == upper[1], 1, 2)
    columns = np.concatenate([products, factor, np.ones((M, 1))], axis=1)
    solved = np.linalg.lstsq(columns, middle, rcond=None)[0]
    B = np.zeros((D, D))
    B[upper] = solved[: len(upper[0])]
    B = B + np.triu(B, 1).T
    eigen, vectors = np.linalg.eigh(B)
    if eigen[0] <= 1e-3 * eigen[-1]:
        return None
    anchors = np.zeros((M, 3))
    anchors[:, :D] = factor @ vectors * np.sqrt(eigen)
    return anchors - anchors.mean(axis=0)


def anchors_from_pairs(pairs: FloatArray, bias_m: float = 0.0, planar: bool = False) -> FloatArray:
    """Estimate anchors (M, 3) from the ranges between them by classical multidimensional scaling.

    The result may be a mirror image. Pairs (M, M) without a range (0) get the shortest path over
    other anchors.

    Raises
    ------
    ValueError
        If there are groups of anchors without ranges between them.
    """
    d = np.maximum(pairs, pairs.T)
    d = np.where(d > 0, np.maximum(d - bias_m, 1e-3), 0.0)
    d = scipy.sparse.csgraph.shortest_path(d, directed=False)
    if not np.isfinite(d).all():
        far = np.flatnonzero(~np.isfinite(d[0])).tolist()
        raise ValueError(
            "pairs must connect all anchors, but no chain of ranges joins anchor 0 to the anchors "
            f"{far}"
        )
    M = len(d)
    D = min(M, 2 if planar else 3)
    J = np.eye(M) - 1 / M
    values, vectors = np.linalg.eigh(-0.5 * J @ d**2 @ J)
    anchors = np.zeros((M, 3))
    anchors[:, :D] = vectors[:, -D:] * np.sqrt(np.maximum(values[-D:], 0.0))
    return anchors
