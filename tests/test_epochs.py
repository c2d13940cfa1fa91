"""The loop over epochs, errors of beliefs, and the innovation's statistic."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import estimators, metrics, motion
from rbl_gym.estimators import Innovations, PoseBelief
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.epochs import (
    AxisErrors,
    PoseErrors,
    Reading,
    Step,
    axis_errors,
    nees_interval,
    pose_errors,
    stack_beliefs,
    timed,
    track_epochs,
)
from rbl_gym.studies.groups import innovations_of
from rbl_gym.worlds import scenes
from tests.helpers import random_world

NOISE = ranging.RangeNoise(0.05)
PROCESS = motion.ProcessNoise(0.02, 0.1)
COVARIANCE = np.diag([0.01] * 3 + [0.04] * 3)


def world(epochs: int = 5):
    """A body at rest, an epoch a second; the third at the same time, with half the links."""
    rng = np.random.default_rng(1)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    true = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    readings = [
        Reading(
            true + 0.05 * rng.standard_normal(true.shape),
            anchors,
            rng.random(true.shape) < 0.5 if k == 2 else None,
            ranging.LinkNoise(np.full(true.shape, 0.2)) if k == 3 else None,
            None if k in (0, 2) else np.zeros(6),
            1.0,
        )
        for k in range(epochs)
    ]
    return tags, (rotation, translation, COVARIANCE), readings


@pytest.mark.parametrize("name", ["iekf", "kf", "uc-kf"])
def test_the_loop_is_the_plain_one(name):
    tags, prior, readings = world()
    filter = estimators.make(name, tags=tags, noise=NOISE, process=PROCESS)
    steps = list(track_epochs(filter, prior, iter(readings)))
    state = filter.initial(*prior)
    for k, (seen, step) in enumerate(zip(readings, steps, strict=True)):
        if k in (1, 3, 4):
            state = filter.predict(state, np.zeros(6), 1.0)
        for mine, theirs in zip(state, step.predicted, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        state = filter.update(state, seen.ranges, seen.anchors, seen.links, noise=seen.noise)
        for mine, theirs in zip(filter.belief(state), step.belief, strict=True):
            np.testing.assert_array_equal(mine, theirs)
    stacked = stack_beliefs(step.belief for step in steps)
    assert stacked.covariance.shape == (5, 6, 6)
    np.testing.assert_array_equal(stacked.translation[3], steps[3].belief.translation)


def test_a_filter_can_be_started_again_at_an_epoch():
    tags, prior, readings = world()
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS)
    wrong = prior[0], prior[1] + 3.0, prior[2]
    asked = []

    def restart(belief: PoseBelief, anchors: np.ndarray):
        asked.append(belief)
        return prior if len(asked) == 1 else None

    steps = list(track_epochs(filter, wrong, readings, restart))
    expected = list(track_epochs(filter, prior, readings))
    assert len(asked) == len(steps)
    for mine, theirs in zip(steps, expected, strict=True):
        np.testing.assert_array_equal(mine.belief.translation, theirs.belief.translation)


def test_time_is_taken_of_the_filter_alone():
    tags, prior, readings = world(3)
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS)
    pairs = list(timed(track_epochs(filter, prior, readings)))
    assert [type(step) for step, _ in pairs] == [Step] * 3
    assert all(seconds >= 0 for _, seconds in pairs)


def test_errors_of_beliefs_by_hand_and_of_impossible_ones():
    rng = np.random.default_rng(2)
    _, tags, rotation, translation = random_world(rng, 4, 4)
    turn = 0.1 * rng.standard_normal((4, 3))
    shift = rng.standard_normal((4, 3))
    hat = rotations.exp(turn) @ rotation
    P = np.tile(np.diag([0.1] * 3 + [0.2] * 3), (4, 1, 1))
    P[2] = 0.0  # claims to know everything
    P[3] = -P[3]  # claims the impossible
    belief = PoseBelief(hat, translation + shift, P, hat)
    found = pose_errors(belief, rotation, translation, tags)
    assert isinstance(found, PoseErrors)
    np.testing.assert_allclose(found.pose, np.concatenate([turn, shift], axis=1), atol=1e-12)
    moved = tags @ np.swapaxes(hat - rotation, -1, -2) + shift[:, None]
    np.testing.assert_allclose(found.tags_m, np.sqrt((moved**2).sum(-1).mean(-1)), rtol=1e-12)
    expected = (turn[:2] ** 2).sum(-1) / 0.1 + (shift[:2] ** 2).sum(-1) / 0.2
    np.testing.assert_allclose(found.nees, [*expected, np.inf, np.inf], rtol=1e-9)


def test_errors_along_a_track_where_truth_is_known():
    rng = np.random.default_rng(5)
    _, _, rotation, translation = random_world(rng, 4, 4)
    Q, t = np.tile(rotation, (6, 1, 1)), np.tile(translation, (6, 1))
    w, v = 0.1 * rng.standard_normal((2, 6, 3))
    P = np.tile(np.diag([0.01, 0.04, 0.09, 1.0, 4.0, 9.0]), (6, 1, 1))
    belief = PoseBelief(rotations.exp(w) @ Q, t + v, P, Q)
    known = np.arange(6) != 3
    whole = axis_errors(belief, Q, t)
    flat = axis_errors(belief, Q, t, known, planar=True)
    assert isinstance(flat, AxisErrors)
    np.testing.assert_allclose(whole.position_m, np.linalg.norm(v, axis=1))
    np.testing.assert_allclose(whole.rotation_deg, np.rad2deg(np.linalg.norm(w, axis=1)))
    np.testing.assert_allclose(whole.rotation_std_deg, np.rad2deg(np.sqrt(0.14)))
    np.testing.assert_allclose(flat.position_std_m, np.sqrt(5))
    np.testing.assert_allclose(flat.rotation_deg[known], np.rad2deg(np.abs(w[known, 2])))
    nees = w[:, 2] ** 2 / 0.09 + v[:, 0] ** 2 + v[:, 1] ** 2 / 4
    np.testing.assert_allclose(flat.nees, np.where(known, nees, np.nan))


@pytest.mark.parametrize(("count", "dof"), [(1, 6), (1, 3), (50, 6)])
def test_the_interval_of_the_nees_holds_what_honest_beliefs_have(count, dof):
    low, high = nees_interval(count, dof)
    drawn = np.random.default_rng(6).chisquare(dof, (20_000, count)).mean(axis=1)
    # A share of 0.975 of 20,000 is known to 0.0011: four standard deviations.
    assert np.mean(drawn < high) == pytest.approx(0.975, abs=0.0045)
    assert np.mean(drawn > low) == pytest.approx(0.975, abs=0.0045)


def test_an_honest_filter_foretells_its_ranges_as_well_as_it_says():
    """The mean NIS is the number of ranges; three hundred trials know it to 4 sigma."""
    scene = scenes.get({"name": "uwb_room", "steps": 3})
    trials = monte_carlo.simulate_trials(scene, 300, np.random.default_rng(3))
    filter = monte_carlo.scene_filter(scene, "iekf", {})
    steps = monte_carlo.trial_steps(trials, filter)
    size = scene.n_anchors * len(scene.tags)
    told = monte_carlo.told_readings(scene, trials.episode, trials.measurements)
    found_of = innovations_of(filter, steps, np.asarray(scene.tags), scene.noise)
    each = [(g.reading.ranges[k], [a[k] for a in i]) for g, i in found_of for k in range(g.count)]
    for (ranges, values), reading in zip(each, told, strict=True):
        found = Innovations(*values)
        np.testing.assert_array_equal(ranges, reading.ranges)
        assert found.nis.shape == found.dof.shape == (300,)
        # One range in 16,000 is refused.
        assert (found.dof >= size - 2).all()
        assert abs(found.nis.mean() - size) < 4 * np.sqrt(2 * size / 300)


@pytest.mark.parametrize("name", ["iekf", "iekf-bias", "iekf-bank", "uc-kf"])
def test_innovations_come_with_their_steps(name):
    """Many epochs at once are the same as one after the other, whatever their laws and links."""
    tags, prior, readings = world(6)
    filter = estimators.make(name, tags=tags, noise=NOISE, process=PROCESS)
    steps = [*track_epochs(filter, prior, readings)]
    groups = [*innovations_of(filter, steps, tags, NOISE)]
    assert sum(group.count for group, _ in groups) == len(readings)
    pairs = [(g.belief, i, k) for g, i in groups for k in range(g.count)]
    for step, (belief, found, k) in zip(steps, pairs, strict=True):
        reading = step.reading
        law = NOISE if reading.noise is None else reading.noise
        told = reading.ranges, reading.anchors, tags, law, reading.links
        alone = estimators.innovations(filter, step.predicted, step.state, *told)
        np.testing.assert_array_equal(belief.translation[k], step.belief.translation)
        for one, other in zip(alone, found, strict=True):
            np.testing.assert_allclose(one, other[k], rtol=1e-9, atol=1e-9)


def test_a_trace_is_of_the_beliefs():
    scene = scenes.get({"name": "hall", "steps": 3})
    trials = monte_carlo.simulate_trials(scene, 2, np.random.default_rng(4))
    assert trials.bound.shape == (4, 2, 6, 6)
    trace = monte_carlo.track_trials(trials, "iekf", {})
    truth = trials.episode.rotation[:, 2], trials.episode.translation[:, 2]
    filter = monte_carlo.scene_filter(scene, "iekf", {})
    belief = list(monte_carlo.trial_steps(trials, filter))[2].belief
    error = metrics.pose_error(belief.rotation, belief.translation, *truth)
    np.testing.assert_allclose(trace.error[2], error, rtol=1e-12)
    np.testing.assert_allclose(trace.nees[2], metrics.nees(error, belief.covariance), rtol=1e-9)
