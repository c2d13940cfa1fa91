"""Convert tables of ranges to arrays over epochs and links."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.recordings.differences import (
    check_lengths,
    leveled,
    mark_double_differences,
    pseudo_ranges,
    read_differences,
)
from rbl_gym.recordings.format import Format
from rbl_gym.recordings.measured import Measured, mark_doubles, read_measured, settle
from rbl_gym.recordings.points import Points, moving
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import IntArray, Table

# Rows that are late by more than this are not sorted (s).
_LATE_S = 1.0


class Log(NamedTuple):
    """Times (K,), ranges (K, M, N), 0 without a link, their standard deviations, anchors and tags.

    `offset`: which ranges share an unknown offset.
    """

    times: FloatArray
    ranges: FloatArray
    links: BoolArray
    range_std: FloatArray | None
    anchors: Points
    anchor_places: FloatArray  # (K, M, 3)
    tags: Points
    offset: str | None = None


def read_log(
    table: Table, anchors: Points | None, tags: Points | None, format: Format, said: Said
) -> Log:
    """Read the ranges of a table, long or wide.

    Without a table of anchors, their positions are columns of the table. Without a table of tags,
    there is one tag, at the origin of the body frame. ValueError as in
    `rbl_gym.recordings.read_recording`.
    """
    if format.strict and table.cut:
        raise ValueError(f"{table.path}, line {table.cut}: the last line is cut off")
    other = None
    if "difference" in table.columns:
        if format.offset not in (None, "tag"):
            raise ValueError(
                f"{table.path}: offset must be None or 'tag' for time differences, got "
                f"{format.offset!r}"
            )
        measured, other, ids = read_differences(table, anchors, tags, format, said)
    else:
        measured, ids = read_measured(table, anchors, tags, format, said)
    times, note = table.seconds(format.time_unit)
    said.note(table.path, note)
    _sort(measured, table, times, format, said)
    if anchors is None:
        anchors, at = _anchors_beside(table, measured, ids[0], times, said)
        ids = anchors.ids, ids[1]
        measured = measured._replace(anchor=at)
    if tags is None:
        tags = Points(ids[1], np.zeros((1, 3)))
    known = anchors.at(times)[1][measured.row, measured.anchor]
    measured.drop(~known, "of an anchor without a position at that time")
    epochs, epoch = np.unique(times[measured.row], return_inverse=True)
    if other is None:
        mark_doubles(measured, epoch)
    else:
        known = anchors.at(times)[1][measured.row, other]
        measured.drop(~known, "of an anchor without a position at that time")
        mark_double_differences(measured, other, epoch)
    settle(measured, table, ids, format, said)
    used = measured.cause == 0
    if not used.any():
        raise ValueError(f"{table.path}: must have at least one usable range, got none")
    shape = len(epochs), len(ids[0]), len(ids[1])
    places = anchors.at(epochs)[0]
    if other is not None:
        ranges, links, std, lost = pseudo_ranges(measured, other, epoch, shape)
        if lost:
            said.drop("of anchors without a connection to the others", lost)
            said.note(
                table.path,
                f"{lost} time differences are left out, as no difference connects their anchors to "
                "the others",
            )
        return _leveled(Log(epochs, ranges, links, std, anchors, places, tags, "tag"), table)
    cells = epoch[used], measured.anchor[used], measured.tag[used]
    ranges, links = np.zeros(shape), np.zeros(shape, dtype=np.bool_)
    ranges[cells], links[cells] = measured.range[used], True
    std = None
    if measured.std is not None:
        std = np.zeros_like(ranges)
        std[cells] = measured.std[used]
    log = Log(epochs, ranges, links, std, anchors, places, tags, format.offset)
    return log if format.offset is None else _leveled(log, table)


def _leveled(log: Log, table: Table) -> Log:
    """Return ranges with common offsets at an arbitrary level; raise if units do not fit."""
    assert log.offset is not None
    points = log.tags.places[None] if log.offset == "anchor" else log.anchor_places
    check_lengths(table.path, log.ranges, log.links, points, log.offset)
    return log._replace(ranges=leveled(log.ranges, log.links, log.anchor_places, log.offset))


def _sort(measured: Measured, table: Table, times: FloatArray, format: Format, said: Said) -> None:
    """Sort and count late rows; raise if `strict`, or if they are late by more than 1 s."""
    late = np.maximum.accumulate(times) - times
    allowed = 0.0 if format.strict else _LATE_S
    table.check(
        late <= allowed + 1e-9,
        "t",
        f"time must not decrease by more than {allowed:g} s from row to row (several runs in one "
        "file need a column run; if the unit is wrong, set --time-unit)",
    )
    if count := int((late > 0).sum()):
        said.sorted_rows += count
        said.note(table.path, f"{count} rows come after later ones and are sorted by time")


def _anchors_beside(
    table: Table, measured: Measured, ids: tuple[str, ...], times: FloatArray, said: Said
) -> tuple[Points, IntArray]:
    """Return the anchors whose positions are columns of the table, and the anchor of each range."""
    axes = ["ax", "ay", *(["az"] if "az" in table.columns else [])]
    if len(axes) == 2:
        said.note(table.path, "there is no column az, so the heights of the anchors are 0")
    places = np.pad(table.points(axes), ((0, 0), (0, 3 - len(axes))))
    anchor = measured.anchor
    if "anchor" not in table.columns:
        distinct, anchor = np.unique(places, axis=0, return_inverse=True)
        anchor = anchor.reshape(-1)
        ids = tuple(" ".join(f"{x:g}" for x in place) for place in distinct)
        if len(set(ids)) < len(ids):
            ids = tuple(map(str, range(len(distinct))))
    tracks = []
    for i in range(len(ids)):
        rows = np.flatnonzero(anchor == i)
        at, first = np.unique(times[rows], return_index=True)
        tracks.append((at, places[rows[first]]))
    return moving(ids, tuple(tracks)), anchor
