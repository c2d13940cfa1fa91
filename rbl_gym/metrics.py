"""Measure the quality of beliefs: pose errors, consistency, error measures of the papers.

All functions broadcast over leading axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from rbl_gym import bounds
from rbl_gym.checks import FloatArray, all_finite, checked, kernel
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled

__all__ = [
    "Figures", "expected_mean_angular_error", "judge", "length", "mean_angular_error", "nees",
    "pose_error", "tag_error",
]  # fmt: skip

# Internal functions without checks: their arguments were checked.
_ERROR, _ANGLE_BETWEEN = kernel(rotations.error), kernel(rotations.angle_between)


@checked(rotation_hat=(3, 3), translation_hat=(3,), rotation=(3, 3), translation=(3,))
def pose_error(
    rotation_hat: FloatArray,
    translation_hat: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
) -> FloatArray:
    """Return the error (..., 6), (w, v): ``Q_hat = exp(w) Q``, radians, ``t_hat = t + v``, metres.

    Parameters
    ----------
    rotation_hat, translation_hat, rotation, translation
        Estimate and truth: (..., 3, 3), (..., 3), (..., 3, 3), (..., 3); metres.
    """
    turn = _ERROR(rotation_hat, rotation)
    shift = np.asarray(translation_hat) - np.asarray(translation)
    return np.concatenate(np.broadcast_arrays(turn, shift), axis=-1)


@checked(
    rotation_hat=(3, 3), translation_hat=(3,), rotation=(3, 3), translation=(3,), tags=("N", 3)
)
def tag_error(
    rotation_hat: FloatArray,
    translation_hat: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    tags: FloatArray,
) -> FloatArray:
    """Return the root mean square (...) of the tag displacements, metres.

    Parameters
    ----------
    rotation_hat, translation_hat, rotation, translation
        Estimate and truth: (..., 3, 3), (..., 3), (..., 3, 3), (..., 3); metres.
    tags
        (..., N, 3), metres, body frame.
    """
    turned = np.asarray(tags) @ np.swapaxes(np.asarray(rotation_hat) - rotation, -1, -2)
    shift = (np.asarray(translation_hat) - translation)[..., None, :]
    displacement = turned + shift
    square = np.einsum("...ni,...ni->...", displacement, displacement)
    return np.sqrt(square / displacement.shape[-2])


@checked(vector=("n",))
def length(vector: FloatArray) -> FloatArray:
    """Return the Euclidean length (...) of vectors (..., n)."""
    return np.sqrt(np.einsum("...i,...i->...", vector, vector))


@checked(error=("n",), covariance=("n", "n"))
def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the normalised estimation error squared (...), ``e^T P^-1 e``.

    For a consistent belief its mean is n: 6 for a pose.
    """
    if covariance.shape[-2:] != (error.shape[-1],) * 2:
        raise ValueError(
            f"covariance must have shape (..., n, n) for errors of n = {error.shape[-1]} entries, "
            f"got {covariance.shape}"
        )
    try:
        solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    except np.linalg.LinAlgError as mistake:
        rank = np.linalg.matrix_rank(covariance)
        raise ValueError(
            f"covariance must not be singular, got rank {rank.min()} of {error.shape[-1]}"
        ) from mistake
    return np.einsum("...i,...i->...", error, solved)


@checked(matrix=(3, 3), rotation=(3, 3))
def mean_angular_error(matrix: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the mean angle (...), radians, between the columns of an estimate and the rotation.

    This is the measure of the static paper. It is computed by atan2, so that small angles are
    accurate. The estimate need not be orthogonal.
    """
    columns = np.swapaxes(np.asarray(matrix), -1, -2), np.swapaxes(np.asarray(rotation), -1, -2)
    return _ANGLE_BETWEEN(*columns).mean(axis=-1)


@checked(covariance=(6, 6), rotation=(3, 3))
def expected_mean_angular_error(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the mean angular error (...), radians, of a Gaussian error of this pose covariance.

    A column moves in the plane perpendicular to it by a zero-mean Gaussian with eigenvalues l1 >=
    l2. Its mean length is ``sqrt(2 l1 / pi) E(1 - l2 / l1)``, E the complete elliptic integral of
    the second kind (parameter m).
    """
    body = np.swapaxes(rotation, -1, -2) @ covariance[..., :3, :3] @ rotation
    lengths = []
    for column in range(3):
        across = [axis for axis in range(3) if axis != column]
        block = body[..., across, :][..., across]
        l2, l1 = np.moveaxis(np.linalg.eigvalsh(block), -1, 0)
        l1, l2 = np.maximum(l1, 0.0), np.maximum(l2, 0.0)  # rounding, where one axis is still
        ratio = l2 / np.where(l1 > 0, l1, 1.0)
        lengths.append(np.sqrt(2 * l1 / np.pi) * scipy.special.ellipe(1 - ratio))
    return np.mean(lengths, axis=0)


class Figures(NamedTuple):
    """Quality figures of beliefs, arrays (...).

    Attributes
    ----------
    rotation_error_rad, position_error_m
        Angle and distance to the true pose.
    tag_error_m
        Root mean square displacement of the tags (`tag_error`).
    nees
        `nees` of the pose error, 6 degrees of freedom.
    score_m
        `bounds.score` of the covariance of the belief.
    """

    rotation_error_rad: FloatArray
    position_error_m: FloatArray
    tag_error_m: FloatArray
    nees: FloatArray
    score_m: FloatArray


def judge(
    rotation_hat: FloatArray,
    translation_hat: FloatArray,
    covariance: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    tags: FloatArray,
) -> Figures:
    """Return the errors of beliefs relative to true poses, their NEES and their score.

    Parameters
    ----------
    rotation_hat, translation_hat, covariance
        The beliefs: (..., 3, 3), (..., 3), (..., 6, 6).
    rotation, translation, tags
        The truth: (..., 3, 3), (..., 3); (..., N, 3) in the body frame, metres.

    Raises
    ------
    ValueError
        If a covariance is not positive definite, or anything is not finite.
    """
    figures = Figures(
        *_judge(rotation_hat, translation_hat, covariance, rotation, translation, tags)
    )
    # A NaN or inf in any of them is one here.
    total = figures.nees + figures.score_m + figures.tag_error_m
    if not all_finite(total):
        wrong = covariance if np.isfinite(figures.tag_error_m).all() else translation_hat
        raise ValueError(
            "beliefs must be finite, and their covariance positive definite, got "
            f"{np.asarray(wrong)!r:.200}"
        )
    return figures


@compiled("belief_errors:judge")
def _judge(
    rotation_hat: FloatArray,
    translation_hat: FloatArray,
    covariance: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    tags: FloatArray,
) -> tuple[FloatArray, ...]:
    """Compute `judge`; the NEES is NaN if a covariance is not positive definite."""
    truth = rotation, translation
    error = kernel(pose_error)(rotation_hat, translation_hat, *truth)
    good = np.asarray(np.isfinite(covariance).all(axis=(-2, -1)))
    safe = np.where(good[..., None, None], covariance, np.eye(6))
    good &= np.linalg.eigvalsh(safe)[..., 0] > 0
    safe = np.where(good[..., None, None], covariance, np.eye(6))
    return (
        np.asarray(kernel(length)(error[..., :3])),
        np.asarray(kernel(length)(error[..., 3:])),
        kernel(tag_error)(rotation_hat, translation_hat, *truth, tags),
        np.where(good, kernel(nees)(error, safe), np.nan),
        np.where(good, bounds.score(safe, rotation_hat, tags), np.nan),
    )
