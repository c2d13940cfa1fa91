"""Predict the accuracy in a zone by the Cramer-Rao bound: points, grids, maps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.placement.building import Problem, Zone
from rbl_gym.placement.sample import prior_of
from rbl_gym.studies.placing.links import anchor_information, layout_information
from rbl_gym.studies.placing.requirements import Errors, errors_of, turns

__all__ = ["Map", "accuracy", "accuracy_map", "accuracy_without_each"]

# Number of rotations of the body over which the accuracy at a position is averaged.
TURNS = 9
# Grid of positions along the axes for the search of the worst one; edges are included.
_GRID = (9, 9, 3)
# Number of cells along the longer side of a map, and minimum along the shorter one.
_MAP, _LEAST_MAP = 56, 20
# Number of links that are processed at a time, so that the temporaries stay in cache.
_BLOCK = 40_000
# Maximum number of draws from a bounding box, and minimum number of positions per draw.
_DRAWS, _DRAWN = 200, 4096


def accuracy(problem: Problem, anchors: FloatArray, places: FloatArray, zone: Zone) -> Errors:
    """Return the errors (L) of the Cramer-Rao bound of one epoch at positions (L, 3) of a zone.

    Parameters
    ----------
    problem, anchors
        The placement problem, and the anchor positions (M, 3).
    places, zone
        The positions, and the zone, which defines the possible rotations.
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
    """Return `accuracy` (M, L) without each of the anchors. Arguments as in `accuracy`."""
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

    ValueError if almost no position is free.
    """
    return _free_of(problem, zone, count, lambda size: rng.random((size, 3)))


def spread_places(problem: Problem, zone: Zone, rng: np.random.Generator, count: int) -> FloatArray:
    """Draw positions as `draw_places`, which fill the zone more evenly.

    They are a Sobol sequence with a random shift. Each position is uniform, but averages and shares
    over all positions vary less than with independent positions.
    """
    from scipy.stats import qmc  # slow to import

    sequence, shift = qmc.Sobol(3, scramble=False), rng.random(3)
    return _free_of(problem, zone, count, lambda size: (sequence.random(size) + shift) % 1.0)


def _free_of(
    problem: Problem, zone: Zone, count: int, draw: Callable[[int], FloatArray]
) -> FloatArray:
    """Return the first free positions (count, 3) of those that `draw` returns in the unit cube."""
    low, high = zone.bounds()
    free = np.empty((0, 3))
    # A Sobol sequence is even over powers of two.
    size = max(_DRAWN, 2 ** math.ceil(math.log2(2 * count)))
    for _ in range(_DRAWS):
        if len(free) >= count:
            return free[:count]
        drawn = low + draw(size) * (high - low)
        free = np.concatenate([free, drawn[is_free(problem, zone, drawn)]])
    raise ValueError(f"zone {zone.name!r} has almost no free place: obstacles cover it")


def is_free(problem: Problem, zone: Zone, places: FloatArray) -> BoolArray:
    """Return which positions (...) lie in a zone or on its edges, and outside obstacles."""
    return zone.contains(places) & ~problem.obstacles.contain(places)


def free_grid(problem: Problem, zone: Zone) -> FloatArray:
    """Return a grid of free positions (L, 3) over a zone, including its edges and corners."""
    low, high = zone.bounds()
    axes = [np.linspace(a, b, n if b > a else 1) for a, b, n in zip(low, high, _GRID, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = [np.column_stack([zone.polygon, np.full(len(zone.polygon), z)]) for z in axes[2]]
    places = np.concatenate([places, *([] if zone.is_box else corners)])
    return places[is_free(problem, zone, places)]


class Map(NamedTuple):
    """Accuracy on a horizontal plane: edges of the cells, and values (rows, columns).

    Values are NaN outside the zone and inside obstacles. `at` is the height. Position and rotation
    are errors over all three axes; `horizontal`, `height` (m) and `heading` (degrees) are the
    errors that zones limit.
    """

    columns: FloatArray
    rows: FloatArray
    position: FloatArray
    rotation: FloatArray
    horizontal: FloatArray
    height: FloatArray
    heading: FloatArray
    at: float


def accuracy_map(
    problem: Problem,
    anchors: FloatArray,
    share: float = 0.5,
    zone: Zone | None = None,
    survive: int = 0,
) -> Map:
    """Return the accuracy over x and y at one height of a zone.

    Parameters
    ----------
    problem, anchors
        The placement problem, and the anchor positions (M, 3).
    share
        The height: 0 is the lower side of the zone, 1 the upper one.
    zone
        The zone; None: the first one.
    survive
        1: each error at each position is that after the loss of the anchor that hurts it most.
    """
    zone = problem.zones[0] if zone is None else zone
    low, high = zone.bounds()
    at = float(low[2] + share * (high - low)[2])
    extent = max(float((high - low)[:2].max()), 1e-9)
    centres = []
    for axis in (0, 1):
        least = _LEAST_MAP if high[axis] > low[axis] else 1
        count = max(least, round(_MAP * (high - low)[axis] / extent))
        share_of = (np.arange(count) + 0.5) / count
        centres.append(low[axis] + share_of * (high - low)[axis])
    places = np.stack(np.meshgrid(*centres, at), axis=-1)[:, :, 0]
    free = is_free(problem, zone, places)
    found = np.full((len(Errors._fields), *free.shape), np.nan)
    if free.any() and survive:
        lost = accuracy_without_each(problem, anchors, places[free], zone)
        found[:, free] = np.max(lost, axis=1)
    elif free.any():
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
        at=at,
    )
