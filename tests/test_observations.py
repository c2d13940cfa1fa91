"""`observation=`: tokens and views of one's own, padded and unpadded, scalar and vector."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from rbl_gym.envs.base_station import BaseStationEnv
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.worlds import scenes
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from rbl_gym.wrappers.observations import OBSERVATIONS, Seen, flat, tokens, viewer_of
from tests.helpers import assert_same
from tests.side_by_side import assert_contract, assert_steps_alike, of_its_spec, peer_of

ID = "rbl_gym:RBL/Tracking-v0"
RACK = {"repeat": {"count": [0, 3], "of": [{"uniform": [-9, 9]}, 0.0, 1.0, 1.0, 1.0, 1.0]}}
MIXED: list[Any] = [
    {"name": "hall", "n_anchors": {"integers": [4, 6]}, "obstacles": RACK, "steps": 4},
    {"name": "auv_craft", "n_anchors": 3, "steps": 3},
]
TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "craft": ("MobileAnchors", {"scenes": [{"name": "auv_craft", "n_anchors": 4, "steps": 4}]}),
    "one craft scene": ("MobileAnchors", {"scene": {"name": "auv_craft", "steps": 4}}),
    "selection": ("AnchorSelection", {"scenes": MIXED[:1], "k": 2}),
    "one hall": ("AnchorSelection", {"scene": {"name": "hall", "steps": 4}, "mode": "subset"}),
    "shared": (
        "SharedAnchors",
        {
            "scene": {"name": "uwb_room", "steps": 4},
            "bodies": [{}, {"tags": [[0, 0, 0], [1, 0, 0]]}],
        },
    ),
}


def nearest(seen: Seen) -> np.ndarray:
    """Distance of the nearest anchor, and how many links there are."""
    gap = seen.observation["anchors"] - seen.belief.translation[..., None, :]
    far = np.linalg.norm(gap, axis=-1)
    if "anchor_mask" in seen.observation:
        far = np.where(seen.observation["anchor_mask"] > 0, far, np.inf)
    links = seen.observation["links"].sum(axis=(-2, -1))
    return np.stack([far.min(axis=-1), links], axis=-1)


def many(seen: Seen) -> dict[str, np.ndarray]:
    """A dict of arrays of several types."""
    return {"place": seen.belief.translation, "links": seen.observation["links"]}


def odd(seen: Seen) -> np.ndarray:
    """As many entries as there are anchors in the drawn scene."""
    return seen.belief.translation[..., :1] * np.ones(seen.scene.n_anchors)


PATH = f"{__name__}:nearest"


# --- tokens -----------------------------------------------------------------------------------


def by_hand(scene, told, belief) -> dict[str, np.ndarray]:
    """The tokens of one world in plain loops."""
    corners = np.array([scene.volume.bounds(), scene.anchor_region.bounds()]).reshape(-1, 3)
    extent = np.linalg.norm(np.ptp(corners, axis=0)) / 2
    m, n = scene.n_anchors, len(scene.tags)
    radius = max(np.linalg.norm(tag) for tag in scene.tags)
    anchors, tags, boxes = [], [], []
    for k in range(m):
        gap = told["anchors"][k] - belief.translation
        measured = told["links"][k, :n].sum() / n
        quality = told["quality"][k] if "quality" in told else 1.0
        anchors.append([*gap / extent, np.log(np.linalg.norm(gap) / extent), measured, quality])
    for k, tag in enumerate(scene.tags):
        turned = belief.rotation @ np.array(tag) / radius
        tags.append([*turned, told["links"][:m, k].sum() / m])
    for box in scene.obstacles:
        centre = (np.array(box[:3]) - belief.translation) / extent
        boxes.append([*centre, *np.array(box[3:]) / extent])
    low, high = scene.volume.bounds()
    sizes = [*(high - low) / 2 / extent, np.log10(extent) / 4, np.log10(radius / extent) / 4]
    return {
        "anchor_tokens": np.array(anchors), "tag_tokens": np.array(tags),
        "obstacle_tokens": np.array(boxes).reshape(-1, 6), "sizes": np.array(sizes),
    }  # fmt: skip


def test_tokens_are_those_of_the_drawn_scene_by_hand():
    """Padded and unpadded the same numbers; what is padded is zero."""
    shown = EstimatePose(gym.make(ID, scenes=MIXED, reward="none"), observation="tokens")
    plain = EstimatePose(gym.make(ID, scenes=MIXED, reward="none"))
    seen = set()
    for seed in range(14):
        got, info = shown.reset(seed=seed)
        told, _ = plain.reset(seed=seed)
        scene = scenes.get(json.loads(info["scene"]))
        for _ in range(scene.steps):
            action = shown.action_space.sample()
            got, told = shown.step(action)[0], plain.step(action)[0]
        assert shown.observation_space.contains(got)
        belief = plain._filter.belief(plain._state)
        want = by_hand(scene, told, belief)
        sizes = {"anchor": (6, 6), "tag": (6, 4), "obstacle": (3, 6)}
        for name, shape in sizes.items():
            rows = want[f"{name}_tokens"]
            padded = np.zeros(shape)
            padded[: len(rows)] = rows
            np.testing.assert_allclose(got[f"{name}_tokens"], padded, rtol=1e-5, atol=1e-5)
            np.testing.assert_array_equal(got[f"{name}_mask"], np.arange(shape[0]) < len(rows))
        np.testing.assert_allclose(got["body"][21:], want["sizes"], rtol=1e-5)
        alone = Seen({**told, "twist": told["twist"]}, belief, scene)
        np.testing.assert_array_equal(got["body"][:21], flat(alone)[:21])
        # The scene alone, without masks.
        m, n = scene.n_anchors, len(scene.tags)
        own = {"anchors": told["anchors"][:m], "links": told["links"][:m, :n]}
        own |= {"twist": told["twist"], "quality": told["quality"][:m]}
        unpadded = tokens(Seen(own, belief, scene), len(scene.obstacles))
        for key, value in unpadded.items():
            where = tuple(slice(size) for size in value.shape)
            np.testing.assert_allclose(got[key][where], value, rtol=1e-6, atol=1e-6)
        seen.add((scene.name, m, len(scene.obstacles)))
    assert len(seen) > 4


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("observation", ["tokens", nearest, many], ids=["tokens", "own", "dict"])
@pytest.mark.parametrize("worlds", [{"scenes": MIXED}, {"scene": {"name": "hall", "steps": 4}}])
def test_world_i_equals_the_scalar_environment(mode, observation, worlds):
    native: Any = VectorEstimatePose(
        TrackingVectorEnv(4, reward="none", autoreset_mode=mode, **worlds), observation=observation
    )
    scalar = lambda: EstimatePose(TrackingEnv(reward="none", **worlds), observation=observation)  # noqa: E731
    peer = peer_of(scalar, mode, 4, {})
    assert_steps_alike(native, peer, 9, 3, {"rtol": 2e-5, "atol": 2e-5})


@pytest.mark.parametrize("kind", TASKS)
@pytest.mark.parametrize("observation", ["dict", "tokens", PATH], ids=["dict", "tokens", "own"])
def test_tasks_show_what_is_asked_for(kind, observation):
    name, arguments = TASKS[kind]
    assert_contract(f"rbl_gym:RBL/{name}-v0", observation=observation, **arguments)


def test_the_racks_of_the_selection_stay_hidden_and_its_memory_is_shown():
    env = gym.make("rbl_gym:RBL/AnchorSelection-v0", observation="tokens")
    observation, _ = env.reset(seed=1)
    assert "obstacle_tokens" not in observation
    assert observation["anchor_tokens"].shape == (12, 8)
    assert not observation["anchor_tokens"][:, 6:].any()
    action = np.r_[np.ones(3), np.zeros(9)].astype(np.float32)
    observation, *_ = env.step(action)
    np.testing.assert_array_equal(observation["anchor_tokens"][:3, 7], 1.0)
    assert (np.abs(observation["anchor_tokens"][:3, 6]) > 0.9).all()


def test_base_stations_have_one_anchor():
    env = EstimatePose(BaseStationEnv(), observation="tokens")
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert observation["anchor_tokens"].shape == (1, 6)


# --- views of one's own -----------------------------------------------------------------------


def test_a_view_of_ones_own_sees_what_the_dict_has():
    env = EstimatePose(gym.make(ID, scene="hall", reward="none"), observation=PATH)
    plain = EstimatePose(gym.make(ID, scene="hall", reward="none"))
    got, told = env.reset(seed=1)[0], plain.reset(seed=1)[0]
    assert env.observation_space == spaces.Box(-1e9, 1e9, (2,), np.float32)
    gap = told["anchors"] - told["belief_translation"]
    want = [np.linalg.norm(gap, axis=1).min(), told["links"].sum()]
    np.testing.assert_allclose(got, want, rtol=1e-6)


def test_spaces_are_declared_or_found():
    found = EstimatePose(TrackingEnv("hall"), observation=many).observation_space
    assert isinstance(found, spaces.Dict)
    assert found["links"].dtype == np.int8
    assert found["place"].dtype == np.float32

    def declared(seen: Seen) -> np.ndarray:
        return seen.belief.translation / 100

    declared.space = spaces.Box(-1.0, 1.0, (3,), np.float64)  # pyrefly: ignore[missing-attribute]
    env = EstimatePose(TrackingEnv("hall"), observation=declared)
    assert env.observation_space is declared.space  # pyrefly: ignore[missing-attribute]
    assert env.reset(seed=1)[0].dtype == np.float64


def test_names_and_paths():
    assert [viewer_of(name).kind for name in OBSERVATIONS] == list(OBSERVATIONS)
    assert viewer_of(PATH).function is nearest


def test_looking_for_the_space_changes_no_episode():
    plain, own = TrackingEnv("hall"), TrackingEnv("hall")
    plain.reset(seed=4)
    own.reset(seed=4)
    EstimatePose(own, observation=nearest)
    assert_same(own.step(0), plain.step(0))
    assert_same(own.reset(), plain.reset())


@pytest.mark.parametrize(
    ("observation", "named"),
    [
        ("picture", "observation must be one of 'dict', 'flat', 'tokens', 'module:function'"),
        (3, "observation must be one of"),
        ("nowhere:view", "observation 'nowhere:view' cannot be imported"),
        (f"{__name__}:PATH", "must be callable"),
        (lambda seen: "text", "observation must return numbers"),
    ],
)
def test_wrong_views_are_named(observation, named):
    for env, wrapper in (
        (TrackingEnv("hall"), EstimatePose),
        (TrackingVectorEnv(2, "hall"), VectorEstimatePose),
    ):
        with pytest.raises(ValueError, match=named):
            wrapper(env, observation=observation)  # pyrefly: ignore[bad-argument-type]


def test_views_that_change_their_shape_or_are_not_finite_are_named():
    env = EstimatePose(TrackingEnv(scenes=MIXED), observation=odd)
    with pytest.raises(ValueError, match=r"observation must have shape \(\d,\), got \(\d,\)"):
        [env.reset(seed=seed) for seed in range(20)]
    env = EstimatePose(TrackingEnv("hall"), observation=lambda seen: np.array([np.inf]))
    with pytest.raises(ValueError, match="observation must hold finite numbers"):
        env.reset(seed=1)
    calls = iter([{"a": 1.0}, {"b": 1.0}])
    env = EstimatePose(TrackingEnv("hall"), observation=lambda seen: next(calls))
    with pytest.raises(ValueError, match="observation must return a dict with a"):
        env.reset(seed=1)


# --- filters by dicts -------------------------------------------------------------------------


def test_filters_are_named_by_dicts_too():
    def belief_of(**told):
        env = EstimatePose(TrackingEnv("hall"), **told)
        return env.reset(seed=2)[0]

    both = belief_of(filter="iekf", options={"robust": True})
    assert_same(belief_of(filter={"name": "iekf", "robust": True}), both)
    cases: list[tuple[str, dict[str, Any]]] = [
        ("MobileAnchors", {}),
        ("AnchorSelection", {}),
        ("SharedAnchors", {}),
        ("AnchorPlacement", {"reward": "filter", "scene": "drone_yard"}),
    ]
    for name, arguments in cases:
        for filter in ("uc-kf", {"name": "uc-kf"}, {"name": "iekf", "iterations": 3}):
            env = gym.make(f"rbl_gym:RBL/{name}-v0", filter=filter, **arguments)
            assert_same(of_its_spec(env).reset(seed=1), env.reset(seed=1))
            gym.make_vec(f"rbl_gym:RBL/{name}-v0", num_envs=2, filter=filter, **arguments)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"filter": {"iterations": 2}}, "filter must be a name, or a dict with the key 'name'"),
        ({"filter": {"name": "iekf"}, "options": {}}, "options must be None if filter is a dict"),
        ({"filter": {"name": "gold"}}, "filter must be one of"),
        ({"filter": {"name": "iekf", "wings": 2}}, "wings"),
    ],
)
def test_wrong_filters_are_named(arguments, named):
    with pytest.raises((ValueError, TypeError), match=named):
        EstimatePose(TrackingEnv("hall"), **arguments)
