"""Mobile anchors and anchor selection: Gymnasium's contract, beliefs and observations by hand."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import seeding

from rbl_gym import bounds, estimators, motion
from rbl_gym.measurements.ranging import LinkNoise
from rbl_gym.worlds import scenes, simulation
from rbl_gym.wrappers import controllers
from rbl_gym.wrappers.selection import AnchorSelectionEnv, AnchorSelectionVectorEnv
from rbl_gym.wrappers.tasks import MobileAnchorsEnv, MobileAnchorsVectorEnv
from tests.helpers import assert_same, score_by_hand, share_by_hand
from tests.side_by_side import actions_of, assert_refused

MOBILE, SELECTION = "rbl_gym:RBL/MobileAnchors-v0", "rbl_gym:RBL/AnchorSelection-v0"
LOSSY = {"drop_probability": 0.2}
WORLDS: dict[str, tuple[str, dict[str, Any]]] = {
    "easy": (MOBILE, {}),
    "hard": (MOBILE, {"difficulty": "hard"}),
    "by number": (MOBILE, {"sort_craft": False}),
    "lossy": (MOBILE, {"scene": {"name": "auv_craft", "links": LOSSY, "n_anchors": 4}}),
    "top 3": (SELECTION, {}),
    "top 1": (SELECTION, {"k": 1}),
    "priced": (SELECTION, {"mode": "priced"}),
    "priced, lossy": (SELECTION, {"mode": "priced", "scene": {"name": "hall", "links": LOSSY}}),
}
every_world = pytest.mark.parametrize("kind", WORLDS)
# What a filter leaves of rounding.
TOLERANCE = {"rtol": 2e-5, "atol": 2e-6}
CLASSES: dict[str, tuple[type, type]] = {
    MOBILE: (MobileAnchorsEnv, MobileAnchorsVectorEnv),
    SELECTION: (AnchorSelectionEnv, AnchorSelectionVectorEnv),
}


def short(kind: str, steps: int = 4) -> tuple[type, type, dict[str, Any]]:
    """Scalar class, vector class, and arguments with short episodes."""
    env_id, arguments = WORLDS[kind]
    scene = arguments.get("scene", {"name": "auv_craft" if env_id == MOBILE else "hall"})
    return *CLASSES[env_id], {**arguments, "scene": {**scene, "steps": steps}}


def run(env, n, seed=0):
    """Everything that n steps of a vector environment return."""
    rng = np.random.default_rng(seed)
    return [env.reset(seed=seed), *(env.step(actions_of(env, rng)) for _ in range(n))]


# --- the belief by a separate filter ----------------------------------------------------------


class Replay:
    """One world by the scene's episode, plain distances, and a filter of its own."""

    def __init__(self, scene, seed: int, name: str = "iekf", **options) -> None:
        self.scene, self.tags = scene, np.array(scene.tags)
        self.name, self.options = name, options or {"iterations": 2}
        self.episode = simulation.draw_episode(scene, seeding.np_random(seed)[0])
        self.anchors = np.array(self.episode.anchors)
        self.state: Any = self.filter().initial(
            self.episode.prior_rotation,
            self.episode.prior_translation,
            self.episode.prior_covariance,
        )
        self.shares: list[float] = []

    def filter(self, noise=None) -> Any:
        return estimators.make(
            self.name, tags=self.tags, noise=noise or self.scene.noise,
            process=self.scene.process, **self.options,
        )  # fmt: skip

    def predict(self, k: int) -> None:
        self.state = self.filter().predict(self.state, self.episode.twists[k], self.scene.dt)

    def update(self, k: int, chosen=None, told: bool = True) -> None:
        place = self.episode.translation[k]
        tags = self.tags @ self.episode.rotation[k].T + place
        distance = np.linalg.norm(tags - self.anchors[:, None], axis=-1)
        share = np.array([[share_by_hand(self.scene, a, place)] for a in self.anchors])
        self.shares += list(share[chosen if chosen is not None else slice(None), 0])
        std = np.sqrt(self.scene.noise.variance(distance) / share)
        ranges = distance + std * self.episode.normals[k]
        law = LinkNoise(np.sqrt(self.scene.noise.variance(ranges) / (share if told else 1.0)))
        links = None
        if chosen is not None:
            links = np.zeros(ranges.shape, bool)
            links[chosen] = True
        noise = law if self.scene.obstacles else None
        self.state = self.filter(noise).update(self.state, ranges, self.anchors, links)

    def score(self) -> float:
        return score_by_hand(self.belief.covariance, self.belief.rotation, self.tags)

    @property
    def belief(self):
        return self.filter().belief(self.state)

    def log_std(self):
        prior = [self.scene.initial_rotation_rad] * 3 + [self.scene.initial_translation_m] * 3
        return np.log(np.sqrt(np.diag(self.state.covariance)) / prior) + 1

    def common(self):
        """What both tasks observe: log standard deviations, two columns of the rotation."""
        return [*self.log_std(), *self.state.rotation[:, 0], *self.state.rotation[:, 1]]


