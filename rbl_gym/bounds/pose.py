"""Compute the Cramer-Rao bound of the pose from one epoch, and the score of a covariance.

The pose error is ``(w, v)``: ``Q_hat = exp(w) Q`` (world frame, rad), ``t_hat = t + v`` (m);
information and covariance are 6 x 6 in that order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.information import range_information
from rbl_gym.checks import BoolArray, FloatArray, check_array, checked
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import ranging

__all__ = ["information_rank", "pose_crb", "score", "symmetric"]

# J_n as a linear function of (c_n, 1), c_n rotated: J_n[i, a] = sum_k (c_n, 1)[k] _BY_POSE[k, i,
# a].
_BY_POSE = np.zeros((4, 3, 6))
_BY_POSE[:3, :, :3] = -rotations.hat(np.eye(3))
_BY_POSE[3, :, 3:] = np.eye(3)
_BY_MOMENTS = np.einsum("kia,lib->klab", _BY_POSE, _BY_POSE).reshape(16, 36)


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
    anchor_std_m: ArrayLike = 0.0,
) -> FloatArray:
    """Return the Cramer-Rao bound (..., 6, 6) of the pose from one epoch of ranges.

    It is the inverse of `range_information` plus the prior information (..., 6, 6), if any. A
    pseudo-inverse is not used, because it would favour anchors without information.

    Arguments as in `range_information`, and `prior_information` (..., 6, 6).

    Raises
    ------
    ValueError
        As in `range_information`, and if the information is singular; the message gives its rank.
    """
    information = range_information(
        anchors, tags, rotation, translation, noise, links,
        model=model, tag_std_m=tag_std_m, offset=offset, anchor_std_m=anchor_std_m,
    )  # fmt: skip
    if prior_information is not None:
        information = information + check_array("prior_information", prior_information, (6, 6))
    return inverted(information, "anchors or tags")


def inverted(information: FloatArray, more: str) -> FloatArray:
    """Return the inverse of pose information; raise ValueError with the rank if it is singular."""
    rank = information_rank(information)
    if (rank < 6).any():
        where = tuple(int(i) for i in np.argwhere(rank < 6)[0])
        at = f" at index {where}" if where else ""
        raise ValueError(
            "the geometry does not determine the pose: its information has rank "
            f"{int(rank.min())} of 6{at}; add {more}, or give prior_information"
        )
    return np.linalg.inv(information)


# Eigenvalues of information below this do not count, with the diagonal scaled to one.
_RANK_TOLERANCE = 1e-11


def information_rank(information: FloatArray) -> np.ndarray:
    """Return the number (...) of directions determined by information (..., n, n); unit-free."""
    n = information.shape[-1]
    # With a unit diagonal no eigenvalue exceeds n. The determinant then bounds the smallest one,
    # so that most matrices need no eigenvalues.
    _, regular = regular_inverse(information, 2 * _RANK_TOLERANCE * n ** (n - 1))
    rank, open_ = np.full(information.shape[:-2], n), ~np.asarray(regular)
    if open_.any():
        scale = np.sqrt(np.maximum(np.diagonal(information[open_], axis1=-2, axis2=-1), 0.0))
        scale = np.where(scale > 0, scale, 1.0)
        scaled = information[open_] / (scale[..., :, None] * scale[..., None, :])
        rank[open_] = (np.linalg.eigvalsh(scaled) > _RANK_TOLERANCE).sum(axis=-1)
    return rank


@compiled("pose_bound:regular_inverse")
def regular_inverse(matrix: FloatArray, least: float) -> tuple[FloatArray, BoolArray]:
    """Return the inverse of symmetric matrices (..., n, n), and whether (...) each is regular.

    Regular means positive definite and, scaled to a unit diagonal, with a determinant above
    `least`. Otherwise the inverse is NaN. A matrix with NaN counts as regular, and its inverse is
    NaN too.
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
    """Return the symmetric part, so that rounding errors do not grow in recursions."""
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))


@checked(covariance=(6, 6), rotation=(3, 3), tags=("N", 3))
def score(covariance: FloatArray, rotation: ArrayLike, tags: ArrayLike) -> FloatArray:
    """Return the root mean square tag error b (...), metres, of a pose covariance (..., 6, 6).

    ``b^2 = mean_n tr(J_n P J_n^T)``, ``J_n = [-[Q c_n]x, I]``: one number for position and
    orientation.
    """
    turned = np.asarray(tags, dtype=np.float64) @ np.swapaxes(np.asarray(rotation), -1, -2)
    extended = np.ones((*turned.shape[:-1], 4))
    extended[..., :3] = turned
    # The sum of J_n^T J_n is linear in the second moments of the tags.
    moments = np.swapaxes(extended, -1, -2) @ extended
    square = moments.reshape((*moments.shape[:-2], 16)) @ _BY_MOMENTS
    square = square.reshape((*square.shape[:-1], 6, 6)) / turned.shape[-2]
    trace = np.einsum("...ab,...ab->...", square, covariance)
    return root_of_trace(trace)


def root_of_trace(trace: ArrayLike) -> FloatArray:
    """Return the score (...) from its square, a trace.

    Raise ValueError if it is NaN or negative.
    """
    # Also True for NaN.
    if not np.min(trace) >= 0:
        raise ValueError(f"covariance must be positive and finite, got a trace of {np.min(trace)}")
    return np.asarray(np.sqrt(trace))
