"""AnchorPlacement with `scenes=`: drawn worlds, padded as the largest, alike scalar and vector."""

from __future__ import annotations

import json
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode

from rbl_gym import placement
from rbl_gym.envs.placement import AnchorPlacementEnv
from rbl_gym.envs.placement_family import PlacementFamilyEnv, PlacementFamilyVectorEnv
from rbl_gym.placement import Context
from rbl_gym.placement.families import TaskFamily, described, task_family
from rbl_gym.worlds import scenes
from rbl_gym.wrappers import FilterReward, VectorFilterReward
from tests.helpers import is_legal
from tests.side_by_side import actions_of, assert_steps_alike, episode, peer_of

ID = "rbl_gym:RBL/AnchorPlacement-v0"
ROOM: dict[str, Any] = {
    "name": "uwb_room",
    "n_anchors": {"integers": [2, 5]},
    "racks": {"integers": [0, 2]},
    "stretch": [{"uniform": [0.7, 1.4]}, {"uniform": [0.7, 1.4]}, 1.0],
}
PLATE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
MIXED: list[Any] = [
    "auv_buoys",
    {"name": "satellite", "n_anchors": 3, "tags": {"choice": [PLATE, [*PLATE, [0, 0, 1]]]}},
    ROOM,
    {"name": "hall", "n_anchors": 4, "noise": {"floor_m": {"log-uniform": [0.02, 0.5]}}},
]
ROOMS = [ROOM, {"name": "hall", "n_anchors": {"integers": [1, 3]}}]
WORLDS: dict[str, dict[str, Any]] = {
    "mixed": {"scenes": MIXED},
    "mixed at once": {"scenes": MIXED, "mode": "one-shot", "mirror": False},
    "rooms with sight": {"scenes": ROOMS, "sight": True},
    "mounts": {"scenes": ROOMS, "mode": "mounts"},
    "names": {"scenes": ["drone_yard", "auv_buoys"], "n_anchors": 3},
}
every_world = pytest.mark.parametrize("kind", WORLDS)


def task_told(info) -> placement.PlacementTask:
    """The task that the infos of a reset name."""
    told = json.loads(info["scene"])
    n_anchors, racks = told.pop("n_anchors"), told.pop("racks")
    return placement.task(told, n_anchors, racks)


@every_world
def test_the_score_is_that_of_the_task_alone(kind):
    """Padded anchors, boxes and tags add nothing; what is told makes the task again."""
    env, seen = PlacementFamilyEnv(**WORLDS[kind]), set()
    for seed in range(16):
        steps = episode(env, seed)
        one, info = task_told(steps[0][4]), steps[-1][4]
        m, k = one.n_anchors, len(one.scene.obstacles) + one.racks
        seen.add((one.scene.name, m, k))
        assert len(steps) == 1 + (1 if env._batch.mode == "one-shot" else m)
        assert (info["anchor_mask"].sum(), info["rack_mask"].sum()) == (m, k)
        assert not info["anchors"][m:].any()
        assert not info["racks"][k:].any()
        anchors = info["anchors"][:m]
        assert is_legal(one, anchors).all()
        problem = Context(info["region"][:3], info["region"][3:], info["racks"][:k])
        score = float(placement.score(one, problem, anchors))
        np.testing.assert_allclose(info["score_m"], score, rtol=1e-9)
        paid = sum(step[1] for step in steps[1:])
        start = math.log(3) if env._batch.mode == "mounts" else 0.0
        np.testing.assert_allclose(paid, start - math.log(score), rtol=1e-9)
    assert len(seen) > 1


@pytest.mark.parametrize("mode", ["sequential", "one-shot", "mounts"])
@pytest.mark.parametrize("mirror", [True, False])
def test_an_episode_equals_that_of_its_scene_alone(mode, mirror):
    """Unpadded: the same problem, shown and paid the same by the environment of one scene."""
    arguments: dict[str, Any] = {"mode": mode, "mirror": mirror}
    env = PlacementFamilyEnv([ROOM], sight=True, **arguments)
    for seed in range(8):
        env.action_space.seed(seed)
        got, info = env.reset(seed=seed)
        one = task_told(info)
        alone = AnchorPlacementEnv(
            one.scene,  # pyrefly: ignore[bad-argument-type]
            racks=one.racks,
            n_anchors=one.n_anchors,
            sight=one.racks > 0,
            **arguments,
        )
        generator, _ = seeding.np_random(seed)
        task_family([ROOM]).draw(generator)
        alone.np_random = generator
        want, plain = alone.reset()
        m, k = one.n_anchors, one.racks
        np.testing.assert_array_equal(info["region"], plain["region"])
        np.testing.assert_array_equal(got[:6], want[:6])
        boxes = got[6:20].reshape(2, 7)
        np.testing.assert_allclose(boxes[:k, :6].ravel(), want[6 : 6 + 6 * k], atol=1e-6)
        np.testing.assert_array_equal(boxes[:, 6], np.arange(2) < k)
        np.testing.assert_allclose(got[20:38], described(one), rtol=1e-6)
        np.testing.assert_array_equal(got[38:43], np.arange(5) < m)
        over = False
        while not over:
            action = env.action_space.sample()
            got, reward, over, _, info = env.step(action)
            own = action[: 3 * m] if mode == "one-shot" else action
            want, expected, ended, _, plain = alone.step(own)
            assert over == ended
            assert reward == pytest.approx(expected, rel=1e-9)
            np.testing.assert_allclose(info["anchors"][:m], plain["anchors"], atol=1e-12)
            if mode == "mounts":
                np.testing.assert_array_equal(info["action_mask"], plain["action_mask"])
                np.testing.assert_array_equal(env.action_masks(), alone.action_masks())
                # Sight, what is taken, the next anchor.
                np.testing.assert_array_equal(got[-119:-5], want[-114 - m : -m])


