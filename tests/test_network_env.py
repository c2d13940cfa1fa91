"""RBL/PlanarNetwork-v0 and EstimateNetwork: the contract, the bound by hand, scalar and vector."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym.envs.network import PRIOR_STD_RAD, PlanarNetworkEnv, PlanarNetworkVectorEnv
from rbl_gym.estimators.networks.beliefs import consensus
from rbl_gym.networks.bounds import (
    Sensing,
    bearing_jacobian,
    linked_covariance,
    linked_pose_covariance,
    orientation_covariance,
    range_jacobian,
)
from rbl_gym.networks.sensing import proj
from rbl_gym.wrappers import EstimateNetwork, VectorEstimateNetwork
from tests.helpers import assert_same
from tests.side_by_side import actions_of

ID = "rbl_gym:RBL/PlanarNetwork-v0"


def make(**arguments):
    return gym.make(ID, **arguments)


def make_vec(count=3, mode="NextStep", **arguments):
    return gym.make_vec(ID, num_envs=count, autoreset_mode=mode, **arguments)


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


def test_lengths_by_hand():
    bare, one = make(n_nodes=8).unwrapped, make(n_nodes=8, lengths="one").unwrapped
    noisy = make_vec(100, n_nodes=8, lengths="all", length_std_m=0.2).unwrapped
    for seed in range(5):
        observation, info = one.reset(seed=seed)
        # Lengths change nothing of what is measured beside them.
        beside = {name: observation[name] for name in ("bearings", "links")}
        assert_same(bare.reset(seed=seed)[0], beside)
        places, links = info["positions"], observation["links"]
        distance = np.linalg.norm(places[0] - places, axis=1) * links[0]
        known = np.zeros((8, 8))
        known[0, distance.argmax()] = known[distance.argmax(), 0] = distance.max()
        np.testing.assert_allclose(observation["lengths"], known, atol=1e-12)
    observation, info = noisy.reset(seed=0)
    places, links, lengths = info["positions"], observation["links"], observation["lengths"]
    np.testing.assert_array_equal(lengths, lengths.swapaxes(1, 2))
    np.testing.assert_array_equal(lengths > 0, links == 1)
    distance = np.linalg.norm(places[:, None] - places[:, :, None], axis=-1)
    errors = (lengths - distance)[np.triu(links) == 1]
    # To 4 standard deviations.
    assert abs(errors.mean()) < 4 * 0.2 / np.sqrt(errors.size)
    assert errors.std() == pytest.approx(0.2, rel=4 / np.sqrt(2 * errors.size))


@pytest.mark.parametrize("lengths", ["one", "all"])
def test_the_bound_of_poses_by_hand(lengths):
    """Against the sparse Jacobians: bearings, lengths, and what is known of any link's length."""
    env = make(n_nodes=9, lengths=lengths, length_std_m=0.2, bearing_std_rad=0.03).unwrapped
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        places, links = info["positions"], observation["links"]
        edges = np.argwhere(np.triu(links))
        # A link is 0.5 to 4 m long, spread as the area: moments by numbers.
        at = np.linspace(0.5, 4, 100_001)
        mean = np.average(at, weights=at)
        std = np.sqrt(np.average((at - mean) ** 2, weights=at))
        measured = observation["lengths"][edges[:, 0], edges[:, 1]] > 0
        sigma = (std**-2 + measured / (0.2 if lengths == "all" else 1e-3) ** 2) ** -0.5
        B = bearing_jacobian(places, edges).toarray() / 0.03
        R = range_jacobian(places, edges).toarray() / sigma[:, None]
        J = np.delete(np.vstack([B, R]), [0, 9, 10], axis=1)
        prior = np.repeat([PRIOR_STD_RAD**-2, 6 / 10**2], [8, 16])
        covariance = np.linalg.inv(J.T @ J + np.diag(prior))
        assert info["score_m"] == pytest.approx(np.sqrt(np.trace(covariance) / 8), rel=1e-4)
        want = np.sqrt(np.trace(covariance[:8, :8]) / 8)
        assert info["score_rad"] == pytest.approx(want, rel=1e-4)
        _, reward, *_, info = env.step(np.zeros(18, np.float32))
        assert reward == pytest.approx(-np.log(info["score_m"]))


