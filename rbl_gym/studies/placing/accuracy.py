"""What the Cramer-Rao bound promises at places of a work region: points, grids, maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray
from rbl_gym.placement.scene_files import Problem

__all__ = [
    "Accuracy",
    "Map",
    "accuracy",
    "accuracy_map",
    "free_sample",
    "level_maps",
]

# Turns of the body over which the accuracy at a place is averaged.
_TURNS = 8
# Places over which the accuracy is averaged; those along the axes where the worst is sought,
# edges included; those along the longer side of a map, and at least along the other.
_SAMPLE, _GRID, _MAP, _LEAST_MAP = 600, (13, 13, 5), 56, 20
# Heights at which a map is drawn in 3-D.
_LEVELS = 5
# Links that are worked on at a time, so that the temporaries stay in cache.
_BLOCK = 40_000


class Accuracy(NamedTuple):
    """Predicted standard deviations at places (L, 3): position (m), rotation (rad), b (m).

    Root mean squares over turns of the body, each (L,); position and rotation are of all three
    axes together.
    """

    places: FloatArray
    position: FloatArray
    rotation: FloatArray
    score: FloatArray


def accuracy(problem: Problem, anchors: FloatArray, places: FloatArray) -> Accuracy:
    """What the Cramer-Rao bound of one epoch of ranges promises at places (L, 3)."""
    task = problem.task
    tags = np.asarray(task.scene.tags)
    turns = task.poses[0][:_TURNS]
    rows = []
    size = max(1, _BLOCK // (len(turns) * len(anchors) * len(tags)))
    for begin in range(0, len(places), size):
        part = places[begin : begin + size]
        weight = problem.share(anchors, part)[:, None, :, None]
        information = bounds.information_at(
            anchors, tags, turns, part[:, None], task.scene.noise, weight
        )
        covariance = np.linalg.inv(information + task.prior_information)
        variance = np.einsum("...ii->...i", covariance)
        b = bounds.score(covariance, turns, tags)
        squares = variance[..., 3:].sum(-1), variance[..., :3].sum(-1), b**2
        rows.append([np.sqrt(square.mean(axis=-1)) for square in squares])
    return Accuracy(places, *(np.concatenate(column) for column in zip(*rows, strict=True)))


def free_sample(problem: Problem) -> FloatArray:
    """Places (L, 3) spread evenly over the zones, obstacles left out."""
    return problem.free_places(_SAMPLE)


def free_grid(problem: Problem) -> FloatArray:
    """A grid of places (L, 3) over the zones, their edges included, obstacles left out."""
    low, high = problem.corners()
    axes = [np.linspace(a, b, n if b > a else 1) for a, b, n in zip(low, high, _GRID, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return places[problem.free(places)]


class Map(NamedTuple):
    """Accuracy on a plane of the region: edges of its axes, values (rows, columns), NaN: blocked.

    `across` and `up` are the axes (0, 1, 2) of columns and rows, `at` the third coordinate.
    """

    columns: FloatArray
    rows: FloatArray
    position: FloatArray
    rotation: FloatArray
    across: int
    up: int
    at: float


def accuracy_map(problem: Problem, anchors: FloatArray, up: int = 1, share: float = 0.5) -> Map:
    """Accuracy on a plane of the work region.

    Parameters
    ----------
    problem, anchors
        What is placed, and where (M, 3).
    up
        1: over x and y; 2: over x and z.
    share
        Where the plane cuts the third axis: 0 is the region's lower side, 1 its upper one.
    """
    low, high = problem.corners()
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
    found = accuracy(problem, anchors, places.reshape(-1, 3))
    blocked = ~problem.free(found.places)
    values = [
        np.where(blocked, np.nan, value).reshape(places.shape[:2])
        for value in (found.position, np.rad2deg(found.rotation))
    ]
    return Map(*centres, *values, across=0, up=up, at=at)


def level_maps(problem: Problem, anchors: FloatArray) -> list[Map]:
    """Maps over x and y at heights from the bottom of the region to its top."""
    low, high = problem.corners()
    shares = np.linspace(0, 1, _LEVELS) if high[2] > low[2] else [0.5]
    return [accuracy_map(problem, anchors, share=float(share)) for share in shares]
