"""The 3 x 4 statistic and the compressed measurement against the textbook's full matrices."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym.estimators.linear import squared_range
from rbl_gym.geometry import bodies
from rbl_gym.measurements import ranging
from tests.helpers import load, random_world, simulate, textbook_model


@pytest.mark.parametrize("case", load("static_estimates.json"), ids=["40 dB", "80 dB", "60 dB"])
def test_statistic_and_ls_of_the_reference_implementation(case):
    anchors, tags, ranges = np.array(case["A"]).T, np.array(case["C"]).T, np.array(case["rhat"])
    noise = ranging.RangeNoise(0.0, case["s0"], reference_tag=0)
    weights = 1 / noise.squared_range_variance(ranges)
    stat = squared_range.statistic(ranges, anchors, tags, weights)
    np.testing.assert_allclose(stat.G[0], case["G"], rtol=1e-9)
    B = stat.b.T @ squared_range.extended(stat.tags)
    np.testing.assert_allclose(B, case["B"], rtol=1e-9, atol=1e-9 * np.abs(case["B"]).max())
    matrix, vector = squared_range.information(stat)
    x = np.linalg.solve(matrix, vector)
    np.testing.assert_allclose(x[:9].reshape(3, 3).T, case["LS"]["Q"], atol=1e-9)
    np.testing.assert_allclose(x[9:], case["LS"]["t"], rtol=1e-9)


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("common", [False, True])
def test_information_and_compression_equal_the_full_model(common, lost):
    rng = np.random.default_rng(1)
    anchors, tags, rotation, translation = random_world(rng, 7, 5)
    noise = ranging.RangeNoise(0.05, 0.01, reference_tag=0 if common else None)
    ranges = simulate(rng, anchors, tags, rotation, translation, noise)
    weights = 1 / noise.squared_range_variance(ranges)
    links = None
    if lost:
        links = rng.random((7, 5)) > 0.3
        links[:, 2] = False  # a tag without any link
    stat = squared_range.statistic(ranges, anchors, tags, weights, links)
    assert stat.is_common == (common and not lost)
    H, z = textbook_model(ranges, anchors, tags, weights, links)
    matrix, vector = squared_range.information(stat)
    np.testing.assert_allclose(matrix, H.T @ H, atol=1e-9 * np.abs(H.T @ H).max())
    np.testing.assert_allclose(vector, H.T @ z, atol=1e-9 * np.abs(H.T @ z).max())
    short_z, short_H = squared_range.compressed(stat)
    assert short_H.shape == (12, 12)
    np.testing.assert_allclose(short_H.T @ short_H, matrix, atol=1e-9 * np.abs(matrix).max())
    np.testing.assert_allclose(short_H.T @ short_z, vector, atol=1e-9 * np.abs(vector).max())


def test_the_compressed_noise_is_standard_normal():
    """Residual z - H x at the truth: mean 0, covariance I, within 5 standard deviations."""
    rng = np.random.default_rng(2)
    anchors, tags, rotation, translation = random_world(rng, 6, 5)
    trials = 4000
    noise = ranging.SquaredRangeNoise(0.01)
    many = np.broadcast_to(rotation, (trials, 3, 3))
    ranges = simulate(rng, anchors, tags, many, translation, noise)
    true = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    weights = 1 / noise.squared_range_variance(true)
    z, H = squared_range.compressed(squared_range.statistic(ranges, anchors, tags, weights))
    residual = z - H @ np.concatenate([rotation.T.ravel(), translation])
    assert np.abs(residual.mean(axis=0)).max() < 5 / np.sqrt(trials)
    np.testing.assert_allclose(np.cov(residual.T), np.eye(12), atol=5 * np.sqrt(2 / trials))


def test_geometric_rank_counts_what_full_links_determine():
    cube = 10 * bodies.cube() + 3.0
    assert squared_range.geometric_rank(cube, bodies.pyramid()) == 12
    assert squared_range.geometric_rank(cube, bodies.plate()) == 9
    assert squared_range.geometric_rank(cube[:1], bodies.pyramid()) == 0
    flat = cube * [1, 1, 0]
    batch = squared_range.geometric_rank(np.stack([cube, flat]), bodies.pyramid())
    np.testing.assert_array_equal(batch, [12, 8])
