"""The rotation of UC-KF: the weighted problems (23) and (26) of the tracking paper, on SO(3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rbl_gym import rotations
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.belief import inverse
from rbl_gym.estimators.least_squares import procrustes, unvec, vec
from rbl_gym.estimators.squared_range import Statistic

# Newton's method squares the error of a step: after one this short nothing is left to gain.
_SHORT_STEP = 1e-8
_ITERATIONS = 8


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


def column_fit(target: FloatArray, blocks: FloatArray) -> FloatArray:
    """The rotation nearest to q where the covariance has a block of its own for each column.

    Newton's method of `least_squares.procrustes`, written out with the trials last. Trials
    whose Hessian is not positive, or whose cost would rise, are left to that function.

    Parameters
    ----------
    target
        (3, 3, B), row, column, trial.
    blocks
        (3, 3, 3, B), the three covariances as the third axis (`four_filters`).

    Returns
    -------
    Rotation (3, 3, B).
    """
    (p00, p01, p02), (_, p11, p12), (_, _, p22) = blocks
    W = _inverse((p00, p01, p02, p11, p12, p22))
    start = np.moveaxis(rotations.nearest(np.moveaxis(target, -1, 0)), 0, -1)
    q = np.ascontiguousarray(start)
    e, y = _residual(W, q, target)
    cost = (e * y).sum(axis=(0, 1))
    hard = np.zeros(q.shape[-1], bool)
    for _ in range(_ITERATIONS):
        w, usable = _newton_step(W, q, y)
        length = np.sqrt((w * w).sum(axis=0))
        q = _turn(q, 0.5 * w)
        e, y = _residual(W, q, target)
        new_cost = (e * y).sum(axis=(0, 1))
        moving = length > _SHORT_STEP
        hard |= ~usable | (length > 1.5) | (moving & (new_cost > cost * (1 + 1e-12)))
        cost = new_cost
        if not (moving & ~hard).any():
            break
    else:
        hard |= moving
    if hard.any():
        q[..., hard] = _damped(W[..., hard], target[..., hard], start[..., hard])
    return q


def _inverse(upper: Sequence[FloatArray]) -> FloatArray:
    """Inverses (6, ...) of symmetric 3 x 3 matrices, by rows of their upper triangles."""
    p00, p01, p02, p11, p12, p22 = upper
    c00, c01, c02 = p11 * p22 - p12 * p12, p02 * p12 - p01 * p22, p01 * p12 - p02 * p11
    cofactors = [c00, c01, c02, p00 * p22 - p02 * p02, p01 * p02 - p00 * p12, p00 * p11 - p01 * p01]
    return np.stack(cofactors) / (p00 * c00 + p01 * c01 + p02 * c02)


def _residual(W: FloatArray, q: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    w00, w01, w02, w11, w12, w22 = W
    e = q - target
    y = np.empty_like(e)
    y[0] = w00 * e[0] + w01 * e[1] + w02 * e[2]
    y[1] = w01 * e[0] + w11 * e[1] + w12 * e[2]
    y[2] = w02 * e[0] + w12 * e[1] + w22 * e[2]
    return e, y


def _newton_step(W: FloatArray, q: FloatArray, y: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Step (3, B) of the exact Hessian, and where that is positive definite (zero elsewhere).

    Gauss-Newton part ``sum [q]x^T W [q]x``, curvature ``sum sym(q y^T) - (q^T y) I``.
    """
    w00, w01, w02, w11, w12, w22 = W
    q0, q1, q2 = q
    y0, y1, y2 = y
    s0, s1, s2 = q0 * y0, q1 * y1, q2 * y2
    a01, a02 = w11 * q2 - w12 * q1, w12 * q2 - w22 * q1
    a10, a11, a12 = w02 * q0 - w00 * q2, w12 * q0 - w01 * q2, w22 * q0 - w02 * q2
    a20, a21, a22 = w00 * q1 - w01 * q0, w01 * q1 - w11 * q0, w02 * q1 - w12 * q0
    hessian = np.stack([
        (q2 * a01 - q1 * a02 - s1 - s2).sum(axis=0),
        (q2 * a11 - q1 * a12 + 0.5 * (q0 * y1 + q1 * y0)).sum(axis=0),
        (q2 * a21 - q1 * a22 + 0.5 * (q0 * y2 + q2 * y0)).sum(axis=0),
        (q0 * a12 - q2 * a10 - s0 - s2).sum(axis=0),
        (q0 * a22 - q2 * a20 + 0.5 * (q1 * y2 + q2 * y1)).sum(axis=0),
        (q1 * a20 - q0 * a21 - s0 - s1).sum(axis=0),
    ])  # fmt: skip
    h00, h01, h02, h11, h12, h22 = hessian
    minor = h00 * h11 - h01 * h01
    determinant = h22 * minor - h12 * (h00 * h12 - h01 * h02) + h02 * (h01 * h12 - h11 * h02)
    usable = (h00 > 0) & (minor > 0) & (determinant > 0)
    if not usable.all():
        hessian = np.where(usable, hessian, np.array([1.0, 0, 0, 1, 0, 1])[:, None])
    i00, i01, i02, i11, i12, i22 = _inverse(hessian)  # pyright: ignore[reportArgumentType]
    g0 = (q1 * y2 - q2 * y1).sum(axis=0)
    g1 = (q2 * y0 - q0 * y2).sum(axis=0)
    g2 = (q0 * y1 - q1 * y0).sum(axis=0)
    step = np.stack([
        i00 * g0 + i01 * g1 + i02 * g2,
        i01 * g0 + i11 * g1 + i12 * g2,
        i02 * g0 + i12 * g1 + i22 * g2,
    ])  # fmt: skip
    return np.where(usable, -step, 0.0), usable


def _turn(q: FloatArray, a: FloatArray) -> FloatArray:
    """``q`` turned by Cayley's rotation of ``a``: exp(2 a) to second order, and no sine."""
    scale = 2 / (1 + (a * a).sum(axis=0))
    first = _cross(a, q)
    return q + scale * (first + _cross(a, first))


def _cross(a: FloatArray, q: FloatArray) -> FloatArray:
    a0, a1, a2 = a
    q0, q1, q2 = q
    return np.stack([a1 * q2 - a2 * q1, a2 * q0 - a0 * q2, a0 * q1 - a1 * q0])


def _damped(W: FloatArray, target: FloatArray, start: FloatArray) -> FloatArray:
    """`procrustes` of the same problem, trials last."""
    n_trials = W.shape[-1]
    weight = np.zeros((n_trials, 3, 3, 3, 3))
    for k in range(3):
        w00, w01, w02, w11, w12, w22 = W[:, k]
        rows = np.array([[w00, w01, w02], [w01, w11, w12], [w02, w12, w22]])
        weight[:, k, :, k, :] = np.moveaxis(rows, -1, 0)
    q = vec(np.moveaxis(target, -1, 0))
    rotation = procrustes(weight.reshape(n_trials, 9, 9), q, np.moveaxis(start, -1, 0))[0]
    return np.moveaxis(rotation, 0, -1)
