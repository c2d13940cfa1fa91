"""The 12-state Kalman filter as four filters of three states: exact for centred tags.

With V the principal axes of the tag layout, ``C^T C = V diag(lambda) V^T``, and the columns
``q'_m = sum_k V_km q_k``, an epoch of common weights tells ``lambda_m G`` about ``q'_m`` and
``N G`` about the translation, and nothing across; rotation and isotropic noise keep it so.

Inside, the trials are the last axis: a block of the covariance is six arrays ``COMPONENTS``
of shape (4, B), the state is (3, 4, B). The covariances that come out are the usual
(..., 12, 12), laid out in memory with the trials last, so that the next step reads them as
they are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

# Upper triangle of a symmetric 3 x 3 block, in the order of the first axis of `blocks`.
COMPONENTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))

# What a block structure may be off by, relative to the variances beside it.
_ROUNDING = 1e-13


class Frame(NamedTuple):
    """The principal axes of a tag layout.

    Attributes
    ----------
    axes
        V (3, 3), a proper rotation.
    share
        (4, 1): the three eigenvalues of ``C^T C`` and N, what G is multiplied with.
    tags
        ``[C V, 1]`` (N, 4).
    aligned
        Whether V is the identity.
    """

    axes: FloatArray
    share: FloatArray
    tags: FloatArray
    aligned: bool


def principal_frame(tags: FloatArray) -> Frame | None:
    """Frame of tags (N, 3), None where they are not centred."""
    if tags.ndim != 2 or (np.abs(tags.sum(axis=0)) > 1e-12 * np.abs(tags).max(initial=0.0)).any():
        return None
    gram = tags.T @ tags
    values, axes = np.diagonal(gram), np.eye(3)
    aligned = bool(np.abs(gram - np.diag(values)).max() <= 1e-14 * values.max())
    if not aligned:
        values, axes = np.linalg.eigh(gram)
        axes = axes * np.sign(np.linalg.det(axes))
    extended = np.concatenate([tags @ axes, np.ones((len(tags), 1))], axis=1)
    share = np.append(np.maximum(values, 0.0), len(tags))[:, None]
    return Frame(axes, share, extended, aligned)


# --- between the state's arrays and the four filters -----------------------------------------


def split(frame: Frame, covariance: FloatArray) -> FloatArray | None:
    """Blocks (6, 4, B) of a covariance (..., 12, 12), None where it is not block-diagonal."""
    last = np.moveaxis(covariance, (-2, -1), (0, 1)).reshape(12, 12, -1)
    cross = [last[:9, 9:]]
    if frame.aligned:
        cross += [last[:3, 3:9], last[3:6, 6:9]]
    if not all(_within(values, last) for values in cross):
        return None
    if frame.aligned:
        return _symmetric_components(np.einsum("kikjb->ijkb", last.reshape(4, 3, 4, 3, -1)))
    n_trials = last.shape[-1]
    rotation = last[:9, :9].reshape(3, 3, 3, 3, n_trials)
    stacked = np.ascontiguousarray(rotation.transpose(0, 2, 1, 3, 4)).reshape(9, -1)
    mix = _mix(frame)
    turned = mix.T @ stacked
    stacked -= mix @ turned
    if (np.abs(stacked.reshape(81, n_trials)).max(axis=0) > _allowed(last[:9, :9])).any():
        return None
    blocks = np.empty((3, 3, 4, n_trials))
    blocks[:, :, :3] = turned.reshape(3, 3, 3, n_trials).transpose(1, 2, 0, 3)
    blocks[:, :, 3] = last[9:, 9:]
    return _symmetric_components(blocks)


def join(frame: Frame, blocks: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    """Covariance (..., 12, 12) of blocks (6, 4, B), its memory with the trials last."""
    n_trials = blocks.shape[-1]
    last = np.zeros((4, 3, 4, 3, n_trials))
    if frame.aligned:
        diagonal = np.einsum("kikjb->ijkb", last)
        for c, (i, j) in enumerate(COMPONENTS):
            diagonal[i, j] = blocks[c]
            if i != j:
                diagonal[j, i] = blocks[c]
    else:
        turned = np.ascontiguousarray(blocks[:, :3].swapaxes(0, 1)).reshape(3, -1)
        rotation = (_mix(frame) @ turned).reshape(3, 3, 6, n_trials)
        for c, (i, j) in enumerate(COMPONENTS):
            last[:3, i, :3, j] = last[:3, j, :3, i] = rotation[:, :, c]
            last[3, i, 3, j] = last[3, j, 3, i] = blocks[c, 3]
    return np.moveaxis(last.reshape(12, 12, *batch), (0, 1), (-2, -1))


def split_mean(frame: Frame, mean: FloatArray) -> FloatArray:
    """State (3, 4, B) in the frame of the principal axes, of the mean (..., 12)."""
    last = np.moveaxis(mean, -1, 0).reshape(4, 3, -1)
    x = np.empty((3, 4, last.shape[-1]))
    if frame.aligned:
        x[:] = last.swapaxes(0, 1)
    else:
        turned = frame.axes.T @ np.ascontiguousarray(last[:3]).reshape(3, -1)
        x[:, :3] = turned.reshape(3, 3, -1).swapaxes(0, 1)
        x[:, 3] = last[3]
    return x


def join_mean(frame: Frame, x: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    """Mean (..., 12) of the state (3, 4, B), its memory with the trials last."""
    last = np.empty((4, 3, x.shape[-1]))
    if frame.aligned:
        last[:] = x.swapaxes(0, 1)
    else:
        turned = frame.axes @ np.ascontiguousarray(x[:, :3].swapaxes(0, 1)).reshape(3, -1)
        last[:3] = turned.reshape(3, 3, -1)
        last[3] = x[:, 3]
    return np.moveaxis(last.reshape(12, *batch), 0, -1)


def _mix(frame: Frame) -> FloatArray:
    """(9, 3): the user's block (k, l) is ``sum_m V_km V_lm P_m``; orthonormal columns."""
    V = frame.axes
    return (V[:, None, :] * V[None, :, :]).reshape(9, 3)


