"""Predict the accuracy in a zone by the Cramer-Rao bound: points, grids, maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.placement.building import Problem, Zone
from rbl_gym.placement.sample import prior_of
from rbl_gym.studies.placing.links import anchor_information, layout_information
from rbl_gym.studies.placing.requirements import Errors, errors_of, turns

__all__ = [
    "Map",
    "accuracy",
    "accuracy_map",
    "accuracy_without_each",
    "level_maps",
]

# Turns of the body over which the accuracy at a place is averaged.
TURNS = 9
# Places along the axes where the worst is sought, edges included.
_GRID = (9, 9, 3)
# Places along the longer side of a map, and at least along the other.
_MAP, _LEAST_MAP = 56, 20
# Heights at which a map is drawn in 3-D.
_LEVELS = 5
# Links that are worked on at a time, so that the temporaries stay in cache.
_BLOCK = 40_000
# Drawings of a zone's bounding box after which it has no free place.
_DRAWS, _DRAWN = 200, 4096


def accuracy(problem: Problem, anchors: FloatArray, places: FloatArray, zone: Zone) -> Errors:
    """Return the errors (L) of the Cramer-Rao bound of one epoch at positions (L, 3) of a zone.

    Parameters
    ----------
    problem, anchors
        The problem, and the anchors (M, 3).
    places, zone
        The positions, and the zone with the possible rotations.
    """
    rotation, prior = turns(zone.attitude, TURNS), prior_of(problem, zone)
    found = []
    for part in _blocks(problem, anchors, places):
        told = layout_information(problem, anchors, part, rotation)
        found.append(errors_of(told + prior, rotation, problem.tags))
    return Errors(*map(np.concatenate, zip(*found, strict=True)))


def accuracy_without_each(
    problem: Problem, anchors: FloatArray, places: FloatArray, zone: Zone
) -> Errors:
    """Return `accuracy` (M, L) without each one of the anchors. Arguments as in `accuracy`."""
    rotation, prior = turns(zone.attitude, TURNS), prior_of(problem, zone)
    found = []
    for part in _blocks(problem, anchors, places):
        told = anchor_information(problem, anchors, part, rotation)
        found.append(errors_of(prior + told.sum(axis=0), rotation, problem.tags, -told))
    return Errors(*(np.concatenate(column, axis=-1) for column in zip(*found, strict=True)))


def _blocks(problem: Problem, anchors: FloatArray, places: FloatArray) -> list[FloatArray]:
    size = max(1, _BLOCK // (TURNS * len(anchors) * len(problem.tags)))
    return [places[begin : begin + size] for begin in range(0, len(places), size)]


def draw_places(problem: Problem, zone: Zone, rng: np.random.Generator, count: int) -> FloatArray:
    """Draw positions (count, 3) of the body origin, uniform over the free part of a zone.

    Parameters
    ----------
    problem, zone
        The problem with its obstacles, and the zone.
    rng, count
        Source of randomness, and number of positions.

    Raises
    ------
    ValueError
        If almost no position is free.
    """
    low, high = zone.bounds()
    free = np.empty((0, 3))
    for _ in range(_DRAWS):
        if len(free) >= count:
            return free[:count]
        drawn = low + rng.random((max(_DRAWN, 2 * count), 3)) * (high - low)
        free = np.concatenate([free, drawn[is_free(problem, zone, drawn)]])
    raise ValueError(f"zone {zone.name!r} has almost no free place: obstacles cover it")


def is_free(problem: Problem, zone: Zone, places: FloatArray) -> BoolArray:
    """Return which positions (...) lie in a zone, including edges, and in no obstacle."""
    return zone.contains(places) & ~problem.obstacles.contain(places)


def free_grid(problem: Problem, zone: Zone) -> FloatArray:
    """Return a grid of positions (L, 3) over a zone with edges and corners, without obstacles."""
    low, high = zone.bounds()
    axes = [np.linspace(a, b, n if b > a else 1) for a, b, n in zip(low, high, _GRID, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = [np.column_stack([zone.polygon, np.full(len(zone.polygon), z)]) for z in axes[2]]
    places = np.concatenate([places, *([] if zone.is_box else corners)])
    return places[is_free(problem, zone, places)]


class Map(NamedTuple):
    """Accuracy on a plane: edges of its axes, values (rows, columns), NaN: off the zone or blocked.

    `across` and `up` are the axes (0, 1, 2) of columns and rows, `at` the third coordinate.
    Position and rotation are of all three axes together; `horizontal`, `height` (m) and
    `heading` (degrees) are what zones ask for.
    """

    columns: FloatArray
    rows: FloatArray
    position: FloatArray
    rotation: FloatArray
    horizontal: FloatArray
    height: FloatArray
    heading: FloatArray
    across: int
    up: int
    at: float


def accuracy_map(
    problem: Problem,
    anchors: FloatArray,
    up: int = 1,
    share: float = 0.5,
    zone: Zone | None = None,
) -> Map:
    """Return the accuracy on a plane of a zone.

    Parameters
    ----------
    problem, anchors
        The problem, and the anchors (M, 3).
    up
        1: over x and y; 2: over x and z.
    share
        Position of the plane on the third axis: 0 is the lower side of the zone, 1 the upper one.
    zone
        None: the first.
    """
    zone = problem.zones[0] if zone is None else zone
    low, high = zone.bounds()
    third = 3 - up
    at = float(low[third] + share * (high - low)[third])
    extent = max(float((high - low)[[0, up]].max()), 1e-9)
    centres = []
    for axis in (0, up):
        least = _LEAST_MAP if high[axis] > low[axis] else 1
        count = max(least, round(_MAP * (high - low)[axis] / extent))
        share_of = (np.arange(count) + 0.5) / count
        centres.append(low[axis] + share_of * (high - low)[axis])
    places = np.empty((len(centres[1]), len(centres[0]), 3))
    places[..., 0], places[..., up], places[..., third] = centres[0], centres[1][:, None], at
    free = is_free(problem, zone, places)
    found = np.full((len(Errors._fields), *free.shape), np.nan)
    if free.any():
        found[:, free] = accuracy(problem, anchors, places[free], zone)
    errors = Errors(*found)
    return Map(
        columns=centres[0],
        rows=centres[1],
        position=errors.position,
        rotation=np.rad2deg(errors.rotation),
        horizontal=errors.horizontal,
        height=errors.height,
        heading=np.rad2deg(errors.heading),
        across=0,
        up=up,
        at=at,
    )


def level_maps(problem: Problem, anchors: FloatArray, zone: Zone | None = None) -> list[Map]:
    """Return maps over x and y at heights from the bottom to the top of a zone."""
    zone = problem.zones[0] if zone is None else zone
    shares = np.linspace(0, 1, _LEVELS) if zone.high_m > zone.low_m else [0.5]
    return [accuracy_map(problem, anchors, share=float(share), zone=zone) for share in shares]