def test_a_part_that_node_0_does_not_see_has_its_prior():
    places = np.array([[0, 0], [1, 0], [0, 3], [1, 3.0]])
    links = np.zeros((4, 4), dtype=np.bool_)
    links[0, 1] = links[1, 0] = links[2, 3] = links[3, 2] = True
    covariance = linked_covariance(links, 0.05, PRIOR_STD_RAD)
    np.testing.assert_allclose(covariance[1:, 1:], np.eye(2) * PRIOR_STD_RAD**2)
    sensing = Sensing(0.05, 0.1, (2.0, 0.5), PRIOR_STD_RAD, 4.0)
    covariance = linked_pose_covariance(places, links, links, sensing)
    np.testing.assert_allclose(np.diag(covariance)[[1, 2]], PRIOR_STD_RAD**2)
    np.testing.assert_allclose(np.diag(covariance)[5:], 16.0)
    # The one link: a bearing in node 0's own frame, and a length.
    np.testing.assert_allclose(np.diag(covariance)[3:5], [1 / (100 + 4), 0.05**2], rtol=2e-3)


# --- the wrapper ------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "worlds"), [("NextStep", 20), ("SameStep", 5), ("Disabled", 5)])
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
        promised.append(info["score_rad"] ** 2)
        assert (info["belief_rad"] >= info["score_rad"] * (1 - 1e-9)).all()
        last = mode == "SameStep" and truncated.all()
        assert truncated.all() == (step in ((5, 12) if mode == "NextStep" else (5, 11)))
        final = info["final_info"] if last else info
        reset = mode == "NextStep" and step == 6
        np.testing.assert_array_equal(reward, 0 if reset else -final["orientation_error_rad"])
        if last:
            space: Any = env.single_observation_space
            assert set(info["final_obs"][0]) == set(space.spaces)
            assert space.contains(info["final_obs"][0])
    # Of 40 worlds the ratio scatters by 5 % over seeds.
    tolerance = 4 * 0.05 * np.sqrt(40 / worlds)
    assert np.mean(square) == pytest.approx(np.mean(promised), rel=tolerance)


@pytest.mark.parametrize(
    ("lengths", "arguments"),
    [
        ("all", {}),
        ("one", {"radius_m": 7.0}),
        pytest.param("one", {}, marks=pytest.mark.long),
        pytest.param("all", {"radius_m": 7.0}, marks=pytest.mark.long),
    ],
)
def test_poses_reach_their_bound(lengths, arguments):
    """60 worlds, 3 epochs, less those in parts; the ratios scatter by 5 % over seeds."""
    envs = VectorEstimateNetwork(make_vec(60, lengths=lengths, **arguments))
    rng = np.random.default_rng(0)
    envs.reset(seed=40)
    rows, nees = [], []
    for _ in range(3):
        observation, reward, *_, info = envs.step(actions_of(envs, rng))
        np.testing.assert_allclose(reward, -info["pose_error_m"])
        whole = np.linalg.matrix_power(observation["links"] + np.eye(12), 11)[:, 0].all(axis=-1)
        rows.append(
            np.array(
                [
                    info[name][whole] ** 2
                    for name in (
                        "pose_error_m",
                        "score_m",
                        "belief_m",
                        "orientation_error_rad",
                        "score_rad",
                    )
                ]
            )
        )
        places = info["positions"] - info["positions"][:, :1]
        off = np.concatenate([proj(observation["orientations"] - info["orientations"])[..., None],
                              observation["positions"] - places], axis=-1)[whole, 1:]  # fmt: skip
        P = observation["pose_covariance"][whole, 1:]
        nees.append((off * np.linalg.solve(P, off[..., None])[..., 0]).sum(axis=-1).ravel())
    pose, bound, belief, turn, turn_bound = np.sqrt(np.concatenate(rows, axis=1).mean(axis=1))
    assert 0.8 * bound < pose < 1.1 * bound
    assert 0.8 * turn_bound < turn < 1.1 * turn_bound
    assert bound < belief < 1.1 * bound
    # Half of a chi-square of 3 degrees is below 2.37; scaled beliefs are a little wide.
    assert 1.7 < np.median(np.concatenate(nees)) < 2.5


@pytest.mark.parametrize("sigma", [1e-6, 0.5, 3.0])
@pytest.mark.parametrize("lengths", ["one", "all"])
def test_beliefs_stay_finite_and_definite_in_any_noise(lengths, sigma):
    envs = VectorEstimateNetwork(
        make_vec(6, lengths=lengths, bearing_std_rad=sigma, step_m=10.0), reward="belief"
    )
    rng = np.random.default_rng(0)
    observation, _ = envs.reset(seed=7)
    for _ in range(3):
        assert envs.observation_space.contains(observation)
        values = np.linalg.eigvalsh(observation["pose_covariance"][:, 1:])
        assert values.min() > -1e-9
        assert np.diagonal(observation["pose_covariance"][:, 1:], axis1=-2, axis2=-1).min() > 0
        observation, reward, *_ = envs.step(actions_of(envs, rng))
        assert np.isfinite(reward).all()


