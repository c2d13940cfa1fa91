"""Check simple polygons in the plan, and test which points they contain. Corners (V, 2), metres."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array

__all__ = ["area", "check_line", "check_polygon", "contains", "ears", "rectangle"]

# Corners closer than this are identical, and lines closer than this touch, metres.
TOUCH_M = 1e-9


def area(polygon: FloatArray) -> float:
    """Return the area in square metres; positive if the corners are counter-clockwise."""
    # Relative to the first corner: far from the origin the products lose digits.
    x, y = (polygon - polygon[0]).T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def rectangle(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return corners (..., 4, 2) of boxes in plan, counter-clockwise; x and y of (..., 2 or 3)."""
    ends = np.stack([low, high], axis=-2)
    return np.stack([ends[..., [0, 1, 1, 0], 0], ends[..., [0, 0, 1, 1], 1]], axis=-1)


def check_line(name: str, line: ArrayLike, closed: bool = False) -> FloatArray:
    """Return a line of at least two corners (V, 2), without repeated corners.

    Raises
    ------
    ValueError
        If it is not a list of [x, y], or has no length.
    """
    points = check_array(name, line, ("V", 2))
    if points.ndim != 2:
        raise ValueError(f"{name} must be a list of [x, y], got shape {points.shape}")
    fresh = np.hypot(*np.diff(points, axis=0).T) > TOUCH_M
    points = points[np.concatenate([[True], fresh])]
    if closed and len(points) > 1 and np.hypot(*(points[-1] - points[0])) <= TOUCH_M:
        points = points[:-1]
    least = 3 if closed else 2
    if len(points) < least:
        raise ValueError(f"{name} must have at least {least} different points, got {len(points)}")
    return points


def check_polygon(name: str, polygon: ArrayLike) -> FloatArray:
    """Return the corners (V, 2) of a simple polygon, counter-clockwise and without repetitions.

    Clockwise polygons are reversed. A last corner that repeats the first is left out.

    Raises
    ------
    ValueError
        If it is not a list of [x, y], has no area, or crosses or touches itself. The message names
        the position.
    """
    ring = check_line(name, polygon, closed=True)
    # A polygon that crosses itself may also have no area.
    spread = np.linalg.svd(ring - ring.mean(axis=0), compute_uv=False)
    if spread[1] <= TOUCH_M:
        raise ValueError(
            f"{name} must enclose an area, but its {len(ring)} corners lie on one line"
        )
    _check_simple(name, ring)
    return ring if area(ring) > 0 else ring[::-1].copy()


def _check_simple(name: str, ring: FloatArray) -> None:
    """Raise ValueError if edges meet, except for neighbours at their common corner."""
    count = len(ring)
    start, end = ring, np.roll(ring, -1, axis=0)
    along = end - start
    length = np.hypot(*along.T)
    after = np.roll(along, -1, axis=0)
    turn = _cross(along, after) / np.maximum(length, np.roll(length, -1))
    back = (np.abs(turn) <= TOUCH_M) & ((along * after).sum(axis=1) < 0)
    if back.any():
        where = end[back.argmax()]
        raise ValueError(f"{name} must not fold back on itself, but does so at {_show(where)}")
    for i in range(count - 2):
        # Edge i, and edges j from the next but one to the last that is not a neighbour.
        j = np.arange(i + 2, count - (i == 0))
        off = _distance(start[i], end[i], start[j], end[j])
        if len(j) and off.min() <= TOUCH_M:
            k = int(j[off.argmin()])
            raise ValueError(
                f"{name} must not cross or touch itself: edge {i + 1}, from {_show(start[i])} to "
                f"{_show(end[i])}, meets edge {k + 1}, from {_show(start[k])} to {_show(end[k])}"
            )


def _distance(a: FloatArray, b: FloatArray, starts: FloatArray, ends: FloatArray) -> FloatArray:
    """Return distances (J,) between a segment and others (J, 2); 0 if they cross."""
    sides = _cross(b - a, starts - a), _cross(b - a, ends - a)
    others = _cross(ends - starts, a - starts), _cross(ends - starts, b - starts)
    crossing = (sides[0] * sides[1] < 0) & (others[0] * others[1] < 0)
    ends_off = [
        to_segment(starts, a, b), to_segment(ends, a, b),
        to_segment(a, starts, ends), to_segment(b, starts, ends),
    ]  # fmt: skip
    return np.where(crossing, 0.0, np.min(ends_off, axis=0))