@pytest.mark.parametrize("difficulty", ["easy", "hard"])
@pytest.mark.parametrize("seed", [3, 11])
def test_mobile_rewards_and_observations_by_a_separate_filter(difficulty, seed):
    env = MobileAnchorsEnv(difficulty)
    scene = env.scene
    m, speed = (3, 4.0) if difficulty == "easy" else (2, 2.0)
    assert (scene.n_anchors, scene.anchor_speed_m_s, scene.dt, scene.steps) == (m, speed, 2, 100)
    twin, rng = Replay(scene, seed), np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    np.testing.assert_allclose(twin.anchors[:, 2], 0)
    twin.update(0)
    for k in range(1, 31):
        gap = twin.anchors - twin.state.translation
        order = sorted(range(m), key=lambda i: math.atan2(gap[i, 1], gap[i, 0]))
        wanted = [
            twin.state.translation[2] / 50, *twin.episode.twists[k - 1][3:5] / 1.5, *twin.common(),
            *gap[order][:, :2].ravel() / 100, *np.log(np.linalg.norm(gap[order], axis=1) / 100),
        ]  # fmt: skip
        np.testing.assert_allclose(observation, wanted, atol=2e-5)
        np.testing.assert_allclose(info["score_m"], twin.score(), rtol=1e-6)
        action = rng.uniform(-1.5, 1.5, 2 * m)
        for j, i in enumerate(order):
            step = action[2 * j : 2 * j + 2]
            twin.anchors[i, :2] += 2.0 * speed * step / max(1.0, np.linalg.norm(step))
        observation, reward, _, _, info = env.step(action)
        np.testing.assert_allclose(env._last_observation()["anchors"], twin.anchors, atol=1e-9)
        twin.predict(k)
        twin.update(k)
        np.testing.assert_allclose(reward, -math.log(twin.score()), rtol=1e-6)
        error = twin.state.translation - twin.episode.translation[k]
        np.testing.assert_allclose(info["position_error_m"], np.linalg.norm(error), rtol=1e-6)
        assert info["rotation_error_rad"] < 0.6


