"""Join lines of a plan to longer ones, and connect holes to their outlines."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.polygons import area

# Width of the slit that connects a hole to its outline, metres.
_SLIT_M = 0.001


def joined(lines: list[FloatArray], tolerance: float) -> list[tuple[FloatArray, bool]]:
    """Join lines (n, 2) at points where exactly two of them end.

    Return the lines, and whether each is a ring, which does not repeat its first point. Ends within
    `tolerance` (metres) are the same point.
    """
    ends = np.array([line[k] for line in lines for k in (0, -1)]).reshape(-1, 2)
    node = np.arange(len(ends))
    order = np.argsort(ends[:, 0], kind="stable")
    for j, first in enumerate(order):
        for second in order[j + 1 :]:
            if ends[second, 0] - ends[first, 0] > tolerance:
                break
            if abs(ends[second, 1] - ends[first, 1]) <= tolerance:
                node[node == node[second]] = node[first]
    meeting: dict[int, list[int]] = {}
    for end, place in enumerate(node.tolist()):
        meeting.setdefault(place, []).append(end)
    partner = {}
    for ends_here in meeting.values():
        if len(ends_here) == 2:
            partner[ends_here[0]], partner[ends_here[1]] = ends_here[1], ends_here[0]
    found, done = [], set()
    # Open chains begin at an end without a partner; the remaining lines are rings.
    starts = [end for end in range(2 * len(lines)) if end not in partner]
    for start in (*starts, *range(2 * len(lines))):
        if start // 2 in done:
            continue
        parts, end = [], start
        while end is not None and end // 2 not in done:
            done.add(end // 2)
            line = lines[end // 2]
            parts.append(line if end % 2 == 0 else line[::-1])
            end = partner.get(end ^ 1)
        closed = end is not None
        points = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
        if closed:
            points = points[:-1]
        if len(points) > 2 or not closed:
            found.append((points, closed))
    return found


def opened(ring: FloatArray, holes: tuple[FloatArray, ...]) -> FloatArray | None:
    """Return a ring with its holes as one simple ring; slits of 1 mm connect the holes to it.

    None if a hole cannot be reached by a straight slit between two corners.
    """
    ring = ring if area(ring) > 0 else ring[::-1]
    left = [hole if area(hole) < 0 else hole[::-1] for hole in holes]
    while left:
        edges = [np.stack([one, np.roll(one, -1, axis=0)], axis=1) for one in (ring, *left)]
        walls = np.concatenate(edges)
        pairs = sorted(
            (float(np.linalg.norm(a - b)), h, i, j)
            for h, hole in enumerate(left)
            for i, a in enumerate(ring)
            for j, b in enumerate(hole)
        )
        for _, h, i, j in pairs:
            if not _is_blocked(ring[i], left[h][j], walls):
                break
        else:
            return None
        hole = np.roll(left.pop(h), -j, axis=0)
        ring = np.concatenate(
            [
                ring[: i + 1],
                hole,
                [_towards(hole[0], hole[-1])],
                [_towards(ring[i], ring[(i + 1) % len(ring)])],
                ring[i + 1 :],
            ]
        )
    return ring


def _towards(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return a point one slit width away from `start`."""
    away = end - start
    return start + min(0.5, _SLIT_M / max(float(np.linalg.norm(away)), 1e-12)) * away


def _is_blocked(a: FloatArray, b: FloatArray, edges: FloatArray) -> bool:
    """Return whether the line from `a` to `b` crosses or touches an edge that ends at neither."""
    own = (edges == a).all(axis=-1).any(axis=-1) | (edges == b).all(axis=-1).any(axis=-1)
    start, end = edges[~own, 0], edges[~own, 1]

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        u, v = q - p, r - p
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    apart = (side(a, b, start) * side(a, b, end) > 0) | (
        side(start, end, a) * side(start, end, b) > 0
    )
    return bool((~apart).any())
