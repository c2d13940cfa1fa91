"""EstimatePose against a filter driven by hand; its consistency, specs and errors."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, RecordEpisodeStatistics, TimeLimit
from scipy.spatial.transform import Rotation

from rbl_gym import estimators
from rbl_gym.measurements.ranging import LinkNoise
from rbl_gym.worlds import scene_bounds
from rbl_gym.worlds.scenes import SCENES
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from tests.helpers import assert_same, score_by_hand
from tests.side_by_side import episode

ID = "rbl_gym:RBL/Tracking-v0"
NAMES = list(SCENES)
KALMAN = ["kf", "uc-kf", "et-kf", "kf-ortho"]
# The KF family needs anchors and tags that are not coplanar; the buoys float on one plane.
SPATIAL = ["uwb_room", "drone_yard", "satellite", "camsap2013"]
LOSSY = {"drop_probability": 0.3}
BELIEF = ("belief_rotation", "belief_translation", "belief_covariance")


def short(name: str, steps: int = 12, **fields: Any) -> dict[str, Any]:
    return {"name": name, "steps": steps, **fields}


def raw(scene: Any, **options: Any) -> gym.Env:
    return gym.make(ID, scene=scene, **options)


def wrapped(scene: Any, filter: str = "iekf", **arguments: Any) -> EstimatePose:
    return EstimatePose(raw(scene), filter, **arguments)


# --- the filter by hand -----------------------------------------------------------------------


@pytest.mark.parametrize("links", [{}, LOSSY], ids=["all links", "lost links"])
@pytest.mark.parametrize(
    ("name", "filter", "options"),
    [
        *((name, "iekf", {}) for name in NAMES),
        ("uwb_room", "iekf", {"robust": True, "iterations": 2}),
        ("hall", "kf", {}),
        ("uwb_room", "uc-kf", {"coupled": True}),
        ("satellite", "et-kf", {"threshold": 0.01}),
        ("drone_yard", "kf", {"engine": "filterpy", "sigma_q_scale": 0.8}),
    ],
)
def test_wrapped_rollout_equals_driving_the_filter_by_hand(name, filter, options, links):
    scene = short(name, 8, links=links)
    env = raw(scene, reward="none")
    world: Any = env.unwrapped
    hand = estimators.make(
        filter, tags=world.scene.tags, noise=world.scene.noise, process=world.scene.process,
        **options,
    )  # fmt: skip
    runs = {
        reward: episode(wrapped(scene, filter, options=options, reward=reward), 1)
        for reward in ("belief", "error")
    }
    tags = np.array(world.scene.tags)
    state = None
    for k, result in enumerate(episode(env, 1)):
        seen, info = result[0], result[-1]
        if state is None:
            prior = info["prior_rotation"], info["prior_translation"], info["prior_covariance"]
            state = hand.initial(*prior)
        else:
            state = hand.predict(state, seen["twist"], world.scene.dt)
        if "quality" in seen:
            variance = world.scene.noise.variance(seen["ranges"])
            noise = LinkNoise(np.sqrt(variance / seen["quality"][:, None]))
            hand = dataclasses.replace(hand, noise=noise)  # pyrefly: ignore[bad-specialization]
        state = hand.update(state, seen["ranges"], seen["anchors"], seen["links"])
        belief = hand.belief(state)
        b = score_by_hand(belief.covariance, belief.rotation, tags)
        estimated = tags @ belief.rotation.T + belief.translation
        true = tags @ info["rotation"].T + info["translation"]
        error = np.mean(np.sum((estimated - true) ** 2, axis=1)) ** 0.5
        w = Rotation.from_matrix(belief.rotation @ info["rotation"].T).as_rotvec()
        e = np.concatenate([w, belief.translation - info["translation"]])
        for reward, steps in runs.items():
            got, told = steps[k][0], steps[k][-1]
            # The wrapper says None where all links measured, which may turn the last bits.
            for key, want in zip(BELIEF, belief[:3], strict=True):
                np.testing.assert_allclose(got[key], want, rtol=1e-9, atol=1e-9)
            for key, want in seen.items():
                np.testing.assert_array_equal(got[key], want)
            assert told["score_m"] == pytest.approx(b, rel=1e-9)
            assert told["tag_error_m"] == pytest.approx(error, rel=1e-7, abs=1e-12)
            assert told["rotation_error_rad"] == pytest.approx(np.linalg.norm(w), abs=1e-7)
            assert told["position_error_m"] == pytest.approx(np.linalg.norm(e[3:]), rel=1e-9)
            nees = e @ np.linalg.inv(belief.covariance) @ e
            assert told["nees"] == pytest.approx(nees, rel=1e-4)
            if k > 0:
                want = -np.log(b) if reward == "belief" else -error
                assert steps[k][1] == pytest.approx(want, rel=1e-7, abs=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_what_the_environment_says_passes_through(name):
    got = episode(wrapped(short(name)), 2)
    want = episode(raw(short(name), reward="none"), 2)
    for a, b in zip(got, want, strict=True):
        assert_same({key: a[-1][key] for key in b[-1]}, b[-1])
        assert a[2:-1] == b[2:-1]


class Watched(gym.Wrapper):
    """Keeps what passes through it, as statistics and videos below a wrapper do."""

    def __init__(self, env):
        super().__init__(env)
        self.seen = []

    def reset(self, **arguments):
        result = self.env.reset(**arguments)
        self.seen.append(result)
        return result

    def step(self, action):
        result = self.env.step(action)
        self.seen.append(result)
        return result


@pytest.mark.parametrize("reward", ["bound", "none"])
@pytest.mark.parametrize("name", ["uwb_room", "hall", "satellite"])
def test_wrappers_below_see_the_environment_as_it_is(name, reward):
    want = episode(raw(short(name), reward=reward), 2)
    below = Watched(raw(short(name), reward=reward))
    above = episode(EstimatePose(below), 2)
    for got, mine, plain in zip(below.seen, above, want, strict=True):
        assert got[1:-1] == plain[1 : len(got) - 1]
        assert_same(got[0], plain[0])
        assert_same(got[-1], plain[-1])
        assert mine[-1].get("bound_m") == plain[-1].get("score_m")
    if reward == "bound":
        assert sum(step[1] for step in below.seen[1:]) != 0


def test_without_a_reward_of_the_environment_no_bound_is_computed(monkeypatch):
    def refuse(*_: Any) -> None:
        raise AssertionError("the bound was computed")

    monkeypatch.setattr(scene_bounds, "posterior_step", refuse)
    with pytest.raises(AssertionError, match="the bound"):
        wrapped(short("uwb_room")).reset(seed=0)
    assert len(episode(EstimatePose(raw(short("uwb_room"), reward="none")))) == 13


@pytest.mark.parametrize("name", NAMES)
def test_iekf_is_consistent(name):
    """The mean NEES is 6 within 4 standard deviations of the mean over independent episodes.

    Errors within an episode are correlated in time, episodes are not: the standard deviation
    comes from the spread of the episodes' means, over the root of their number.
    """
    worlds, steps = 200, min(SCENES[name].steps, 20)
    envs = VectorEstimatePose(gym.make_vec(ID, num_envs=worlds, scene=short(name, steps)), "iekf")
    envs.action_space.seed(0)
    seen = [envs.reset(seed=0)[1]["nees"]]
    seen += [envs.step(envs.action_space.sample())[4]["nees"] for _ in range(steps)]
    means = np.mean(seen, axis=0)
    deviation = means.std(ddof=1) / worlds**0.5
    assert abs(means.mean() - 6) < 4 * deviation
    assert deviation < 1.2 * (12 / worlds) ** 0.5  # or the test would say nothing


@pytest.mark.parametrize("name", SPATIAL)
@pytest.mark.parametrize("filter", KALMAN)
def test_kalman_family_tracks(filter, name):
    """Real errors at the end of an episode below half the initial ones, the prior's."""
    steps = min(SCENES[name].steps, 40)
    env = wrapped(short(name, steps), filter, reward="error" if filter == "kf" else "belief")
    scene = SCENES[name]
    results = episode(env, 3)
    assert len(results) == steps + 1
    start = score_by_hand(scene.prior_covariance, np.eye(3), np.array(scene.tags))
    last = [result[-1]["tag_error_m"] for result in results[-5:]]
    assert np.mean(last) < start / 2
    for result in results[1:]:
        assert type(result[1]) is float
        assert np.isfinite(result[1])
        turn = result[0]["belief_rotation"]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(turn) > 0


