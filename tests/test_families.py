"""Families of scenes: the draws, and environments that draw a world at every reset."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import seeding

from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.envs.tracking_vector import TrackingVectorEnv
from rbl_gym.worlds import scenes
from rbl_gym.worlds.families import SceneFamily, family
from rbl_gym.wrappers import EstimatePose, SelectAnchors, VectorEstimatePose
from tests.side_by_side import episode
from tests.test_tracking_env import ID

ROOM: dict[str, Any] = {
    "name": "uwb_room",
    "n_anchors": {"integers": [3, 8]},
    "noise": {"floor_m": {"log-uniform": [0.02, 0.5]}},
    "links": {"drop_probability": {"uniform": [0.0, 0.3]}},
    "steps": 6,
}
YARD: dict[str, Any] = {"name": {"choice": ["drone_yard", "satellite"]}, "steps": 4}
MIXED = [{"name": "hall", "steps": 5}, ROOM, YARD]


def draws(value: Any, count: int = 400, seed: int = 1):
    rng = np.random.default_rng(seed)
    return [family(value).draw(rng) for _ in range(count)]


def test_laws_draw_what_they_say():
    drawn = [overrides for _, overrides in draws(ROOM)]
    counts = np.bincount([one["n_anchors"] for one in drawn], minlength=9)
    assert set(np.flatnonzero(counts)) == {3, 4, 5, 6, 7, 8}
    # 400 draws of six: 67 each, standard deviation 7.5.
    assert (np.abs(counts[3:] - 400 / 6) < 4.5 * 7.5).all()
    floor = np.log([one["noise"]["floor_m"] for one in drawn])
    low, high = np.log([0.02, 0.5])
    assert low <= floor.min() < floor.max() <= high
    # Uniform of the logarithm: the mean within 4.5 standard deviations.
    assert abs(floor.mean() - 0.5 * (low + high)) < 4.5 * (high - low) / np.sqrt(12 * 400)
    drop = np.array([one["links"]["drop_probability"] for one in drawn])
    assert 0 <= drop.min() < 0.05
    assert 0.25 < drop.max() <= 0.3


def test_members_and_choices_are_equally_likely():
    names = [scene.name for scene, _ in draws(MIXED, 600)]
    counts = {name: names.count(name) for name in set(names)}
    assert set(counts) == {"hall", "uwb_room", "drone_yard", "satellite"}
    assert abs(counts["uwb_room"] - 200) < 4.5 * np.sqrt(600 * 2 / 9)
    assert abs(counts["satellite"] - 100) < 4.5 * np.sqrt(600 * 5 / 36)


def test_the_overrides_make_the_scene_again():
    for scene, overrides in draws(MIXED, 30):
        again = scenes.get(json.loads(json.dumps(overrides)))
        assert again == scene


def test_sizes_are_those_of_the_largest():
    found = family(MIXED)
    assert (found.n_anchors, found.n_tags, found.steps) == (12, 6, 6)
    assert found.anchor_speed_m_s == scenes.get("satellite").anchor_speed_m_s


def test_one_scene_is_a_family_too():
    assert family("hall").draw(np.random.default_rng(1))[0] == scenes.get("hall")
    assert family(scenes.get("hall")).n_anchors == 12
    assert family(family(ROOM)).n_anchors == 8


@pytest.mark.parametrize(
    ("value", "named"),
    [
        ([], "scenes must hold at least one scene"),
        (3, "scenes must be a list of scenes, a name or a dict of changes, got 3"),
        (["castle"], r"scenes\[0\]: scene must be one of"),
        (["hall", {"name": "hall", "weight": 1}], r"scenes\[1\]: scene has no field 'weight'"),
        ({"name": "hall", "dt": {"uniform": [2.0, 1.0]}}, r"dt.uniform must be \[low, high\]"),
        ({"name": "hall", "dt": {"uniform": [1.0]}}, r"scenes\[0\].dt.uniform must have shape"),
        ({"name": "hall", "dt": {"log-uniform": [0.0, 1.0]}}, "dt.log-uniform"),
        ({"name": "hall", "n_anchors": {"integers": [3, 4.5]}}, "must be two whole numbers"),
        ({"name": "hall", "n_anchors": {"integer": [3, 4]}}, r"repeat; did you mean 'integers'\?"),
        (
            {"name": "hall", "n_anchors": {"integers": [4, 3]}},
            r"high\] with low at most high",
        ),
        ({"name": {"choice": []}}, "name.choice must be a list of values"),
        ({"name": {"choice": "hall"}}, "name.choice must be a list of values"),
        ({"name": "hall", "n_anchors": {"integers": [0, 4]}}, "n_anchors"),
        (
            {"name": "hall", "tags": {"repeat": 3}},
            "repeat must be a dict with the keys count and of, got 3",
        ),
        (
            {"name": "hall", "tags": {"repeat": {"count": [1, 2, 3], "of": [0, 0, 0]}}},
            r"repeat.count must be a number or \[low, high\]",
        ),
        ({"name": "hall", "anchors": [[0, 0, {"uniform": [2, 1]}]]}, r"anchors\[0\]\[2\].uniform"),
        ({"name": "hall", "inertial": "consumer"}, "scenes must have no inertial sensor"),
    ],
)
def test_wrong_families_are_named(value, named):
    with pytest.raises(ValueError, match=named):
        family(value)


RACKS = {
    "name": "hall",
    "stretch": [{"uniform": [0.6, 1.4]}, {"uniform": [0.6, 1.4]}, 1.0],
    "obstacles": {
        "repeat": {
            "count": [0, 5],
            "of": {
                "choice": [
                    [{"uniform": [-15, 15]}, {"uniform": [-7, 7]}, 1.5, 0.5, 3.0, 1.5],
                    [{"uniform": [-15, 15]}, {"uniform": [-7, 7]}, 1.5, 3.0, 0.5, 1.5],
                ]
            },
        }
    },
    "steps": 5,
}


def test_lists_choices_and_copies_hold_laws():
    drawn = draws(RACKS)
    counts = np.bincount([len(overrides["obstacles"]) for _, overrides in drawn], minlength=6)
    # 400 draws of six.
    assert (np.abs(counts - 400 / 6) < 4.5 * 7.5).all()
    boxes = np.concatenate([o["obstacles"] for _, o in drawn if o["obstacles"]])
    assert (np.abs(boxes[:, :2]) <= [15, 7]).all()
    assert (np.ptp(boxes[:, :2], axis=0) > [28, 13]).all()
    long_in_x = boxes[:, 3] == 3.0
    assert abs(long_in_x.mean() - 0.5) < 4.5 * 0.5 / np.sqrt(len(boxes))
    assert family(RACKS).n_boxes == 5
    assert len(family(RACKS).corners) == 4


def test_a_stretched_scene_has_its_places_multiplied():
    factors = np.array([1.5, 0.5, 2.0])
    plain, long = scenes.get("hall"), scenes.get({"name": "hall", "stretch": factors.tolist()})
    for name in ("volume", "anchor_region"):
        got, want = getattr(long, name).bounds(), getattr(plain, name).bounds()
        np.testing.assert_allclose(got, np.array(want) * factors)
    assert long.anchors is not None
    np.testing.assert_allclose(long.anchors, np.array(plain.anchors) * factors)
    np.testing.assert_allclose(long.obstacles, np.array(plain.obstacles) * np.tile(factors, 2))
    assert long.tags == plain.tags
    # Anchors on the walls stay on them.
    anchors = np.array(long.anchors)
    np.testing.assert_allclose(long.anchor_region.project(anchors), anchors, atol=1e-9)


@pytest.mark.parametrize(
    ("scene", "named"),
    [
        ({"name": "hall", "stretch": [1.0, 0.0, 1.0]}, "stretch must be three positive numbers"),
        ({"name": "hall", "stretch": 2.0}, "scene.stretch must have shape"),
        ({"name": "satellite", "stretch": [1, 1, 2]}, "stretch scales boxes and walls only"),
    ],
)
def test_what_cannot_be_stretched_is_named(scene, named):
    with pytest.raises(ValueError, match=named):
        scenes.get(scene)


def test_too_many_combinations_are_refused():
    choices = {"choice": list(range(1, 102))}
    with pytest.raises(ValueError, match="at most 10000 combinations of choices, got 10201"):
        SceneFamily(({"name": "hall", "steps": choices, "n_anchors": choices},))


# --- environments -----------------------------------------------------------------------------


def test_an_episode_equals_that_of_its_scene_alone():
    """The scene is drawn first; what follows is the scene's own episode, in larger arrays."""
    seen = set()
    for seed in range(12):
        env = gym.make(ID, scenes=MIXED)
        results = episode(env, seed)
        scene = env.unwrapped.scene  # pyrefly: ignore[missing-attribute]
        seen.add(scene.name)
        alone = TrackingEnv(scene)
        generator, _ = seeding.np_random(seed)
        family(MIXED).draw(generator)
        alone.np_random = generator
        want: list[Any] = [alone.reset()]
        env.action_space.seed(seed)
        for _ in results[1:]:
            action = env.action_space.sample()
            own = action[: 3 * scene.n_anchors] if scene.anchor_speed_m_s > 0 else 0
            want.append(alone.step(own))
        m, n = scene.n_anchors, len(scene.tags)
        assert len(results) == scene.steps + 1
        for got, plain in zip(results, want, strict=True):
            told = got[0]
            np.testing.assert_array_equal(told["ranges"][:m, :n], plain[0]["ranges"])
            np.testing.assert_array_equal(told["links"][:m, :n], plain[0]["links"])
            np.testing.assert_array_equal(told["anchors"][:m], plain[0]["anchors"])
            assert told["links"].sum() == plain[0]["links"].sum()
            assert told["anchor_mask"].sum() == m
            assert told["tag_mask"].sum() == n
            np.testing.assert_array_equal(told["tags"][:n], scene.body)
            if len(plain) == 5:
                assert got[1] == plain[1]
        assert json.loads(results[0][-1]["scene"])["name"] == scene.name
    assert len(seen) > 2