@pytest.mark.parametrize("mode", ["top-k", "priced"])
@pytest.mark.parametrize("seed", [1, 5])
def test_selection_rewards_and_observations_by_a_separate_filter(mode, seed):
    env = AnchorSelectionEnv(mode, price=0.07)
    scene = env.scene
    assert scene.blocked_information == 0.02
    twin, rng = Replay(scene, seed), np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    assert not info["chosen"].any()
    for k in range(1, 31):
        wanted = [
            *(twin.state.translation - [0, 0, 1.75]) / [17, 8, 1.25],
            *twin.episode.twists[k - 1][3:] / 2,
            *twin.common(),
        ]
        np.testing.assert_allclose(observation, wanted, atol=2e-5)
        if mode == "top-k":
            action = rng.uniform(-1, 1, 12)
            chosen = np.argsort(action)[-3:]
        else:
            action = (rng.random(12) < 0.3).astype(np.int8)
            chosen = np.flatnonzero(action)
        observation, reward, _, _, info = env.step(action)
        np.testing.assert_array_equal(np.flatnonzero(info["chosen"]), np.sort(chosen))
        twin.predict(k)
        if len(chosen):
            twin.update(k, chosen)
        wanted_reward = -math.log(twin.score())
        wanted_reward -= 0.07 * len(chosen) * (mode == "priced")
        np.testing.assert_allclose(reward, wanted_reward, rtol=1e-6)
    assert set(twin.shares) == {0.02, 1.0}


def test_a_blocked_link_carries_two_percent_and_the_filter_is_told():
    env = AnchorSelectionEnv(k=1)
    scene = env.scene
    for seed in range(20):
        probe = Replay(scene, seed)
        shares = [share_by_hand(scene, a, probe.episode.translation[1]) for a in probe.anchors]
        if 0.02 in shares:
            break
    env.reset(seed=seed)
    blocked = shares.index(0.02)
    env.step(np.eye(12)[blocked])
    got = env.belief.covariance
    beliefs = []
    for told in (True, False):
        twin = Replay(scene, seed)
        twin.predict(1)
        twin.update(1, [blocked], told)
        beliefs.append(twin.state.covariance)
    np.testing.assert_allclose(got, beliefs[0], rtol=1e-6, atol=1e-12)
    assert np.trace(beliefs[0]) > 1.05 * np.trace(beliefs[1])
    # In information: the gain of the link is a fiftieth of what it would be in sight.
    before = Replay(scene, seed)
    before.predict(1)
    gain = [np.trace(np.linalg.inv(p) - np.linalg.inv(before.state.covariance)) for p in beliefs]
    assert gain[0] / gain[1] == pytest.approx(0.02, rel=0.1)  # the linearisation points differ


def test_without_anchors_the_belief_is_the_prediction():
    env = AnchorSelectionVectorEnv(4, "priced")
    env.reset(seed=2)
    before = env.belief
    _, reward, _, _, info = env.step(np.zeros((4, 12), np.int8))
    pose = motion.propagate(before.rotation, before.translation, env.twist, 0.2)
    covariance = bounds.predict_covariance(before.covariance, env.twist, 0.2, env.scene.process)
    np.testing.assert_allclose(env.belief.rotation, pose[0], atol=1e-12)
    np.testing.assert_allclose(env.belief.translation, pose[1], atol=1e-12)
    np.testing.assert_allclose(env.belief.covariance, covariance, rtol=1e-9, atol=1e-12)
    score = bounds.score(covariance, pose[0], np.array(env.scene.tags))
    np.testing.assert_allclose(reward, -np.log(score))
    assert not info["chosen"].any()
    # Beside worlds that measure, too.
    mixed = np.zeros((4, 12), np.int8)
    mixed[[1, 3]] = 1
    before = env.belief
    env.step(mixed)
    alone = bounds.predict_covariance(before.covariance, env.twist, 0.2, env.scene.process)
    np.testing.assert_allclose(env.belief.covariance[[0, 2]], alone[[0, 2]], rtol=1e-9, atol=1e-12)
    traces = np.trace(env.belief.covariance - alone, axis1=1, axis2=2)
    assert (traces[[1, 3]] < 0).all()


