"""Poses of networks in batches: against the sparse estimator, finite differences, the Jacobians."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize

from rbl_gym.estimators import frames
from rbl_gym.estimators.networks.beliefs import network_belief
from rbl_gym.estimators.networks.poses import network_poses
from rbl_gym.networks.bounds import (
    Sensing,
    bearing_jacobian,
    frame_covariance,
    linked_pose_covariance,
    pose_information,
    range_jacobian,
)
from rbl_gym.networks.sensing import proj, true_bearings

N = 7
SENSING = Sensing(0.03, 0.05, (3.0, 1.0), 1.8, 5.0)
# Lengths of which nothing is known beforehand.
OPEN = SENSING._replace(typical_length_m=(3.0, 1e5), prior_std_rad=1e5, prior_std_m=1e5)


def network(seed, links=None):
    """Positions and orientations in the frame of node 0; edges, links, bearings and lengths."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 6, (N, 2))
    places -= places[0]
    theta = np.concatenate([[0.0], rng.uniform(-3, 3, N - 1)])
    if links is None:
        links = np.triu(rng.random((N, N)) < 0.75, 1)
        links[0, 1:] = True
        links = links | links.T
    edges = np.argwhere(np.triu(links))
    bearings, lengths = np.zeros((N, N)), np.zeros((N, N))
    i, j = edges.T
    both = true_bearings(places, theta, edges) + 0.03 * rng.standard_normal((len(edges), 2))
    bearings[i, j], bearings[j, i] = both.T
    lengths[i, j] = np.linalg.norm(places[i] - places[j], axis=1)
    lengths[i, j] = lengths[j, i] = np.abs(lengths[i, j] + 0.05 * rng.standard_normal(len(edges)))
    return places, theta, edges, links, bearings, lengths


def test_poses_are_those_of_the_sparse_estimator():
    for seed in range(4):
        _, theta, edges, links, bearings, lengths = network(seed)
        i, j = edges.T
        want = frames(edges, np.column_stack([bearings[i, j], bearings[j, i]]), N,
                      bearing_std_rad=0.03, ranges=lengths[i, j], range_std_m=0.05)  # fmt: skip
        found = network_poses(
            links, bearings, lengths, OPEN, theta + 0.1 * (theta != 0), np.zeros((N, 2))
        )
        np.testing.assert_allclose(found.positions, want.positions, atol=1e-6)
        np.testing.assert_allclose(proj(found.orientations - want.orientations), 0, atol=1e-7)
        assert found.chi_square == pytest.approx(want.cost, rel=1e-6)
        assert found.degrees == pytest.approx(3 * len(edges) - 3 * (N - 1), abs=1e-4)


def test_a_network_that_is_not_rigid_is_held_by_the_typical_length():
    """A chain: against scipy's least squares of all residuals, those of the lengths too."""
    links = np.abs(np.subtract.outer(np.arange(N), np.arange(N))) == 1
    places, theta, edges, links, bearings, lengths = network(9, links)
    lengths = np.where(np.add.outer(np.arange(N), np.arange(N)) == 1, lengths, 0.0)
    i, j = edges.T

    def off(x):
        turned = np.concatenate([[0.0], x[: N - 1]])
        at = np.concatenate([[[0, 0]], x[N - 1 :].reshape(-1, 2)])
        both = np.column_stack([bearings[i, j], bearings[j, i]])
        apart = np.linalg.norm(at[j] - at[i], axis=1)
        return np.concatenate(
            [
                proj(both - true_bearings(at, turned, edges)).ravel() / 0.03,
                np.where(lengths[i, j] > 0, (apart - lengths[i, j]) / 0.05, 0.0),
                apart - 3.0,
            ]
        )

    start = np.concatenate([theta[1:], places[1:].ravel()])
    want = scipy.optimize.least_squares(off, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    sensing = OPEN._replace(typical_length_m=SENSING.typical_length_m)
    found = network_poses(links, bearings, lengths, sensing, theta, np.zeros((N, 2)))
    x = np.concatenate([found.orientations[1:], found.positions[1:].ravel()])
    assert float(off(x) @ off(x)) == pytest.approx(2 * want.cost, rel=1e-6, abs=1e-9)
    np.testing.assert_allclose(found.positions.ravel()[2:], want.x[N - 1 :], atol=1e-4)
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(want.jac.T @ want.jac), rtol=1e-3, atol=1e-4
    )
    # Two bearings and a length fix the three unknowns of a link. The one length that is measured
    # shares its unknown with the typical one; no other typical length is a measurement.
    assert found.degrees == pytest.approx(1 - 400 / 401, abs=1e-6)


