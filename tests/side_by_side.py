"""A vector environment beside Gymnasium's own of scalar environments: the same, step by step."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from tests.helpers import assert_same


def peer_of(scalar: Any, mode: Any, n: int, arguments: dict[str, Any]) -> SyncVectorEnv:
    """Gymnasium's vector environment of n scalar ones."""
    return SyncVectorEnv([lambda: scalar(**arguments)] * n, autoreset_mode=mode)


def assert_refused(scalar: Any, arguments: dict[str, Any], action: Any, message: str) -> None:
    """Assert that a bad action is refused, before a reset too, and changes nothing."""
    env, peer = scalar(**arguments), scalar(**arguments)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.reset(seed=1)
    peer.reset(seed=1)
    with pytest.raises(ValueError, match=message):
        env.step(action)
    env.action_space.seed(1)
    good = env.action_space.sample()
    assert_same(env.step(good), peer.step(good))


def actions_of(env: Any, rng: np.random.Generator) -> np.ndarray:
    """Random actions of all worlds, beyond the box too."""
    space = env.single_action_space
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(space.n, size=env.num_envs)
    if isinstance(space, gym.spaces.MultiBinary):
        return rng.integers(0, 2, env.action_space.shape).astype(np.int8)
    return rng.uniform(-1.3, 1.3, env.action_space.shape).astype(np.float32)


Step = tuple[Any, float, bool, bool, dict[str, Any]]


def played(env: Any, seed: int = 0, steps: int | None = None) -> tuple[list[Step], list[Any]]:
    """An episode of a scalar environment, or `steps` of it, under random actions; these actions.

    The reset comes first, as a step with reward 0.
    """
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    results: list[Any] = [(observation, 0.0, False, False, info)]
    actions: list[Any] = []
    while len(actions) != steps and not (results[-1][2] or results[-1][3]):
        actions.append(env.action_space.sample())
        results.append(env.step(actions[-1]))
        assert len(actions) < 10**5
    for observation, *paid, _ in results:
        assert env.observation_space.contains(observation)
        assert [type(value) for value in paid] == [float, bool, bool]
    return results, actions


def episode(env: Any, seed: int = 0, steps: int | None = None) -> list[Step]:
    """The steps of `played`."""
    return played(env, seed, steps)[0]


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

    Returns what `native` gave at each step.
    """
    rng = np.random.default_rng(4)
    native.reset(seed=1)
    peer.reset(seed=1)
    actions = actions_of(native, rng)
    native.step(actions)
    peer.step(actions)
    again = np.arange(native.num_envs) % 2 == 0
    native.reset(options={"reset_mask": again})
    for world in np.flatnonzero(again):
        peer.envs[world].reset()
    results = []
    for _ in range(steps):
        actions = actions_of(native, rng)
        results.append(native.step(actions))
        assert_same(results[-1][:4], peer.step(actions)[:4], **tolerance)
    return results


def of_its_spec(env: Any) -> Any:
    """The environment that the JSON of a spec makes, which says the same of itself."""
    text = env.spec.to_json()
    again = gym.make(EnvSpec.from_json(text))
    assert again.spec is not None
    assert json.loads(again.spec.to_json()) == json.loads(text)
    return again


def assert_contract(env_id: str, **arguments: Any) -> None:
    """Checker, spec, copies, and native vector environments beside scalar ones, in short."""
    env = gym.make(env_id, **arguments)
    check_env(env.unwrapped, skip_render_check=True)
    assert_same(of_its_spec(env).reset(seed=3), env.reset(seed=3))
    twin, action = pickle.loads(pickle.dumps(env)), env.action_space.sample()
    assert_same(twin.step(action), env.step(action))
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
        native = gym.make_vec(env_id, num_envs=3, autoreset_mode=mode, **arguments)
        peer = peer_of(lambda: gym.make(env_id, **arguments), mode, 3, {})
        assert_steps_alike(native, peer, 6, 3, {"rtol": 2e-5, "atol": 2e-5})


def assert_twins_go_on_alike(env: Any, steps: int) -> None:
    """Copies and pickles of a vector environment in mid-episode do as it does."""
    rng = np.random.default_rng(1)
    twins = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    for _ in range(steps):
        actions = actions_of(env, rng)
        want = env.step(actions)
        for twin in twins:
            assert_same(twin.step(actions), want)


def spoil(value: Any) -> None:
    """Write ones all over the arrays in a result."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, np.ndarray) and value.dtype != object:
        value[...] = 1
    elif not isinstance(value, str):
        for item in value if isinstance(value, list | tuple | np.ndarray) else []:
            spoil(item)


def assert_memory_is_not_shared(make: Any, steps: int) -> None:
    """The same seed gives the same bytes, also where the caller writes into what it was given."""
    last = []
    for spoiled in (False, True):
        env, rng = make(), np.random.default_rng(2)
        results: list[Any] = [env.reset(seed=9)]
        for _ in range(steps):
            if spoiled:
                spoil(results[-1])
            results.append(env.step(actions_of(env, rng)))
        last.append(results[-1])
    first, second = last
    parts = [one[0] if isinstance(one[0], dict) else {"": one[0]} for one in last]
    for key in parts[0]:
        assert parts[0][key].tobytes() == parts[1][key].tobytes()
    assert first[1].tobytes() == second[1].tobytes()
    assert_same(first, second)
