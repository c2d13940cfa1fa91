"""Cramer-Rao bounds of the pose: Fisher information on SO(3) x R^3, posterior bound, the score.

The pose error is ``(w, v)``: ``Q_hat = exp(w) Q`` (world frame, rad), ``t_hat = t + v`` (m);
information and covariance are 6 x 6 in that order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    BoolArray,
    FloatArray,
    check_array,
    check_links,
    check_number,
    check_one_of,
    checked,
    kernel,
)
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import offsets, ranging

__all__ = [
    "directions", "information_rank", "lift", "pose_crb",
    "range_information", "range_jacobian", "score", "symmetric", "tag_jacobian",
]  # fmt: skip

# Behind the doors: what comes to these was checked, or made here.
_HAT, _EXP = kernel(rotations.hat), kernel(rotations.exp)
_TAG_POSITIONS, _DISTANCES = kernel(ranging.tag_positions), kernel(ranging.distances)

_NOTHING, _ONE = np.zeros((6, 6)), np.ones((1, 1))
# J_n as a linear function of (c_n, 1), c_n turned: J_n[i, a] = sum_k (c_n, 1)[k] _BY_POSE[k, i, a].
_BY_POSE = np.zeros((4, 3, 6))
_BY_POSE[:3, :, :3] = -rotations.hat(np.eye(3))
_BY_POSE[3, :, 3:] = np.eye(3)
_BY_MOMENTS = np.einsum("kia,lib->klab", _BY_POSE, _BY_POSE).reshape(16, 36)


def tag_jacobian(rotation: FloatArray, tags: FloatArray) -> FloatArray:
    """Derivative (..., N, 3, 6) of the tag positions by the pose error: ``[-[Q c_n]x, I]``."""
    turned = tags @ np.swapaxes(rotation, -1, -2)
    J = np.zeros((*turned.shape, 6))
    J[..., :3] = -_HAT(turned)
    J[..., 3:] = np.eye(3)
    return J


def directions(anchors: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (..., M, N) and unit vectors (..., M, N, 3) from anchors to positions.

    The unit vector is zero where an anchor and a position coincide.
    """
    difference = positions[..., None, :, :] - anchors[..., :, None, :]
    distance = np.sqrt(np.einsum("...i,...i->...", difference, difference))
    return distance, difference / np.where(distance > 0, distance, 1.0)[..., None]


def lift(J: FloatArray, per_tag: FloatArray) -> FloatArray:
    """Pose information ``sum_n J_n^T U_n J_n`` from that of each tag's position (..., N, 3, 3)."""
    stacked = (*J.shape[:-3], 3 * J.shape[-3], 6)
    weighted = per_tag @ J
    rows = weighted.reshape((*weighted.shape[:-3], *stacked[-2:]))
    return np.swapaxes(J.reshape(stacked), -1, -2) @ rows


