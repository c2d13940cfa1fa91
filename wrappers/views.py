"""What the policies of the learning tasks see, of arrays with any leading axes."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.kernels import compiled


def _belief(rotation: FloatArray, covariance: FloatArray, prior_variance: FloatArray) -> FloatArray:
    """(..., 12): log standard deviations, less that of their usual size; two columns of Q."""
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
    """The numbers (..., M) of the craft in their order, and the view (..., 15 + 3 M).

    Parameters
    ----------
    translation, rotation, covariance
        Of the belief.
    twist
        Known twist (..., 6).
    anchors
        Craft (..., M, 3).
    prior_variance
        (6,), the usual size of the belief's variances.
    speed
        The usual size of the velocity.
    sort
        Whether by the bearing from the estimate, so that equal situations look equal.
    limits
        (15 + 3 M,), all of one size, to which entries are cut.
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
    """The view (..., 18); `centre` and `half` (3,) scale the place, the others as above."""
    parts = [
        (translation - centre) / half,
        twist[..., 3:] / speed,
        _belief(rotation, covariance, prior_variance),
    ]
    return np.clip(np.concatenate(parts, axis=-1), -limits, limits)
