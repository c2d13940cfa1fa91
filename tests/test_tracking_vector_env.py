"""The native vector environment against scalar environments, step by step."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.worlds.scenes import SCENES
from tests.side_by_side import (
    assert_masks_alike,
    assert_memory_is_not_shared,
    assert_mixes_alike,
    assert_steps_alike,
    assert_twins_go_on_alike,
    peer_of,
)

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


@pytest.mark.parametrize("name", ["uwb_room", "auv_buoys", "camsap2013"])
@pytest.mark.parametrize("reward", ["bound", "none"])
def test_same_step_equals_scalar_environments_with_final_observation_and_info(name, reward):
    both = vectors(short(name), AutoresetMode.SAME_STEP, reward=reward)
    steps = assert_steps_alike(*both, 12, [3, 1, 4, 1], TOLERANCE)
    assert sum("final_obs" in info for *_, info in steps) == 2


@pytest.mark.parametrize("name", ["drone_yard", "satellite"])
def test_disabled_resets_what_the_mask_says_and_clocks_may_differ(name):
    both = vectors(short(name, 6), AutoresetMode.DISABLED)
    priors = ("prior_rotation", "prior_translation", "prior_covariance")
    assert_masks_alike(*both, 16, ("rotation", "epoch", "score_m"), TOLERANCE, priors)


@pytest.mark.parametrize("name", ["uwb_room", "auv_buoys"])
def test_next_step_mixes_resets_and_steps(name):
    steps = assert_mixes_alike(*vectors(short(name), AutoresetMode.NEXT_STEP), 12, TOLERANCE)
    assert [True, False, True, False] in [step[3].tolist() for step in steps]


def test_disabled_refuses_to_step_past_the_end():
    env = TrackingVectorEnv(2, short("uwb_room", 1), autoreset_mode="Disabled")
    env.reset(seed=1)
    env.step(np.zeros(2, int))
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros(2, int))


def test_make_vec_gives_the_native_environment_with_its_arguments():
    env = gym.make_vec(
        ID, num_envs=3, scene=short("uwb_room", 50), max_episode_steps=4, autoreset_mode="SameStep"
    )
    assert isinstance(env.unwrapped, TrackingVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.reset(seed=1)
    ends = [env.step(np.zeros(3, int))[3].all() for _ in range(8)]
    assert ends == [False, False, False, True] * 2
    assert env.spec is not None
    again = gym.make_vec(env.spec)
    np.testing.assert_array_equal(again.reset(seed=2)[0]["ranges"], env.reset(seed=2)[0]["ranges"])


def test_the_same_seed_gives_the_same_bytes_and_memory_is_never_shared():
    assert_memory_is_not_shared(lambda: TrackingVectorEnv(3, short("auv_buoys", 4)), 7)


def test_twins_in_mid_episode_go_on_alike():
    env = TrackingVectorEnv(3, short("satellite", 6))
    env.reset(seed=4)
    env.step(np.zeros((3, 15)))
    assert_twins_go_on_alike(env, 9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs must be an int from 1 to 100000000, got 0"),
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
    with pytest.raises(ValueError, match="seed must hold 2 seeds, got"):
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
