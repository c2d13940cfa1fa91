"""Policies for any number of anchors, run by numpy: motion of craft, links chosen by sight."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.motion.kinematics import propagate
from rbl_gym.studies.learning.deep_sets import DeepSets, check_sets
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers import controllers, craft_tokens, sight_tokens, views
from rbl_gym.wrappers.situations import action_of, craft_by_number, situations

__all__ = ["SET_KINDS", "SetPolicy"]

# Environment of a policy of each kind, and row lengths of its network: element, pair, output.
SET_KINDS: dict[str, tuple[str, tuple[int, int, int]]] = {
    "craft": ("RBL/MobileAnchors-v0", (craft_tokens.OWN, craft_tokens.PAIR, 2)),
    "sight": ("RBL/AnchorSelection-v0", (sight_tokens.QUERY, sight_tokens.EVENT, 1)),
}
# Largest correction of the orbit with three craft or more, in units of the largest speed. The orbit
# is good there. In a few worlds in a hundred larger corrections lead craft to the same place, where
# they see the same and stay together. Chosen in worlds that no figure is from.
_LARGEST = 0.2


class SetPolicy(NamedTuple):
    """A deterministic policy that reads the environment's belief, not its observation.

    Attributes
    ----------
    network
        The trained network.
    kind
        ``"craft"``: the network corrects the orbit of `controllers`, for 2 craft or more. With 3
        or more it changes a velocity by a fifth of the limit at most.
        ``"sight"``: the network predicts from the previous measurements which anchors will see the
        body. The anchors are chosen greedily by the expected score.
    meta
        Origin of the policy.
    """

    network: DeepSets
    kind: str
    meta: dict[str, Any]

    def player(self) -> Callable[[Any, Any], np.ndarray]:
        """Return a function ``(env, observation) -> actions`` with a memory, for one episode.

        `env` is the environment of a task, scalar or vector, after `reset` or `step`.
        """
        if self.kind == "craft":
            return _craft_player(self.network)
        return _Chooser(self.network)

    def check(self) -> None:
        """Raise ValueError unless the network fits its kind."""
        check_sets(self.network, *SET_KINDS[self.kind][1])


def _batched(env: Any, *arrays: np.ndarray) -> list[np.ndarray]:
    """Return arrays of one world or of many with a leading axis of worlds."""
    one = env.anchors.ndim == 2
    return [np.asarray(array)[None] if one else np.asarray(array) for array in arrays]


def _mask(env: Any) -> np.ndarray:
    seen: Mapping[str, np.ndarray] = env.inner_observation
    mask = seen.get("anchor_mask", np.ones(env.anchors.shape[:-1]))
    return _batched(env, mask)[0].astype(np.float64)


def craft_seen(env: Any) -> craft_tokens.CraftTokens:
    """Return the input (B, M, ...) of each craft of an environment; B is 1 for a scalar one."""
    rotation, translation, covariance = _batched(env, *env.belief[:3])
    twist, craft = _batched(env, env.twist, craft_by_number(env))
    reach = np.broadcast_to(views.reach_of_craft(env.world), len(craft))
    return craft_tokens.craft_tokens(
        rotation, translation, covariance, twist, craft, _mask(env), reach, env.world.dt
    )


def craft_actions(env: Any, seen: craft_tokens.CraftTokens, own: np.ndarray) -> np.ndarray:
    """Return actions for level velocities (B, M, 2) in the frames of the craft."""
    length = np.linalg.norm(own, axis=-1, keepdims=True)
    velocity = own / np.maximum(length, 1.0)
    velocity = (np.swapaxes(seen.frames, -1, -2) @ velocity[..., None])[..., 0]
    (order,) = _batched(env, env.order)
    actions = np.take_along_axis(velocity, order[..., None], axis=-2).reshape(len(own), -1)
    return actions if env.anchors.ndim == 3 else actions[0]


def _limited(correction: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return corrections (B, M, 2), cut to `_LARGEST` in length with three craft or more."""
    length = np.linalg.norm(correction, axis=-1, keepdims=True)
    largest = np.where(others.sum(axis=-1, keepdims=True) >= 2, _LARGEST, np.inf)
    return correction * np.minimum(1.0, largest / np.maximum(length, 1e-12))


def _craft_player(network: DeepSets) -> Callable[[Any, Any], np.ndarray]:
    def play(env: Any, _: Any) -> np.ndarray:
        seen = craft_seen(env)
        correction = _limited(network(seen.own, seen.pairs, seen.others), seen.others)
        return craft_actions(env, seen, correction + seen.orbit)

    return play


class _Chooser:
    """Chooses anchors greedily by the sight that the network predicts, and remembers past sight."""

    def __init__(self, network: DeepSets) -> None:
        self._network = network
        self._chosen: np.ndarray | None = None

    def __call__(self, env: Any, observation: Any) -> np.ndarray:
        told = _batched(env, *env.belief[:2], env.twist, env.anchors)
        rotation, translation, twist, anchors = told
        batch, mask = len(anchors), _mask(env)
        if self._chosen is None:
            self._memory = sight_tokens.forgotten(batch, anchors.shape[1])
        else:
            sight = _sight(env)
            self._memory = sight_tokens.remember(self._memory, self._chosen, translation, sight)
        dt = np.broadcast_to(env.world.dt, batch)
        _, body = propagate(rotation, translation, twist, dt)
        middle, half = volumes(env.world, batch)
        tokens = sight_tokens.sight_tokens(anchors, body, self._memory, middle, half)
        clear = 1 / (1 + np.exp(-self._network(*tokens)[..., 0]))
        actions = np.full(mask.shape, -1.0)
        for rows, situation in situations(env):
            m = situation.scene.n_anchors
            likely = clear[rows, :m]
            quality = likely + (1 - likely) * situation.scene.blocked_information
            actions[rows, :m] = controllers.greedy(situation, quality)
        self._chosen = (actions > 0) & (mask > 0)
        return action_of(env, actions if env.anchors.ndim == 3 else actions[0])


def _sight(env: Any) -> np.ndarray:
    """Return 1 if an anchor saw the body in the last step, else -1."""
    (links,) = _batched(env, env.inner_observation["links"])
    (quality,) = _batched(
        env, env.inner_observation.get("quality", np.ones(env.anchors.shape[:-1]))
    )
    return np.where(links.any(axis=-1) & (quality > 0.5), 1.0, -1.0)


def volumes(world: Any, batch: int) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and half sizes (B, 3) of the volumes of one scene or of several."""
    scenes = (world,) * batch if isinstance(world, Scene) else world.scenes
    corners = np.array([one.volume.bounds() for one in scenes])
    return corners.mean(axis=1), np.maximum(0.5 * (corners[:, 1] - corners[:, 0]), 1.0)
