"""The bank of iterated EKFs: unknown start, mirror poses, recovery of a lost track."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import bounds, estimators, motion
from rbl_gym.estimators.bank.hypotheses import RIVALS
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.studies import monte_carlo
from rbl_gym.worlds import scenes
from tests.helpers import random_world, simulate

NOISE = ranging.RangeNoise(0.05)
PROCESS = motion.ProcessNoise(0.02, 0.1)
TAGS = bodies.octahedron(0.8)
COVARIANCE = np.diag([0.02] * 3 + [0.1] * 3)
VAGUE = np.diag([np.pi**2] * 3 + [400.0] * 3)
# Chi-square of six degrees of freedom: one in 10^13 is above.
FAR = 70.0


def make(tags=TAGS, name="iekf-bank", **options) -> Any:
    return estimators.make(name, tags=tags, noise=NOISE, process=PROCESS, **options)


def world(scene, seed, trials, steps=10, **links):
    scene = scenes.get({"name": scene, "steps": steps, "links": links})
    return monte_carlo.simulate_trials(scene, trials, np.random.default_rng(seed))


def told_wrong(world, seed):
    """The world with filters that are told a pose 180 degrees and 10 m off, and are sure of it."""
    episode, rng = world.episode, np.random.default_rng(seed)
    units = rng.standard_normal((2, len(episode.rotation), 3))
    turn, shift = units / np.linalg.norm(units, axis=-1, keepdims=True)
    return world._replace(
        episode=episode._replace(
            prior_rotation=rotations.exp(np.pi * turn) @ episode.rotation[:, 0],
            prior_translation=episode.translation[:, 0] + 10 * shift,
        )
    )


def near(world, trace):
    """Which trials (K, B) are at the truth, measured by the bound."""
    square = np.einsum("...i,...ij,...j->...", trace.error, np.linalg.inv(world.bound), trace.error)
    return square < FAR


@pytest.mark.parametrize("robust", [False, True])
def test_without_a_doubt_it_is_the_iterated_ekf(robust):
    here = world("uwb_room", 1, 20, nlos_probability=0.1 if robust else 0.0)
    filters: list[Any] = [
        monte_carlo.scene_filter(here.scene, name, {"robust": robust})
        for name in ("iekf", "iekf-bank")
    ]
    runs = [list(monte_carlo.trial_steps(here, filter)) for filter in filters]
    for plain, banked in zip(*runs, strict=True):
        for a, b in zip(plain.belief, banked.belief, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)
        assert np.isneginf(banked.state.log_odds).all()
    np.testing.assert_array_equal(filters[1].probabilities(runs[1][-1].state)[:, 0], 1.0)


@pytest.mark.parametrize("scene", ["uwb_room", "drone_yard", "satellite", "auv_buoys"])
@pytest.mark.parametrize("trials", [100, pytest.param(1000, marks=pytest.mark.long)])
def test_half_a_turn_and_ten_metres_off_it_comes_back(scene, trials):
    """At least 99 % are back within 10 epochs, where the plain filter is still lost."""
    here = world(scene, 2, trials)
    back = {
        name: near(here, monte_carlo.track_trials(told_wrong(here, 3), name, {})).mean(axis=1)
        for name in ("iekf", "iekf-bank")
    }
    assert back["iekf-bank"][10] >= 0.99
    assert back["iekf"][1] < 0.2


def test_it_comes_back_among_reflected_paths():
    here = world("drone_yard", 4, 60, nlos_probability=0.1)
    trace = monte_carlo.track_trials(told_wrong(here, 5), "iekf-bank", {"robust": True})
    assert near(here, trace)[10].mean() >= 0.97


def test_from_nothing():
    here = world("drone_yard", 6, 60, steps=3)
    episode = here.episode._replace(
        prior_rotation=np.broadcast_to(np.eye(3), (60, 3, 3)),
        prior_translation=np.zeros((60, 3)),
        prior_covariance=np.broadcast_to(np.diag([np.pi**2] * 3 + [1e4] * 3), (60, 6, 6)),
    )
    trace = monte_carlo.track_trials(here._replace(episode=episode), "iekf-bank", {})
    assert near(here, trace)[0].all()


def test_after_an_outage_without_odometry():
    here = world("drone_yard", 7, 60, steps=50)
    twists = here.episode.twists.copy()
    twists[:, 5:41] = 0.0
    blind = [
        m._replace(links=np.zeros_like(m.links)) if 5 <= k < 40 else m
        for k, m in enumerate(here.measurements)
    ]
    lost = here._replace(episode=here.episode._replace(twists=twists), measurements=blind)
    back = near(here, monte_carlo.track_trials(lost, "iekf-bank", {}))
    assert back[4].all()
    assert back[35].mean() < 0.2
    assert back[45].mean() >= 0.99


def mirror_world(rng, climb):
    """Anchors and tags in planes: the mirror image explains every epoch as well as the truth."""
    anchors = np.array([[0, 0, 0], [9, 0, 0], [9, 7, 0], [0, 7, 0], [4, 3, 0.0]])
    tags = bodies.plate(1.6, 1.0)
    twist = np.array([0.1, 0.05, 0.2, 0.3, 0.2, climb])
    poses = [(rotations.random(rng), np.array([4.0, 2.0, 3.0]))]
    for _ in range(15):
        poses.append(motion.propagate(*poses[-1], twist, 0.1))
    epochs = [simulate(rng, anchors, tags, *pose, NOISE) for pose in poses]
    return anchors, tags, twist, poses, epochs


def test_motion_tells_exact_mirror_images_apart():
    """Both are followed while nothing tells; a known climb decides, and the truth leads."""
    right = 0
    for seed in range(12):
        anchors, tags, twist, poses, epochs = mirror_world(np.random.default_rng(seed), 1.0)
        bank = make(tags)
        state = bank.initial(np.eye(3), [4.0, 3.0, 0.0], VAGUE)
        for k, ranges in enumerate(epochs):
            if k:
                state = bank.predict(state, twist, 0.1)
            state = bank.update(state, ranges, anchors)
            if k == 0:
                # The prior is symmetric: it is even, and the other one is the mirror image.
                chances = bank.probabilities(state)
                assert 0.4 < chances.max() < 0.6
                assert np.sort(chances)[-2] > 0.4
                other = state.rival_translation[np.argmax(state.log_odds)]
                mirrored = state.translation * [1, 1, -1]
                np.testing.assert_allclose(other, mirrored, atol=0.05)
        assert bank.probabilities(state)[0] > 0.99
        right += np.linalg.norm(state.translation - poses[-1][1]) < 0.3
    assert right == 12


def test_a_known_side_decides_at_once():
    for seed in range(6):
        anchors, tags, _, poses, epochs = mirror_world(np.random.default_rng(seed), 0.0)
        for sign in (1, -1):
            volume = np.sort([[-5, -5, 0.0], [15, 15, 10.0 * sign]], axis=0)
            bank = make(tags, volume=volume)
            state = bank.initial(np.eye(3), [4.0, 3.0, 0.0], VAGUE)
            state = bank.update(state, epochs[0], anchors)
            np.testing.assert_allclose(state.translation, poses[0][1] * [1, 1, sign], atol=0.6)
            assert np.sign(state.translation[2]) == sign
            assert bank.probabilities(state)[0] == 1.0


def test_a_leader_outside_its_volume_is_replaced():
    """It follows the mirror image, confident and at peace with the ranges, on the wrong side."""
    anchors, tags, _, poses, epochs = mirror_world(np.random.default_rng(3), 0.0)
    rotation, translation = poses[0]
    # Tags of a plate are mirrored by a half turn about the plate's normal after the reflection.
    mirror = np.diag([1.0, 1.0, -1.0])
    image = mirror @ rotation @ np.diag([1.0, 1.0, -1.0]), mirror @ translation
    bank = make(tags, volume=[[-5, -5, 0], [15, 15, 10]])
    state = bank.update(bank.initial(*image, 0.01 * COVARIANCE), epochs[0], anchors)
    np.testing.assert_allclose(state.translation, translation, atol=0.5)


def test_odds_are_those_of_the_textbook():
    """A rival's log odds change by the difference of log N(ranges; h, H P H^T + R)."""
    rng = np.random.default_rng(8)
    anchors = 20 * rng.standard_normal((5, 3))
    pose = rotations.random(rng), rng.standard_normal(3)
    ranges = simulate(rng, anchors, TAGS, *pose, NOISE)
    bank = make()
    tight, wide = 1e-4 * COVARIANCE, 2e-4 * np.diag([0.01, 0.02, 0.03, 0.2, 0.1, 0.1])
    shift = np.array([0.01, -0.01, 0.008, 0.03, 0.02, -0.01])
    led, off = (
        (rotations.exp(sign * shift[:3]) @ pose[0], pose[1] + sign * shift[3:]) for sign in (1, -1)
    )
    state = bank.initial(*led, tight)
    slots = {name: getattr(state, name).copy() for name in state._fields}
    slots["rival_rotation"][0], slots["rival_translation"][0] = off
    slots["rival_covariance"][0] = wide
    slots["log_odds"][0] = -2.0
    state = bank.update(type(state)(**slots), ranges, anchors)

    def log_normal(rotation, translation, P):
        distance, J = bounds.range_jacobian(anchors, TAGS, rotation, translation)
        S = J.T @ P @ J + 0.05**2 * np.eye(J.shape[1])
        e = (ranges - distance).ravel()
        return -0.5 * e @ np.linalg.solve(S, e) - 0.5 * np.linalg.slogdet(S)[1]

    want = -2.0 + log_normal(*off, wide) - log_normal(*led, tight)
    assert state.log_odds[0] == pytest.approx(want, abs=0.02)


