"""Sight past boxes: the slab test against points sampled on the segment, and its edges."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbl_gym.geometry import polygons
from rbl_gym.geometry.obstacles import Obstacles, box_bounds, check_obstacles, in_sight

BOX = np.array([0.0, 0, 0, 1, 2, 3])


def sees(anchor, point, boxes=BOX) -> bool:
    boxes = np.atleast_2d(boxes)
    free = in_sight(np.array([anchor], float), np.array([point], float), boxes)
    assert free.shape == (1, 1)
    return bool(free[0, 0])


def depth_by_sampling(anchor, point, box, n=2001) -> float:
    """How far the deepest sampled point of the segment lies inside the box; negative: outside."""
    points = anchor + np.linspace(0, 1, n)[:, None] * (point - anchor)
    return float((box[3:] - np.abs(points - box[:3])).min(axis=-1).max())


def test_random_segments_against_sampling():
    rng = np.random.default_rng(0)
    anchors, points = rng.uniform(-4, 4, (2, 400, 3))
    box = np.array([0.3, -0.2, 0.1, 1.0, 0.6, 1.5])
    free = in_sight(anchors[:, None], points[:, None], box[None])[:, 0, 0]
    depth = np.array([depth_by_sampling(a, p, box) for a, p in zip(anchors, points, strict=True)])
    # Between two samples lie at most 14 m / 2000.
    clear = np.abs(depth) > 0.004
    np.testing.assert_array_equal(free[clear], depth[clear] < 0)
    assert clear.mean() > 0.95
    assert 0.1 < free.mean() < 0.9


@pytest.mark.parametrize(
    ("anchor", "point", "free"),
    [
        ((-5, 0, 0), (5, 0, 0), False),  # straight through
        ((-5, -1, 0.5), (5, 1, -0.5), False),
        ((-5, 0, 0), (-2, 0, 0), True),  # ends before it
        ((2, 0, 0), (5, 0, 0), True),  # begins behind it
        ((-5, 0, 0), (-1, 0, 0), True),  # ends on the face
        ((-5, 0, 0), (-0.5, 0, 0), False),  # ends inside
        ((-0.5, 0, 0), (0.5, 1, 1), False),  # wholly inside
        ((-1, 0, 0), (1, 0, 0), False),  # from face to face, through the middle
        ((-1, 0, 0), (-5, 1, 1), True),  # leaves from the face
        ((-5, -2, 0), (5, -2, 0), True),  # along a face, on either side
        ((-5, 2, 0), (5, 2, 0), True),
        ((0, -5, 3), (0, 5, 3), True),
        ((0, -5, -3), (0, 5, -3), True),
        ((1, 0, -9), (1, 0, 9), True),
        ((-1, 0, -9), (-1, 0, 9), True),
        ((-1, -2, -9), (-1, -2, 9), True),  # along an edge
        ((-2, -1, 0), (0, -3, 0), True),  # touches an edge
        ((-2, -3, 2), (0, -1, 4), True),  # touches a corner
        ((-5, 2.5, 0), (5, 2.5, 0), True),  # parallel, beside
        ((-5, 1.999, 0), (5, 1.999, 0), False),  # parallel, just inside
        ((0, 0, 0), (0, 0, 0), False),  # a point inside
        ((1, 0, 0), (1, 0, 0), True),  # a point on a face
        ((4, 4, 4), (4, 4, 4), True),  # a point outside
        ((-1, 0, 0), (-1, 1, 1), True),  # within a face
    ],
)
def test_special_segments(anchor, point, free):
    assert sees(anchor, point) is free
    assert sees(point, anchor) is free


WHOLE = st.integers(-6, 6)
PLACE = st.tuples(WHOLE, WHOLE, WHOLE).map(np.array)


@given(PLACE, PLACE, PLACE, st.tuples(*[st.integers(1, 4)] * 3).map(np.array))
def test_on_whole_numbers_ends_change_places_and_the_world_moves(anchor, point, centre, half):
    """Whole numbers meet faces, edges and corners exactly."""
    box = np.concatenate([centre, half])
    free = sees(anchor, point, box)
    assert sees(point, anchor, box) is free
    shift = np.array([32, -8, 4])
    moved = np.concatenate([centre + shift, half])
    assert sees(anchor + shift, point + shift, moved) is free
    assert sees(4 * anchor, 4 * point, 4 * box) is free
    assert sees(-anchor, -point, np.concatenate([-centre, half])) is free
    for order in ([1, 2, 0], [0, 2, 1]):
        turned = np.concatenate([centre[order], half[order]])
        assert sees(anchor[order], point[order], turned) is free


REAL = st.floats(-10, 10)
ANYWHERE = st.tuples(REAL, REAL, REAL).map(np.array)


@given(ANYWHERE, ANYWHERE, ANYWHERE, st.floats(0.1, 5), st.floats(0.01, 100))
def test_any_numbers_are_fine(anchor, point, centre, size, scale):
    box = np.array([*centre, size, 0.5 * size, 2 * size])
    free = sees(anchor, point, box)
    depth = depth_by_sampling(anchor, point, box, 201)
    if depth > 1e-6:
        assert not free
    # A box a little larger than one that blocks blocks too.
    if not free:
        assert not sees(anchor, point, box * [1, 1, 1, 1.01, 1.01, 1.01])
        assert not sees(scale * anchor, scale * point, scale * box * [1, 1, 1, 1.01, 1.01, 1.01])


def test_tiny_and_huge_steps_give_no_warning():
    assert sees((-5e12, 0, 0), (5e12, 1e-320, 0)) is False
    assert sees((-5e300, 3, 0), (5e300, 3, 1e-320)) is True
    assert sees((1e-310, 9, 0), (2e-310, 8, 0)) is True


def test_several_boxes_block_what_any_blocks():
    rng = np.random.default_rng(1)
    anchors, points = rng.uniform(-4, 4, (2, 7, 3))
    boxes = np.concatenate([rng.uniform(-2, 2, (3, 3)), rng.uniform(0.5, 1.5, (3, 3))], axis=1)
    each = [in_sight(anchors, points, box[None]) for box in boxes]
    np.testing.assert_array_equal(in_sight(anchors, points, boxes), np.all(each, axis=0))
    assert in_sight(anchors, points, np.empty((0, 6))).all()


def test_batches_are_loops_whichever_of_the_three_has_the_axes():
    rng = np.random.default_rng(2)
    anchors, points = rng.uniform(-4, 4, (5, 1, 2, 3)), rng.uniform(-4, 4, (4, 3, 3))
    boxes = np.concatenate([rng.uniform(-2, 2, (5, 4, 2, 3)), np.ones((5, 4, 2, 3))], axis=-1)
    free = in_sight(anchors, points, boxes)
    assert free.shape == (5, 4, 3, 2)
    assert 0 < free.mean() < 1
    for i, j, p, m in np.ndindex(free.shape):
        assert free[i, j, p, m] == sees(anchors[i, 0, m], points[j, p], boxes[i, j])
    assert in_sight(anchors[0, 0], points[0], boxes).shape == (5, 4, 3, 2)
    assert in_sight(anchors[0, 0], points[0], boxes[:0]).shape == (0, 4, 3, 2)


def test_good_obstacles_come_back_as_arrays():
    np.testing.assert_array_equal(check_obstacles([[0, 0, 1, 1, 1, 1]]), [[0.0, 0, 1, 1, 1, 1]])
    for none in ([], (), np.empty((0, 6))):
        assert check_obstacles(none).shape == (0, 6)


@pytest.mark.parametrize(
    ("obstacles", "message"),
    [
        ([[1, 2, 3]], "obstacles must have shape (..., K, 6), got (1, 3)"),
        ([1, 2, 3, 4, 5, 6], "obstacles must have shape (..., K, 6), got (6,)"),
        (np.ones((2, 1, 6)), "obstacles must have shape (K, 6), got (2, 1, 6)"),
        ([[0, 0, np.nan, 1, 1, 1]], "obstacles must be finite, got nan at index (0, 2)"),
        ([[0, 0, 0, 1, 0, 1]], "obstacles must have positive half sizes, got 0 m"),
        ([[0, 0, 0, 1, -2, 1]], "obstacles must have positive half sizes, got -2 m"),
        ("rack", "obstacles must be an array of real numbers"),
    ],
)
def test_bad_obstacles_are_refused(obstacles, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        check_obstacles(obstacles)


def test_obstacles_tell_the_share_of_each_link():
    """In sight all of it; behind a box, or with an end in it, what the box leaves."""
    rng = np.random.default_rng(8)
    obstacles = Obstacles(np.array([BOX, [4.0, 0, 0, 0.5, 2, 3]]), 0.03)
    anchors, points = rng.uniform(-6, 6, (2, 30, 3))
    wanted = np.where(in_sight(anchors, points, obstacles.boxes), 1.0, 0.03)
    np.testing.assert_array_equal(obstacles.share(anchors, points), wanted)
    assert 0.1 < (wanted == 1).mean() < 0.9
    held = [any((np.abs(p - box[:3]) <= box[3:]).all() for box in obstacles.boxes) for p in points]
    np.testing.assert_array_equal(obstacles.contain(points), held)
    assert obstacles
    nothing = Obstacles(np.empty((0, 6)), 0.0)
    assert not nothing
    assert (nothing.share(anchors, points) == 1).all()
    assert not nothing.contain(points).any()


def test_boxes_have_corners_and_a_rectangle_in_plan():
    low, high = box_bounds(np.array([[2.0, 1, 5, 1, 0.5, 3], [0, 0, 0, 1, 1, 1]]))
    np.testing.assert_array_equal(low, [[1, 0.5, 2], [-1, -1, -1]])
    np.testing.assert_array_equal(high, [[3, 1.5, 8], [1, 1, 1]])
    rings = polygons.rectangle(low, high)
    np.testing.assert_array_equal(rings[0], [[1, 0.5], [3, 0.5], [3, 1.5], [1, 1.5]])
    assert [polygons.area(ring) for ring in rings] == [2, 4]
