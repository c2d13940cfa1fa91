"""Every kernel of the world against its textbook form: shapes, lost links, degenerate cases."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import kernels, metrics
from rbl_gym.bounds import information, pose, posterior
from rbl_gym.estimators import inputs
from rbl_gym.estimators.linear import engines, least_squares, unitary
from rbl_gym.geometry import obstacles, regions, rotations
from rbl_gym.measurements import bearing, noise_laws, ranging
from rbl_gym.metrics import Figures
from rbl_gym.motion import kinematics, trajectories
from rbl_gym.placement import Gain, gradient
from rbl_gym.placement import problem as placement
from rbl_gym.worlds import simulation

pytestmark = pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")

LAWS = {
    "own": noise_laws.RangeNoise(0.05, 0.01),
    "reference": noise_laws.RangeNoise(0.05, 0.01, reference_tag=1),
    "squared": noise_laws.SquaredRangeNoise(0.1),
}
every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
every_batch = pytest.mark.parametrize("batch", [(), (3,), (2, 3)], ids=str)


def assert_equal_forms(form, *args, atol=1e-9, least=1e-300) -> Any:
    """Both forms of a function: relative to the largest entry, and for shapes that broadcast.

    `least` is the smallest size of the entries that counts.
    """
    with np.errstate(all="ignore"):
        got, want = form.kernel(*args), form.textbook(*args)
    got, want = (x if isinstance(x, tuple) else (x,) for x in (got, want))
    assert len(got) == len(want)
    for mine, plain in zip(got, want, strict=True):
        assert mine.shape == plain.shape
        scale = np.nanmax(np.abs(plain), initial=least)
        np.testing.assert_allclose(mine / scale, plain / scale, rtol=0, atol=atol)
    return got


class World:
    """Random bodies among anchors; anchors and tags are common to all where `common`."""

    def __init__(self, batch, m=4, n=5, common=False, seed=0):
        rng = self.rng = np.random.default_rng(seed)
        self.anchors = rng.normal(0, 20, (*(() if common else batch), m, 3))
        self.tags = rng.normal(0, 1, (n, 3))
        self.rotation, self.translation = (
            rotations.random(rng, batch),
            rng.normal(0, 5, (*batch, 3)),
        )
        self.share = np.where(rng.random((*batch, m, n)) < 0.3, 0.0, rng.random((*batch, m, n)))
        root = rng.standard_normal((*batch, 6, 6))
        self.matrix = root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(6)

    @property
    def places(self):
        return self.anchors, self.tags, self.rotation, self.translation


# --- rotations ---------------------------------------------------------------------------------


@every_batch
@pytest.mark.parametrize("spread", [1e-9, 0.1, 1.0, 30.0])
def test_nearest(batch, spread):
    rng = np.random.default_rng(1)
    near = rotations.random(rng, batch) + spread * rng.standard_normal((*batch, 3, 3))
    assert_equal_forms(rotations._nearest, near)


@pytest.mark.parametrize(
    "matrix",
    [
        -np.eye(3), np.diag([1.0, 2, -3]), np.diag([1.0, 2, 0]), 1e-200 * np.diag([3.0, 2, -1]),
        np.diag([1e-9, 1, 1e9]),
    ],
)  # fmt: skip
def test_nearest_of_reflections_and_singular_matrices(matrix):
    turn = rotations.random(np.random.default_rng(2))
    got = rotations._nearest(turn @ matrix)
    assert np.linalg.det(got) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(got @ got.T, np.eye(3), atol=1e-12)
    # The projection may not be unique (-I): what it is worth is.
    want = rotations._nearest.textbook(turn @ matrix)
    scale = np.abs(matrix).max()
    trace = [np.sum(Q * (turn @ matrix)) / scale for Q in (got, want)]
    assert trace[0] == pytest.approx(trace[1], abs=1e-9)


def test_nearest_of_nothing():
    np.testing.assert_array_equal(rotations._nearest(np.zeros((3, 3))), np.eye(3))
    assert np.isnan(rotations._nearest(np.full((3, 3), np.nan))).any()


# --- epochs ------------------------------------------------------------------------------------


@every_batch
@every_law
@pytest.mark.parametrize("common", [False, True])
def test_ranges_of_an_epoch(law, batch, common):
    world = World(batch, common=common)
    normals = 3 * world.rng.standard_normal((*batch, 4, 5))
    assert_equal_forms(
        ranging._sample, world.rotation, world.translation, world.tags, world.anchors, normals,
        law.numbers, 5.0,
    )  # fmt: skip


@every_law
def test_ranges_of_an_anchor_on_a_tag(law):
    tags, anchors = np.eye(3), np.array([[1.0, 0, 0], [0, 1, 0], [9, 9, 9]])
    normals = -np.ones((3, 3))
    world = np.eye(3), np.zeros(3), tags, anchors, normals
    assert_equal_forms(ranging._sample, *world, law.numbers, 9.0)


@every_batch
def test_distances(batch):
    world = World(batch)
    assert_equal_forms(
        ranging.true_distances, world.rotation, world.translation, world.tags, world.anchors
    )


@every_batch
def test_twists_along_way_points(batch):
    rng = np.random.default_rng(0)
    points = rng.integers(-1, 2, (20, *batch, 6, 3)).astype(float)
    # Ends that are reached exactly, a leg without a length, and beyond the end.
    points[0, ..., 3, :] = points[0, ..., 2, :]
    spin = rng.standard_normal((*batch, 6))
    assert_equal_forms(trajectories._follow, points, np.linspace(0.25, 20, 80), spin, 0.1)
    assert_equal_forms(trajectories._follow, points[..., :2, :], np.zeros(3), spin, 0.1)


@every_batch
def test_propagate(batch):
    rng = np.random.default_rng(4)
    start = rotations.random(rng, batch), rng.normal(size=(*batch, 3))
    assert_equal_forms(kinematics._propagate, *start, rng.standard_normal((*batch, 6)), 0.7)


@every_batch
def test_walk(batch):
    rng = np.random.default_rng(3)
    start = rotations.random(rng, batch), rng.normal(size=(*batch, 3))
    twists, normals = rng.standard_normal((2, *batch, 7, 6))
    std = np.array([0.1, 0.0, 0.2, 1, 2, 3])
    assert_equal_forms(kinematics._walk, *start, twists, normals, std, 0.1, np.empty(8))
    assert_equal_forms(kinematics._walk, *start, np.zeros((7, 6)), normals, std, 0.1, np.empty(8))


@every_batch
def test_moves_of_anchors(batch):
    rng = np.random.default_rng(7)
    places, velocity = rng.normal(size=(2, *batch, 4, 3))
    velocity[..., 0, :] = 0.0
    assert_equal_forms(simulation._move, places, velocity, 2.5)


@pytest.mark.parametrize("count", [0, 1, 3])
@every_batch
def test_sight(batch, count):
    rng = np.random.default_rng(4)
    anchors, points = rng.uniform(-5, 5, (*batch, 6, 3)), rng.uniform(-5, 5, (9, 3))
    boxes = np.concatenate([rng.uniform(-4, 4, (count, 3)), rng.uniform(0.2, 2, (count, 3))], -1)
    got = obstacles.in_sight(anchors, points, boxes)
    assert got.dtype == np.bool_
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(got, obstacles.in_sight.textbook(anchors, points, boxes))


def test_sight_along_a_face_and_from_inside():
    box = np.array([[0.0, 0, 0, 1, 1, 1]])
    anchors = np.array([[-3.0, 1, 0], [-3, 0, 0], [0, 0, 0], [3, 1, 1]])
    points = np.array([[3.0, 1, 0], [0, 0.5, 0], [3, 3, 3], [-3, 1, 1]])
    with np.errstate(all="ignore"):
        want = obstacles.in_sight.textbook(anchors, points, box)
    np.testing.assert_array_equal(obstacles.in_sight(anchors, points, box), want)
    assert want[0, 0]
    assert not want[2, 2]


# --- bounds ------------------------------------------------------------------------------------


@every_batch
@every_law
@pytest.mark.parametrize("common", [False, True])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (4, 5), (7, 2)])
def test_information(law, batch, common, m, n):
    if n == 1 and law.numbers[3] == 1:
        pytest.skip("no such tag")
    world = World(batch, m, n, common)
    for share in (world.share, np.ones((m, n)), np.zeros((m, n), bool)):
        assert_equal_forms(
            information.add_range_information, np.eye(6), *world.places, law.numbers, share
        )


def test_a_law_that_no_kernel_knows_takes_the_textbook_form():
    world = World((2,))
    law = noise_laws.LinkNoise(np.full((4, 5), 0.1))
    got = information.information_at(*world.places, law, world.share)
    want = information.information_at(*world.places, noise_laws.RangeNoise(0.1), world.share)
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)


@every_batch
@every_law
def test_posterior_step_with_ranges(law, batch):
    world = World(batch)
    twist = world.rng.standard_normal((*batch, 6))
    args = world.anchors, world.tags, world.rotation, world.translation, law.numbers, world.share
    for std in (np.zeros(6), np.array([0.1, 0.2, 0.3, 1, 2, 3])):
        for dt in (0.0, 0.2):
            seen = np.outer(np.arange(6.0), np.arange(6.0))
            for J in (world.matrix, np.zeros((6, 6)), 1e12 * world.matrix, seen):
                with np.errstate(all="ignore"):
                    got, _ = posterior.step_of_ranges.kernel(J, twist, dt, std, *args)
                    want, _ = posterior.step_of_ranges.textbook(J, twist, dt, std, *args)
                scale = np.sqrt(np.einsum("...ii->...i", want))
                scale = scale[..., :, None] * scale[..., None, :]
                np.testing.assert_allclose(got / scale, want / scale, rtol=0, atol=1e-9)
            assert_equal_forms(posterior.step_of_ranges, world.matrix, twist, dt, std, *args)


@every_batch
def test_posterior_step_with_angles(batch):
    world = World(batch, m=1)
    assert_equal_forms(
        posterior.step_of_angles, world.matrix, world.rng.standard_normal((*batch, 6)), 0.3,
        np.ones(6), world.anchors[..., 0, :], world.tags, world.rotation, world.translation, 0.01,
    )  # fmt: skip


@every_batch
def test_angles_of_an_epoch(batch):
    world = World(batch, m=1)
    normals = world.rng.standard_normal((*batch, 2, 5))
    for std in (0.01, 100.0):
        assert_equal_forms(
            bearing.sample, world.rotation, world.translation, world.tags,
            world.anchors[..., 0, :], normals, std,
        )  # fmt: skip


def test_scores_of_what_is_no_information_are_nan():
    world = World(())
    for J in (np.zeros((6, 6)), np.full((6, 6), np.nan), -np.eye(6)):
        args = (
            J, np.zeros(6), 0.0, np.zeros(6), *world.places, LAWS["own"].numbers, np.zeros((4, 5))
        )  # fmt: skip
        for form in (posterior.step_of_ranges.kernel, posterior.step_of_ranges.textbook):
            with np.errstate(all="ignore"):
                assert np.isnan(form(*args)[1])


# --- linear filters ------------------------------------------------------------------------------


class Linear:
    """States of 12 numbers with their covariances, and an epoch of ranges of the true poses."""

    def __init__(self, batch, m, n, weights, seed=0):
        world = World(batch, m, n, seed=seed)
        rng = world.rng
        self.tags, self.anchors = world.tags, world.anchors
        turn = rotations.exp(0.1 * rng.standard_normal((*batch, 3))) @ world.rotation
        place = world.translation + rng.standard_normal((*batch, 3))
        self.mean = np.concatenate([least_squares.vec(turn), place], axis=-1)
        root = rng.standard_normal((*batch, 12, 12))
        self.P = 0.01 * (root @ np.swapaxes(root, -1, -2) + np.eye(12))
        positions = ranging.tag_positions(world.rotation, world.translation, self.tags)
        self.ranges = ranging.distances(self.anchors, positions) + 0.05
        self.weights = rng.uniform(0.01, 1, (*batch, m, 1 if weights == "common" else n))
        if weights == "lost":
            self.weights *= rng.random(self.weights.shape) < 0.6
            # A tag that nobody hears, and an anchor that hears nobody.
            self.weights[..., 0] = 0.0
            self.weights[..., -1, :] = 0.0

    @property
    def epoch(self):
        return self.ranges, self.anchors, self.tags, self.weights


every_weight = pytest.mark.parametrize("weights", ["common", "of each link", "lost"])


@every_batch
def test_linear_prediction(batch):
    rng, linear = np.random.default_rng(5), Linear(batch, 4, 5, "common")
    for twist in (rng.standard_normal((*batch, 6)), np.zeros(6), np.array([0, 9.0, 0, 1, 2, 3])):
        assert_equal_forms(engines.predict_mean, linear.mean, twist, 0.3)
        for P in (linear.P, np.eye(12)):
            assert_equal_forms(engines.predict_covariance, P, twist, 0.3, rng.random(12))


@every_batch
@every_weight
@pytest.mark.parametrize(("m", "n"), [(1, 2), (4, 5), (10, 6)])
@pytest.mark.parametrize("flat", [False, True])
def test_linear_update(batch, weights, m, n, flat):
    linear = Linear(batch, m, n, weights)
    if flat:
        linear.anchors[..., 2], linear.tags[:, 1] = 0.0, 0.0
    P = assert_equal_forms(engines.update_covariance, linear.P, *linear.epoch[1:])[0]
    assert_equal_forms(engines.update_covariance, np.eye(12), *linear.epoch[1:])
    # The textbook form adds and subtracts numbers of the size of the squared ranges.
    assert_equal_forms(engines.update_mean, linear.mean, P, *linear.epoch, atol=1e-8)
    assert_equal_forms(engines.inverse12, np.eye(12) + P)


@every_weight
@pytest.mark.parametrize(("trials", "m", "n"), [(1, 1, 2), (3, 4, 5), (8, 10, 6)])
def test_linear_update_of_trials_with_one_covariance(weights, trials, m, n):
    linear, one = Linear((trials,), m, n, weights), Linear((), m, n, weights)
    P = engines.update_covariance(one.P, *one.epoch[1:])
    told = one.anchors, one.tags, one.weights
    means = assert_equal_forms(
        engines.update_means, linear.mean, P, linear.ranges, *told, atol=1e-8
    )[0]
    # Far from the origin: the textbook form would lose the digits.
    far = np.array([1e6, -2e6, 3e5])
    shifted = linear.mean + np.concatenate([np.zeros(9), far])
    with np.errstate(all="ignore"):
        found = engines.update_means.kernel(shifted, P, linear.ranges, told[0] + far, *told[1:])
    np.testing.assert_allclose(found - shifted, means - linear.mean, rtol=1e-6, atol=1e-6)
    for wrong in (0.0, -1.0, np.nan, np.inf, 1e60):
        spoiled = linear.ranges.copy()
        spoiled[-1, 0, -1] = wrong
        for form in (engines.update_means.kernel, engines.update_means.textbook):
            with np.errstate(all="ignore"):
                found = form(linear.mean, P, spoiled, *told)
            assert np.isnan(found[-1]).all()
            np.testing.assert_allclose(found[:-1], means[:-1], rtol=1e-6, atol=1e-8)


@every_batch
@pytest.mark.parametrize("law", [(0, 0.05, 0.0, -1), (0, 0.05, 0.01, 2), (1, 0.03, 0, 0)])
@pytest.mark.parametrize(("m", "n"), [(4, 5), (10, 6)])
def test_a_plain_linear_epoch_in_one_call(batch, law, m, n):
    linear = Linear(batch, m, n, "common")
    P = 0.1 * linear.P / np.abs(linear.P).max()
    told: list[Any] = [np.array(law, dtype=float), linear.anchors, linear.tags, 1 / 3]
    found = assert_equal_forms(
        engines.update_plain, linear.mean, P, linear.ranges, *told, atol=1e-8
    )
    weights = 1 / noise_laws.law_of(told[0]).squared_range_variance(linear.ranges)
    want = engines.update_covariance.textbook(P, linear.anchors, linear.tags, weights)
    np.testing.assert_allclose(found[1], want, rtol=1e-9, atol=1e-12)
    assert np.isfinite(found[0]).all()
    law_and_anchors = told[0], told[1], told[3]
    assert_equal_forms(engines.weigh_plain, P, linear.ranges, *law_and_anchors)
    spoiled = linear.ranges.copy()
    spoiled[..., 0, 0] = 0.0
    for prior, ranges in ((P, spoiled), (30 * P, linear.ranges)):
        for form in (engines.update_plain.kernel, engines.update_plain.textbook):
            with np.errstate(all="ignore"):
                assert np.isnan(form(linear.mean, prior, ranges, *told)[0]).all()
        for form in (engines.weigh_plain.kernel, engines.weigh_plain.textbook):
            with np.errstate(all="ignore"):
                assert np.isnan(form(prior, ranges, *law_and_anchors)).all()


@every_batch
@every_weight
def test_compressed_measurements(batch, weights):
    """Two factors of the same information: H^T H and H^T z are equal."""
    linear = Linear(batch, 4, 5, weights)
    told = []
    with np.errstate(all="ignore"):
        for form in (engines.compress.kernel, engines.compress.textbook):
            z, H = form(*linear.epoch, linear.mean)
            transposed = np.swapaxes(H, -1, -2)
            told.append((transposed @ H, (transposed @ z[..., None])[..., 0]))
    for mine, plain in zip(*told, strict=True):
        np.testing.assert_allclose(mine, plain, rtol=0, atol=1e-9 * np.abs(plain).max())


@every_batch
@pytest.mark.parametrize("factor", [1.0, 100.0, 1e6])
def test_vague_states(batch, factor):
    linear = Linear(batch, 4, 5, "common")
    for spread in (np.ones(12), np.repeat([1e-3, 1.0], [9, 3]), np.repeat([1.0, 1e-3], [9, 3])):
        P = factor * linear.P * np.sqrt(spread[:, None] * spread)
        got = engines.is_vague.kernel(P, linear.anchors, 1 / 3)
        np.testing.assert_array_equal(got, engines.is_vague.textbook(P, linear.anchors, 1 / 3))


@every_batch
@pytest.mark.parametrize(("m", "n"), [(4, 5), (10, 6)])
def test_linear_constraints_and_beliefs(batch, m, n):
    linear = Linear(batch, m, n, "common")
    assert_equal_forms(unitary.coupled_fit, linear.mean, linear.P)
    assert_equal_forms(unitary.decoupled_fit, linear.mean, linear.P, *linear.epoch)
    for form in (unitary.projected_belief, unitary.constrained_belief):
        assert_equal_forms(form, linear.mean, linear.P, np.zeros(3), np.zeros(6))


@every_batch
@pytest.mark.parametrize("size", [6, 12])
def test_sound_priors(batch, size):
    rng = np.random.default_rng(7)
    root = rng.standard_normal((*batch, size, size))
    Q, P = rotations.random(rng, batch), root @ np.swapaxes(root, -1, -2) + 1e-3 * np.eye(size)
    skew, wrong = np.zeros((size, size)), P.copy()
    skew[0, 1] = 0.1
    wrong[..., 2, 2] = np.nan
    no_rotations = (-Q, 1.001 * Q, Q @ np.diag([1.0, 1.0, 0.0]), np.full((3, 3), np.nan))
    no_covariances = (-P, P - 1e4 * np.eye(size), P + skew, wrong, 0 * P, 0 * P + 1.0)
    for rotation, covariance, sound in (
        (Q, P, True), *((R, P, False) for R in no_rotations),
        *((Q, C, False) for C in no_covariances),
    ):  # fmt: skip
        for form in (inputs.is_sound.kernel, inputs.is_sound.textbook):
            with np.errstate(all="ignore"):
                assert (form(rotation, covariance, 1e-6, 1e-8) == sound).all()


@every_batch
@pytest.mark.parametrize("rank", [1, 3, 9])
def test_procrustes(batch, rank):
    rng = np.random.default_rng(6)
    root = rng.standard_normal((*batch, 9, rank))
    weight, target = root @ np.swapaxes(root, -1, -2), rng.standard_normal((*batch, 9))
    start = rotations.random(rng, batch)
    _, cost = least_squares._newton.kernel(weight, target, start)
    _, want = least_squares._newton.textbook(weight, target, start)
    np.testing.assert_allclose(cost, want, rtol=1e-9, atol=1e-9)
    if rank == 9:
        assert_equal_forms(least_squares._newton, weight, target, start)


# --- errors ------------------------------------------------------------------------------------


@every_batch
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.1, 3.1])
@pytest.mark.parametrize("n", [1, 5])
def test_figures_of_beliefs(batch, angle, n):
    world = World(batch, n=n)
    axis = world.rng.standard_normal((*batch, 3))
    axis *= angle / np.linalg.norm(axis, axis=-1, keepdims=True)
    belief = rotations.exp(axis) @ world.rotation, world.translation + 0.1, world.matrix
    truth = world.rotation, world.translation, world.tags
    # The angle comes of a matrix near the identity, whose entries are rounded to 1e-16.
    atol = max(1e-9, 1e-15 / max(angle, 1e-9))
    assert_equal_forms(metrics._judge, *belief, *truth, atol=atol, least=1e-9)
    figures = metrics.judge(*belief, *truth)
    assert isinstance(figures, Figures)
    np.testing.assert_allclose(figures.rotation_error_rad, angle, atol=1e-7)
    error = metrics.pose_error(*belief[:2], *truth[:2])
    np.testing.assert_allclose(figures.nees, metrics.nees(error, belief[2]), rtol=1e-8)
    np.testing.assert_allclose(figures.score_m, pose.score(belief[2], belief[0], world.tags))


@pytest.mark.parametrize("factor", [-1.0, np.nan])
def test_figures_of_no_covariance_are_refused(factor):
    world = World((3,))
    world.matrix[1] *= factor
    pair = world.rotation, world.translation
    assert_equal_forms(metrics._judge, *pair, world.matrix, *pair, world.tags, least=1e-6)
    with pytest.raises(ValueError, match="covariance positive definite"):
        metrics.judge(*pair, world.matrix, *pair, world.tags)


# --- layouts -----------------------------------------------------------------------------------


@every_batch
@every_law
@pytest.mark.parametrize("m", [1, 4])
def test_scores_of_layouts(law, batch, m):
    world, poses = World((), m=m), World((*batch, 6), seed=1)
    anchors = world.rng.normal(0, 20, (*batch, m, 3))
    share = world.rng.random((*batch, 6, m))
    args = (
        anchors, poses.rotation, poses.translation, world.tags, 0.1 * np.eye(6), law.numbers, share
    )  # fmt: skip
    assert_equal_forms(placement.mean_square, *args)
    assert_equal_forms(
        placement.weighted_square, poses.matrix, poses.rotation, world.tags, world.rng.random(6)
    )


@every_batch
@every_law
@pytest.mark.parametrize("limits", [(), (30.0, 20.0, 2.0, 1.5), (25.0, 0.0, 1.5, 0.0)])
def test_gradients_of_layouts(law, batch, limits):
    world, poses = World((), m=4), World((*batch, 6), seed=1)
    anchors, normals = world.rng.normal(0, 15, (2, *batch, 4, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[..., 0, :] = 0.0
    gain = Gain(*limits)
    weight = world.rng.random(6)
    args = (
        anchors,
        normals,
        poses.rotation,
        poses.translation,
        weight,
        poses.matrix,
        world.tags,
        law.numbers,
        gain.numbers,
        world.rng.random((*batch, 6, 4, world.tags.shape[-2])),
    )
    square, slope = assert_equal_forms(gradient.square_and_gradient, *args)
    assert (np.abs(slope).max(axis=(-1, -2)) > 0).all()
    assert (square > 0).all()


@every_batch
def test_places_on_walls(batch):
    low, high = np.array([-1.0, 0, 2]), np.array([5.0, 3, 4])
    steps = np.array([-3, -1, -1e-4, 0, 5e-4, 0.3, 2])
    actions = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    actions = np.concatenate([actions, np.random.default_rng(0).normal(0, 1, (100, 3))])
    actions = actions.reshape(-1, *(1 for _ in batch), 3) * np.ones((*batch, 1))
    assert_equal_forms(regions.place_on_walls, actions, low, high)
    assert_equal_forms(regions._project_on_walls, 0.7 + 3.1 * actions, low, high)
    assert_equal_forms(regions._project_to_box, 0.7 + 3.1 * actions, low, high)
    assert_equal_forms(regions._place_in_box, actions, low, high)


@every_batch
@pytest.mark.parametrize("n", [1, 3, 6])
def test_regular_inverse(batch, n):
    rng = np.random.default_rng(n)
    root = rng.standard_normal((50, *batch, n, n)) * 10.0 ** rng.integers(-1, 2, n)[:, None]
    matrix = root @ np.swapaxes(root, -1, -2)
    matrix[0, ..., -1, :] = matrix[0, ..., :, -1] = 0.0
    matrix[1, ..., 0, 0] *= -1
    matrix[2, ..., -1, -1] = np.nan
    got, regular = assert_equal_forms(pose.regular_inverse, matrix, 1e-7)
    assert not regular[:2].any()
    assert regular[2].all()
    assert np.isnan(got[:3]).all()
    unit = got[3:] @ matrix[3:]
    np.testing.assert_allclose(
        unit[regular[3:]], np.broadcast_to(np.eye(n), unit.shape)[regular[3:]], atol=1e-6
    )
