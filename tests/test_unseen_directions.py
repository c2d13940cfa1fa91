"""Undetermined directions stay wide: tags in a line, tags without ranges, lost tracks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import bounds, estimators, metrics, motion
from rbl_gym.estimators.costs.unseen_directions import kept_wide
from rbl_gym.estimators.iekf import doa_filter, manifold, vague_start
from rbl_gym.estimators.iekf.manifold import PoseState
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import bearing, ranging
from tests.helpers import simulate

ANCHORS = np.array(
    [[0, 0, 2], [8, 0, 2.2], [8, 6, 2.5], [0, 6, 0.3], [4, 0, 0.2], [4, 6, 2.9], [0, 3, 1.0]]
)
NOISE = ranging.RangeNoise(0.05)
TURN, WALK, DT = np.deg2rad(20), 0.3, 0.1
PROCESS = motion.ProcessNoise(TURN, WALK)
PAIR = np.array([[0.3, 0, 0], [-0.3, 0, 0]])
THREE = np.array([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.3, 0.1]])


def make(tags, name="iekf", **options):
    return estimators.make(name, tags=tags, noise=NOISE, process=PROCESS, **options)


def wander(rng, batch, count):
    """A random walk of poses around the middle of the anchors."""
    rotation = rotations.random(rng, batch)
    translation = np.array([4, 3, 1.2]) + 0.3 * rng.standard_normal((*batch, 3))
    for _ in range(count):
        step = np.sqrt(DT) * rng.standard_normal((*batch, 6))
        rotation = rotations.exp(TURN * step[..., :3]) @ rotation
        translation = np.clip(translation + WALK * step[..., 3:], [1, 1, 0.4], [7, 5, 2])
        yield rotation, translation


@pytest.fixture
def searches(monkeypatch):
    """How many trials each global start was for."""
    counts = []
    for module in (manifold, doa_filter):
        plain = module.global_start

        def counted(problem, sought, batch, best_of, plain=plain):
            counts.append(int(np.sum(sought)))
            return plain(problem, sought, batch, best_of)

        monkeypatch.setattr(module, "global_start", counted)
    return counts


@pytest.mark.parametrize(
    ("name", "tags", "dead"),
    [
        ("iekf", PAIR, ()),
        ("iekf", THREE, (2,)),
        ("iekf", np.array([[0.0, 0, 0]]), ()),
        ("iekf", PAIR + [1, 0, 0], ()),
        ("iekf-bank", PAIR, ()),
        ("iekf-cv", PAIR, ()),
    ],
    ids=["two tags", "a third never ranges", "one tag", "beside the origin", "bank", "cv"],
)
def test_a_roll_that_nobody_sees_grows_as_the_process_says(name, tags, dead, searches):
    """No refusal, no search, and no knowledge out of nothing."""
    rng = np.random.default_rng(2)
    batch, std = (12,), np.array([0.2] * 3 + [0.3] * 3)
    filter = make(tags, name)
    if name == "iekf-cv":
        # No twist: the process alone moves the pose.
        still = {"turn_rate_rad_s": 1e-6, "speed_m_s": 1e-6, "turn_acceleration": 0.0,
                 "acceleration": 0.0}  # fmt: skip
        filter = make(tags, name, **still)
    state: Any = None
    for k, pose in enumerate(wander(rng, batch, 80)):
        if state is None:
            offset = std * rng.standard_normal((*batch, 6))
            start = rotations.exp(offset[:, :3]) @ pose[0], pose[1] + offset[:, 3:]
            state = filter.initial(*start, np.diag(std**2))
        else:
            state = filter.predict(state, np.zeros(6), DT)
        ranges = simulate(rng, ANCHORS, tags, *pose, NOISE)
        links = np.ones(ranges.shape, bool)
        links[..., list(dead)] = False
        state = filter.update(state, ranges, ANCHORS, links)
        belief = filter.belief(state)
        wide = np.linalg.eigvalsh(belief.covariance[:, :3, :3])[:, -1]
        expected = std[0] ** 2 + k * DT * TURN**2
        np.testing.assert_allclose(wide, expected, rtol=0.05)
    assert expected > 0.5**2
    assert searches == []
    heard = np.delete(tags, list(dead), axis=0)
    nees = tag_nees(belief, pose[0], pose[1], heard)
    # 12 bodies, 3 degrees of freedom: the mean is within five standard deviations of 3.
    assert abs(nees.mean() - 3) < 5 * np.sqrt(6 / 12)


def tag_nees(belief, rotation, translation, tags):
    """Squared errors (B, N) of the tags' places in their own covariance."""
    got = ranging.tag_positions(belief.rotation, belief.translation, tags)
    error = (got - ranging.tag_positions(rotation, translation, tags))[..., None]
    J = bounds.tag_jacobian(belief.rotation, tags)
    P = J @ belief.covariance[:, None] @ np.swapaxes(J, -1, -2)
    return (error * np.linalg.solve(P, error)).sum(axis=(-2, -1))


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_an_update_tells_nothing_new_about_a_direction_without_ranges(offset):
    """The information along the null direction is that of the prior, to rounding."""
    rng = np.random.default_rng(3)
    tags = PAIR + offset * np.array([0.2, 0.7, -0.4])
    root = rng.standard_normal((6, 6))
    prior = PoseState(rotations.random(rng), np.array([4, 3, 1.2]), root @ root.T / 20)
    pose = rotations.exp([0.2, -0.1, 0.3]) @ prior.rotation, prior.translation + 0.2
    filter = make(tags, iterations=10)
    after = filter.update(prior, simulate(rng, ANCHORS, tags, *pose, NOISE), ANCHORS)

    def along(state):
        line = state.rotation @ [1.0, 0, 0]
        null = np.concatenate([line, -np.cross(line, state.rotation @ tags[0])])
        return null @ np.linalg.solve(state.covariance, null)

    np.testing.assert_allclose(along(after), along(prior), rtol=1e-6)
    assert np.linalg.det(after.covariance) < 1e-6 * np.linalg.det(prior.covariance)