def test_a_batch_is_a_loop_over_trials():
    """Of some the prior is wrong, of some it is vague, of some links are missing."""
    rng = np.random.default_rng(9)
    trials = 6
    anchors, _, rotation, translation = random_world(rng, 6, 6, (trials,))
    covariance = np.where(np.arange(trials)[:, None, None] < 2, VAGUE, COVARIANCE)
    start = translation + np.where(np.arange(trials)[:, None] == 3, 10.0, 0.1)
    twist = 0.1 * rng.standard_normal((trials, 6))
    epochs = [
        (simulate(rng, anchors, TAGS, rotation, translation, NOISE), rng.random((trials, 6, 6)) > k)
        for k in (0.0, 0.3, 0.3)
    ]
    bank = make()

    def follow(rows):
        state = bank.initial(rotation[rows], start[rows], covariance[rows])
        for k, (ranges, links) in enumerate(epochs):
            if k:
                state = bank.predict(state, twist[rows], 0.1)
            state = bank.update(state, ranges[rows], anchors[rows], links[rows])
        return state

    whole = follow(slice(None))
    for k in range(trials):
        single = follow(k)
        for name, a, b in zip(whole._fields, whole, single, strict=True):
            shown = np.isfinite(whole.log_odds[k])
            if name.startswith("rival"):
                np.testing.assert_allclose(a[k][shown], b[shown], atol=1e-6)
            else:
                np.testing.assert_allclose(a[k], b, atol=1e-6)