def range_jacobian(
    anchors: FloatArray, tags: FloatArray, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances (..., M, N) and their derivative by the pose error, transposed: (..., 6, M N).

    The derivative of a distance by (w, v) is ``(Q c x u, u)``, u the unit vector from anchor to
    tag (zero where both coincide). Components come first, so that every step runs along memory.

    Arguments as `range_information`.
    """
    turned = tags @ np.swapaxes(rotation, -1, -2)
    positions = turned + translation[..., None, :]
    c = [turned[..., None, :, i] for i in range(3)]
    d = [positions[..., None, :, i] - anchors[..., :, None, i] for i in range(3)]
    distance = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    inverse = 1 / np.where(distance > 0, distance, 1.0)
    J = np.empty((*distance.shape[:-2], 6, *distance.shape[-2:]))
    for i in range(3):
        np.multiply(d[i], inverse, out=J[..., 3 + i, :, :])
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        J[..., i, :, :] = c[j] * J[..., 3 + k, :, :] - c[k] * J[..., 3 + j, :, :]
    return distance, J.reshape((*distance.shape[:-2], 6, -1))


def range_information(
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: ranging.NoiseLaw,
    links: ArrayLike | None = None,
    *,
    model: str = "raw",
    tag_std_m: float = 0.0,
    offset: str | None = None,
) -> FloatArray:
    """Fisher information (..., 6, 6) of one epoch of ranges about the pose.

    The variance is taken at the true range; what its own dependence on the range would tell
    is left out, as in the papers.

    Parameters
    ----------
    anchors, tags, rotation, translation
        (..., M, 3), (..., N, 3), (..., 3, 3), (..., 3); metres.
    noise
        Law of the ranges.
    links
        Mask (..., M, N), True = measured.
    model
        ``"raw"``: of the ranges. ``"squared"``: of what is left of the squared ranges once
        ``|s|^2`` is projected out, that is of all the papers' linear estimators and filters;
        with the prior of the 12 states brought to the pose, the unitarily constrained bound
        of the tracking paper's model.
    tag_std_m
        Standard deviation of the tags' places on the body, per axis: a nuisance, marginalised.
    offset
        Whose ranges have an unknown offset in common (`measurements.offsets`): ``"tag"``,
        ``"anchor"``, or ``"epoch"``; None: no ranges. Of raw ranges, with tags at known places.

    Raises
    ------
    ValueError
        On a wrong shape or a value that is not finite.
    """
    check_one_of("model", model, ("raw", "squared"))
    if offsets.check_offset(offset) is not None and (model != "raw" or tag_std_m != 0):
        raise ValueError(
            f"offset goes with model 'raw' and tag_std_m 0, got {model!r} and {tag_std_m!r}"
        )
    tag_std_m = check_number("tag_std_m", tag_std_m, low=0.0)
    anchors = check_array("anchors", anchors, ("M", 3))
    tags = check_array("tags", tags, ("N", 3))
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    if not callable(getattr(noise, "variance", None)):
        raise ValueError(f"noise must be a noise law of rbl_gym.ranging, got {noise!r:.80}")
    mask = check_links(links, (anchors.shape[-2], tags.shape[-2]))
    if model == "raw" and tag_std_m == 0:
        return information_at(anchors, tags, rotation, translation, noise, mask, offset)
    positions = _TAG_POSITIONS(rotation, translation, tags)
    of_tag = _raw_tag_information if model == "raw" else _squared_tag_information
    per_tag = of_tag(anchors, positions, noise, mask)
    damping = np.eye(3) + tag_std_m**2 * per_tag
    return lift(tag_jacobian(rotation, tags), np.linalg.solve(damping, per_tag))


def information_at(
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    noise: ranging.NoiseLaw,
    share: Any = None,
    offset: str | None = None,
) -> FloatArray:
    """`range_information` on arrays that are known to be good.

    `share` (..., M, N): of its information that each link has, None: all of it.
    """
    share = _ONE if share is None else share
    numbers = ranging.numbers_of(noise, tags.shape[-2])
    if numbers is None:
        return _range_information(anchors, tags, rotation, translation, noise, share, offset)
    links = anchors.shape[-2], tags.shape[-2]
    if share.shape[-2:] != links:
        share = np.broadcast_to(share, (*share.shape[:-2], *links))
    told = _NOTHING, anchors, tags, rotation, translation, numbers, share
    if offset is None:
        told = _information(*told)
    else:
        told = _offset_information(*told, offsets.code_of(offset))
    if not np.isfinite(told).all():
        check_variance(noise, _DISTANCES(anchors, _TAG_POSITIONS(rotation, translation, tags)))
    return told


@compiled("pose_bound:range_information")
def _information(
    prior: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    law: FloatArray,
    share: FloatArray,
) -> FloatArray:
    """A prior's information (..., 6, 6) and that of ranges, whose law is told by its numbers."""
    noise = ranging.law_of(law)
    return prior + _range_information(anchors, tags, rotation, translation, noise, share)


@compiled("offsets:information")
def _offset_information(
    prior: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    law: FloatArray,
    share: FloatArray,
    offset: int,
) -> FloatArray:
    """`_information` of ranges with unknown offsets, by the code of their kind."""
    noise, kind = ranging.law_of(law), offsets.name_of(offset)
    return prior + _range_information(anchors, tags, rotation, translation, noise, share, kind)


def _range_information(
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    noise: ranging.NoiseLaw,
    share: FloatArray,
    offset: str | None = None,
) -> FloatArray:
    distance, J = range_jacobian(anchors, tags, rotation, translation)
    weight = _inverse(noise.variance(distance), distance) * share
    if offset is not None:
        links = J.reshape((*J.shape[:-1], *distance.shape[-2:]))
        J = offsets.centred(links, weight[..., None, :, :], offset)
        J = J.reshape((*J.shape[:-2], -1))
    flat = weight.reshape((*weight.shape[:-2], 1, -1))
    return (J * flat) @ np.swapaxes(J, -1, -2)


def check_variance(noise: ranging.NoiseLaw, distance: FloatArray) -> None:
    """A ValueError where a law has no variance at a distance (..., M, N) that is not zero."""
    _inverse(noise.variance(distance), distance)


def _inverse(variance: FloatArray, distance: FloatArray) -> FloatArray:
    """Weights (..., M, N) of ranges, squared or not: what an anchor on a tag measures has none.

    There the range has no gradient: that link tells nothing.
    """
    with np.errstate(divide="ignore"):
        weight = np.where(distance > 0, 1 / variance, 0.0)
    if not np.isfinite(weight).all():
        where = np.broadcast_to(distance, weight.shape)[~np.isfinite(weight)][0]
        raise ValueError(f"noise must have a variance at every distance, got 0 at {where:g} m")
    return weight


def _raw_tag_information(
    anchors: FloatArray, positions: FloatArray, noise: ranging.NoiseLaw, links: BoolArray | None
) -> FloatArray:
    """Information (..., N, 3, 3) of the ranges about the place of each tag."""
    distance, unit = directions(anchors, positions)
    weight = _inverse(noise.variance(distance), distance)
    weight = weight if links is None else weight * links
    return np.einsum("...mni,...mnj->...nij", weight[..., None] * unit, unit)


def _squared_tag_information(
    anchors: FloatArray, positions: FloatArray, noise: ranging.NoiseLaw, links: BoolArray | None
) -> FloatArray:
    """Information ``4 A Pi_n A^T`` (..., N, 3, 3) about each tag, |s|^2 projected out."""
    distance = _DISTANCES(anchors, positions)
    weight = _inverse(noise.squared_range_variance(distance), distance)
    weight = weight if links is None else weight * links
    spread, weighted = weighted_spread(anchors, weight)
    return 4 * np.swapaxes(weighted, -1, -2) @ spread


def weighted_spread(anchors: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Anchors less their weighted mean (..., N, M, 3), and the same times the weights (..., M, N).

    Their product ``A Pi A^T`` is the projection of the common unknown ``|s|^2`` out of the
    squared ranges, without forming Pi.
    """
    per_tag = np.swapaxes(weights, -1, -2)
    total = per_tag.sum(axis=-1, keepdims=True)
    mean = (per_tag / np.where(total > 0, total, 1.0)) @ anchors
    spread = anchors[..., None, :, :] - mean[..., :, None, :]
    return spread, per_tag[..., None] * spread


def pose_crb(
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: ranging.NoiseLaw,
    prior_information: ArrayLike | None = None,
    links: ArrayLike | None = None,
    *,
    model: str = "raw",
    tag_std_m: float = 0.0,
    offset: str | None = None,
) -> FloatArray:
    """Cramer-Rao bound (..., 6, 6) of the pose from one epoch of ranges.

    The inverse of `range_information` plus the prior information (..., 6, 6), if any. Never a
    pseudo-inverse: it would reward anchors that see nothing.

    Arguments as `range_information`, and `prior_information` (..., 6, 6).

    Raises
    ------
    ValueError
        As `range_information`, and where the information is singular, with its rank.
    """
    information = range_information(
        anchors, tags, rotation, translation, noise, links,
        model=model, tag_std_m=tag_std_m, offset=offset,
    )  # fmt: skip
    if prior_information is not None:
        information = information + check_array("prior_information", prior_information, (6, 6))
    return inverted(information, "anchors or tags")


def inverted(information: FloatArray, more: str) -> FloatArray:
    """Inverse of a pose's information, or a ValueError that names its rank and what it lacks."""
    rank = information_rank(information)
    if (rank < 6).any():
        where = tuple(int(i) for i in np.argwhere(rank < 6)[0])
        raise ValueError(
            f"the geometry does not determine the pose: information of rank {int(rank.min())} "
            f"of 6 at batch index {where}; add {more}, or prior_information"
        )
    return np.linalg.inv(information)


def information_rank(information: FloatArray, tolerance: float = 1e-11) -> np.ndarray:
    """Number (...) of directions an information matrix (..., n, n) determines, free of units."""
    n = information.shape[-1]
    # With a unit diagonal no eigenvalue exceeds n: a determinant bounds the smallest one, and
    # spares most matrices the eigenvalues.
    _, regular = regular_inverse(information, 2 * tolerance * n ** (n - 1))
    rank, open_ = np.full(information.shape[:-2], n), ~np.asarray(regular)
    if open_.any():
        scale = np.sqrt(np.maximum(np.diagonal(information[open_], axis1=-2, axis2=-1), 0.0))
        scale = np.where(scale > 0, scale, 1.0)
        scaled = information[open_] / (scale[..., :, None] * scale[..., None, :])
        rank[open_] = (np.linalg.eigvalsh(scaled) > tolerance).sum(axis=-1)
    return rank


@compiled("pose_bound:regular_inverse")
def regular_inverse(matrix: FloatArray, least: float) -> tuple[FloatArray, BoolArray]:
    """Inverse of symmetric matrices (..., n, n), and whether (...) each is regular for certain.

    That is, positive definite and, scaled to a unit diagonal, of a determinant above `least`. Of
    others the inverse is NaN; one that holds NaN counts as regular, and is NaN too.
    """
    n, diagonal = matrix.shape[-1], np.diagonal(matrix, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(diagonal <= 0, 1.0, diagonal))
    outer = scale[..., :, None] * scale[..., None, :]
    unit = matrix / outer
    known = np.isfinite(unit).all(axis=(-2, -1), keepdims=True)
    safe = np.where(known, unit, np.eye(n))
    good = (np.linalg.eigvalsh(safe)[..., :1, None] > 0) & (
        np.linalg.det(safe)[..., None, None] > least
    )
    inverse = symmetric(np.linalg.inv(np.where(good, safe, np.eye(n))) / outer)
    return np.where(good & known, inverse, np.nan), (good | ~known)[..., 0, 0]


def symmetric(matrix: FloatArray) -> FloatArray:
    """The symmetric part, to keep rounding from growing in recursions."""
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))


