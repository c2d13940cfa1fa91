"""Observations of the learning tasks, as functions of arrays with any leading axes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.kernels import compiled
from rbl_gym.worlds.scene import Scene


def _belief(rotation: FloatArray, covariance: FloatArray, prior_variance: FloatArray) -> FloatArray:
    """Return (..., 12): log standard deviations minus their usual values; two columns of Q."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    spread = 0.5 * np.log(np.maximum(variance, 1e-24) / prior_variance) + 1.0
    return np.concatenate([spread, rotation[..., 0], rotation[..., 1]], axis=-1)


@compiled("task_views:mobile_anchors")
def mobile_anchors(
    translation: FloatArray,
    rotation: FloatArray,
    covariance: FloatArray,
    twist: FloatArray,
    anchors: FloatArray,
    prior_variance: FloatArray,
    speed: float,
    sort: bool,
    limits: FloatArray,
) -> tuple[np.ndarray, FloatArray]:
    """Return the numbers (..., M) of the craft in order, and the view (..., 15 + 3 M).

    From mean and covariance of the belief, its usual variances (6,), the known twist (..., 6) and
    the craft (..., M, 3) of a usual speed. With `sort` they are sorted by the bearing from the
    estimate, so that equal situations look equal. Entries are cut to `limits` (15 + 3 M,), all
    equal.
    """
    gap = (anchors - translation[..., None, :]) / 100
    order = np.argsort(np.arctan2(gap[..., 1], gap[..., 0]), axis=-1, kind="stable")
    if not sort:
        order = np.broadcast_to(np.arange(order.shape[-1]), order.shape)
    level = np.take_along_axis(gap[..., :2], order[..., None], axis=-2)
    square = (level**2).sum(axis=-1) + (translation[..., 2:] / 100) ** 2
    parts = [
        translation[..., 2:] / 50,
        twist[..., 3:5] / speed,
        _belief(rotation, covariance, prior_variance),
        level.reshape(*level.shape[:-2], -1),
        0.5 * np.log(np.maximum(square, 1e-16)),
    ]
    return order, np.clip(np.concatenate(parts, axis=-1), -limits, limits)


@compiled("task_views:anchor_selection")
def anchor_selection(
    translation: FloatArray,
    rotation: FloatArray,
    covariance: FloatArray,
    twist: FloatArray,
    prior_variance: FloatArray,
    speed: float,
    centre: FloatArray,
    half: FloatArray,
    limits: FloatArray,
) -> FloatArray:
    """Return the view (..., 18); `centre` and `half` (3,) scale the position, the rest as above."""
    parts = [
        (translation - centre) / half,
        twist[..., 3:] / speed,
        _belief(rotation, covariance, prior_variance),
    ]
    return np.clip(np.concatenate(parts, axis=-1), -limits, limits)


# --- drawn worlds: arrays for the largest number of anchors, and their masks ------------------


def reach_of_craft(world: Any) -> FloatArray:
    """Return the longest move of a craft in a step (...), metres, of `Scene` or `StackedScenes`."""
    if isinstance(world, Scene):
        return np.asarray(world.anchor_speed_m_s * world.dt)
    return world.arrays.speed * world.arrays.dt


def padded_craft(
    view: Callable[..., tuple[np.ndarray, FloatArray]],
    told: Sequence[np.ndarray],
    mask: np.ndarray,
    reach_m: FloatArray,
) -> tuple[np.ndarray, FloatArray]:
    """Return order (..., M) and view (..., 16 + 4 M) of the existing craft.

    `view` is `mobile_anchors` of `told`, its first arguments, the last of which are the craft (...,
    M, 3). `mask` (..., M) is 1 for existing craft; `reach_m` (...) the longest move in a step.
    """
    m, counts = mask.shape[-1], mask.sum(axis=-1)
    order = np.broadcast_to(np.arange(m), mask.shape).copy()
    flat = np.zeros((*counts.shape, 16 + 4 * m))
    flat[..., 15 + 3 * m] = np.minimum(reach_m / 10, 10.0)
    flat[..., 16 + 3 * m :] = mask
    for count in np.unique(counts).tolist():
        rows = counts == count
        *belief, anchors = (field[rows] for field in told)
        order[rows, :count], seen = view(*belief, anchors[:, :count])
        # Positions, then distances: each part is padded separately.
        flat[rows, : 15 + 2 * count] = seen[:, : 15 + 2 * count]
        flat[rows, 15 + 2 * m : 15 + 2 * m + count] = seen[:, 15 + 2 * count :]
    return order, flat


def padded_selection(
    flat: FloatArray, observation: Mapping[str, np.ndarray], half: FloatArray, extent_m: float
) -> FloatArray:
    """Return the view (..., 21 + 6 M): `anchor_selection`, volume, anchors and their memory."""
    mask = observation["anchor_mask"]
    gap = observation["anchors"] - observation["belief_translation"][..., None, :]
    heard = np.exp(-observation["age"] / 10)
    parts = [
        flat,
        half / extent_m,
        np.clip(gap / extent_m * mask[..., None], -10, 10).reshape(*mask.shape[:-1], -1),
        np.where(heard > 0, 2 * observation["known"] - 1, 0.0),
        heard,
        mask,
    ]
    return np.concatenate(parts, axis=-1)