@pytest.mark.parametrize(
    ("env_id", "filter", "options"),
    [
        (MOBILE, "iekf-bank", {"robust": False}),
        (MOBILE, "iekf", {"robust": True}),
        (SELECTION, "uc-kf", {"sigma_q_scale": 0.8}),
        (SELECTION, "iekf-cv", {"iterations": 3}),
    ],
)
def test_any_filter_by_a_plain_loop(env_id, filter, options):
    scene = {"name": "auv_craft" if env_id == MOBILE else "hall", "steps": 8}
    env: Any = gym.make(env_id, filter=filter, options=options, scene=scene).unwrapped
    extra = {"iterations": 2} if filter == "iekf" else {}
    twin, rng = Replay(env.scene, 4, filter, **extra, **options), np.random.default_rng(4)
    env.reset(seed=4)
    if env_id == MOBILE:
        twin.update(0)
    for k in range(1, 9):
        action = rng.uniform(-1, 1, env.action_space.shape)
        _, reward, _, _, info = env.step(action)
        twin.anchors = env._last_observation()["anchors"].copy()
        twin.predict(k)
        twin.update(k, np.argsort(action)[-3:] if env_id == SELECTION else None)
        np.testing.assert_allclose(reward, -math.log(twin.score()), rtol=1e-6)
        error = twin.belief.translation - twin.episode.translation[k]
        np.testing.assert_allclose(info["position_error_m"], np.linalg.norm(error), rtol=1e-5)


# --- actions ----------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 3, 12])
def test_top_k_takes_the_highest_and_on_ties_the_lower_numbers(k):
    env = AnchorSelectionVectorEnv(3, k=k)
    env.reset(seed=1)
    scores = np.random.default_rng(1).uniform(-1, 1, (3, 12))
    scores[1] = 0.5
    scores[2] *= 100
    chosen = env.step(scores)[4]["chosen"]
    assert (chosen.sum(axis=1) == k).all()
    np.testing.assert_array_equal(chosen[1], np.arange(12) < k)
    for world in (0, 2):
        if k < 12:
            assert scores[world][chosen[world] == 1].min() > scores[world][chosen[world] == 0].max()


def test_binary_choices_may_come_as_floats():
    """As stable-baselines3 hands them on."""
    results = []
    for dtype in (np.int8, np.float32, np.bool_):
        env = AnchorSelectionVectorEnv(2, "priced")
        env.reset(seed=1)
        results.append(env.step((np.arange(24).reshape(2, 12) % 3 == 0).astype(dtype)))
    assert_same(results[1], results[0])
    assert_same(results[2], results[0])


def test_each_anchor_costs_its_price():
    rewards = {}
    for price in (0.0, 0.05, 0.3):
        env = AnchorSelectionVectorEnv(3, "priced", price=price)
        env.reset(seed=1)
        actions = np.zeros((3, 12), np.int8)
        actions[1, :4], actions[2] = 1, 1
        rewards[price] = env.step(actions)[1]
    for price in (0.05, 0.3):
        lost = price * np.array([0, 4, 12])
        np.testing.assert_allclose(rewards[0.0] - rewards[price], lost, atol=1e-12)


@pytest.mark.parametrize("sort", [True, False])
def test_craft_numbers_change_nothing_when_sorted(sort):
    turn = np.array([2, 0, 3, 1])
    env = MobileAnchorsVectorEnv(8, scene={"name": "auv_craft", "n_anchors": 4}, sort_craft=sort)
    env.reset(seed=3)
    seen = env.inner_observation
    assert seen is not None
    other = {**seen, "anchors": seen["anchors"][:, turn]}
    assert np.array_equal(env._task_view(seen, env.scene), env._task_view(other, env.scene)) is sort
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 8))
    env.step(actions)
    moved = env._last_observation()["anchors"]
    env.reset(seed=3)
    env.inner_observation = other
    env._task_view(other, env.scene)
    renumbered = env._command(actions).reshape(8, 4, 3)
    env.inner_observation = seen
    # The same craft get the same commands, whatever their numbers.
    back = np.argsort(turn)
    env.inner.step(renumbered[:, back].reshape(8, 12))
    got = env.inner.unwrapped._anchors
    assert np.allclose(got, moved, atol=1e-9) is sort