def test_a_body_whose_tags_span_a_plane_keeps_its_covariance():
    rng = np.random.default_rng(4)
    pose = PoseState(rotations.random(rng, (5,)), rng.random((5, 3)), np.tile(np.eye(6), (5, 1, 1)))
    for tags in (THREE, bodies.plate(), bodies.octahedron(0.8)):
        assert kept_wide(pose, pose, np.ones(len(tags), bool), tags) is pose
    # Of trials whose links are lost to all but two tags, these alone are looked at.
    heard = np.ones((5, 3), bool)
    heard[2, 2] = False
    turned = pose._replace(rotation=rotations.exp([0.3, 0, 0]) @ pose.rotation)
    got = kept_wide(pose, turned, heard, THREE).covariance
    same = (got == pose.covariance).all(axis=(-2, -1))
    np.testing.assert_array_equal(same, [True, True, False, True, True])


# --- global starts ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["iekf", "iekf-bank", "iekf-bias"])
def test_a_first_epoch_is_searched_once_and_the_roll_of_two_tags_never_again(name, searches):
    rng = np.random.default_rng(5)
    filter = make(PAIR, name)
    state = filter.initial(np.eye(3), [4, 3, 1.5], np.diag([np.pi**2] * 3 + [9.0] * 3))
    for k, pose in enumerate(wander(rng, (8,), 30)):
        if k:
            state = filter.predict(state, np.zeros(6), DT)
        state = filter.update(state, simulate(rng, ANCHORS, PAIR, *pose, NOISE), ANCHORS)
    assert searches == [8]
    belief = filter.belief(state)
    found = ranging.tag_positions(belief.rotation, belief.translation, PAIR)
    gap = np.linalg.norm(found - ranging.tag_positions(pose[0], pose[1], PAIR), axis=-1)
    # One of the 16 tags may be in doubt between the two ends of so short a body.
    assert np.median(gap) < 0.1
    assert (np.linalg.eigvalsh(belief.covariance[:, :3, :3])[:, -1] > 0.5**2).all()


def test_single_ranges_are_never_searched_and_a_third_tag_that_speaks_again_is(searches):
    """The roll of two tags passes 0.5 rad; ranges to the third settle it at once."""
    rng = np.random.default_rng(6)
    filter = make(THREE)
    poses = list(wander(rng, (), 40))
    links = estimators.Asynchronous(filter, ANCHORS, len(THREE), window_s=0.1)
    offset = 0.1 * rng.standard_normal(6)
    start = rotations.exp(offset[:3]) @ poses[0][0], poses[0][1] + offset[3:]
    stream = links.start(filter.initial(*start, 0.1**2 * np.eye(6)), time=-DT)
    for k, pose in enumerate(poses):
        ranges = simulate(rng, ANCHORS, THREE, *pose, NOISE)
        for tag in (0, 1):
            for anchor in rng.permutation(len(ANCHORS))[:3]:
                stream = links.add(stream, k * DT, anchor, tag, ranges[anchor, tag])
    state = links.state(stream)
    wide = np.linalg.eigvalsh(state.covariance[:3, :3])[-1]
    np.testing.assert_allclose(wide, 0.1**2 + len(poses) * DT * TURN**2, rtol=0.1)
    assert searches == []
    after = filter.update(state, ranges, ANCHORS)
    assert searches == [1]
    assert metrics.nees(metrics.pose_error(after[0], after[1], *pose), after.covariance) < 22


