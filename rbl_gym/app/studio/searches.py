"""Searches from the current layout: gradient descent, and the best position for one more anchor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rbl_gym.app.studio.state import Layout, State, set_layout, with_one_more
from rbl_gym.placement.descent import descend
from rbl_gym.placement.exchange import refresh
from rbl_gym.placement.file_keys import MAX_ANCHORS
from rbl_gym.studies.placing import choosing

__all__ = ["add_best", "optimise"]

# Rounds of an optimisation, gradient steps of a round, and the minimum gain of a round.
_ROUNDS, _STEPS, _LEAST_GAIN = 12, 8, 2e-3


def add_best(state: State, seed: int = 0) -> State:
    """Add an anchor at the best position. The same errors as in `add`."""
    if len(state.anchors) >= MAX_ANCHORS:
        raise ValueError(f"a layout has at most {MAX_ANCHORS} anchors")
    found = choosing.next_anchor(state.problem, state.anchors, seed)
    if found is None:
        raise ValueError("no mount is free for another anchor")
    return with_one_more(state, found)


def optimise(state: State, seed: int = 0) -> Iterator[tuple[float, State]]:
    """Improve the layout step by step; the fixed anchors do not move.

    Every round takes some gradient steps, and draws fresh candidates if there are obstacles. All
    rounds count as one change: undo restores the layout from before the first. Yields progress from
    0 to 1, and a state whose score is at most the previous one.
    """
    world, (start, fixed) = state.world, state.layout
    free = np.flatnonzero(~fixed)
    if not len(free):
        yield 1.0, state
        return
    setting = world.setting.with_fixed(start[fixed])
    rng = np.random.default_rng([seed, len(start)])
    best, least, reached = state, state.score, start[free]
    for number in range(_ROUNDS):
        before = least
        reached, score = descend(setting, reached, _STEPS)
        if not setting.is_smooth:
            anchors = start.copy()
            anchors[free] = reached
            if score < least:
                best, least = set_layout(state, Layout(anchors, fixed)), score
                yield (number + 0.5) / _ROUNDS, best
            reached, score = refresh(setting, reached, rng)
        if score < least:
            anchors = start.copy()
            anchors[free] = reached
            best, least = set_layout(state, Layout(anchors, fixed)), score
        if least > before * (1 - _LEAST_GAIN) and number:
            break
        yield (number + 1) / _ROUNDS, best
    yield 1.0, best
