"""Reference controllers: legal actions, the documented behaviour, and their order of quality."""

from __future__ import annotations

import itertools
import json
import math

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import bounds, motion
from rbl_gym.wrappers import controllers
from rbl_gym.wrappers.selection import AnchorSelectionVectorEnv
from rbl_gym.wrappers.situations import situations
from rbl_gym.wrappers.tasks import MobileAnchorsVectorEnv
from tests.helpers import share_by_hand


def mean_loss(env, controller, steps, seed=3):
    """Mean log b of some steps of the worlds of seed 5, less the price."""
    rng = np.random.default_rng(seed)
    env.reset(seed=5)
    return -np.mean([env.step(controller(env, rng))[1] for _ in range(steps)])


@pytest.mark.parametrize("difficulty", ["easy", "hard"])
@pytest.mark.parametrize("name", controllers.MOBILE)
def test_mobile_actions_are_legal_and_follow_the_generator(difficulty, name):
    env = MobileAnchorsVectorEnv(4, difficulty)
    env.reset(seed=1)
    controller = controllers.MOBILE[name]
    for _ in range(3):
        actions = controller(env, np.random.default_rng(7))
        np.testing.assert_array_equal(actions, controller(env, np.random.default_rng(7)))
        assert actions.shape == env.action_space.shape
        assert np.abs(actions).max() <= 1 + 1e-12
        if name != "random":
            assert np.linalg.norm(actions.reshape(4, -1, 2), axis=-1).max() <= 1 + 1e-12
        env.step(actions)


@pytest.mark.parametrize(
    "arguments", [{}, {"k": 1}, {"k": 12}, {"mode": "priced"}, {"mode": "subset", "k": 2}]
)
@pytest.mark.parametrize("name", controllers.SELECTION)
def test_selection_actions_are_legal_and_follow_the_generator(arguments, name):
    env = AnchorSelectionVectorEnv(4, **arguments)
    env.reset(seed=1)
    controller = controllers.SELECTION[name]
    for _ in range(3):
        actions = controller(env, np.random.default_rng(7))
        np.testing.assert_array_equal(actions, controller(env, np.random.default_rng(7)))
        assert actions.shape == env.action_space.shape
        if isinstance(env.single_action_space, gym.spaces.MultiBinary):
            assert np.isin(actions, (0, 1)).all()
        elif isinstance(env.single_action_space, gym.spaces.Discrete):
            scores = AnchorSelectionVectorEnv(4, k=2)
            scores.reset(seed=1)
            if env.inner_observation is not None and not env.inner_observation["links"].any():
                chosen = scores._command(controller(scores, np.random.default_rng(7)))
                np.testing.assert_array_equal(env._command(actions), chosen)
        else:
            assert np.abs(actions).max() <= 1
        env.step(actions)


@pytest.mark.parametrize("sort", [True, False])
def test_actions_are_in_the_order_of_the_observation(sort):
    """A command for a craft by its number reaches that craft, whatever the order."""
    env = MobileAnchorsVectorEnv(6, sort_craft=sort)
    env.reset(seed=2)
    before = env._last_observation()["anchors"].copy()
    velocity = np.zeros((6, 3, 2))
    velocity[:, 1] = [0.6, -0.8]
    env.step(controllers._ordered(env, velocity))
    moved = (env._last_observation()["anchors"] - before)[..., :2]
    np.testing.assert_allclose(moved, 8 * velocity, atol=1e-9)


@pytest.mark.parametrize("difficulty", ["easy", "hard"])
@pytest.mark.parametrize("name", ["ring", "orbit"])
def test_ring_and_orbit_reach_their_radius_and_angles(difficulty, name):
    still = {"name": "auv_craft", "trajectory": "constant", "speed_m_s": 0.0}
    env = MobileAnchorsVectorEnv(8, difficulty, scene=still)
    env.reset(seed=1)
    rng, angles = np.random.default_rng(1), []
    for _ in range(99):
        truth = env.step(controllers.MOBILE[name](env, rng))[4]["translation"]
        gap = env._last_observation()["anchors"][..., :2] - truth[:, None, :2]
        angles.append(np.sort(np.arctan2(gap[..., 1], gap[..., 0]), axis=-1))
    pair = difficulty == "hard"
    depths = getattr(controllers, f"{'PAIR_' if pair else ''}{name.upper()}_DEPTHS")
    radius = depths * np.maximum(-truth[:, 2], 10)
    # The process pushes the vehicle by .3 m a step, and craft overtake on a chord.
    error = np.linalg.norm(gap, axis=-1) / radius[:, None] - 1
    # Two craft know the vehicle to metres only, on a ring as small as three.
    typical = np.median if pair else np.max
    assert typical(np.abs(error)) < 0.1
    spread = np.diff(angles[-1], axis=-1)
    if pair:
        spread = np.minimum(spread, 2 * np.pi - spread)
        assert np.median(np.abs(spread - controllers.PAIR_ANGLE)) < 0.4
    else:
        assert np.abs(spread - 2 * np.pi / 3).max() < 0.3
    turning = np.angle(np.exp(1j * (angles[-1] - angles[-2])).prod(axis=-1))
    turned = np.abs(turning).mean()
    assert turned > 0.2 if name == "orbit" else turned < 0.2