def test_a_lost_track_is_searched_once(searches):
    """A minute without ranges: nothing is known of the turn, and the next epoch tells it."""
    rng = np.random.default_rng(7)
    tags = bodies.octahedron(0.8)
    pose = rotations.random(rng, (40,)), rng.uniform([2, 2, 0.5], [6, 4, 2], (40, 3))
    filter = make(tags)
    state = filter.initial(np.eye(3), [4, 3, 1.2], np.diag([0.01] * 3 + [1.0] * 3))
    # A direction that passes 0.5 rad is no reason to refuse, with or without ranges.
    state = filter.predict(state, np.zeros(6), 60.0)
    state = filter.update(state, np.ones((7, 6)), ANCHORS, np.zeros((7, 6), bool))
    assert searches == []
    for _ in range(3):
        state = filter.update(state, simulate(rng, ANCHORS, tags, *pose, NOISE), ANCHORS)
    assert searches == [40]
    error = metrics.pose_error(state.rotation, state.translation, *pose)
    assert (metrics.nees(error, state.covariance) < 22).mean() > 0.95


def test_a_bank_of_two_tags_that_was_carried_off_finds_them_again():
    """The bodies are put elsewhere between two epochs, metres away from where the bank thinks."""
    rng = np.random.default_rng(10)
    bank: Any = make(PAIR, "iekf-bank")
    start = rotations.random(rng, (20,)), rng.uniform([1, 1, 0.5], [3, 2, 2], (20, 3))
    state = bank.initial(*start, np.diag([0.01] * 3 + [0.01] * 3))
    pose = rotations.random(rng, (20,)), rng.uniform([5, 4, 0.5], [7, 5, 2], (20, 3))
    for k in range(12):
        here = start if k < 2 else pose
        state = bank.predict(state, np.zeros(6), DT) if k else state
        state = bank.update(state, simulate(rng, ANCHORS, PAIR, *here, NOISE), ANCHORS)
    belief = bank.belief(state)
    gap = ranging.tag_positions(belief.rotation, belief.translation, PAIR)
    gap = np.linalg.norm(gap - ranging.tag_positions(*pose, PAIR), axis=-1)
    assert (gap < 0.2).mean() > 0.9


@pytest.mark.parametrize(
    ("anchors", "tags"),
    [(ANCHORS[:2], bodies.pyramid()), (ANCHORS[[0, 0, 0]] + [[0, 0, 0], [5, 0, 0], [9, 0, 0]],
                                       bodies.pyramid()), (ANCHORS[:3], PAIR)],
    ids=["two anchors", "anchors in a line", "two tags"],
)  # fmt: skip
@pytest.mark.parametrize("name", ["iekf", "iekf-bank", "iekf-cv", "iekf-bias"])
def test_a_geometry_that_cannot_tell_a_pose_is_carried_by_the_prior(anchors, tags, name):
    pose = rotations.exp([0.3, 0.1, -0.2]), np.array([3.0, 2.0, 1.0])
    ranges = ranging.distances(anchors, ranging.tag_positions(*pose, tags))
    filter = make(tags, name)
    tight = filter.update(filter.initial(*pose, 0.01 * np.eye(6)), ranges, anchors)
    assert np.linalg.norm(filter.belief(tight).translation - pose[1]) < 0.05
    vague = filter.initial(np.eye(3), [3, 2, 1], np.diag([np.pi**2] * 3 + [9.0] * 3))
    belief = filter.belief(filter.update(vague, ranges, anchors))
    assert np.linalg.eigvalsh(belief.covariance[:3, :3])[-1] > 0.5**2