@pytest.mark.parametrize("observation", ["dict", "flat"])
def test_filters_run_in_drawn_worlds_and_are_honest(observation):
    env = EstimatePose(gym.make(ID, scenes=MIXED, reward="none"), observation=observation)
    nees = [step[-1]["nees"] for seed in range(40) for step in episode(env, seed)]
    # About 220 epochs of 6 degrees of freedom, correlated within 40 episodes.
    assert 4.5 < np.mean(nees) < 7.5


def test_a_filter_has_no_more_than_the_scene_alone():
    env = EstimatePose(gym.make(ID, scenes=MIXED, reward="none"))
    results = episode(env, 3)
    scene = env.unwrapped.scene  # pyrefly: ignore[missing-attribute]
    plain = EstimatePose(TrackingEnv(scene, "none"))
    filter = plain._filter
    info = results[0][-1]
    state = filter.initial(
        info["prior_rotation"], info["prior_translation"], info["prior_covariance"]
    )
    m, n = scene.n_anchors, len(scene.tags)
    for k, (told, *_) in enumerate(results):
        if k:
            state = filter.predict(state, told["twist"], scene.dt)
        assert not scene.obstacles
        links = told["links"][:m, :n].astype(bool)
        state = filter.update(state, told["ranges"][:m, :n], told["anchors"][:m], links)
        belief = filter.belief(state)
        np.testing.assert_allclose(told["belief_covariance"], belief.covariance, rtol=1e-9)


