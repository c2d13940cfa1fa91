"""Find the centre lines of walls that are drawn as two lines."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray

# Two lines are parallel within this sine of their angle. Their overlap must be longer than this
# multiple of their distance.
_PARALLEL, _LEAST_OVERLAP = 0.02, 1.0
Piece = tuple[float, float]


def centre_lines(
    lines: list[tuple[FloatArray, bool]], widest: float
) -> tuple[list[tuple[FloatArray, float]], list[FloatArray]]:
    """Return centre lines of pairs of parallel segments, and the segments without a partner.

    `lines` are points (n, 2) of each line, and whether it is a ring; `widest` is the maximum
    distance of the two lines of a wall. Centre lines (2, 2) come with the distance of their two
    lines, the closest pairs first. Remaining pieces shorter than `widest`, such as the end of a
    wall, are dropped.
    """
    segments = np.concatenate(
        [
            np.stack([points, np.roll(points, -1, axis=0)], axis=1)[: None if closed else -1]
            for points, closed in lines
        ]
        or [np.empty((0, 2, 2))]
    )
    start, away = segments[:, 0], segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(away, axis=-1)
    segments, start, length = segments[length > 0], start[length > 0], length[length > 0]
    along = (segments[:, 1] - start) / length[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    found = []
    for i in range(len(segments)):
        ends = segments[i + 1 :] - start[i]
        apart = ends @ normal[i]
        parallel = np.abs(along[i + 1 :] @ normal[i]) < _PARALLEL
        near = np.abs(apart.mean(axis=-1))
        for j in np.flatnonzero(parallel & (near > 1e-3) & (near < widest)).tolist():
            found.append((float(near[j]), i, i + 1 + j))
    free: list[list[Piece]] = [[(0.0, float(x))] for x in length]
    pairs = []
    for distance, i, j in sorted(found):
        # Intervals along segment i that are free on both segments.
        sign = 1.0 if along[i] @ along[j] > 0 else -1.0
        shift = float((start[j] - start[i]) @ along[i])
        other = [_ordered(shift + sign * a, shift + sign * b) for a, b in free[j]]
        common = [
            (max(a, c), min(b, d))
            for a, b in free[i]
            for c, d in other
            if min(b, d) - max(a, c) > _LEAST_OVERLAP * distance
        ]
        for low, high in common:
            # If one of the two lines continues, the wall turns a corner: extend it to the middle of
            # the corner.
            reach = 0.5 * distance
            first = low - reach * _goes_on(free[i], other, low - reach)
            last = high + reach * _goes_on(free[i], other, high + reach)
            middle = 0.5 * float((segments[j].mean(axis=0) - start[i]) @ normal[i])
            line = start[i] + np.array([[first], [last]]) * along[i] + middle * normal[i]
            pairs.append((line, distance))
            free[i] = _without(free[i], low, high)
            ends = _ordered(sign * (low - shift), sign * (high - shift))
            free[j] = _without(free[j], *ends)
            other = [_ordered(shift + sign * a, shift + sign * b) for a, b in free[j]]
    single = [
        start[i] + np.array([[a], [b]]) * along[i]
        for i, pieces in enumerate(free)
        for a, b in pieces
        if b - a > widest
    ]
    return pairs, single


def _ordered(one: float, other: float) -> Piece:
    return min(one, other), max(one, other)


def _goes_on(one: list[Piece], other: list[Piece], place: float) -> bool:
    return any(a - 1e-6 <= place <= b + 1e-6 for a, b in (*one, *other))


def _without(pieces: list[Piece], low: float, high: float) -> list[Piece]:
    parts = [part for a, b in pieces for part in ((a, min(b, low)), (max(a, high), b))]
    return [(a, b) for a, b in parts if b - a > 1e-9]
