"""Search for a layout that minimises b, and compute the usual layouts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import placement
from rbl_gym.checks import FloatArray, check_one_of
from rbl_gym.geometry.regions import Box, Shell, Walls
from rbl_gym.placement import amortised, design, layouts
from rbl_gym.placement.building import Problem
from rbl_gym.placement.problem import Context
from rbl_gym.studies.placing import ranking
from rbl_gym.studies.progress import Advance, silent

__all__ = ["STARTS", "Design", "design_layout", "usual_layouts"]

# Methods of the search: `placement.design`, or `placement.amortised` with this many steps.
STARTS, _EVALUATIONS = ("search", "amortised"), 20
# Usual layouts that are also start layouts of the search, if there are no obstacles.
_STARTS = ("grid", "ring")
# The layout "random" is the median of this many random layouts.
_RANDOM_DRAWS = 25


class Design(NamedTuple):
    """A layout (M, 3), the search that found it, and all results: name -> layout."""

    anchors: FloatArray
    method: str
    searched: dict[str, FloatArray]


# --- design ----------------------------------------------------------------------------------


def design_layout(
    problem: Problem,
    seed: int,
    advance: Advance = silent,
    start: FloatArray | None = None,
    begin: str = "search",
) -> Design:
    """Return the best layout of a problem, from `placement.design` or a usual one.

    Parameters
    ----------
    problem, seed
        The problem, and the seed of all randomness.
    advance
        Called after each of the `SEARCH_STEPS` steps.
    start
        An additional start: a layout (K, 3), its first rows the fixed anchors. If it has fewer
        anchors than needed, the others are added.
    begin
        One of `STARTS`: the method of the search.
    """
    check_one_of("start", begin, STARTS)
    fixed, rng = problem.fixed, np.random.default_rng([seed, problem.n_anchors])
    drawn = {} if len(fixed) else usual(problem, rng)
    starts = {}
    if isinstance(problem.mounts, Box | Shell | Walls) and not problem.obstacles:
        starts = {name: layout for name, layout in drawn.items() if name in _STARTS}
    if start is not None:
        starts["given"] = start[len(fixed) :]
    if begin == "amortised":
        found, name = amortised.of_problem(problem, _EVALUATIONS), "amortised"
        advance(SEARCH_STEPS)
    else:
        found, name = design.find_layout(problem, rng, starts, advance)
        name = f"search from {name}"
    searched = {name: np.concatenate([fixed, _rounded(problem, found[len(fixed) :])])}
    if start is not None and len(start) == problem.n_anchors:
        searched["as given"] = start
    searched |= drawn
    legal = {
        name: anchors
        for name, anchors in searched.items()
        if not problem.obstacles.contain(anchors).any()
    }
    # Evaluated at more positions than the search has used.
    scores = {name: ranking.score_of(problem, x, seed) for name, x in legal.items()}
    best = min(scores, key=scores.__getitem__)
    ordered = _in_order(legal[best][len(fixed) :], problem.context.centre)
    return Design(np.concatenate([fixed, ordered]), best, searched)


SEARCH_STEPS = len(design.STAGES)


def _rounded(problem: Problem, anchors: FloatArray) -> FloatArray:
    """Return anchors rounded to the millimetre, if they remain legal."""
    rounded = problem.mounts.project(np.round(anchors, 3))
    return np.where(problem.obstacles.contain(rounded)[:, None], anchors, rounded)


def _in_order(anchors: FloatArray, centre: FloatArray) -> FloatArray:
    """Return anchors in counter-clockwise order around the region, from the x axis."""
    away = anchors - centre
    return anchors[np.argsort(np.arctan2(away[:, 1], away[:, 0]) % (2 * np.pi), kind="stable")]


def _repeated(context: Context, count: int) -> Context:
    return Context(*(np.broadcast_to(field, (count, *field.shape)) for field in context))


# --- the usual layouts -----------------------------------------------------------------------


def usual_layouts(problem: Problem, seed: int) -> dict[str, FloatArray]:
    """Return the usual layouts (M, 3) of a problem by their names."""
    return usual(problem, np.random.default_rng([seed, 2]))


def usual(problem: Problem, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Return the usual layouts; `random` is the median of many draws."""
    context = problem.context
    found = {
        name: layout(problem, context, rng)
        for name, layout in layouts.LAYOUTS.items()
        if name != "random"
    }
    many = layouts.random(problem, _repeated(context, _RANDOM_DRAWS), rng)
    order = np.argsort(placement.score(problem, context, many))
    return found | {"random": many[order[_RANDOM_DRAWS // 2]]}
