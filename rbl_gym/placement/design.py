"""Search for the layout of a problem with the smallest score.

Greedy search with swaps over candidates gives starts. Fresh candidates and the gradient then
improve each of them in turn. Fresh candidates, near and far, find ways past walls. The gradient
moves all anchors at once. Early stages use few positions. The last one uses enough positions for
the layout to be as good at positions that the search has not used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.building import Problem
from rbl_gym.placement.descent import descend
from rbl_gym.placement.exchange import choose, refresh, swap
from rbl_gym.placement.sample import sample
from rbl_gym.placement.setting import Setting, of_problem

__all__ = ["STAGES", "find_layout", "free_candidates"]

# Numbers of positions in each stage, and of layouts that go on to the next.
STAGES, _KEPT = (256, 1024, 2048), (2, 1, 1)
# Rounds of fresh candidates in each stage, and gradient steps after them.
_FRESH, _STEPS = 3, 12
# Gradient steps without obstacles: the gradient alone then finds the layout.
_STEPS_FREE = 40
# Number of candidates of a greedy start.
_CANDIDATES = 400
# There are so many greedy starts, or fewer if together they had more than so many anchors.
_STARTS, _ANCHORS = 4, 32


def find_layout(
    problem: Problem,
    rng: np.random.Generator,
    starts: Mapping[str, FloatArray] | None = None,
    advance: Callable[[], object] = lambda: None,
) -> tuple[FloatArray, str]:
    """Return the best layout (M, 3) found, fixed anchors first, and the name of its start.

    Parameters
    ----------
    problem
        The problem.
    rng
        Source of all random numbers.
    starts
        Further starts by name: legal positions (K, 3) of the anchors that are not fixed. If K is
        too small, the missing anchors are added greedily.
    advance
        Called after each of the stages.

    Raises
    ------
    ValueError
        If there are fewer legal positions than anchors.
    """
    count = problem.n_anchors - len(problem.fixed)
    if not count:
        return problem.fixed.copy(), "fixed"
    found: dict[str, FloatArray] = {}
    for stage, kept in zip(STAGES, _KEPT, strict=True):
        setting = of_problem(problem, sample(problem, stage))
        if not found:
            found = _starts(problem, setting, rng, count, starts or {})
        improved = {name: _improved(setting, layout, rng) for name, layout in found.items()}
        names = sorted(improved, key=lambda name: improved[name][1])[:kept]
        found = {name: improved[name][0] for name in names}
        advance()
    name, layout = next(iter(found.items()))
    return np.concatenate([problem.fixed, layout]), name


def _starts(
    problem: Problem,
    setting: Setting,
    rng: np.random.Generator,
    count: int,
    given: Mapping[str, FloatArray],
) -> dict[str, FloatArray]:
    """Return layouts (`count`, 3): greedy with swaps for draws of candidates, and given ones."""
    most = 1 if problem.mounts.listed() is not None else max(1, min(_STARTS, _ANCHORS // count))
    number = max(_CANDIDATES, 4 * count)
    first, *others = (free_candidates(problem, rng, number) for _ in range(most))
    parts = setting.parts(first)
    found = {"greedy": first[_greedy(setting, parts, count)]}
    for name, start in given.items():
        added = choose(setting.with_fixed(start), parts, count - len(start))
        found[name] = np.concatenate([start, first[added]])
    for k, drawn in enumerate(others, start=2):
        found[f"greedy {k}"] = drawn[_greedy(setting, setting.parts(drawn), count)]
    return found


def _greedy(setting: Setting, parts: FloatArray, count: int) -> list[int]:
    """Return the indices of `count` candidates, chosen greedily and then swapped."""
    return swap(setting, parts, choose(setting, parts, count))


def _improved(
    setting: Setting, layout: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, float]:
    """Return a layout after fresh candidates and gradient steps, and its score."""
    if setting.is_smooth:
        return descend(setting, layout, _STEPS_FREE)
    for _ in range(_FRESH):
        layout, _ = refresh(setting, layout, rng)
    return descend(setting, layout, _STEPS)


def free_candidates(problem: Problem, rng: np.random.Generator, count: int) -> FloatArray:
    """Return legal positions (count, 3) outside of the obstacles, uniform; or all listed mounts.

    Raises
    ------
    ValueError
        If there are fewer legal positions than anchors.
    """
    drawn = problem.mounts.listed()
    if drawn is None:
        drawn = problem.mounts.draw(rng.random((20 * count, 3)))
    free = drawn[~problem.obstacles.contain(drawn)]
    if len(free) < problem.n_anchors - len(problem.fixed):
        raise ValueError(
            f"{problem.n_anchors - len(problem.fixed)} anchors cannot be mounted: obstacles leave "
            f"{len(free)} permitted positions"
        )
    return free if problem.mounts.listed() is not None else free[:count]
