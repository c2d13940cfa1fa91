"""The native vector environment against scalar environments, step by step."""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.scenes import SCENES
from tests.helpers import assert_same

ID = "rbl_gym:RBL/Tracking-v0"
LOSSY = {"drop_probability": 0.2, "nlos_probability": 0.1, "reach_m": 500.0}


def short(name, steps=5, **fields):
    return {"name": name, "steps": steps, **fields}


def assert_equal(got, want):
    """Equal to the last bits that batched arithmetic may turn."""
    assert_same(got, want, rtol=1e-9, atol=1e-9)


def vectors(scene, mode, n=4, reward="bound"):
    """The native vector environment, and Gymnasium's own around scalar ones."""
    native = TrackingVectorEnv(n, scene, reward, autoreset_mode=mode)
    makers = [lambda: TrackingEnv(scene, reward)] * n
    return native, SyncVectorEnv(makers, autoreset_mode=mode)


def actions_of(env, rng):
    if isinstance(env.single_action_space, gym.spaces.Discrete):
        return np.zeros(env.num_envs, dtype=np.int64)
    return rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)


@pytest.mark.parametrize("name", list(SCENES))
@pytest.mark.parametrize("links", [{}, LOSSY], ids=["all links", "lossy"])
def test_next_step_equals_scalar_environments_episode_after_episode(name, links):
    native, peer = vectors(short(name, links=links), AutoresetMode.NEXT_STEP)
    rng = np.random.default_rng(1)
    assert_equal(native.reset(seed=5), peer.reset(seed=5))
    for _ in range(14):
        actions = actions_of(native, rng)
        got, want = native.step(actions), peer.step(actions)
        for a, b in zip(got[:4], want[:4], strict=True):
            assert_equal(a, b)
        assert_equal(got[4], want[4])
        assert native.observation_space.contains(got[0])


@pytest.mark.parametrize("name", ["uwb_room", "auv_buoys", "camsap2013"])
@pytest.mark.parametrize("reward", ["bound", "none"])
def test_same_step_equals_scalar_environments_with_final_observation_and_info(name, reward):
    native, peer = vectors(short(name), AutoresetMode.SAME_STEP, reward=reward)
    rng = np.random.default_rng(2)
    assert_equal(native.reset(seed=[3, 1, 4, 1]), peer.reset(seed=[3, 1, 4, 1]))
    seen = 0
    for _ in range(12):
        actions = actions_of(native, rng)
        got, want = native.step(actions), peer.step(actions)
        for a, b in zip(got, want, strict=True):
            assert_equal(a, b)
        seen += "final_obs" in got[4]
    assert seen == 2


@pytest.mark.parametrize("name", ["drone_yard", "satellite"])
def test_disabled_resets_what_the_mask_says_and_clocks_may_differ(name):
    native, peer = vectors(short(name, 6), AutoresetMode.DISABLED)
    rng = np.random.default_rng(3)
    assert_equal(native.reset(seed=7), peer.reset(seed=7))
    for step in range(1, 16):
        actions = actions_of(native, rng)
        got, want = native.step(actions), peer.step(actions)
        for a, b in zip(got, want, strict=True):
            assert_equal(a, b)
        mask = got[3].copy()
        if step == 2:
            mask[[1, 3]] = True  # in mid-episode: from here on the clocks differ
        if mask.any():
            a, info = native.reset(options={"reset_mask": mask.copy()})
            b, peer_info = peer.reset(options={"reset_mask": mask.copy()})
            assert_equal(a, b)
            for key in ("prior_rotation", "prior_translation", "prior_covariance"):
                assert_equal(info[key], peer_info[key])
                np.testing.assert_array_equal(info[f"_{key}"], mask)
            for key in ("rotation", "epoch", "score_m"):
                assert_equal(info[key][mask], peer_info[key][mask])


def test_disabled_refuses_to_step_past_the_end():
    env = TrackingVectorEnv(2, short("uwb_room", 1), autoreset_mode="Disabled")
    env.reset(seed=1)
    env.step(np.zeros(2, int))
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros(2, int))


def test_make_vec_gives_the_native_environment_with_its_arguments():
    env = gym.make_vec(ID, num_envs=3, scene=short("uwb_room", 50), max_episode_steps=4,
                       autoreset_mode="SameStep")  # fmt: skip
    assert isinstance(env.unwrapped, TrackingVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.reset(seed=1)
    ends = [env.step(np.zeros(3, int))[3].all() for _ in range(8)]
    assert ends == [False, False, False, True] * 2
    assert env.spec is not None
    again = gym.make_vec(env.spec)
    np.testing.assert_array_equal(again.reset(seed=2)[0]["ranges"], env.reset(seed=2)[0]["ranges"])


def test_the_same_seed_gives_the_same_bytes_and_memory_is_never_shared():
    rollouts = []
    for spoil in (False, True):
        env = TrackingVectorEnv(3, short("auv_buoys", 4))
        results: list[Any] = [env.reset(seed=9)]
        for _ in range(7):
            if spoil:
                for value in (*results[-1][0].values(), *results[-1][-1].values()):
                    value[...] = 1
            results.append(env.step(np.zeros((3, 12), np.float32)))
        rollouts.append(results[-1])
    for key in rollouts[0][0]:
        assert rollouts[0][0][key].tobytes() == rollouts[1][0][key].tobytes()
    assert rollouts[0][1].tobytes() == rollouts[1][1].tobytes()


def test_pickling_in_mid_episode():
    env = TrackingVectorEnv(3, short("satellite", 6))
    env.reset(seed=4)
    env.step(np.zeros((3, 15)))
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(9):
        a, b = env.step(np.ones((3, 15))), twin.step(np.ones((3, 15)))
        np.testing.assert_array_equal(a[0]["ranges"], b[0]["ranges"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs must be a positive int, got 0"),
        ({"scene": "attic"}, "scene must be one of"),
        ({"reward": "gold"}, "reward must be one of 'bound', 'none', got 'gold'"),
        ({"autoreset_mode": "Never"}, "autoreset_mode must be one of 'NextStep'"),
        ({"render_mode": "human"}, "render_mode must be None"),
        ({"max_episode_steps": 0}, "max_episode_steps must be"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        TrackingVectorEnv(**{"num_envs": 2, **arguments})


def test_bad_calls_are_named():
    env = TrackingVectorEnv(2, "auv_buoys")
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 12)))
    with pytest.raises(ValueError, match="seed must hold 2 seeds, got 3"):
        env.reset(seed=[1, 2, 3])
    env.reset(seed=1)
    for bad in (np.zeros((2, 11)), np.zeros((1, 2, 12)), np.full((2, 12), np.nan)):
        with pytest.raises(ValueError, match="actions must"):
            env.step(bad)
    with pytest.raises(ValueError, match="reset_mask must be"):
        env.reset(options={"reset_mask": np.zeros(2, bool)})
    fixed = TrackingVectorEnv(2, "uwb_room")
    fixed.reset(seed=1)
    with pytest.raises(ValueError, match="actions must lie in"):
        fixed.step(np.ones(2, int))
