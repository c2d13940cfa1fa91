"""The state of the studio: a world, a layout of anchors, a slice; and the functions that change it.

States are immutable: every function takes a state and returns a new one.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.app.studio.world import Knobs, World, knobs_of
from rbl_gym.checks import BoolArray, FloatArray, check_array
from rbl_gym.placement.building import Problem
from rbl_gym.placement.file_keys import MAX_ANCHORS, MIN_ANCHORS
from rbl_gym.studies.placing import choosing, design

__all__ = [
    "Layout",
    "Slice",
    "State",
    "add",
    "cut",
    "fix",
    "move",
    "open_state",
    "place_body",
    "plane",
    "redo",
    "remove",
    "set_layout",
    "snap",
    "turn_knobs",
    "undo",
]

# Maximum number of layouts that undo can restore.
_MOST_PAST = 200
# Anchors closer than this count as one position, metres.
_APART_M = 1e-3
# Candidates for a new anchor; the one farthest from the others is taken.
_CANDIDATES = 400


class Layout(NamedTuple):
    """Anchors (M, 3) in metres, and which of them (M,) are fixed."""

    anchors: FloatArray
    fixed: BoolArray


class Slice(NamedTuple):
    """Quantity and plane of the map.

    Attributes
    ----------
    quantity
        A name of `maps.QUANTITIES`, or ``"requirement"``.
    up
        1: over x and y; 2: over x and z.
    share
        Position of the plane along the third axis: 0 is the lower side of all zones, 1 the upper
        side.
    """

    quantity: str = "position"
    up: int = 1
    share: float = 0.5


_FIRST_SLICE = Slice()


@dataclass(frozen=True, eq=False)
class State:
    """The state of the studio; `body` is the position (3,) of the body on the slice, metres.

    `past` and `future` are layouts for undo and redo, the next one last.
    """

    world: World
    layout: Layout
    body: FloatArray
    slice: Slice = _FIRST_SLICE
    past: tuple[Layout, ...] = ()
    future: tuple[Layout, ...] = ()

    @property
    def anchors(self) -> FloatArray:
        """(M, 3), metres."""
        return self.layout.anchors

    @property
    def fixed(self) -> BoolArray:
        """(M,): which anchors are fixed."""
        return self.layout.fixed

    @property
    def problem(self) -> Problem:
        """The problem with this layout's number of anchors and its fixed anchors."""
        anchors, fixed = self.layout
        return dataclasses.replace(self.world.problem, n_anchors=len(anchors), fixed=anchors[fixed])

    @property
    def score(self) -> float:
        """b of the layout, metres."""
        return self.world.score(self.anchors)


def open_state(problem: Problem, anchors: FloatArray | None = None) -> State:
    """Return the initial state of a problem.

    Parameters
    ----------
    problem
        The placement problem. If all its anchors are fixed, they become the layout and are
        released.
    anchors
        (M, 3), metres; None: the fixed anchors, and the best usual layout for the others.

    Raises
    ------
    ValueError
        If the layout has too few or too many anchors, or an anchor at an illegal position.
    """
    world, fixed = World(problem, knobs_of(problem)), problem.fixed
    if anchors is None:
        anchors = fixed if len(fixed) == problem.n_anchors else _first_layout(world)
    anchors = check_array("anchors", anchors, ("M", 3))
    if anchors.ndim != 2 or not MIN_ANCHORS <= len(anchors) <= MAX_ANCHORS:
        raise ValueError(
            f"anchors must be {MIN_ANCHORS} to {MAX_ANCHORS} positions (M, 3), "
            f"got shape {anchors.shape}"
        )
    among = (np.abs(anchors[:, None] - fixed).max(axis=-1) < 1e-9).any(axis=1)
    stays = np.zeros(len(anchors), bool) if len(fixed) == problem.n_anchors else among
    legal = world.setting.legal(anchors) | among
    if not legal.all():
        k = int(np.argmin(legal))
        raise ValueError(
            f"anchors[{k}] = {anchors[k].tolist()} is not a legal position: off the mounts, or "
            "inside an obstacle"
        )
    start = State(world, Layout(anchors, stays), np.mean(problem.corners(), axis=0))
    return start if not problem.obstacles.contain(start.body) else _beside(start)


def _first_layout(world: World) -> FloatArray:
    """Return the best usual layout with legal, distinct anchors; the fixed ones are first."""
    problem, fixed = world.problem, world.problem.fixed
    count = problem.n_anchors - len(fixed)
    drawn = design.design.free_candidates(problem, np.random.default_rng(0), max(count, 4))
    usual = [anchors[:count] for anchors in design.usual_layouts(problem, 0).values()]
    found = [np.concatenate([fixed, anchors]) for anchors in usual]
    found = [layout for layout in found if _is_proper(world, layout, len(fixed))]
    return min(found, key=world.score) if found else np.concatenate([fixed, drawn[:count]])


def _is_proper(world: World, anchors: FloatArray, n_fixed: int) -> bool:
    """Return whether all anchors are distinct, and those after the fixed ones are legal."""
    apart = np.abs(anchors[:, None] - anchors).max(axis=-1) + 2 * _APART_M * np.eye(len(anchors))
    return bool((apart > _APART_M).all() and world.setting.legal(anchors[n_fixed:]).all())


# --- one anchor ------------------------------------------------------------------------------