def test_masks_stand_at_the_end_of_a_flat_observation():
    env = EstimatePose(gym.make(ID, scenes=MIXED, reward="none"), observation="flat")
    for seed in range(6):
        flat, _ = env.reset(seed=seed)
        m = env.unwrapped.scene.n_anchors  # pyrefly: ignore[missing-attribute]
        np.testing.assert_array_equal(flat[-12:], np.arange(12) < m)
        # Relative places and distances of anchors that are not there.
        assert not flat[21 + 3 * m : 21 + 36].any()
        assert not flat[21 + 36 + m : 21 + 48].any()


def test_anchors_can_be_selected():
    env = EstimatePose(SelectAnchors(gym.make(ID, scenes=["hall", ROOM], reward="none")))
    env.reset(seed=2)
    observation, *_ = env.step(np.r_[1, 1, np.zeros(10)].astype(np.int8))
    assert set(np.flatnonzero(observation["links"].any(axis=1))) <= {0, 1}


def test_frames_are_those_of_the_drawn_scene():
    env: Any = gym.make(ID, scenes=MIXED, reward="none", render_mode="rgb_array")
    for seed in range(2):
        env.reset(seed=seed)
        assert np.shape(env.render()) == (540, 960, 3)


def test_scene_beside_scenes_is_refused():
    with pytest.raises(ValueError, match="scene must be left out if scenes is given, got 'hall'"):
        gym.make(ID, scene="hall", scenes=MIXED)


