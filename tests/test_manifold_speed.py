"""The iterated EKF's arrays with trials last, against plain loops over trials."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bounds, components, estimators, motion
from rbl_gym.estimators.costs.range_cost import RangeCost, huber, lift_map
from rbl_gym.estimators.iekf import manifold
from rbl_gym.estimators.iekf.manifold import PoseState
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from tests.helpers import random_world, simulate

NOISE = ranging.RangeNoise(0.05, 0.001)
PROCESS = motion.ProcessNoise((0.02, 0.01, 0.03), 0.1)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """So that few trials make several blocks."""
    monkeypatch.setattr(manifold, "_BLOCK", 256)


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


@pytest.mark.parametrize("trials", [3, 600])
def test_prediction_equals_a_loop_over_trials(trials):
    rng, tags, *_, prior = world(trials)
    twist = rng.standard_normal((trials, 6))
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS)
    got = filter.predict(filter.initial(*prior), twist, 0.3)
    for k in range(0, trials, 7):
        want = naive_predict([a[k] for a in prior], twist[k], 0.3)
        assert_equal_poses([a[k] for a in got], want)
    single = filter.predict(filter.initial(*(a[0] for a in prior)), twist[0], 0.3)
    assert_equal_poses(single, naive_predict([a[0] for a in prior], twist[0], 0.3))


@pytest.mark.parametrize("iterations", [1, 2, 4])
@pytest.mark.parametrize("robust", [False, True])
def test_update_equals_a_loop_over_trials(iterations, robust):
    """Across the seams of the blocks, with lost links, and for one body alone."""
    trials = 600
    rng, tags, anchors, ranges, prior = world(trials)
    links = rng.random(ranges.shape) > 0.1
    weights = links / NOISE.variance(ranges)
    filter = estimators.make(
        "iekf", tags=tags, noise=NOISE, process=PROCESS, iterations=iterations, robust=robust
    )
    got = filter.update(filter.initial(*prior), ranges, anchors, links)
    assert all(a.flags.c_contiguous for a in got)
    threshold = 1.5 if robust else None
    for k in [0, 1, 254, 255, 256, 257, 511, 512, 599]:
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
    near = ranges[0] + 0.01 * np.random.default_rng(2).standard_normal((300, 2, *ranges[0].shape))
    got = filter.update(one, near, anchors[0])
    assert got.rotation.shape == (300, 2, 3, 3)
    many = filter.initial(*(a[:2] for a in prior))
    mixed = filter.update(many, near, anchors[:1])
    for k in (0, 127, 128, 299):
        want = filter.update(one, near[k, 1], anchors[0])
        assert_equal_poses([a[k, 1] for a in got], want)
        want = filter.update(filter.initial(*(a[1] for a in prior)), near[k, 1], anchors[0])
        assert_equal_poses([a[k, 1] for a in mixed], want)
    with pytest.raises(ValueError, match="anchors must not be empty"):
        filter.update(PoseState(*(a[:0] for a in prior)), ranges[:0], anchors[:0])


def test_vague_priors_in_a_later_block_start_globally_and_alone():
    _, tags, anchors, ranges, prior = world(300, anchors=7)
    P = prior[2].copy()
    P[290] = np.diag([10.0] * 3 + [100.0] * 3)
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS, iterations=6)
    got = filter.update(filter.initial(*prior[:2], P), ranges, anchors)
    for k in (0, 289, 290, 291):
        alone = filter.initial(prior[0][k], prior[1][k], P[k])
        assert_equal_poses([a[k] for a in got], filter.update(alone, ranges[k], anchors[k]))


def test_vague_priors_of_a_batch_of_two_axes_are_those_of_one():
    """More of them than one block of starts holds, good priors in between."""
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


@pytest.mark.parametrize("loss", [None, huber(1.5)])
def test_shared_tags_give_the_sums_of_tags_of_their_own(loss):
    _, tags, anchors, ranges, (rotation, translation, _) = world(20)
    weights = 1 / NOISE.variance(ranges)
    common = RangeCost(ranges, weights, anchors, tags, loss, lift=lift_map(tags))
    own = RangeCost(ranges, weights, anchors, np.tile(tags, (20, 1, 1)), loss)
    for a, b in zip(common(rotation, translation), own(rotation, translation), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * np.abs(b).max())


def test_an_anchor_on_a_tag_has_no_gradient_and_no_warning():
    tags = bodies.octahedron(0.8)
    anchors = np.array([tags[0], [5.0, 0, 0], [0, 5, 1]])
    cost = RangeCost(np.ones((3, 6)), np.ones((3, 6)), anchors, tags)
    at = cost(np.eye(3), np.zeros(3))
    assert np.isfinite(at.hessian).all()
    assert np.isfinite(at.gradient).all()


# --- linear algebra by components -------------------------------------------------------------


@pytest.mark.parametrize("batch", [(), (1,), (7,), (3, 4)])
def test_inverse_and_solve_equal_numpy(batch):
    rng = np.random.default_rng(3)
    root = rng.standard_normal((*batch, 6, 6)) * np.array([1e-3, 1, 1, 10, 1e3, 1])
    A = np.swapaxes(root, -1, -2) @ root
    b, damping = rng.standard_normal((*batch, 6)), rng.random(batch)
    got = components.last(components.inverse(components.first(A, 2)), 2)
    want = np.linalg.inv(A)
    scale = np.sqrt(np.diagonal(want, axis1=-2, axis2=-1))
    scale = scale[..., None] * scale[..., None, :]
    np.testing.assert_allclose(got / scale, want / scale, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got, np.swapaxes(got, -1, -2), rtol=1e-12)
    x = components.solve(components.first(A, 2), components.first(b, 1), damping)
    damped = (
        A * (1 + damping[..., None, None] * np.eye(6)) if batch else A + damping * A * np.eye(6)
    )
    want = np.linalg.solve(damped, b[..., None])[..., 0]
    np.testing.assert_allclose(components.last(x, 1), want, rtol=1e-9)


def test_a_matrix_that_is_not_positive_definite_is_refused():
    A = np.eye(6)[:, :, None] * np.array([1.0, 2.0])
    A[3, 3, 1] = 0.0
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        components.inverse(A)


def test_rotations_by_components_are_those_of_the_package():
    rng = np.random.default_rng(4)
    w = rng.standard_normal((50, 3)) * np.exp(rng.uniform(-12, 0, (50, 1)))
    for name in ("exp", "left_jacobian_inverse"):
        got = components.last(getattr(components, name)(components.first(w, 1)), 2)
        np.testing.assert_allclose(got, getattr(rotations, name)(w), rtol=1e-14, atol=1e-16)


# --- bounds of one body -----------------------------------------------------------------------


def test_bounds_of_one_pose_equal_those_of_a_batch():
    _, tags, anchors, _, (rotation, translation, P) = world(4)
    twist = np.random.default_rng(5).standard_normal((4, 6))
    places = anchors, tags, rotation, translation
    distance, J = bounds.range_jacobian(*places)
    information = bounds.information_at(*places, NOISE)
    predicted = bounds.predict_information(np.linalg.inv(P), twist, 0.2, PROCESS)
    b = bounds.score(P, rotation, tags)
    for k in range(4):
        one = anchors[k], tags, rotation[k], translation[k]
        single = bounds.range_jacobian(*one)
        np.testing.assert_allclose(single[0], distance[k], rtol=1e-14)
        np.testing.assert_allclose(single[1], J[k], atol=1e-14)
        np.testing.assert_allclose(
            bounds.information_at(*one, NOISE), information[k], rtol=1e-10, atol=1e-8
        )
        alone = bounds.predict_information(np.linalg.inv(P[k]), twist[k], 0.2, PROCESS)
        scale = np.abs(alone).max()
        np.testing.assert_allclose(alone, predicted[k], rtol=0, atol=1e-10 * scale)
        J_tags = bounds.tag_jacobian(rotation[k], tags)
        want = np.sqrt(np.mean([np.trace(j @ P[k] @ j.T) for j in J_tags]))
        np.testing.assert_allclose([b[k], bounds.score(P[k], rotation[k], tags)], want, rtol=1e-13)