def test_craft_move_at_their_limit_at_most_and_stay_on_the_water():
    env = MobileAnchorsVectorEnv(16, "hard")
    env.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(20):
        before = env._last_observation()["anchors"].copy()
        actions = rng.uniform(-2, 2, (16, 4))
        wanted = np.linalg.norm(actions.reshape(16, 2, 2), axis=-1).clip(max=1)
        order = env.order.copy()
        env.step(actions)
        moved = np.linalg.norm(env._last_observation()["anchors"] - before, axis=-1)
        np.testing.assert_allclose(
            np.take_along_axis(moved, order, axis=1), 2.0 * 2.0 * wanted, rtol=1e-9
        )
        assert not env._last_observation()["anchors"][..., 2].any()


# --- consistency ------------------------------------------------------------------------------


def test_a_belief_that_was_handed_out_outlives_its_episode():
    envs = MobileAnchorsVectorEnv(num_envs=3, autoreset_mode="Disabled")
    envs.reset(seed=1)
    held = envs.belief
    before = [field.copy() for field in held]
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    for field, old in zip(held, before, strict=True):
        np.testing.assert_array_equal(field, old)
    assert not np.array_equal(envs.belief.translation[0], before[1][0])
    np.testing.assert_array_equal(envs.belief.translation[1], before[1][1])


@pytest.mark.parametrize("kind", ["easy", "hard", "selection"])
@pytest.mark.parametrize("worlds", [256, pytest.param(1024, marks=pytest.mark.long)])
def test_nees_is_six(kind, worlds):
    """Means over worlds of a chi-square of 6 degrees; at epochs far apart about independent."""
    if kind == "selection":
        env: Any = AnchorSelectionVectorEnv(worlds, autoreset_mode="Disabled")
        policy: Any = controllers.greedy_blind
    else:
        env = MobileAnchorsVectorEnv(worlds, kind, autoreset_mode="Disabled")
        policy = controllers.orbit
    rng = np.random.default_rng(1)
    env.reset(seed=1)
    values = np.array([env.step(policy(env, rng))[4]["nees"] for _ in range(25)])
    if kind == "hard":
        # Two craft leave a direction so weak that the belief is curved there: the tail is long,
        # with ever so many iterations. What is typical is still near a chi-square's 5.35.
        assert 5.0 < np.median(values[5:]) < 6.2
        return
    means = values.mean(axis=1)
    one = math.sqrt(12 / worlds)
    # Mean over epochs: of the errors' memory, a fifth of the epochs count as independent.
    assert abs(np.mean(means[5:]) - 6) < 4 * one / math.sqrt(4), means
    assert np.abs(means[5:] - 6).max() < 5 * one, means


# --- scenes of one's own, bad arguments -------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "scene"),
    [
        (MobileAnchorsVectorEnv, {"name": "auv_craft", "speed_m_s": 0.0}),
        (MobileAnchorsVectorEnv, {"name": "auv_craft", "n_anchors": 1}),
        (MobileAnchorsVectorEnv, "satellite"),
        (AnchorSelectionVectorEnv, "camsap2013"),
        (AnchorSelectionVectorEnv, "auv_buoys"),
        (
            AnchorSelectionVectorEnv,
            {"name": "hall", "volume": {"low": [-17, -8, 1], "high": [17, 8, 1]}},
        ),
        (AnchorSelectionVectorEnv, scenes.get("uwb_room")),
    ],
)
def test_other_scenes_give_finite_observations(kind, scene):
    env = kind(4, scene=scene, max_episode_steps=4)
    for step in run(env, 9):
        assert np.isfinite(step[0]).all()
        assert env.observation_space.contains(step[0])


