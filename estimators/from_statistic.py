"""Updates of the 12-state filters from an epoch's statistic alone: G and B, no ranges.

See `squared_range` for the two and `rbl_gym.statistic` for where they come from.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.estimators import four_filters
from rbl_gym.estimators.engines import FEW_TRIALS, FilterPy, information_update
from rbl_gym.estimators.four_filters import Frame
from rbl_gym.estimators.inputs import VAGUE_ENTRY_VARIANCE, matrix_rank
from rbl_gym.estimators.shared_covariance import shared, spread_out
from rbl_gym.estimators.squared_range import Statistic, extended, information_of_moments

# Rounding that a symmetric semidefinite matrix may show, relative to its diagonal.
_ROUNDING = 1e-9


class StatisticEpoch(NamedTuple):
    """One epoch of checked G (..., 3, 3) and B (..., 3, 4), and the tags (N, 3) it is of."""

    G: FloatArray
    B: FloatArray
    tags: FloatArray

    def statistic(self) -> Statistic:
        """The statistic of `squared_range`: of all b that make this B, the smallest."""
        pull = np.linalg.pinv(extended(self.tags), rcond=1e-9)
        return Statistic(self.G[..., None, :, :], np.swapaxes(self.B @ pull, -1, -2), self.tags)

    def information(self) -> tuple[FloatArray, FloatArray]:
        """Information matrix (..., 12, 12) and vector (..., 12), those of the statistic."""
        G, B = (
            np.moveaxis(array, (-2, -1), (0, 1)).reshape(*array.shape[-2:], -1)
            for array in (self.G, self.B)
        )
        matrix, vector = information_of_moments(G, B, extended(self.tags))
        return (
            matrix.reshape(*self.G.shape[:-2], 12, 12),
            vector.reshape(*self.B.shape[:-2], 12),
        )


def check_statistic(G: ArrayLike, B: ArrayLike, tags: FloatArray) -> StatisticEpoch:
    """An epoch of a statistic, or a ValueError: shapes, NaN, a G that is no information."""
    G, B = check_array("G", G, (3, 3)), check_array("B", B, (3, 4))
    try:
        np.broadcast_shapes(G.shape[:-2], B.shape[:-2])
    except ValueError:
        raise ValueError(f"G and B must have one batch, got {G.shape} and {B.shape}") from None
    g = np.moveaxis(G, (-2, -1), (0, 1))
    scale = np.abs(g).max(axis=(0, 1))
    if (np.abs(g - g.swapaxes(0, 1)).max(axis=(0, 1)) > _ROUNDING * scale).any():
        raise ValueError("G must be symmetric")
    # Positive semidefinite is: no principal minor below zero.
    pairs = [(i, j, g[i, i] * g[j, j] - g[i, j] ** 2) for i, j in ((0, 1), (0, 2), (1, 2))]
    determinant = g[2, 2] * pairs[0][2] - (
        g[0, 0] * g[1, 2] ** 2 - 2 * g[0, 1] * g[0, 2] * g[1, 2] + g[1, 1] * g[0, 2] ** 2
    )
    minors = [g[i, i] >= -_ROUNDING * scale for i in range(3)]
    minors += [minor >= -_ROUNDING * scale**2 for *_, minor in pairs]
    if not (np.all(minors) and (determinant >= -_ROUNDING * scale**3).all()):
        raise ValueError("G must be positive semidefinite")
    return StatisticEpoch(G, B, np.asarray(tags, dtype=np.float64))


def check_informed(covariance: FloatArray, epoch: StatisticEpoch) -> None:
    """A ValueError where the epoch has not rank 12 and the rotation's prior says nothing."""
    common = shared(covariance)
    variance = np.diagonal(covariance if common is None else common, axis1=-2, axis2=-1)
    vague = variance[..., :9].max(axis=-1) > VAGUE_ENTRY_VARIANCE
    if not vague.any():
        return
    size = np.abs(epoch.tags).max()
    rank = matrix_rank(epoch.G) * matrix_rank(extended(epoch.tags / (size if size > 0 else 1.0)))
    if ((rank < 12) & vague).any():
        raise ValueError(
            f"G and the tags determine only rank {int(rank.min())} of the filter's 12 states, and "
            "the prior is too vague to stand in. Use a tighter prior covariance"
        )


def update(
    mean: FloatArray, P: FloatArray, epoch: StatisticEpoch, frame: Frame | None, engine: str
) -> tuple[FloatArray, FloatArray]:
    """Mean (..., 12) and covariance (..., 12, 12) after an epoch: `engines` from a statistic."""
    if engine == "filterpy":
        if epoch.G.ndim != 2 or epoch.B.ndim != 2:
            raise ValueError(f"G and B must be of one body for filterpy, got {epoch.B.shape}")
        # Of an epoch filterpy's engine asks for the statistic, and no more.
        return FilterPy.update(mean, P, epoch, frame)  # pyright: ignore[reportArgumentType]
    batch = np.broadcast_shapes(mean.shape[:-1], epoch.G.shape[:-2], epoch.B.shape[:-2])
    common = shared(P)
    if common is not None and epoch.G.ndim == 2:
        mean, P = information_update(mean, common, *epoch.information())
        return np.broadcast_to(mean, (*batch, 12)), spread_out(P, batch)
    if frame is not None and math.prod(batch) >= FEW_TRIALS:
        posterior = _four_filters(frame, mean, P if common is None else common, epoch, batch)
        if posterior is not None:
            return posterior
    return information_update(mean, P, *epoch.information())


def _four_filters(
    frame: Frame, mean: FloatArray, P: FloatArray, epoch: StatisticEpoch, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray] | None:
    """The update by `four_filters`, None where the state has not that structure."""
    if P.ndim > 2 and P.shape[:-2] != batch:
        P = np.broadcast_to(P, (*batch, 12, 12))
    blocks = four_filters.split(frame, P)
    if blocks is None:
        return None
    B = epoch.B
    if not frame.aligned:
        B = np.concatenate([B[..., :3] @ frame.axes, B[..., 3:]], axis=-1)
    # Contiguous copies, so that every step of the filters runs along memory.
    G, B = (
        np.ascontiguousarray(np.moveaxis(array, (-2, -1), (0, 1))).reshape(*array.shape[-2:], -1)
        for array in (
            epoch.G if epoch.G.ndim == 2 else np.broadcast_to(epoch.G, (*batch, 3, 3)),
            np.broadcast_to(B, (*batch, 3, 4)),
        )
    )
    x = four_filters.split_mean(frame, np.broadcast_to(mean, (*batch, 12)))
    posterior = four_filters.update(frame, x, blocks, G, B)
    if posterior is None:
        return None
    return (
        four_filters.join_mean(frame, posterior[0], batch),
        four_filters.join(frame, posterior[1], batch),
    )
