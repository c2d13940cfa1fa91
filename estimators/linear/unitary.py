"""Convert the 12 states to poses: problems (23), (26), (27) of UC-KF, and beliefs on SO(3)."""

from __future__ import annotations

import numpy as np

from rbl_gym.bounds.pose import symmetric
from rbl_gym.checks import FloatArray, kernel
from rbl_gym.estimators.filter import inverse
from rbl_gym.estimators.linear.least_squares import procrustes, unvec, vec
from rbl_gym.estimators.linear.squared_range import statistic
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled

# Internal functions without checks: undetermined entries are NaN.
_HAT, _NEAREST = kernel(rotations.hat), kernel(rotations.nearest)


@compiled("linear_beliefs:decoupled_fit")
def decoupled_fit(
    mean: FloatArray,
    covariance: FloatArray,
    ranges: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """Return the rotation from centred tags and its prior block (26), then the translation (27).

    The prior is `mean` (..., 12) and `covariance` (..., 12, 12); the weights (..., M, 1) are common
    to all tags. Returns ``[vec Q; t]`` (..., 12), Q a rotation.
    """
    stat = statistic(ranges, anchors, tags, weights)
    P_q = inverse(covariance[..., :9, :9])
    P_t = inverse(covariance[..., 9:, 9:])
    centred = tags - tags.mean(axis=-2, keepdims=True)
    G = stat.G[..., 0, :, :]
    gram = np.swapaxes(centred, -1, -2) @ centred
    kron = np.einsum("...kl,...ij->...kilj", gram, G)
    weight = P_q + kron.reshape(*kron.shape[:-4], 9, 9)
    pull = (P_q @ mean[..., :9, None])[..., 0] + vec(np.swapaxes(stat.b, -1, -2) @ centred)
    rotation = _fit_rotation(weight, np.linalg.solve(weight, pull[..., None])[..., 0])
    turned = (rotation @ tags.sum(axis=-2)[..., None])[..., 0]
    right = (
        (P_t @ mean[..., 9:, None])[..., 0] + stat.b.sum(axis=-2) - (G @ turned[..., None])[..., 0]
    )
    translation = np.linalg.solve(P_t + tags.shape[-2] * G, right[..., None])[..., 0]
    return np.concatenate([vec(rotation), translation], axis=-1)


@compiled("linear_beliefs:coupled_fit")
def coupled_fit(mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the pose (..., 12) nearest to a linear posterior in its covariance norm, (23)."""
    q, t = mean[..., :9], mean[..., 9:]
    weight = inverse(covariance[..., :9, :9])
    rotation = _fit_rotation(weight, q)
    moved = weight @ (vec(rotation) - q)[..., None]
    t = t + (covariance[..., 9:, :9] @ moved)[..., 0]
    return np.concatenate([vec(rotation), t], axis=-1)


def _fit_rotation(weight: FloatArray, q: FloatArray) -> FloatArray:
    return procrustes(weight, q, _NEAREST(unvec(q)))[0]


@compiled("linear_beliefs:projected_belief")
def projected_belief(
    mean: FloatArray, covariance: FloatArray, like: FloatArray, size: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the nearest pose, its covariance ``J^+ P J^+T``, and the state matrix (..., 3, 3).

    The pose is a rotation (..., 3, 3) and a translation (..., 3). `like` (3,) and `size` (6,) only
    give a kernel the size of the results.
    """
    matrix, translation = unvec(mean[..., :9]).copy(), mean[..., 9:].copy()
    rotation = _NEAREST(matrix)
    # J^T J = blkdiag(2 I, I): the pseudo-inverse needs no solver.
    halves = np.array([0.5] * 3 + [1.0] * 3)[:, None]
    pinv = np.swapaxes(state_jacobian(rotation), -1, -2) * halves
    P = symmetric(pinv @ covariance @ np.swapaxes(pinv, -1, -2))
    return rotation, translation, P, matrix


@compiled("linear_beliefs:constrained_belief")
def constrained_belief(
    mean: FloatArray, covariance: FloatArray, like: FloatArray, size: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the pose of the state, its covariance ``(J^T P^-1 J)^-1`` on SO(3), and the matrix.

    See `projected_belief`.
    """
    matrix, translation = unvec(mean[..., :9]).copy(), mean[..., 9:].copy()
    rotation = _NEAREST(matrix)
    J = state_jacobian(rotation)
    P = inverse(np.swapaxes(J, -1, -2) @ np.linalg.solve(covariance, J))
    return rotation, translation, P, matrix


def state_jacobian(rotation: FloatArray) -> FloatArray:
    """Return the derivative (..., 12, 6) of ``[vec Q; t]`` by the pose error (w, v)."""
    J = np.zeros((*rotation.shape[:-2], 12, 6))
    for k in range(3):
        J[..., 3 * k : 3 * k + 3, :3] = -_HAT(rotation[..., :, k])
    J[..., 9:, 3:] = np.eye(3)
    return J
