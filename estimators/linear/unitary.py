"""UC-KF on SO(3): the weighted problems (23), (26) and (27) of the tracking paper."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.filter import inverse
from rbl_gym.estimators.linear.least_squares import procrustes, unvec, vec
from rbl_gym.estimators.linear.squared_range import Statistic
from rbl_gym.geometry import rotations


def decoupled_fit(
    mean: FloatArray, covariance: FloatArray, stat: Statistic
) -> tuple[FloatArray, FloatArray]:
    """Rotation from the centred tags and its prior block (26), then the translation (27).

    Parameters
    ----------
    mean, covariance
        Prior (..., 12) and (..., 12, 12).
    stat
        Of common weights.

    Returns
    -------
    Rotation (..., 3, 3) and translation (..., 3).
    """
    P_q = inverse(covariance[..., :9, :9])
    P_t = inverse(covariance[..., 9:, 9:])
    tags = stat.tags - stat.tags.mean(axis=-2, keepdims=True)
    G = stat.G[..., 0, :, :]
    gram = np.swapaxes(tags, -1, -2) @ tags
    kron = np.einsum("...kl,...ij->...kilj", gram, G)
    weight = P_q + kron.reshape(*kron.shape[:-4], 9, 9)
    pull = (P_q @ mean[..., :9, None])[..., 0] + vec(np.swapaxes(stat.b, -1, -2) @ tags)
    rotation = _fit_rotation(weight, np.linalg.solve(weight, pull[..., None])[..., 0])
    n_tags = stat.b.shape[-2]
    turned = (rotation @ stat.tags.sum(axis=-2)[..., None])[..., 0]
    right = (
        (P_t @ mean[..., 9:, None])[..., 0] + stat.b.sum(axis=-2) - (G @ turned[..., None])[..., 0]
    )
    return rotation, np.linalg.solve(P_t + n_tags * G, right[..., None])[..., 0]


def coupled_fit(mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The pose nearest to a linear posterior in its own covariance, (23)."""
    q, t = mean[..., :9], mean[..., 9:]
    weight = inverse(covariance[..., :9, :9])
    rotation = _fit_rotation(weight, q)
    moved = weight @ (vec(rotation) - q)[..., None]
    return rotation, t + (covariance[..., 9:, :9] @ moved)[..., 0]


def _fit_rotation(weight: FloatArray, q: FloatArray) -> FloatArray:
    return procrustes(weight, q, rotations.nearest(unvec(q)))[0]