def test_two_batch_axes_and_shared_arrays():
    rng = np.random.default_rng(10)
    anchors = random_world(rng, 6, 6)[0]
    rotation, translation = rotations.random(rng, (2, 3)), rng.standard_normal((2, 3, 3))
    ranges = simulate(rng, anchors, TAGS, rotation, translation, NOISE)
    bank = make()
    # One prior, one twist and one set of anchors for all.
    state = bank.initial(np.eye(3), np.zeros(3), VAGUE)
    state = bank.update(bank.predict(state, np.zeros(6), 0.1), ranges, anchors)
    assert state.log_odds.shape == (2, 3, RIVALS)
    assert state.nis.shape == (2, 3)
    np.testing.assert_allclose(state.translation, translation, atol=0.5)
    assert bank.belief(state).covariance.shape == (2, 3, 6, 6)
    np.testing.assert_allclose(bank.probabilities(state).sum(axis=-1), 1.0)


def test_an_epoch_without_links_changes_nothing_but_the_window():
    bank = make()
    anchors, _, rotation, translation = random_world(np.random.default_rng(11), 6, 6)
    before = bank.initial(rotation, translation, COVARIANCE)._replace(
        nis=np.array(10.0), links=np.array(5.0)
    )
    after = bank.update(before, np.ones((6, 6)), anchors, np.zeros((6, 6), bool))
    for name, a, b in zip(before._fields, before, after, strict=True):
        if name not in ("nis", "links"):
            np.testing.assert_allclose(a, b, atol=1e-9)
    assert after.nis == pytest.approx(7.0)
    assert after.links == pytest.approx(3.5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"volume": [[0, 0, 0], [1, -1, 1]]}, r"volume must be \[lower corner, upper"),
        ({"volume": [[0, 0], [1, 1]]}, r"volume must have shape \(..., 2, 3\)"),
        ({"volume": np.zeros((4, 2, 3))}, r"volume must be \[lower corner, upper"),
        ({"iterations": 0}, "iterations must be"),
        ({"robust": 1}, "robust must be True, False or 'late'"),
        ({"rivals": 3}, "filter 'iekf-bank' has no option 'rivals'"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_wrong_epochs_are_named():
    bank = make()
    state = bank.initial(np.eye(3), np.zeros(3), COVARIANCE)
    with pytest.raises(ValueError, match="ranges must be finite"):
        bank.update(state, np.full((4, 6), np.nan), np.eye(4, 3))
    with pytest.raises(ValueError, match="twist must have shape"):
        bank.predict(state, np.zeros(5), 0.1)
    with pytest.raises(ValueError, match="dt must be"):
        bank.predict(state, np.zeros(6), -0.1)


def test_a_mirror_pose_that_nearly_fits_is_found_out():
    # Anchors that are almost coplanar: where the plain filter stays behind them, its residuals
    # are 1.6 times what they should be, 36 links at a time.
    anchors = np.array([[0, 7.29, 1.43], [6.82, 8, 0.97], [0, 4.2, 2.33],
                        [2.93, 2.21, 3], [10, 7.64, 0.63], [10, 6.97, 0.77]])  # fmt: skip
    scene = scenes.get("uwb_room")
    tags, rotation = np.array(scene.tags), rotations.exp(np.array([1.79, 0.03, 1.6]))
    translation = np.array([4.57, 1.43, 1.6])
    believed = rotations.exp(np.array([2.11, 0.09, 1.4])), np.array([4.19, 2.58, 2.87])
    truth = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    rng, far = np.random.default_rng(0), {}
    for name in ("iekf", "iekf-bank"):
        filter = estimators.make(name, tags=tags, noise=scene.noise, process=scene.process)
        state = filter.initial(
            np.broadcast_to(believed[0], (100, 3, 3)),
            np.broadcast_to(believed[1], (100, 3)),
            scene.prior_covariance,
        )
        for k in range(10):
            if k:
                state = filter.predict(state, np.zeros(6), scene.dt)
            noise = 0.1 * rng.standard_normal((100, *truth.shape))
            state = filter.update(state, truth + noise, anchors)
        off = np.linalg.norm(filter.belief(state).translation - translation, axis=-1)
        far[name] = (off > 1).mean()
    assert far["iekf"] > 0.25
    assert far["iekf-bank"] < 0.05
