"""The noise law of an epoch as an argument of the update, also for filters of others."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import estimators, motion, recordings
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import bearing, ranging
from rbl_gym.studies import monte_carlo, replay
from rbl_gym.studies.bench import stages
from rbl_gym.worlds import scenes
from rbl_gym.wrappers import EstimatePose, VectorEstimatePose
from tests.helpers import random_world, simulate

TAGS = bodies.octahedron(1.0)
PROCESS = motion.ProcessNoise(0.05, 0.1)


class Delegate:
    """All that docs/your_estimator.md asks of a filter, and nothing that it does not."""

    def __init__(self, tags: Any, noise: Any, process: Any) -> None:
        self._inner = estimators.make("iekf", tags=tags, noise=noise, process=process)

    def initial(self, rotation, translation, covariance):
        return self._inner.initial(rotation, translation, covariance)

    def predict(self, state, twist, dt):
        return self._inner.predict(state, twist, dt)

    def update(self, state, ranges, anchors, links=None, noise=None):
        return self._inner.update(state, ranges, anchors, links, noise)

    def belief(self, state):
        return self._inner.belief(state)


class OldInterface(Delegate):
    def update(self, state, ranges, anchors, links=None):  # pyrefly: ignore[bad-override]
        return self._inner.update(state, ranges, anchors, links)


OLD, NEW = (f"tests.test_epoch_noise:{kind.__name__}" for kind in (OldInterface, Delegate))
REFUSAL = r"filter 'tests.test_epoch_noise:OldInterface' must take update\(.*noise=None\), because"


def test_a_delegate_has_the_nees_of_iekf_in_a_hall_with_racks():
    nees = {}
    for name in ("iekf", NEW):
        envs = gym.make_vec("rbl_gym:RBL/Tracking-v0", num_envs=16, scene="hall", reward="none")
        envs = VectorEstimatePose(envs, name)
        _, info = envs.reset(seed=3)
        rows = [info["nees"]]
        for _ in range(20):
            rows.append(envs.step(np.zeros(16, dtype=np.int64))[-1]["nees"])
        nees[name] = np.array(rows)
    np.testing.assert_allclose(nees[NEW], nees["iekf"], rtol=1e-12)
    # Honest: 6 degrees of freedom; of 336 correlated values the mean is within 1.
    assert abs(nees[NEW].mean() - 6) < 1


def test_every_loop_gives_it_the_law_of_the_epoch():
    scene = scenes.get({"name": "hall", "steps": 5})
    world = monte_carlo.simulate_trials(scene, 8, np.random.default_rng(0))
    stage = stages.scene_stage({"name": "hall", "steps": 5}, "nominal", 8, 0)
    for run in (
        lambda name: monte_carlo.track_trials(world, name, {}).nees,
        lambda name: stages.run_filter(stage, name, {})[0]["anees"],
    ):
        np.testing.assert_allclose(run(NEW), run("iekf"), rtol=1e-12)
    # Blind to the racks the same filter claims far too much.
    assert monte_carlo.track_trials(world, "iekf", {}).nees.mean() < 9


def log(std: float) -> recordings.Recording:
    """Five epochs at one place, one range off by a metre that says so."""
    anchors, tags, rotation, translation = random_world(np.random.default_rng(4), 6, 4)
    ranges = np.repeat(
        ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))[None], 5, 0
    )
    each = np.full(ranges.shape, 0.02)
    ranges[:, 2, 1] += 1.0
    each[:, 2, 1] = std
    truth = recordings.Truth(
        np.arange(5) * 0.1, np.repeat(rotation[None], 5, 0), np.repeat(translation[None], 5, 0)
    )
    names = tuple("abcdef"), tuple("wxyz")
    return recordings.Recording(
        np.arange(5) * 0.1, ranges, ranges > 0, each, anchors, tags, *names, truth
    )


@pytest.mark.parametrize("name", ["iekf", "kf", "iekf-bank", "iekf-cv", "iekf-bias", NEW])
def test_a_recording_with_its_own_noise_is_weighed_by_it(name):
    settings = replay.Settings.of(filter=name, robust=False)
    found = []
    for std in (0.02, 10.0):
        track = replay.track_recording(log(std), settings)
        errors = replay.track_errors(log(std), track, settings)
        assert errors is not None
        assert errors.tags is not None
        found.append(errors.tags[-1])
    told_wrong, told_right = found
    assert told_right < 0.02
    assert told_wrong > 5 * told_right
    assert replay.range_std_of(log(0.02), settings) == "recorded"


def test_a_filter_of_the_old_interface_is_refused_by_name_where_it_matters():
    hall = gym.make("rbl_gym:RBL/Tracking-v0", scene="hall")
    with pytest.raises(ValueError, match=REFUSAL + r".*obstacles.* takes \(state, ranges, anchors"):
        EstimatePose(hall, OLD)
    halls = gym.make_vec("rbl_gym:RBL/Tracking-v0", num_envs=2, scene="hall")
    with pytest.raises(ValueError, match=REFUSAL):
        VectorEstimatePose(halls, OLD)
    with pytest.raises(ValueError, match=REFUSAL):
        monte_carlo.scene_filter(scenes.get("hall"), OLD, {})
    with pytest.raises(ValueError, match=REFUSAL + ".*recording"):
        replay.track_recording(log(0.02), replay.Settings.of(filter=OLD))
    stage = stages.scene_stage({"name": "hall", "steps": 2}, "nominal", 2, 0)
    record, _ = stages.run_filter(stage, OLD, {})
    assert record["status"] == "ValueError"
    assert "OldInterface' must take update(" in record["message"]
    # Elsewhere it runs as ever.
    env = EstimatePose(gym.make("rbl_gym:RBL/Tracking-v0", scene="uwb_room"), OLD)
    assert env.reset(seed=1)[1]["nees"] > 0
    replay.track_recording(log(0.02), replay.Settings.of(filter=OLD, range_std_m=0.1))


@pytest.mark.parametrize("name", ["kf", "iekf", "iekf-bank", "iekf-cv", "iekf-bias"])
def test_a_noise_that_is_no_law_is_refused(name):
    filter = estimators.make(name, tags=TAGS, noise=ranging.RangeNoise(0.1), process=PROCESS)
    state = filter.initial(np.eye(3), np.zeros(3), 0.01 * np.eye(6))
    anchors = 9.0 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    ranges = ranging.distances(anchors, TAGS)
    with pytest.raises(ValueError, match=r"noise must be a noise law .* got 0.1"):
        filter.update(state, ranges, anchors, noise=0.1)  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ValueError, match=r"noise must fit ranges of shape \(4, 6\)"):
        filter.update(state, ranges, anchors, noise=ranging.LinkNoise(np.ones((3, 6))))


@pytest.mark.parametrize("name", ["kf", "iekf", "iekf-bank", "iekf-cv", "iekf-bias"])
def test_a_law_with_leading_axes_is_a_law_for_each(name):
    filter = estimators.make(name, tags=TAGS, noise=ranging.RangeNoise(0.1), process=PROCESS)
    state = filter.initial(np.eye(3), np.zeros(3), 0.01 * np.eye(6))
    anchors = 9.0 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    ranges = ranging.distances(anchors, TAGS) + 0.05
    each = np.random.default_rng(0).uniform(0.05, 0.5, (3, 4, 6))
    belief = filter.belief(filter.update(state, ranges, anchors, noise=ranging.LinkNoise(each)))
    for k in range(3):
        alone = filter.update(state, ranges, anchors, noise=ranging.LinkNoise(each[k]))
        for a, b in zip(belief, filter.belief(alone), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-8, atol=1e-9)


def test_angles_take_the_laws_of_their_epoch():
    station = np.zeros(3)
    pose = rotations.exp([0.1, 0.2, 0.3]), np.array([4.0, 3.0, 2.0])
    angles = bearing.angles(ranging.tag_positions(*pose, TAGS) - station)
    ranges = ranging.distances(station[None], ranging.tag_positions(*pose, TAGS))
    laws = [(bearing.AngleNoise(s), ranging.RangeNoise(r)) for s, r in ((0.01, 0.1), (0.05, 0.5))]
    filters = [
        estimators.make("iekf", tags=TAGS, noise=noise, process=PROCESS, measurement="doa",
                        range_noise=range_noise)
        for noise, range_noise in laws
    ]  # fmt: skip
    state = filters[0].initial(*pose, 0.1 * np.eye(6))
    noise, range_noise = laws[1]
    told: Any = filters[0]
    got = told.update(state, angles, station, noise=noise, ranges=ranges, range_noise=range_noise)
    want = filters[1].update(state, angles, station, ranges=ranges)  # pyrefly: ignore[bad-keyword-argument]
    np.testing.assert_array_equal(got.covariance, want.covariance)
    with pytest.raises(ValueError, match=r"noise must be a bearing.AngleNoise, or None, got Range"):
        told.update(state, angles, station, noise=range_noise)


def test_one_range_of_a_stream_has_its_own_law():
    rng = np.random.default_rng(5)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    own, law = ranging.RangeNoise(0.1), ranging.LinkNoise(np.array([[0.4]]))
    ranges = simulate(rng, anchors, tags, rotation, translation, own)
    filter = estimators.make("iekf", tags=tags, noise=own, process=PROCESS)
    links = estimators.Asynchronous(filter, anchors, len(tags))
    stream = links.start(filter.initial(rotation, translation, 0.01 * np.eye(6)), time=0.0)
    # Out of order: the law goes with its range.
    stream = links.add(stream, 0.2, 1, 2, ranges[1, 2])
    stream = links.add(stream, 0.1, 0, 3, ranges[0, 3], noise=law)
    state = filter.initial(rotation, translation, 0.01 * np.eye(6))
    for anchor, tag, noise in ((0, 3, law), (1, 2, None)):
        mask = np.zeros(ranges.shape, bool)
        mask[anchor, tag] = True
        state = filter.predict(state, np.zeros(6), 0.1)
        state = filter.update(state, ranges, anchors, mask, noise)
    np.testing.assert_allclose(links.belief(stream).covariance, state.covariance, rtol=1e-12)
    np.testing.assert_allclose(links.belief(stream).translation, state.translation, rtol=1e-12)


def test_options_of_a_filter_by_name_and_by_settings_give_the_same_track():
    told = replay.track_recording(log(0.02), replay.Settings.of(filter="iekf/robust=late"))
    same = replay.track_recording(log(0.02), replay.Settings.of(filter="iekf", robust="late"))
    np.testing.assert_array_equal(told.translation, same.translation)
    once = replay.Settings.of(filter="iekf/iterations=1")
    assert replay.recording_filter(log(0.02), once).iterations == 1  # pyrefly: ignore[missing-attribute]
    assert once.changed(filter="iekf-cv").filter_options == ()
    supposed = replay.Settings.of(filter="iekf/robust=false").changed(robust=True)
    assert replay.recording_filter(log(0.02), supposed).robust is True  # pyrefly: ignore[missing-attribute]
    with pytest.raises(ValueError, match="'kf' has no option 'robust'"):
        replay.check_replay(log(0.02), replay.Settings.of(filter="kf/robust=true"))
    with pytest.raises(ValueError, match="robust is given twice"):
        replay.Settings.of(filter="iekf/robust=true", robust=True)
