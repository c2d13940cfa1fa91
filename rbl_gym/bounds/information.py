"""Compute the Fisher information of one epoch of ranges about the pose, on SO(3) x R^3.

The pose error is ``(w, v)``: ``Q_hat = exp(w) Q`` (world frame, rad), ``t_hat = t + v`` (m);
information is 6 x 6 in that order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.tag_information import (
    check_variance,
    inverse_variance,
    raw_tag_information,
    squared_tag_information,
)
from rbl_gym.checks import FloatArray, check_array, check_links, check_number, check_one_of, kernel
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import offsets, ranging
from rbl_gym.measurements.noise_laws import check_law

__all__ = ["lift", "range_information", "range_jacobian", "tag_jacobian"]

# Internal functions without checks: their arguments were checked, or made here.
_HAT = kernel(rotations.hat)
_TAG_POSITIONS, _DISTANCES = kernel(ranging.tag_positions), kernel(ranging.distances)

_NOTHING, _ONE = np.zeros((6, 6)), np.ones((1, 1))


def tag_jacobian(rotation: FloatArray, tags: FloatArray) -> FloatArray:
    """Return derivative (..., N, 3, 6) of tag positions by the pose error, ``[-[Q c_n]x, I]``."""
    turned = tags @ np.swapaxes(rotation, -1, -2)
    J = np.zeros((*turned.shape, 6))
    J[..., :3] = -_HAT(turned)
    J[..., 3:] = np.eye(3)
    return J


def lift(J: FloatArray, per_tag: FloatArray) -> FloatArray:
    """Return the pose information ``sum_n J_n^T U_n J_n`` from that of each tag (..., N, 3, 3)."""
    stacked = (*J.shape[:-3], 3 * J.shape[-3], 6)
    weighted = per_tag @ J
    rows = weighted.reshape((*weighted.shape[:-3], *stacked[-2:]))
    return np.swapaxes(J.reshape(stacked), -1, -2) @ rows


def range_jacobian(
    anchors: FloatArray, tags: FloatArray, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return distances (..., M, N) and the transposed derivative (..., 6, M N) by the pose error.

    The derivative of a distance by (w, v) is ``(Q c x u, u)``, with the unit vector u from
    anchor to tag (zero if both coincide). Components come first, so that all steps are contiguous.

    Arguments as in `range_information`.
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
    anchor_std_m: ArrayLike = 0.0,
) -> FloatArray:
    """Return the Fisher information (..., 6, 6) of one epoch of ranges about the pose.

    The variance is taken at the true range. The information from its dependence on the range is
    neglected, as in the papers.

    Parameters
    ----------
    anchors, tags, rotation, translation
        (..., M, 3), (..., N, 3), (..., 3, 3), (..., 3); metres.
    noise
        Noise law of the ranges.
    links
        Mask (..., M, N), True = measured.
    model
        ``"raw"``: information of the ranges. ``"squared"``: information of the squared ranges
        after ``|s|^2`` is projected out, as in all linear estimators and filters of the papers.
        With the prior of the 12 states transformed to the pose, this is the unitarily constrained
        bound of the model of the tracking paper.
    tag_std_m
        Standard deviation of the tag positions on the body, per axis: a nuisance, marginalised.
    offset
        Ranges of one ``"tag"``, ``"anchor"`` or ``"epoch"`` share an unknown offset
        (`measurements.offsets`); None: no offset. For raw ranges with known tag positions.
    anchor_std_m
        Standard deviation of the anchor positions: one, one per anchor (M,), or one per axis
        (M, 3). A nuisance with this prior, shared by all ranges of an anchor, marginalised. For
        raw ranges with known tag positions.

    Raises
    ------
    ValueError
        If a shape is wrong or a value is not finite.
    """
    check_one_of("model", model, ("raw", "squared"))
    offsets.check_offset(offset)
    tag_std_m = check_number("tag_std_m", tag_std_m, low=0.0)
    anchors = check_array("anchors", anchors, ("M", 3))
    anchor_std = anchor_deviations(anchor_std_m, anchors.shape[-2])
    for name, given in (("offset", offset), ("anchor_std_m", anchor_std)):
        if given is not None and (model != "raw" or tag_std_m != 0):
            raise ValueError(
                f"{name} needs model 'raw' and tag_std_m = 0, got {model!r} and {tag_std_m!r}"
            )
    tags = check_array("tags", tags, ("N", 3))
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    check_law("noise", noise, ("variance",))
    mask = check_links(links, (anchors.shape[-2], tags.shape[-2]))
    if model == "raw" and tag_std_m == 0:
        return information_at(anchors, tags, rotation, translation, noise, mask, offset, anchor_std)
    positions = _TAG_POSITIONS(rotation, translation, tags)
    of_tag = raw_tag_information if model == "raw" else squared_tag_information
    per_tag = of_tag(anchors, positions, noise, mask)
    damping = np.eye(3) + tag_std_m**2 * per_tag
    return lift(tag_jacobian(rotation, tags), np.linalg.solve(damping, per_tag))


def anchor_deviations(anchor_std_m: ArrayLike, anchors: int) -> FloatArray | None:
    """Return standard deviations (M, 3) from one number, (M,) or (M, 3); None if all are zero."""
    std = check_array("anchor_std_m", anchor_std_m, ())
    if (std < 0).any():
        raise ValueError(f"anchor_std_m must not be negative, got {std.min():g}")
    if std.shape not in ((), (anchors,), (anchors, 3)):
        raise ValueError(
            f"anchor_std_m must be one number, or have shape ({anchors},) or ({anchors}, 3), "
            f"got {std.shape}"
        )
    if not std.any():
        return None
    return np.broadcast_to(std[:, None] if std.ndim == 1 else std, (anchors, 3))


def information_at(
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    noise: ranging.NoiseLaw,
    share: Any = None,
    offset: str | None = None,
    anchor_std: FloatArray | None = None,
) -> FloatArray:
    """Compute `range_information` from checked arrays.

    `share` (..., M, N): share of its information that each link has; None: all of it. `anchor_std`
    (M, 3); None: the anchor positions are known.
    """
    share = _ONE if share is None else share
    if anchor_std is not None and offset is not None:
        rows, weight = weighted_rows(
            anchors, tags, rotation, translation, noise, share, offset, anchor_std
        )
        return marginal(information_of_rows(rows, weight), 6)
    numbers = ranging.numbers_of(noise, tags.shape[-2])
    if numbers is None:
        form = _range_information if anchor_std is None else _surveyed_information
        last = offset if anchor_std is None else anchor_std
        return form(anchors, tags, rotation, translation, noise, share, last)  # pyrefly: ignore[bad-argument-type]
    links = anchors.shape[-2], tags.shape[-2]
    if share.shape[-2:] != links:
        share = np.broadcast_to(share, (*share.shape[:-2], *links))
    told = _NOTHING, anchors, tags, rotation, translation, numbers, share
    if anchor_std is not None:
        told = _anchor_information(*told, anchor_std)
    elif offset is None:
        told = add_range_information(*told)
    else:
        told = _offset_information(*told, offsets.code_of(offset))
    if not np.isfinite(told).all():
        check_variance(noise, _DISTANCES(anchors, _TAG_POSITIONS(rotation, translation, tags)))
    return told


@compiled("pose_bound:range_information")
def add_range_information(
    prior: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    law: FloatArray,
    share: FloatArray,
) -> FloatArray:
    """Return prior information (..., 6, 6) plus that of all ranges, with a law by its numbers."""
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
    """Compute `add_range_information` of ranges with unknown offsets, by the code of their kind."""
    noise, kind = ranging.law_of(law), offsets.name_of(offset)
    return prior + _range_information(anchors, tags, rotation, translation, noise, share, kind)


@compiled("anchor_errors:information")
def _anchor_information(
    prior: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    law: FloatArray,
    share: FloatArray,
    anchor_std: FloatArray,
) -> FloatArray:
    """Compute `add_range_information` for anchor positions with standard deviations (M, 3)."""
    noise = ranging.law_of(law)
    return prior + _surveyed_information(
        anchors, tags, rotation, translation, noise, share, anchor_std
    )


def _surveyed_information(
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    noise: ranging.NoiseLaw,
    share: FloatArray,
    anchor_std: FloatArray,
) -> FloatArray:
    """Return ``sum_m (H_m - C_m (I + U_m)^-1 C_m^T)``: anchor positions are eliminated.

    H_m, U_m and C_m: information of its ranges about the pose, about its position in units of the
    prior standard deviations, and the cross term.
    """
    distance, J = range_jacobian(anchors, tags, rotation, translation)
    weight = inverse_variance(noise.variance(distance), distance) * share
    J = J.reshape((*J.shape[:-1], *distance.shape[-2:]))
    place = -J[..., 3:, :, :] * anchor_std.T[:, :, None]
    own = np.einsum("...imn,...mn,...jmn->...mij", place, weight, place)
    cross = np.einsum("...imn,...mn,...jmn->...mij", place, weight, J)
    taken = np.swapaxes(cross, -1, -2) @ np.linalg.solve(np.eye(3) + own, cross)
    return np.einsum("...imn,...mn,...jmn->...ij", J, weight, J) - taken.sum(axis=-3)


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
    weight = inverse_variance(noise.variance(distance), distance) * share
    if offset is not None:
        links = J.reshape((*J.shape[:-1], *distance.shape[-2:]))
        J = offsets.centred(links, weight[..., None, :, :], offset)
        J = J.reshape((*J.shape[:-2], -1))
    flat = weight.reshape((*weight.shape[:-2], 1, -1))
    return (J * flat) @ np.swapaxes(J, -1, -2)


# --- the pose together with nuisances -----------------------------------------------


def weighted_rows(
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    noise: ranging.NoiseLaw,
    share: Any,
    offset: str | None,
    anchor_std: FloatArray | None,
    further: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (..., 6 + q, M N) by pose and nuisances, and weights (..., M N).

    Nuisances are in units of their prior standard deviations: first the 3 M coordinates of anchors
    with `anchor_std` (M, 3), then those with the derivatives (G, M N) `further`. With an `offset`,
    the weighted mean of their group is subtracted from the derivatives.
    """
    distance, J = range_jacobian(anchors, tags, rotation, translation)
    weight = inverse_variance(noise.variance(distance), distance) * share
    grid, links = distance.shape[-2:], distance.shape[-2] * distance.shape[-1]
    rows = [J]
    if anchor_std is not None:
        unit = J[..., 3:, :].reshape((*J.shape[:-2], 1, 3, *grid))
        own = np.eye(grid[0])[:, None, :, None] * anchor_std.T[:, :, None]
        rows.append((-unit * own).reshape((*J.shape[:-2], -1, links)))
    if further is not None:
        rows.append(np.broadcast_to(further, (*J.shape[:-2], *further.shape)))
    stacked = np.concatenate(rows, axis=-2)
    if offset is not None:
        apart = stacked.reshape((*stacked.shape[:-1], *grid))
        apart = offsets.centred(apart, weight[..., None, :, :], offset)
        stacked = apart.reshape((*apart.shape[:-2], links))
    return stacked, weight.reshape((*weight.shape[:-2], links))


def information_of_rows(rows: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the information (..., 6 + q, 6 + q) of weighted rows, plus q unit priors."""
    information = (rows * weight[..., None, :]) @ np.swapaxes(rows, -1, -2)
    own = np.arange(6, information.shape[-1])
    information[..., own, own] += 1.0
    return information


def marginal(joint: FloatArray, states: int) -> FloatArray:
    """Return the information on the first states alone: ``J_aa - J_ab J_bb^-1 J_ba``."""
    cross = joint[..., :states, states:]
    told = np.linalg.solve(joint[..., states:, states:], np.swapaxes(cross, -1, -2))
    found = joint[..., :states, :states] - cross @ told
    return 0.5 * (found + np.swapaxes(found, -1, -2))
