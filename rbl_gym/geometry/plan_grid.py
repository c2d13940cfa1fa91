"""Index obstacles by cells in the plan, so that a link checks only those on its path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

# Cells per obstacle, and the maximum number along either axis.
_CELLS, _MOST = 1.0, 200
# Margin around obstacles, metres, and as a share of the whole extent.
_MARGIN_M, _MARGIN = 1e-6, 1e-12


class PlanGrid(NamedTuple):
    """A grid of square cells; the cells at the edge extend to infinity.

    `cells` (5,) are corner x, y of the first cell, length of a side, numbers of columns and rows.
    The obstacles of cell ``c = row * columns + column`` are ``members[starts[c] : starts[c + 1]]``.
    """

    cells: FloatArray
    starts: np.ndarray
    members: np.ndarray


def one_cell(count: int) -> PlanGrid:
    """Return a grid of one cell, with all of `count` obstacles."""
    cells = np.array([0.0, 0.0, 1.0, 1.0, 1.0])
    return PlanGrid(cells, np.array([0, count]), np.arange(count))


def plan_grid(low: FloatArray, high: FloatArray) -> PlanGrid:
    """Return the grid of obstacles between corners (K, 2) in the plan, metres."""
    count = len(low)
    origin, extent = low.min(axis=0), np.ptp([low.min(axis=0), high.max(axis=0)], axis=0)
    side = max(np.sqrt(extent.prod() / (_CELLS * count)), extent.max() / _MOST, 1e-3)
    shape = np.maximum(np.ceil(extent / side), 1).astype(int)
    margin = _MARGIN_M + _MARGIN * np.abs([low, high]).max()
    first, last = (
        np.floor((corner - origin) / side).clip(0, shape - 1).astype(int)
        for corner in (low - margin, high + margin)
    )
    cell, member = [], []
    for index, ((c0, r0), (c1, r1)) in enumerate(zip(first, last, strict=True)):
        columns, rows = np.arange(c0, c1 + 1), np.arange(r0, r1 + 1)
        held = (rows[:, None] * shape[0] + columns).ravel()
        cell.append(held)
        member.append(np.full(len(held), index))
    cell, member = np.concatenate(cell), np.concatenate(member)
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(shape.prod() + 1))
    return PlanGrid(np.array([*origin, side, *shape], float), starts, member[order])
