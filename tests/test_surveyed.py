"""Anchors off by their survey: scenes of them, and the filter whose states their places are."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.optimize import least_squares

from rbl_gym import bounds, estimators, motion
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.bench import worlds as bench_worlds
from rbl_gym.worlds import scenes, simulation
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from tests.helpers import random_world
from tests.side_by_side import assert_steps_alike

NOISE, PROCESS = ranging.RangeNoise(0.05), motion.ProcessNoise(0.1, 0.2)
SCENE = scenes.get({"name": "uwb_room", "steps": 12, "survey_std_m": 0.1})


def test_an_update_is_the_maximum_a_posteriori_of_pose_and_places():
    rng = np.random.default_rng(1)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    std = np.array([[0.05, 0.1, 0.2]] * 5)
    told = anchors + std * rng.standard_normal((5, 3))
    prior = np.diag([0.02] * 3 + [0.1] * 3)
    start = rotations.exp([0.1, -0.05, 0.1]) @ rotation, translation + [0.2, -0.3, 0.1]
    ranges = ranging.simulate(anchors, tags, rotation, translation, NOISE, rng).ranges

    def residuals(x):
        Q, t = rotations.exp(x[:3]) @ start[0], start[1] + x[3:6]
        places = told + x[6:].reshape(5, 3)
        d = np.linalg.norm((tags @ Q.T + t)[None] - places[:, None], axis=-1)
        own = x[:6] / np.sqrt(np.diag(prior)), x[6:] / std.ravel()
        return np.concatenate([((d - ranges) / 0.05).ravel(), *own])

    want = least_squares(residuals, np.zeros(21), xtol=1e-12, ftol=1e-12).x
    filter = estimators.make(
        "iekf", tags=tags, noise=NOISE, process=PROCESS, iterations=20, anchor_std_m=std
    )
    state = filter.update(filter.initial(*start, prior), ranges, told)
    found = np.concatenate(
        [rotations.error(state.rotation, start[0]), state.translation - start[1], state.extra]
    )
    # The derivative by the places is taken twice; what is left is of third order.
    np.testing.assert_allclose(found, want, atol=1e-3)
    # Its covariance is the inverse of prior and ranges together, all 21 states.
    epoch = bounds.RangeEpoch(told + state.extra.reshape(5, 3), tags, state[0], state[1], NOISE)
    J = bounds.with_nuisances(np.linalg.inv(prior), 15)
    J = bounds.posterior_step(J, epoch, None, bounds.Nuisances(anchor_std_m=std))
    scale = np.r_[np.ones(6), std.ravel()]
    want = np.linalg.inv(J) * scale * scale[:, None]
    np.testing.assert_allclose(state.covariance, want, atol=0.05 * std.max() ** 2)


@pytest.mark.parametrize("offset", [pytest.param(None, marks=pytest.mark.long), "tag"])
def test_the_filter_that_knows_the_survey_is_at_its_bound(offset):
    """200 trials of 13 epochs: the ratio within 5 %, NEES/6 within 0.1 (2 and 3 deviations)."""
    changes = {"links": {"offset": offset}, "steps": 12, "survey_std_m": 0.1}
    scene = scenes.get({"name": "uwb_room", **changes})
    trials = monte_carlo.simulate_trials(scene, 200, np.random.default_rng(2))
    bound = np.trace(trials.bound[..., 3:, 3:], axis1=-2, axis2=-1).mean()
    told = {}
    for name, options in (("plain", {}), ("knows", {"anchor_std_m": 0.1})):
        trace = monte_carlo.track_trials(trials, "iekf", options)
        square = (trace.error[..., 3:] ** 2).sum(axis=-1).mean()
        told[name] = np.sqrt(square / bound), trace.nees.mean() / 6
    assert told["knows"][0] == pytest.approx(1, abs=0.05)
    assert told["knows"][1] == pytest.approx(1, abs=0.1)
    assert told["plain"][0] > told["knows"][0] + 0.05
    assert told["plain"][1] > 2


def test_environments_tell_surveyed_places_that_stay_off():
    env: Any = gym.make("rbl_gym:RBL/Tracking-v0", scene={"name": "auv_buoys", "survey_std_m": 2.0})
    seen, info = env.reset(seed=3)
    assert env.observation_space.contains(seen)
    off = seen["anchors"] - info["anchors"]
    assert 0.5 < np.sqrt((off**2).mean()) < 4
    for _ in range(3):
        seen, *_, info = env.step(np.ones(12, dtype=np.float32))
        np.testing.assert_allclose(seen["anchors"] - info["anchors"], off, atol=1e-9)
    # The ranges are those of the true places.
    tags = ranging.tag_positions(info["rotation"], info["translation"], env.unwrapped.scene.tags)
    far = ranging.distances(info["anchors"], tags)
    assert np.abs(seen["ranges"] - far).max() < 6 * 0.3
    vector = gym.make_vec(
        "rbl_gym:RBL/Tracking-v0", num_envs=2, scene={"name": "auv_buoys", "survey_std_m": 2.0}
    )
    many, infos = vector.reset(seed=3)
    np.testing.assert_allclose(many["anchors"][0] - infos["anchors"][0], off, atol=1e-9)


def test_the_bound_of_an_episode_is_the_recursion_with_nuisances():
    trials = monte_carlo.simulate_trials(SCENE, 3, np.random.default_rng(5))
    nuisances = bounds.Nuisances(anchor_std_m=0.1)
    J = bounds.with_nuisances(np.linalg.inv(SCENE.prior_covariance), nuisances.count(6, 6))
    for k, measured in enumerate(trials.measurements):
        at = simulation.epoch_of(trials.episode, k)
        epoch = bounds.RangeEpoch(
            trials.episode.anchors, SCENE.tags, at.rotation, at.translation, NOISE, measured.links
        )
        epoch = epoch._replace(noise=SCENE.noise)
        moved = bounds.KnownTwist(at.twist, SCENE.dt, SCENE.process) if k else None
        J = bounds.posterior_step(J, epoch, moved, nuisances)
    found = np.linalg.inv(bounds.marginal_information(J))
    np.testing.assert_allclose(trials.bound[-1], found, rtol=1e-8, atol=1e-12)


def test_hashes_of_scenes_without_a_survey_are_as_they_were():
    facts = bench_worlds.scene_facts(scenes.get("uwb_room"))
    assert not {"survey_std_m", "prisms", "gain", "fixed"} & set(facts)
    assert bench_worlds.scene_facts(SCENE)["survey_std_m"] == 0.1


def test_what_cannot_be_is_refused():
    make = {"tags": np.eye(3), "noise": NOISE, "process": PROCESS}
    with pytest.raises(ValueError, match="anchor_std_m must not be negative"):
        estimators.make("iekf", **make, anchor_std_m=-0.1)
    filter = estimators.make("iekf", **make, anchor_std_m=0.1)
    state = filter.initial(np.eye(3), np.zeros(3), np.eye(6))
    state = filter.update(state, np.full((4, 3), 5.0), 5 * np.eye(4)[:, :3] + 1)
    with pytest.raises(ValueError, match="the number of anchors must stay 4"):
        filter.update(state, np.full((5, 3), 5.0), 5 * np.eye(5)[:, :3] + 1)
    with pytest.raises(ValueError, match="survey_std_m must be"):
        scenes.get({"name": "uwb_room", "survey_std_m": -1.0})


FAMILY: list[Any] = [
    {"name": "auv_buoys", "survey_std_m": {"uniform": [1.0, 3.0]}, "steps": 4},
    {"name": "uwb_room", "steps": 3},
]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_families_have_surveys_too(mode):
    worlds: dict[str, Any] = {"scenes": FAMILY, "reward": "none"}
    native: Any = VectorEstimatePose(TrackingVectorEnv(4, autoreset_mode=mode, **worlds))
    peer = SyncVectorEnv([lambda: EstimatePose(TrackingEnv(**worlds))] * 4, autoreset_mode=mode)
    results = assert_steps_alike(native, peer, 8, 3, {"rtol": 2e-5, "atol": 2e-5})
    told, *_, info = results[0]
    off = np.abs(told["anchors"] - info["anchors"])
    surveyed = told["anchor_mask"].sum(axis=-1) == 4
    assert 0 < surveyed.sum() < 4
    assert (off[surveyed][:, :4] > 0).all()
    assert not off[~surveyed].any()


def test_families_with_a_survey_have_no_bound():
    for env in (TrackingEnv, TrackingVectorEnv):
        with pytest.raises(ValueError, match="reward must be 'none' if scenes have survey"):
            env(scenes=FAMILY)
    with pytest.raises(ValueError, match=r"bodies\[0\] must have survey_std_m = 0"):
        gym.make("rbl_gym:RBL/SharedAnchors-v0", scene={"name": "hall", "survey_std_m": 0.1})
