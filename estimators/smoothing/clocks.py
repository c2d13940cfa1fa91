"""Drifting clocks in the smoother: each clock has an offset and a drift at every epoch."""

from __future__ import annotations

import numpy as np

from rbl_gym.bounds.smoothing import LEAST_STD
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.smoothing.equations import Equations, LogState, Rows
from rbl_gym.estimators.smoothing.ranges import BiasBlock
from rbl_gym.measurements import offsets
from rbl_gym.measurements.offsets import Clock


def clock_block(law: Clock, shape: tuple[int, int], extra: int) -> BiasBlock:
    """Return the bias block of the clock offsets of (M, N) links.

    `extra` is the number of extra states of an epoch that precede the offsets. The drifts follow
    the offsets.
    """
    group = offsets.columns(law.offset, *shape).argmax(axis=-1)
    size = int(group.max()) + 1
    return BiasBlock(slice(extra, extra + size), group, law.std_m, np.inf)


def first_offsets(gaps: FloatArray, there: BoolArray, offset: str) -> tuple[FloatArray, FloatArray]:
    """Return clock offsets (..., K, G), and the first of each (..., G).

    They are medians of `gaps` (..., K, M, N), ranges less distances. An epoch without ranges of a
    clock gets the first offset of that clock.
    """
    found = offsets.median(gaps, there, offset)
    found = found.reshape((*found.shape[:-2], -1))
    heard = there.any(axis=offsets.axes_of(offset), keepdims=True).reshape(found.shape)
    where = heard.argmax(axis=-2)[..., None, :]
    first = np.take_along_axis(found, where, axis=-2)
    return np.where(heard, found, first), first[..., 0, :]


def add_clocks(
    equations: Equations,
    block: BiasBlock,
    law: Clock,
    mean: FloatArray,
    state: LogState,
    times: FloatArray,
) -> None:
    """Add the prior of the clocks, with offsets about a mean (..., G), and their motion in time."""
    size, n = block.where.stop - block.where.start, 6 + state.extra.shape[-1]
    offset, drift = (
        slice(block.where.start + k * size, block.where.stop + k * size) for k in range(2)
    )
    o, d = state.extra[..., offset], state.extra[..., drift]
    at = [slice(6 + where.start, 6 + where.stop) for where in (offset, drift)]
    equations.add_prior(at[0], o[..., 0, :] - mean, np.asarray(law.std_m))
    equations.add_prior(at[1], d[..., 0, :], np.asarray(law.drift_m_s))
    dt = np.diff(times)[..., None]
    # Cholesky factor [[a, 0], [b, c]] of the covariance of offset and drift.
    walk, wander = law.walk_m**2, law.drift_walk_m_s**2
    a = np.sqrt(walk * dt + wander * dt**3 / 3 + LEAST_STD**2)
    b = wander * dt**2 / 2 / a
    c = np.sqrt(np.maximum(wander * dt - b**2, 0.0) + LEAST_STD**2)
    A, B = (np.zeros((*o.shape[:-2], o.shape[-2] - 1, 2 * size, n)) for _ in range(2))
    first, second = np.arange(size), np.arange(size, 2 * size)
    places = [np.arange(where.start, where.stop) for where in at]
    residual = np.concatenate(
        [np.diff(o, axis=-2) - dt * d[..., :-1, :], np.diff(d, axis=-2)], axis=-1
    )
    A[..., first, places[0]], A[..., first, places[1]] = -1.0, -dt
    A[..., second, places[1]] = -1.0
    B[..., first, places[0]] = B[..., second, places[1]] = 1.0
    for rows, wide in ((residual, ()), (A, (None,)), (B, (None,))):
        axis = -1 - len(wide)
        upper, lower = np.split(rows, 2, axis=axis)
        scale = [x[(..., *wide)] for x in (a, b, c)]
        upper /= scale[0]
        lower -= scale[1] * upper
        lower /= scale[2]
    equations.add(Rows(residual, A, B))
