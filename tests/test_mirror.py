"""Mirror poses keep the ranges; their covariance is that of reflected errors."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym.geometry import rotations
from rbl_gym.geometry.mirror import Plane, mirror_pose, plane_of
from rbl_gym.measurements import ranging


def flat(rng, count, normal):
    """Points in a plane through (1, 2, 3)."""
    points = rng.standard_normal((count, 3))
    return points - (points @ normal)[:, None] * normal + [1.0, 2.0, 3.0]


@pytest.fixture
def world():
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((2, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    rotation, translation = rotations.random(rng, (5,)), rng.standard_normal((5, 3))
    return 4 * flat(rng, 6, normals[0]), flat(rng, 4, normals[1]), rotation, translation, normals


def test_a_plane_is_found(world):
    anchors, tags, _, _, normals = world
    for points, normal in zip((anchors, tags), normals, strict=True):
        plane = plane_of(points)
        assert abs(plane.normal @ normal) == pytest.approx(1)
        assert plane.thickness == pytest.approx(0, abs=1e-6)
        assert plane.width > 0.1
    assert isinstance(plane, Plane)
    thick = plane_of([[0, 0, 1], [9, 0, -1], [0, 9, 1], [9, 9, -1.0]] * np.array([1, 1, 0.5]))
    assert thick.normal[2] > 0.9
    assert plane_of([[1, 0, 0], [1, 5, 0], [1, 0, 5.0]]).normal == pytest.approx([1, 0, 0])


def test_the_image_has_the_ranges_of_the_pose_and_lies_behind_the_plane(world):
    anchors, tags, rotation, translation, normals = world
    P = np.eye(6)
    image = mirror_pose(rotation, translation, P, anchors, tags)
    here, there = (
        ranging.tag_positions(*pose, tags) for pose in ((rotation, translation), image[:2])
    )
    np.testing.assert_allclose(
        ranging.distances(anchors, here), ranging.distances(anchors, there), rtol=1e-9
    )
    side = [(points - anchors[0]) @ normals[0] for points in (here, there)]
    np.testing.assert_allclose(side[0], -side[1], atol=1e-9)
    back = mirror_pose(*image, anchors, tags)
    np.testing.assert_allclose(back[0], rotation, atol=1e-9)
    np.testing.assert_allclose(back[1], translation, atol=1e-9)
    np.testing.assert_allclose(back[2], np.broadcast_to(P, (5, 6, 6)), atol=1e-9)


def test_the_covariance_is_that_of_reflected_errors(world):
    anchors, tags, rotation, translation, _ = world
    rng = np.random.default_rng(1)
    root = rng.standard_normal((6, 6))
    P = root @ root.T
    image = mirror_pose(rotation[0], translation[0], P, anchors, tags)
    columns = []
    for error in 1e-6 * root.T:
        turned = rotations.exp(error[:3]) @ rotation[0]
        other = mirror_pose(turned, translation[0] + error[3:], P, anchors, tags)
        columns.append(np.r_[rotations.error(other[0], image[0]), other[1] - image[1]] / 1e-6)
    columns = np.array(columns).T
    np.testing.assert_allclose(image[2], columns @ columns.T, rtol=1e-3, atol=1e-3)
