"""The filter of 12 states on covariances of any form, trials last, for tags of common weights.

About the tags' centroid and on their principal axes (`four_filters.Frame`) an epoch is four
measurements of three numbers, each of one column: ``lambda_k G`` about the k-th. Whatever the
covariance, the update is four steps, one for each, with inverses of 3 x 3 matrices only:

    ``N_k = (P_kk^-1 + lambda_k G)^-1``,    ``N_mk = P_mk P_kk^-1 N_k``,
    ``N_mn = P_mn - N_mk lambda_k G P_kn``

The first two keep the digits of a vague prior; what the third loses is small to the prior of a
block that later steps replace.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.four_filters import Frame, frame_of_centred, inverse

# Variance that the rotation may bring to the centroid, over that of the translation.
_FAR = 1e6


class CentredFrame(NamedTuple):
    """The principal axes of any tag layout (N, 3) about its centroid (3,)."""

    centre: FloatArray
    frame: Frame


def centred_frame(tags: FloatArray) -> CentredFrame:
    """Centroid and principal axes of tags (N, 3)."""
    centre = tags.mean(axis=0)
    return CentredFrame(centre, frame_of_centred(tags - centre))


def predict(
    mean: FloatArray, P: FloatArray, step: FloatArray, shift: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance after ``x <- F x + [0; shift]``, ``P <- F P F^T + Q``, trials last.

    Parameters
    ----------
    mean, P
        (12, B) and (12, 12, B), or B = 1 where common.
    step, shift
        Rotation R (3, 3, B) of ``F = blkdiag(R, R, R, I)``, and (3, B).
    noise
        Diagonal (12,) of Q.
    """
    n_trials = max(mean.shape[-1], P.shape[-1], step.shape[-1])
    blocks = _Blocks(np.empty((4, 3, 4, 3, n_trials)))
    old = P.reshape(4, 3, 4, 3, -1)
    for m in range(3):
        half = np.einsum("ijb,jnkb->inkb", step, old[m])
        for n in range(m, 3):
            np.einsum("ijb,kjb->ikb", half[:, n], step, out=blocks[m, n])
        blocks[m, 3] = half[:, 3]
    blocks[3, 3] = old[3, :, 3]
    last = blocks.filled()
    np.einsum("iib->ib", last)[...] += noise[:, None]
    x = mean.reshape(4, 3, -1)
    moved = np.empty((4, 3, n_trials))
    np.einsum("ijb,kjb->kib", step, x[:3], out=moved[:3])
    np.add(x[3], shift, out=moved[3])
    return moved.reshape(12, -1), last


def update(
    tags: CentredFrame, mean: FloatArray, P: FloatArray, G: FloatArray, B: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Mean (12, B) and covariance (12, 12, B) after an epoch.

    None where a block is singular, or where the way to the centroid and back would cost digits:
    a rotation that is vague beside the translation, tags far from their origin. The epoch is
    G (3, 3, B) and B (3, 4, B) of `squared_range.moments`, of the tags of the frame, trials
    last.
    """
    x = mean.reshape(4, 3, -1).copy()
    if tags.centre.any():
        variance = np.einsum("iib->ib", P)
        reach = (tags.centre**2).sum() * variance[:9].max(axis=0)
        if (reach > _FAR * variance[9:].min(axis=0)).any():
            return None
    blocks = _Blocks(P.reshape(4, 3, 4, 3, -1).copy())
    _move(blocks, x, tags.centre)
    if not tags.frame.aligned:
        _turn(blocks, x, tags.frame.axes.T)
    for k in range(4):
        told = tags.frame.share[k] * G
        precision = inverse(blocks[k, k])
        if precision is None:
            return None
        new = inverse(precision + told)
        if new is None:
            return None
        shrink = np.einsum("ijb,jkb->ikb", precision, new)
        others = [m for m in range(4) if m != k]
        cross = {m: np.einsum("ijb,jkb->ikb", blocks[m, k], shrink) for m in others}
        for n in others:
            seen = np.einsum("ijb,kjb->ikb", told, blocks[n, k])
            for m in others:
                if m <= n:
                    blocks[m, n] -= np.einsum("ijb,jkb->ikb", cross[m], seen)
        innovation = B[:, k] - np.einsum("ijb,jb->ib", told, x[k])
        for m in others:
            blocks[m, k] = cross[m]
            x[m] += np.einsum("ijb,jb->ib", cross[m], innovation)
        blocks[k, k] = new
        x[k] += np.einsum("ijb,jb->ib", new, innovation)
    if not tags.frame.aligned:
        _turn(blocks, x, tags.frame.axes)
    _move(blocks, x, -tags.centre)
    return x.reshape(12, -1), blocks.filled()


class _Blocks:
    """The 3 x 3 blocks (m, n) of symmetric (4, 3, 4, 3, B): only those with m <= n are kept."""

    def __init__(self, array: FloatArray) -> None:
        self.array = array

    def __getitem__(self, which: tuple[int, int]) -> FloatArray:
        m, n = which
        return self.array[m, :, n] if m <= n else self.array[n, :, m].swapaxes(0, 1)

    def __setitem__(self, which: tuple[int, int], value: FloatArray) -> None:
        self[which][...] = value

    def filled(self) -> FloatArray:
        """All of the matrix (12, 12, B), the half below the diagonal from the half above it."""
        last = self.array.reshape(12, 12, -1)
        for i in range(1, 12):
            last[i, :i] = last[:i, i]
        return last


def _move(blocks: _Blocks, x: FloatArray, by: FloatArray) -> None:
    """State and covariance, in place, of the point that stands `by` (3,) off the tracked one."""
    columns = [k for k in range(3) if by[k] != 0]
    for k in columns:
        x[3] += by[k] * x[k]
        blocks[3, 3] += by[k] * blocks[3, k]
    for k in columns:
        for m in range(3):
            blocks[m, 3] += by[k] * blocks[m, k]
    for k in columns:
        blocks[3, 3] += by[k] * blocks[k, 3]


def _turn(blocks: _Blocks, x: FloatArray, axes: FloatArray) -> None:
    """State and covariance, in place, with the columns ``q'_m = sum_k axes_mk q_k``."""
    n_trials = x.shape[-1]
    x[:3] = (axes @ x[:3].reshape(3, -1)).reshape(3, 3, n_trials)
    across = np.stack([blocks[m, 3] for m in range(3)])
    blocks.array[:3, :, 3] = (axes @ across.reshape(3, -1)).reshape(3, 3, 3, n_trials)
    rotation = np.stack([blocks[m, n] for m in range(3) for n in range(3)])
    mix = (axes[:, None, :, None] * axes[None, :, None, :]).reshape(9, 9)
    turned = (mix @ rotation.reshape(9, -1)).reshape(3, 3, 3, 3, n_trials)
    blocks.array[:3, :, :3] = turned.swapaxes(1, 2)
