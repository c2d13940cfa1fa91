"""Notes on anchors of a given layout: inside an obstacle, or near a mount but not on it."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.polygons import contains, rectangle
from rbl_gym.placement.building import Problem

# An anchor is inside an obstacle if it is this far from its surface, metres.
_INSIDE_M = 1e-3
# An anchor this near to a mount, but not on it, is probably meant to be on it, metres.
_NEAR_M = 0.15


def given_notes(problem: Problem, anchors: FloatArray, names: list[str]) -> list[str]:
    """Return notes on anchors (M, 3) that are inside an obstacle, or just in front of a mount."""
    within = np.zeros(len(anchors), bool)
    found = []
    for ring, low, high in _solids(problem):
        z = anchors[:, 2]
        held = contains(ring, anchors[:, :2], _INSIDE_M)
        held &= (z > low + _INSIDE_M) & (z < high - _INSIDE_M)
        within |= held
        (x0, y0), (x1, y1) = ring.min(axis=0), ring.max(axis=0)
        found += [
            f"Anchor {names[k]!r} is inside a wall or an obstacle: x {x0:.2f} to {x1:.2f} m, "
            f"y {y0:.2f} to {y1:.2f} m, z {low:.2f} to {high:.2f} m. All its links pass through it."
            for k in np.flatnonzero(held)
        ]
    return found + _beside_mounts(problem, anchors, names, within)


def _beside_mounts(
    problem: Problem, anchors: FloatArray, names: list[str], within: BoolArray
) -> list[str]:
    """Return a note on the anchors near a mount that faces a direction, but not on it."""
    mounts = problem.mounts
    if not isinstance(mounts, Mounts):
        return []
    legal = mounts.project(anchors)
    away = np.linalg.norm(legal - anchors, axis=1)
    faces = mounts.normal(legal).any(axis=1) & ~mounts.normal(anchors).any(axis=1)
    near = np.flatnonzero(faces & ~within & (away <= _NEAR_M))
    if not len(near):
        return []
    told = [
        f"{names[k]!r} {away[k]:.2f} m from {mounts.names(legal)[k]!r}, where it would be at "
        f"({', '.join(f'{value:.3f}' for value in legal[k])})"
        for k in near
    ]
    return [
        f"Near a mount but not on it, so that they can see in all directions: {'; '.join(told)}."
    ]


def _solids(problem: Problem) -> list[tuple[FloatArray, float, float]]:
    """Return the outline in plan, and the lower and upper height, of every obstacle."""
    prisms = problem.obstacles.prisms
    lows, highs = box_bounds(problem.obstacles.boxes)
    boxes = zip(rectangle(lows, highs), lows[:, 2], highs[:, 2], strict=True)
    return [*boxes, *zip(prisms.corners, prisms.low_m, prisms.high_m, strict=True)]