def _within(cross: FloatArray, covariance: FloatArray) -> bool:
    """Whether terms across blocks are zero, exactly (mostly, and cheaply told) or to rounding."""
    # As integers one pass tells; minus zero goes on to the next line.
    if cross.view(np.uint64).max(initial=0) == 0:
        return True
    allowed = np.minimum(_allowed(covariance[:9, :9]), _allowed(covariance[9:, 9:]))
    return bool((np.abs(cross) <= allowed).all())


def _allowed(covariance: FloatArray) -> FloatArray:
    return _ROUNDING * np.einsum("iib->ib", covariance).max(axis=0)


def _symmetric_components(blocks: FloatArray) -> FloatArray:
    packed = np.empty((6, *blocks.shape[2:]))
    for c, (i, j) in enumerate(COMPONENTS):
        if i == j:
            packed[c] = blocks[i, i]
        else:
            np.add(blocks[i, j], blocks[j, i], out=packed[c])
            packed[c] *= 0.5
    return packed


# --- the filters -----------------------------------------------------------------------------


def predict_mean(mean: FloatArray, step: FloatArray, shift: FloatArray) -> FloatArray:
    """Mean (..., 12) after ``Q <- step Q``, ``t <- t + shift``, its memory with the trials last.

    The step (3, 3, ...) has the trials last, the shift (..., 3) first.
    """
    batch = np.broadcast_shapes(mean.shape[:-1], step.shape[2:], shift.shape[:-1])
    x = np.moveaxis(np.broadcast_to(mean, (*batch, 12)), -1, 0).reshape(4, 3, *batch)
    R = step
    new = np.empty((4, 3, *batch))
    for i in range(3):
        new[:3, i] = R[i, 0] * x[:3, 0] + R[i, 1] * x[:3, 1] + R[i, 2] * x[:3, 2]
        new[3, i] = x[3, i] + shift[..., i]
    return np.moveaxis(new.reshape(12, *batch), 0, -1)