@pytest.mark.parametrize("std_rad", [0.5, np.pi])
@pytest.mark.parametrize(
    ("name", "options"),
    [("iekf", {}), ("iekf", {"robust": True}), ("iekf-bank", {}), ("iekf-bias", {})],
)
def test_a_planar_robot_with_two_tags_has_a_heading(std_rad, name, options, searches):
    """Eight anchors above, height, roll and pitch held by the prior."""
    rng = np.random.default_rng(8)
    anchors = np.array([[x, y, 2.0] for x in (0, 4, 8) for y in (0, 3, 6) if (x, y) != (4, 3)])
    noise = ranging.RangeNoise(0.05)
    process = motion.ProcessNoise((0.0, 0.0, TURN), (WALK, WALK, 0.0))
    filter = estimators.make(name, tags=PAIR, noise=noise, process=process, **options)
    heading = rng.uniform(-np.pi, np.pi, 20)
    translation = np.column_stack([rng.uniform([2, 1.5], [6, 4.5], (20, 2)), np.full(20, 1.2)])
    turned = rotations.from_euler_zyx(heading, np.zeros(20), np.zeros(20))
    guess = rotations.from_euler_zyx(
        heading + min(std_rad, 0.5) * rng.standard_normal(20), np.zeros(20), np.zeros(20)
    )
    std = np.array([1e-3, 1e-3, std_rad, 1.0, 1.0, 1e-3])
    state = filter.initial(
        guess, translation + std[3:] * rng.standard_normal((20, 3)), np.diag(std**2)
    )
    errors = []
    for k in range(40):
        if k:
            step = np.sqrt(DT) * rng.standard_normal((20, 3))
            heading = heading + TURN * step[:, 0]
            translation[:, :2] += WALK * step[:, 1:]
            turned = rotations.from_euler_zyx(heading, np.zeros(20), np.zeros(20))
            state = filter.predict(state, np.zeros(6), DT)
        state = filter.update(
            state, simulate(rng, anchors, PAIR, turned, translation, noise), anchors
        )
        belief = filter.belief(state)
        errors.append(metrics.pose_error(belief.rotation, belief.translation, turned, translation))
    assert len(searches) <= 1
    settled = np.array(errors[10:])
    assert np.sqrt((settled[..., 3:5] ** 2).sum(-1).mean()) < 0.05
    assert np.rad2deg(np.median(np.abs(settled[..., 2]))) < 5
    assert np.abs(settled[..., 2]).max() < np.deg2rad(45)


def test_angles_to_two_tags_run_on_too(searches):
    rng = np.random.default_rng(9)
    filter = estimators.make("iekf", tags=PAIR, noise=bearing.AngleNoise(0.005), process=PROCESS,
                             measurement="doa", range_noise=NOISE)  # fmt: skip
    station = np.zeros(3)
    pose = rotations.random(rng, (6,)), np.array([3.0, 4.0, 2.0]) + rng.random((6, 3))
    state: Any = filter.initial(*pose, np.diag([0.2**2] * 3 + [0.1**2] * 3))
    told: Any = filter
    for k in range(60):
        state = filter.predict(state, np.zeros(6), DT) if k else state
        angles = bearing.simulate(PAIR, *pose, bearing.AngleNoise(0.005), rng, station)
        ranges = simulate(rng, station[None], PAIR, *pose, NOISE)
        state = told.update(state, angles, station, ranges=ranges)
    wide = np.linalg.eigvalsh(state.covariance[:, :3, :3])[:, -1]
    np.testing.assert_allclose(wide, 0.2**2 + 59 * DT * TURN**2, rtol=0.05)
    assert searches == []
    vague = filter.initial(np.eye(3), [3.5, 4.5, 2.5], np.diag([np.pi**2] * 3 + [1.0] * 3))
    found = told.update(vague, angles, station, ranges=ranges)
    assert searches == [6]
    assert np.linalg.norm(found.translation - pose[1], axis=-1).max() < 0.3


def test_a_held_axis_may_round_below_zero():
    """Rotations to start from, about the axes that are uncertain; a held one is left alone."""
    covariance = np.diag([-1e-22, 0.0, 1.0, 1, 1, 1])[None, None]
    prior = PoseState(np.eye(3)[None, None], np.zeros((1, 1, 3)), covariance)
    turns = rotations.log(vague_start.spread(prior))
    assert np.isfinite(turns).all()
    np.testing.assert_allclose(turns[..., :2], 0.0, atol=1e-9)
    assert np.ptp(turns[..., 2]) > 3
