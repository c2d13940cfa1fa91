"""Walls along lines in the plan: straight pieces, mitred where they meet, with openings."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.polygons import TOUCH_M, area

# Mitres longer than this many half thicknesses are cut off.
_LONGEST_MITRE = 4.0
# Smaller openings, and smaller parts of a wall beside them, are left out.
_LEAST_M, _LEAST_M2 = 1e-3, 1e-6


Solid = tuple[FloatArray, float, float]  # corners (V, 2) in the plan, lower and upper height


class Wall(NamedTuple):
    """A straight wall: its ends (2,) in the plan, half its thickness, its heights, metres."""

    start: FloatArray
    end: FloatArray
    half_m: float
    low_m: float
    high_m: float


class Opening(NamedTuple):
    """An opening: its ends (2, 2) in the plan, its heights, metres; index of its table."""

    ends: FloatArray
    low_m: float
    high_m: float
    table: int


def segments(line: FloatArray, closed: bool) -> list[tuple[FloatArray, FloatArray]]:
    """Return the straight pieces of a line (V, 2)."""
    ends = np.roll(line, -1, axis=0)
    return list(zip(line, ends, strict=True))[: None if closed else -1]


def wall_pieces(line: FloatArray, half: float, closed: bool) -> list[FloatArray]:
    """Return quadrilaterals (4, 2) around the pieces of a line, mitred at their joints."""
    found: list[FloatArray] = []
    parts = segments(line, closed)
    along = np.array([(end - start) / np.hypot(*(end - start)) for start, end in parts])
    for i, (start, end) in enumerate(parts):
        left = half * turned(along[i])
        joined = [closed or i > 0, closed or i + 1 < len(parts)]
        before, after = (
            _mitre(along[k % len(parts)], along[i], half) if join else left
            for k, join in zip((i - 1, i + 1), joined, strict=True)
        )
        ring = np.array([start - before, end - after, end + after, start + before])
        # Mitres of a piece that is shorter than them would cross.
        if min((ring[1] - ring[0]) @ along[i], (ring[2] - ring[3]) @ along[i]) < TOUCH_M:
            ring = np.array([start - left, end - left, end + left, start + left])
        found.append(ring)
    return found


def _mitre(one: FloatArray, other: FloatArray, half: float) -> FloatArray:
    """Return the vector from a corner of two directions to the intersection of their left sides."""
    middle = turned(one) + turned(other)
    square = middle @ middle
    # cos^2 of half the turn is square / 4.
    if square * _LONGEST_MITRE**2 < 4:
        return half * turned(other)
    return 2 * half * middle / square


def turned(direction: FloatArray) -> FloatArray:
    """Return vectors rotated by 90 degrees to the left."""
    return np.array([-direction[1], direction[0]])


def opened(
    ring: FloatArray, wall: Wall, openings: list[Opening]
) -> tuple[list[Solid], list[Solid | None]]:
    """Return what openings leave of a straight wall, and the gap of each; None: not in this wall.

    `ring` are the corners (4, 2) of the wall, of `wall_pieces`.
    """
    length = float(np.hypot(*(wall.end - wall.start)))
    along = (wall.end - wall.start) / length
    across = wall.half_m * turned(along)
    reach = (ring - wall.start) @ along

    def between(first: float, last: float) -> FloatArray:
        """Return the corners of the part between two distances from the start of the wall."""
        right, left = np.clip([first, last], *reach[:2]), np.clip([last, first], *reach[:1:-1])
        sides = np.repeat([-1.0, 1.0], 2)[:, None] * across
        corners = wall.start + np.array([*right, *left])[:, None] * along + sides
        return corners[np.hypot(*(corners - np.roll(corners, 1, axis=0)).T) > TOUCH_M]

    spans: list[tuple[float, float, float, float] | None] = []
    for opening in openings:
        off = opening.ends - wall.start
        first, last = np.sort(off @ along).clip(0.0, length).tolist()
        low, high = max(opening.low_m, wall.low_m), min(opening.high_m, wall.high_m)
        inside = np.abs(off @ turned(along)).max() <= wall.half_m + 1e-6
        there = inside and last - first > _LEAST_M and high - low > _LEAST_M
        spans.append((first, last, low, high) if there else None)
    found = sorted((span for span in spans if span is not None), key=lambda span: span[2])
    if not found:
        return [(ring, wall.low_m, wall.high_m)], [None] * len(openings)
    rest: list[Solid] = []
    stops = [-np.inf, *np.unique([span[:2] for span in found]), np.inf]
    for first, last in itertools.pairwise(stops):
        corners, low = between(first, last), wall.low_m
        if len(corners) < 3 or area(corners) < _LEAST_M2:
            continue
        for begin, end, bottom, top in found:
            if begin <= first and last <= end:
                if bottom - low > _LEAST_M:
                    rest.append((corners, low, bottom))
                low = max(low, top)
        if wall.high_m - low > _LEAST_M:
            rest.append((corners, low, wall.high_m))
    return rest, [span and (between(*span[:2]), *span[2:]) for span in spans]
