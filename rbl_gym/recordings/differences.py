"""Logs of time differences and of pseudo-ranges, as ranges with an unknown offset in common.

A difference ``d(anchor_a, tag) - d(anchor_b, tag)`` is that of two arrivals. All differences of a
tag at one time give back the arrivals but for one unknown length, which they share: pseudo-ranges.
The noise of a reference anchor, which all differences to it have in common, is that of its own
pseudo-range then. Their level means nothing; it is set to that of a body at the anchors' centre.
"""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.measurements import offsets
from rbl_gym.recordings.format import Format
from rbl_gym.recordings.measured import Measured, ids_of, judge, scale_of
from rbl_gym.recordings.points import Points
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import Ids, IntArray, Table

# Pseudo-ranges of a tag may differ by no more than its anchors are apart, and so much (m).
_NOISE_M = 5.0
_MOST_TOO_LONG = 0.2


def read_differences(
    table: Table, anchors: Points | None, tags: Points | None, format: Format, said: Said
) -> tuple[Measured, IntArray, Ids]:
    """The differences of a table ``t,anchor_a,anchor_b,tag,difference[,std or var]``.

    Returns
    -------
    The differences, as of `anchor_a`; which anchor each is to; ids of anchors and tags.

    Raises
    ------
    ValueError
        If columns are missing, or the anchors' places are nowhere told.
    """
    table.require("t", "anchor_a", "anchor_b", "difference")
    if anchors is None:
        raise ValueError(f"{table.path}: differences need a table of anchors")
    read = {"t", "anchor_a", "anchor_b", "difference", "tag", "run"}
    ids = anchors.ids, ids_of(table, "tag", tags)
    scale = scale_of(table, "difference", format, said)
    values = scale * table.numbers("difference", may_be_missing=True)
    first, other = (table.positions(name, ids[0]) for name in ("anchor_a", "anchor_b"))
    none = np.zeros(len(values), dtype=np.intp)
    tag = table.positions("tag", ids[1]) if "tag" in table.columns else none
    std, column = None, next((c for c in ("std", "var") if c in table.columns), "")
    if column:
        read.add(column)
        std = table.numbers(column, may_be_missing=True)
        with np.errstate(invalid="ignore"):
            std = scale * (np.sqrt(std) if column == "var" else std)
    rows = np.arange(len(values))
    measured = Measured(rows, none, first, tag, values, std, none.copy(), ["difference"], [column])
    if "valid" in table.columns:
        read.add("valid")
        valid = table.numbers("valid")
        table.check(np.isin(valid, (0, 1)), "valid", "must be 0 or 1")
        measured.drop(valid == 0, "marked as not valid")
    said.read(table, read)
    measured.drop(other < 0, "to an unknown anchor")
    measured.drop((first == other) & (first >= 0), "of an anchor to itself")
    judge(measured, table, signed=True)
    return measured, other, ids


def mark_double_differences(measured: Measured, other: IntArray, epoch: IntArray) -> None:
    """Find pairs (R,) of anchors that come twice for a tag at one time, in either order."""
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
    """Pseudo-ranges (K, M, N), which there are, their deviations, and how many had to go.

    Least squares of the differences of a tag at one time. Where some hang together with none of
    the others, the larger part is taken. A difference has the variance of two arrivals.
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
    """Which anchors (M,) the most differences hang together with."""
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
    """Pseudo-ranges (K, M, N) of a body at the anchors' centre, on average; anchors (K, M, 3)."""
    distance = np.linalg.norm(anchors - anchors.mean(axis=-2, keepdims=True), axis=-1)
    gap = np.where(links, distance[..., None] - ranges, 0.0)
    shift = offsets.common(gap, links.astype(np.float64), offset)
    return np.where(links, ranges + shift, 0.0)


def check_lengths(
    path: str, ranges: FloatArray, links: BoolArray, points: FloatArray, offset: str
) -> None:
    """A ValueError where ranges with an offset differ by more than their points are apart.

    `points` (K or 1, M, 3) are the anchors, or for an offset by anchor the tags (1, N, 3).
    """
    axis = -1 if offset == "anchor" else -2
    low = np.where(links, ranges, np.inf).min(axis=axis)
    high = np.where(links, ranges, -np.inf).max(axis=axis)
    extent = np.linalg.norm(np.ptp(points, axis=-2), axis=-1)[:, None]
    there = links.sum(axis=axis) > 1
    too_long = there & (high - low > 1.5 * extent + _NOISE_M)
    if too_long.sum() > _MOST_TOO_LONG * max(there.sum(), 1):
        raise ValueError(
            f"{path}: units look inconsistent, ranges with an offset in common differ by "
            f"{np.median((high - low)[too_long]):.4g} m and the points they are of are at most "
            f"{extent.max():.4g} m apart (another unit? another kind of offset?)"
        )
