"""Convert time differences and pseudo-ranges to ranges with a common unknown offset.

A difference ``d(anchor_a, tag) - d(anchor_b, tag)`` compares two arrival times. All differences of
a tag at one time determine the arrival times up to one common unknown length: pseudo-ranges. The
noise of a reference anchor, which all differences to it share, becomes the noise of its own
pseudo-range. The common level is arbitrary; it is set to that of a body at the centre of the
anchors.
"""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.measurements import offsets
from rbl_gym.recordings.format import Format
from rbl_gym.recordings.measured import Measured, id_columns, ids_of, judge, measured_of, scale_of
from rbl_gym.recordings.points import Points
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import Ids, IntArray, Table

# Pseudo-ranges of a tag may differ by the distance of its anchors and this margin (m).
_NOISE_M = 5.0
_MOST_TOO_LONG = 0.2


def read_differences(
    table: Table, anchors: Points | None, tags: Points | None, format: Format, said: Said
) -> tuple[Measured, IntArray, Ids]:
    """Read the differences of a table ``t,anchor_a,anchor_b,tag,difference[,std or var]``.

    Returned are the differences, assigned to `anchor_a`; the second anchor of each; ids of anchors
    and tags. ValueError if columns are missing, or the anchor positions are not given.
    """
    table.require("t", "anchor_a", "anchor_b", *id_columns(tag=tags), "difference")
    if anchors is None:
        raise ValueError(
            f"{table.path}: give the positions of the anchors (--anchors), which time differences "
            "need"
        )
    ids = anchors.ids, ids_of(table, "tag", tags)
    scale = scale_of(table, "difference", format, said)
    first, other = (table.positions(name, ids[0]) for name in ("anchor_a", "anchor_b"))
    tag = table.positions("tag", ids[1]) if "tag" in table.columns else np.zeros_like(first)
    measured = measured_of(table, "difference", first, tag, scale)
    read = "t", "anchor_a", "anchor_b", "difference", "tag", "run", "valid"
    said.read(table, {*read, *measured.std_columns})
    measured.drop(other < 0, "to an unknown anchor")
    measured.drop((first == other) & (first >= 0), "of an anchor to itself")
    judge(measured, table, signed=True)
    return measured, other, ids


def mark_double_differences(measured: Measured, other: IntArray, epoch: IntArray) -> None:
    """Find pairs (R,) of anchors that occur twice for a tag at one time, in either order."""
    used = np.flatnonzero(measured.cause == 0)
    low, high = np.minimum(measured.anchor, other), np.maximum(measured.anchor, other)
    keys = np.stack([epoch, measured.tag, low, high], axis=1)[used]
    first = np.unique(keys, axis=0, return_index=True)[1]
    again = np.zeros(len(epoch), dtype=bool)
    again[np.delete(used, first)] = True
    measured.drop(again, "twice with two values")


def pseudo_ranges(
    measured: Measured, other: IntArray, epoch: IntArray, shape: tuple[int, int, int]
) -> tuple[FloatArray, BoolArray, FloatArray | None, int]:
    """Return pseudo-ranges (K, M, N), their mask, standard deviations, and how many were dropped.

    They are the least-squares solution for the differences of a tag at one time. If the differences
    form several unconnected groups, the largest is used. A difference has the variance of two
    arrival times.
    """
    ranges, links = np.zeros(shape), np.zeros(shape, dtype=np.bool_)
    std = None if measured.std is None else np.zeros(shape)
    used = np.flatnonzero(measured.cause == 0)
    order = used[np.lexsort((measured.tag[used], epoch[used]))]
    key = epoch[order] * shape[2] + measured.tag[order]
    lost = 0
    for rows in np.split(order, np.flatnonzero(np.diff(key)) + 1):
        a, b = measured.anchor[rows], other[rows]
        part = _largest_part(a, b, shape[1])
        kept = part[a]
        lost += int((~kept).sum())
        rows, a, b = rows[kept], a[kept], b[kept]
        here = np.flatnonzero(part)
        H = (a[:, None] == here).astype(float) - (b[:, None] == here)
        k, n = epoch[rows[0]], measured.tag[rows[0]]
        ranges[k, here, n] = np.linalg.lstsq(H, measured.range[rows], rcond=None)[0]
        links[k, here, n] = True
        if std is not None and measured.std is not None:
            half = measured.std[rows] ** 2 / 2
            count = np.abs(H).sum(axis=0)
            std[k, here, n] = np.sqrt(np.abs(H).T @ half / count)
    return ranges, links, std, lost


def _largest_part(a: IntArray, b: IntArray, anchors: int) -> BoolArray:
    """Return the anchors (M,) of the group connected by the most differences."""
    label = np.arange(anchors)
    while True:
        least = label.copy()
        np.minimum.at(least, a, label[b])
        np.minimum.at(least, b, least[a])
        if (least == label).all():
            break
        label = least
    return np.asarray(label == label[a[np.argmax(np.bincount(label[a])[label[a]])]])


def leveled(ranges: FloatArray, links: BoolArray, anchors: FloatArray, offset: str) -> FloatArray:
    """Shift pseudo-ranges (K, M, N) to the level of a body at the centre of anchors (K, M, 3)."""
    distance = np.linalg.norm(anchors - anchors.mean(axis=-2, keepdims=True), axis=-1)
    gap = np.where(links, distance[..., None] - ranges, 0.0)
    shift = offsets.common(gap, links.astype(np.float64), offset)
    return np.where(links, ranges + shift, 0.0)


def check_lengths(
    path: str, ranges: FloatArray, links: BoolArray, points: FloatArray, offset: str
) -> None:
    """Raise ValueError if ranges with an offset differ by more than the distance of their points.

    `points` (K or 1, M, 3) are the anchors or, for one offset per anchor, the tags (1, N, 3).
    """
    axis = -1 if offset == "anchor" else -2
    low = np.where(links, ranges, np.inf).min(axis=axis)
    high = np.where(links, ranges, -np.inf).max(axis=axis)
    extent = np.linalg.norm(np.ptp(points, axis=-2), axis=-1)[:, None]
    there = links.sum(axis=axis) > 1
    too_long = there & (high - low > 1.5 * extent + _NOISE_M)
    if too_long.sum() > _MOST_TOO_LONG * max(there.sum(), 1):
        raise ValueError(
            f"{path}: units look inconsistent, ranges of one {'anchor' if axis == -1 else 'tag'} "
            f"differ by {np.median((high - low)[too_long]):.4g} m (median), but the "
            f"{'tags' if axis == -1 else 'anchors'} are only {extent.max():.4g} m apart: are they "
            f"in the unit of the ranges? is the offset really one for each {offset}?"
        )
