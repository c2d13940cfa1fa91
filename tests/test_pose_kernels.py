"""Kernels of the iterated EKF and of `locate`, their textbook forms, and plain loops.

Shapes, lost links, noise of every link its own, lines and planes of tags and anchors.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbl_gym import bounds, estimators, kernels, motion
from rbl_gym.bounds import information as fisher
from rbl_gym.estimators.costs import losses
from rbl_gym.estimators.costs.map_problem import PoseState, minimize_ranges, positive_inverse
from rbl_gym.estimators.iekf.pose_steps import WEIGHTS, predict_pose, update_pose
from rbl_gym.estimators.locating.maximum_likelihood import most_likely_pose, points_start
from rbl_gym.estimators.locating.rotation_net import ROTATION_NET
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from tests.helpers import random_world, simulate

NOISE = ranging.RangeNoise(0.05, 0.001)
PROCESS = motion.ProcessNoise((0.02, 0.01, 0.03), 0.1)
needs_kernels = pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")

shapes = st.tuples(st.integers(1, 7), st.integers(1, 6))
geometries = st.sampled_from(
    ["solid", "tags in a line", "tags in a plane", "anchors in a line", "anchors in a plane",
     "tags in a point"]
)  # fmt: skip
some_losses = st.sampled_from(
    [losses.SQUARES, losses.huber(1.5), losses.cut_huber(1.5, 4.0),
     losses.geman_mcclure(3.0), losses.redescending(1.0)]
)  # fmt: skip

# Of offsets, as kernels have them.
kinds = st.integers(0, 3)


def epoch(seed, m, n, geometry="solid", lost=0.2, batch=(3,), wrong=0.0):
    """Prior pose and covariance, ranges, weights, anchors, tags of a batch of worlds."""
    rng = np.random.default_rng(seed)
    anchors, tags, rotation, translation = random_world(rng, m, n, batch)
    if geometry == "tags in a line":
        tags[:, 1:] = 0.0
    elif geometry == "tags in a plane":
        tags[:, 2] = 0.1
    elif geometry == "tags in a point":
        tags[:] = tags[0]
    elif geometry == "anchors in a line":
        anchors[..., 1:] = 1.0
    elif geometry == "anchors in a plane":
        anchors[..., 2] = 1.0
    root = 0.02 * rng.standard_normal((*batch, 6, 6)) + np.diag([0.05] * 3 + [0.2] * 3)
    P = root @ np.swapaxes(root, -1, -2)
    offset = (root @ rng.standard_normal((*batch, 6, 1)))[..., 0]
    law = ranging.LinkNoise(rng.uniform(0.03, 0.3, (m, n)))
    ranges = simulate(rng, anchors, tags, rotation, translation, law)
    ranges += 4 * (rng.random(ranges.shape) < wrong)
    links = rng.random(ranges.shape) >= lost
    rotation = rotations.exp(offset[..., :3]) @ rotation
    translation = translation + offset[..., 3:]
    # What was not measured may be anything.
    ranges = np.where(links, ranges, np.nan)
    return (rotation, translation, P), ranges, links / law.variance(ranges), anchors, tags


def assert_near(got, want, tolerance=1e-9):
    for a, b in zip(got, want, strict=True):
        np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b))
        known = np.isfinite(b)
        scale = max(1.0, np.abs(b[known]).max(initial=0.0))
        np.testing.assert_allclose(a[known], b[known], rtol=0, atol=tolerance * scale)


# --- kernels and textbook forms ---------------------------------------------------------------


@needs_kernels
@given(st.integers(0, 99), st.floats(0, 3), st.floats(0, 2))
def test_prediction(seed, turn, dt):
    (rotation, translation, P), *_ = epoch(seed, 1, 1)
    twist = turn * np.random.default_rng(seed).standard_normal((3, 6))
    args = rotation, translation, P, twist, dt, PROCESS.std() ** 2
    assert_near(predict_pose.kernel(*args), predict_pose.textbook(*args), 1e-12)


@needs_kernels
@given(
    st.integers(0, 999), shapes, geometries, st.sampled_from([0, 1, 2]), st.sampled_from([1, 4]),
    kinds,
)  # fmt: skip
def test_update(seed, shape, geometry, robust, iterations, offset):
    prior, *data = epoch(seed, *shape, geometry=geometry, wrong=0.1 if robust else 0.0)
    ranges, weights, *places = data
    args = *prior, ranges, weights, WEIGHTS, *places, *prior[:2], (offset, iterations, robust)
    with np.errstate(all="ignore"):
        got, want = update_pose.kernel(*args), update_pose.textbook(*args)
    # A prior that is singular to rounding leaves a pose that means nothing.
    known = np.isfinite(want[3])
    np.testing.assert_array_equal(np.isfinite(got[3]), known)
    assert_near([field[known] for field in got], [field[known] for field in want])


@needs_kernels
@pytest.mark.parametrize(
    "law",
    [
        NOISE,
        ranging.RangeNoise(0.0, 0.01, 1),
        ranging.RangeNoise(0.1),
        ranging.SquaredRangeNoise(0.05),
    ],
)
def test_update_by_the_numbers_of_a_law(law):
    prior, ranges, _, *places = epoch(3, 4, 3, lost=0.0)
    ranges[1, 2, 1] = -1.0
    args = *prior, ranges, np.ones((4, 3)), law.numbers, *places, *prior[:2], (0, 3, 0)
    with np.errstate(all="ignore"):
        got, want = update_pose.kernel(*args), update_pose.textbook(*args)
        weights = 1 / law.variance(ranges) + np.zeros_like(ranges)
        told = update_pose.kernel(*args[:4], weights, WEIGHTS, *args[6:])
    assert np.isnan(got[2][1]).all()
    for a, b in zip(got[:3], want[:3], strict=True):
        assert_near([a[[0, 2]]], [b[[0, 2]]])
    for a, b in zip(got, told, strict=True):
        assert_near([a[[0, 2]]], [b[[0, 2]]], 1e-12)


@needs_kernels
@given(st.integers(0, 999), shapes, geometries, some_losses, kinds)
def test_a_few_steps_by_every_loss(seed, shape, geometry, loss, offset):
    prior, *data = epoch(seed, *shape, geometry=geometry, wrong=0.1)
    information = positive_inverse(prior[2])
    args = *prior[:2], *prior[:2], information, *data, loss, offset, 3, 1e-6
    with np.errstate(all="ignore"):
        got, want = minimize_ranges.kernel(*args), minimize_ranges.textbook(*args)
    assert_near(got[:3], want[:3])
    assert_near(got[3:5], want[3:5], 1e-8)


@needs_kernels
@given(st.integers(0, 999), st.sampled_from([(4, 3), (5, 4), (10, 6)]), geometries)
def test_linear_starts(seed, shape, geometry):
    _, *data = epoch(seed, *shape, geometry=geometry, lost=0.1)
    with np.errstate(all="ignore"):
        got, want = points_start.kernel(*data), points_start.textbook(*data)
    # Of tags in a line any turn about it will do; of anchors in a plane rounding is the height.
    if geometry in ("solid", "tags in a plane"):
        assert_near(got, want, 1e-6)


@needs_kernels
@pytest.mark.parametrize("geometry", ["solid", "anchors in a plane", "tags in a plane"])
@pytest.mark.parametrize("shape", [(4, 5), (6, 6), (10, 6)])
def test_most_likely_poses_and_their_alternatives(shape, geometry):
    _, *data = epoch(1, *shape, geometry=geometry, lost=0.0, batch=(30,))
    start = points_start(*data)
    args = *data, *start, ROTATION_NET, np.empty((3, 6))
    with np.errstate(all="ignore"):
        got, want = most_likely_pose.kernel(*args), most_likely_pose.textbook(*args)
    # Of a trial that the ranges hardly determine the last digits are chance.
    firm = want[5] & (np.linalg.eigvalsh(want[4])[:, 0] > 1.0)
    assert firm.sum() >= 20
    np.testing.assert_allclose(got[2][firm], want[2][firm], rtol=1e-9, atol=1e-9)
    for k in (0, 1, 5):
        np.testing.assert_allclose(got[k][firm], want[k][firm], atol=1e-7)
    same = np.isfinite(got[8]) == np.isfinite(want[8])
    assert same[firm].mean() > 0.97
    both = np.isfinite(got[8]) & np.isfinite(want[8]) & same.all(axis=-1)[:, None]
    np.testing.assert_allclose(got[8][both], want[8][both], rtol=1e-6, atol=1e-6)


@needs_kernels
def test_what_is_not_positive_definite_is_nan_in_both():
    prior, *data = epoch(0, 4, 3)
    P = prior[2].copy()
    P[1] = 0.01 * np.diag([1.0, 1, -1, 1, 1, 1])
    P[2, 0, 0] = np.nan
    args = *prior[:2], P, *data[:2], WEIGHTS, *data[2:], *prior[:2], (0, 2, 0)
    for form in (update_pose.kernel, update_pose.textbook):
        with np.errstate(all="ignore"):
            got = form(*args)[2]
        np.testing.assert_array_equal(np.isfinite(got).all(axis=(-2, -1)), [True, False, False])
    filter = estimators.make("iekf", tags=data[3], noise=NOISE, process=PROCESS)
    state = PoseState(*(a[1] for a in (*prior[:2], P)))
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        filter.update(state, np.ones((4, 3)), data[2][1])


@needs_kernels
def test_an_anchor_on_a_tag_has_no_gradient():
    tags = bodies.octahedron(0.8)
    anchors = np.array([tags[0], [5.0, 0, 0], [0, 5, 1]])
    data = np.ones((3, 6)), np.ones((3, 6)), anchors, tags, losses.SQUARES
    start = np.eye(3), np.zeros(3)
    for form in (minimize_ranges.kernel, minimize_ranges.textbook):
        got = form(*start, *start, np.zeros((6, 6)), *data, 0, 0, 1e-6)
        without = form(
            *start, *start, np.zeros((6, 6)), np.ones((3, 6)),
            np.where((np.arange(18) == 0).reshape(3, 6), 0.0, 1.0), *data[2:], 0, 0, 1e-6,
        )  # fmt: skip
        assert got[2] > without[2]
        for a, b in zip(got[3:5], without[3:5], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12)


# --- against plain loops over trials and links ------------------------------------------------


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def naive_predict(prior, twist, dt):
    """One trial: F P F^T + dt G S G^T with 6 x 6 matrices."""
    rotation, translation, P = prior
    step = rotations.exp(twist[:3] * dt)
    F, G = np.eye(6), np.eye(6)
    F[:3, :3], G[:3, :3] = step, rotations.left_jacobian(twist[:3] * dt)
    P = F @ P @ F.T + dt * G @ np.diag(PROCESS.std() ** 2) @ G.T
    return step @ rotation, translation + twist[3:] * dt, P


def naive_update(prior, ranges, anchors, tags, weights, iterations, threshold=None):
    """One trial: Gauss-Newton, loops over links, and the inverse of the last Hessian."""
    Q0, t0, P = prior
    Q, t, prior_information = Q0, t0, np.linalg.inv(P)
    for k in range(iterations + 1):
        D = np.eye(6)
        turn = rotations.log(Q @ Q0.T)
        D[:3, :3] = rotations.left_jacobian_inverse(turn)
        error = np.concatenate([turn, t - t0])
        hessian = D.T @ prior_information @ D
        gradient = D.T @ prior_information @ error
        for m, n in np.ndindex(*ranges.shape):
            arm = Q @ tags[n]
            away = arm + t - anchors[m]
            distance = np.linalg.norm(away)
            J = np.concatenate([hat(arm) @ away, away]) / distance
            residual, w = distance - ranges[m, n], weights[m, n]
            if threshold is not None:
                w = w * min(1.0, threshold / max(np.sqrt(w) * abs(residual), 1e-300))
            hessian += w * np.outer(J, J)
            gradient += w * residual * J
        if k == iterations:
            return Q, t, np.linalg.inv(hessian)
        step = -np.linalg.solve(hessian, gradient)
        Q, t = rotations.exp(step[:3]) @ Q, t + step[3:]
    raise AssertionError


def world(trials, anchors=5):
    """Tags, true world, ranges and a prior that is off by its own standard deviation."""
    rng = np.random.default_rng(1)
    tags = bodies.octahedron(0.8)
    anchors, _, rotation, translation = random_world(rng, anchors, 6, (trials,))
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    root = 0.02 * rng.standard_normal((trials, 6, 6)) + np.diag([0.05] * 3 + [0.2] * 3)
    P = root @ np.swapaxes(root, -1, -2)
    offset = (root @ rng.standard_normal((trials, 6, 1)))[..., 0]
    rotation = rotations.exp(offset[:, :3]) @ rotation
    return rng, tags, anchors, ranges, (rotation, translation + offset[:, 3:], P)


def assert_equal_poses(got, want):
    np.testing.assert_allclose(got[0], want[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(got[1], want[1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got[2], want[2], rtol=0, atol=1e-9 * np.abs(want[2]).max())


def test_prediction_equals_a_loop_over_trials():
    rng, tags, *_, prior = world(40)
    twist = rng.standard_normal((40, 6))
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS)
    got = filter.predict(filter.initial(*prior), twist, 0.3)
    for k in range(40):
        want = naive_predict([a[k] for a in prior], twist[k], 0.3)
        assert_equal_poses([a[k] for a in got], want)
    single = filter.predict(filter.initial(*(a[0] for a in prior)), twist[0], 0.3)
    assert_equal_poses(single, naive_predict([a[0] for a in prior], twist[0], 0.3))


@pytest.mark.parametrize("iterations", [1, 2, 4])
@pytest.mark.parametrize("robust", [False, True])
def test_update_equals_a_loop_over_trials(iterations, robust):
    """With lost links, and for one body alone."""
    rng, tags, anchors, ranges, prior = world(40)
    links = rng.random(ranges.shape) > 0.1
    weights = links / NOISE.variance(ranges)
    filter = estimators.make(
        "iekf", tags=tags, noise=NOISE, process=PROCESS, iterations=iterations, robust=robust
    )
    got = filter.update(filter.initial(*prior), ranges, anchors, links)
    threshold = 1.5 if robust else None
    for k in range(0, 40, 5):
        one = [a[k] for a in prior]
        want = naive_update(one, ranges[k], anchors[k], tags, weights[k], iterations, threshold)
        assert_equal_poses([a[k] for a in got], want)
        single = filter.update(filter.initial(*one), ranges[k], anchors[k], links[k])
        assert_equal_poses(single, want)


def test_batches_of_several_axes_and_shared_arrays_are_a_loop():
    """Anchors common to a row, one prior for all: every way in which arrays broadcast."""
    _, tags, anchors, ranges, prior = world(600)
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS, iterations=2)
    one = filter.initial(*(a[0] for a in prior))
    near = ranges[0] + 0.01 * np.random.default_rng(2).standard_normal((30, 2, *ranges[0].shape))
    got = filter.update(one, near, anchors[0])
    assert got.rotation.shape == (30, 2, 3, 3)
    many = filter.initial(*(a[:2] for a in prior))
    mixed = filter.update(many, near, anchors[:1])
    for k in (0, 12, 29):
        want = filter.update(one, near[k, 1], anchors[0])
        assert_equal_poses([a[k, 1] for a in got], want)
        want = filter.update(filter.initial(*(a[1] for a in prior)), near[k, 1], anchors[0])
        assert_equal_poses([a[k, 1] for a in mixed], want)
    with pytest.raises(ValueError, match="anchors must not be empty"):
        filter.update(PoseState(*(a[:0] for a in prior)), ranges[:0], anchors[:0])


def test_vague_priors_of_a_batch_of_two_axes_are_those_of_one():
    """Good priors in between."""
    _, tags, anchors, ranges, prior = world(40, anchors=7)
    P = prior[2].copy()
    P[::2] = np.diag([10.0] * 3 + [100.0] * 3)
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS, iterations=6)
    flat = filter.update(filter.initial(*prior[:2], P), ranges, anchors)
    state = PoseState(*(a.reshape(4, 10, *a.shape[1:]) for a in (*prior[:2], P)))
    grid = ranges.reshape(4, 10, 7, 6), anchors.reshape(4, 10, 7, 3)
    assert_equal_poses([a.reshape(40, *a.shape[2:]) for a in filter.update(state, *grid)], flat)
    for k in (0, 21, 38):
        alone = filter.initial(prior[0][k], prior[1][k], P[k])
        assert_equal_poses([a[k] for a in flat], filter.update(alone, ranges[k], anchors[k]))


# --- bounds of one body -----------------------------------------------------------------------


def test_bounds_of_one_pose_equal_those_of_a_batch():
    _, tags, anchors, _, (rotation, translation, P) = world(4)
    twist = np.random.default_rng(5).standard_normal((4, 6))
    places = anchors, tags, rotation, translation
    distance, J = bounds.range_jacobian(*places)
    information = fisher.information_at(*places, NOISE)
    predicted = bounds.predict_information(np.linalg.inv(P), twist, 0.2, PROCESS)
    b = bounds.score(P, rotation, tags)
    for k in range(4):
        one = anchors[k], tags, rotation[k], translation[k]
        single = bounds.range_jacobian(*one)
        np.testing.assert_allclose(single[0], distance[k], rtol=1e-14)
        np.testing.assert_allclose(single[1], J[k], atol=1e-14)
        np.testing.assert_allclose(
            fisher.information_at(*one, NOISE), information[k], rtol=1e-10, atol=1e-8
        )
        alone = bounds.predict_information(np.linalg.inv(P[k]), twist[k], 0.2, PROCESS)
        scale = np.abs(alone).max()
        np.testing.assert_allclose(alone, predicted[k], rtol=0, atol=1e-10 * scale)
        J_tags = bounds.tag_jacobian(rotation[k], tags)
        want = np.sqrt(np.mean([np.trace(j @ P[k] @ j.T) for j in J_tags]))
        np.testing.assert_allclose([b[k], bounds.score(P[k], rotation[k], tags)], want, rtol=1e-13)


def test_information_about_tags_is_lifted_to_the_pose():
    rng = np.random.default_rng(6)
    J, U = rng.standard_normal((2, 5, 3, 6)), rng.standard_normal((2, 5, 3, 3))
    want = [sum(j.T @ u @ j for j, u in zip(*pair, strict=True)) for pair in zip(J, U, strict=True)]
    np.testing.assert_allclose(bounds.lift(J, U), want, atol=1e-12)
