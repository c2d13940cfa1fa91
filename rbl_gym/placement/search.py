"""Searches that use the score: best of many, greedy, along the gradient, hybrid, CMA-ES.

As in `layouts`, a search is a function ``(task, context, rng) -> anchors (..., M, 3)``. Options are
keywords. CMA-ES is that of the package `cmaes` (extra ``placement``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray, check_array, check_number
from rbl_gym.extras import require
from rbl_gym.placement import exchange, setting
from rbl_gym.placement.descent import descend
from rbl_gym.placement.layouts import Layout, amortised, ring
from rbl_gym.placement.problem import Context, PlacementTask, information, score, score_of

__all__ = [
    "SEARCHES", "STRONGEST", "along_gradient", "best_of_random", "cma_es", "greedy",
    "greedy_swaps", "hybrid", "shared_layout",
]  # fmt: skip

# Candidates of `greedy`.
_DRAWN = 150
# Candidates of a greedy start, rounds of fresh ones after them, and then gradient steps.
_CANDIDATES, _ROUNDS, _STEPS = 100, 3, 12
# Initial standard deviation of CMA-ES, in the action box [-1, 1].
_SIGMA = 0.6
# Hybrid search: greedy starts, turns of fresh candidates and gradient, steps of each turn.
_STARTS, _TURNS, _STEPS_OF_TURN = 2, 2, 20


def best_of_random(
    task: PlacementTask, context: Context, rng: np.random.Generator, tries: int = 100
) -> FloatArray:
    """Return the best of `tries` random layouts.

    Arguments as in `cma_es`.
    """
    check_number("tries", tries, low=1)
    batch = context.centre.shape[:-1]
    drawn = task.scene.anchor_region.draw(rng.random((*batch, tries, task.n_anchors, 3)))
    best = score(task, expand(context), drawn).argmin(axis=-1)
    return np.take_along_axis(drawn, best[..., None, None, None], axis=-3)[..., 0, :, :]


def greedy(
    task: PlacementTask,
    context: Context,
    rng: np.random.Generator,
    candidates: FloatArray | None = None,
    swaps: bool = False,
) -> FloatArray:
    """Add one anchor after the other, each the best among candidates.

    Parameters
    ----------
    task, context
        The problem.
    rng
        Draws the candidates.
    candidates
        Candidates (K, 3); None: 150 uniform legal positions, separate for each context.
    swaps
        Whether to replace single anchors by candidates afterwards, as long as this helps.
    """
    batch = context.centre.shape[:-1]
    if candidates is None:
        drawn = task.scene.anchor_region.draw(rng.random((*batch, _DRAWN, 3)))
    else:
        shared = check_array("candidates", candidates, ("K", 3))
        drawn = np.broadcast_to(shared, (*batch, *shared.shape[-2:]))
    if drawn.shape[-2] < task.n_anchors:
        raise ValueError(
            f"candidates must be at least n_anchors = {task.n_anchors}, got {drawn.shape[-2]}"
        )
    result = np.empty((*batch, task.n_anchors, 3))
    for where in np.ndindex(batch):
        one = Context(*(field[where] for field in context))
        chosen = _greedy(task, one, drawn[where], swaps)
        result[where] = drawn[where][chosen]
    return result


def greedy_swaps(task: PlacementTask, context: Context, rng: np.random.Generator) -> FloatArray:
    """Return `greedy` with swaps."""
    return greedy(task, context, rng, swaps=True)


def _greedy(
    task: PlacementTask, context: Context, candidates: FloatArray, swaps: bool
) -> list[int]:
    """Return indices of the chosen candidates (K, 3) of one problem, without repetition."""
    # Information is a sum over the anchors, so each candidate's is computed once.
    parts = information(task, context, candidates[:, None])
    chosen: list[int] = []
    total = np.zeros(parts.shape[1:])
    for _ in range(task.n_anchors):
        scores = score_of(task, total + parts)
        scores[chosen] = math.inf
        chosen.append(int(scores.argmin()))
        total = total + parts[chosen[-1]]
    best = float(score_of(task, total))
    improved = swaps
    while improved:
        improved = False
        for k, old in enumerate(chosen):
            without = total - parts[old]
            scores = score_of(task, without + parts)
            scores[chosen] = math.inf
            new = int(scores.argmin())
            if scores[new] < best * (1 - 1e-9):
                chosen[k], best, improved = new, float(scores[new]), True
                total = without + parts[new]
    return chosen


def along_gradient(
    task: PlacementTask,
    context: Context,
    rng: np.random.Generator,
    evaluations: int = 30,
    start: FloatArray | None = None,
) -> FloatArray:
    """Minimize by L-BFGS-B from the ring; with obstacles, from greedy and fresh candidates.

    Parameters
    ----------
    task, context, rng
        As in `cma_es`.
    evaluations
        Largest number of evaluations of score and gradient per context; fewer after greedy.
    start
        Legal anchors (..., M, 3) to start from instead, for example those of a policy.
    """
    if start is None:
        result = ring(task, context, rng)
    else:
        shape = (*context.centre.shape[:-1], task.n_anchors, 3)
        result = np.array(np.broadcast_to(check_array("start", start, shape[-2:]), shape))
    for where, seen in _settings(task, context):
        if seen.obstacles and start is None:
            begin = _greedy_start(task, seen, rng)
            result[where], _ = _in_turns(seen, begin, rng, 1, _STEPS)
        else:
            result[where], _ = descend(seen, result[where], evaluations)
    return result


def hybrid(task: PlacementTask, context: Context, rng: np.random.Generator) -> FloatArray:
    """Alternate fresh candidates and the gradient, from the ring and from greedy with swaps.

    This is the search of `placement.design` over the poses of an environment's problem. It takes
    several times as long as `along_gradient`. Arguments as in `cma_es`.
    """
    result = ring(task, context, rng)
    for where, seen in _settings(task, context):
        starts = [result[where], *(_greedy_start(task, seen, rng) for _ in range(_STARTS))]
        found = [_in_turns(seen, one, rng, _TURNS, _STEPS_OF_TURN) for one in starts]
        result[where], _ = min(found, key=lambda pair: pair[1])
    return result


def _settings(
    task: PlacementTask, context: Context
) -> Iterator[tuple[tuple[int, ...], setting.Setting]]:
    """Yield each problem of a batch with its index."""
    for where in np.ndindex(context.centre.shape[:-1]):
        yield where, setting.of_task(task, Context(*(field[where] for field in context)))


def _greedy_start(
    task: PlacementTask, seen: setting.Setting, rng: np.random.Generator
) -> FloatArray:
    """Return a layout (M, 3) by greedy with swaps, outside of obstacles."""
    region = task.scene.anchor_region
    candidates = region.draw(rng.random((max(_CANDIDATES, 4 * task.n_anchors), 3)))
    free = candidates[~seen.obstacles.contain(candidates)]
    candidates = free if len(free) >= task.n_anchors else candidates
    parts = seen.parts(candidates)
    return candidates[exchange.swap(seen, parts, exchange.choose(seen, parts, task.n_anchors))]


def _in_turns(
    seen: setting.Setting, anchors: FloatArray, rng: np.random.Generator, turns: int, steps: int
) -> tuple[FloatArray, float]:
    """Return a layout after `turns` of fresh candidates and gradient steps, and its score."""
    score = math.inf
    for _ in range(turns):
        for _ in range(_ROUNDS):
            anchors, _ = exchange.refresh(seen, anchors, rng)
        anchors, score = descend(seen, anchors, steps)
    return anchors, score


def cma_es(
    task: PlacementTask,
    context: Context,
    rng: np.random.Generator,
    generations: int = 120,
    population: int = 16,
    start: FloatArray | None = None,
) -> FloatArray:
    """Run CMA-ES on the actions of all anchors, separately for each context.

    Parameters
    ----------
    task, context, rng
        The problem, contexts (...), and the source of all random numbers.
    generations, population
        Their product is the number of layouts scored for each context.
    start
        Anchors (..., M, 3) to start from, for example those of a policy; None: near the centre.

    Returns
    -------
    The best layout evaluated, including the start.

    Raises
    ------
    MissingExtraError
        Without the package `cmaes`.
    """
    batch = context.centre.shape[:-1]
    size = 3 * task.n_anchors
    mean = 0.1 * rng.standard_normal((*batch, size))
    if start is not None:
        begin = check_array("start", start, (task.n_anchors, 3))
        mean = np.broadcast_to(task.scene.anchor_region.action(begin), (*batch, *begin.shape[-2:]))
        mean = mean.reshape((*batch, size))
    flat = mean.reshape(-1, size)
    strategies = [_strategy(one, population, rng) for one in flat]
    best = flat.copy()
    best_score = _scores(task, context, best.reshape((*batch, size))).reshape(-1)
    for _ in range(generations):
        asked = np.array([[one.ask() for _ in range(population)] for one in strategies])
        asked = asked.reshape(len(strategies), population, size)
        scores = _scores(task, expand(context), asked.reshape((*batch, population, size)))
        scores = scores.reshape(-1, population)
        for one, solutions, values in zip(strategies, asked, np.log(scores), strict=True):
            one.tell(list(zip(solutions, values.tolist(), strict=True)))
        row = np.arange(len(asked))
        least = scores.argmin(axis=-1)
        better = scores[row, least] < best_score
        best_score = np.where(better, scores[row, least], best_score)
        best = np.where(better[:, None], asked[row, least], best)
    return _placed(task, best.reshape((*batch, size)))


def shared_layout(
    task: PlacementTask,
    contexts: Context,
    rng: np.random.Generator,
    generations: int = 120,
    population: int = 16,
) -> FloatArray:
    """Return one layout (M, 3) for all contexts (C,): CMA-ES on the mean log score.

    Arguments as in `cma_es`.
    """
    if contexts.centre.ndim != 2:
        raise ValueError(f"contexts must have one batch axis, got {contexts.centre.shape[:-1]}")
    size = 3 * task.n_anchors
    strategy = _strategy(0.1 * rng.standard_normal(size), population, rng)
    best, best_value = np.zeros(size), math.inf
    for _ in range(generations):
        asked = np.array([strategy.ask() for _ in range(population)])
        values = np.log(_scores(task, contexts, asked[:, None])).mean(axis=-1)
        strategy.tell(list(zip(asked, values.tolist(), strict=True)))
        if values.min() < best_value:
            best, best_value = asked[values.argmin()], float(values.min())
    return _placed(task, best)


def _strategy(mean: FloatArray, population: int, rng: np.random.Generator) -> Any:
    require("cmaes", "placement", "the reference cma-es")
    from cmaes import CMA

    seed = int(rng.integers(2**31))
    return CMA(mean=mean, sigma=_SIGMA, population_size=population, seed=seed)


def _placed(task: PlacementTask, actions: FloatArray) -> FloatArray:
    """Return anchors (..., M, 3) of flat actions (..., 3 M)."""
    return task.scene.anchor_region.place(actions.reshape((*actions.shape[:-1], -1, 3)))


def _scores(task: PlacementTask, context: Context, actions: FloatArray) -> FloatArray:
    return score(task, context, _placed(task, actions))


def expand(context: Context) -> Context:
    """Return the contexts with one more batch axis, for several layouts of each."""
    return Context(
        context.centre[..., None, :], context.half[..., None, :], context.racks[..., None, :, :]
    )


SEARCHES: dict[str, Layout] = {
    "best-of-random": best_of_random,
    "greedy": greedy,
    "greedy-swaps": greedy_swaps,
    "gradient": along_gradient,
    "hybrid": hybrid,
    "amortised": amortised,
    "cma-es": cma_es,
}
# Layouts whose best one counts as the best known.
STRONGEST = ("gradient", "hybrid", "cma-es")
