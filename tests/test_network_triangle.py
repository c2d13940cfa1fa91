"""Three nodes in space: frames from bearings against the truth, a general solver, the bound."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rbl_gym.estimators import triangle_frames
from rbl_gym.estimators.networks.triangle import TRIANGLE_EDGES
from rbl_gym.geometry import rotations
from rbl_gym.networks import bounds, rigidity, sensing

PLACES = np.array([[0.0, 0.0, 0.0], [4.0, 1.0, 0.5], [1.0, 3.0, -2.0]])


def measured(sigma, rng, trials=1):
    """Truth and bearings; every node's frame is anyhow."""
    turned = rotations.random(rng, (trials, 3))
    seen = sensing.measure_in_space(PLACES, turned, TRIANGLE_EDGES, sigma, rng)
    return turned, seen


def test_exact_bearings_give_all_frames():
    turned, seen = measured(0.0, np.random.default_rng(0), 20)
    length = float(np.linalg.norm(PLACES[1] - PLACES[0]))
    found = triangle_frames(seen, length)
    first = np.swapaxes(turned[:, :1], -1, -2)
    np.testing.assert_allclose(found.rotation, first @ turned, atol=1e-12)
    in_first = (first @ (PLACES - PLACES[0])[..., None])[..., 0]
    np.testing.assert_allclose(found.position, in_first, atol=1e-12)
    np.testing.assert_allclose(found.misfit, 0, atol=1e-13)
    np.testing.assert_allclose(found.angle.sum(axis=-1), np.pi)
    for i, j in TRIANGLE_EDGES:  # pair by pair, from what rigidity says of three nodes
        k = 3 - i - j
        u = [PLACES[j] - PLACES[i], PLACES[i] - PLACES[j], PLACES[k] - PLACES[i],
             PLACES[k] - PLACES[j]]  # fmt: skip
        frames = [turned[0, i], turned[0, j], turned[0, i], turned[0, j]]
        pair = rigidity.triangle_rotation(*(R.T @ v for R, v in zip(frames, u, strict=True)))
        np.testing.assert_allclose(found.rotation[0, i] @ pair, found.rotation[0, j], atol=1e-12)


def test_it_is_the_least_squares_of_a_general_solver():
    """Rotations and places of nodes 1 and 2, by scipy; residuals are geodesic."""
    for seed in range(3):
        _, seen = measured(0.05, np.random.default_rng(seed))
        found = triangle_frames(seen[0])
        seen = seen[0] / np.linalg.norm(seen[0], axis=-1, keepdims=True)

        def residuals(x, seen=seen, found=found):
            turns = Rotation.from_rotvec(x[:9].reshape(3, 3)).as_matrix() @ found.rotation
            places = np.vstack([[0, 0, 0], found.position[1], x[9:12]])
            rows = []
            for row, (i, j) in enumerate(TRIANGLE_EDGES):
                for side, (a, b) in enumerate(((i, j), (j, i))):
                    u = turns[a].T @ (places[b] - places[a])
                    u = u / np.linalg.norm(u)
                    across = np.cross(u, seen[row, side])
                    sine = np.linalg.norm(across)
                    rows.append(across / sine * np.arctan2(sine, u @ seen[row, side]))
            return np.concatenate(rows)

        start = np.concatenate([np.full(9, 0.01), found.position[2] + 0.05])
        best = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        at = residuals(np.concatenate([np.zeros(9), found.position[2]]))
        assert at @ at == pytest.approx(2 * best.cost, rel=1e-6)
        assert at @ at == pytest.approx(found.misfit**2 / 6, rel=1e-9)
        turns = Rotation.from_rotvec(best.x[:9].reshape(3, 3)).as_matrix() @ found.rotation
        np.testing.assert_allclose(turns[0].T @ turns, found.rotation, atol=1e-5)


def test_errors_reach_the_bound_and_the_misfit_has_its_variance():
    """4000 trials, 4 standard deviations of a variance of 6 degrees of freedom at least."""
    sigma, trials = 0.01, 4000
    turned, seen = measured(sigma, np.random.default_rng(1), trials)
    found = triangle_frames(seen)
    truth = np.swapaxes(turned[:, :1], -1, -2) @ turned
    error = (
        Rotation.from_matrix((found.rotation @ np.swapaxes(truth, -1, -2))[:, 1:].reshape(-1, 3, 3))
        .as_rotvec()
        .reshape(trials, 6)
    )
    bound = bounds.space_orientation_covariance(PLACES, TRIANGLE_EDGES, sigma)
    # In node 0's frame, which is another one in every trial: traces only.
    for node in (slice(0, 3), slice(3, 6)):
        got = np.mean(np.sum(error[:, node] ** 2, axis=1))
        assert got == pytest.approx(np.trace(bound[node, node]), rel=4 * np.sqrt(2 / trials))
    assert found.misfit.var() == pytest.approx(6 * sigma**2, rel=4 * np.sqrt(2 / trials))


def test_the_bound_is_the_inverse_of_a_numeric_information():
    J = np.zeros((18, 18))
    shift = 1e-6

    def seen(x):
        turns = Rotation.from_rotvec(x[9:].reshape(3, 3)).as_matrix()
        places = PLACES + x[:9].reshape(3, 3)
        exact = sensing.measure_in_space(
            places, turns, TRIANGLE_EDGES, 0.0, np.random.default_rng(0)
        )
        return exact.ravel()

    for k in range(18):
        step = shift * np.eye(18)[k]
        J[:, k] = (seen(step) - seen(-step)) / (2 * shift)
    np.testing.assert_allclose(bounds.space_jacobian(PLACES, TRIANGLE_EDGES), J, atol=1e-8)
    # The gauge by another choice: frame 0 and the place of node 1 along its direction.
    u = PLACES[1] / np.linalg.norm(PLACES[1])
    kept = np.delete(J, [0, 1, 2, 9, 10, 11], axis=1)
    length = np.concatenate([u, np.zeros(9)])
    information = kept.T @ kept + np.outer(length, length)
    want = 0.02**2 * np.linalg.inv(information)[6:, 6:]
    got = bounds.space_orientation_covariance(PLACES, TRIANGLE_EDGES, 0.02)
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_what_cannot_be_solved_is_said():
    on_a_line = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    seen = sensing.measure_in_space(
        on_a_line, np.tile(np.eye(3), (3, 1, 1)), TRIANGLE_EDGES, 0.0, np.random.default_rng(0)
    )
    with pytest.raises(ValueError, match="bearings must span a triangle"):
        triangle_frames(seen)
    with pytest.raises(ValueError, match="motions remain free"):
        bounds.space_orientation_covariance(on_a_line, TRIANGLE_EDGES, 0.1)
    with pytest.raises(ValueError, match="bearings must have shape"):
        triangle_frames(np.ones((3, 3)))
    with pytest.raises(ValueError, match="got one of length 0"):
        triangle_frames(np.zeros((3, 2, 3)))
    with pytest.raises(ValueError, match=r"those of nodes \[[0-9], [0-9]\] are the same"):
        sensing.measure_in_space(
            np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)), TRIANGLE_EDGES, 0.0,
            np.random.default_rng(0),
        )  # fmt: skip
