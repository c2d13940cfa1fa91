"""Rotations against the group axioms, power series, scipy and finite differences."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from rbl_gym.geometry import rotations

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
SEEDS = st.integers(0, 2**32 - 1)
SHAPES = [(), (5,), (2, 3)]
ANGLES = [
    0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.0099, 0.01, 0.0101, 0.5, 2.0, 3.0,
    np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi - 1e-12, np.pi,
]  # fmt: skip
BELOW_PI = ANGLES[:-1]


def turns(angle: float) -> np.ndarray:
    """Rotation vectors (12, 3) of one angle: about the axes, their opposites, and at random."""
    axes = np.random.default_rng(7).standard_normal((6, 3))
    axes = np.concatenate([np.eye(3), -np.eye(3), axes])
    return angle * axes / np.linalg.norm(axes, axis=-1, keepdims=True)


def cross_matrix(w: np.ndarray) -> np.ndarray:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def series(w: np.ndarray, shift: int) -> np.ndarray:
    """sum_k [w]x^k / (k + shift)!: the exponential (shift 0), the left Jacobian (shift 1)."""
    total, power, factorial = np.zeros((3, 3)), np.eye(3), 1.0
    for k in range(40):
        total += power / factorial
        power, factorial = power @ cross_matrix(w), factorial * (k + 1 + shift)
    return total


# --- group axioms -----------------------------------------------------------------------------


def test_identity_is_exact():
    np.testing.assert_array_equal(rotations.exp(np.zeros(3)), np.eye(3))
    np.testing.assert_array_equal(rotations.log(np.eye(3)), np.zeros(3))
    np.testing.assert_array_equal(rotations.left_jacobian(np.zeros(3)), np.eye(3))
    np.testing.assert_array_equal(rotations.left_jacobian_inverse(np.zeros(3)), np.eye(3))


# --- exponential, logarithm, quaternions ------------------------------------------------------


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_quaternion_equal_scipy(angle):
    w = turns(angle)
    scipy = Rotation.from_rotvec(w)
    Q = rotations.exp(w)
    np.testing.assert_allclose(Q, scipy.as_matrix(), atol=2e-15)
    got, want = rotations.quaternion(Q), np.roll(scipy.as_quat(), 1, axis=-1)
    want *= np.sign(np.sum(got * want, axis=-1, keepdims=True))  # q and -q are one rotation
    np.testing.assert_allclose(got, want, atol=2e-15)
    assert (got[..., 0] >= 0).all()


@pytest.mark.parametrize("angle", BELOW_PI)
def test_log_undoes_exp_to_relative_precision(angle):
    w = turns(angle)
    np.testing.assert_allclose(rotations.log(rotations.exp(w)), w, rtol=1e-12, atol=4e-15 * angle)


def test_log_at_half_a_turn_is_one_of_the_two_vectors():
    w = turns(np.pi)
    got = rotations.log(rotations.exp(w))
    np.testing.assert_allclose(np.linalg.norm(got, axis=-1), np.pi, rtol=1e-15)
    sign = np.sign(np.sum(got * w, axis=-1, keepdims=True))
    np.testing.assert_allclose(sign * got, w, atol=4e-15)


@PROPERTY
@given(SEEDS)
def test_log_equals_scipy_and_exp_undoes_it(seed):
    Q = rotations.random(np.random.default_rng(seed), (20,))
    w = rotations.log(Q)
    np.testing.assert_allclose(w, Rotation.from_matrix(Q).as_rotvec(), atol=1e-13)
    np.testing.assert_allclose(rotations.exp(w), Q, atol=4e-15)


@PROPERTY
@given(SEEDS, st.floats(1e-3, 1e3))
def test_from_quaternion_undoes_quaternion_at_any_length_and_sign(seed, length):
    rng = np.random.default_rng(seed)
    Q = Rotation.random(8, rng).as_matrix()
    q = rotations.quaternion(Q)
    for scale in (length, -length):
        np.testing.assert_allclose(rotations.from_quaternion(scale * q), Q, atol=4e-15)


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (np.zeros((2, 4)), "q must not be zero, got [0.0, 0.0, 0.0, 0.0] at index (0,)"),
        (np.ones(3), "q must have shape (..., 4), got (3,)"),
        ([1, 0, np.nan, 0], "q must be finite, got nan at index (2,)"),
    ],
)
def test_bad_quaternion_is_refused(q, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        rotations.from_quaternion(q)


@PROPERTY
@given(st.floats(-7, 7), st.floats(-7, 7), st.floats(-7, 7))
def test_euler_angles_equal_scipy(yaw, pitch, roll):
    want = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(rotations.from_euler_zyx(yaw, pitch, roll), want, atol=1e-14)


def test_euler_angles_broadcast_together():
    yaw, pitch = np.array([[0.1], [0.2]]), np.array([0.3, 0.4, 0.5])
    got = rotations.from_euler_zyx(yaw, pitch, 1)
    assert got.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(got[1, 2], rotations.from_euler_zyx(0.2, 0.5, 1))


@PROPERTY
@given(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_yaw_is_the_first_euler_angle(yaw, pitch, roll):
    got = rotations.yaw(rotations.from_euler_zyx(yaw, pitch, roll))
    np.testing.assert_allclose(got, yaw, atol=1e-13)


# --- Jacobians --------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_equals_its_power_series(angle):
    w = turns(angle)
    want = np.stack([series(row, 1) for row in w])
    np.testing.assert_allclose(rotations.left_jacobian(w), want, atol=5e-15)


@pytest.mark.parametrize("angle", [*ANGLES, 4.0, 6.0])
def test_left_jacobian_times_its_inverse_is_the_identity(angle):
    w = turns(angle)
    product = rotations.left_jacobian(w) @ rotations.left_jacobian_inverse(w)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=3e-14)


# --- nearest rotation -------------------------------------------------------------------------


def closeness(M: np.ndarray) -> float:
    """Largest tr(R^T M) over the rotations R: the top eigenvalue of Davenport's 4 x 4 matrix."""
    z = np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
    K = np.empty((4, 4))
    K[0, 0], K[0, 1:], K[1:, 0] = np.trace(M), z, z
    K[1:, 1:] = M + M.T - np.trace(M) * np.eye(3)
    return np.linalg.eigvalsh(K)[-1]


