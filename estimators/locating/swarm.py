"""Competitors of the DOA paper: heuristic searches over the distances of the tags.

With known directions, K distances from the base station determine the positions of K tags. The
searches find K distances for which the distances between tags match those on the body. The paper
names the two searches but gives neither objective nor parameters. Ours minimise
``sum_ij (|d_i u_i - d_j u_j| - |c_i - c_j|)^2``; the y of all tags has one sign. The two classes
list the other assumptions. Population, steps, reach and the fraction of new individuals were tuned
once for the fraction of poses near the truth.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.locating.doa_newton import Places, body_size
from rbl_gym.measurements import bearing

# Objective (B, P) of normalised distances (K, B, P).
Objective = Callable[[FloatArray], FloatArray]
# A search has converged if its best distances moved less than this (units of the body's size) over
# the last quarter of its steps.
_STILL = 1e-3
# Particle swarm: inertia, both attractions. Participatory search: learning rate, new individuals.
_INERTIA, _ATTRACTION = 0.7298, 1.4962
_LEARNING_RATE, _FRESH = 0.5, 40
_SMALLEST_RAD = 1e-4  # least angle between directions that bounds a distance


@dataclass(frozen=True)
class ParticleSwarm:
    """Particle swarm optimisation with constriction (Clerc and Kennedy 2002), global best.

    Assumed: 400 particles, 120 steps, inertia 0.7298, both attractions 1.4962, distances up to 2.5
    times the largest that the directions allow, positions clipped to that, velocities start at
    zero.
    """

    size: int = 400
    steps: int = 120
    reach: float = 2.5

    def search(
        self, objective: Objective, shape: tuple[int, int], rng: np.random.Generator
    ) -> Iterator[FloatArray]:
        """Return the best distances (K, B) after each step, in units of `reach`."""
        x = rng.random((*shape, self.size))
        velocity = np.zeros_like(x)
        best, best_cost = x.copy(), objective(x)
        for _ in range(self.steps):
            x, velocity = self._moved(x, velocity, best, best_cost, rng)
            best, best_cost = _better(best, best_cost, x, objective(x))
            yield _at(best, best_cost.argmin(axis=-1))

    def _moved(
        self,
        x: FloatArray,
        velocity: FloatArray,
        best: FloatArray,
        best_cost: FloatArray,
        rng: np.random.Generator,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the next positions and velocities."""
        leader = _at(best, best_cost.argmin(axis=-1))
        own, common = _ATTRACTION * rng.random((2, *x.shape))
        velocity = _INERTIA * velocity + own * (best - x) + common * (leader[..., None] - x)
        return np.clip(x + velocity, 0.0, 1.0), velocity


