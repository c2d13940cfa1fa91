"""RBL/SharedAnchors-v0: several bodies, one set of anchors, a filter for each."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym.wrappers.shared_anchors import SharedAnchorsEnv, SharedAnchorsVectorEnv
from tests.helpers import needs
from tests.side_by_side import actions_of

ID = "rbl_gym:RBL/SharedAnchors-v0"
PLATE = [[0.5, 0.5, 0], [-0.5, 0.5, 0.1], [0.5, -0.5, 0.2], [-0.5, -0.5, 0]]
TWO: dict[str, Any] = {
    "scene": {"name": "drone_yard", "n_anchors": 5, "anchor_speed_m_s": 3.0, "steps": 5},
    "bodies": [{}, {"tags": PLATE, "speed_m_s": 1.0, "noise": {"floor_m": 0.3}}],
}


@needs("stable_baselines3")
def test_sb3_checker():
    from stable_baselines3.common.env_checker import (
        check_env as check_sb3,
    )

    check_sb3(SharedAnchorsEnv(observation="flat", **TWO))


def test_ranges_are_those_of_each_body_to_the_same_anchors():
    env = SharedAnchorsEnv(**TWO)
    observation, info = env.reset(seed=5)
    errors, floors = [], [0.1, 0.3]
    for _ in range(5):
        for k, (tags, floor) in enumerate(zip(observation["tags"], floors, strict=True)):
            n = int(observation["tag_mask"][k].sum())
            assert n == (6, 4)[k]
            places = tags[:n] @ info["rotation"][k].T + info["translation"][k]
            gap = np.linalg.norm(places - observation["anchors"][:, None], axis=-1)
            std = np.hypot(floor, 0.001 * gap)
            errors.append(((observation["ranges"][k][:, :n] - gap) / std).ravel())
            assert not observation["links"][k][:, n:].any()
        observation, *_, info = env.step(env.action_space.sample())
    errors = np.concatenate(errors)
    # 250 standard normals.
    assert abs(errors.mean()) < 4.5 / np.sqrt(250)
    assert abs(np.square(errors).mean() - 1) < 4.5 * np.sqrt(2 / 250)


@pytest.mark.parametrize(
    ("combine", "by_hand"), [("mean", np.mean), ("worst", np.min), ("sum", np.sum)]
)
def test_rewards_become_one(combine, by_hand):
    env = SharedAnchorsEnv(**TWO, combine=combine)
    env.reset(seed=1)
    _, reward, *_, info = env.step(env.action_space.sample())
    assert reward == pytest.approx(by_hand(-np.log(info["score_m"])), rel=1e-12)


def test_an_action_moves_the_anchors_of_all():
    env = SharedAnchorsEnv(**TWO)
    before = env.reset(seed=1)[0]["anchors"]
    after = env.step(np.tile([1.0, 0, 0], 5))[0]["anchors"]
    dt, region = env.family.corners[0].dt, env.family.corners[0].anchor_region
    np.testing.assert_allclose(after, region.project(before + [3.0 * dt, 0, 0]), atol=1e-12)


def test_one_body_alone_is_a_world_of_its_own():
    env = SharedAnchorsEnv(scene="uwb_room", bodies=[{}])
    observation, info = env.reset(seed=1)
    assert observation["ranges"].shape == (1, 6, 6)
    assert info["nees"].shape == (1,)
    assert env.action_space == gym.spaces.Discrete(1)


def test_masks_restart_only_some_worlds():
    envs = SharedAnchorsVectorEnv(3, autoreset_mode="Disabled", **TWO)
    envs.reset(seed=1)
    rng = np.random.default_rng(1)
    before = envs.step(actions_of(envs, rng))[0]
    mask = np.array([False, True, False])
    after, info = envs.reset(options={"reset_mask": mask})
    for world, fresh in enumerate(mask):
        assert np.array_equal(before["ranges"][world], after["ranges"][world]) == (not fresh)
    np.testing.assert_array_equal(info["_prior_rotation"], mask)
    assert [json.loads(one)["name"] for one in info["scene"][1]] == ["drone_yard"] * 2


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"bodies": []}, "bodies must be a list of dicts, .*; got"),
        ({"bodies": [3]}, r"bodies\[0\] must be a dict of changes of the scene, got 3"),
        ({"bodies": [{}, {"dt": 0.5}]}, r"bodies\[1\] must have the dt of the others, got 0.5"),
        ({"bodies": [{}, {"n_anchors": 3}]}, r"bodies\[1\] must have the n_anchors"),
        ({"scene": 3}, "scene must be a name or a dict"),
        ({"scene": "castle"}, "scene must be one of"),
        ({"combine": "best"}, "combine must be one of"),
        ({"reward": "gold"}, "reward must be one of"),
        ({"filter": "gold"}, "filter must be one of"),
        ({"observation": "picture"}, "observation must be one of"),
        ({"num_envs": 0}, "num_envs"),
    ],
)
def test_wrong_arguments_are_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        SharedAnchorsVectorEnv(**{**TWO, **arguments})
