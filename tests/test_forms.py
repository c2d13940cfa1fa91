"""Wrappers tell which form of environment they take, and which other environment or wrapper."""

from __future__ import annotations

import gymnasium as gym
import pytest

from rbl_gym import wrappers

IDS = {
    "EstimatePose": "RBL/Tracking-v0",
    "SelectAnchors": "RBL/Tracking-v0",
    "FilterReward": "RBL/AnchorPlacement-v0",
    "EstimateNetwork": "RBL/PlanarNetwork-v0",
}


@pytest.mark.parametrize("name", IDS)
def test_a_vector_environment_names_the_vector_wrapper(name):
    envs = gym.make_vec(f"rbl_gym:{IDS[name]}", num_envs=2)
    with pytest.raises(ValueError, match=f"got the vector environment .*: use Vector{name}$"):
        getattr(wrappers, name)(envs)


@pytest.mark.parametrize("name", IDS)
def test_a_single_environment_names_the_single_wrapper(name):
    env = gym.make(f"rbl_gym:{IDS[name]}")
    with pytest.raises(ValueError, match=f"got the single environment .*: use {name}$"):
        getattr(wrappers, f"Vector{name}")(env)


@pytest.mark.parametrize("name", IDS)
def test_an_id_is_no_environment(name):
    with pytest.raises(ValueError, match=f"as gym.make returns it, got '{IDS[name]}'"):
        getattr(wrappers, name)(IDS[name])
    with pytest.raises(ValueError, match=f"as gym.make_vec returns it, got '{IDS[name]}'"):
        getattr(wrappers, f"Vector{name}")(IDS[name])


@pytest.mark.parametrize("reward", ["error", "belief", "filter"])
def test_a_reward_of_the_wrapper_names_the_wrapper(reward):
    with pytest.raises(ValueError, match=rf"got '{reward}'; the wrapper EstimateNetwork\(env, rew"):
        gym.make("rbl_gym:RBL/PlanarNetwork-v0", reward=reward)
