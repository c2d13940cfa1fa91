"""Observations of `RBL/AnchorPlacement-v0`: positions, mirroring, tokens, custom views."""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from rbl_gym.envs.placement import AnchorPlacementEnv, AnchorPlacementVectorEnv
from rbl_gym.envs.placement_family import PlacementFamilyEnv, PlacementFamilyVectorEnv
from rbl_gym.envs.placement_views import PLACEMENT_OBSERVATIONS, Placing, placement_tokens
from rbl_gym.placement.families import described
from tests.side_by_side import assert_steps_alike, episode, peer_of, played

ID = "rbl_gym:RBL/AnchorPlacement-v0"
ROOM = {
    "name": "uwb_room",
    "n_anchors": {"integers": [3, 5]},
    "racks": {"integers": [0, 2]},
    "stretch": [{"uniform": [0.7, 1.4]}, 1.0, 1.0],
}
WORLDS: dict[str, dict[str, Any]] = {
    "buoys": {"scene": "auv_buoys"},
    "at once": {"scene": "uwb_room", "racks": 2, "mode": "one-shot"},
    "mounts": {"scene": "uwb_room", "racks": 1, "mode": "mounts"},
    "sight": {"scene": "uwb_room", "racks": 2, "sight": True},
    "drawn": {"scenes": [ROOM, "auv_buoys"]},
    "drawn mounts": {"scenes": [ROOM], "mode": "mounts"},
}
every_world = pytest.mark.parametrize("kind", WORLDS)


def distances(placing: Placing) -> dict[str, np.ndarray]:
    told = placing.observation
    gap = np.linalg.norm(told["anchors"] - told["region"][:, None, :3], axis=-1)
    return {"gap": gap * told["placed"], "left": told["anchor_mask"] - told["placed"]}


@every_world
def test_the_dict_without_mirroring_is_what_the_infos_say(kind):
    env = gym.make(ID, observation="dict", mirror=False, **WORLDS[kind])
    for seed in range(4):
        steps = episode(env, seed)
        task: Any = env.get_wrapper_attr("task")
        for count, (seen, *_, info) in enumerate(steps):
            assert env.observation_space.contains(seen)
            np.testing.assert_array_equal(seen["region"], info["region"])
            np.testing.assert_array_equal(seen["anchors"], info["anchors"])
            placed = count if kind != "at once" else count * task.n_anchors
            real = np.arange(len(seen["placed"])) < task.n_anchors
            np.testing.assert_array_equal(seen["placed"], np.arange(len(real)) < placed)
            np.testing.assert_array_equal(seen["anchor_mask"], real)
            wanted = (np.arange(len(real)) == placed) & real & (kind != "at once")
            np.testing.assert_array_equal(seen["next"], wanted)
            if "racks" in seen:
                np.testing.assert_array_equal(seen["racks"], info["racks"])
            if kind == "mounts":
                np.testing.assert_array_equal(1 - seen["taken"], info["action_mask"])


@pytest.mark.parametrize("kind", ["buoys", "at once", "mounts"])
def test_what_is_mirrored_agrees_with_the_actions(kind):
    env = gym.make(ID, observation="dict", **WORLDS[kind])
    plain = gym.make(ID, **WORLDS[kind])
    task: Any = env.get_wrapper_attr("task")
    low, high = task.scene.volume.bounds()
    low, high = np.array(low), np.array(high)
    mirrored = 0
    for seed in range(8):
        steps, actions = played(env, seed)
        flat = [one for one, *_ in episode(plain, seed)]
        for (seen, *_, info), vector in zip(steps, flat, strict=True):
            signs = np.where(np.isclose(seen["region"][:3], info["region"][:3]), 1, -1)
            mirrored += (signs < 0).any()
            assert (seen["region"][:2] >= (0.5 * (low + high))[:2] - 1e-9).all()
            # The flat vector shows the same, scaled to the volume.
            scaled = (seen["region"][:3] - 0.5 * (low + high)) / (0.5 * (high - low))
            np.testing.assert_allclose(vector[:3], scaled, atol=1e-6)
            turned = np.where(signs < 0, low + high - info["anchors"], info["anchors"])
            placed = seen["placed"][:, None] > 0
            np.testing.assert_allclose(seen["anchors"], turned * placed, atol=1e-9)
            racks = np.where(signs < 0, low + high - info["racks"][:, :3], info["racks"][:, :3])
            for own in seen.get("racks", ()):
                assert np.isclose(own[:3], racks).all(axis=-1).any()
        last = steps[-1][0]
        if kind == "mounts":
            np.testing.assert_allclose(last["anchors"], last["mounts"][actions], atol=1e-9)
        else:
            placed = task.scene.anchor_region.place(np.reshape(actions, (-1, 3)).astype(float))
            np.testing.assert_allclose(last["anchors"], placed, atol=1e-6)
    assert mirrored > 4


