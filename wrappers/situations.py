"""Inputs of a controller from a vector environment, for worlds that share a scene."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators import PoseBelief
from rbl_gym.worlds.scene import Scene

Controller = Callable[[Any, np.random.Generator], np.ndarray]


class Situation(NamedTuple):
    """Worlds of a learning task that share a scene; the names are those of its environment."""

    num_envs: int
    scene: Scene
    belief: PoseBelief
    twist: FloatArray
    anchors: FloatArray
    order: np.ndarray | None
    mode: str | None
    k: Any
    price: Any


def situations(env: Any) -> Iterator[tuple[np.ndarray, Situation]]:
    """Return the worlds of an environment grouped by scene, with what is known of them.

    A scalar environment is one row.
    """
    one = env.anchors.ndim == 2
    fields: list[Any] = [*env.belief, env.twist, env.anchors, getattr(env, "order", None)]
    if one:
        fields = [None if field is None else field[None] for field in fields]
    *belief, twist, anchors, order = fields
    scenes = getattr(env.world, "scenes", (env.world,) * len(anchors))
    alike: dict[Scene, list[int]] = {}
    for row, scene in enumerate(scenes):
        alike.setdefault(scene, []).append(row)
    choice = [getattr(env, name, None) for name in ("mode", "k", "price")]
    if choice[0] == "subset":
        # The same choice in another form.
        choice[0] = "top-k"
    for scene, found in alike.items():
        rows, m = np.array(found), scene.n_anchors
        yield (
            rows,
            Situation(
                len(rows),
                scene,
                PoseBelief(*(field[rows] for field in belief)),
                twist[rows],
                anchors[rows, :m],
                None if order is None else order[rows, :m],
                *choice,
            ),
        )


def craft_by_number(env: Any) -> FloatArray:
    """Return positions (..., M, 3) of the craft in the order of their numbers.

    `env.anchors` is in the order of the actions.
    """
    craft = np.empty_like(env.anchors)
    np.put_along_axis(craft, env.order[..., None], env.anchors, axis=-2)
    return craft


def action_of(env: Any, scores: np.ndarray) -> np.ndarray:
    """Return the action for scores (..., M) of the anchors, in the form of the environment."""
    if env.mode == "priced":
        return (scores > 0).astype(np.int8)
    if env.mode == "top-k":
        return scores
    best = (-scores).argsort(axis=-1, kind="stable")[..., : env.k]
    chosen = np.zeros(scores.shape, dtype=np.bool_)
    np.put_along_axis(chosen, best, True, axis=-1)
    return env.subset_of(chosen)


def in_each_scene(controller: Controller) -> Controller:
    """Make a controller for one scene work for worlds with different scenes.

    Craft that a scene does not have do not move, and anchors that it does not have get the lowest
    score.
    """

    @functools.wraps(controller)
    def act(env: Any, rng: np.random.Generator) -> np.ndarray:
        # For craft: velocities along two axes.
        columns = 2 if hasattr(env, "order") else 1
        shape = env.num_envs, columns * env.anchors.shape[1]
        actions = np.full(shape, 0.0 if columns == 2 else -1.0)
        for rows, situation in situations(env):
            own = controller(situation, rng)
            actions[rows, : own.shape[1]] = own
        return actions if columns == 2 else action_of(env, actions)

    return act
