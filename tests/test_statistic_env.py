"""Tracking whose epochs are observed as their statistic: 12 normals in place of M x N ranges."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from rbl_gym import estimators, statistic
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.ranging import SquaredRangeNoise
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from tests.helpers import assert_same
from tests.side_by_side import actions_of
from tests.test_tracking_vector_env import ID, short

FIXED = short("camsap2013", 6)
MOVABLE = short("camsap2013", 6, anchor_speed_m_s=20.0)
SCENES = pytest.mark.parametrize("scene", [FIXED, MOVABLE], ids=["fixed", "movable"])
MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]


def scalar(scene, reward="bound"):
    return TrackingEnv(scene, reward, observation="statistic")


def rollout(env, seed, steps=6):
    env.action_space.seed(seed)
    return [env.reset(seed=seed), *(env.step(env.action_space.sample()) for _ in range(steps))]


@SCENES
@pytest.mark.parametrize("reward", ["bound", "none"])
def test_gymnasiums_checker_has_no_complaint(scene, reward):
    check_env(gym.make(ID, scene=scene, reward=reward, observation="statistic").unwrapped)


@SCENES
def test_space_is_finite_and_holds_every_observation(scene):
    env: Any = scalar(scene)
    assert set(env.observation_space.keys()) == {"G", "B", "anchors", "twist"}
    for key in ("G", "B"):
        assert np.isfinite(env.observation_space[key].high).all()
        assert env.observation_space[key].dtype == np.float64
    for seed in range(4):
        for result in rollout(env, seed):
            assert env.observation_space.contains(result[0])
            assert "nlos" not in result[-1]


@SCENES
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("reward", ["bound", "none"])
def test_vector_equals_scalar_environments_episode_after_episode(scene, mode, reward):
    options = {"observation": "statistic", "autoreset_mode": mode}
    native = TrackingVectorEnv(4, scene, reward, **options)
    peer = SyncVectorEnv([lambda: scalar(scene, reward)] * 4, autoreset_mode=mode)
    rng = np.random.default_rng(1)
    got, want = native.reset(seed=5), peer.reset(seed=5)
    for _ in range(15):
        for a, b in zip(got, want, strict=True):
            assert_same(a, b, rtol=1e-9, atol=1e-9)
        assert native.observation_space.contains(got[0])
        actions = actions_of(native, rng)
        got, want = native.step(actions), peer.step(actions)


def test_the_statistic_is_that_of_the_pose_and_the_anchors_seen():
    """G by the plain function of the true pose; B within 6 standard deviations of its mean."""
    env = scalar(MOVABLE)
    law = env.scene.noise
    assert isinstance(law, SquaredRangeNoise)
    tags = np.array(env.scene.tags)
    for result in rollout(env, 3):
        seen, truth = result[0], (result[-1]["rotation"], result[-1]["translation"])
        world = seen["anchors"], tags, *truth, law
        want = statistic.measure_statistic(*world, np.zeros((3, 4)))
        np.testing.assert_allclose(seen["G"], want.G, rtol=1e-9)
        spread = np.sqrt(np.diag(want.G)[:, None] * np.append((tags**2).sum(0), len(tags)))
        assert (np.abs(seen["B"] - want.B) < 6 * spread).all()


@pytest.mark.parametrize("filter", ["kf", "uc-kf"])
def test_errors_of_a_filter_are_those_of_raw_ranges(filter):
    """Root mean square tag errors of either mode within 4 standard deviations of each other."""
    worlds = 1500
    figures = []
    for observation in ("ranges", "statistic"):
        envs = gym.make_vec(ID, num_envs=worlds, scene=FIXED, observation=observation)
        wrapped = VectorEstimatePose(envs, filter)
        wrapped.reset(seed=0 if observation == "ranges" else 10**6)
        errors = []
        for _ in range(6):
            info = wrapped.step(np.zeros(worlds, int))[-1]
            errors.append(info["tag_error_m"] ** 2)
        mean, deviation = np.mean(errors, axis=1), np.std(errors, axis=1) / worlds**0.5
        figures.append((np.sqrt(mean), deviation / (2 * np.sqrt(mean))))
    (a, da), (b, db) = figures
    assert (np.abs(a - b) < 4 * np.hypot(da, db)).all()
    assert (np.hypot(da, db) < 0.05 * a).all()  # or the test would say nothing


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("filter", "arguments"),
    [("kf", {}), ("uc-kf", {"reward": "error"}), ("et-kf", {"observation": "flat"})],
)
def test_vector_wrapper_equals_scalar_wrapped_environments(mode, filter, arguments):
    options = {"observation": "statistic", "autoreset_mode": mode}
    native = VectorEstimatePose(TrackingVectorEnv(3, MOVABLE, **options), filter, **arguments)
    peer = SyncVectorEnv(
        [lambda: EstimatePose(scalar(MOVABLE), filter, **arguments)] * 3, autoreset_mode=mode
    )
    rng = np.random.default_rng(1)
    got, want = native.reset(seed=3), peer.reset(seed=3)
    for _ in range(10):
        for a, b in zip(got, want, strict=True):
            assert_same(a, b, rtol=2e-5, atol=2e-6)
        assert native.observation_space.contains(got[0])
        actions = actions_of(native, rng)
        got, want = native.step(actions), peer.step(actions)


def test_wrapped_rollout_equals_driving_the_filter_by_hand():
    env = scalar(FIXED, "none")
    scene = env.scene
    hand = estimators.make(
        "kf", tags=np.array(scene.tags), noise=scene.noise, process=scene.process
    )
    state = None
    for raw, got in zip(
        rollout(env, 1), rollout(EstimatePose(scalar(FIXED), "kf"), 1), strict=True
    ):
        seen, info = raw[0], raw[-1]
        if state is None:
            prior = [info[f"prior_{key}"] for key in ("rotation", "translation", "covariance")]
            state = hand.initial(*prior)
        else:
            state = hand.predict(state, seen["twist"], scene.dt)
        state = hand.update_statistic(state, seen["G"], seen["B"])  # pyright: ignore[reportAttributeAccessIssue]
        np.testing.assert_array_equal(got[0]["belief_rotation"], hand.belief(state).rotation)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ("uwb_room", "scene must have a SquaredRangeNoise for its statistic, got RangeNoise"),
        (short("camsap2013", links={"drop_probability": 0.1}), "links that never fail"),
        (short("camsap2013", links={"nlos_probability": 0.1}), "links that never fail"),
        (short("camsap2013", links={"reach_m": 5e3}), "no reach_m"),
        (short("camsap2013", obstacles=[[0, 0, 0, 5, 5, 5]]), "no obstacles"),
    ],
    ids=str,
)
@pytest.mark.parametrize("make", [TrackingEnv, TrackingVectorEnv])
def test_scenes_without_a_statistic_are_named(make, scene, message):
    with pytest.raises(ValueError, match=message):
        make(scene=scene, observation="statistic")


@pytest.mark.parametrize("make", [TrackingEnv, TrackingVectorEnv])
def test_bad_observation_is_named(make):
    message = "observation must be one of 'ranges', 'statistic', got 'ether'"
    with pytest.raises(ValueError, match=message):
        make(scene="camsap2013", observation="ether")


def test_filters_that_need_ranges_are_refused():
    with pytest.raises(ValueError, match=r"filter must have update_statistic.*got IteratedEkf"):
        EstimatePose(scalar(FIXED), "iekf")
    envs = TrackingVectorEnv(2, FIXED, observation="statistic")
    with pytest.raises(ValueError, match=r"filter must have update_statistic.*got IteratedEkf"):
        VectorEstimatePose(envs, "iekf")
