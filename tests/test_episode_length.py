"""Episode lengths of all ids as in their specs; options of reset."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import TimeAwareObservation

# Arguments of each id, and how long its episodes are then.
LENGTHS = [
    ("Tracking", {}, 100),
    ("Tracking", {"scene": {"name": "uwb_room", "steps": 130}, "reward": "none"}, 130),
    ("Tracking", {"scene": "camsap2013"}, 20),
    ("AnchorPlacement", {}, 4),
    ("AnchorPlacement", {"mode": "one-shot"}, 1),
    ("AnchorPlacement", {"scene": "uwb_room", "mode": "mounts", "n_anchors": 7}, 7),
    ("AnchorPlacement", {"scene": "drone_yard", "reward": "filter", "filter": "uc-kf"}, 6),
    ("PlanarNetwork", {}, 50),
    ("PlanarNetwork", {"n_nodes": 4, "steps": 60}, 60),
    ("MobileAnchors", {}, 100),
    ("MobileAnchors", {"difficulty": "hard", "scene": {"name": "auv_craft", "steps": 120}}, 120),
    ("AnchorSelection", {}, 50),
    ("AnchorSelection", {"scene": {"name": "hall", "steps": 55}}, 55),
    ("BaseStation", {}, 100),
    ("BaseStation", {"scene": {"steps": 130}}, 130),
]
ARGUMENTS = pytest.mark.parametrize(
    ("name", "arguments", "steps"), LENGTHS, ids=[f"{name}-{n}" for name, _, n in LENGTHS]
)


def id_of(name: str) -> str:
    return f"rbl_gym:RBL/{name}-v0"


def length(env: Any) -> int:
    """Steps until the episode is over."""
    env.reset(seed=1)
    env.action_space.seed(1)
    for k in range(1, 1000):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if np.any(terminated | truncated):
            return k
    raise AssertionError("the episode never ends")


@ARGUMENTS
def test_spec_tells_the_length_of_the_episodes_as_made(name, arguments, steps):
    env = gym.make(id_of(name), **arguments)
    assert env.spec is not None
    assert env.spec.max_episode_steps == steps
    assert length(env) == steps
    envs = gym.make_vec(id_of(name), num_envs=2, **arguments)
    assert envs.spec is not None
    assert envs.spec.max_episode_steps == steps
    assert length(envs) == steps


@ARGUMENTS
def test_specs_make_the_same_environment_again(name, arguments, steps):
    env = gym.make(id_of(name), **arguments)
    assert env.spec is not None
    for spec in (env.spec, EnvSpec.from_json(env.spec.to_json())):
        again = gym.make(spec)
        assert again.spec == env.spec
        assert length(again) == steps
    envs = gym.make_vec(id_of(name), num_envs=2, **arguments)
    assert envs.spec is not None
    again = gym.make_vec(envs.spec)
    assert again.spec == envs.spec
    assert again.num_envs == 2
    assert length(again) == steps


def test_a_shorter_limit_of_make_is_in_the_spec():
    env = gym.make(id_of("Tracking"), max_episode_steps=7)
    envs = gym.make_vec(id_of("Tracking"), num_envs=2, max_episode_steps=7)
    for made in (env, envs):
        assert made.spec is not None
        assert made.spec.max_episode_steps == 7
        assert length(made) == 7
    assert envs.spec is not None
    again = gym.make_vec(envs.spec)
    assert again.spec == envs.spec
    assert length(again) == 7


@pytest.mark.parametrize("name", sorted({name for name, *_ in LENGTHS}))
def test_time_aware_observation_takes_the_environment_as_made(name):
    env = TimeAwareObservation(gym.make(id_of(name)))
    assert env.reset(seed=0)[0] in env.observation_space


@pytest.mark.parametrize("name", sorted({name for name, *_ in LENGTHS}))
def test_options_that_nobody_knows_are_refused(name):
    env, envs = gym.make(id_of(name)), gym.make_vec(id_of(name), num_envs=2)
    for made in (env, envs):
        made.reset(seed=0, options={})
        with pytest.raises(ValueError, match=r"options m.*got 'nonsense'"):
            made.reset(seed=0, options={"nonsense": 1})
        with pytest.raises(ValueError, match="options must be a dict or None, got 3"):
            made.reset(seed=0, options=3)  # pyrefly: ignore[bad-argument-type]