def matrices() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    M, Q = rng.standard_normal((3, 3)), rotations.random(rng)
    if np.linalg.det(M) < 0:
        M = -M
    rank1 = np.outer(M[0], M[1])
    return {
        "general": M, "reflected": -M, "near a rotation": Q + 0.01 * M,
        "a reflection": Q @ np.diag([1, 1, -1]), "minus a rotation": -Q,
        "rank 2": M @ np.diag([1, 1, 0]), "rank 1": rank1, "zero": np.zeros((3, 3)),
    }  # fmt: skip


@pytest.mark.parametrize("kind", matrices())
def test_nearest_is_a_rotation_that_no_other_beats(kind):
    M = matrices()[kind]
    R = rotations.nearest(M)
    rotations.check_rotation(kind, R, tolerance=1e-14)
    np.testing.assert_allclose(np.trace(R.T @ M), closeness(M), atol=1e-13)
    drawn = Rotation.random(5000, np.random.default_rng(0)).as_matrix()
    assert np.linalg.norm(R - M) <= np.linalg.norm(drawn - M, axis=(-2, -1)).min() + 1e-12


def nearest_by_svd(M: np.ndarray) -> np.ndarray:
    """The textbook's way, one matrix."""
    U, _, Vt = np.linalg.svd(M)
    return U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt


@pytest.mark.parametrize("noise", [0.0, 1e-9, 0.01, 0.1, 0.3, 0.5])
@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e25])
def test_nearest_of_a_batch_equals_the_svd(noise, scale):
    rng = np.random.default_rng(8)
    M = rotations.random(rng, (500,)) + noise * rng.standard_normal((500, 3, 3))
    want = np.stack([nearest_by_svd(m) for m in M])
    # Where two singular values nearly cancel the answer itself is ill-conditioned: sigma_2 +
    # sigma_3 (less it, of a reflection) divides every rounding error.
    values = np.linalg.svd(M, compute_uv=False)
    gap = values[:, 1] + np.sign(np.linalg.det(M)) * values[:, 2]
    assert (np.abs(rotations.nearest(scale * M) - want).max(axis=(1, 2)) * gap < 1e-12).all()


@pytest.mark.parametrize("kind", matrices())
def test_nearest_of_a_hard_matrix_in_a_batch_is_that_of_the_matrix_alone(kind):
    rng = np.random.default_rng(9)
    M = rotations.random(rng, (10, 10)) + 0.1 * rng.standard_normal((10, 10, 3, 3))
    M[3, 4] = matrices()[kind]
    got = rotations.nearest(M)
    assert got.shape == M.shape
    rotations.check_rotation(kind, got, tolerance=1e-14)
    np.testing.assert_allclose(got[3, 4], rotations.nearest(M[3, 4]), atol=1e-13)
    np.testing.assert_allclose(got[0, 0], rotations.nearest(M[0, 0]), atol=1e-14)


def test_log_of_a_batch_of_small_and_wide_turns_is_a_loop():
    w = np.concatenate([turns(angle) for angle in ANGLES])
    Q = rotations.exp(w)
    np.testing.assert_allclose(
        rotations.log(Q), [rotations.log(q) for q in Q], rtol=1e-13, atol=1e-15
    )


# --- errors and angles ------------------------------------------------------------------------


@pytest.mark.parametrize("angle", BELOW_PI)
def test_error_is_global(angle):
    Q = rotations.random(np.random.default_rng(0))
    w = turns(angle)
    np.testing.assert_allclose(rotations.error(rotations.exp(w) @ Q, Q), w, atol=3e-15)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("length", [1e-3, 1.0, 1e3])