def test_numbers_are_drawn_within_their_bounds():
    drawn = [task_family([ROOM]).draw(np.random.default_rng(seed))[0] for seed in range(300)]
    anchors = np.bincount([one.n_anchors for one in drawn], minlength=6)
    racks = np.bincount([one.racks for one in drawn])
    assert set(np.flatnonzero(anchors)) == {2, 3, 4, 5}
    assert set(np.flatnonzero(racks)) == {0, 1, 2}
    # 300 draws of four and of three.
    assert (np.abs(anchors[2:] - 75) < 4.5 * 7.5).all()
    assert (np.abs(racks - 100) < 4.5 * 8.2).all()
    length = np.array([one.scene.volume.bounds()[1][0] for one in drawn])
    assert (length >= 0.7 * 9).all()
    assert (length <= 1.4 * 9).all()
    assert np.ptp(length) > 0.6 * 9


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"scenes": []}, "scenes must hold at least one scene"),
        ({"scenes": 3}, "scenes must be a list"),
        ({"scenes": ["castle"]}, r"scenes\[0\]: scene must be one of"),
        ({"scenes": ["hall", {"name": "auv_buoys", "racks": 1}]}, r"scenes\[1\]: racks must be 0"),
        ({"scenes": MIXED, "scene": "hall"}, "scene must be left out if scenes is given"),
        ({"scenes": MIXED, "mode": "mounts"}, "scenes must be rooms with walls"),
        ({"scenes": MIXED, "sight": True}, "scenes must be rooms with walls"),
        ({"scenes": MIXED, "mode": "all"}, "mode must be one of"),
        ({"scenes": MIXED, "mirror": 1}, "mirror must be True or False"),
        ({"scenes": ["camsap2013"]}, "scene must have a volume"),
        ({"scenes": [{"name": "uwb_room", "racks": {"integers": [0, 3]}}]}, "racks"),
    ],
)
def test_wrong_arguments_are_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        gym.make(ID, **arguments)


def test_masks_are_of_the_mounts_only():
    assert TaskFamily(("hall",)).most_boxes == 4
    with pytest.raises(ValueError, match="mode must be 'mounts' for action masks"):
        PlacementFamilyEnv(MIXED).action_masks()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_paid_by_a_filter(mode):
    arguments: dict[str, Any] = {
        "scenes": [{**ROOM, "n_anchors": {"integers": [2, 3]}}, "drone_yard"]
    }
    native: Any = VectorFilterReward(
        PlacementFamilyVectorEnv(3, autoreset_mode=mode, n_anchors=3, **arguments), "iekf"
    )
    peer = peer_of(
        lambda **told: FilterReward(PlacementFamilyEnv(**told), "iekf"), mode, 3,
        {"n_anchors": 3, **arguments},
    )  # fmt: skip
    results = assert_steps_alike(native, peer, 5, 3, {"rtol": 1e-7, "atol": 1e-9})
    assert any(one[1].any() for one in results)


def test_frames_are_those_of_the_drawn_task():
    envs = PlacementFamilyVectorEnv(2, MIXED, render_mode="rgb_array")
    envs.reset(seed=3)
    envs.step(actions_of(envs, np.random.default_rng(1)))
    frames = envs.render()
    for world in range(2):
        alone = PlacementFamilyEnv(MIXED, render_mode="rgb_array")
        alone.reset(seed=3 + world)
        assert np.shape(alone.render()) == frames[world].shape == (540, 960, 3)


def test_scenes_as_objects_are_told_by_their_names():
    env = PlacementFamilyEnv([scenes.get("drone_yard")], n_anchors=3)
    _, info = env.reset(seed=1)
    assert json.loads(info["scene"]) == {"name": "drone_yard", "n_anchors": 3, "racks": 0}
    assert env.task.n_anchors == 3
