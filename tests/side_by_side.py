"""A vector environment beside Gymnasium's own of scalar environments: the same, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv

from tests.helpers import assert_same


def peer_of(scalar: Any, mode: Any, n: int, arguments: dict[str, Any]) -> SyncVectorEnv:
    """Gymnasium's vector environment of n scalar ones."""
    return SyncVectorEnv([lambda: scalar(**arguments)] * n, autoreset_mode=mode)


def actions_of(env: Any, rng: np.random.Generator) -> np.ndarray:
    """Random actions of all worlds, beyond the box too."""
    space = env.single_action_space
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(space.n, size=env.num_envs)
    if isinstance(space, gym.spaces.MultiBinary):
        return rng.integers(0, 2, env.action_space.shape).astype(np.int8)
    return rng.uniform(-1.3, 1.3, env.action_space.shape).astype(np.float32)


def assert_steps_alike(
    native: Any, peer: Any, steps: int, seed: Any, tolerance: dict[str, float]
) -> list[Any]:
    """Reset and step both alike; returns what `native` gave at each step."""
    rng = np.random.default_rng(1)
    assert_same(native.reset(seed=seed), peer.reset(seed=seed), **tolerance)
    results = []
    for _ in range(steps):
        actions = actions_of(native, rng)
        results.append(native.step(actions))
        assert_same(results[-1], peer.step(actions), **tolerance)
        assert native.observation_space.contains(results[-1][0])
    return results


def assert_masks_alike(
    native: Any,
    peer: Any,
    steps: int,
    known: Sequence[str],
    tolerance: dict[str, float],
    at_reset: Sequence[str] = (),
) -> None:
    """Without autoreset, worlds reset by masks, some in mid-episode: their clocks differ.

    Of the worlds of a mask the infos `known` are alike; the infos `at_reset` only they have.
    """
    rng = np.random.default_rng(3)
    assert_same(native.reset(seed=7), peer.reset(seed=7), **tolerance)
    for step in range(1, steps):
        actions = actions_of(native, rng)
        got, want = native.step(actions), peer.step(actions)
        assert_same(got, want, **tolerance)
        mask = got[2] | got[3]
        if step == 2:
            mask[1::2] = True
        if mask.any():
            observation, info = native.reset(options={"reset_mask": mask.copy()})
            peer_observation, peer_info = peer.reset(options={"reset_mask": mask.copy()})
            assert_same(observation, peer_observation, **tolerance)
            for key in known:
                assert_same(info[key][mask], peer_info[key][mask], **tolerance)
            for key in at_reset:
                assert_same(info[key], peer_info[key], **tolerance)
                np.testing.assert_array_equal(info[f"_{key}"], mask)


def assert_mixes_alike(
    native: Any, peer: Any, steps: int, tolerance: dict[str, float]
) -> list[Any]:
    """With autoreset by the next step, worlds 0, 2, ... begin anew while the others go on.

    By hand, what both offer only without autoreset. Returns what `native` gave at each step.
    """
    rng = np.random.default_rng(4)
    native.reset(seed=1)
    peer.reset(seed=1)
    actions = actions_of(native, rng)
    native.step(actions)
    peer.step(actions)
    again = np.arange(native.num_envs) % 2 == 0
    native._begin(again)
    for world in np.flatnonzero(again):
        peer.envs[world].reset()
    results = []
    for _ in range(steps):
        actions = actions_of(native, rng)
        results.append(native.step(actions))
        assert_same(results[-1][:4], peer.step(actions)[:4], **tolerance)
    return results
