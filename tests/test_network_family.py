"""RBL/PlanarNetwork-v0 with `scenes=`: drawn networks, padding, the bound by hand, errors."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rbl_gym.envs.network_plans import PRIOR_STD_RAD, NetworkFamily, NetworkPlan
from rbl_gym.networks.bounds import linked_covariance, linked_pose_covariance
from rbl_gym.worlds import field_laws
from rbl_gym.wrappers import EstimateNetwork, VectorEstimateNetwork
from tests.helpers import assert_same

ID = "rbl_gym:RBL/PlanarNetwork-v0"
DRAWN = [
    {"n_nodes": {"integers": [3, 7]}, "radius_m": {"uniform": [3.0, 8.0]}, "blind_m": 0.2},
    {
        "n_nodes": 5,
        "side_m": {"log-uniform": [2.0, 30.0]},
        "bearing_std_rad": {"choice": [0.01, 0.2]},
        "step_m": 1.5,
    },
]
every_length = pytest.mark.parametrize("lengths", ["none", "one", "all"])


@every_length
def test_a_family_of_one_is_the_network_itself(lengths):
    fields = {"n_nodes": 6, "side_m": 8.0, "radius_m": 5.0, "bearing_std_rad": 0.1}
    alone = gym.make(ID, lengths=lengths, **fields)
    drawn = gym.make(ID, lengths=lengths, scenes=fields)
    first, told = alone.reset(seed=3)
    observation, info = drawn.reset(seed=3)
    assert json.loads(info.pop("scene")) == fields
    for _ in range(4):
        np.testing.assert_array_equal(observation.pop("node_mask"), 1)
        np.testing.assert_array_equal(observation.pop("network")[:2], [8.0, 5.0])
        assert_same((observation, info), (first, told))
        action = alone.action_space.sample()
        first, reward, *_, told = alone.step(action)
        observation, paid, *_, info = drawn.step(action)
        assert paid == reward


@every_length
def test_drawn_networks_by_hand(lengths):
    env = gym.make(ID, scenes=DRAWN, lengths=lengths)
    env.action_space.seed(0)
    counts, stds = set(), set()
    for seed in range(12):
        observation, info = env.reset(seed=seed)
        fields = json.loads(info["scene"])
        plan = NetworkPlan(**fields)
        if lengths == "one":
            plan = dataclasses.replace(plan, length_std_m=1e-4 * plan.side_m)
        n, before = plan.n_nodes, info["positions"]
        counts.add(n)
        stds.add(plan.bearing_std_rad)
        action = env.action_space.sample()
        observation, reward, *_, info = env.step(action)
        assert env.observation_space.contains(observation)
        numbers = [plan.side_m, plan.radius_m, plan.blind_m, plan.bearing_std_rad]
        numbers += [plan.length_std_m, plan.step_m]
        np.testing.assert_allclose(observation["network"], numbers, rtol=1e-12)
        np.testing.assert_array_equal(observation["node_mask"], np.arange(7) < n)
        places, theta = info["positions"], info["orientations"]
        assert not places[n:].any()
        assert not theta[n:].any()
        assert not observation["bearings"][n:].any()
        links = np.zeros((7, 7), dtype=bool)
        for i in range(n):
            ahead = plan.step_m * action[2 * i : 2 * i + 2]
            turn = np.array([[np.cos(theta[i]), -np.sin(theta[i])],
                             [np.sin(theta[i]), np.cos(theta[i])]])  # fmt: skip
            moved = np.clip(before[i] + turn @ ahead, 0, plan.side_m)
            np.testing.assert_allclose(places[i], moved, atol=1e-6)
            for j in range(n):
                gap = np.linalg.norm(places[j] - places[i])
                links[i, j] = plan.blind_m <= gap <= plan.radius_m
        np.testing.assert_array_equal(observation["links"], links)
        small = links[:n, :n]
        covariance = linked_covariance(small, plan.bearing_std_rad, PRIOR_STD_RAD)
        if lengths != "none":
            ranged = observation["lengths"][:n, :n] > 0
            covariance = linked_pose_covariance(places[:n], small, ranged, plan.sensing)
            score = np.sqrt(np.trace(covariance) / (n - 1))
            assert info["score_m"] == pytest.approx(score, rel=1e-9)
            assert reward == pytest.approx(-np.log(score), abs=1e-9)
        score = np.sqrt(np.diagonal(covariance)[: n - 1].mean())
        assert info["score_rad"] == pytest.approx(score, rel=1e-9)
        if lengths == "none":
            assert reward == pytest.approx(-np.log(score), abs=1e-9)
    assert len(counts) > 2
    assert stds == {0.01, 0.05, 0.2}


def test_the_checker_and_frames():
    check_env(gym.make(ID, scenes=DRAWN).unwrapped, skip_render_check=True)
    env: Any = gym.make(ID, scenes=DRAWN, render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape == (540, 960, 3)


def test_largest_numbers_are_those_of_the_spaces():
    family = NetworkFamily(tuple(DRAWN), NetworkPlan())
    assert (family.highest.n_nodes, family.highest.radius_m, family.highest.side_m) == (7, 8, 30)
    assert field_laws.limits({"choice": [3.0, {"uniform": [1.0, 9.0]}, 2]}) == (1.0, 9.0)
    assert field_laws.limits(4) == (4, 4)
    space: Any = gym.make(ID, scenes=DRAWN).observation_space
    assert space["bearings"].shape == (7, 7)


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ([], "scenes must have at least one network"),
        ("uwb_room", "scenes must be a list of dicts or a dict, got 'uwb_room'"),
        (["hall"], r"scenes\[0\] must be a dict with fields of a network \(n_nodes, side_m"),
        ([{"steps": 3}], r"scenes\[0\] must only have the fields n_nodes, .* got 'steps'"),
        ([{"n_nodes": 1}], r"scenes\[0\]: n_nodes must be"),
        ([{}, {"radius_m": {"uniform": [-1, 5]}}], r"scenes\[1\]: radius_m must"),
        ([{"n_nodes": {"integers": [2.5, 5]}}], r"scenes\[0\].n_nodes.integers must be two whole"),
        ([{"side_m": {"choice": ["long"]}}], "side_m"),
    ],
)
def test_wrong_families_are_named(scenes, message):
    with pytest.raises(ValueError, match=message):
        gym.make(ID, scenes=scenes)


def test_an_estimator_needs_one_network():
    with pytest.raises(ValueError, match="scenes must be left out: EstimateNetwork"):
        EstimateNetwork(gym.make(ID, scenes=DRAWN))
    with pytest.raises(ValueError, match="scenes must be left out: EstimateNetwork"):
        VectorEstimateNetwork(gym.make_vec(ID, num_envs=2, scenes=DRAWN))
