"""Tag layouts: named shapes, centred tags, errors for bad sizes."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from rbl_gym.geometry import bodies

LAYOUTS = [bodies.pyramid, bodies.octahedron, bodies.cube, bodies.plate]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_come_centred_in_float64(layout):
    tags = layout(0.7)
    assert tags.dtype == np.float64
    np.testing.assert_allclose(tags.sum(axis=0), 0, atol=1e-15)


# Distances between the tags of a layout of size 2: (distance, how many pairs have it).
PAIRS = {
    bodies.pyramid: [(2, 4), (8**0.5, 2), (6**0.5, 4)],
    bodies.octahedron: [(2**0.5, 12), (2, 3)],
    bodies.cube: [(2, 12), (8**0.5, 12), (12**0.5, 4)],
}


@pytest.mark.parametrize("layout", PAIRS, ids=lambda f: f.__name__)
def test_distances_between_tags_are_those_of_the_solid(layout):
    want = sorted(distance for distance, count in PAIRS[layout] for _ in range(count))
    np.testing.assert_allclose(np.sort(pdist(layout(2.0))), want, rtol=1e-14)


def test_pyramid_points_up():
    np.testing.assert_allclose(bodies.pyramid(3.0)[:, 2], [-0.6, -0.6, -0.6, -0.6, 2.4])


def test_plate_is_a_flat_rectangle():
    tags = bodies.plate(4.0, 2.0)
    assert {tuple(tag) for tag in tags} == {(2, 1, 0), (-2, 1, 0), (-2, -1, 0), (2, -1, 0)}


def test_body_of_the_static_paper_keeps_its_origin():
    tags = bodies.icassp2013()
    assert tags.shape == (6, 3)
    np.testing.assert_array_equal(tags[[0, 2, 5]], [[1, 0, 0], [7, 5, 0], [2.5, 2.5, 5]])
    np.testing.assert_allclose(tags.mean(axis=0), [24.5 / 6, 17.5 / 6, 5 / 6])


def test_centred_takes_every_body_of_a_batch_by_itself():
    tags = np.random.default_rng(0).normal(5, 1, (4, 6, 3))
    got = bodies.centred(tags)
    for body, centred in zip(tags, got, strict=True):
        np.testing.assert_allclose(centred.sum(axis=0), 0, atol=1e-13)
        np.testing.assert_allclose(pdist(centred), pdist(body))


def test_perturbation_is_gaussian_of_the_stated_deviation_on_every_axis():
    tags = bodies.cube(1.0)
    batch = np.broadcast_to(tags, (4000, 8, 3))
    error = bodies.perturb(batch, 0.02, np.random.default_rng(1)) - tags
    # 32,000 draws an axis: a variance is known to sqrt(2 / n) of itself, a mean to std/sqrt(n).
    n = error[..., 0].size
    np.testing.assert_allclose(error.var(axis=(0, 1)), 0.02**2, rtol=4 * (2 / n) ** 0.5)
    np.testing.assert_allclose(error.mean(axis=(0, 1)), 0, atol=4 * 0.02 / n**0.5)
    correlation = np.corrcoef(error.reshape(4000, -1).T) - np.eye(24)
    assert np.abs(correlation).max() < 5 / 4000**0.5


def test_no_perturbation_changes_nothing():
    got = bodies.perturb(bodies.cube(), 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(got, bodies.cube())


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
def test_bad_size_is_refused(layout, size):
    with pytest.raises(ValueError, match=r"^(size|length)_m must be a finite number"):
        layout(size)


@pytest.mark.parametrize(
    ("tags", "std", "message"),
    [
        (np.ones((6, 2)), 0.1, "tags must have shape (..., N, 3), got (6, 2)"),
        (np.ones((6, 3)), -0.1, "std_m must be a finite number of at least 0, got -0.1"),
    ],
)
def test_bad_perturbation_is_refused(tags, std, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        bodies.perturb(tags, std, np.random.default_rng(0))
