"""RBL/PlanarNetwork-v0 and EstimateNetwork: the contract, the bound by hand, scalar and vector."""

# scipy.sparse comes without stubs, and pyright's guesses of it are wrong.
# pyright: reportOptionalMemberAccess=false, reportAttributeAccessIssue=false
# pyright: reportArgumentType=false, reportCallIssue=false
from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rbl_gym.envs.network import PRIOR_STD_RAD, PlanarNetworkEnv, PlanarNetworkVectorEnv
from rbl_gym.networks.bounds import orientation_covariance
from rbl_gym.networks.sensing import proj
from rbl_gym.wrappers import EstimateNetwork, VectorEstimateNetwork
from rbl_gym.wrappers.estimate_network import consensus
from tests.helpers import assert_same
from tests.side_by_side import (
    actions_of,
    assert_memory_is_not_shared,
    assert_twins_go_on_alike,
    of_its_spec,
)

ID = "rbl_gym:RBL/PlanarNetwork-v0"


def make(**arguments):
    return gym.make(ID, **arguments)


def make_vec(count=3, mode="NextStep", **arguments):
    return gym.make_vec(ID, num_envs=count, autoreset_mode=mode, **arguments)


# --- Gymnasium --------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [{}, {"n_nodes": 2}, {"reward": "none", "radius_m": 2.0}])
def test_gymnasiums_checker_has_no_complaint(arguments):
    check_env(make(**arguments).unwrapped)


def test_specs_round_trip_with_the_wrapper():
    env = EstimateNetwork(make(n_nodes=5, steps=4), reward="error")
    again = of_its_spec(env)
    action = np.full(10, 0.3, np.float32)
    assert_same(again.reset(seed=2), env.reset(seed=2))
    assert_same(again.step(action), env.step(action))


def test_twins_in_mid_episode_go_on_alike():
    env = PlanarNetworkVectorEnv(2, n_nodes=6)
    env.reset(seed=1)
    env.step(actions_of(env, np.random.default_rng(0)))
    assert_twins_go_on_alike(env, 3)


def test_memory_is_never_shared():
    assert_memory_is_not_shared(lambda: VectorEstimateNetwork(make_vec(steps=4)), 6)


@pytest.mark.parametrize("wrap", [False, True], ids=["raw", "estimated"])
def test_world_i_of_a_vector_is_the_scalar_environment(wrap):
    vector, scalars = make_vec(steps=5), [make(steps=5) for _ in range(3)]
    if wrap:
        vector = VectorEstimateNetwork(vector)
        scalars = [EstimateNetwork(env) for env in scalars]
    rng = np.random.default_rng(2)
    observation, info = vector.reset(seed=5)
    for world, env in enumerate(scalars):
        first, told = env.reset(seed=5 + world)
        assert_same({key: value[world] for key, value in observation.items()}, first, atol=1e-12)
    for _ in range(5):
        actions = actions_of(vector, rng)
        observation, reward, _, truncated, info = vector.step(actions)
        assert vector.observation_space.contains(observation)
        for world, env in enumerate(scalars):
            single, one, terminated, over, told = env.step(actions[world])
            assert_same({key: value[world] for key, value in observation.items()}, single,
                        atol=1e-12)  # fmt: skip
            assert one == pytest.approx(reward[world], abs=1e-12)
            assert type(one) is float
            assert (terminated, over) == (False, truncated[world])
            for key, value in told.items():
                np.testing.assert_allclose(info[key][world], value, atol=1e-12)
    assert truncated.all()


# --- what it measures -------------------------------------------------------------------------


def test_bearings_links_and_the_bound_by_hand():
    env = make(bearing_std_rad=1e-7, n_nodes=10).unwrapped
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        action = np.random.default_rng(seed).uniform(-1, 1, 20)
        places, theta = info["positions"], info["orientations"]
        for i in range(10):
            c, s = np.cos(theta[i]), np.sin(theta[i])
            ahead, left = 0.5 * action[2 * i : 2 * i + 2]
            places[i] += [c * ahead - s * left, s * ahead + c * left]
        places = np.clip(places, 0, 10)
        observation, reward, _, _, info = env.step(action)
        np.testing.assert_allclose(info["positions"], places, atol=1e-12)
        np.testing.assert_array_equal(info["orientations"], theta)
        edges = []
        for i in range(10):
            for j in range(10):
                apart = places[j] - places[i]
                sees = i != j and 0.5 <= np.linalg.norm(apart) <= 4
                assert observation["links"][i, j] == sees
                want = np.arctan2(apart[1], apart[0]) - theta[i] if sees else 0.0
                assert abs(proj(observation["bearings"][i, j] - want)) < 1e-6
                if sees and i < j:
                    edges.append([i, j])
        covariance = orientation_covariance(edges, 10, 1e-7)
        score = np.sqrt(np.trace(covariance) / 9)
        assert info["score_rad"] == pytest.approx(score, rel=1e-6)
        assert reward == pytest.approx(-np.log(score), rel=1e-6)