def test_three_craft_beat_two_and_controllers_are_in_their_order():
    losses = {}
    for difficulty in ("easy", "hard"):
        for name in ("random", "ring", "orbit"):
            env = MobileAnchorsVectorEnv(32, difficulty)
            losses[difficulty, name] = mean_loss(env, controllers.MOBILE[name], 40)
    assert losses["easy", "ring"] < losses["easy", "random"] - 0.5
    assert losses["hard", "orbit"] < losses["hard", "ring"] < losses["hard", "random"]
    assert losses["easy", "random"] < losses["hard", "random"]


@pytest.mark.parametrize("difficulty", ["easy", "hard"])
def test_receding_horizon_is_better_than_random(difficulty):
    env = MobileAnchorsVectorEnv(6, difficulty)
    planned = mean_loss(env, controllers.receding_horizon, 20)
    assert planned < mean_loss(env, controllers.random_velocities, 20) - 0.2


def test_a_plan_costs_the_mean_log_score_along_it():
    env = MobileAnchorsVectorEnv(2)
    env.reset(seed=3)
    env.step(np.zeros((2, 6)))
    rng = np.random.default_rng(1)
    plans = rng.uniform(-0.7, 0.7, (2, 5, 6, 3, 2))
    got = controllers._plan_cost(env, plans, controllers._predicted(env))
    scene, tags = env.scene, np.array(env.scene.tags)
    for world, sample in itertools.product(range(2), (0, 4)):
        pose = env.belief.rotation[world], env.belief.translation[world]
        twist, covariance = env.twist[world], env.belief.covariance[world]
        anchors, cost = env._last_observation()["anchors"][world].copy(), 0.0
        for step in plans[world, sample]:
            anchors[:, :2] += 8 * step
            pose = motion.propagate(*pose, twist, 2.0)
            covariance = bounds.predict_covariance(covariance, twist, 2.0, scene.process)
            covariance = bounds.pose_crb(
                anchors, tags, *pose, scene.noise, prior_information=np.linalg.inv(covariance)
            )
            cost += math.log(bounds.score(covariance, pose[0], tags)) / 6
        np.testing.assert_allclose(got[world, sample], cost, rtol=1e-6)


# --- choosing ---------------------------------------------------------------------------------


def predicted_score(env, world, chosen, with_map):
    """b of the predicted belief with the chosen anchors added, in plain steps."""
    scene, tags = env.scene, np.array(env.scene.tags)
    state, twist = env.belief, env.twist[world]
    pose = motion.propagate(state.rotation[world], state.translation[world], twist, scene.dt)
    covariance = bounds.predict_covariance(state.covariance[world], twist, scene.dt, scene.process)
    information = np.linalg.inv(covariance)
    for i in chosen:
        anchor = env.anchors[world, i]
        share = share_by_hand(scene, anchor, pose[1]) if with_map else 1.0
        information = information + share * bounds.information_at(
            anchor[None], tags, *pose, scene.noise
        )
    return bounds.score(np.linalg.inv(information), pose[0], tags)


@pytest.mark.parametrize("with_map", [False, True])
@pytest.mark.parametrize("mode", ["top-k", "priced"])
def test_greedy_takes_at_each_turn_what_brute_force_would(mode, with_map):
    controller = controllers.greedy_with_map if with_map else controllers.greedy_blind
    env, rng = AnchorSelectionVectorEnv(5, mode, price=0.2), np.random.default_rng(0)
    env.reset(seed=8)
    for _ in range(3):
        actions = controller(env, rng)
        for world in range(5):
            wanted: list[int] = []
            value = math.log(predicted_score(env, world, [], with_map))
            while len(wanted) < (3 if mode == "top-k" else 12):
                rest = [i for i in range(12) if i not in wanted]
                values = [
                    math.log(predicted_score(env, world, [*wanted, i], with_map)) for i in rest
                ]
                if mode == "priced" and min(values) >= value - 0.2:
                    break
                value = min(values)
                wanted.append(rest[int(np.argmin(values))])
            assert set(np.flatnonzero(actions[world] > 0)) == set(wanted)
        env.step(actions)