# --- specs, pickles, memory -------------------------------------------------------------------


def test_spec_keeps_the_options_as_they_were():
    options = {"robust": True}
    env = wrapped("uwb_room", options=options)
    options["robust"] = False
    assert env.spec is not None
    kwargs = env.spec.additional_wrappers[-1].kwargs
    assert kwargs is not None
    assert kwargs["options"] == {"robust": True}


# --- observations -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_flat_observation_is_float32_and_in_its_space(name):
    env = wrapped(name, observation="flat")
    size = 21 + 4 * SCENES[name].n_anchors
    assert env.observation_space == spaces.Box(-10.0, 10.0, (size,), np.float32)
    for result in episode(env, 9):
        assert result[0].dtype == np.float32
        assert env.observation_space.contains(result[0])


@pytest.mark.parametrize("name", ["uwb_room", "drone_yard", "auv_buoys", "satellite"])
def test_flat_observation_is_of_order_one(name):
    """What a policy reads is neither cut nor vanishing: at most 1 % of the numbers at the cut."""
    flat = np.stack([result[0] for result in episode(wrapped(name, observation="flat"), 10)])
    assert (np.abs(flat) == 10.0).mean() < 0.01
    assert 0.1 < np.sqrt(np.mean(flat**2)) < 5


def test_meaning_of_the_flat_observation_checked_by_hand():
    scene = SCENES["auv_buoys"]
    _, full = episode(wrapped("auv_buoys"), 11, steps=1)
    _, flat = episode(wrapped("auv_buoys", observation="flat"), 11, steps=1)
    seen, got = full[0], flat[0]
    rotation, place = seen["belief_rotation"], seen["belief_translation"]
    # Volume +-150, +-150, -80 to -20; anchors +-200 at z = 0: the box around both has the
    # half diagonal of 400 x 400 x 80.
    extent = np.linalg.norm([400, 400, 80]) / 2
    want = list((place - [0, 0, -50]) / [150, 150, 30])
    want += list(seen["twist"][:3] / (np.pi / 10))  # dt = 1 s
    want += list(seen["twist"][3:] / 1.5)
    want += [np.log(seen["belief_covariance"][i, i] ** 0.5) for i in range(6)]
    want += [*rotation[:, 0], *rotation[:, 1]]
    for m in range(scene.n_anchors):
        want += list((seen["anchors"][m] - place) / extent)
    for m in range(scene.n_anchors):
        want.append(np.log(np.linalg.norm(seen["anchors"][m] - place) / extent))
    assert max(map(abs, want)) < 10
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