@dataclass(frozen=True)
class ParticipatorySearch:
    """Participatory search algorithm (Liu and Gomide, Evolving Intelligence 10, 2017), as outlined.

    The pool consists of individuals on [0, 1]^K. The compatibility ``rho(x, y)`` of two individuals
    is one minus their mean absolute difference. Each step pairs every individual ``s`` with a
    random other one ``s'``:

    1. Selection: ``p_s`` is the one of the two that is more compatible with the best individual.
    2. Recombination: ``p_r = s + alpha rho(s, s')^(1-a) (s' - s)``.
    3. Mutation: ``p_m = best + rho(p_s, p_r)^(1-a) (p_s - p_r)``.
    4. ``p_m`` replaces ``s`` if it is better.

    New random individuals then replace the worst tenth. The paper does not give the settings: 400
    individuals, 200 steps, learning rate alpha = 0.5, arousal a = 0, and the new tenth.
    """

    size: int = 400
    steps: int = 200
    reach: float = 1.0

    def search(
        self, objective: Objective, shape: tuple[int, int], rng: np.random.Generator
    ) -> Iterator[FloatArray]:
        """Return the best distances (K, B) after each step, in units of `reach`."""
        x = rng.random((*shape, self.size))
        cost = objective(x)
        for _ in range(self.steps):
            child = self._children(x, cost, rng)
            x, cost = _better(x, cost, child, objective(child))
            worst = np.argpartition(-cost, _FRESH, axis=-1)[..., :_FRESH]
            new = rng.random((*shape, _FRESH))
            np.put_along_axis(x, np.broadcast_to(worst, new.shape), new, axis=-1)
            np.put_along_axis(cost, worst, objective(new), axis=-1)
            yield _at(x, cost.argmin(axis=-1))

    def _children(self, x: FloatArray, cost: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the mutated individuals of a step, one for each."""
        best = _at(x, cost.argmin(axis=-1))[..., None]
        other = np.roll(x, rng.integers(1, self.size), axis=-1)
        nearer = _compatibility(x, best) >= _compatibility(other, best)
        selected = np.where(nearer, x, other)
        recombined = x + _LEARNING_RATE * _compatibility(x, other) * (other - x)
        change = _compatibility(selected, recombined) * (selected - recombined)
        return np.clip(best + change, 0.0, 1.0)


def search_places(
    search: ParticleSwarm | ParticipatorySearch,
    angles: FloatArray,
    tags: FloatArray,
    angle_std_rad: FloatArray,
    rng: np.random.Generator,
) -> Places:
    """Search for tag positions (B, K, 3), y >= 0; return them and the step of convergence.

    Directions are (B, 2, K), tags in the body frame (B, K, 3), standard deviations of the angles
    (B,).
    """
    unit = body_size(tags)
    rays = bearing.directions(angles)
    body = (tags / unit[:, None, None]).transpose(2, 1, 0)
    pairs = np.array(list(itertools.combinations(range(tags.shape[1]), 2))).T
    gap = body[:, pairs[0]] - body[:, pairs[1]]
    lengths = np.sqrt((gap * gap).sum(axis=0))
    cosines = np.einsum("bpi,bpi->pb", rays[:, pairs[0]], rays[:, pairs[1]])
    reach = search.reach * _farthest(pairs, lengths, cosines, angle_std_rad)

    def objective(x: FloatArray) -> FloatArray:
        total, d = np.zeros(x.shape[1:]), x * reach[..., None]
        for i, j, length, cosine in zip(
            *pairs, lengths[..., None], cosines[..., None], strict=True
        ):
            # |d_i u_i - d_j u_j|^2, never below zero by rounding.
            squared = (d[i] - d[j]) ** 2 + 2 * (1 - cosine) * d[i] * d[j]
            total += (np.sqrt(np.maximum(squared, 0.0)) - length) ** 2
        return total

    shape = tags.shape[1], len(tags)
    rest, iterations = np.zeros(shape), np.full(len(tags), search.steps)
    for step, found in enumerate(search.search(objective, shape, rng), start=1):
        moved = (np.abs(reach * found - rest) > _STILL).any(axis=0)
        rest = np.where(moved, reach * found, rest)
        iterations[moved] = step
    positions = rays * (unit * reach * found).T[..., None]
    return Places(positions, iterations, iterations <= search.steps - search.steps // 4)


def _farthest(
    pairs: np.ndarray, lengths: FloatArray, cosines: FloatArray, std_rad: FloatArray
) -> FloatArray:
    """Return the largest distance (K, B) of every tag by ``d_i sin(i, j) <= |c_i - c_j|``.

    This is the law of sines. The angle between two directions is reduced by 3 standard deviations.
    Beyond a right angle the bound is ``d_i <= |c_i - c_j|``.
    """
    between = np.arccos(np.clip(cosines, -1, 1)) - 3 * np.sqrt(2) * std_rad
    most = lengths / np.sin(np.clip(between, _SMALLEST_RAD, np.pi / 2))
    farthest = np.full((pairs.max() + 1, most.shape[1]), np.inf)
    for ends in pairs:
        np.minimum.at(farthest, ends, most)
    return farthest


def _better(
    x: FloatArray, cost: FloatArray, other: FloatArray, other_cost: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the cheaper of two individuals each, and its cost."""
    better = other_cost < cost
    return np.where(better, other, x), np.where(better, other_cost, cost)


def _at(x: FloatArray, index: np.ndarray) -> FloatArray:
    """Return the individuals (K, B) at an index (B,) into (K, B, P)."""
    return np.take_along_axis(x, index[None, :, None], axis=-1)[..., 0]


def _compatibility(x: FloatArray, y: FloatArray) -> FloatArray:
    return 1 - np.abs(x - y).mean(axis=0)
