"""Notes on anchors of a given layout: inside an obstacle, or not on a mount."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.geometry.polygons import contains, rectangle
from rbl_gym.placement.building import Problem
from rbl_gym.placement.plans.drawing import UNITS

# An anchor is inside an obstacle if it is this far from its surface, metres.
_INSIDE_M = 1e-3
# An anchor this near to a mount, but not on it, is probably meant to be on it, metres.
_NEAR_M = 0.15
# An anchor this near to a mount is on it, metres (`Mounts.normal`).
_ON_M = 0.01
# Anchors farther than this from every mount may be in another unit, metres.
_FAR_M = 100.0
# Most anchors that one note lists.
_MOST = 4
# What lists show in place of the name of a mount.
NO_MOUNT = "no mount"


def mount_names(problem: Problem, anchors: FloatArray) -> list[str]:
    """Return the name of the mount of each anchor (M, 3); `NO_MOUNT` if it is on none."""
    away = np.linalg.norm(problem.mounts.project(anchors) - anchors, axis=1)
    names = problem.mounts.names(anchors)
    return [
        name if off <= _ON_M else NO_MOUNT for name, off in zip(names, away.tolist(), strict=True)
    ]


def given_notes(problem: Problem, anchors: FloatArray, names: list[str]) -> list[str]:
    """Return notes on anchors (M, 3) that are inside an obstacle, or not on a mount."""
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
    return found + _off_mounts(problem, anchors, names, within)


def _off_mounts(
    problem: Problem, anchors: FloatArray, names: list[str], within: BoolArray
) -> list[str]:
    """Return notes on the anchors that are near a mount but not on it, or far from all mounts."""
    mounts = problem.mounts
    legal = mounts.project(anchors)
    away = np.linalg.norm(legal - anchors, axis=1)
    fixed = np.abs(anchors[:, None] - problem.fixed).max(axis=-1) < _INSIDE_M
    off = (away > _ON_M) & ~within & ~fixed.any(axis=1)
    faces = mounts.normal(legal).any(axis=1) & (away <= _NEAR_M) & isinstance(mounts, Mounts)
    there = mounts.names(legal)
    near, far = np.flatnonzero(off & faces), np.flatnonzero(off & ~faces)
    found = []
    if len(near):
        told = [
            f"{names[k]!r} is {away[k]:.2f} m from {there[k]!r} (nearest point of the mount: "
            f"{_point(legal[k])})"
            for k in near
        ]
        found.append(
            "Anchors that are near a mount but not on it count as free: they see in all "
            f"directions. {'; '.join(told)}."
        )
    if len(far):
        told = [
            f"anchor {names[k]!r} at {_point(anchors[k])} is on no mount: the nearest point of "
            f"one is {away[k]:.2f} m away ({there[k]})"
            for k in far[:_MOST]
        ]
        if len(far) > _MOST:
            told.append(f"and {len(far) - _MOST} more")
        found.append(f"A{'; '.join(told)[1:]}.{_unit(problem, anchors[far], away[far])}")
    return found


def _unit(problem: Problem, anchors: FloatArray, away: FloatArray) -> str:
    """Return a hint at the unit of anchors far outside; ``""`` if they are not."""
    if away.max() <= _FAR_M:
        return ""
    for unit, scale in UNITS.items():
        scaled = anchors * scale
        gap = np.linalg.norm(problem.mounts.project(scaled) - scaled, axis=1)
        if scale < 1 and gap.max() < 1.0:
            return f" Are the positions in {unit}? The file must have metres."
    return " Check the unit and the origin: the file must have metres, as the building has."


def _point(point: FloatArray) -> str:
    return f"({', '.join(f'{value:.3f}' for value in point)})"


def _solids(problem: Problem) -> list[tuple[FloatArray, float, float]]:
    """Return the outline in plan, and the lower and upper height, of every obstacle."""
    prisms = problem.obstacles.prisms
    lows, highs = box_bounds(problem.obstacles.boxes)
    boxes = zip(rectangle(lows, highs), lows[:, 2], highs[:, 2], strict=True)
    return [*boxes, *zip(prisms.corners, prisms.low_m, prisms.high_m, strict=True)]