# --- what it refuses --------------------------------------------------------------------------


def test_a_belief_that_is_a_plain_tuple_names_the_filter():
    message = r"belief of the filter Tuples must return .*PoseBelief\(.*, got a tuple of 3"
    env = EstimatePose(gym.make(ID, reward="none"), "tests.fragile:Tuples")
    with pytest.raises(TypeError, match=message):
        env.reset(seed=0)
    envs = VectorEstimatePose(gym.make_vec(ID, num_envs=2), "tests.fragile:Tuples")
    with pytest.raises(TypeError, match=message):
        envs.reset(seed=0)


def test_environment_of_another_kind_is_named():
    with pytest.raises(ValueError, match=r"env must be RBL/Tracking-v0 or another.*CartPole"):
        EstimatePose(gym.make("CartPole-v1"))


def test_environment_that_hides_its_measurements_is_named():
    with pytest.raises(ValueError, match=r"env must observe ranges, links, anchors.*Box\("):
        EstimatePose(FlattenObservation(raw("uwb_room")))


def test_a_task_with_its_own_filter_needs_no_wrapper():
    for name in ("MobileAnchors", "AnchorSelection"):
        env = gym.make(f"rbl_gym:RBL/{name}-v0")
        message = f"must not run a filter already, got {name}Env: .*pass filter=.* to gym.make"
        with pytest.raises(ValueError, match=message):
            EstimatePose(env)
        envs = gym.make_vec(f"rbl_gym:RBL/{name}-v0", num_envs=2)
        with pytest.raises(ValueError, match="must not run a filter already"):
            VectorEstimatePose(envs)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"filter": "ekf"}, "filter must be one of .*uc-kf.*, got 'ekf'"),
        ({"filter": ""}, "filter must be one of"),
        ({"filter": None}, "filter must be one of .*, got None"),
        ({"options": {"iteration": 3}}, "no option 'iteration'; its options are iterations"),
        ({"filter": "kf", "options": {"robust": True}}, "'kf' has no option 'robust'"),
        ({"filter": "kf/robust=true"}, "'kf' has no option 'robust'"),
        ({"filter": "iekf/robust=true", "options": {"robust": True}}, "option 'robust' twice"),
        ({"options": {"iterations": 0}}, "iterations"),
        ({"options": {"iterations": "many"}}, "iterations.*many"),
        ({"filter": "kf", "options": {"engine": "steam"}}, "engine must be one of .*'steam'"),
        ({"filter": "et-kf", "options": {"threshold": -1}}, "threshold"),
        ({"reward": "bound"}, "reward must be one of 'belief', 'error', .*, got 'bound'"),
        ({"reward": None}, "reward must be one of 'belief', 'error', .*, got None"),
        (
            {"observation": "image"},
            "observation must be one of 'dict', 'flat', 'tokens', .* got 'image'",
        ),
    ],
    ids=str,
)
def test_wrong_argument_is_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        EstimatePose(raw("uwb_room"), **arguments)


def test_coplanar_anchors_are_refused_by_the_linear_filters_where_the_prior_is_vague():
    env = wrapped({"name": "auv_buoys", "initial_rotation_rad": 2.0}, "kf")
    with pytest.raises(ValueError, match="rank"):
        env.reset(seed=0)


# --- with other wrappers ----------------------------------------------------------------------


def test_time_limit_around_it():
    env = TimeLimit(wrapped("uwb_room", observation="flat"), max_episode_steps=5)
    assert len(episode(env)) == 6


def test_time_limit_inside_it():
    env = EstimatePose(raw("uwb_room", max_episode_steps=5))
    assert len(episode(env)) == 6


def test_episode_statistics_sum_its_reward():
    env = RecordEpisodeStatistics(wrapped(short("drone_yard"), reward="error"))
    results = episode(env, 12)
    told = results[-1][-1]["episode"]
    assert told["l"] == 12
    assert told["r"] == pytest.approx(-sum(r[-1]["tag_error_m"] for r in results[1:]), rel=1e-5)
