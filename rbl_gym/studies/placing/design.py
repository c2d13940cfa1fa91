"""The search for a layout that makes b small, and the usual layouts."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rbl_gym import placement
from rbl_gym.checks import FloatArray
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.placement import layouts, search
from rbl_gym.placement.building import Problem
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.studies.placing import judging
from rbl_gym.studies.progress import Advance, silent

__all__ = [
    "Design",
    "design_layout",
    "usual_layouts",
]

# Poses over which layouts are scored while searching: racks make the score rough.
_N_POSES, _N_POSES_OBSTACLES = 64, 160
# First standard deviations of CMA-ES, in units of half the legal space: near the start, and far.
_SIGMAS = (0.1, 0.4)
_GENERATIONS = 80
# Random layouts whose median stands for "at random".
_RANDOM_DRAWS = 25


class FreeTask(PlacementTask):
    """A task scored over poses in the zones of a problem, outside of its obstacles."""

    problem: Problem

    def obstacles(self, context: Context) -> Obstacles:
        """Those of the problem."""
        return self.problem.obstacles

    @functools.cached_property
    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Rotations (P, 3, 3) and offsets (P, 3), spread evenly over what is free."""
        low, high = self.scene.volume.bounds()
        # Few places may be free: they are then taken in turns.
        places = np.resize(self.problem.free_places(self.n_poses), (self.n_poses, 3))
        half = 0.5 * (high - low)
        offsets = (places - 0.5 * (low + high)) / np.where(half > 0, half, 1.0)
        return PlacementTask(self.scene, self.n_anchors, n_poses=self.n_poses).poses[0], offsets


def free_task(problem: Problem, n_poses: int) -> FreeTask:
    """The problem's task over so many free poses."""
    task = FreeTask(problem.scene, problem.n_anchors, n_poses=n_poses)
    object.__setattr__(task, "problem", problem)
    return task


class Design(NamedTuple):
    """A layout (M, 3), how it was found, and what the searches reached: name -> layout."""

    anchors: FloatArray
    method: str
    searched: dict[str, FloatArray]


# --- design ----------------------------------------------------------------------------------


def design_layout(
    problem: Problem,
    seed: int,
    advance: Advance = silent,
    smaller: FloatArray | None = None,
) -> Design:
    """The best layout of a problem: greedy with swaps, then CMA-ES from it and from the ring.

    Parameters
    ----------
    problem, seed
        What is placed, and the seed of candidates and searches.
    advance
        Called after each of the `SEARCH_STEPS` steps.
    smaller
        A good layout (M - 1, 3) of one anchor fewer: with the best candidate added, it is one
        more start.
    """
    context = problem.context
    task = free_task(problem, _N_POSES_OBSTACLES if problem.obstacles else _N_POSES)
    rng = np.random.default_rng([seed, task.n_anchors])
    candidates = free_candidates(problem, rng, max(200, 4 * task.n_anchors))
    greedy = search.greedy(task, context, rng, candidates, swaps=True)
    searched = {"greedy with swaps": greedy}
    starts = {"greedy": greedy, "ring": layouts.ring(task, context, rng)}
    if smaller is not None:
        added = np.concatenate(
            [np.broadcast_to(smaller, (len(candidates), *smaller.shape)), candidates[:, None]],
            axis=-2,
        )
        scores = placement.score(task, _repeated(context, len(added)), added)
        starts["one fewer"] = searched["one added"] = added[scores.argmin()]
    advance()
    for sigma in _SIGMAS:
        found = search.cma_es(
            task,
            _repeated(context, len(starts)),
            rng,
            _GENERATIONS,
            sigma=sigma,
            start=np.array(list(starts.values())),
        )
        for name, anchors in zip(starts, found, strict=True):
            searched[f"CMA-ES from {name}, step {sigma:g}"] = anchors
        advance()
    # Nobody mounts to less than a millimetre.
    region = task.scene.anchor_region
    searched = {name: region.project(np.round(x, 3)) for name, x in searched.items()}
    searched |= usual(task, context, rng)
    legal = {
        name: anchors
        for name, anchors in searched.items()
        if not problem.obstacles.contain(anchors).any()
    }
    # Judged over more places than those that the search has seen.
    scores = {name: judging.score_of(problem, x, seed) for name, x in legal.items()}
    best = min(scores, key=scores.__getitem__)
    return Design(_in_order(legal[best], context.centre), best, searched)


SEARCH_STEPS = 1 + len(_SIGMAS)


def free_candidates(problem: Problem, rng: np.random.Generator, count: int) -> FloatArray:
    """Legal places (count, 3) outside of the obstacles, uniform.

    Raises
    ------
    ValueError
        If hardly any place is free.
    """
    drawn = problem.mounts.draw(rng.random((20 * count, 3)))
    free = drawn[~problem.obstacles.contain(drawn)]
    if len(free) < problem.n_anchors:
        raise ValueError("anchors have no legal place: obstacles cover all of them")
    return free[:count]


def _in_order(anchors: FloatArray, centre: FloatArray) -> FloatArray:
    """Anchors counted around the region, counter-clockwise from the x axis."""
    away = anchors - centre
    return anchors[np.argsort(np.arctan2(away[:, 1], away[:, 0]) % (2 * np.pi), kind="stable")]


def _repeated(context: Context, count: int) -> Context:
    return Context(*(np.broadcast_to(field, (count, *field.shape)) for field in context))


# --- the usual layouts -----------------------------------------------------------------------


def usual_layouts(problem: Problem, seed: int) -> dict[str, FloatArray]:
    """The usual layouts (M, 3) of a problem by their names."""
    rng = np.random.default_rng([seed, 2])
    return usual(free_task(problem, _N_POSES), problem.context, rng)


def usual(task: PlacementTask, context: Context, rng: np.random.Generator) -> dict[str, FloatArray]:
    """The usual layouts; `random` is the median of many draws."""
    found = {
        name: layout(task, context, rng)
        for name, layout in layouts.LAYOUTS.items()
        if name != "random"
    }
    many = layouts.random(task, _repeated(context, _RANDOM_DRAWS), rng)
    order = np.argsort(placement.score(task, _repeated(context, _RANDOM_DRAWS), many))
    return found | {"random": many[order[_RANDOM_DRAWS // 2]]}
