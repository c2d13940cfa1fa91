"""Better layouts from the one that is shown: downhill from it, and the best place for one more."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rbl_gym.app.studio.state import Layout, State, set_layout, with_one_more
from rbl_gym.checks import FloatArray
from rbl_gym.placement.descent import descend
from rbl_gym.placement.exchange import refresh
from rbl_gym.placement.file_keys import MAX_ANCHORS
from rbl_gym.placement.setting import Setting
from rbl_gym.studies.placing import choosing

__all__ = ["add_best", "optimise"]

# Rounds of an optimisation, steps along the gradient in each; it ends where a round gains less.
_ROUNDS, _STEPS, _LEAST_GAIN = 12, 8, 2e-3


def add_best(state: State, seed: int = 0) -> State:
    """One more anchor where it helps most. Arguments and errors as `add`.

    Parameters
    ----------
    state
        The layout as it is.
    seed
        Of the candidates.
    """
    if len(state.anchors) >= MAX_ANCHORS:
        raise ValueError(f"there may be {MAX_ANCHORS} anchors at most")
    found = choosing.next_anchor(state.problem, state.anchors, seed)
    if found is None:
        raise ValueError("no mount is left for one more anchor")
    return with_one_more(state, found[0])


def optimise(state: State, seed: int = 0) -> Iterator[tuple[float, State]]:
    """Better and better layouts, from this one on; the fixed anchors stay.

    In every round some steps along the gradient, and fresh candidates where something is in the
    way. All of them are one change: undo goes back to the layout at the beginning.

    Parameters
    ----------
    state
        Where it begins.
    seed
        Of the fresh candidates.

    Yields
    ------
    How much is done, from 0 to 1, and a state whose score is at most that of the one before.
    """
    world, (start, fixed) = state.world, state.layout
    free = np.flatnonzero(~fixed)
    if not len(free):
        yield 1.0, state
        return
    setting = _with_fixed(world.setting, start[fixed])
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


def _with_fixed(setting: Setting, fixed: FloatArray) -> Setting:
    """The setting in which anchors count as known."""
    if not len(fixed):
        return setting
    return setting._replace(sample=setting.sample._replace(prior=setting.told(fixed)))