@pytest.mark.parametrize(
    ("scene", "level", "n_anchors", "speed"),
    [
        ("auv_craft", "easy", 3, 4.0),
        ("auv_craft", "hard", 2, 2.0),
        ({"name": "auv_craft", "anchor_speed_m_s": 3.0}, "hard", 2, 3.0),
        ({"name": "auv_craft", "anchors": [[9.0 * i, 0, 0] for i in range(5)]}, "hard", 5, 2.0),
        ("auv_buoys", "easy", 4, 4.0),
        ("satellite", "easy", 5, 1.0),
        ({"name": "uwb_room", "anchor_speed_m_s": 0.5}, "easy", 6, 0.5),
    ],
)
def test_the_difficulty_leaves_what_a_scene_says(scene, level, n_anchors, speed):
    arguments: list[dict[str, Any]] = [{"scene": scene}]
    if isinstance(scene, dict):
        arguments.append({"scenes": [scene]})
    for given in arguments:
        env = MobileAnchorsEnv(level, **given)
        assert (env.scene.n_anchors, env.scene.anchor_speed_m_s) == (n_anchors, speed)
        assert env.action_space.shape == (2 * n_anchors,)
        env.reset(seed=1)
        assert env.anchors.shape == (n_anchors, 3)


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (0, {"difficulty": "x"}, "difficulty must be one of 'easy', 'hard', got 'x'"),
        (0, {"difficulty": ["easy"]}, "difficulty must be one of"),
        (0, {"scene": "mars"}, "scene must be one of"),
        (0, {"scene": "uwb_room"}, "anchor_speed_m_s = 0 in 'uwb_room': set anchor_speed_m_s"),
        (0, {"scene": "satellite", "difficulty": "hard"}, "difficulty must be left out without"),
        (
            0,
            {"scene": {"name": "auv_craft", "anchor_speed_m_s": 0}},
            "scene must have moving anchors",
        ),
        (0, {"sort_craft": "no"}, "sort_craft must be True or False, got 'no'"),
        (0, {"render_mode": "human"}, "render_mode must be None"),
        (1, {"mode": "all"}, "mode must be one of 'top-k', 'priced', 'subset', got 'all'"),
        (1, {"k": 0}, "k must be an int from 1 to 12, got 0"),
        (1, {"k": 13}, "k must be an int from 1 to 12, got 13"),
        (1, {"k": 2.0}, "k must be an int from 1 to 12, got 2.0"),
        (1, {"k": True}, "k must be an int from 1 to 12, got True"),
        (1, {"price": -0.1}, "price must be a finite number"),
        (1, {"price": math.nan}, "price must be a finite number"),
        (1, {"price": "cheap"}, "price must be a number, got 'cheap'"),
        (1, {"scene": None}, "scene must be a name or a dict"),
        (1, {"render_mode": "human"}, "render_mode must be None"),
    ],
)
def test_bad_arguments_are_named(kind, arguments, message):
    for cls in list(CLASSES.values())[kind]:
        with pytest.raises(ValueError, match=message):
            cls(**arguments)


@pytest.mark.parametrize(
    ("kind", "action", "message"),
    [
        ("easy", np.zeros(4), r"action must be numbers of shape \(6,\)"),
        ("easy", [0, 0, math.nan, 0, 0, 0], "action must be finite, got nan"),
        ("easy", [math.inf, 0, 0, 0, 0, 0], "action must be finite, got inf"),
        ("top 3", "all", "action must be numbers"),
        ("top 3", np.full(12, math.nan), "action must be finite"),
        ("priced", np.full(12, 2), "action must lie in"),
        ("priced", np.full(12, 256), "action must lie in"),
        ("priced", np.full(12, -255), "action must lie in"),
        ("priced", np.full(12, 0.5), "action must lie in"),
        ("priced", np.full(12, 1e300), "action must lie in"),
        ("priced", np.full(12, math.nan), "action must be finite"),
        ("priced", np.ones(11, int), r"action must be numbers of shape \(12,\)"),
    ],
)
def test_bad_actions_are_named_and_change_nothing(kind, action, message):
    scalar, _, arguments = short(kind)
    assert_refused(scalar, arguments, action, message)
