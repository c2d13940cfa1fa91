"""Regions: draws are legal and uniform, projection is legal, idempotent and the nearest point."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from rbl_gym.geometry.regions import Box, Region, Shell, Walls

PROPERTY = settings(deadline=None, derandomize=True)
ROOM = Walls((0, 0, 0.3), (10, 8, 3))
REGIONS: dict[str, Region] = {
    "box": Box((-1, 2, 0), (3, 4, 10)),
    "flat box": Box((-5, -5, 0), (5, 3, 0)),
    "point": Box((1, 2, 3), (1, 2, 3)),
    "low room": ROOM,
    "tower": Walls((-1, -2, 0), (1, 1, 20)),
    "shell": Shell(2, 5),
    "ball": Shell(0, 5),
    "sphere": Shell(3, 3),
}
every_region = pytest.mark.parametrize("kind", REGIONS)


def distance_outside(region: Region, points: np.ndarray) -> np.ndarray:
    """How far points are from being legal, from the definition of each region."""
    if isinstance(region, Shell):
        radius = np.linalg.norm(points, axis=-1)
        return np.maximum(region.inner_m - radius, radius - region.outer_m)
    low, high = region.bounds()
    outside = np.maximum(low - points, points - high).max(axis=-1)
    if isinstance(region, Box):
        return outside
    surfaces = [points[..., 0] - low[0], points[..., 0] - high[0], points[..., 1] - low[1],
                points[..., 1] - high[1], points[..., 2] - high[2]]  # fmt: skip
    return np.maximum(outside, np.abs(surfaces).min(axis=0))


def draw(region: Region, n: int, seed: int = 0) -> np.ndarray:
    return region.draw(np.random.default_rng(seed).random((n, 3)))


def around(region: Region, n: int, seed: int = 1) -> np.ndarray:
    """Points in, near and far off the region, twice its size to every side."""
    low, high = region.bounds()
    size = np.maximum(high - low, 1.0)
    return np.random.default_rng(seed).uniform(low - 2 * size, high + 2 * size, (n, 3))


@every_region
def test_draws_are_legal(kind):
    points = draw(REGIONS[kind], 5000)
    assert distance_outside(REGIONS[kind], points).max() <= 1e-12


@every_region
def test_draws_at_the_ends_of_the_uniforms_are_legal(kind):
    ends = np.stack(np.meshgrid(*[[0.0, 0.5, 1 - 2**-53]] * 3), axis=-1)
    assert distance_outside(REGIONS[kind], REGIONS[kind].draw(ends)).max() <= 1e-12


@every_region
def test_bounds_are_the_tightest_box(kind):
    low, high = REGIONS[kind].bounds()
    points = draw(REGIONS[kind], 20_000)
    assert (points >= low - 1e-12).all()
    assert (points <= high + 1e-12).all()
    size = np.maximum(high - low, 1.0)
    assert (points.min(axis=0) - low <= 0.1 * size).all()
    assert (high - points.max(axis=0) <= 0.1 * size).all()


def assert_counts(counts: np.ndarray, shares: np.ndarray) -> None:
    """Counts follow the shares (chi-square, one false alarm in a thousand seeds)."""
    shares = shares / shares.sum()
    assert stats.chisquare(counts, counts.sum() * shares).pvalue > 1e-3


@pytest.mark.parametrize("kind", ["low room", "tower"])
def test_draws_on_walls_and_ceiling_are_uniform_by_area(kind):
    room = REGIONS[kind]
    assert isinstance(room, Walls)
    low, high = room.bounds()
    x, y, z = high - low
    points = draw(room, 20_000)
    place = (points - low) / (high - low)
    # Each surface, in 4 x 4 tiles of its two free coordinates.
    counts, shares = [], []
    faces = [(0, 0, y * z), (0, 1, y * z), (1, 0, x * z), (1, 1, x * z), (2, 1, x * y)]
    for axis, side, area in faces:
        on = place[place[:, axis] == side]
        free = [a for a in range(3) if a != axis]
        tiles, _, _ = np.histogram2d(*on[:, free].T, bins=4, range=[[0, 1]] * 2)
        counts.append(tiles.ravel())
        shares.append(np.full(16, area / 16))
    assert np.sum(counts) == len(points)
    assert_counts(np.concatenate(counts), np.concatenate(shares))


@pytest.mark.parametrize("kind", ["box", "flat box"])
def test_draws_in_a_box_are_uniform(kind):
    low, high = REGIONS[kind].bounds()
    points = draw(REGIONS[kind], 20_000)
    free = np.flatnonzero(high > low)
    counts, _ = np.histogramdd(points[:, free], bins=4, range=[(low[a], high[a]) for a in free])
    assert_counts(counts.ravel(), np.ones(counts.size))


@pytest.mark.parametrize("kind", ["shell", "ball"])
def test_draws_in_a_shell_are_uniform_by_volume(kind):
    shell = REGIONS[kind]
    assert isinstance(shell, Shell)
    points = draw(shell, 20_000)
    radius = np.linalg.norm(points, axis=-1)
    edges = np.linspace(shell.inner_m, shell.outer_m, 6)
    octant = (points > 0) @ [1, 2, 4]
    counts, _, _ = np.histogram2d(radius, octant, bins=[edges, np.arange(9) - 0.5])
    assert_counts(counts.ravel(), np.repeat(np.diff(edges**3), 8))


def test_draws_on_a_sphere_are_uniform_by_area():
    points = draw(REGIONS["sphere"], 20_000) / 3
    for column in points.T:  # Archimedes: every coordinate is uniform
        assert stats.kstest(column, stats.uniform(-1, 2).cdf).pvalue > 1e-3


@every_region
def test_projections_are_legal(kind):
    region = REGIONS[kind]
    assert distance_outside(region, region.project(around(region, 5000))).max() <= 1e-12


@every_region
def test_projection_keeps_legal_points(kind):
    region = REGIONS[kind]
    for points in (draw(region, 2000), region.project(around(region, 2000))):
        np.testing.assert_allclose(region.project(points), points, atol=1e-12)


@every_region
def test_projection_is_nearer_than_every_drawn_point(kind):
    region = REGIONS[kind]
    points, drawn = around(region, 300), draw(region, 20_000)
    distance = np.linalg.norm(points - region.project(points), axis=-1)
    rivals = np.array([np.linalg.norm(drawn - point, axis=-1).min() for point in points])
    worse = distance > rivals + 1e-9
    assert not worse.any(), f"{points[worse][0]} goes to {region.project(points)[worse][0]}"


@settings(PROPERTY, max_examples=150)
@given(st.tuples(st.floats(-2, 12), st.floats(-2, 10), st.floats(-12, 6)))
def test_projection_onto_a_low_room_is_the_nearest_of_its_five_surfaces(point):
    (x0, y0, z0), (x1, y1, z1) = ROOM.bounds()
    surfaces = [((x0, y0, z0), (x0, y1, z1)), ((x1, y0, z0), (x1, y1, z1)),
                ((x0, y0, z0), (x1, y0, z1)), ((x0, y1, z0), (x1, y1, z1)),
                ((x0, y0, z1), (x1, y1, z1))]  # fmt: skip
    nearest = [np.linalg.norm(np.clip(point, *surface) - point) for surface in surfaces]
    got = np.linalg.norm(ROOM.project(np.array(point)) - point)
    np.testing.assert_allclose(got, min(nearest), atol=1e-12)


@every_region
def test_batches_are_loops(kind):
    region = REGIONS[kind]
    uniforms = np.random.default_rng(0).random((2, 3, 3))
    points = around(region, 6).reshape(2, 3, 3)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(
            region.draw(uniforms)[index], region.draw(uniforms[index]), rtol=1e-14
        )
        np.testing.assert_allclose(
            region.project(points)[index], region.project(points[index]), rtol=1e-14
        )
    assert region.draw(uniforms[:0]).shape == (0, 3, 3)
    assert region.project(points[:0]).shape == (0, 3, 3)


@every_region
def test_projection_leaves_its_argument_alone(kind):
    points = around(REGIONS[kind], 10)
    before = points.copy()
    REGIONS[kind].project(points)
    np.testing.assert_array_equal(points, before)


def test_the_centre_of_a_shell_goes_to_its_inner_sphere():
    np.testing.assert_array_equal(Shell(2, 5).project(np.zeros((2, 3))), [[2, 0, 0]] * 2)


@pytest.mark.parametrize("kind", [Box, Walls])
def test_corners_from_lists_are_equal_and_hashable(kind):
    lists, tuples = kind([0, 1, 2], [3, 4, 5]), kind((0.0, 1.0, 2.0), (3.0, 4.0, 5.0))
    assert lists == tuples
    assert hash(lists) == hash(tuples)


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (Box, ((0, 0, 1), (1, 1, 0)), "low must lie below high, got low (0.0, 0.0, 1.0)"),
        (Walls, ((0, 0, 0), (1, 1, 0)), "low must lie below high"),
        (Box, ((0, 0), (1, 1)), "low must have shape (..., 3), got (2,)"),
        (Box, ((0, 0, 0), (1, np.nan, 1)), "high must be finite, got nan at index (1,)"),
        (Walls, ((0, 0, 0), "abc"), "high must be an array of real numbers, got 'abc'"),
        (Box, (((0, 0, 0), (0, 0, 0)), (1, 1, 1)), "low must"),
        (Shell, (-1, 2), "inner_m must be a finite number of at least 0, got -1.0"),
        (Shell, (3, 2), "outer_m must be a finite number of at least 3, got 2.0"),
        (Shell, (0, np.inf), "outer_m must be a finite number of at least 0, got inf"),
        (Shell, ("1", 2), "inner_m must be a number, got '1'"),
    ],
)
def test_bad_region_is_refused(kind, arguments, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        kind(*arguments)


# --- actions ----------------------------------------------------------------------------------

every_action = np.stack(np.meshgrid(*[[-1.5, -1, -1e-4, 0, 1e-200, 3e-4, 0.3, 1]] * 3), axis=-1)


@every_region
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_places_of_actions_are_legal(kind, dtype):
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (5000, 3))
    for some in (actions, 1e-3 * actions, every_action.reshape(-1, 3)):
        points = REGIONS[kind].place(some.astype(dtype))
        assert points.dtype == np.float64
        assert distance_outside(REGIONS[kind], points).max() <= 1e-9


@every_region
def test_action_is_the_inverse_of_place(kind):
    region = REGIONS[kind]
    for points in (draw(region, 3000), region.project(around(region, 3000))):
        actions = region.action(points)
        assert np.abs(actions).max() <= 1 + 1e-9
        np.testing.assert_allclose(region.place(actions), points, atol=1e-8)


@every_region
def test_every_place_can_be_named(kind):
    """Places of random actions come as near to any legal point as their number lets one hope."""
    region = REGIONS[kind]
    placed = region.place(np.random.default_rng(3).uniform(-1, 1, (5000, 3)))
    low, high = region.bounds()
    far = max(np.linalg.norm(placed - point, axis=-1).min() for point in draw(region, 30))
    assert far <= 0.2 * np.linalg.norm(high - low) + 1e-12


def test_a_box_scales_the_action():
    box = Box((-1, 2, 0), (3, 4, 10))
    np.testing.assert_allclose(box.place(np.array([0.5, -1, 0])), [2, 2, 5])
    np.testing.assert_allclose(box.place(np.array([9, -9, 0.2])), [3, 2, 6])
    np.testing.assert_array_equal(Box((0, 0, 5), (2, 2, 5)).action(np.array([1, 2, 5])), [0, 1, 0])


@pytest.mark.parametrize("kind", ["low room", "tower"])
def test_walls_by_the_formula(kind):
    """u = a / max(|ax|, |ay|, max(az, 0), 1e-3), cut to [-1, 1]^3, times the half size."""
    room = REGIONS[kind]
    low, high = room.bounds()
    for a in np.random.default_rng(4).uniform(-1, 1, (500, 3)) * [1, 1, 3]:
        a = np.clip(a, -1, 1)
        u = np.clip(a / max(abs(a[0]), abs(a[1]), max(a[2], 0.0), 1e-3), -1, 1)
        np.testing.assert_allclose(room.place(a), (low + high) / 2 + u * (high - low) / 2)


def test_walls_in_words():
    places = {
        (1, 0, 0): (10, 4, 1.65),
        (0, -0.2, 0): (5, 0, 1.65),
        (0, 0, 0.1): (5, 4, 3),
        (0.5, 0, 0.5): (10, 4, 3),
        (0.5, 0, -1): (10, 4, 0.3),
        (0.5, 0, -0.25): (10, 4, 1.65 - 1.35 / 2),
    }
    for action, place in places.items():
        np.testing.assert_allclose(ROOM.place(np.array(action, float)), place, atol=1e-12)
    # No direction: the legal point nearest to the middle; straight down: nearest to the floor's.
    np.testing.assert_allclose(ROOM.place(np.zeros(3)), [5, 4, 3])
    np.testing.assert_allclose(ROOM.place(np.array([0, 0, -1.0])), [5, 4, 3])


def test_a_shell_by_the_formula():
    shell = Shell(50, 300)
    np.testing.assert_allclose(shell.place(np.zeros(3)), [50, 0, 0])
    np.testing.assert_allclose(shell.place(np.array([0, -0.2, 0])), [0, -100, 0])
    np.testing.assert_allclose(shell.place(np.ones(3)), np.full(3, 300 / 3**0.5))
    np.testing.assert_allclose(shell.place(np.array([0, 0, 7.0])), [0, 0, 300])
    tiny = shell.place(np.array([0, 1e-12, 0]))
    np.testing.assert_allclose(tiny, [0, 50, 0], atol=1e-9)


@every_region
def test_batches_of_actions_are_loops(kind):
    region = REGIONS[kind]
    actions = np.random.default_rng(5).uniform(-1.2, 1.2, (2, 3, 3))
    points = region.place(actions)
    back = region.action(points)
    before = actions.copy()
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(points[index], region.place(actions[index]), rtol=1e-14)
        np.testing.assert_allclose(back[index], region.action(points[index]), rtol=1e-12)
    np.testing.assert_array_equal(actions, before)
    assert region.place(actions[:0]).shape == (0, 3, 3)
    assert region.action(points[:0]).shape == (0, 3, 3)
