"""RBL/BaseStation-v0: Gymnasium's contract, angles and score by hand, scalar against vector."""

from __future__ import annotations

import json
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import seeding

from rbl_gym import bounds
from rbl_gym.bounds import doa
from rbl_gym.envs.base_station import BaseStationEnv, BaseStationVectorEnv
from rbl_gym.measurements import bearing
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from tests.helpers import assert_same

ID = "rbl_gym:RBL/BaseStation-v0"
WORLDS: dict[str, dict[str, Any]] = {
    "default": {"scene": {"steps": 5}},
    "fixed station": {"scene": {"steps": 5, "anchor_speed_m_s": 0}},
    "coarse": {"scene": {"steps": 5}, "angle_std_rad": 0.05, "reward": "none"},
}
DRAWN: list[Any] = [
    {"speed_m_s": {"uniform": [1.0, 4.0]}, "steps": {"integers": [3, 5]}},
    {"tags": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]], "dt": 0.2, "steps": 4},
    {"anchor_speed_m_s": 0.0, "steps": 3},
]
WORLDS["drawn"] = {"scenes": DRAWN}
WORLDS["drawn, coarse"] = {"scenes": DRAWN, "angle_std_rad": 0.05, "reward": "none"}


def test_angles_and_score_by_hand():
    env = BaseStationEnv(scene={"steps": 8})
    scene, noise = env._batch.scene, env._batch.noise
    tags = np.array(scene.tags)
    env.action_space.seed(0)
    observation, info = env.reset(seed=2)
    J = np.linalg.inv(info["prior_covariance"])
    residuals = []
    for epoch in range(9):
        if epoch:
            before = observation["station"]
            observation, reward, _, truncated, info = env.step(env.action_space.sample())
            assert np.linalg.norm(observation["station"] - before) <= 3.0 * scene.dt + 1e-9
            assert truncated == (epoch == 8)
            J = bounds.predict_information(J, observation["twist"], scene.dt, scene.process)
            assert reward == pytest.approx(-math.log(info["score_m"]))
        assert info["epoch"] == epoch
        pose, station = (info["rotation"], info["translation"]), observation["station"]
        J = J + doa.doa_information(tags, *pose, noise, station)
        score = bounds.score(np.linalg.inv(J), info["rotation"], tags)
        assert info["score_m"] == pytest.approx(float(score), rel=1e-9)
        true = bearing.angles(tags @ pose[0].T + pose[1], station)
        residuals.append((observation["angles"] - true) / noise.std_rad)
    assert 0.7 < np.std(residuals) < 1.3
    assert observation["station"][1] < info["translation"][1]


def test_a_nearer_station_sees_better():
    """Toward the body against away from it, the same episodes."""
    scores = {}
    for direction in (1.0, -1.0):
        env = BaseStationVectorEnv(20, scene={"steps": 40})
        env.reset(seed=5)
        for _ in range(40):
            info = env.step(np.tile([0.0, direction, 0.0], (20, 1)))[-1]
        scores[direction] = np.log(info["score_m"]).mean()
    assert scores[1.0] < scores[-1.0] - 0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene": "uwb_room"}, "scene must be a dict"),
        ({"scene": {"n_anchors": 2, "anchors": None}}, "n_anchors = 1"),
        ({"scene": {"links": {"drop_probability": 0.1}}}, "no failing links"),
        ({"scene": {"walls": 2}}, "no field 'walls'"),
        ({"angle_std_rad": 0.0}, "angle_std_rad must be"),
        ({"reward": "belief"}, "reward must be one of"),
        ({"render_mode": "human"}, "render_mode must be None"),
    ],
)
def test_bad_arguments_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        BaseStationEnv(**changes)


# --- filters ----------------------------------------------------------------------------------


def test_the_belief_is_honest_and_the_bound_is_reached():
    envs = BaseStationVectorEnv(100, scene={"steps": 40})
    action, bound, errors, nees = np.zeros((100, 3)), [], [], []
    envs.reset(seed=1)
    for _ in range(40):
        bound.append(envs.step(action)[-1]["score_m"])
    wrapped = VectorEstimatePose(BaseStationVectorEnv(100, scene={"steps": 40}))
    wrapped.reset(seed=1)
    for _ in range(40):
        _, reward, _, _, info = wrapped.step(action)
        np.testing.assert_allclose(reward, -np.log(info["score_m"]))
        errors.append(info["tag_error_m"])
        nees.append(info["nees"])
    # Errors of 100 tracks, correlated over their 40 steps: some 5 % either way.
    assert np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(bound))) == pytest.approx(
        1, abs=0.15
    )
    assert np.mean(nees) == pytest.approx(6, rel=0.15)


def test_filters_of_ranges_are_refused():
    with pytest.raises(ValueError, match="filter 'kf' has no option 'measurement'"):
        EstimatePose(gym.make(ID), "kf")


# --- worlds drawn anew ------------------------------------------------------------------------


def test_a_drawn_episode_equals_that_of_its_scene_alone():
    seen = set()
    for seed in range(8, 28):
        env = BaseStationEnv(scenes=DRAWN)
        observation, info = env.reset(seed=seed)
        told = json.loads(info["scene"])
        seen.add((told.get("dt", 0.1), told["steps"]))
        alone = BaseStationEnv(scene=told)
        generator, _ = seeding.np_random(seed)
        assert env.family is not None
        env.family.draw(generator)
        alone.np_random = generator
        want, _ = alone.reset()
        for step in range(told["steps"]):
            np.testing.assert_array_equal(observation.pop("tags"), alone.scene.body)
            assert_same(observation, want, rtol=1e-12)
            action = np.full(3, 0.5) if env.scene.anchor_speed_m_s > 0 else 0
            observation, reward, _, over, _ = env.step(np.full(3, 0.5))
            want, expected, _, ended, _ = alone.step(action)
            assert reward == pytest.approx(expected, rel=1e-12)
            assert over == ended == (step == told["steps"] - 1)
    assert len(seen) >= 3


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"scenes": DRAWN, "scene": {"steps": 3}}, "scene must be left out if scenes is given"),
        ({"scene": {"n_anchors": 4}}, "scene must have n_anchors = 1, the base station, got 4"),
        (
            {"scenes": ["hall"]},
            r"scenes\[0\] must be a dict with changes of the default world, got 'hall'",
        ),
        ({"scenes": []}, "scenes must hold at least one scene"),
        (
            {"scenes": [{}, {"tags": [[0, 0, 0]]}]},
            r"the same number of tags, .*; got \[1, 4\] tags",
        ),
        (
            {"scenes": {"n_anchors": 2, "anchors": None}},
            "scene must have n_anchors = 1, the base station, got 2",
        ),
    ],
)
def test_wrong_families_are_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        BaseStationEnv(**arguments)
