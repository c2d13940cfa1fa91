"""RBL/AnchorPlacement-v0: Gymnasium's contract, the score by hand, scalar against vector."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import placement
from rbl_gym.envs.placement import AnchorPlacementEnv, AnchorPlacementVectorEnv
from rbl_gym.placement import Context
from rbl_gym.worlds.scenes import SCENES
from tests.helpers import assert_same, is_legal
from tests.side_by_side import assert_refused, episode, played, spoil

ID = "rbl_gym:RBL/AnchorPlacement-v0"
WORLDS: dict[str, dict[str, Any]] = {
    "auv": {},
    "yard": {"scene": "drone_yard"},
    "satellite": {"scene": "satellite", "n_anchors": 2},
    "room with racks": {"scene": "uwb_room", "racks": 2},
    "one rack, one anchor": {"scene": "uwb_room", "racks": 1, "n_anchors": 1},
    "own scene": {"scene": {"name": "icassp2013", "noise": {"floor_m": 0.1}}, "n_anchors": 3},
    "at once": {"scene": "uwb_room", "mode": "one-shot", "racks": 1},
    "at once, auv": {"mode": "one-shot"},
    "sight": {"scene": "uwb_room", "racks": 2, "sight": True},
    "sight at once": {"scene": "uwb_room", "mode": "one-shot", "racks": 1, "sight": True},
    "mounts": {"scene": "uwb_room", "mode": "mounts", "n_anchors": 3},
    "mounts and racks": {"scene": "uwb_room", "mode": "mounts", "racks": 2},
}
every_world = pytest.mark.parametrize("kind", WORLDS)


def batch_of(env: Any) -> Any:
    """The vector environment of one world that a scalar one is."""
    return env.unwrapped._batch


def context_of(info) -> Context:
    return Context(info["region"][:3], info["region"][3:], info["racks"])


# --- Gymnasium --------------------------------------------------------------------------------


@every_world
def test_the_problems_that_are_told_are_copies(kind):
    env = AnchorPlacementVectorEnv(3, **WORLDS[kind])
    env.reset(seed=1)
    before = env.contexts
    spoil(env.contexts._asdict())
    assert_same(env.contexts._asdict(), before._asdict())


@every_world
def test_seeds_decide_and_episodes_differ(kind):
    env = AnchorPlacementEnv(**WORLDS[kind])
    first, second = episode(env, 4), episode(env, 4)
    assert_same(first, second)
    region = first[0][-1]["region"]
    assert (env.reset()[1]["region"] != region).any()
    assert (env.reset(seed=5)[1]["region"] != region).any()
    problem = placement.draw_contexts(batch_of(env).task, np.random.default_rng(4))
    np.testing.assert_array_equal(region, np.concatenate([problem.centre, problem.half]))


# --- what an episode is -----------------------------------------------------------------------


@every_world
def test_rewards_are_the_score_of_the_anchors_in_info(kind):
    env = AnchorPlacementEnv(**WORLDS[kind])
    task = batch_of(env).task
    for seed in range(3):
        steps = episode(env, seed)
        one_shot = WORLDS[kind].get("mode") == "one-shot"
        assert len(steps) == 1 + (1 if one_shot else task.n_anchors)
        info = steps[-1][4]
        assert is_legal(task, info["anchors"]).all()
        score = float(placement.score(task, context_of(info), info["anchors"]))
        np.testing.assert_allclose(info["score_m"], score, rtol=1e-9)
        rewards = [step[1] for step in steps]
        if WORLDS[kind].get("mode") == "mounts":
            np.testing.assert_allclose(sum(rewards), math.log(3) - math.log(score))
            for k in range(1, len(steps)):
                placed = steps[k][4]["anchors"][:k]
                value = math.log(placement.score(task, context_of(info), placed))
                np.testing.assert_allclose(sum(rewards[: k + 1]), math.log(3) - value)
        else:
            np.testing.assert_allclose(rewards[-1], -math.log(score))
            assert not any(rewards[:-1])
        for k, (_, reward, terminated, truncated, info) in enumerate(steps):
            assert type(reward) is float
            assert terminated is (k == len(steps) - 1)
            assert truncated is False
            assert type(info["score_m"]) is float
            assert (info["score_m"] > 0) is terminated


def turned(env, info, mirror):
    """Signs by which the region is brought towards +x and +y."""
    scene = batch_of(env).task.scene
    low, high = scene.volume.bounds()
    # Legal places that do not lie evenly about the volume are no mirror's.
    mirror &= np.array_equal(sum(scene.anchor_region.bounds())[:2], (low + high)[:2])  # pyrefly: ignore[unsupported-operation]
    sign = np.where(info["region"][:3] < 0.5 * (low + high), -1, 1) if mirror else np.ones(3)
    return sign * [1, 1, 0] + [0, 0, 1]


@pytest.mark.parametrize("mirror", [True, False])
@pytest.mark.parametrize("kind", ["auv", "satellite", "room with racks"])
@pytest.mark.parametrize("seed", [6, 7, 8])
def test_sequential_places_each_action_by_the_region(kind, mirror, seed):
    env = AnchorPlacementEnv(**WORLDS[kind], mirror=mirror)
    task = batch_of(env).task
    steps, actions = played(env, seed)
    for k, step in enumerate(steps):
        shown = np.array(actions[:k], float).reshape(-1, 3) * turned(env, step[4], mirror)
        placed = task.scene.anchor_region.place(shown)
        np.testing.assert_allclose(step[4]["anchors"][:k], placed)
        assert not step[4]["anchors"][k:].any()  # zeros where no anchor stands yet


@pytest.mark.parametrize("mirror", [True, False])
@pytest.mark.parametrize("seed", [6, 7, 8])
@every_world
def test_observations_by_hand(kind, mirror, seed):
    env = AnchorPlacementEnv(**WORLDS[kind], mirror=mirror)
    task, mode = batch_of(env).task, WORLDS[kind].get("mode", "sequential")
    low, high = (np.array(corner) for corner in (task.scene.volume.low, task.scene.volume.high))
    m = task.n_anchors
    steps, actions = played(env, seed)
    for k, (observation, _, _, _, info) in enumerate(steps):
        assert observation.dtype == np.float32
        assert env.observation_space.contains(observation)
        sign = turned(env, info, mirror)
        floor, top = task.scene.anchor_region.bounds()
        middle = 0.5 * (floor + top) * [1, 1, 0]
        centre, half, racks = context_of(info)
        centre = middle + sign * (centre - middle)
        racks = np.array([[*(middle + sign * (r[:3] - middle)), *r[3:]] for r in racks])
        if mirror:
            racks = sorted(racks, key=lambda rack: -rack[0])
        parts = [2 * (centre - low) / (high - low) - 1, 4 * half / (high - low) - 1]
        for rack in racks:
            parts += [2 * (rack[:3] - floor) / (top - floor) - 1, 2 * rack[3:] / (top - floor)]
        if mode == "sequential":
            done = np.zeros((m, 3))
            done[:k] = np.array(actions[:k]).reshape(-1, 3)
            parts.append(done.ravel())
        if mode == "mounts" or WORLDS[kind].get("sight"):
            # Mount k of the observation is the one that the mirror takes mount k to.
            mounts = middle + sign * (placement.mounts(task) - middle)
            parts.append(placement.sight_fractions(task, context_of(info), mounts))
        if mode == "mounts":
            taken = np.zeros(57)
            taken[np.array(actions[:k], int)] = 1
            parts.append(taken)
            np.testing.assert_array_equal(info["action_mask"], 1 - taken)
            assert info["action_mask"].dtype == np.int8
            np.testing.assert_allclose(info["anchors"][:k], mounts[np.array(actions[:k], int)])
        if mode != "one-shot":
            parts.append(np.arange(m) == k)
        wanted = np.clip(np.concatenate(parts), -1, 1)
        np.testing.assert_allclose(observation, wanted, atol=1e-6)


def test_actions_beyond_the_box_are_cut():
    env = AnchorPlacementEnv(n_anchors=1, mirror=False)
    env.reset(seed=1)
    observation, _, _, _, info = env.step(np.array([3.0, -9, 0.5]))
    np.testing.assert_allclose(info["anchors"], [[200, -200, 0]])
    np.testing.assert_allclose(observation[6:9], [1, -1, 0.5])
    assert env.observation_space.contains(observation)


def test_one_shot_equals_sequential():
    actions = np.random.default_rng(3).uniform(-1, 1, (4, 3)).astype(np.float32)
    once, stepwise = AnchorPlacementEnv(mode="one-shot"), AnchorPlacementEnv()
    once.reset(seed=2)
    stepwise.reset(seed=2)
    got = once.step(actions.ravel())
    for action in actions:
        want = stepwise.step(action)
    np.testing.assert_array_equal(got[4]["anchors"], want[4]["anchors"])
    assert got[1] == want[1]


def test_a_mount_twice_adds_a_second_anchor_there():
    env = AnchorPlacementEnv("uwb_room", "mounts", n_anchors=2, mirror=False)
    task = batch_of(env).task
    _, info = env.reset(seed=8)
    first = env.step(20)
    second = env.step(20)
    np.testing.assert_array_equal(second[4]["anchors"], placement.mounts(task)[[20, 20]])
    assert second[4]["action_mask"].sum() == 56
    total = 2 * placement.information(task, context_of(info), placement.mounts(task)[[20]])
    np.testing.assert_allclose(second[4]["score_m"], placement.score_of(task, total), rtol=1e-9)
    np.testing.assert_allclose(first[1] + second[1], math.log(3 / second[4]["score_m"]))


# --- vector -----------------------------------------------------------------------------------


def test_contexts_are_those_in_info():
    env = AnchorPlacementVectorEnv(5, "uwb_room", racks=2)
    _, info = env.reset(seed=3)
    contexts = env.contexts
    np.testing.assert_array_equal(np.hstack([contexts.centre, contexts.half]), info["region"])
    np.testing.assert_array_equal(contexts.racks, info["racks"])


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": "attic"}, "scene must be one of"),
        ({"scene": "camsap2013"}, "scene must have a volume, that of"),
        ({"scene": 7}, "scene must be a name or a dict"),
        ({"mode": "all"}, "mode must be one of 'sequential', 'one-shot', 'mounts', got 'all'"),
        ({"mode": "mounts"}, "scene must have walls for mount points, got 'auv_buoys'"),
        ({"racks": 1}, "racks must be 0 outside a named room"),
        ({"sight": True}, "sight must be False with racks=0 in a scene without obstacles"),
        ({"sight": 1}, "sight must be True or False, got 1"),
        ({"racks": 1.5}, "racks must be an int from 0 to 2, got 1.5"),
        ({"n_anchors": 0}, "n_anchors must be"),
        ({"n_anchors": "four"}, "n_anchors must be an int from 1 to 1000000, got 'four'"),
        ({"render_mode": "human"}, "render_mode must be None"),
    ],
)
@pytest.mark.parametrize("kind", [AnchorPlacementEnv, AnchorPlacementVectorEnv])
def test_bad_arguments_are_named(kind, arguments, message):
    with pytest.raises(ValueError, match=message):
        kind(**arguments)


@pytest.mark.parametrize(
    ("kind", "action", "message"),
    [
        ("auv", np.zeros(2), r"action must be numbers of shape \(3,\)"),
        ("auv", np.zeros((1, 3)), "action must be numbers"),
        ("auv", [0, 0, math.nan], "action must be finite, got nan"),
        ("auv", [0, 0, -math.inf], "action must be finite, got -inf"),
        ("auv", "north", "action must be numbers"),
        ("auv", None, "action must be numbers"),
        ("auv", np.zeros(3, complex), "action must be numbers"),
        ("at once", np.zeros(3), r"action must be numbers of shape \(15,\)"),
        ("mounts", 57, "action must lie in"),
        ("mounts", -1, "action must lie in"),
        ("mounts", 2**63, "action must lie in"),
        ("mounts", 3.7, "action must be integers"),
        ("mounts", math.nan, "action must be integers"),
        ("mounts", [1], "action must be integers"),
    ],
)
def test_bad_actions_are_named_and_change_nothing(kind, action, message):
    assert_refused(AnchorPlacementEnv, WORLDS[kind], action, message)


def test_a_hall_keeps_its_obstacles_and_its_problems_are_not_mirrored():
    hall = SCENES["hall"]
    env = AnchorPlacementEnv("hall", racks=1, sight=True)
    observation, info = env.reset(seed=2)
    np.testing.assert_array_equal(info["racks"][:4], hall.obstacles)
    assert info["racks"].shape == (5, 6)
    # Region 6, the drawn rack 6, 11 anchors with 3 coordinates each, 57 mounts, 11 numbers.
    assert observation.shape == (6 + 6 + 33 + 57 + 11,)
    low, high = hall.volume.bounds()
    centre = (info["region"][:3] - 0.5 * (low + high)) / (0.5 * (high - low))
    np.testing.assert_allclose(observation[:3], centre, atol=1e-6)
    # Layouts are judged among all five.
    task = env._batch.task
    context = context_of(info)
    anchors = np.array(hall.anchors)[: task.n_anchors]
    alone = context._replace(racks=np.empty((0, 6)))
    assert placement.score(task, context, anchors) > 1.05 * placement.score(task, alone, anchors)


def test_frames_of_a_hall_show_its_obstacles():
    shown = []
    for scene in ("hall", {"name": "hall", "obstacles": []}):
        env = AnchorPlacementEnv(scene, render_mode="rgb_array")
        env.reset(seed=2)
        env.step(np.zeros(3))
        shown.append(env.render())
    assert (shown[0] != shown[1]).any()


def test_action_masks_are_the_mounts_that_are_free():
    arguments = {"scene": "uwb_room", "mode": "mounts", "racks": 1}
    env = gym.make(ID, **arguments)
    env.reset(seed=3)
    masks: Any = env.get_wrapper_attr("action_masks")
    assert masks().shape == (57,)
    assert masks().all()
    for count in range(1, 4):
        chosen = int(np.flatnonzero(masks())[5])
        *_, info = env.step(chosen)
        assert not masks()[chosen]
        assert masks().sum() == 57 - count
        np.testing.assert_array_equal(masks(), info["action_mask"])
    envs = gym.make_vec(ID, num_envs=2, **arguments)
    envs.reset(seed=3)
    envs.step(np.array([4, 9]))
    both = envs.unwrapped.action_masks()  # pyrefly: ignore[missing-attribute]
    assert [list(np.flatnonzero(~row)) for row in both] == [[4], [9]]
    with pytest.raises(ValueError, match="mode must be 'mounts' for action masks"):
        gym.make(ID).get_wrapper_attr("action_masks")()
