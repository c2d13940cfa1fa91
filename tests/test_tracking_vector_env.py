"""The native vector environment against scalar environments, step by step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.worlds.scenes import SCENES
from tests.side_by_side import assert_steps_alike, peer_of

ID = "rbl_gym:RBL/Tracking-v0"
LOSSY = {"drop_probability": 0.2, "nlos_probability": 0.1, "reach_m": 500.0}

# Batched arithmetic may turn the last bits.
TOLERANCE = {"rtol": 1e-9, "atol": 1e-9}


def short(name, steps=5, **fields):
    return {"name": name, "steps": steps, **fields}


def vectors(scene, mode, n=4, reward="bound"):
    """The native vector environment, and Gymnasium's own around scalar ones."""
    arguments = {"scene": scene, "reward": reward}
    native = TrackingVectorEnv(n, **arguments, autoreset_mode=mode)
    return native, peer_of(TrackingEnv, mode, n, arguments)


@pytest.mark.parametrize("name", list(SCENES))
@pytest.mark.parametrize("links", [{}, LOSSY], ids=["all links", "lossy"])
def test_next_step_equals_scalar_environments_episode_after_episode(name, links):
    both = vectors(short(name, links=links), AutoresetMode.NEXT_STEP)
    assert_steps_alike(*both, 14, 5, TOLERANCE)


def test_disabled_refuses_to_step_past_the_end():
    env = TrackingVectorEnv(2, short("uwb_room", 1), autoreset_mode="Disabled")
    env.reset(seed=1)
    env.step(np.zeros(2, int))
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros(2, int))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs must be an int from 1 to 100000000, got 0"),
        ({"num_envs": 2.0}, "num_envs must be an int from 1 to 100000000, got 2.0"),
        ({"scene": "attic"}, "scene must be one of"),
        ({"reward": "gold"}, "reward must be one of 'bound', 'none', got 'gold'"),
        ({"autoreset_mode": "Never"}, "autoreset_mode must be one of 'NextStep'"),
        ({"render_mode": "human"}, "render_mode must be None"),
        ({"max_episode_steps": 0}, "max_episode_steps must be"),
        ({"max_episode_steps": 2.5}, "max_episode_steps must be a positive int, got 2.5"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    told: dict[str, Any] = {"num_envs": 2, **arguments}
    with pytest.raises(ValueError, match=message):
        TrackingVectorEnv(**told)


def test_bad_calls_are_named():
    env = TrackingVectorEnv(2, "auv_buoys")
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 12)))
    with pytest.raises(gym.error.ResetNeeded, match="all environments before"):
        env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ValueError, match="seed must have 2 seeds, one for each world, got"):
        env.reset(seed=[1, 2, 3])
    env.reset(seed=1)
    for bad in (np.zeros((2, 11)), np.zeros((1, 2, 12)), np.full((2, 12), np.nan)):
        with pytest.raises(ValueError, match="actions must"):
            env.step(bad)
    for mask in (np.zeros(2, bool), np.ones(3, bool), np.ones(2, int)):
        with pytest.raises(ValueError, match="reset_mask must be"):
            env.reset(options={"reset_mask": mask})
    fixed = TrackingVectorEnv(2, "uwb_room")
    fixed.reset(seed=1)
    with pytest.raises(ValueError, match="actions must lie in"):
        fixed.step(np.ones(2, int))
