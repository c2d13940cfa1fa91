"""What the studio shows: a world, a layout of anchors, a slice; and what can be done to it.

A state is never changed: every function takes one and returns another.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, check_array
from rbl_gym.placement.building import Problem
from rbl_gym.placement.descent import descend
from rbl_gym.placement.exchange import refresh
from rbl_gym.placement.file_keys import MAX_ANCHORS, MIN_ANCHORS
from rbl_gym.placement.setting import Setting
from rbl_gym.studies.placing import choosing, design
from rbl_gym.studio.world import Knobs, World, knobs_of

__all__ = [
    "Layout",
    "Slice",
    "State",
    "add",
    "add_best",
    "fix",
    "move",
    "open_state",
    "optimise",
    "redo",
    "remove",
    "set_layout",
    "snap",
    "turn_knobs",
    "undo",
]

# Layouts that undo goes back to, at most.
_MOST_PAST = 200
# Anchors nearer to each other than this stand at one place, metres.
_APART_M = 1e-3
# Candidates among which a new anchor is the farthest from the others.
_CANDIDATES = 400
# Rounds of an optimisation, steps along the gradient in each; it ends where a round gains less.
_ROUNDS, _STEPS, _LEAST_GAIN = 12, 8, 2e-3


class Layout(NamedTuple):
    """Anchors (M, 3) in metres, and which of them (M,) stay where they are."""

    anchors: FloatArray
    fixed: BoolArray


class Slice(NamedTuple):
    """What the map shows, and where.

    Attributes
    ----------
    quantity
        A name of `maps.QUANTITIES`, or ``"requirement"``.
    up
        1: over x and y; 2: over x and z.
    share
        Where the plane cuts the third axis: 0 is the lower side of all zones, 1 the upper one.
    """

    quantity: str = "position"
    up: int = 1
    share: float = 0.5


_FIRST_SLICE = Slice()


@dataclass(frozen=True, eq=False)
class State:
    """What the studio shows.

    Parameters
    ----------
    world
        The problem and its knobs.
    layout
        The anchors.
    slice
        What the map shows.
    past, future
        Layouts that undo and redo go to, the nearest last.
    """

    world: World
    layout: Layout
    slice: Slice = _FIRST_SLICE
    past: tuple[Layout, ...] = ()
    future: tuple[Layout, ...] = ()

    @property
    def anchors(self) -> FloatArray:
        """(M, 3), metres."""
        return self.layout.anchors

    @property
    def fixed(self) -> BoolArray:
        """(M,): which anchors stay where they are."""
        return self.layout.fixed

    @property
    def problem(self) -> Problem:
        """The problem of this layout: its number of anchors, and those that stay."""
        anchors, fixed = self.layout
        return dataclasses.replace(self.world.problem, n_anchors=len(anchors), fixed=anchors[fixed])

    @property
    def score(self) -> float:
        """b of the layout, metres."""
        return self.world.score(self.anchors)


def open_state(problem: Problem, anchors: FloatArray | None = None) -> State:
    """The state in which a problem is opened.

    Parameters
    ----------
    problem
        What is placed. Of a problem whose anchors are all fixed, these are the layout, and none
        of them stays.
    anchors
        (M, 3), metres; None: the fixed ones, and the best of the usual layouts for the others.

    Raises
    ------
    ValueError
        Where the layout has too few or too many anchors, or one that stands where none may.
    """
    world, fixed = World(problem, knobs_of(problem)), problem.fixed
    if anchors is None:
        anchors = fixed if len(fixed) == problem.n_anchors else _first_layout(world)
    anchors = check_array("anchors", anchors, ("M", 3))
    if anchors.ndim != 2 or not MIN_ANCHORS <= len(anchors) <= MAX_ANCHORS:
        raise ValueError(
            f"anchors must be {MIN_ANCHORS} to {MAX_ANCHORS} places (M, 3), "
            f"got shape {anchors.shape}"
        )
    among = (np.abs(anchors[:, None] - fixed).max(axis=-1) < 1e-9).any(axis=1)
    stays = np.zeros(len(anchors), bool) if len(fixed) == problem.n_anchors else among
    legal = world.setting.legal(anchors) | among
    if not legal.all():
        k = int(np.argmin(legal))
        raise ValueError(
            f"anchors[{k}] = {anchors[k].tolist()} stands where none may: off the mounts, or "
            "inside of an obstacle"
        )
    return State(world, Layout(anchors, stays))


def _first_layout(world: World) -> FloatArray:
    """The best of the usual layouts whose anchors are legal; the fixed anchors come first."""
    problem, fixed = world.problem, world.problem.fixed
    found = []
    for anchors in design.usual_layouts(problem, 0).values():
        anchors = np.concatenate([fixed, anchors[: len(anchors) - len(fixed)]])
        if world.setting.legal(anchors[len(fixed) :]).all():
            found.append(anchors)
    if not found:
        drawn = design.design.free_candidates(problem, np.random.default_rng(0), 4)
        found = [np.concatenate([fixed, drawn[: problem.n_anchors - len(fixed)]])]
    return min(found, key=world.score)


# --- one anchor ------------------------------------------------------------------------------


def snap(world: World, point: FloatArray) -> FloatArray:
    """The legal mount (3,) nearest to a point, to the millimetre where the mount allows it."""
    mounts = world.problem.mounts
    return mounts.project(np.round(mounts.project(np.asarray(point, float)), 3))


def move(state: State, index: int, point: FloatArray) -> State:
    """The anchor at the legal mount nearest to a point.

    It stays where it was where that mount is inside of an obstacle, or has an anchor.

    Raises
    ------
    ValueError
        If there is no such anchor, or it is fixed.
    """
    _check_index(state, index)
    if state.fixed[index]:
        raise ValueError(f"anchor {index + 1} is fixed: release it first")
    place = snap(state.world, point)
    others = np.delete(state.anchors, index, axis=0)
    if not _is_free(state, place, others) or _are_one(place, state.anchors[index]):
        return state
    anchors = state.anchors.copy()
    anchors[index] = place
    return set_layout(state, Layout(anchors, state.fixed))


def add(state: State, point: FloatArray | None = None) -> State:
    """One more anchor, the last: at the mount nearest to a point, or far from the others.

    Raises
    ------
    ValueError
        If there are as many as there may be, or that mount is inside of an obstacle or taken.
    """
    if len(state.anchors) >= MAX_ANCHORS:
        raise ValueError(f"there may be {MAX_ANCHORS} anchors at most")
    if point is None:
        problem, rng = state.world.problem, np.random.default_rng(len(state.anchors))
        drawn = choosing.candidates(problem, rng, _CANDIDATES)
        apart = np.linalg.norm(drawn[:, None] - state.anchors, axis=-1).min(axis=1)
        point = drawn[int(apart.argmax())]
    place = snap(state.world, point)
    if not _is_free(state, place, state.anchors):
        raise ValueError("no anchor may stand there: inside of an obstacle, or taken")
    return _with_one_more(state, place)


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
    return _with_one_more(state, found[0])


def remove(state: State, index: int) -> State:
    """Without an anchor.

    Raises
    ------
    ValueError
        If there is no such anchor, it is fixed, or too few would be left.
    """
    _check_index(state, index)
    if state.fixed[index]:
        raise ValueError(f"anchor {index + 1} is fixed: release it first")
    if len(state.anchors) <= MIN_ANCHORS:
        raise ValueError(f"fewer than {MIN_ANCHORS} anchors never tell a pose")
    anchors, fixed = (np.delete(array, index, axis=0) for array in state.layout)
    return set_layout(state, Layout(anchors, fixed))


def fix(state: State, index: int, fixed: bool = True) -> State:
    """An anchor that stays where it is, in optimising too; or one that is released."""
    _check_index(state, index)
    if state.fixed[index] == fixed:
        return state
    stays = state.fixed.copy()
    stays[index] = fixed
    return set_layout(state, Layout(state.anchors, stays))


def _with_one_more(state: State, place: FloatArray) -> State:
    anchors = np.concatenate([state.anchors, place[None]])
    return set_layout(state, Layout(anchors, np.append(state.fixed, False)))


def _check_index(state: State, index: int) -> None:
    if not 0 <= index < len(state.anchors):
        raise ValueError(f"anchor must be 1 to {len(state.anchors)}, got {index + 1}")


def _is_free(state: State, place: FloatArray, others: FloatArray) -> bool:
    taken = _are_one(place, others).any()
    return not (taken or state.world.problem.obstacles.contain(place[None])[0])


def _are_one(place: FloatArray, others: FloatArray) -> BoolArray:
    """Which of the others (..., 3) stand at a place (3,)."""
    return np.abs(others - place).max(axis=-1) <= _APART_M


# --- the whole layout ------------------------------------------------------------------------


def set_layout(state: State, layout: Layout) -> State:
    """Another layout; undo goes back to the one before."""
    past = (*state.past, state.layout)[-_MOST_PAST:]
    return dataclasses.replace(state, layout=layout, past=past, future=())


def undo(state: State) -> State:
    """The layout before the last change; the same where there is none."""
    if not state.past:
        return state
    *past, layout = state.past
    future = (*state.future, state.layout)
    return dataclasses.replace(state, layout=layout, past=tuple(past), future=future)


def redo(state: State) -> State:
    """The layout before the last undo; the same where there is none."""
    if not state.future:
        return state
    *future, layout = state.future
    past = (*state.past, state.layout)
    return dataclasses.replace(state, layout=layout, past=past, future=tuple(future))


def turn_knobs(state: State, **knobs: float) -> State:
    """With other `Knobs`, given by their names."""
    changed: Knobs = state.world.knobs._replace(**knobs)
    return dataclasses.replace(state, world=state.world.with_knobs(changed))


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