def test_too_few_steps_show_in_the_belief():
    found = {}
    for steps in (0, 5000):
        envs = VectorEstimateNetwork(make_vec(40, radius_m=7.0), reward="belief", steps=steps)
        _, info = envs.reset(seed=1)
        found[steps] = info
        assert info["consensus_converged"].all() == (steps > 0)
        assert (info["consensus_steps"] <= steps).all()
        _, reward, *_, info = envs.step(np.zeros((40, 24)))
        np.testing.assert_allclose(reward, -np.log(info["belief_rad"]))
        ratio = np.maximum(info["chi_square"], 1)
        np.testing.assert_allclose(
            info["belief_rad"], info["score_rad"] * np.sqrt(ratio), rtol=0.02
        )
    # A tree alone leaves the other edges far off.
    assert found[5000]["chi_square"].mean() == pytest.approx(1, abs=0.1)
    assert found[0]["chi_square"].mean() > 1.5
    error = {
        steps: np.sqrt(np.mean(info["orientation_error_rad"] ** 2)) for steps, info in found.items()
    }
    assert error[0] > 1.3 * error[5000]


@pytest.mark.parametrize("kappa", [None, "best", "theorem", "trace", 0.01])
@pytest.mark.parametrize("cycles", ["bfs", "paton", "minimum", "all"])
def test_options_of_the_consensus_lead_to_one_estimate(kappa, cycles):
    arguments = {"n_nodes": 5, "radius_m": 15.0, "bearing_std_rad": 0.02}
    env = EstimateNetwork(make(**arguments), cycles=cycles, kappa=kappa)
    other = EstimateNetwork(make(**arguments), order="asynchronous")
    found, info = env.reset(seed=3)
    expected, told = other.reset(seed=3)
    assert info["consensus_converged"]
    assert told["consensus_converged"]
    np.testing.assert_allclose(found["orientations"], expected["orientations"], atol=1e-7)
    action = np.ones(10, np.float32)
    np.testing.assert_allclose(
        env.step(action)[0]["orientations"], other.step(action)[0]["orientations"], atol=1e-7
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cycles": "none"}, "cycles must be one of"),
        ({"cycles": 3}, "cycles must be a name such as 'bfs', got 3"),
        ({"kappa": "fast"}, "kappa must be one of"),
        ({"kappa": 0.7}, "kappa must lie in"),
        ({"order": "random"}, "order must be one of"),
        ({"steps": 1.5}, "steps must be an int"),
        ({"reward": "bound"}, "reward must be one of 'belief', 'error'"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        EstimateNetwork(make(), **options)
    with pytest.raises(ValueError, match=message):
        VectorEstimateNetwork(make_vec(), **options)


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
            found, *_ = consensus(links, bearings, before)
            errors[name].append(np.mean(proj(found - theta) ** 2))
    # The ratio is 0.73, and scatters by 0.05.
    assert np.mean(errors["warm"]) < 0.85 * np.mean(errors["cold"])


def test_part_of_the_network_is_estimated_and_the_rest_keeps_what_it_had():
    links = np.zeros((4, 4), dtype=np.bool_)
    links[0, 2] = links[2, 0] = links[1, 3] = links[3, 1] = True
    bearings = np.zeros((4, 4))
    bearings[0, 2], bearings[2, 0] = 0.3, -2.5
    theta, steps, converged = consensus(links, bearings, np.array([0.0, 1.0, 0.0, -1.0]))
    np.testing.assert_allclose(theta, [0, 1, float(proj(0.3 + 2.5 + np.pi)), -1])
    assert (steps, converged) == (0, True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_nodes": 1}, "n_nodes must be an int from 2 to 10000, got 1"),
        ({"n_nodes": 4.0}, "n_nodes must be an int"),
        ({"steps": 0}, "steps must be"),
        ({"radius_m": np.nan}, "radius_m must be a finite number"),
        ({"bearing_std_rad": 0.0}, "bearing_std_rad must be"),
        ({"lengths": "some"}, "lengths must be one of 'none', 'one', 'all', got 'some'"),
        ({"length_std_m": 0.0}, "length_std_m must be"),
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