def test_nearest_takes_the_nearest():
    for mode in ("top-k", "priced"):
        env = AnchorSelectionVectorEnv(4, mode)
        env.reset(seed=2)
        rng = np.random.default_rng(0)
        distance = np.linalg.norm(env.anchors - env.belief.translation[:, None], axis=-1)
        chosen = env.step(controllers.nearest(env, rng))[4]["chosen"]
        for world in range(4):
            assert set(np.flatnonzero(chosen[world])) == set(np.argsort(distance[world])[:3])


@pytest.mark.parametrize("mode", ["top-k", "priced"])
def test_selection_controllers_are_in_their_order(mode):
    losses = {
        name: mean_loss(AnchorSelectionVectorEnv(32, mode), controller, 20)
        for name, controller in controllers.SELECTION.items()
    }
    assert losses["greedy-with-map"] < losses["greedy-blind"] < losses["random"]
    assert losses["greedy-blind"] <= losses["nearest"] + 0.01


# --- families of scenes -----------------------------------------------------------------------

CRAFT = {
    "name": "auv_craft",
    "n_anchors": {"integers": [2, 5]},
    "anchor_speed_m_s": {"choice": [2.0, 4.0]},
}
RACK = [{"uniform": [-15, 15]}, {"uniform": [-7, 7]}, 1.5, 0.5, 4.0, 1.5]
HALLS = {
    "name": "hall",
    "n_anchors": {"integers": [6, 12]},
    "obstacles": {"repeat": {"count": [1, 3], "of": RACK}},
}


@pytest.mark.parametrize(
    ("make", "scene", "known"),
    [
        (MobileAnchorsVectorEnv, {"name": "auv_craft", "n_anchors": 3}, controllers.MOBILE),
        (AnchorSelectionVectorEnv, {"name": "hall", "steps": 50}, controllers.SELECTION),
    ],
)
def test_a_family_of_one_scene_is_that_scene(make, scene, known):
    alone, family = make(3, scene=scene), make(3, scenes=[scene])
    for env in (alone, family):
        env.reset(seed=4)
    for controller in known.values():
        one, other = (controller(env, np.random.default_rng(1)) for env in (alone, family))
        np.testing.assert_allclose(one, other, atol=1e-9)
        assert one.dtype == other.dtype


@pytest.mark.parametrize("name", ["ring", "orbit"])
def test_craft_of_each_world_go_where_they_would_alone(name):
    """A world of a family by itself: the same situation, in an environment of its own scene."""
    env = MobileAnchorsVectorEnv(6, scenes=CRAFT)
    _, info = env.reset(seed=2)
    actions = controllers.MOBILE[name](env, np.random.default_rng(0))
    assert len({len(json.loads(one)) for one in info["scene"]}) == 1
    found = {}
    for rows, situation in situations(env):
        m = situation.scene.n_anchors
        assert {env.world.scenes[row] for row in rows} == {situation.scene}
        assert env.inner_observation is not None
        for row in rows:
            found[row] = m
            alone = MobileAnchorsVectorEnv(1, scene=situation.scene)
            alone.reset(seed=0)
            alone.inner_observation = {
                key: value[row : row + 1].copy() for key, value in env.inner_observation.items()
            }
            alone.inner_observation["anchors"] = alone.inner_observation["anchors"][:, :m]
            alone.order = env.order[row : row + 1, :m]
            wanted = controllers.MOBILE[name](alone, np.random.default_rng(0))[0]
            np.testing.assert_allclose(actions[row, : 2 * m], wanted, atol=1e-12)
            assert not actions[row, 2 * m :].any()
    assert sorted(found) == list(range(6))
    assert len(set(found.values())) > 1


@pytest.mark.parametrize("mode", ["top-k", "priced"])
def test_drawn_halls_have_references_in_their_order(mode):
    losses = {
        name: mean_loss(AnchorSelectionVectorEnv(24, mode, scenes=HALLS), controller, 12)
        for name, controller in controllers.SELECTION.items()
    }
    assert losses["greedy-with-map"] < losses["greedy-blind"] < losses["random"]