def test_angle_between_keeps_small_and_large_angles(angle, length):
    u = np.array([length, 0, 0])
    v = np.array([np.cos(angle), np.sin(angle), 0]) * 2
    np.testing.assert_allclose(rotations.angle_between(u, v), angle, rtol=1e-14)


@PROPERTY
@given(SEEDS)
def test_hat_is_the_cross_product_and_vee_its_inverse(seed):
    w, v = np.random.default_rng(seed).standard_normal((2, 4, 3))
    W = rotations.hat(w)
    np.testing.assert_allclose((W @ v[..., None])[..., 0], np.cross(w, v), atol=1e-15)
    np.testing.assert_array_equal(rotations.vee(W), w)
    symmetric = v[:, :, None] * v[:, None, :]
    np.testing.assert_allclose(rotations.vee(W + symmetric), w, atol=1e-15)


# --- batches, draws, checks -------------------------------------------------------------------

VECTOR_FUNCTIONS = [rotations.exp, rotations.left_jacobian, rotations.left_jacobian_inverse,
                    rotations.hat]  # fmt: skip
MATRIX_FUNCTIONS = [rotations.log, rotations.quaternion, rotations.nearest, rotations.vee,
                    rotations.yaw]  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("function", VECTOR_FUNCTIONS + MATRIX_FUNCTIONS)
def test_a_batch_is_a_loop(function, shape):
    rng = np.random.default_rng(11)
    argument = rng.standard_normal((*shape, 3)) * np.exp(rng.uniform(-12, 0, (*shape, 1)))
    if function in MATRIX_FUNCTIONS:
        argument = Rotation.from_rotvec(argument.reshape(-1, 3)).as_matrix()
        argument = argument.reshape(*shape, 3, 3)
    got = function(argument)
    assert got.shape[: len(shape)] == shape
    for index in np.ndindex(*shape):
        np.testing.assert_allclose(got[index], function(argument[index]), rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("shape", SHAPES)
def test_draws_have_the_shape_asked_for(shape):
    assert rotations.random(np.random.default_rng(0), shape).shape == (*shape, 3, 3)


def test_draws_are_uniform():
    Q = rotations.random(np.random.default_rng(5), (4000,))
    angle = np.linalg.norm(rotations.log(Q), axis=-1)
    # Density of the angle under the uniform law: (1 - cos x) / pi.
    assert stats.kstest(angle, lambda x: (x - np.sin(x)) / np.pi).pvalue > 1e-3
    # Every entry is uniform on [-1, 1] (Archimedes): mean 0, variance 1/3; 4.5 deviations.
    np.testing.assert_allclose(Q.mean(axis=0), 0, atol=4.5 / (3 * 4000) ** 0.5)
    for row, column in np.ndindex(3, 3):
        assert stats.kstest(Q[:, row, column], stats.uniform(-1, 2).cdf).pvalue > 1e-4


@pytest.mark.parametrize("shape", SHAPES)
def test_good_rotations_pass(shape):
    Q = rotations.random(np.random.default_rng(0), shape)
    np.testing.assert_array_equal(rotations.check_rotation("Q", Q), Q)


@pytest.mark.parametrize(
    ("Q", "message"),
    [
        (
            1.001 * np.eye(3),
            "start must be orthogonal (a rotation matrix), but start times its transpose differs "
            "from the identity by 0.002",
        ),
        (np.stack([np.eye(3), np.diag([1, 1, -1])]), "start must be a proper rotation"),
        (np.eye(4), "start must have shape (..., 3, 3), got (4, 4)"),
        (np.full((3, 3), np.nan), "start must be finite, got nan at index (0, 0)"),
    ],
)
def test_bad_rotations_are_refused(Q, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        rotations.check_rotation("start", Q)


def test_an_empty_batch_is_refused_by_name():
    with pytest.raises(ValueError, match=r"^w must not be empty, got shape \(0, 3\)"):
        rotations.exp(np.zeros((0, 3)))


def test_cayley_is_its_definition_and_the_exponential_to_second_order():
    rng = np.random.default_rng(20)
    w = rng.standard_normal((50, 3))
    X = rotations.hat(w) / 2
    want = np.linalg.solve(np.eye(3) - X, np.eye(3) + X)
    np.testing.assert_allclose(rotations.cayley(w), want, atol=1e-13)
    angle = np.linalg.norm(w, axis=1)
    turned = np.linalg.norm(rotations.log(rotations.cayley(w)), axis=1)
    np.testing.assert_allclose(turned, 2 * np.arctan(angle / 2))
    short = 1e-3 * w
    # The third-order terms differ by |w|^3 / 12 of the rotation.
    gap = np.abs(rotations.cayley(short) - rotations.exp(short)).max(axis=(-2, -1))
    assert (gap <= np.linalg.norm(short, axis=1) ** 3 / 12 * 1.01 + 1e-15).all()
