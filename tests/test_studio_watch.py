"""Frames of filters at work, without a browser."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import placement, recordings
from rbl_gym.placement import scene_files
from rbl_gym.studies import replay
from rbl_gym.studies.learning import policies, rollouts
from rbl_gym.studies.learning.evaluation import layouts_of
from rbl_gym.studies.learning.rl_tasks import rl_task
from rbl_gym.studies.watching.frames import (
    LINKS,
    Frame,
    Links,
    Named,
    Pose,
    Tracked,
    filter_named,
    link_kinds,
)
from rbl_gym.studies.watching.learned import learned_frames, learned_program, played_program
from rbl_gym.studies.watching.live import (
    CALM,
    Disturbances,
    Stage,
    frames,
    stage_of_problem,
    stage_of_scene,
)
from rbl_gym.studies.watching.played import env_frames
from rbl_gym.studies.watching.recorded import recorded_frames, track_all
from rbl_gym.worlds import scenes
from rbl_gym.wrappers import EstimatePose, controllers
from tests.helpers import ROOT

ROOM = stage_of_scene(scenes.get("uwb_room"), 80)
BOTH = [filter_named("iekf"), Named("iekf/robust=true", "iekf", {"robust": True})]
# Disturbances set in here, and have settled so many epochs later.
SET_IN, SETTLED = 30, 40


def played(seed: int = 3, stage: Stage = ROOM, **disturbances: float) -> list[Frame]:
    now = Disturbances(**disturbances)
    return [*frames(stage, BOTH, seed, lambda epoch: now if epoch >= SET_IN else CALM)]


def rms(run: list[Frame], which: int, start: int = SETTLED) -> float:
    """Of the position error."""
    return float(np.sqrt(np.mean([f.tracks[which].position_m ** 2 for f in run[start:]])))


def nis(run: list[Frame], which: int, start: int = SETTLED) -> float:
    """Mean per degree of freedom."""
    return float(np.mean([f.tracks[which].nis_ratio for f in run[start:]]))


@pytest.fixture(scope="module")
def calm() -> list[Frame]:
    return played()


def truth_of(frame: Frame) -> Pose:
    assert frame.truth is not None
    return frame.truth


def arrays(frame: Frame) -> list[Any]:
    tracks: tuple[Tracked, ...] = frame.tracks
    beliefs = [field for track in tracks for field in track.belief]
    return [*truth_of(frame), frame.told, *frame.links, *beliefs, *(t.rejected for t in tracks)]


def test_the_same_seed_gives_the_same_frames_and_another_one_others(calm):
    again, other = played(nlos=0.1), played(seed=4)
    for one, two in zip(calm[:SET_IN], again[:SET_IN], strict=True):
        for a, b in zip(arrays(one), arrays(two), strict=True):
            np.testing.assert_array_equal(a, b)
    assert len(calm) == len(again) == 81
    # Disturbances change no truth.
    np.testing.assert_array_equal(truth_of(calm[-1]).translation, truth_of(again[-1]).translation)
    assert not np.allclose(truth_of(calm[0]).translation, truth_of(other[0]).translation)


def test_an_undisturbed_run_is_the_episode_of_the_environment_and_its_filter(calm):
    env = EstimatePose(
        gym.make("rbl_gym:RBL/Tracking-v0", scene={"name": "uwb_room", "steps": 80}), "iekf"
    )
    observation, info = env.reset(seed=3)
    for frame in calm[:20]:
        np.testing.assert_array_equal(observation["anchors"], frame.told)
        np.testing.assert_array_equal(info["translation"], truth_of(frame).translation)
        np.testing.assert_allclose(
            observation["belief_translation"], frame.tracks[0].belief.translation, atol=1e-12
        )
        assert info["position_error_m"] == pytest.approx(frame.tracks[0].position_m, abs=1e-12)
        assert info["nees"] == pytest.approx(frame.tracks[0].nees, rel=1e-6)
        observation, _, _, _, info = env.step(0)


def test_undisturbed_filters_are_honest(calm):
    # NIS of 80 epochs of 36 ranges: its mean per degree is known to 2.6 %.
    for which in (0, 1):
        assert nis(calm, which, 0) == pytest.approx(1, abs=0.1)
    assert rms(calm, 0) < 0.1
    assert all(not f.tracks[0].rejected.any() and f.links.measured.all() for f in calm)


def test_reflected_paths_break_the_filter_and_the_robust_one_holds(calm):
    run = played(nlos=0.15)
    reflected = np.mean([f.links.reflected.mean() for f in run[SET_IN:]])
    # 51 epochs of 36 links: three standard deviations are 0.025.
    assert reflected == pytest.approx(0.15, abs=0.03)
    assert not any(f.links.reflected.any() for f in run[:SET_IN])
    assert rms(run, 0) > 5 * rms(calm, 0)
    assert nis(run, 0) > 3
    assert rms(run, 1) < 1.5 * rms(calm, 1)
    assert nis(run, 1) == pytest.approx(1, abs=0.15)
    rejected = np.array([f.tracks[1].rejected for f in run[SET_IN:]])
    nlos = np.array([f.links.reflected for f in run[SET_IN:]])
    # 5 m are 50 standard deviations: all are rejected, and hardly any other.
    assert rejected[nlos].all()
    assert rejected[~nlos].mean() < 0.01
    assert not any(f.tracks[0].rejected.any() for f in run)


def test_lost_links_give_no_range_and_leave_filters_honest():
    run = played(lost=0.5)
    lost = 1 - np.mean([f.links.measured.mean() for f in run[SET_IN:]])
    assert lost == pytest.approx(0.5, abs=0.04)
    assert nis(run, 0) == pytest.approx(1, abs=0.15)


def test_a_wrong_anchor_raises_the_nis_and_the_robust_filter_is_nearer(calm):
    run = played(wrong_m=0.5)
    moved = np.linalg.norm(run[-1].told - run[-1].anchors, axis=1)
    np.testing.assert_allclose(moved, [0.5, 0, 0, 0, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(run[0].told, run[0].anchors)
    assert nis(run, 0) > 1.8 > 1.2 > nis(calm, 0)
    assert rms(run, 0) > 3 * rms(calm, 0)
    assert rms(run, 1) < 0.7 * rms(run, 0)


def test_twice_the_noise_is_four_times_the_nis():
    # Of ranges that are rejected beyond four standard deviations some are missing.
    assert 2.4 < nis(played(noise=2.0), 0) < 4


def test_a_filter_by_its_label():
    assert filter_named(" iekf/robust=true") == BOTH[1]
    assert filter_named("iekf/robust=late").options == {"robust": "late"}
    assert filter_named("uc-kf") == Named("uc-kf", "uc-kf", {})


def test_kinds_of_links():
    assert LINKS == ("lost", "used", "reflected", "rejected", "behind an obstacle")
    measured = np.array([[True, True, True, False, True]])
    reflected = np.array([[False, True, True, False, False]])
    links = Links(measured, reflected, np.array([[False, True, True, True, True]]))
    rejected = np.array([[False, False, True, False, False]])
    assert link_kinds(links, rejected).tolist() == [[1, 2, 3, 0, 4]]
    assert link_kinds(links).tolist() == [[1, 2, 2, 0, 4]]


def test_a_building_is_watched_with_its_walls():
    problem = scene_files.problem(str(ROOT / "examples" / "warehouse.toml"))
    mounts = problem.mounts.draw(np.random.default_rng(0).random((8, 3)))
    stage = stage_of_problem(problem, mounts, 20)
    run = [*frames(stage, [filter_named("iekf")], 0)]
    low, high = problem.zones[0].bounds()
    for frame in run:
        place = truth_of(frame).translation
        assert (place > low - 1).all()
        assert (place < high + 1).all()
        np.testing.assert_array_equal(frame.anchors, mounts)
        blocked = problem.share(mounts, place[None])[0] < 0.5
        np.testing.assert_array_equal(frame.links.weak, np.repeat(blocked[:, None], 6, axis=1))
    assert any(frame.links.weak.any() for frame in run)


def test_what_cannot_be_played_is_refused_before_the_first_frame():
    with pytest.raises(ValueError, match="filter must be one of"):
        frames(ROOM, [filter_named("kalmann")], 0)
    with pytest.raises(ValueError, match="inertial"):
        frames(ROOM, [filter_named("iekf-imu")], 0)
    with pytest.raises(ValueError, match="nlos"):
        Disturbances(nlos=1.5)
    with pytest.raises(ValueError, match="steps"):
        stage_of_scene(scenes.get("uwb_room"), 0)


# --- recordings ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def log() -> recordings.Recording:
    folder = ROOT / "examples" / "log"
    names = ("ranges", "anchors", "tags", "truth")
    files: dict[str, Any] = {name: folder / f"{name}.csv" for name in names}
    whole = recordings.read_recording(recordings.Files(**files))
    some = ("times", "ranges", "links")
    return whole._replace(**{name: getattr(whole, name)[:40] for name in some}, range_std=None)


def test_a_recording_is_shown_as_replay_judges_it(log):
    settings = replay.Settings.of(filter="iekf-log")
    tracks = track_all(log, (filter_named("iekf-log"), filter_named("iekf")), settings)
    assert [*tracks] == ["iekf-log", "iekf"]
    run = [*recorded_frames(log, tracks, settings)]
    replayed = replay.replay_recording(log, settings)
    assert len(run) == len(log.times)
    assert run[-1].time_s == pytest.approx(log.times[-1] - log.times[0])
    assert replayed.errors is not None
    known = np.array([frame.truth is not None for frame in run])
    np.testing.assert_array_equal(known, replayed.errors.known)
    shown = np.array([frame.tracks[0].position_m for frame in run])
    np.testing.assert_allclose(shown[known], replayed.errors.position[known])
    assert np.isnan(shown[~known]).all()
    told = replayed.track.innovations
    assert told is not None
    np.testing.assert_allclose([f.tracks[0].nis for f in run], told.nis)
    np.testing.assert_array_equal([f.tracks[0].rejected for f in run], log.links & ~told.used)
    np.testing.assert_array_equal([f.links.measured for f in run], log.links)


def test_a_track_of_other_epochs_is_refused(log):
    track = replay.track_recording(log, replay.Settings.of(filter="iekf-log"))
    shorter = log._replace(times=log.times[:-1])
    with pytest.raises(ValueError, match="epochs of the recording"):
        recorded_frames(shorter, {"iekf-log": track})
    with pytest.raises(ValueError, match="tracks must hold"):
        recorded_frames(log, {})


# --- environments and policies ----------------------------------------------------------------


def test_an_environment_is_shown_with_its_own_filter_and_others():
    made = gym.make("rbl_gym:RBL/Tracking-v0", scene={"name": "uwb_room", "steps": 8})
    env = EstimatePose(made, {"name": "iekf", "robust": True}, observation="flat")
    run = [*env_frames(env, (filter_named("uc-kf"),), seed=4)]
    assert [track.label for track in run[0].tracks] == ["iekf/robust=true", "uc-kf"]
    assert len(run) == 9
    _, info = env.reset(seed=4)
    for frame in run[1:]:
        *_, info = env.step(0)
        assert frame.tracks[0].position_m == pytest.approx(info["position_error_m"], rel=1e-9)
        assert frame.score_m == info["score_m"]
        np.testing.assert_array_equal(truth_of(frame).rotation, info["rotation"])


def test_only_the_anchors_that_were_chosen_have_links():
    env = gym.make("rbl_gym:RBL/AnchorSelection-v0")
    run = [*env_frames(env, seed=1)]
    assert {int(frame.links.measured.any(axis=1).sum()) for frame in run[1:]} == {3}
    last, belief = run[-1].tracks[0].belief, env.get_wrapper_attr("belief")
    np.testing.assert_allclose(last.translation, belief.translation, atol=1e-9)
    np.testing.assert_allclose(last.covariance, belief.covariance, atol=1e-9)


def test_other_environments_are_shown_as_they_are_rendered():
    with pytest.raises(ValueError, match="rgb_array"):
        env_frames(gym.make("rbl_gym:RBL/PlanarNetwork-v0"))
    env = gym.make("rbl_gym:RBL/PlanarNetwork-v0", render_mode="rgb_array")
    frame = next(env_frames(env))
    np.testing.assert_array_equal(frame.picture, env.render())
    with pytest.raises(ValueError, match="env must be"):
        env_frames("RBL/Tracking-v0")  # pyrefly: ignore[bad-argument-type]


def random_policy(task: str, folder) -> str:
    env = rl_task(task).make(1)
    kind, outputs = policies.kind_and_outputs(env.single_action_space)
    size = env.single_observation_space.shape[0]
    weights = 0.3 * np.random.default_rng(0).standard_normal((outputs, size))
    path = str(folder / f"{task}-0.npz")
    policies.save(policies.Policy((weights,), (np.zeros(outputs),), kind, {"task": task}), path)
    return path


def test_a_policy_places_beside_a_reference(tmp_path):
    program = learned_program(random_policy("auv_buoys", tmp_path), "ring", seed=2)
    run = [*program.start((), 2, lambda _: CALM)]
    assert [len(frame.anchors) for frame in run] == [0, 1, 2, 3, 4]
    assert np.isnan(run[0].score_m)
    ring = layouts_of(rl_task("auv_buoys"), {}, ["ring"], 1, 2)[0]
    np.testing.assert_array_equal(run[0].ghosts["ring"], ring.found["ring"][0])
    expected = placement.score(ring.problem, ring.contexts, run[-1].anchors[None])
    assert run[-1].score_m == pytest.approx(float(expected[0]), rel=1e-9)


def test_a_policy_steers_beside_a_reference_as_it_is_evaluated(tmp_path):
    short = rl_task("mobile-easy")
    policy = policies.load(random_policy("mobile-easy", tmp_path))
    run = [*learned_frames(short, policy, "orbit", seed=0)]
    returns, steps = rollouts.returns(short, policy.player(), 1, 0)
    assert run[-1].score_m == pytest.approx(float(np.exp(-returns / steps)[0]), rel=1e-6)
    rng = np.random.default_rng(0)
    returns, steps = rollouts.returns(short, lambda env, _: controllers.orbit(env, rng), 1, 0)
    assert run[-1].scores["orbit"] == pytest.approx(float(np.exp(-returns / steps)[0]), rel=1e-6)
    assert run[-1].ghosts["orbit"].shape == run[-1].anchors.shape == (3, 3)


def test_a_policy_plays_an_environment_of_its_own_again_and_again(tmp_path):
    path = random_policy("mobile-easy", tmp_path)
    env = gym.make("rbl_gym:RBL/MobileAnchors-v0", scene={"name": "auv_craft", "steps": 4})
    program = played_program(path, env, seed=3)
    runs = [[*program.start((), 3, lambda _: CALM)] for _ in range(2)]
    observation, _ = env.reset(seed=3)
    play = policies.load(path).player()
    for step in range(4):
        observation, *_, info = env.step(play(env, observation))
        for run in runs:
            assert run[step + 1].score_m == info["score_m"]
    with pytest.raises(ValueError, match="does not fit"):
        played_program(path, gym.make("rbl_gym:RBL/AnchorPlacement-v0"))
    with pytest.raises(ValueError, match="does not fit"):
        played_program(path, gym.make("rbl_gym:RBL/Tracking-v0"))


def test_a_policy_that_cannot_be_played_is_refused(tmp_path):
    path = random_policy("auv_buoys", tmp_path)
    with pytest.raises(ValueError, match="reference"):
        learned_program(path, "nobody")
    (tmp_path / "none.npz").write_text("")
    with pytest.raises(ValueError, match="not a policy"):
        learned_program(str(tmp_path / "none.npz"))