def predict_blocks(
    blocks: FloatArray, step: FloatArray, noise: FloatArray, batch: tuple[int, ...]
) -> FloatArray:
    """Blocks (6, 4, B) of the batch after ``P_m <- R P_m R^T`` of the rotation's three.

    Parameters
    ----------
    blocks
        (6, 4, B), or (6, 4, 1) where common.
    step
        R (3, 3, ...), trials last.
    noise
        Variances (12,) that are added.
    """
    if step.ndim > 2:
        step = np.broadcast_to(step, (3, 3, *batch))
    step = step.reshape(3, 3, -1)
    p00, p01, p02, p11, p12, p22 = blocks[:, :3]
    rows = [
        (
            r[0] * p00 + r[1] * p01 + r[2] * p02,
            r[0] * p01 + r[1] * p11 + r[2] * p12,
            r[0] * p02 + r[1] * p12 + r[2] * p22,
        )
        for r in step
    ]
    new = np.empty((6, 4, math.prod(batch)))
    new[:, 3] = blocks[:, 3]
    for c, (i, j) in enumerate(COMPONENTS):
        r = step[j]
        new[c, :3] = rows[i][0] * r[0] + rows[i][1] * r[1] + rows[i][2] * r[2]
        if i == j:
            new[c] += noise.reshape(4, 3)[:, i, None]
    return new


def update(
    frame: Frame, x: FloatArray, blocks: FloatArray, G: FloatArray, B: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """State (3, 4, B) and blocks (6, 4, B) after an epoch; None where a block is singular.

    The epoch is G (3, 3, B or 1) and B (3, 4, B) of `squared_range.moments`, trials last.

    The information form: exact for vague priors.
    """
    precision = inverse(blocks)
    if precision is None:
        return None
    g00, g01, g02, g11, g12, g22 = information = np.empty((6, *B.shape[1:]))
    for c, (i, j) in enumerate(COMPONENTS):
        np.multiply(frame.share, G[i, j], out=information[c])
    new = inverse(precision + information)
    if new is None:
        return None
    e0 = B[0] - (g00 * x[0] + g01 * x[1] + g02 * x[2])
    e1 = B[1] - (g01 * x[0] + g11 * x[1] + g12 * x[2])
    e2 = B[2] - (g02 * x[0] + g12 * x[1] + g22 * x[2])
    posterior = np.empty((3, *e0.shape))
    for i, (a, b, c) in enumerate(((0, 1, 2), (1, 3, 4), (2, 4, 5))):
        np.add(x[i], new[a] * e0 + new[b] * e1 + new[c] * e2, out=posterior[i])
    return posterior, new


def inverse(blocks: FloatArray) -> FloatArray | None:
    """Inverses (6, ...) of symmetric blocks by ``L D L^T``, None where one is not positive."""
    p00, p01, p02, p11, p12, p22 = blocks
    result = np.empty(blocks.shape)
    if not p00.min(initial=math.inf) > 0:
        return None
    r0 = 1 / p00
    l10, l20 = p01 * r0, p02 * r0
    pivot = p11 - l10 * p01
    if not pivot.min(initial=math.inf) > 0:
        return None
    r1 = 1 / pivot
    rest = p12 - l20 * p01
    l21 = rest * r1
    pivot = p22 - l20 * p02 - l21 * rest
    if not pivot.min(initial=math.inf) > 0:
        return None
    r2 = np.divide(1, pivot, out=result[5])
    m20 = l10 * l21 - l20
    i02 = np.multiply(m20, r2, out=result[2])
    minus_l10 = -l10 * r1
    np.subtract(minus_l10, l21 * i02, out=result[1])
    i12 = np.multiply(-l21, r2, out=result[4])
    np.subtract(r1, l21 * i12, out=result[3])
    np.add(r0 - l10 * minus_l10, m20 * i02, out=result[0])
    return result
