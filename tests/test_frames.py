"""Frames of planar networks: exact data, the bound, ranges beside bearings, wrong input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym.estimators import frames
from rbl_gym.networks import rigidity, sensing
from rbl_gym.networks.bounds import (
    bearing_jacobian,
    frame_covariance,
    orientation_covariance,
    range_jacobian,
)
from rbl_gym.networks.sensing import proj, random_network, true_bearings

SQUARE = np.array([[0, 1], [1, 2], [2, 3], [0, 3]])


def of_node_0(positions, theta):
    """The truth in the frame of node 0."""
    c, s = np.cos(theta[0]), np.sin(theta[0])
    return (positions - positions[0]) @ np.array([[c, -s], [s, c]]), proj(theta - theta[0])


def lengths(positions, edges):
    return np.linalg.norm(positions[edges[:, 1]] - positions[edges[:, 0]], axis=1)


@pytest.fixture(scope="module")
def network():
    """A parallel rigid network of 14 nodes, in the frame of node 0."""
    rng = np.random.default_rng(3)
    while True:
        one = random_network(14, 8, 0.0, rng)
        if len(one.positions) == 14 and rigidity.localizability(one.positions, one.edges).frames:
            return *of_node_0(one.positions, one.orientations), one.edges


def test_exact_bearings_and_one_length_give_the_truth(network):
    positions, theta, edges = network
    bearings = true_bearings(positions, theta, edges)
    pair, length = (0, 0), 0.0
    for i, j in (edges[3], edges[-1], [0, 13]):
        pair, length = (i, j), float(np.linalg.norm(positions[j] - positions[i]))
        found = frames(edges, bearings, 14, pair, length)
        assert found.converged
        np.testing.assert_allclose(found.positions, positions, atol=1e-8)
        np.testing.assert_allclose(proj(found.orientations - theta), 0, atol=1e-9)
    twice = frames(edges, bearings, 14, pair, 2 * length)
    np.testing.assert_allclose(twice.positions, 2 * positions, atol=1e-8)


def test_ranges_localize_where_bearings_alone_do_not(network):
    positions, theta, _ = network
    positions, theta = positions[:4], theta[:4]
    bearings = true_bearings(positions, theta, SQUARE)
    with pytest.raises(ValueError, match=r"\(rank 5\), got rank 4: add edges"):
        frames(SQUARE, bearings, 4, (0, 1), 1.0)
    measured = lengths(positions, SQUARE)
    found = frames(SQUARE, bearings, 4, ranges=measured, range_std_m=0.1)
    np.testing.assert_allclose(found.positions, positions, atol=1e-7)
    # Three of four lengths still give the shape, two do not fix it together with its scale.
    one_less = np.where([1, 1, 1, 0], measured, 0)
    np.testing.assert_allclose(
        frames(SQUARE, bearings, 4, ranges=one_less, range_std_m=0.1).positions,
        positions,
        atol=1e-7,
    )
    with pytest.raises(ValueError, match="got rank"):
        frames(SQUARE, bearings, 4, ranges=np.where([1, 0, 0, 0], measured, 0), range_std_m=0.1)


@pytest.mark.parametrize("trials", [40, pytest.param(500, marks=pytest.mark.long)])
def test_errors_reach_the_bound_and_ranges_lower_it(network, trials):
    """To 4 standard deviations: the sums of variances, and all covariances together."""
    positions, theta, edges = network
    sigma, range_std = 0.01, 0.02
    pair = (int(edges[3, 0]), int(edges[3, 1]))
    known = float(np.linalg.norm(positions[pair[1]] - positions[pair[0]]))
    exact = lengths(positions, edges)
    rng = np.random.default_rng(4)
    errors = {"known": [], "ranged": []}
    for _ in range(trials):
        bearings = sensing.measure_bearings(positions, theta, edges, sigma, rng)
        # Two nodes are 5 cm apart: one range in thousands comes out below zero.
        ranges = np.abs(exact + range_std * rng.standard_normal(len(edges)))
        both = {
            "known": frames(edges, bearings, 14, pair, known),
            "ranged": frames(
                edges, bearings, 14, bearing_std_rad=sigma, ranges=ranges, range_std_m=range_std
            ),
        }
        for name, found in both.items():
            assert found.converged
            off = proj(found.orientations - theta)[1:], (found.positions - positions)[1:].ravel()
            errors[name].append(np.concatenate(off))
    bounds = {
        "known": frame_covariance(positions, edges, sigma, pair),
        "ranged": frame_covariance(positions, edges, sigma, ranges_of=edges, range_std_m=range_std),
    }
    for name, rows in errors.items():
        for part in (slice(13), slice(13, None)):
            square = np.square(rows)[:, part].sum(axis=1)
            scatter = 4 * square.std() / trials**0.5
            assert square.mean() == pytest.approx(np.trace(bounds[name][part, part]), abs=scatter)
        # What is known has no error: the chi-square has as many degrees as the bound has rank.
        nees = np.einsum("ti,ij,tj->t", rows, np.linalg.pinv(bounds[name], hermitian=True), rows)
        degrees = np.linalg.matrix_rank(bounds[name], hermitian=True)
        assert degrees == 39 - (name == "known")
        assert nees.mean() == pytest.approx(degrees, abs=4 * np.sqrt(2 * degrees / trials))
    # The positions know something of the orientations, and the ranges more.
    alone = np.trace(orientation_covariance(edges, 14, sigma))
    assert np.trace(bounds["known"][:13, :13]) < alone
    assert np.trace(bounds["ranged"][:13, :13]) < np.trace(bounds["known"][:13, :13])


def test_the_known_length_has_no_error_in_the_bound(network):
    positions, _, edges = network
    P = frame_covariance(positions, edges, 0.05, (0, 5))
    row = range_jacobian(positions, [[0, 5]]).toarray()[0]
    row = np.delete(row, [0, 14, 15])
    assert row @ P @ row == pytest.approx(0, abs=1e-12)


def test_jacobians_are_those_of_finite_differences(network):
    positions, theta, edges = network
    step = 1e-6

    def predicted(x):
        places = x[14:].reshape(-1, 2)
        return true_bearings(places, x[:14], edges).ravel(), lengths(places, edges)

    x = np.concatenate([theta, positions.ravel()])
    for which, jacobian in ((0, bearing_jacobian), (1, range_jacobian)):
        columns = [
            proj(predicted(x + step * unit)[which] - predicted(x - step * unit)[which]) / (2 * step)
            for unit in np.eye(len(x))
        ]
        np.testing.assert_allclose(
            jacobian(positions, edges).toarray(), np.transpose(columns), atol=1e-7
        )


def test_one_node_and_two():
    alone = frames([], [], 1)
    assert alone.converged
    assert alone.positions.tolist() == [[0, 0]]
    pair = frames([[0, 1]], [[0.5, -2.0]], 2, (0, 1), 3.0)
    np.testing.assert_allclose(pair.positions[1], 3 * np.array([np.cos(0.5), np.sin(0.5)]))
    np.testing.assert_allclose(pair.orientations, [0, float(proj(0.5 + 2.0 + np.pi))])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"known_pair": None},
            "either known_pair or ranges must be given, as one of them sets the scale; got neither",
        ),
        ({"ranges": np.ones(5), "range_std_m": 0.1}, "the scale; got both"),
        ({"length_m": None}, "length_m must be a number"),
        ({"length_m": -1.0}, "length_m must be"),
        ({"known_pair": (1, 1)}, "two different nodes"),
        ({"known_pair": (0, 7)}, "nodes 0 to 3"),
        ({"bearings": np.full((5, 2), np.nan)}, "bearings must be finite"),
        ({"bearings": np.zeros((4, 2))}, r"bearings must have shape \(5, 2\)"),
        ({"edges": [[0, 1], [0, 1], [1, 2], [0, 2], [0, 2]]}, r"components: \{0, 1, 2\}, \{3\}"),
        ({"known_pair": None, "ranges": -np.ones(5), "range_std_m": 1.0}, "ranges must not be neg"),
        ({"known_pair": None, "ranges": np.ones(5)}, "range_std_m must be a number"),
        ({"bearing_std_rad": 0.0}, "bearing_std_rad"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    arguments: dict[str, Any] = {
        "edges": [[0, 1], [1, 2], [2, 3], [0, 3], [0, 2]],
        "bearings": np.zeros((5, 2)),
        "n_nodes": 4,
        "known_pair": (0, 1),
        "length_m": 1.0,
        **change,
    }
    with pytest.raises(ValueError, match=message):
        frames(**arguments)


def test_the_bound_says_what_is_not_determined():
    positions = np.random.default_rng(0).uniform(size=(4, 2))
    with pytest.raises(ValueError, match="1 of their unknowns remain free"):
        frame_covariance(positions, SQUARE, 0.1, (0, 1))
    with pytest.raises(ValueError, match="either known_pair or ranges must be given"):
        frame_covariance(positions, SQUARE, 0.1)
