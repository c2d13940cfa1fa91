"""VectorEstimatePose around native vector environments; beside scalar ones: `test_contract`."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorWrapper

from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from tests.helpers import assert_same
from tests.test_tracking_vector_env import ID, short


class Watched(VectorWrapper):
    """Keeps copies of what passes through it, and the things themselves."""

    def __init__(self, env):
        super().__init__(env)
        self.seen = []

    def reset(self, **arguments):
        return self.keep(self.env.reset(**arguments))

    def step(self, actions):
        return self.keep(self.env.step(actions))

    def keep(self, result):
        self.seen.append((copy.deepcopy(result), result))
        return result


@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_wrappers_below_see_the_environment_as_it_is(mode):
    below = Watched(gym.make_vec(ID, num_envs=3, scene=short("hall", 4), autoreset_mode=mode))
    plain = gym.make_vec(ID, num_envs=3, scene=short("hall", 4), autoreset_mode=mode)
    envs = VectorEstimatePose(below, "iekf")
    zeros = np.zeros(3, int)
    above: list[Any] = [envs.reset(seed=1)]
    want: list[Any] = [plain.reset(seed=1)]
    for _ in range(9):
        above.append(envs.step(zeros))
        want.append(plain.step(zeros))
    for (then, after), mine, raw in zip(below.seen, above, want, strict=True):
        assert_same(then, raw)
        assert_same(after, raw)
        np.testing.assert_array_equal(mine[-1]["bound_m"], raw[-1]["score_m"])
        if "final_info" in raw[-1]:
            final = mine[-1]["final_info"]
            np.testing.assert_array_equal(final["bound_m"], raw[-1]["final_info"]["score_m"])
    assert all(np.any(step[1] != 0) for step, _ in below.seen[1:4])


def test_wraps_what_make_vec_gives_and_computes_no_bound_where_none_is_asked_for(monkeypatch):
    from rbl_gym.worlds import scene_bounds

    def refuse(*_):
        raise AssertionError("the bound was computed")

    monkeypatch.setattr(scene_bounds, "posterior_step", refuse)
    envs = gym.make_vec(ID, num_envs=4, scene="uwb_room", reward="none")
    wrapped = VectorEstimatePose(envs, "iekf")
    wrapped.reset(seed=1)
    _, reward, _, _, info = wrapped.step(np.zeros(4, int))
    np.testing.assert_allclose(reward, -np.log(info["score_m"]))


def test_wrong_environments_and_names_are_named():
    with pytest.raises(ValueError, match="env must be RBL/Tracking-v0 or another"):
        VectorEstimatePose(gym.make_vec("CartPole-v1", num_envs=2))
    with pytest.raises(ValueError, match=r"reward must be one of 'belief'.*got 'gold'"):
        VectorEstimatePose(TrackingVectorEnv(2), reward="gold")
    mistaken: Any = TrackingVectorEnv(2)
    with pytest.raises(ValueError, match=r"got the vector environment .*: use VectorEstimatePose"):
        EstimatePose(mistaken)
    single: Any = gym.make(ID)
    with pytest.raises(ValueError, match=r"got the single environment .*: use EstimatePose"):
        VectorEstimatePose(single)