@every_world
def test_tokens_by_hand(kind):
    env = gym.make(ID, observation="tokens", **WORLDS[kind])
    told = gym.make(ID, observation="dict", **WORLDS[kind])
    flat = gym.make(ID, **WORLDS[kind])
    for seed in range(3):
        for (seen, *_), (known, *_), (vector, *_) in zip(
            episode(env, seed), episode(told, seed), episode(flat, seed), strict=True
        ):
            assert env.observation_space.contains(seen)
            task: Any = told.get_wrapper_attr("task")
            extent, centre = float(task.scene.scales.extent), known["region"][:3]
            want = np.concatenate([vector[:6], described(task)])
            np.testing.assert_allclose(seen["problem"], want, atol=1e-6)
            for m, token in enumerate(seen["anchor_tokens"]):
                placed = known["placed"][m]
                want = (known["anchors"][m] - centre) / extent * placed
                np.testing.assert_allclose(token, [*want, placed, known["next"][m]], atol=1e-6)
                assert seen["anchor_mask"][m] == (m < task.n_anchors)
            for k, token in enumerate(seen.get("obstacle_tokens", ())):
                box, real = known["racks"][k], known["rack_mask"][k]
                want = np.concatenate([box[:3] - centre, box[3:]]) / extent * real
                np.testing.assert_allclose(token, want, atol=1e-6)
            for k, token in enumerate(seen.get("mount_tokens", ())):
                want = (known["mounts"][k] - centre) / extent
                want = [*want, known["sight"][k], known["taken"][k]]
                np.testing.assert_allclose(token, want, atol=1e-6)
    assert ("mount_tokens" in seen) == (kind in ("mounts", "sight", "drawn mounts"))


@every_world
@pytest.mark.parametrize("view", ["dict", "tokens", distances])
def test_the_vector_environment_shows_the_same(kind, view):
    drawn = "scenes" in WORLDS[kind]
    native = PlacementFamilyVectorEnv if drawn else AnchorPlacementVectorEnv
    scalar = PlacementFamilyEnv if drawn else AnchorPlacementEnv
    arguments = {**WORLDS[kind], "observation": view}
    mode = AutoresetMode.SAME_STEP
    envs = native(num_envs=3, autoreset_mode=mode, **arguments)
    peer = peer_of(scalar, mode, 3, arguments)
    results = assert_steps_alike(envs, peer, 9, 4, {"rtol": 1e-6, "atol": 1e-6})
    assert any("final_obs" in info for *_, info in results)


def test_views_by_path_and_with_a_space_of_their_own():
    path = "tests.test_placement_views:distances"
    env: Any = gym.make(ID, observation=path)
    assert env.spec is not None
    again = gym.make(pickle.loads(pickle.dumps(env.spec)))
    seen = again.reset(seed=1)[0]
    assert env.observation_space["left"].dtype == np.int8
    assert {key: one.shape for key, one in seen.items()} == {"gap": (4,), "left": (4,)}
    check_env(again.unwrapped, skip_render_check=True)

    def first(placing):
        return placing.flat[:, :3]

    first.space = gym.spaces.Box(-2, 2, (3,), np.float32)  # pyrefly: ignore[missing-attribute]
    envs = gym.make_vec(ID, num_envs=2, observation=first)
    assert envs.single_observation_space == first.space  # pyrefly: ignore[missing-attribute]
    assert envs.reset(seed=1)[0].shape == (2, 3)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ("pixels", "observation must be one of 'flat', 'dict', 'tokens', 'module:function'"),
        ("tests.nowhere:view", "cannot be imported"),
        (lambda placing: placing.flat[0], r"observation must have a leading axis of worlds, \(1"),
        (lambda placing: {"a": [[1.0]] * 2}, r"observation\['a'\] must have a leading axis"),
        (lambda placing: [["text"]], "observation must return numbers"),
    ],
)
def test_what_is_no_observation_is_refused(observation, message):
    assert "flat" in PLACEMENT_OBSERVATIONS
    with pytest.raises(ValueError, match=message):
        gym.make(ID, observation=observation)


def test_a_view_that_changes_its_mind_is_refused():
    lengths = iter([3, 3, 4])

    def view(placing):
        return placing.flat[:, : next(lengths)]

    env = gym.make(ID, observation=view)
    env.reset(seed=1)
    with pytest.raises(ValueError, match=r"observation must have shape \(1, 3\), got \(1, 4\)"):
        env.step(env.action_space.sample())


def test_tokens_are_cut():
    env = AnchorPlacementVectorEnv(2, observation="dict")
    env.reset(seed=1)
    placing = env._placing()
    far = {**placing.observation, "anchors": np.full((2, 4, 3), 1e9)}
    far["placed"] = np.ones((2, 4), np.int8)
    tokens = placement_tokens(placing._replace(observation=far))
    assert (tokens["anchor_tokens"][..., :3] == 10).all()
