"""Model unknown offsets of ranges: pseudo-ranges, and time differences of arrival.

All ranges of a tag share one unknown offset if its clock runs free or its time of transmission is
unknown (uplink TDoA). All ranges of an anchor do if it is not synchronised with the others. With
passive receivers, all ranges of an epoch do. A white offset is independent at every epoch. For a
group of ranges ``r = d + c + noise`` with weights w, the most likely offset is the weighted mean
of ``r - d``. The remaining information is ``J^T (W - W 1 1^T W / 1^T W 1) J``: derivatives minus
their weighted mean. A time difference to a reference anchor is the difference of two such ranges.
The noise of the reference, which all differences share, is thereby treated correctly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, check_number, check_one_of

__all__ = ["OFFSETS", "Clock", "centred", "common"]

# The axes of (..., M, N) along which ranges share one offset.
_AXES = {"tag": (-2,), "anchor": (-1,), "epoch": (-2, -1)}
OFFSETS = tuple(_AXES)


@dataclass(frozen=True)
class Clock:
    """Law of clock offsets with drift, in metres of range (0.3 m are a nanosecond).

    Parameters
    ----------
    offset
        One clock for each ``"tag"``, for each ``"anchor"``, or one for all (``"epoch"``).
    std_m, drift_m_s
        Initial standard deviations: of the offset about the estimate from the first ranges, and of
        its drift (one part in 10^8 is 3 m/s).
    walk_m, drift_walk_m_s
        Random walks of offset and drift: standard deviations after 1 s.
    """

    offset: str = "tag"
    std_m: float = 100.0
    drift_m_s: float = 3.0
    walk_m: float = 0.1
    drift_walk_m_s: float = 0.1

    def __post_init__(self) -> None:
        check_one_of("offset", self.offset, OFFSETS)
        for name in ("std_m", "drift_m_s"):
            check_number(name, getattr(self, name), low=1e-6, high=1e4)
        for name in ("walk_m", "drift_walk_m_s"):
            check_number(name, getattr(self, name), low=0.0)

    def transition(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return F and Q (2, 2) of offset and drift over `dt` seconds."""
        walk, wander = self.walk_m**2, self.drift_walk_m_s**2
        Q = [
            [walk * dt + wander * dt**3 / 3, wander * dt**2 / 2],
            [wander * dt**2 / 2, wander * dt],
        ]
        return np.array([[1.0, dt], [0.0, 1.0]]), np.array(Q)


def check_offset(offset: str | None) -> str | None:
    """Return a valid kind of offset, None for no offset; raise ValueError for other values."""
    if offset is not None:
        check_one_of("offset", offset, OFFSETS)
    return offset


def code_of(offset: str | None) -> int:
    """Return the code of the kind in kernels: 0 for none, 1 by tag, 2 by anchor, 3 by epoch."""
    return 0 if offset is None else 1 + OFFSETS.index(offset)


def name_of(code: int) -> str | None:
    """Return the kind of a code; inverse of `code_of`."""
    return (None, *OFFSETS)[int(code)]


def group_shape(offset: str, anchors: int, tags: int) -> tuple[int, int]:
    """Return the shape of the offsets of one epoch: (1, N), (M, 1) or (1, 1), as of (M, N)."""
    return {"tag": (1, tags), "anchor": (anchors, 1), "epoch": (1, 1)}[offset]


def common(values: FloatArray, weights: FloatArray, offset: str) -> FloatArray:
    """Return the weighted means of groups of values (..., M, N); 0 if a group has no weight.

    Parameters
    ----------
    values, weights
        (..., M, N), which broadcast.
    offset
        One of `OFFSETS`: which values form a group.

    Returns
    -------
    (..., 1, N), (..., M, 1) or (..., 1, 1).
    """
    axes = _AXES[offset]
    total = weights.sum(axis=axes, keepdims=True)
    return (weights * values).sum(axis=axes, keepdims=True) / np.where(total > 0, total, 1.0)


def centred(values: FloatArray, weights: FloatArray, offset: str) -> FloatArray:
    """Return values (..., M, N) minus the weighted mean of their group; arguments: see `common`."""
    return values - common(values, weights, offset)


def median(values: FloatArray, there: BoolArray, offset: str) -> FloatArray:
    """Return the medians of groups of the valid values (..., M, N); the lower one of two."""
    axes = axes_of(offset)
    values, there = np.broadcast_arrays(values, there)
    ordered = np.where(there, values, np.inf)
    if offset == "epoch":
        ordered = ordered.reshape((*ordered.shape[:-2], 1, -1))
        axes = (-1,)
    ordered = np.sort(ordered, axis=axes[0])
    count = there.sum(axis=axes_of(offset), keepdims=True)
    found = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=axes[0])
    return np.where(count > 0, found, 0.0)


def columns(offset: str, anchors: int, tags: int) -> FloatArray:
    """Return the incidence matrix (M N, G) of links and offsets: ones and zeros."""
    shape = group_shape(offset, anchors, tags)
    group = np.broadcast_to(np.arange(shape[0] * shape[1]).reshape(shape), (anchors, tags))
    return np.eye(shape[0] * shape[1])[group.ravel()]


def axes_of(offset: str) -> tuple[int, ...]:
    """Return the axes of (..., M, N) along which links form one group."""
    return _AXES[offset]


def paired(links: BoolArray, offset: str) -> BoolArray:
    """Return which links (..., M, N) share their offset; single ones give no information."""
    return np.asarray(links & (links.sum(axis=_AXES[offset], keepdims=True) > 1))
