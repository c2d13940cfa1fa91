"""RBL/Tracking-v0: Gymnasium's contract, the score by hand, and errors."""

from __future__ import annotations

import copy
import multiprocessing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import registry
from gymnasium.error import ResetNeeded

import rbl_gym
from rbl_gym import bounds
from rbl_gym.envs.tracking import TrackingEnv, observation_space
from rbl_gym.worlds.scenes import SCENES
from tests.helpers import assert_same, law_by_hand, score_by_hand, share_by_hand
from tests.side_by_side import episode

ID = "rbl_gym:RBL/Tracking-v0"
NAMES = list(SCENES)
MOVABLE = [name for name, scene in SCENES.items() if scene.anchor_speed_m_s > 0]
FIXED = [name for name in NAMES if name not in MOVABLE]
LOSSY = {"drop_probability": 0.3, "nlos_probability": 0.2}
OVERRIDDEN = {
    "name": "satellite",
    "steps": 6,
    "links": LOSSY,
    "noise": {"kind": "range", "floor_m": 0.2, "reference_tag": 0},
    "anchors": [[100.0, 0, 0], [0, 100, 0], [0, 0, 100], [-60, -60, -60]],
}


def short(name: str, steps: int = 12, **fields: Any) -> dict[str, Any]:
    return {"name": name, "steps": steps, **fields}


# --- Gymnasium --------------------------------------------------------------------------------


def test_make_alone_finds_the_environment_in_a_spawned_worker():
    worker = multiprocessing.get_context("spawn").Process(target=gym.make, args=(ID,))
    worker.start()
    worker.join(60)
    assert worker.exitcode == 0


def test_registration_is_idempotent():
    before = registry["RBL/Tracking-v0"]
    rbl_gym._register_environments()
    assert registry["RBL/Tracking-v0"] is before


def test_environment_leaves_the_scene_dict_alone():
    scene = copy.deepcopy(OVERRIDDEN)
    env = TrackingEnv(scene)
    episode(env)
    assert scene == OVERRIDDEN


def test_max_episode_steps_of_make_truncates():
    env = gym.make(ID, scene="drone_yard", max_episode_steps=7)
    assert [step[3] for step in episode(env)] == [False] * 7 + [True]


# --- spaces, memory, types, the end -----------------------------------------------------------


@pytest.mark.parametrize("trajectory", [None, "random-twist"])
@pytest.mark.parametrize("name", NAMES)
def test_every_observation_is_in_the_space(name, trajectory):
    fields = {} if trajectory is None else {"trajectory": trajectory}
    env = TrackingEnv(short(name, SCENES[name].steps, links=LOSSY, **fields))
    for observation, *_ in episode(env, 8):
        for key, space in observation_space(env.scene).items():
            assert space.contains(observation[key]), key
        assert env.observation_space.contains(observation)


@pytest.mark.parametrize("name", NAMES)
def test_observation_space_is_finite_and_its_numbers_are_float64(name):
    for key, space in observation_space(SCENES[name]).items():
        if isinstance(space, spaces.Box):
            assert space.dtype == np.float64
            assert np.isfinite(space.low).all(), key
            assert np.isfinite(space.high).all(), key


@pytest.mark.parametrize("name", MOVABLE)
def test_anchors_driven_to_the_edge_of_their_region_stay_in_the_space(name):
    env = TrackingEnv({"name": name, "anchor_speed_m_s": 1000.0})
    rng = np.random.default_rng(9)
    env.reset(seed=9)
    for _ in range(env.scene.steps):
        action = rng.choice([-1.0, 0.0, 1.0], 3 * env.scene.n_anchors)
        assert env.observation_space.contains(env.step(action)[0])


def test_fast_spin_stays_in_the_space():
    env = TrackingEnv({"name": "auv_buoys", "spin_rad_s": 3.0})
    for seed in range(20):
        env.reset(seed=seed)
        assert env.observation_space.contains(env.step(np.zeros(12))[0])


@pytest.mark.parametrize("name", NAMES)
def test_episode_truncates_after_the_scenes_steps_and_then_needs_a_reset(name):
    env = TrackingEnv(name)
    truncated = [step[3] for step in episode(env)]
    assert truncated == [False] * SCENES[name].steps + [True]
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(env.action_space.sample())
    env.reset()
    env.step(env.action_space.sample())