# --- many worlds ------------------------------------------------------------------------------

VARIED = [
    {"name": "hall", "steps": 5, "blocked_information": {"choice": [0.0, 0.1]}},
    {**ROOM, "links": {"drop_probability": 0.2, "nlos_probability": {"uniform": [0.0, 0.2]}}},
    {"name": "icassp2013", "steps": 3},
    {"name": "camsap2013", "steps": 4},
    {"name": "auv_craft", "steps": 6, "n_anchors": {"integers": [2, 5]}},
    {"name": "satellite", "steps": 4, "links": {"reach_m": 120.0}},
]


def test_every_reset_draws_anew_and_says_so():
    envs = gym.make_vec(ID, num_envs=6, scenes=[ROOM], reward="none")
    _, info = envs.reset(seed=1)
    first = [json.loads(one)["noise"]["floor_m"] for one in info["scene"]]
    for _ in range(7):
        *_, info = envs.step(np.zeros(6, int))
    assert info["_scene"].all()
    again = [json.loads(one)["noise"]["floor_m"] for one in info["scene"]]
    assert len({*first, *again}) == 12


def test_frames_of_many_worlds_equal_those_of_each():
    native = VectorEstimatePose(TrackingVectorEnv(2, scenes=MIXED, render_mode="rgb_array"))
    native.reset(seed=4)
    frames: Any = native.render()
    for world in range(2):
        alone = EstimatePose(TrackingEnv(scenes=MIXED, render_mode="rgb_array"))
        alone.reset(seed=4 + world)
        assert (np.abs(frames[world].astype(int) - alone.render()) > 8).mean() < 1e-3


# --- tasks ------------------------------------------------------------------------------------

CRAFT = [{"name": "auv_craft", "n_anchors": {"integers": [2, 5]}, "steps": 5}]
STILL = {"name": "hall", "anchor_speed_m_s": 0.0}
HALLS = [
    {"name": "hall", "steps": 4},
    {
        "name": "hall",
        "n_anchors": 7,
        "steps": 3,
        "obstacles": {"choice": [[], [[0, 0, 2, 1, 1, 2]]]},
    },
]
TASKS = [
    ("RBL/MobileAnchors-v0", {"scenes": CRAFT, "difficulty": "hard"}),
    ("RBL/MobileAnchors-v0", {"scenes": CRAFT, "sort_craft": False, "reward": "error"}),
    ("RBL/AnchorSelection-v0", {"scenes": HALLS}),
    ("RBL/AnchorSelection-v0", {"scenes": [RACKS, *HALLS]}),
    ("RBL/AnchorSelection-v0", {"scenes": HALLS, "mode": "priced", "reward": "error"}),
]