def test_information_is_that_of_the_jacobians():
    places, _, edges, links, *_ = network(2)
    i, j = edges.T
    weights = np.zeros((N, N))
    weights[i, j] = weights[j, i] = np.linspace(1, 9, len(edges))
    B = bearing_jacobian(places, edges).toarray() / 0.03
    R = range_jacobian(places, edges).toarray() * np.sqrt(weights[i, j])[:, None]
    H = pose_information(places, links, 0.03, weights)
    np.testing.assert_allclose(H, B.T @ B + R.T @ R, atol=1e-9 * H.max())
    stacked = pose_information(np.stack([places, places + 1]), np.stack([links] * 2), 0.03, weights)
    np.testing.assert_allclose(stacked, [H, H], atol=1e-9 * H.max())


def test_the_bound_is_that_of_frames_where_nothing_is_known_beforehand():
    places, _, edges, links, *_ = network(3)
    every = linked_pose_covariance(places, links, links, OPEN)
    want = frame_covariance(places, edges, 0.03, ranges_of=edges, range_std_m=0.05)
    np.testing.assert_allclose(every, want, atol=1e-8 * want.max())
    known = np.zeros((N, N), dtype=np.bool_)
    known[0, 2] = known[2, 0] = True
    exact = OPEN._replace(length_std_m=1e-5)
    want = frame_covariance(places, edges, 0.03, known_pair=(0, 2))
    np.testing.assert_allclose(
        linked_pose_covariance(places, links, known, exact), want, atol=1e-5 * want.max()
    )


def test_a_batch_is_its_networks_one_by_one():
    worlds = [network(seed) for seed in range(5)]
    theta, links, bearings, lengths = (
        np.array([world[k] for world in worlds]) for k in (1, 3, 4, 5)
    )
    start = np.zeros((5, N, 2))
    batch = network_belief(links, bearings, lengths, theta, start, SENSING)
    for k in range(5):
        one = network_belief(links[k], bearings[k], lengths[k], theta[k], start[k], SENSING)
        for name in one._fields:
            np.testing.assert_allclose(getattr(batch, name)[k], getattr(one, name), atol=1e-10)


def test_variances_grow_with_the_residuals_and_end_at_the_prior():
    _, theta, _, links, bearings, lengths = network(5)
    start = np.zeros((N, 2))
    sharp = network_belief(links, bearings, lengths, theta, start, SENSING)
    # The same data under sensors that claim ten times less noise: a hundredfold chi-square.
    proud = SENSING._replace(bearing_std_rad=0.003, length_std_m=0.005)
    wide = network_belief(links, bearings, lengths, theta, start, proud)
    assert wide.chi_square == pytest.approx(100 * sharp.chi_square, rel=0.02)
    # With it the variances are again what the residuals say.
    ratio = np.trace(wide.covariance[1:], axis1=1, axis2=2).sum()
    ratio /= np.trace(sharp.covariance[1:], axis1=1, axis2=2).sum()
    assert ratio == pytest.approx(sharp.chi_square / max(float(sharp.chi_square), 1), rel=0.05)
    wild = network_belief(links, bearings + np.arange(float(N)), lengths, theta, start, proud)
    variance = np.diagonal(wild.covariance, axis1=-2, axis2=-1)
    assert (variance <= np.array([1.8, 5, 5]) ** 2 * (1 + 1e-12)).all()
    assert (variance[1:] > 0).all()