def test_info_tells_the_truth_the_epoch_and_at_reset_the_prior():
    steps = episode(TrackingEnv(short("uwb_room", 3)))
    assert [info["epoch"] for *_, info in steps] == [0, 1, 2, 3]
    common = {"rotation", "translation", "nlos", "epoch", "score_m"}
    prior = {"prior_rotation", "prior_translation", "prior_covariance"}
    assert steps[0][4].keys() == common | prior
    assert all(info.keys() == common for *_, info in steps[1:])
    for *_, info in steps:
        np.testing.assert_allclose(info["rotation"] @ info["rotation"].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_ranges_are_those_of_the_true_pose_to_the_anchors_seen(name):
    """Within 6 standard deviations of the distance, the anchors being where they are now."""
    env = TrackingEnv(short(name))
    tags = np.array(env.scene.tags)
    for observation, *_, info in episode(env, 11):
        for m, n in np.ndindex(observation["ranges"].shape):
            tag = info["rotation"] @ tags[n] + info["translation"]
            distances = np.linalg.norm(
                tags @ info["rotation"].T + info["translation"] - observation["anchors"][m], axis=1
            )
            variance = np.broadcast_to(env.scene.noise.variance(distances[None]), (1, len(tags)))
            error = observation["ranges"][m, n] - np.linalg.norm(tag - observation["anchors"][m])
            share = share_by_hand(env.scene, observation["anchors"][m], info["translation"])
            assert abs(error) < 6 * (variance[0, n] / share) ** 0.5


@pytest.mark.parametrize("speed", [0.0, 3.0])
def test_quality_is_that_of_the_sight_from_each_anchor(speed):
    scene = short("hall", 8, anchor_speed_m_s=speed)
    told = []
    for result in episode(gym.make(ID, scene=scene), 4):
        seen, place = result[0], result[-1]["translation"]
        want = [share_by_hand(SCENES["hall"], anchor, place) for anchor in seen["anchors"]]
        np.testing.assert_array_equal(seen["quality"], want)
        told += want
    assert set(told) == {1.0, SCENES["hall"].blocked_information}


@pytest.mark.parametrize("name", NAMES)
def test_quality_is_observed_only_among_obstacles(name):
    env = gym.make(ID, scene=name)
    assert ("quality" in env.reset(seed=0)[0]) == bool(SCENES[name].obstacles)


# --- reward -----------------------------------------------------------------------------------


@pytest.mark.parametrize("links", [{}, LOSSY], ids=["all links", "lost links"])
@pytest.mark.parametrize("name", NAMES)
def test_reward_is_minus_log_of_the_posterior_bound_along_the_truth(name, links):
    env = TrackingEnv(short(name, links=links))
    scene, tags = env.scene, np.array(env.scene.tags)
    J = None
    for k, (seen, reward, *_, info) in enumerate(episode(env, 12)):
        pose = info["rotation"], info["translation"]
        law = law_by_hand(scene, seen["anchors"], *pose)
        if J is None:
            J = np.linalg.inv(info["prior_covariance"]) + bounds.range_information(
                seen["anchors"], tags, *pose, law, seen["links"]
            )
        else:
            J = bounds.posterior_crb_step(
                J, seen["anchors"], tags, *pose, law,
                seen["twist"], scene.dt, scene.process, seen["links"],
            )  # fmt: skip
        b = score_by_hand(np.linalg.inv(J), info["rotation"], tags)
        assert info["score_m"] == pytest.approx(b, rel=1e-9)
        if k > 0:
            assert reward == pytest.approx(-np.log(b), abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_reward_none_is_zero_and_computes_no_score(name):
    steps = episode(TrackingEnv(short(name), reward="none"), 13)
    assert [reward for _, reward, *_ in steps] == [0.0] * 13
    assert not any("score_m" in info for *_, info in steps)


def test_reward_has_no_influence_on_the_world():
    both = [episode(TrackingEnv(short("satellite"), reward=r), 14) for r in ("bound", "none")]
    for a, b in zip(*both, strict=True):
        assert_same(a[0], b[0])


# --- actions ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FIXED)
def test_fixed_anchors_have_one_action_and_stay(name):
    env = TrackingEnv(short(name))
    assert env.action_space == spaces.Discrete(1)
    first, *rest = (observation["anchors"] for observation, *_ in episode(env, 15))
    for anchors in rest:
        np.testing.assert_array_equal(anchors, first)


@pytest.mark.parametrize("name", MOVABLE)
def test_movable_anchors_take_velocities(name):
    env = TrackingEnv(name)
    size = 3 * env.scene.n_anchors
    assert env.action_space == spaces.Box(-1.0, 1.0, (size,), np.float32)


@pytest.mark.parametrize("name", MOVABLE)
def test_a_full_action_moves_an_anchor_by_the_speed_limit_before_the_ranges_are_taken(name):
    env = TrackingEnv(short(name))
    first = env.reset(seed=17)[0]["anchors"]
    action = np.zeros((env.scene.n_anchors, 3), np.float32)
    action[0, 1] = action[1, 0] = 1.0
    seen = env.step(action.ravel())[0]["anchors"]
    step = env.scene.anchor_speed_m_s * env.scene.dt
    np.testing.assert_allclose(seen - first, step * action, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "action",
    [
        np.zeros(11),
        np.zeros((4, 3)),
        np.zeros((1, 12)),
        np.zeros((2, 12)),
        0.0,
        [np.nan] * 12,
        [0.0] * 11 + [np.inf],
        None,
        "north",
    ],
    ids=["11", "4x3", "1x12", "2x12", "scalar", "nan", "inf", "None", "str"],
)
@pytest.mark.parametrize("reward", ["bound", "none"])
def test_bad_action_is_named_and_changes_nothing(action, reward):
    env, twin = (TrackingEnv(short("auv_buoys"), reward) for _ in range(2))
    env.reset(seed=18)
    twin.reset(seed=18)
    with pytest.raises(ValueError, match="action"):
        env.step(action)
    assert_same(env.step(np.ones(12)), twin.step(np.ones(12)))


@pytest.mark.parametrize("action", [1, -1, np.zeros(18), None], ids=str)
def test_action_that_fixed_anchors_do_not_have_is_named(action):
    env = TrackingEnv("uwb_room")
    env.reset(seed=19)
    with pytest.raises(ValueError, match="action"):
        env.step(action)


# --- arguments --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "named"),
    [
        ("nowhere", "scene must be one of .*'uwb_room'.*'nowhere'"),
        ({"name": "uwb_room", "stepz": 5}, "stepz.*steps"),
    ],
    ids=str,
)
def test_bad_scene_is_named(scene, named):
    with pytest.raises(ValueError, match=named):
        TrackingEnv(scene)


@pytest.mark.parametrize("reward", ["score", "", None, 1])
def test_bad_reward_is_named(reward):
    with pytest.raises(ValueError, match=f"reward must be one of 'bound', 'none', got {reward!r}"):
        TrackingEnv(reward=reward)


@pytest.mark.parametrize("name", ["Tracking", "BaseStation"])
def test_a_function_as_reward_is_sent_to_the_wrapper(name):
    with pytest.raises(ValueError, match=r"got .*abs.*: EstimatePose\(env, filter, reward=...\)"):
        gym.make(f"rbl_gym:RBL/{name}-v0", reward=abs)


def test_bad_render_mode_is_named():
    with pytest.raises(ValueError, match="render_mode must be None or 'rgb_array', got 'human'"):
        TrackingEnv(render_mode="human")


# --- links ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_lost_links_show_as_range_0_and_as_often_as_said(name):
    env = TrackingEnv({"name": name, "steps": 40, "links": {"drop_probability": 0.25}})
    seen = [observation for observation, *_ in episode(env, 20)]
    ranges = np.stack([observation["ranges"] for observation in seen])
    links = np.stack([observation["links"] for observation in seen])
    np.testing.assert_array_equal(ranges == 0, links == 0)
    assert links.dtype == np.int8
    assert np.mean(links == 0) == pytest.approx(0.25, abs=4 * (0.1875 / links.size) ** 0.5)


def test_info_marks_reflected_paths():
    env = TrackingEnv(short("uwb_room", links={"nlos_probability": 0.3, "nlos_bias_m": 50.0}))
    for observation, *_, info in episode(env, 21):
        np.testing.assert_array_equal(info["nlos"], observation["ranges"] > 40)


def test_no_link_at_all_is_a_world_too():
    env = TrackingEnv(short("auv_buoys", links={"drop_probability": 1.0}))
    scores = [info["score_m"] for *_, info in episode(env, 22)]
    assert (np.diff(scores) > 0).all()
