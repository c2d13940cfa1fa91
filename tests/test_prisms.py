"""Prisms in the way of links, and polygons in the plan, against naive forms and shapely."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from rbl_gym.geometry import polygons
from rbl_gym.geometry.obstacles import Obstacles, Prisms, held_by, in_sight, share_behind
from tests.helpers import needs

SQUARE = [[0, 0], [2, 0], [2, 2], [0, 2]]
# Concave: a notch from above, down to (5, 1).
NOTCHED = [[4, 0], [6, 0], [6, 2], [5, 1], [4, 2]]
NO_BOXES = np.empty((0, 6))


def star(rng, corners: int) -> np.ndarray:
    """A simple polygon about a random place, mostly concave."""
    angle = 2 * np.pi * (np.arange(corners) + rng.uniform(0, 0.8, corners)) / corners
    radius = rng.uniform(0.5, 2.0, corners)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return rng.uniform(0, 10, 2) + radius[:, None] * around


def building(rng, count=12) -> Prisms:
    low = rng.uniform(0, 1, count)
    share = np.where(np.arange(count) % 3, rng.uniform(0, 1, count), np.nan)
    rings = [star(rng, int(corners)) for corners in rng.integers(3, 9, count)]
    return Prisms.of(rings, low, low + rng.uniform(0.5, 3, count), share)


def ways(prisms: Prisms, start, end, sample: int = 4001) -> np.ndarray:
    """About how long a segment runs inside of each prism, by points on it."""
    points = start + (np.arange(sample)[:, None] + 0.5) / sample * (end - start)
    held = []
    for corners, low, high in zip(prisms.corners, prisms.low_m, prisms.high_m, strict=True):
        level = (points[:, 2] > low) & (points[:, 2] < high)
        held.append((level & winds(corners, points[:, :2])).mean())
    return np.array(held) * math.dist(start, end)


def winds(ring, points) -> np.ndarray:
    """Whether a ring winds about points: the angles under which its edges are seen add up."""
    away = ring - np.asarray(points)[..., None, :]
    after = np.roll(away, -1, axis=-2)
    cross = away[..., 0] * after[..., 1] - away[..., 1] * after[..., 0]
    return abs(np.arctan2(cross, (away * after).sum(axis=-1)).sum(axis=-1)) > 1


def test_random_segments_against_sampling():
    rng = np.random.default_rng(3)
    prisms = building(rng, 4)
    anchors, points = rng.uniform([0, 0, 0], [10, 10, 4], (2, 12, 3))
    share = Obstacles(NO_BOXES, 0.05, prisms).share(anchors, points)
    compared = 0
    for p, m in np.ndindex(share.shape):
        way = ways(prisms, anchors[m], points[p], 400)
        if ((way > 0) & (way < 0.1)).any():
            continue  # too short a way to be sure of
        met = way > 0
        own = np.nanprod(np.where(met, prisms.share, 1.0))
        common = 0.05 if (met & np.isnan(prisms.share)).any() else 1.0
        if share[p, m] == pytest.approx(common * own, rel=1e-12):
            compared += 1
        else:  # a corner that the samples have missed
            assert way.min() == 0
            assert share[p, m] < common * own
    assert compared > 0.8 * share.size
    assert 0.1 < (share < 1).mean() < 0.9


@needs("shapely")
def test_random_segments_against_shapely():
    import shapely

    rng = np.random.default_rng(0)
    prisms = building(rng)
    boxes = np.array([[5, 5, 1, 0.5, 0.5, 1.0]])
    anchors, points = (rng.uniform([0, 0, 0], [10, 10, 4], (n, 3)) for n in (15, 60))
    wanted = np.empty((60, 15))
    for p, m in np.ndindex(wanted.shape):
        a, d = anchors[m], points[p] - anchors[m]
        own, free = 1.0, bool(in_sight(a[None], points[p][None], boxes)[0, 0])
        for ring, low, high, share in zip(
            prisms.corners, prisms.low_m, prisms.high_m, prisms.share, strict=True
        ):
            first, last = sorted([(low - a[2]) / d[2], (high - a[2]) / d[2]])
            first, last = max(0.0, first), min(1.0, last)
            if first < last:
                line = shapely.LineString([(a + t * d)[:2] for t in (first, last)])
                if line.intersection(shapely.Polygon(ring)).length > 1e-6:
                    free, own = (False, own) if np.isnan(share) else (free, own * share)
        wanted[p, m] = own * (1.0 if free else 0.05)
    obstacles = Obstacles(boxes, 0.05, prisms)
    np.testing.assert_allclose(obstacles.share(anchors, points), wanted, rtol=1e-12)


def test_a_square_prism_is_the_box():
    """On whole numbers, where segments meet faces, edges and corners exactly."""
    axes = np.arange(-1.0, 4.0)
    grid = np.stack(np.meshgrid(axes, axes, axes), axis=-1).reshape(-1, 3)
    box = np.array([[1.0, 1, 1, 1, 1, 1]])
    prism = Obstacles(NO_BOXES, 0.1, Prisms.of([SQUARE], 0, 2, 0.5))
    free = in_sight(grid, grid, box)
    free |= np.eye(len(grid), dtype=bool)  # a link of no length
    np.testing.assert_array_equal(prism.share(grid, grid), np.where(free, 1.0, 0.5))
    plain = Obstacles(NO_BOXES, 0.1, Prisms.of([SQUARE], 0, 2))
    np.testing.assert_array_equal(plain.share(grid, grid), np.where(free, 1.0, 0.1))


@pytest.mark.parametrize(
    ("start", "end", "free"),
    [
        ((4, 2, 1), (6, 2, 1), True),  # over the notch, from tip to tip
        ((5, 3, 1), (5, 1, 1), True),  # down to the bottom of the notch
        ((5, 3, 1), (5, 0.999, 1), False),
        ((4, 1.9, 1), (6, 1.9, 1), False),  # through both arms: once
        ((3, 0, 1), (7, 0, 1), True),  # along the lower edge
        ((4, -1, 1), (4, 3, 1), True),  # along the left edge
        ((4, 0, 1), (5, 1, 1), False),  # from corner to corner, inside
        ((3, 1, 1), (5, 3, 1), True),  # touches the left tip
        ((3, 3, 1), (6, 0, 1), False),  # along the slope of the notch, then inside
        ((3, 1, 2), (7, 1, 2), True),  # on the top
        ((3, 1, 0), (7, 1, 0), True),  # on the bottom
        ((5, 0.5, 3), (5, 0.5, -1), False),  # upright, inside
        ((5, 1.5, 3), (5, 1.5, -1), True),  # upright, in the notch
        ((5, 1, 3), (5, 1, -1), True),  # upright, at a corner
        ((4, 0.5, 3), (4, 0.5, -1), True),  # upright, on an edge
        ((4.5, 0, 3), (4.5, 0, -1), True),
        ((5, 0.5, 3), (5, 0.5, 2), True),  # upright, ends on the top
        ((5, 0.5, 0.5), (5, 0.5, 0.5), True),  # no segment at all
        ((4.5, 0.5, 0.5), (5, 0.5, 0.5), False),  # wholly inside
    ],
)
def test_special_segments(start, end, free):
    prisms = Obstacles(NO_BOXES, 0.0, Prisms.of([NOTCHED], 0, 2))
    for turn in (0.0, 0.7, 2.0, 4.0):
        # Turned, all that touches is only nearly so.
        c, s = math.cos(turn), math.sin(turn)
        turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        ring = np.array(NOTCHED) @ turned[:2, :2].T
        prisms = Obstacles(NO_BOXES, 0.0, Prisms.of([ring], 0, 2))
        ends = np.array([start, end], float) @ turned.T
        for a, b in (ends, ends[::-1]):
            assert bool(prisms.share(a[None], b[None])[0, 0] == 1.0) is free


def test_losses_multiply_and_what_has_none_of_its_own_counts_once():
    walls = [[[x, -1], [x + 0.1, -1], [x + 0.1, 1], [x, 1]] for x in range(1, 6)]
    prisms = Prisms.of(walls, 0, 3, [0.5, 0.2, np.nan, np.nan, 0.0])
    obstacles = Obstacles(np.array([[6.5, 0, 1, 0.1, 1, 1]]), 0.1, prisms)
    ends = np.array([[x, 0, 1] for x in (0.5, 1.5, 2.5, 3.5, 4.5, 5.5)])
    anchor = np.array([[0.0, 0, 1]])
    share = obstacles.share(anchor, ends)[:, 0]
    np.testing.assert_allclose(share, [1, 0.5, 0.1, 0.01, 0.01, 0])
    assert obstacles.share(np.array([[5.5, 0, 1]]), np.array([[7.0, 0, 1]]))[0, 0] == 0.1
    assert len(obstacles) == 6
    assert obstacles


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_both_forms_agree(batch):
    rng = np.random.default_rng(5)
    prisms = building(rng)
    boxes = np.concatenate([rng.uniform(0, 8, (*batch, 2, 3)), np.ones((*batch, 2, 3))], axis=-1)
    anchors, points = (rng.uniform(0, 8, (*batch, n, 3)) for n in (5, 20))
    points[..., 0, :2] = anchors[..., 0, :2]  # upright
    points[..., 1, 2] = anchors[..., 1, 2]  # level
    obstacles = Obstacles(boxes, 0.05, prisms)
    arguments = anchors, points, boxes, prisms.corners, prisms.limits, np.float64(0.05)
    arguments = *arguments, *obstacles._grid
    got = share_behind(*arguments)
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(got, share_behind.textbook(*arguments), rtol=1e-12)
    assert got.shape == (*batch, 20, 5)
    np.testing.assert_array_equal(obstacles.share(anchors, points), got)
    np.testing.assert_array_equal(obstacles.sees(anchors, points), got == 1)


@pytest.mark.parametrize("extent", [(300.0, 40.0), (5.0, 5.0), (2e5, 1.0)])
def test_many_obstacles_are_found_by_the_grid_as_one_by_one(extent):
    """Short and long links, level, upright, along rows, and far outside of the grid."""
    rng = np.random.default_rng(9)
    walls, boxes = [], []
    for centre in rng.uniform([0, 0], extent, (70, 2)):
        along = rng.normal(size=2) * rng.choice([0.02, 0.2]) * min(extent)
        across = 0.1 * np.array([-along[1], along[0]])
        walls.append(np.array([-along - across, along - across, along + across, across - along]))
        walls[-1] += centre
        boxes.append([*rng.uniform([0, 0], extent), 1, *rng.uniform(0.01, 0.1, 2), 1])
    prisms = Prisms.of(walls, 0, 3, rng.uniform(0.2, 0.9, 70))
    low, high = -0.2 * np.array(extent), 1.2 * np.array(extent)
    anchors = np.column_stack([rng.uniform(low, high, (40, 2)), rng.uniform(0, 4, 40)])
    points = np.column_stack([rng.uniform(low, high, (60, 2)), rng.uniform(0, 4, 60)])
    points[:20, 0], points[20:40, 1] = anchors[:20, 0], anchors[20:40, 1]
    points[40:50, :2] = anchors[:10, :2] + 0.05 * rng.normal(size=(10, 2)) * min(extent)
    obstacles = Obstacles(np.array(boxes), 0.3, prisms)
    got = obstacles.share(anchors, points)
    with np.errstate(all="ignore"):
        wanted = share_behind.textbook(
            anchors, points, obstacles.boxes, prisms.corners, prisms.limits, 0.3, *obstacles._grid
        )
    np.testing.assert_allclose(got, wanted, rtol=1e-12)
    assert (wanted < 1).mean() > 0.1
    assert (wanted == 1).any()
    alone = Obstacles(np.array(boxes), 0.3)
    free = in_sight(anchors, points, alone.boxes)
    np.testing.assert_array_equal(alone.share(anchors, points), np.where(free, 1.0, 0.3))
    np.testing.assert_array_equal(alone.sees(anchors, points), free)


def test_what_a_prism_contains():
    rng = np.random.default_rng(6)
    prisms = building(rng, 5)
    points = rng.uniform([0, 0, 0], [10, 10, 4], (600, 3))
    held = np.zeros(600, dtype=bool)
    for ring, low, high in zip(prisms.corners, prisms.low_m, prisms.high_m, strict=True):
        inside = winds(ring, points[:, :2])
        held |= inside & (points[:, 2] > low) & (points[:, 2] < high)
    obstacles = Obstacles(NO_BOXES, 0.0, prisms)
    np.testing.assert_array_equal(obstacles.contain(points), held)
    with np.errstate(all="ignore"):
        textbook = held_by.textbook(points, NO_BOXES, prisms.corners, prisms.limits)
    np.testing.assert_array_equal(textbook, held)
    assert 0.02 < held.mean() < 0.9
    square = Obstacles(NO_BOXES, 0.0, Prisms.of([SQUARE], 0, 2))
    edge = np.array([[0, 1, 1], [2, 2, 1], [1, 1, 0], [1, 1, 2], [1, 0, 1]], float)
    assert not square.contain(edge).any()
    assert square.contain(edge + 1e-3 * (np.array([1, 1, 1]) - edge)).all()


@pytest.mark.parametrize("margin", [0.3, 1e-6, -0.3])
def test_polygons_contain_with_a_margin(margin):
    rng = np.random.default_rng(7)
    ring = polygons.check_polygon("ring", NOTCHED)
    points = rng.uniform([3, -1], [7, 3], (500, 2))
    found = polygons.contains(ring, points, margin)
    start, end = ring[:, None], np.roll(ring, -1, axis=0)[:, None]
    edge = start + np.linspace(0, 1, 201)[:, None] * (end - start)
    off = np.linalg.norm(points[:, None, None] - edge, axis=-1).min(axis=(1, 2))
    signed = np.where(winds(ring, points), off, -off)
    clear = abs(signed - margin) > 0.01
    np.testing.assert_array_equal(found[clear], signed[clear] > margin)
    assert clear.mean() > 0.9
    assert 0.02 < found.mean() < 0.9


def test_polygons_are_made_counter_clockwise_without_repeated_corners():
    for ring in (SQUARE, SQUARE[::-1], [*SQUARE, SQUARE[0]], [SQUARE[0], *SQUARE]):
        found = polygons.check_polygon("ring", ring)
        assert found.shape == (4, 2)
        assert polygons.area(found) == 4
    assert Prisms.of([SQUARE[::-1]], 0, 1).corners.shape == (1, 4, 2)


@pytest.mark.parametrize(
    ("ring", "message"),
    [
        ([[0, 0], [1, 1]], "ring must have at least 3 different points, got 2"),
        ([[0, 0], [1, 1], [0, 0]], "ring must have at least 3 different points, got 2"),
        ([[0, 0], [1, 1], [2, 2]], "ring must enclose an area, but its 3 corners lie on one line"),
        ([[0, 0], [2, 2], [2, 0], [0, 2]], "ring must not cross or touch itself"),
        (
            [[0, 0], [3, 3], [3, 0], [0, 2]],
            "ring must not cross or touch itself: edge 1, from (0, 0) to (3, 3), meets edge 3, "
            "from (3, 0) to (0, 2)",
        ),
        ([[0, 0], [4, 0], [4, 4], [2, 0], [0, 4]], "ring must not cross or touch itself"),
        ([[0, 0], [4, 0], [4, 2], [4, 1], [0, 1]], "ring must not fold back on itself"),
        ([[0, 0], [1, 0], [np.nan, 1]], "ring must be finite, got nan at index (2, 0)"),
        ([[0, 0, 0], [1, 0, 0], [1, 1, 0]], "ring must have shape (..., V, 2)"),
        ([[[0, 0], [1, 0], [1, 1]]], "ring must be a list of [x, y]"),
        ("hall", "ring must be an array of real numbers"),
        ([], "ring must"),
    ],
)
def test_bad_polygons_are_refused(ring, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        polygons.check_polygon("ring", ring)


def test_lines():
    assert polygons.check_line("line", [[0, 0], [0, 0], [1, 0]]).shape == (2, 2)
    assert polygons.check_line("line", [*SQUARE, SQUARE[0]], closed=True).shape == (4, 2)
    with pytest.raises(ValueError, match="line must have at least 2 different points, got 1"):
        polygons.check_line("line", [[1, 1], [1, 1]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([SQUARE], 1, 1), r"high_m\[0\] must be"),
        (([SQUARE], np.nan, 1), r"low_m\[0\] must be"),
        (([SQUARE, NOTCHED], 0, 1, [0.5, 2]), r"share\[1\] must be"),
        (([SQUARE, SQUARE[:2]], 0, 1), r"polygons\[1\] must have at least 3"),
    ],
)
def test_bad_prisms_are_refused(arguments, message):
    with pytest.raises(ValueError, match="^" + message):
        Prisms.of(*arguments)
    assert len(Prisms.of([], 0, 1)) == len(Prisms()) == 0
