"""Possible positions of anchors in a building: draws, projections, faces, forbidden parts."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym.geometry.mounts import Mounts, nearest_point
from rbl_gym.geometry.regions import Box, Faces, Shell, Walls

# A strip of wall 4 x 0.5 m, two triangles of 2 m2, one of 0.5 m2 with a height, a point.
PIECES = np.array(
    [
        [0, 0, 4, 0, 4, 0, 2, 2.5],
        [0, 0, 2, 0, 0, 2, 3, 3],
        [2, 0, 2, 2, 0, 2, 3, 3],
        [5, 5, 6, 5, 5, 6, 0, 1],
        [9, 9, 9, 9, 9, 9, 1, 1],
    ],
    float,
)
FACES = Faces(
    np.zeros((4, 3)),
    np.zeros((4, 3, 3)),
    np.zeros((4, 3)),
    np.array([[0, 1, 0], [0, 0, -1], [0, 0, 0], [0, 0, 0.0]]),
    np.array([1.0, 2, 3, 4]),
    ("wall", "ceiling", "area", "post"),
)
MOUNTS = Mounts(PIECES, np.array([0, 1, 1, 2, 3]), FACES)


def test_draws_fill_the_pieces_by_their_measure():
    rng = np.random.default_rng(0)
    points = MOUNTS.draw(rng.random((20_000, 3)))
    np.testing.assert_allclose(MOUNTS.measure, [2, 2, 2, 0.5, 1])
    share = np.bincount(MOUNTS.face_of(points), minlength=4) / len(points)
    wanted = np.array([2, 4, 0.5, 1]) / 7.5
    std = np.sqrt(wanted * (1 - wanted) / len(points))
    assert (np.abs(share - wanted) < 4 * std).all()
    np.testing.assert_allclose(MOUNTS.project(points), points, atol=1e-12)
    ceiling = points[MOUNTS.face_of(points) == 1]
    np.testing.assert_allclose(ceiling.mean(axis=0), [1, 1, 3], atol=0.05)
    # Uniform over the square of the two triangles: as many below as above either diagonal.
    assert abs((ceiling[:, 0] > ceiling[:, 1]).mean() - 0.5) < 0.03
    assert abs((ceiling[:, 0] + ceiling[:, 1] > 2).mean() - 0.5) < 0.03
    wall = points[MOUNTS.face_of(points) == 0]
    np.testing.assert_allclose(wall.mean(axis=0), [2, 0, 2.25], atol=0.1)
    low, high = MOUNTS.bounds()
    np.testing.assert_array_equal([low, high], [[0, 0, 0], [9, 9, 3]])


def test_the_nearest_point_is_nearer_than_every_drawn_one():
    rng = np.random.default_rng(1)
    points = rng.uniform(-2, 11, (300, 3))
    legal = MOUNTS.project(points)
    drawn = MOUNTS.draw(rng.random((4000, 3)))
    off = np.linalg.norm(points - legal, axis=1)
    least = np.linalg.norm(points[:, None] - drawn, axis=2).min(axis=1)
    assert (off <= least + 1e-9).all()
    assert (off > least - 0.35).all()
    np.testing.assert_allclose(MOUNTS.project(legal), legal, atol=1e-12)


@pytest.mark.parametrize("batch", [(), (3,), (2, 4)])
def test_both_forms_of_the_nearest_point_agree(batch):
    points = np.random.default_rng(2).uniform(-2, 11, (*batch, 7, 3))
    with np.errstate(all="ignore"):
        point, piece = nearest_point.textbook(points, PIECES)
    got = nearest_point(points, PIECES)
    np.testing.assert_allclose(got[0], point, atol=1e-12)
    np.testing.assert_array_equal(got[1], piece)


def test_actions_name_legal_points():
    rng = np.random.default_rng(3)
    points = MOUNTS.draw(rng.random((5, 8, 3)))
    np.testing.assert_allclose(MOUNTS.place(MOUNTS.action(points)), points, atol=1e-12)
    placed = MOUNTS.place(rng.uniform(-3, 3, (50, 3)))
    np.testing.assert_allclose(MOUNTS.project(placed), placed, atol=1e-12)


def test_faces_tell_normal_cost_and_name():
    points = np.array([[1, 0, 2.2], [0.5, 0.5, 3], [5.2, 5.2, 0.5], [9, 9, 1]])
    np.testing.assert_array_equal(MOUNTS.face_of(points), [0, 1, 2, 3])
    np.testing.assert_array_equal(MOUNTS.normal(points), FACES.normal)
    np.testing.assert_array_equal(MOUNTS.cost(points), [1, 2, 3, 4])
    assert MOUNTS.names(points) == ["wall", "ceiling", "area", "post"]
    assert not MOUNTS.normal(points + [0, 0.02, 0.02]).any()
    assert MOUNTS.listed() is None
    posts = Mounts(PIECES[4:], np.array([0]), FACES)
    np.testing.assert_array_equal(posts.listed(), [[9, 9, 1]])


@pytest.mark.parametrize(
    "region", [Box((0, 0, 1), (4, 3, 1)), Walls((0, 0, 0), (5, 4, 3)), Shell(2, 5)]
)
def test_simple_regions_have_faces_too(region):
    rng = np.random.default_rng(4)
    points = region.draw(rng.random((200, 3)))
    faces = region.faces
    face, distance = faces.nearest(points)
    assert distance.max() < 1e-9
    np.testing.assert_array_equal(region.face_of(points), face)
    assert (region.cost(points) == 1).all()
    assert set(region.names(points)) <= set(faces.names)
    assert region.listed() is None
    # Every point is its face's origin and steps along the sides.
    away = points - faces.origin[face]
    steps = np.einsum("pij,pj->pi", faces.axes[face], away)
    np.testing.assert_allclose(np.einsum("pij,pi->pj", faces.axes[face], steps), away, atol=1e-9)
    normal = region.normal(points)
    if isinstance(region, Walls):
        inward = points + 0.5 * normal
        assert ((inward > 0) & (inward < [5, 4, 3])).sum() > 0.8 * inward.size
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)
        assert region.names(np.array([[0, 2, 1], [2, 2, 3.0]])) == ["west wall", "ceiling"]
    else:
        assert not normal.any()
