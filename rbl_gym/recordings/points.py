"""Read tables of anchors and tags, and interpolate the positions of moving points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import MAX_COORDINATE_M, AnyPath, Source, is_first, read_table

MAX_TAG_M = 1e4
# A gap of more than this number of usual steps of a moving point is reported.
_GAP = 5.0


class Points(NamedTuple):
    """Ids and positions (P, 3) of points; times (L,) and positions (L, 3) of each moving point."""

    ids: tuple[str, ...]
    places: FloatArray
    tracks: tuple[tuple[FloatArray, FloatArray], ...] | None = None

    def at(self, times: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return positions (K, P, 3) at times (K,), and a mask of known positions (K, P).

        Between its times a point moves along a line. Before the first and after the last it is
        known for the usual interval between two of them.
        """
        shape = len(times), len(self.ids)
        if self.tracks is None:
            return np.broadcast_to(self.places, (*shape, 3)), np.ones(shape, dtype=bool)
        places, known = np.empty((*shape, 3)), np.ones(shape, dtype=bool)
        for p, (at, where) in enumerate(self.tracks):
            for axis in range(3):
                places[:, p, axis] = np.interp(times, at, where[:, axis])
            if len(at) > 1:
                step = float(np.median(np.diff(at)))
                known[:, p] = (times >= at[0] - step) & (times <= at[-1] + step)
        return places, known


def read_points(path: AnyPath, kind: str, source: Source, said: Said) -> Points:
    """Read the points of a table.

    `kind`: ``"anchor"`` or ``"tag"``. Anchors with column `t` move.
    """
    table = read_table(path, source)
    column = kind if kind in table.columns or "id" not in table.columns else "id"
    axes = [axis for axis in "xyz" if axis in table.columns]
    if axes == ["x", "y"] and len(table.columns) == 3 + ("t" in table.columns):
        said.note(table.path, "there is no column z, so the heights are 0")
    else:
        axes = [*"xyz"]
    table.require(column, *axes)
    ids = table.text(column)
    table.check(np.array([*map(bool, ids)]), column, f"every {kind} must have an id")
    places = table.points(axes, MAX_TAG_M if kind == "tag" else MAX_COORDINATE_M)
    places = np.pad(places, ((0, 0), (0, 3 - len(axes))))
    once = is_first(ids)
    if once.all() or kind == "tag" or "t" not in table.columns:
        table.check(once, column, f"every {kind} must have its own id")
        said.read(table, (column, *axes))
        return Points(tuple(ids), places)
    said.read(table, (column, *axes, "t"))
    times, note = table.seconds()
    said.note(table.path, note)
    every = np.array(ids)
    names = tuple(every[once].tolist())
    tracks = []
    for name in names:
        rows = np.flatnonzero(every == name)
        rows = rows[np.argsort(times[rows], kind="stable")]
        again = np.ones(len(times), dtype=bool)
        again[rows[1:]] = np.diff(times[rows]) > 0
        table.check(again, "t", f"{kind} {name!r} must have one position at a time")
        tracks.append((times[rows], places[rows]))
    said.note(table.path, _longest_gap(names, tracks))
    return moving(names, tuple(tracks))


def _longest_gap(ids: tuple[str, ...], tracks: list[tuple[FloatArray, FloatArray]]) -> str:
    """Return a note on the longest interval between two positions of a moving point, if unusual."""
    gaps = [np.diff(at) if len(at) > 1 else np.zeros(1) for at, _ in tracks]
    worst = max(range(len(ids)), key=lambda p: gaps[p].max())
    gap, usual = gaps[worst].max(), np.median(gaps[worst])
    if gap <= _GAP * usual:
        return ""
    return (
        f"{ids[worst]!r} has no position for {gap:.4g} s (usually {usual:.4g} s); straight motion "
        "is assumed there"
    )


def moving(ids: tuple[str, ...], tracks: tuple[tuple[FloatArray, FloatArray], ...]) -> Points:
    """Return the points of these tracks; fixed points if none of them moves."""
    places = np.array([where.mean(axis=0) for _, where in tracks])
    if all(np.ptp(where, axis=0).max() < 1e-9 for _, where in tracks):
        return Points(ids, np.array([where[0] for _, where in tracks]))
    return Points(ids, places, tracks)
