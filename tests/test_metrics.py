"""Metrics against naive loops, safe textbook formulas, and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate
from scipy.spatial.transform import Rotation

from rbl_gym import metrics
from rbl_gym.geometry import rotations

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
SEEDS = st.integers(0, 2**32 - 1)


def draw_covariance(rng: np.random.Generator, size: int = 6) -> np.ndarray:
    root = rng.standard_normal((size, size + 3))
    return root @ root.T


@PROPERTY
@given(SEEDS)
def test_pose_error_is_global_and_taken_off_by_its_own_motion(seed):
    rng = np.random.default_rng(seed)
    Q, t = rotations.random(rng, (4,)), rng.standard_normal((4, 3))
    error = rng.standard_normal((4, 6))
    Q_hat = Rotation.from_rotvec(error[:, :3]).as_matrix() @ Q
    error[:, :3] = Rotation.from_rotvec(error[:, :3]).as_rotvec()  # the short way
    got = metrics.pose_error(Q_hat, t + error[:, 3:], Q, t)
    np.testing.assert_allclose(got, error, atol=1e-12)


def test_pose_error_of_many_estimates_of_one_pose_is_a_loop():
    rng = np.random.default_rng(0)
    Q_hat, t_hat = rotations.random(rng, (5, 2)), rng.standard_normal((2, 3))
    got = metrics.pose_error(Q_hat, t_hat, np.eye(3), np.ones(3))
    assert got.shape == (5, 2, 6)
    for i, j in np.ndindex(5, 2):
        want = metrics.pose_error(Q_hat[i, j], t_hat[j], np.eye(3), np.ones(3))
        np.testing.assert_allclose(got[i, j], want, atol=1e-15)


@PROPERTY
@given(SEEDS)
def test_tag_error_equals_the_naive_mean(seed):
    rng = np.random.default_rng(seed)
    Q_hat, Q = rotations.random(rng, (2,))
    t_hat, t = rng.standard_normal((2, 3))
    tags = rng.standard_normal((6, 3))
    total = sum(np.sum((Q_hat @ c + t_hat - Q @ c - t) ** 2) for c in tags)
    got = metrics.tag_error(Q_hat, t_hat, Q, t, tags)
    np.testing.assert_allclose(got, (total / 6) ** 0.5, rtol=1e-12)
    R, shift, order = rotations.random(rng), rng.standard_normal(3), rng.permutation(6)
    moved = R @ Q_hat, R @ t_hat + shift, R @ Q, R @ t + shift, tags[order]
    np.testing.assert_allclose(metrics.tag_error(*moved), got, rtol=1e-11)


def test_tag_error_of_a_batch_is_a_loop_and_zero_at_the_truth():
    rng = np.random.default_rng(1)
    Q_hat, t_hat = rotations.random(rng, (3, 4)), rng.standard_normal((3, 4, 3))
    tags = rng.standard_normal((5, 3))
    got = metrics.tag_error(Q_hat, t_hat, np.eye(3), np.zeros(3), tags)
    for i in np.ndindex(3, 4):
        want = metrics.tag_error(Q_hat[i], t_hat[i], np.eye(3), np.zeros(3), tags)
        np.testing.assert_allclose(got[i], want)
    np.testing.assert_array_equal(metrics.tag_error(Q_hat, t_hat, Q_hat, t_hat, tags), 0)


def test_nees_of_consistent_errors_has_mean_6_and_variance_12():
    rng, n = np.random.default_rng(2), 20_000
    P = draw_covariance(rng)
    nees = metrics.nees(rng.multivariate_normal(np.zeros(6), P, n), np.broadcast_to(P, (n, 6, 6)))
    # Chi-square of 6: the mean is known to sqrt(12 / n), the variance to sqrt(720 / n); 4.5.
    assert abs(nees.mean() - 6) <= 4.5 * (12 / n) ** 0.5
    assert abs(nees.var() - 12) <= 4.5 * (720 / n) ** 0.5


@PROPERTY
@given(SEEDS, st.floats(1e-6, 1e6))
def test_nees_equals_the_inverse_and_is_free_of_units(seed, unit):
    rng = np.random.default_rng(seed)
    P, error = draw_covariance(rng), rng.standard_normal(6)
    want = error @ np.linalg.inv(P) @ error
    np.testing.assert_allclose(metrics.nees(error, P), want, rtol=1e-8)
    units = np.array([1, 1, 1, unit, unit, unit])
    scaled = metrics.nees(units * error, units[:, None] * P * units)
    np.testing.assert_allclose(scaled, want, rtol=1e-7)


def test_nees_of_a_batch_is_a_loop():
    rng = np.random.default_rng(3)
    P = np.stack([draw_covariance(rng) for _ in range(4)])
    error = rng.standard_normal((3, 4, 6))
    got = metrics.nees(error, P)
    for i, j in np.ndindex(3, 4):
        np.testing.assert_allclose(got[i, j], metrics.nees(error[i, j], P[j]))


# --- mean angular error -----------------------------------------------------------------------


@PROPERTY
@given(SEEDS)
def test_mean_angular_error_equals_arccos_where_that_is_safe(seed):
    rng = np.random.default_rng(seed)
    matrix, Q = rng.standard_normal((3, 3)), rotations.random(rng)
    cosines = [np.dot(matrix[:, k], Q[:, k]) / np.linalg.norm(matrix[:, k]) for k in range(3)]
    want = np.mean(np.arccos(np.clip(cosines, -1, 1)))
    np.testing.assert_allclose(metrics.mean_angular_error(matrix, Q), want, atol=1e-7)


@pytest.mark.parametrize("angle", [1e-12, 1e-8, 1e-3, 1.0, 3.0])
def test_turn_about_one_axis_moves_the_other_two_columns(angle):
    Q = rotations.random(np.random.default_rng(4))
    turned = Q @ rotations.exp(angle * np.eye(3))
    got = metrics.mean_angular_error(turned, Q)
    np.testing.assert_allclose(got, 2 / 3 * angle, rtol=1e-3 if angle < 1e-11 else 1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_expected_mean_angular_error_is_that_of_sampled_rotations(seed):
    rng, n = np.random.default_rng(seed), 20_000
    Q, P = rotations.random(rng), 1e-6 * draw_covariance(rng)
    w = rng.multivariate_normal(np.zeros(6), P, n)[:, :3]
    angles = metrics.mean_angular_error(rotations.exp(w) @ Q, Q)
    # 4.5 standard deviations of the mean, 1e-5 for the second order.
    want = metrics.expected_mean_angular_error(P, Q)
    assert abs(angles.mean() - want) <= 4.5 * angles.std() / n**0.5 + 1e-5 * want


@pytest.mark.parametrize("variances", [(1.0, 1.0, 1.0), (1.0, 2.0, 5.0), (1.0, 1e-6, 1e-12)])
def test_expected_mean_angular_error_equals_an_integral(variances):
    # E|x| of a plane Gaussian: sqrt(pi / 2) times the mean over directions of its deviation.
    def length(a: float, b: float) -> float:
        def deviation(u: float) -> float:
            return (a * np.cos(u) ** 2 + b * np.sin(u) ** 2) ** 0.5

        mean, _ = integrate.quad(deviation, 0, np.pi / 2, epsabs=1e-12, limit=200)
        return (np.pi / 2) ** 0.5 * mean / (np.pi / 2)

    x, y, z = variances
    want = (length(y, z) + length(x, z) + length(x, y)) / 3
    got = metrics.expected_mean_angular_error(np.diag([x, y, z, 1, 1, 1]), np.eye(3))
    np.testing.assert_allclose(got, want, rtol=1e-9)


@pytest.mark.parametrize("std", [0.0, 0.1])
def test_expected_mean_angular_error_of_a_planar_body(std):
    # Only the two columns in the plane move, by |N(0, std^2)|, of mean std sqrt(2 / pi).
    P = np.diag([0, 0, std**2, 1, 1, 0])
    got = metrics.expected_mean_angular_error(P, np.eye(3))
    np.testing.assert_allclose(got, 2 / 3 * std * (2 / np.pi) ** 0.5, rtol=1e-12)


def test_expected_mean_angular_error_of_a_turn_about_any_one_axis():
    # Rank 1, so that rounding makes some of the smaller eigenvalues negative.
    rng = np.random.default_rng(6)
    axis, Q = rng.standard_normal((200, 3)), rotations.random(rng, (200,))
    P = np.zeros((200, 6, 6))
    P[:, :3, :3] = axis[:, :, None] * axis[:, None, :]
    in_body = np.einsum("bji,bj->bi", Q, axis)
    across = [np.linalg.norm(np.delete(in_body, k, axis=1), axis=1) for k in range(3)]
    want = (2 / np.pi) ** 0.5 * np.mean(across, axis=0)
    np.testing.assert_allclose(metrics.expected_mean_angular_error(P, Q), want, rtol=1e-7)


def test_angular_errors_of_a_batch_are_a_loop():
    rng = np.random.default_rng(7)
    P = np.stack([draw_covariance(rng) for _ in range(4)])
    Q, matrix = rotations.random(rng, (3, 4)), rng.standard_normal((3, 4, 3, 3))
    expected = metrics.expected_mean_angular_error(P, Q)
    error = metrics.mean_angular_error(matrix, Q)
    for i, j in np.ndindex(3, 4):
        want = metrics.expected_mean_angular_error(P[j], Q[i, j])
        np.testing.assert_allclose(expected[i, j], want)
        np.testing.assert_allclose(error[i, j], metrics.mean_angular_error(matrix[i, j], Q[i, j]))


def test_length_is_the_euclidean_norm():
    vector = np.random.default_rng(11).standard_normal((4, 5, 3))
    np.testing.assert_allclose(metrics.length(vector), np.linalg.norm(vector, axis=-1), rtol=1e-14)
    assert metrics.length(np.array([3.0, 4.0, 12.0])) == 13.0