def test_craft_that_are_not_there_are_zeros():
    env: Any = gym.make("rbl_gym:RBL/MobileAnchors-v0", scenes=CRAFT)
    seen = set()
    for seed in range(12):
        flat, info = env.reset(seed=seed)
        m = json.loads(info["scene"])["n_anchors"]
        seen.add(m)
        np.testing.assert_array_equal(flat[31:], np.arange(5) < m)
        assert flat[30] == np.float32(0.8)
        assert flat[15 : 15 + 2 * m].all()
        assert not flat[15 + 2 * m : 25].any()
        assert not flat[25 + m : 30].any()
        alone: Any = gym.make(
            "rbl_gym:RBL/MobileAnchors-v0", scene={**CRAFT[0], "n_anchors": m}
        ).unwrapped
        # The same view of the same belief and craft.
        told = {
            **env.unwrapped.inner_observation,
            "anchors": env.unwrapped.inner_observation["anchors"][:m],
        }
        told.pop("anchor_mask")
        own = alone._task_view(told, alone.scene)
        np.testing.assert_array_equal(flat[15 : 15 + 2 * m], own[15 : 15 + 2 * m])
        np.testing.assert_array_equal(flat[25 : 25 + m], own[15 + 2 * m :])
    assert seen == {2, 3, 4, 5}


def test_the_selection_shows_the_drawn_hall_and_what_was_learned():
    """Every entry by hand, from the scene that the infos name."""
    env: Any = gym.make("rbl_gym:RBL/AnchorSelection-v0", scenes=[RACKS, *HALLS])
    extent = max(float(scene.scales.extent) for scene in env.unwrapped.family.corners)
    rng, counts = np.random.default_rng(1), set()
    for seed in range(8):
        flat, info = env.reset(seed=seed)
        scene = scenes.get(json.loads(info["scene"]))
        m, told, age = scene.n_anchors, np.zeros(12), np.full(12, np.inf)
        counts.add(m)
        low, high = scene.volume.bounds()
        for _ in range(scene.steps):
            flat, *_, info = env.step(rng.uniform(-1, 1, 12).astype(np.float32))
            seen = env.unwrapped.inner_observation
            age += 1
            for k in np.flatnonzero(info["chosen"]):
                assert k < m
                quality = seen["quality"][k] if "quality" in seen else 1.0
                told[k] = 2 * quality * seen["links"][k].any() - 1
                age[k] = 0
            place = seen["belief_translation"]
            gap = np.zeros((12, 3))
            gap[:m] = (seen["anchors"][:m] - place) / extent
            want = [
                (place - (low + high) / 2) / ((high - low) / 2), flat[3:18],
                (high - low) / 2 / extent, gap.ravel(), told, np.exp(-age / 10), np.arange(12) < m,
            ]  # fmt: skip
            np.testing.assert_allclose(flat, np.concatenate(want), rtol=2e-6, atol=1e-6)
    assert counts == {7, 12}


@pytest.mark.parametrize(
    ("name", "arguments", "named"),
    [
        ("MobileAnchors", {"scenes": [STILL]}, "scene must have moving anchors"),
        (
            "MobileAnchors",
            {"scenes": CRAFT, "scene": "hall"},
            "scene must be left out if scenes is given",
        ),
        ("AnchorSelection", {"scenes": HALLS, "k": 8}, "k must be .* 7, got 8"),
    ],
)
def test_what_does_not_do_for_a_task_is_named(name, arguments, named):
    with pytest.raises(ValueError, match=named):
        gym.make(f"rbl_gym:RBL/{name}-v0", **arguments)


def test_filters_whose_states_differ_in_size_go_one_by_one():
    envs: Any = gym.make_vec(
        "rbl_gym:RBL/MobileAnchors-v0", num_envs=4, scenes=CRAFT, filter="iekf-bias"
    )
    with pytest.raises(ValueError, match=r"states of the same shape .* vectorization_mode='sync'"):
        envs.reset(seed=5)