@checked(covariance=(6, 6), rotation=(3, 3), tags=("N", 3))
def score(covariance: FloatArray, rotation: ArrayLike, tags: ArrayLike) -> FloatArray:
    """Root mean square tag error b (...) in metres that a pose covariance (..., 6, 6) implies.

    ``b^2 = mean_n tr(J_n P J_n^T)``, ``J_n = [-[Q c_n]x, I]``: one number for position and
    orientation together.
    """
    turned = np.asarray(tags, dtype=np.float64) @ np.swapaxes(np.asarray(rotation), -1, -2)
    extended = np.ones((*turned.shape[:-1], 4))
    extended[..., :3] = turned
    # The sum of J_n^T J_n is linear in the tags' second moments.
    moments = np.swapaxes(extended, -1, -2) @ extended
    square = moments.reshape((*moments.shape[:-2], 16)) @ _BY_MOMENTS
    square = square.reshape((*square.shape[:-1], 6, 6)) / turned.shape[-2]
    trace = np.einsum("...ab,...ab->...", square, covariance)
    return root_of_trace(trace)


def root_of_trace(trace: ArrayLike) -> FloatArray:
    """The score (...) from its square, which is a trace; NaN and negative ones are refused."""
    # True of NaN too.
    if not np.min(trace) >= 0:
        raise ValueError(f"covariance must be positive and finite, got a trace of {np.min(trace)}")
    return np.asarray(np.sqrt(trace))
