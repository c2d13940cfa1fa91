"""Better layouts by the dilution of precision, without the score.

The dilution of precision is the bound of the position error of a single point, without attitude.
It has a simple derivative. Adding an anchor changes its information by a matrix of rank one.
Therefore all exchanges of one anchor for a candidate are known at once, in closed form. Problems
may have leading axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.placement.tokens import Scenery

__all__ = ["Links", "Parts", "exchanged", "links_of", "prior_of", "square_and_slope"]

# Upper halves of matrices of size 3: of the unit matrix, and how often each number appears.
_UNIT = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])
_DOUBLED = 2 - _UNIT
# Where the numbers of a matrix are in its upper half.
_WHOLE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
# Anchors are at least this far from the body, as a fraction of the extent of the zones.
_NEAR = 1e-6
# Anchors that may be exchanged: those without which the layout is best.
_WEAKEST = 3
# An exchange makes the mean square at least this much smaller.
_LEAST = 0.99


class Links(NamedTuple):
    """Anchors and the information of their links.

    Attributes
    ----------
    points
        (..., M, 3).
    told
        Upper halves of the information (..., P, M, 6) about the position.
    """

    points: FloatArray
    told: FloatArray


class Parts(NamedTuple):
    """Links of the anchors of a layout, of fixed anchors, and of the candidates."""

    anchors: Links
    fixed: Links
    candidates: Links


def links_of(scenery: Scenery, points: FloatArray, share: FloatArray) -> Links:
    """Return the links of anchors (..., M, 3) with information fractions (..., P, M)."""
    x, y, z = (scenery.places[..., :, None, k] - points[..., None, :, k] for k in range(3))
    square = x * x + y * y + z * z
    weight, _ = _weight(scenery, square, share)
    wx, wy = weight * x, weight * y
    return Links(points, np.stack([wx * x, wx * y, wx * z, wy * y, wy * z, weight * z * z], -1))


def _weight(
    scenery: Scenery, square: FloatArray, share: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return w of the information w d d' of an offset, and its derivative by the square of d."""
    square = np.maximum(square, (_NEAR * scenery.extent[..., None, None]) ** 2)
    floor, growth = (scenery.noise[..., k, None, None] ** 2 for k in (0, 1))
    variance = floor + growth * square
    weight = scenery.tags.shape[-2] * share / (variance * square)
    return weight, -weight * (1 / square + growth / variance)


def square_and_slope(
    scenery: Scenery, weight: FloatArray, anchors: Links, fixed: Links, share: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the mean square error (...), and its derivative (..., M, 3) by the anchors.

    Parameters
    ----------
    scenery, weight
        The problem, and weights (P,) of its places.
    anchors, fixed
        Links of the layout, and of fixed anchors.
    share
        Information fractions (..., P, M) of the links of the layout, held constant.
    """
    total = anchors.told.sum(axis=-2) + fixed.told.sum(axis=-2)
    P = _inverse(total + prior_of(scenery)[..., None, None] * _UNIT)
    away = scenery.places[..., :, None, :] - anchors.points[..., None, :, :]
    w, slope = _weight(scenery, (away**2).sum(axis=-1), share)
    # The trace of P falls by tr(PP dF), with F the sum of w d d'.
    PPd = away @ _square(P)[..., _WHOLE]
    along = (away * PPd).sum(axis=-1)
    by_place = 2 * (w[..., None] * PPd + (slope * along)[..., None] * away)
    square = (weight * _trace(P)).sum(axis=-1)
    return square, (weight[:, None, None] * by_place).sum(axis=-3)


def prior_of(scenery: Scenery) -> FloatArray:
    """Return the information (...) of each coordinate without anchors."""
    return (2 / scenery.extent) ** 2


def exchanged(
    weight: FloatArray, prior: FloatArray, parts: Parts, allowed: BoolArray, most: int
) -> FloatArray:
    """Return anchors (..., M, 3) after exchanges, the best one each time.

    Parameters
    ----------
    weight
        Weights (P,) of the places.
    prior
        Information (...) of each coordinate without anchors.
    parts
        Anchors and candidates.
    allowed
        Which candidates (..., C) may be chosen.
    most
        Largest number of exchanges.
    """
    (points, told), fixed, candidates = parts
    rest = fixed.told.sum(axis=-2) + prior[..., None, None] * _UNIT
    by_candidate = np.swapaxes(_DOUBLED * candidates.told, -1, -2).astype(np.float32)
    weight, (count, number) = weight[:, None], (points.shape[-2], candidates.points.shape[-2])
    for _ in range(most):
        total = told.sum(axis=-2, keepdims=True) + rest[..., None, :]
        now = (weight * _trace(_inverse(total))).sum(axis=(-1, -2))
        P = _inverse(total - told)
        before = (weight * _trace(P)).sum(axis=-2)
        weak = before.argsort(axis=-1)[..., :_WEAKEST]
        P = np.take_along_axis(P, weak[..., None, :, None], axis=-2)
        # By the candidate's information w u u', trace(P) falls by w u'PPu / (1 + w u'Pu).
        fall = (weight[..., None] * _square(P)).astype(np.float32) @ by_candidate
        fall /= 1 + P.astype(np.float32) @ by_candidate
        after = np.take_along_axis(before, weak, axis=-1)[..., None] - fall.sum(axis=-3)
        taken = (points[..., None, :, :] == candidates.points[..., None, :]).all(axis=-1)
        after = np.where((allowed & ~taken.any(axis=-1))[..., None, :], after, np.inf)
        after = after.reshape(*after.shape[:-2], -1)
        best = after.argmin(axis=-1)[..., None]
        better = np.take_along_axis(after, best, axis=-1) < _LEAST * now[..., None]
        if not better.any():
            break
        anchor = np.take_along_axis(weak, best // number, axis=-1)
        moves = (better & (np.arange(count) == anchor))[..., None]
        index = (best % number)[..., None]
        points = np.where(moves, np.take_along_axis(candidates.points, index, axis=-2), points)
        new = np.take_along_axis(candidates.told, index[..., None, :, :], axis=-2)
        told = np.where(moves[..., None, :, :], new, told)
    return points


def _inverse(a: FloatArray) -> FloatArray:
    """Return the inverses of symmetric matrices of size 3, by their upper halves (..., 6)."""
    xx, xy, xz, yy, yz, zz = np.moveaxis(a, -1, 0)
    A, B, C = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    rows = [A, B, C, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy]
    return np.stack(rows, axis=-1) / (xx * A + xy * B + xz * C)[..., None]


def _square(a: FloatArray) -> FloatArray:
    """Return the squares of symmetric matrices, upper halves (..., 6)."""
    xx, xy, xz, yy, yz, zz = np.moveaxis(a, -1, 0)
    rows = [xx * xx + xy * xy + xz * xz, xx * xy + xy * yy + xz * yz, xx * xz + xy * yz + xz * zz]
    rows += [xy * xy + yy * yy + yz * yz, xy * xz + yy * yz + yz * zz, xz * xz + yz * yz + zz * zz]
    return np.stack(rows, axis=-1)


def _trace(a: FloatArray) -> FloatArray:
    return a[..., 0] + a[..., 3] + a[..., 5]
