"""SelectAnchors below EstimatePose: only the chosen anchors measure."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.wrappers import SelectAnchors

HALL = {"name": "hall", "steps": 4, "links": {"drop_probability": 0.2}}
MOVABLE = {"name": "auv_buoys", "steps": 4}


@pytest.mark.parametrize("scene", [HALL, MOVABLE])
def test_an_observation_has_the_links_of_the_chosen_anchors_and_no_others(scene):
    world = TrackingEnv(scene)
    env = SelectAnchors(TrackingEnv(scene))
    still = np.zeros(world.action_space.shape or (), world.action_space.dtype)
    assert not env.reset(seed=3)[0]["links"].any()
    world.reset(seed=3)
    rng = np.random.default_rng(1)
    for _ in range(4):
        chosen = rng.integers(0, 2, env.action_space.shape)
        got, *_, info = env.step(chosen)
        want, *_ = world.step(still)
        assert env.observation_space.contains(got)
        np.testing.assert_array_equal(info["chosen"], chosen)
        on = chosen == 1
        for key in want:
            if key in ("twist", "anchors"):
                np.testing.assert_array_equal(got[key], want[key])
            else:
                np.testing.assert_array_equal(got[key][on], want[key][on])
        assert not got["links"][~on].any()
        assert not got["ranges"][~on].any()
        assert (got.get("quality", np.ones(len(on)))[~on] == 1).all()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(11), r"action must be numbers of shape \(12,\)"),
        (np.full(12, 0.5), "action must lie in MultiBinary"),
        (np.full(12, np.nan), "action must be finite"),
    ],
)
def test_bad_actions_are_named(action, message):
    env = SelectAnchors(TrackingEnv(HALL))
    env.reset(seed=1)
    with pytest.raises(ValueError, match=message):
        env.step(action)


def test_an_environment_without_a_scene_is_refused():
    with pytest.raises(ValueError, match="env must be RBL/Tracking-v0 or another"):
        SelectAnchors(gym.make("CartPole-v1"))
