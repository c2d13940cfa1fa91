"""Poses for the score of a layout."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, check_count
from rbl_gym.geometry import rotations
from rbl_gym.placement.building import Problem, Zone, free_places
from rbl_gym.placement.problem import Context, PlacementTask, positions

__all__ = ["Sample", "of_context", "sample"]

# Smallest number of positions in a zone.
_LEAST_PLACES = 64
# Rotation of the prior that regularizes the bound, and information of a known tilt.
_PRIOR_ROTATION_RAD, _KNOWN = math.radians(60), 1e12


class Sample(NamedTuple):
    """Poses with their weights and prior information.

    Attributes
    ----------
    rotation, places
        Rotations (P, 3, 3) and positions (P, 3), metres. Rotations at one position are consecutive.
    weight
        Weights (P,) with sum 1.
    prior
        Information (P, 6, 6) of the pose error.
    zone
        Index (P,) of the zone of the position.
    turns
        Number of rotations at each position.
    """

    rotation: FloatArray
    places: FloatArray
    weight: FloatArray
    prior: FloatArray
    zone: np.ndarray
    turns: int = 1

    def every(self, step: int, first: int) -> np.ndarray:
        """Return indices of the poses at every k-th position of each zone, from the first on."""
        zone = self.zone[:: self.turns]
        rank = np.empty(len(zone), dtype=np.int64)
        for index in np.unique(zone):
            rank[zone == index] = np.arange((zone == index).sum())
        return np.flatnonzero(np.repeat(rank % step == first, self.turns))

    def part(self, index: np.ndarray) -> Sample:
        """Return the poses with these indices; the total weight of each zone does not change."""
        rotation, places, weight, prior, zone = (field[index] for field in self[:5])
        arrays = Sample(rotation, places, weight, prior, zone, self.turns)
        whole = np.bincount(self.zone, self.weight)
        here = np.bincount(arrays.zone, arrays.weight, minlength=len(whole))
        ratio = whole / np.where(here > 0, here, 1.0)
        return arrays._replace(weight=arrays.weight * ratio[arrays.zone])


def sample(problem: Problem, n_places: int = 1024, turns: int = 1, seed: int = 0) -> Sample:
    """Return poses that fill the zones of a problem evenly, without those inside obstacles.

    Parameters
    ----------
    problem
        Problem with zones, obstacles and the prior.
    n_places
        Number of positions, shared among the zones by weight; each zone has at least 64. A larger
        number includes the positions of a smaller one.
    turns
        Number of rotations at each position: any rotations, or rotations about the vertical if the
        attitude of the zone is level or only the heading is estimated.
    seed
        Seed of the rotations.

    Raises
    ------
    ValueError
        If a zone has no free position, or a number is below 1.
    """
    n_places = check_count("n_places", n_places, least=1)
    turns = check_count("turns", turns, least=1)
    total = sum(zone.weight for zone in problem.zones)
    rows = []
    for index, zone in enumerate(problem.zones):
        count = max(round(n_places * zone.weight / total), min(_LEAST_PLACES, n_places))
        places = free_places(zone, problem.obstacles, count)
        if not len(places):
            raise ValueError(f"zone {zone.name!r} has no free place: obstacles cover it")
        n = len(places)
        rng = np.random.default_rng([seed, index])
        rows.append(
            (
                _turns(rng, zone, (n, turns)),
                places,
                np.full(n, zone.weight / (total * n * turns)),
                np.full(n, index),
                # Order of the position in its zone: any part of the sample has positions of all
                # zones.
                (np.arange(n) + 0.5) / n,
            )
        )
    rotation, places, weight, zone, order = (
        np.concatenate(column) for column in zip(*rows, strict=True)
    )
    order = np.argsort(order, kind="stable")
    prior = np.array([prior_of(problem, zone) for zone in problem.zones])
    zone = np.repeat(zone[order], turns)
    return Sample(
        rotation[order].reshape(-1, 3, 3),
        np.repeat(places[order], turns, axis=0),
        np.repeat(weight[order], turns),
        prior[zone],
        zone,
        turns,
    )


def _turns(rng: np.random.Generator, zone: Zone, batch: tuple[int, ...]) -> FloatArray:
    if zone.attitude == "free":
        return rotations.random(rng, batch)
    angle = rng.uniform(0, 2 * np.pi, (*batch, 1))
    return rotations.exp(angle * np.array([0.0, 0.0, 1.0]))


def prior_of(problem: Problem, zone: Zone) -> FloatArray:
    """Return the prior information (6, 6): 60 degrees, and half of the extent of all zones.

    If only the heading is estimated, the tilt is known.
    """
    extent = float(np.ptp(problem.corners(), axis=0).max())
    diagonal = np.array([_PRIOR_ROTATION_RAD**-2] * 3 + [(0.5 * extent) ** -2] * 3)
    if zone.attitude == "heading":
        diagonal[:2] = _KNOWN
    return np.diag(diagonal)


def of_context(task: PlacementTask, context: Context) -> Sample:
    """Return the poses of the environments' score for a context without batch axes."""
    n = task.n_poses
    prior = np.broadcast_to(task.prior_information, (n, 6, 6))
    return Sample(
        task.poses[0],
        positions(task, context),
        np.full(n, 1 / n),
        prior,
        np.zeros(n, dtype=np.int64),
    )
