"""Measures of a layout other than its score."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import bounds, placement
from rbl_gym.checks import FloatArray, check_array
from rbl_gym.measurements import ranging
from rbl_gym.placement.problem import Context, PlacementTask

__all__ = ["Criteria", "criteria"]


class Criteria(NamedTuple):
    """Measures of a layout, each (...); small is good for all of them.

    Attributes
    ----------
    score_m
        `placement.score`.
    position_m, rotation_rad
        Root mean square over the poses of ``sqrt(tr P)`` of translation and rotation.
    d_optimal_m
        Geometric mean of the six standard deviations, the rotation in metres at the tags.
    e_optimal_m
        Root mean square over the poses of the largest of the six standard deviations.
    worst_m
        b of the worst pose.
    conditioning
        Geometric mean over the poses of the condition number of Abar, the weighted anchors minus
        their mean (static paper, Remark 1). It is large if the linear estimators lose a direction.
    """

    score_m: FloatArray
    position_m: FloatArray
    rotation_rad: FloatArray
    d_optimal_m: FloatArray
    e_optimal_m: FloatArray
    worst_m: FloatArray
    conditioning: FloatArray


def criteria(task: PlacementTask, context: Context, anchors: FloatArray) -> Criteria:
    """Return all criteria of layouts (..., M, 3)."""
    anchors = check_array("anchors", anchors, ("M", 3))
    context = placement.checked_context(context)
    covariance = np.linalg.inv(
        placement.information(task, context, anchors) + task.prior_information
    )
    tags, rotation = np.asarray(task.scene.tags), task.poses[0]
    b = bounds.score(covariance, rotation, tags)
    # The pose error (w, v) in metres at the tags: C^T (w, v).
    J = bounds.tag_jacobian(rotation, tags)
    square, vectors = np.linalg.eigh(np.einsum("pnia,pnib->pab", J, J) / len(tags))
    C = vectors * np.sqrt(np.maximum(square, 0.0))[:, None]
    values = np.maximum(np.linalg.eigvalsh(np.swapaxes(C, -1, -2) @ covariance @ C), 1e-300)
    of_position, of_rotation = (
        np.sqrt(np.einsum("...ii->...", covariance[..., part, part]).mean(axis=-1))
        for part in (slice(3, 6), slice(3))
    )
    return Criteria(
        np.sqrt((b**2).mean(axis=-1)),
        of_position,
        of_rotation,
        np.exp(0.5 * np.log(values).mean(axis=(-1, -2))),
        np.sqrt(values[..., -1].mean(axis=-1)),
        b.max(axis=-1),
        _conditioning(_weighted_anchors(task, context, anchors)),
    )


def _conditioning(spread: FloatArray) -> FloatArray:
    """Return mean condition numbers (...) of Abar (..., P, M, 3); inf for fewer than 4 anchors."""
    if spread.shape[-2] < 4:
        return np.full(spread.shape[:-3], np.inf)
    singular = np.linalg.svd(spread, compute_uv=False)
    least = np.maximum(singular[..., 2], 1e-12 * singular[..., 0])
    # Coincident anchors, or anchors without information, leave only zeros.
    ratio = np.divide(singular[..., 0], least, out=np.full(least.shape, 1e12), where=least > 0)
    return np.exp(np.log(ratio).mean(axis=-1))


def _weighted_anchors(task: PlacementTask, context: Context, anchors: FloatArray) -> FloatArray:
    """Return Abar (..., P, M, 3): anchors minus weighted mean, times the root of the weights."""
    places = placement.positions(task, context)
    distance = ranging.distances(anchors[..., None, :, :], places[..., None, :])
    weight = 1 / task.scene.noise.squared_range_variance(np.maximum(distance, 1e-6))
    if in_the_way := task.obstacles_in(context):
        weight = weight * in_the_way.share(anchors, places)[..., None]
    total = weight.sum(axis=-2)
    # Without any information, Abar is zero.
    mean = (weight * anchors[..., None, :, :]).sum(axis=-2) / np.where(total > 0, total, 1.0)
    return np.sqrt(weight) * (anchors[..., None, :, :] - mean[..., None, :])