def test_nodes_that_nothing_is_known_of_have_their_prior():
    env = make(n_nodes=3, radius_m=0.0).unwrapped
    observation, info = env.reset(seed=0)
    assert not observation["links"].any()
    assert info["score_rad"] == pytest.approx(PRIOR_STD_RAD)
    observation, info = EstimateNetwork(env).reset(seed=0)
    np.testing.assert_array_equal(observation["orientations"], np.zeros(3))
    np.testing.assert_allclose(observation["orientation_std"], [0, PRIOR_STD_RAD, PRIOR_STD_RAD])


# --- the wrapper ------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "worlds"), [("NextStep", 40), ("SameStep", 5), ("Disabled", 5)])
def test_the_estimates_errors_are_as_large_as_promised(mode, worlds):
    env = VectorEstimateNetwork(
        make_vec(worlds, mode, steps=6, n_nodes=6, side_m=6.0, radius_m=7.0), reward="error"
    )
    rng = np.random.default_rng(3)
    env.reset(seed=0)
    square, promised = [], []
    for step in range(12):
        if mode == "Disabled" and step == 6:
            env.reset(options={"reset_mask": np.ones(worlds, dtype=np.bool_)})
        _, reward, _, truncated, info = env.step(actions_of(env, rng))
        square.append(info["orientation_error_rad"] ** 2)
        promised.append(info["belief_rad"] ** 2)
        last = mode == "SameStep" and truncated.all()
        assert truncated.all() == (step in ((5, 12) if mode == "NextStep" else (5, 11)))
        final = info["final_info"] if last else info
        reset = mode == "NextStep" and step == 6
        np.testing.assert_array_equal(reward, 0 if reset else -final["orientation_error_rad"])
        if last:
            assert set(info["final_obs"][0]) == set(env.single_observation_space.spaces)
            assert env.single_observation_space.contains(info["final_obs"][0])
    # Of 40 worlds the ratio scatters by 5 % over seeds.
    tolerance = 4 * 0.05 * np.sqrt(40 / worlds)
    assert np.mean(square) == pytest.approx(np.mean(promised), rel=tolerance)


def test_a_warm_start_keeps_long_cycles_from_slipping():
    # A ring of 16 with much noise: the sum of its angles is often more than half a turn off.
    n_nodes, sigma = 16, 0.6
    angle = 2 * np.pi * np.arange(n_nodes) / n_nodes
    places = np.column_stack([np.cos(angle), np.sin(angle)])
    apart = places[None] - places[:, None]
    distance = np.linalg.norm(apart, axis=-1)
    links = (distance > 0) & (distance < 0.5)
    rng = np.random.default_rng(4)
    theta = np.concatenate([[0.0], rng.uniform(-3, 3, n_nodes - 1)])
    errors = {"cold": [], "warm": []}
    for _ in range(80):
        normals = sigma * rng.standard_normal((n_nodes, n_nodes))
        bearings = proj(np.arctan2(apart[..., 1], apart[..., 0]) - theta[:, None] + normals)
        for name, before in (("cold", None), ("warm", theta)):
            found, _ = consensus(links, bearings, before)
            errors[name].append(np.mean(proj(found - theta) ** 2))
    # The ratio is 0.73, and scatters by 0.05.
    assert np.mean(errors["warm"]) < 0.85 * np.mean(errors["cold"])


def test_part_of_the_network_is_estimated_and_the_rest_keeps_what_it_had():
    links = np.zeros((4, 4), dtype=np.bool_)
    links[0, 2] = links[2, 0] = links[1, 3] = links[3, 1] = True
    bearings = np.zeros((4, 4))
    bearings[0, 2], bearings[2, 0] = 0.3, -2.5
    theta, steps = consensus(links, bearings, np.array([0.0, 1.0, 0.0, -1.0]))
    np.testing.assert_allclose(theta, [0, 1, proj(0.3 + 2.5 + np.pi), -1])
    assert steps == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_nodes": 1}, "n_nodes must be an int from 2 to 10000, got 1"),
        ({"n_nodes": 4.0}, "n_nodes must be an int"),
        ({"steps": 0}, "steps must be"),
        ({"radius_m": np.nan}, "radius_m must be a finite number"),
        ({"bearing_std_rad": 0.0}, "bearing_std_rad must be"),
        ({"reward": "error"}, "reward must be one of 'bound', 'none', got 'error'"),
        ({"render_mode": "human"}, "render_mode must be None"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        PlanarNetworkEnv(**arguments)


def test_wrong_actions_and_worlds_are_named():
    env = PlanarNetworkVectorEnv(2, n_nodes=3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="actions must be finite"):
        env.step(np.full((2, 6), np.nan))
    with pytest.raises(ValueError, match=r"actions must be numbers of shape \(2, 6\)"):
        env.step(np.zeros((2, 5)))
    with pytest.raises(ValueError, match="env must be RBL/PlanarNetwork-v0"):
        EstimateNetwork(gym.make("rbl_gym:RBL/Tracking-v0"))
    with pytest.raises(ValueError, match="env must be RBL/PlanarNetwork-v0"):
        VectorEstimateNetwork(gym.make_vec("rbl_gym:RBL/Tracking-v0", num_envs=2))
    with pytest.raises(ValueError, match="reward must be one of 'belief', 'error'"):
        EstimateNetwork(make(), reward="bound")
