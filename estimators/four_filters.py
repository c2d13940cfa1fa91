"""The 12-state Kalman filter as four filters of three states: exact for centred tags.

With V the principal axes of the tag layout, ``C^T C = V diag(lambda) V^T``, and the columns
``q'_m = sum_k V_km q_k``, an epoch of common weights tells ``lambda_m G`` about ``q'_m`` and
``N G`` about the translation, and nothing across; rotation and isotropic noise keep it so.

Inside, the trials are the last axis: the four blocks of the covariance are (3, 3, 4, B), the
state is (3, 4, B). The covariances that come out are the usual (..., 12, 12), laid out in
memory with the trials last. They are read-only, and their memory's owner remembers the blocks,
so that the next step need not look for them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

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
    return frame_of_centred(tags)


def frame_of_centred(tags: FloatArray) -> Frame:
    """Frame of tags (N, 3) about their centroid."""
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


class _Owner(np.ndarray):
    """The memory of a covariance (12, 12, ...) that was joined, and what it was joined from."""

    frame: Frame | None
    blocks: FloatArray | None

    def __array_finalize__(self, source: object) -> None:
        # A part of the memory is not what the blocks say.
        self.frame = self.blocks = None


def remembered(frame: Frame, covariance: FloatArray) -> FloatArray | None:
    """Blocks (3, 3, 4, B) that `join` made this whole covariance of; None of any other array."""
    owner = covariance.base
    # Of a slice or a copy the base is another array.
    if (
        isinstance(owner, _Owner)
        and owner.frame is frame
        and covariance.shape == owner.shape
        and covariance.strides == owner.strides
    ):
        return owner.blocks
    return None


def split(frame: Frame, covariance: FloatArray) -> FloatArray | None:
    """Blocks (3, 3, 4, B) of a covariance (..., 12, 12), None where it is not block-diagonal."""
    blocks = remembered(frame, covariance)
    if blocks is not None:
        return blocks
    last = np.moveaxis(covariance, (-2, -1), (0, 1)).reshape(12, 12, -1)
    cross = [last[:9, 9:]]
    if frame.aligned:
        cross += [last[:3, 3:9], last[3:6, 6:9]]
    if not all(_within(values, last) for values in cross):
        return None
    if frame.aligned:
        return _diagonal_blocks(last)
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
    return blocks


def join(frame: Frame, blocks: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    """Covariance (..., 12, 12) of blocks (3, 3, 4, B), read-only, trials last in memory."""
    n_trials = blocks.shape[-1]
    last = np.zeros((12, 12, n_trials))
    if frame.aligned:
        _diagonal_blocks(last)[:] = blocks
    else:
        turned = np.ascontiguousarray(blocks[:, :, :3].transpose(2, 0, 1, 3)).reshape(3, -1)
        rotation = (_mix(frame) @ turned).reshape(3, 3, 3, 3, n_trials)
        last.reshape(4, 3, 4, 3, n_trials)[:3, :, :3] = rotation.swapaxes(1, 2)
        last[9:, 9:] = blocks[:, :, 3]
    last.flags.writeable = False
    # An owner of an owner: the base of a view is the first array behind it of another type.
    moved = np.moveaxis(last.view(_Owner).reshape(12, 12, *batch), (0, 1), (-2, -1))
    owner = moved.view(_Owner)
    owner.frame, owner.blocks = frame, blocks
    return owner.view(np.ndarray)


def _diagonal_blocks(last: FloatArray) -> FloatArray:
    """View (3, 3, 4, B) of the blocks on the diagonal of (12, 12, B)."""
    return np.einsum("kikjb->ijkb", last.reshape(4, 3, 4, 3, -1))


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


def _is_zero(values: FloatArray) -> bool:
    """Whether all values are plus zero: as integers, which one pass tells."""
    return values.view(np.uint64).max(initial=0) == 0


def _within(cross: FloatArray, covariance: FloatArray) -> bool:
    """Whether terms across blocks are zero, exactly (mostly, and cheaply told) or to rounding."""
    if _is_zero(cross):
        return True
    allowed = np.minimum(_allowed(covariance[:9, :9]), _allowed(covariance[9:, 9:]))
    return bool((np.abs(cross) <= allowed).all())


def _allowed(covariance: FloatArray) -> FloatArray:
    return _ROUNDING * np.einsum("iib->ib", covariance).max(axis=0)


# --- the filters -----------------------------------------------------------------------------


def predict(
    x: FloatArray, blocks: FloatArray, step: FloatArray, shift: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """State (3, 4, B) and blocks (3, 3, 4, B) after a step of time.

    Parameters
    ----------
    x, blocks
        The state, and the blocks or (3, 3, 4, 1) where common.
    step, shift
        Rotation R (3, 3, B or 1) of the three columns, and shift (3, B or 1) of the translation.
    noise
        Variances (3, 4, 1) that are added, one for all entries of the rotation.
    """
    moved = np.empty((3, 4, max(x.shape[-1], step.shape[-1])))
    np.einsum("ijb,jkb->ikb", step, x[:, :3], out=moved[:, :3])
    np.add(x[:, 3], shift, out=moved[:, 3])
    new = np.empty((3, 3, 4, moved.shape[-1] if step.shape[-1] > 1 else blocks.shape[-1]))
    half = np.einsum("ijb,jlkb->ilkb", step, blocks[:, :, :3])
    np.einsum("ijkb,ljb->ilkb", half, step, out=new[:, :, :3])
    new[:, :, 3] = blocks[:, :, 3]
    for i in range(3):
        new[i, i] += noise[i]
        new[i, :i] = new[:i, i]
    return moved, new


def update(
    frame: Frame, x: FloatArray, blocks: FloatArray, G: FloatArray, B: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """State (3, 4, B) and blocks (3, 3, 4, B) after an epoch; None where a block is singular.

    The epoch is G (3, 3, B) and B (3, 4, B) of `squared_range.moments`, trials last.

    The information form: exact for vague priors.
    """
    precision = inverse(blocks)
    if precision is None:
        return None
    new = inverse(precision + frame.share * G[:, :, None])
    if new is None:
        return None
    innovation = np.einsum("ijb,jkb->ikb", G, x)
    innovation *= frame.share
    np.subtract(B, innovation, out=innovation)
    moved = np.einsum("ijkb,jkb->ikb", new, innovation)
    moved += x
    return moved, new


def inverse(blocks: FloatArray) -> FloatArray | None:
    """Inverses (3, 3, ...) of symmetric matrices by ``L D L^T``, None where one is not positive."""
    (p00, p01, p02), (_, p11, p12), (_, _, p22) = blocks
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
    r2 = np.divide(1, pivot, out=result[2, 2])
    m20 = l10 * l21 - l20
    i02 = np.multiply(m20, r2, out=result[0, 2])
    minus_l10 = -l10 * r1
    np.subtract(minus_l10, l21 * i02, out=result[0, 1])
    i12 = np.multiply(-l21, r2, out=result[1, 2])
    np.subtract(r1, l21 * i12, out=result[1, 1])
    np.add(r0 - l10 * minus_l10, m20 * i02, out=result[0, 0])
    for i in (1, 2):
        result[i, :i] = result[:i, i]
    return result
