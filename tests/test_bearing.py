"""Directions of arrival: angles, derivatives, noise, and the Cramer-Rao bound of the pose."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym.bounds import doa
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import bearing
from tests.helpers import load

POINTS = np.random.default_rng(1).normal(size=(5, 4, 3))


def test_angles_are_those_to_the_axes():
    unit = POINTS / np.linalg.norm(POINTS, axis=-1, keepdims=True)
    found = bearing.angles(POINTS)
    np.testing.assert_allclose(found[:, 0], np.arccos(unit[..., 0]), atol=1e-12)
    np.testing.assert_allclose(found[:, 1], np.arccos(unit[..., 2]), atol=1e-12)
    np.testing.assert_allclose(bearing.angles(bearing.MIRROR * POINTS), found)
    np.testing.assert_allclose(bearing.angles(POINTS + [1, 2, 3], [1, 2, 3]), found)


def test_angles_keep_their_digits_at_both_ends_of_an_axis():
    for sign in (1.0, -1.0):
        found = bearing.angles([[sign, 1e-9, 0.0]])[0, 0]
        away = found if sign > 0 else np.pi - found
        np.testing.assert_allclose(away, 1e-9, rtol=1e-5 if sign < 0 else 1e-15, atol=5e-16)


def test_derivatives_by_finite_differences():
    J, step = bearing.jacobian(POINTS), 1e-6
    weights = np.random.default_rng(3).normal(size=(2, 5, 4))
    x = np.moveaxis(POINTS, -1, 0)
    curvature = bearing.curvature(x, weights)
    for axis in range(3):
        d = step * np.eye(3)[axis]
        numeric = (bearing.angles(POINTS + d) - bearing.angles(POINTS - d)) / (2 * step)
        np.testing.assert_allclose(J[..., axis], numeric, atol=1e-7)
        d = d[:, None, None]
        turned = (bearing.linearize(x + d)[1] - bearing.linearize(x - d)[1]) / (2 * step)
        numeric = np.einsum("abn,aibn->ibn", weights, turned)
        np.testing.assert_allclose(curvature[:, axis], numeric, atol=1e-5)


def test_on_an_axis_derivatives_are_finite():
    for point in np.eye(3):
        assert np.isfinite(bearing.jacobian(point[None])).all()
    assert np.isfinite(bearing.jacobian([[0.0, 0.0, 0.0]])).all()


def test_directions_invert_the_angles_and_infeasible_ones_are_unit_vectors():
    unit = POINTS / np.linalg.norm(POINTS, axis=-1, keepdims=True)
    back = bearing.directions(bearing.angles(POINTS), np.sign(unit[..., 1]))
    np.testing.assert_allclose(back, unit, atol=1e-9)
    impossible = np.array([[0.3], [0.3]])
    found = bearing.directions(impossible)[0]
    np.testing.assert_allclose(np.linalg.norm(found), 1.0)
    assert found[1] == 0.0


def test_noise_is_folded_back_and_has_its_standard_deviation():
    noise = bearing.AngleNoise(0.02)
    near_axis = np.full((2, 4), 1e-3)
    assert (noise.sample(near_axis, -np.ones((2, 4))) >= 0).all()
    assert (noise.sample(np.pi - near_axis, np.ones((2, 4))) <= np.pi).all()
    drawn = bearing.simulate(
        bodies.doa2019(), np.tile(np.eye(3), (4000, 1, 1)), [5.0, 5.0, 3.0], noise,
        np.random.default_rng(2), station=[0.0, 0.0, 1.0],
    )  # fmt: skip
    truth = bearing.angles(bodies.doa2019() + [5.0, 5.0, 2.0])
    np.testing.assert_allclose(drawn.std(axis=0), 0.02, rtol=0.05)
    np.testing.assert_allclose(drawn.mean(axis=0), truth, atol=0.002)


def test_the_bound_has_the_reference_coefficients():
    for case in load("doa.json")["cases"]:
        P = doa.doa_crb(case["C"], case["R"], case["t"], bearing.AngleNoise(1.0))
        want = case["ccrb_per_rad"]
        np.testing.assert_allclose(np.sqrt(2 * np.trace(P[:3, :3])), want["R_frobenius"], rtol=1e-9)
        np.testing.assert_allclose(np.sqrt(np.trace(P[3:, 3:])), want["t_m"], rtol=1e-9)
    P = doa.doa_crb(bodies.doa2019(), np.eye(3), [5, 5, 3], bearing.AngleNoise(1.0))
    np.testing.assert_allclose(np.sqrt(2 * np.trace(P[:3, :3])), 10.01873440, rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(np.trace(P[3:, 3:])), 23.64240626, rtol=1e-6)


def test_information_is_that_of_the_measurement_model():
    """J^T J / sigma^2 by finite differences of the angles by the pose error, a station aside."""
    tags, noise, station = bodies.pyramid(2.0), bearing.AngleNoise(0.01), np.array([1.0, -2.0, 0.5])
    rotation, translation = rotations.random(np.random.default_rng(4)), np.array([3.0, 5.0, 2.0])

    def seen(error):
        turned = tags @ (rotations.exp(error[:3]) @ rotation).T
        return bearing.angles(turned + translation + error[3:], station).ravel()

    J = np.stack([(seen(d) - seen(-d)) / 2e-6 for d in 1e-6 * np.eye(6)], axis=-1)
    found = doa.doa_information(tags, rotation, translation, noise, station)
    np.testing.assert_allclose(found, J.T @ J / 0.01**2, rtol=1e-5, atol=1e-3)
    batch = doa.doa_information(
        tags, np.tile(rotation, (2, 3, 1, 1)), np.tile(translation, (3, 1)), noise, station
    )
    assert batch.shape == (2, 3, 6, 6)
    np.testing.assert_allclose(batch, np.broadcast_to(found, batch.shape))


def test_what_does_not_determine_the_pose_is_refused_with_its_rank():
    with pytest.raises(ValueError, match="rank 4 of 6"):
        doa.doa_crb(bodies.doa2019()[:2], np.eye(3), [5, 5, 3], bearing.AngleNoise())
    prior = doa.doa_crb(bodies.doa2019()[:2], np.eye(3), [5, 5, 3], bearing.AngleNoise(), np.eye(6))
    assert np.isfinite(prior).all()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.full((2, 4), np.nan), "angles must be finite"),
        (np.full((2, 4), 45.0), "angles must be angles in radians on"),
        (np.full((2, 4), -0.2), "angles must be angles in radians on"),
        (np.zeros((2, 3)), "angles must have shape"),
    ],
)
def test_bad_angles_are_refused(value, message):
    with pytest.raises(ValueError, match=message):
        bearing.check_angles(value, 4)
    with pytest.raises(ValueError, match="std_rad must be"):
        bearing.AngleNoise(0.0)
    with pytest.raises(ValueError, match="noise must be a bearing"):
        doa.doa_crb(bodies.doa2019(), np.eye(3), [5, 5, 3], 0.1)  # pyrefly: ignore[bad-argument-type]


@pytest.mark.parametrize("scale", [1e-45, 1e-3, 1e9, 1e120, 1e150, 1e300])
def test_angles_and_derivatives_at_any_distance(scale):
    """Angles do not know the distance, gradients fall with it, nothing overflows."""
    x = np.random.default_rng(4).normal(size=(3, 200))
    found, gradient = bearing.linearize(x)
    far, flat = bearing.linearize(scale * x)
    np.testing.assert_allclose(far, found, rtol=1e-12)
    # A product with 1e-300 loses digits below the smallest normal number.
    np.testing.assert_allclose(
        flat * min(scale, 1e290), gradient * min(1, 1e290 / scale), rtol=1e-9, atol=1e-12
    )
    if scale < 1e150:
        weights = np.ones((2, 200))
        bent = bearing.curvature(scale * x, weights) * scale * scale
        np.testing.assert_allclose(bent, bearing.curvature(x, weights), rtol=1e-9, atol=1e-9)
