"""Covariance of an update along directions that its epoch does not observe.

Ranges to collinear tags do not determine the roll of the body about their line. The line rotates
with the body. A usual update moves the prior's information to the new pose by the derivative of its
residual, ``Jl^-1(log(Q Q_-^T))``, which rotates it only half of the way. The uncertain direction
then leaves the line: every update adds a little information about the roll that the ranges do not
have. After many updates the filter is overconfident in the roll. This module rotates the
information with the body, so that the uncertain direction stays on the line.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.estimators.filter import inverse
from rbl_gym.geometry import rotations

# Tags with a smaller ratio of squared width to squared length count as collinear. For these the
# difference of the two ways to move the prior exceeds the information of the ranges; for others it
# is negligible.
_THIN = 0.01
_HAT, _LOG = kernel(rotations.hat), kernel(rotations.log)
_LEFT_JACOBIAN_INVERSE = kernel(rotations.left_jacobian_inverse)


def kept_wide(prior: Any, posterior: Any, heard: BoolArray | np.bool_, tags: FloatArray) -> Any:
    """Return the posterior with a covariance that keeps unobserved directions as wide as before.

    `prior` and `posterior` are poses before and after the update, NamedTuples with `rotation`,
    `translation` and `covariance`. `heard` (..., N): which of the tags (..., N, 3) had any link.
    """
    thin, centre = _line(heard, tags)
    if not thin.any():
        return posterior
    batch = np.broadcast_shapes(thin.shape, posterior.translation.shape[:-1])
    axes = batch or (1,)
    where = np.broadcast_to(thin, axes).nonzero()

    def chosen(array: FloatArray, core: int) -> FloatArray:
        return np.broadcast_to(array, (*axes, *array.shape[array.ndim - core :]))[where]

    Q0, P0 = chosen(prior.rotation, 2), chosen(prior.covariance, 2)
    Q1, P1 = chosen(posterior.rotation, 2), chosen(posterior.covariance, 2)
    information = inverse(P0)
    back = Q0 @ np.swapaxes(Q1, -1, -2)
    arms = [_HAT((Q @ chosen(centre, 1)[..., None])[..., 0]) for Q in (Q0, Q1)]
    D = np.zeros_like(P1)
    D[:, :3, :3] = _LEFT_JACOBIAN_INVERSE(_LOG(np.swapaxes(back, -1, -2)))
    D[:, 3:, 3:] = np.eye(3)
    # An error about the tags' centre keeps its value in the body frame.
    T = np.zeros_like(P1)
    T[:, :3, :3], T[:, 3:, 3:] = back, np.eye(3)
    T[:, 3:, :3] = arms[0] @ back - arms[1]
    carried = [np.swapaxes(A, -1, -2) @ information @ A for A in (D, T)]
    covariance = np.broadcast_to(posterior.covariance, (*axes, 6, 6)).copy()
    covariance[where] = inverse(inverse(P1) - carried[0] + carried[1])
    return posterior._replace(covariance=covariance.reshape((*batch, 6, 6)))


def _line(heard: BoolArray | np.bool_, tags: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Return whether (...) the tags with links are nearly collinear, and their centre (..., 3)."""
    heard = np.asarray(heard)
    share = heard / np.maximum(heard.sum(axis=-1, keepdims=True), 1)
    centre = (share[..., None, :] @ tags)[..., 0, :]
    about = (tags - centre[..., None, :]) * heard[..., None]
    gram = np.swapaxes(about, -1, -2) @ about
    trace = np.einsum("...ii->...", gram)
    # Sum of products of pairs of eigenvalues, over the square of their sum.
    pairs = 0.5 * (trace**2 - np.einsum("...ij,...ij->...", gram, gram))
    return np.asarray(heard.any(axis=-1) & (pairs <= _THIN * trace**2)), centre