def to_segment(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """Return distances (...) of points (..., 2) from segments between (..., 2), metres."""
    along, away = end - start, points - start
    square = (along**2).sum(axis=-1)
    share = ((along * away).sum(axis=-1) / np.where(square > 0, square, 1.0)).clip(0.0, 1.0)
    return np.hypot(*np.moveaxis(away - share[..., None] * along, -1, 0))


def contains(polygon: FloatArray, points: FloatArray, margin_m: float = 1e-6) -> BoolArray:
    """Return which points (..., 2) lie in a polygon (V, 2), and not within a margin of its edge.

    A negative margin also includes points on the edge, and outside up to this distance.
    """
    reach = max(0.0, -margin_m)
    low, high = polygon.min(axis=0) - reach, polygon.max(axis=0) + reach
    found = np.asarray(((points >= low) & (points <= high)).all(axis=-1))
    near = points[found]
    start, end = polygon, np.roll(polygon, -1, axis=0)
    x, y = near[:, None, 0], near[:, None, 1]
    above = start[:, 1] > y
    # A ray along x crosses an odd number of edges if it starts inside.
    crosses = above != (end[:, 1] > y)
    height = np.where(crosses, end[:, 1] - start[:, 1], 1.0)
    ahead = start[:, 0] + (y - start[:, 1]) / height * (end - start)[:, 0] > x
    inside = (crosses & ahead).sum(axis=1) % 2 == 1
    off = to_segment(near[:, None], start, end).min(axis=1, initial=np.inf)
    found[found] = inside & (off > margin_m) if margin_m >= 0 else inside | (off <= -margin_m)
    return found


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _show(point: FloatArray) -> str:
    return f"({point[0]:g}, {point[1]:g})"


def ears(corners: FloatArray) -> np.ndarray:
    """Return triangles (V - 2, 3), corner indices, of a simple polygon (V, 2), by ear clipping."""

    def turn(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
        u, v = b - a, c - a
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    x, y = corners.T
    area = x @ np.roll(y, -1) - y @ np.roll(x, -1)
    left = list(range(len(corners)))[:: 1 if area >= 0 else -1]
    found = []
    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
            others = corners[[n for n in left if n not in (a, b, c)]]
            pairs = ((a, b), (b, c), (c, a))
            sides = [turn(corners[p], corners[q], others) for p, q in pairs]
            if turn(*corners[[a, b, c]]) > 0 and not (np.min(sides, axis=0) >= 0).any():
                break
        else:  # the rest has no area
            break
        found.append([a, b, c])
        left.remove(b)
    return np.array([*found, left[:3]])


def prism_edges(ring: FloatArray, low: float, high: float) -> FloatArray:
    """Return the edges (3 V, 2, 3) of a prism over corners (V, 2)."""
    bottom, top = (np.insert(ring, 2, z, axis=1) for z in (low, high))
    around = [np.stack([one, np.roll(one, -1, axis=0)], axis=1) for one in (bottom, top)]
    return np.concatenate([*around, np.stack([bottom, top], axis=1)])


def prism_mesh(
    rings: Iterable[FloatArray], lows: Iterable[float], highs: Iterable[float]
) -> tuple[FloatArray, np.ndarray]:
    """Return prisms over rings (V, 2) as vertices (K, 3) and triangles (T, 3)."""
    points, triangles, count = [], [], 0
    for ring, low, high in zip(rings, lows, highs, strict=True):
        # Corners of prisms are repeated up to a common number.
        ring = ring[np.append(True, (np.diff(ring, axis=0) != 0).any(axis=1))]
        size, here = len(ring), np.arange(len(ring))
        there, caps = (here + 1) % size, ears(ring)
        points += [np.insert(ring, 2, z, axis=1) for z in (low, high)]
        sides = [[here, there, there + size], [here, there + size, here + size]]
        faces = [caps[:, ::-1], caps + size, *(np.stack(side, axis=1) for side in sides)]
        triangles.append(np.concatenate(faces) + count)
        count += 2 * size
    return np.concatenate(points), np.concatenate(triangles)