def snap(world: World, point: FloatArray) -> FloatArray:
    """Return the legal mount (3,) nearest to a point, rounded to millimetres if possible."""
    mounts = world.problem.mounts
    return mounts.project(np.round(mounts.project(np.asarray(point, float)), 3))


def move(state: State, index: int, point: FloatArray) -> State:
    """Move an anchor to the legal mount nearest to a point.

    The anchor keeps its position if that mount is inside an obstacle or taken.

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
    """Add an anchor, as the last one, at the mount nearest to a point, or far from the others.

    Raises
    ------
    ValueError
        If the number of anchors is at its maximum, or that mount is inside an obstacle or taken.
    """
    if len(state.anchors) >= MAX_ANCHORS:
        raise ValueError(f"a layout has at most {MAX_ANCHORS} anchors")
    if point is None:
        problem, rng = state.world.problem, np.random.default_rng(len(state.anchors))
        drawn = choosing.candidates(problem, rng, _CANDIDATES)
        apart = np.linalg.norm(drawn[:, None] - state.anchors, axis=-1).min(axis=1)
        place = snap(state.world, drawn[int(apart.argmax())])
    else:
        place = snap(state.world, point)
    if not _is_free(state, place, state.anchors):
        raise ValueError("the position is inside an obstacle, or another anchor is there")
    return with_one_more(state, place)


def remove(state: State, index: int) -> State:
    """Remove an anchor.

    Raises
    ------
    ValueError
        If there is no such anchor, it is fixed, or too few anchors would be left.
    """
    _check_index(state, index)
    if state.fixed[index]:
        raise ValueError(f"anchor {index + 1} is fixed: release it first")
    if len(state.anchors) <= MIN_ANCHORS:
        raise ValueError(f"a pose needs at least {MIN_ANCHORS} anchors")
    anchors = np.delete(state.anchors, index, axis=0)
    return set_layout(state, Layout(anchors, np.delete(state.fixed, index)))


def fix(state: State, index: int, fixed: bool = True) -> State:
    """Fix an anchor, also for optimisation, or release it."""
    _check_index(state, index)
    if state.fixed[index] == fixed:
        return state
    stays = state.fixed.copy()
    stays[index] = fixed
    return set_layout(state, Layout(state.anchors, stays))


def with_one_more(state: State, place: FloatArray) -> State:
    """Add an anchor, as the last one, at a legal position."""
    anchors = np.concatenate([state.anchors, place[None]])
    return set_layout(state, Layout(anchors, np.append(state.fixed, False)))


def _check_index(state: State, index: int) -> None:
    if not 0 <= index < len(state.anchors):
        raise ValueError(f"anchor must be 1 to {len(state.anchors)}, got {index + 1}")


def _is_free(state: State, place: FloatArray, others: FloatArray) -> bool:
    taken = _are_one(place, others).any()
    return not (taken or state.world.problem.obstacles.contain(place[None])[0])


def _are_one(place: FloatArray, others: FloatArray) -> BoolArray:
    """Return which of the others (..., 3) coincide with a position (3,)."""
    return np.abs(others - place).max(axis=-1) <= _APART_M


# --- the slice and the body ------------------------------------------------------------------


def plane(state: State) -> tuple[FloatArray, FloatArray]:
    """Return corners (3,) of the slice: the box of all zones, cut at its share; metres."""
    low, high = (corner.copy() for corner in state.world.base.corners())
    third = 3 - state.slice.up
    low[third] = high[third] = low[third] + state.slice.share * (high - low)[third]
    return low, high


def cut(state: State, **fields: Any) -> State:
    """Change fields of the `Slice`; the body moves onto the new slice."""
    changed = dataclasses.replace(state, slice=state.slice._replace(**fields))
    return place_body(changed, state.body)


def place_body(state: State, point: FloatArray) -> State:
    """Move the body to the position on the slice nearest to a point, outside of all obstacles.

    If that position is inside an obstacle, only the coordinate normal to the slice changes.
    """
    low, high = plane(state)
    place = np.clip(point, low, high)
    if state.world.problem.obstacles.contain(place[None])[0]:
        place = np.clip(state.body, low, high)
    return dataclasses.replace(state, body=place)


def _beside(state: State) -> State:
    """Move the body to the free position of the zones nearest to its own."""
    places = state.world.sample.places
    return dataclasses.replace(
        state, body=places[np.linalg.norm(places - state.body, axis=1).argmin()]
    )


# --- the whole layout ------------------------------------------------------------------------


def set_layout(state: State, layout: Layout) -> State:
    """Replace the layout; undo restores the previous one."""
    past = (*state.past, state.layout)[-_MOST_PAST:]
    return dataclasses.replace(state, layout=layout, past=past, future=())


def undo(state: State) -> State:
    """Restore the layout before the last change; without one the state is unchanged."""
    if not state.past:
        return state
    *past, layout = state.past
    future = (*state.future, state.layout)
    return dataclasses.replace(state, layout=layout, past=tuple(past), future=future)


def redo(state: State) -> State:
    """Restore the layout before the last undo; without one the state is unchanged."""
    if not state.future:
        return state
    *future, layout = state.future
    past = (*state.past, state.layout)
    return dataclasses.replace(state, layout=layout, past=past, future=tuple(future))


def turn_knobs(state: State, **knobs: Any) -> State:
    """Change `Knobs`, given by name."""
    changed: Knobs = state.world.knobs._replace(**knobs)
    return dataclasses.replace(state, world=state.world.with_knobs(changed))
