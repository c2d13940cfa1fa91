"""locate_doa: the reference file, the bound, the global optimum, mirror images, bad input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import estimators, metrics
from rbl_gym.bounds import doa as doa_bounds
from rbl_gym.estimators.costs.doa_cost import DoaCost, SumCost
from rbl_gym.estimators.costs.levenberg_marquardt import minimize_pose
from rbl_gym.estimators.costs.range_cost import RangeCost
from rbl_gym.estimators.locating.doa_global import three_point_depths
from rbl_gym.estimators.locating.doa_newton import newton_iteration, unit_quaternion
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import bearing, ranging
from tests.helpers import load, over_bound

TAGS = bodies.doa2019()
T = np.array([5.0, 5.0, 3.0])
CASES = load("doa.json")["cases"]
METHODS = ["ml", "nia", "pso", "psa"]
degrees = pytest.mark.parametrize("sigma_deg", [0.01, 0.1, 1.0])


def trials(count, sigma_deg, seed=0, turned=True, tags=TAGS):
    """Rotations and noisy angles at (5, 5, 3), the law of the noise."""
    rng = np.random.default_rng(seed)
    rotation = rotations.random(rng, (count,)) if turned else np.tile(np.eye(3), (count, 1, 1))
    noise = bearing.AngleNoise(np.deg2rad(max(sigma_deg, 1e-4)))
    true = bearing.angles(ranging.tag_positions(rotation, T, tags))
    normals = rng.standard_normal(true.shape)
    angles = noise.sample(true, normals) if sigma_deg > 0 else true
    return rotation, angles, noise


def ratios(found, rotation, noise):
    """RMSE over the bound of rotation and translation."""
    error = metrics.pose_error(found.rotation, found.translation, rotation, T)
    return over_bound(error, doa_bounds.doa_crb(TAGS, rotation, T, noise))


# --- the reference ----------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_the_reference_file(case):
    angles = np.reshape(case["omega"], (2, 4))
    noise = bearing.AngleNoise(1.0)
    nia = estimators.locate_doa(angles, case["C"], "nia", noise, "y>0", distance_weight=1.0)
    np.testing.assert_allclose(nia.rotation, case["nia"]["R"], atol=1e-8)
    np.testing.assert_allclose(nia.translation, case["nia"]["t"], atol=1e-8)
    ml = estimators.locate_doa(angles, case["C"], "ml", noise, "y>0")
    np.testing.assert_allclose(ml.rotation, case["ml_se3"]["R"], atol=1e-6)
    np.testing.assert_allclose(ml.translation, case["ml_se3"]["t"], atol=1e-6)
    np.testing.assert_allclose(2 * ml.cost, case["ml_se3"]["cost"], atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_places_of_newtons_iteration(case):
    angles, tags = np.reshape(case["omega"], (1, 2, 4)), np.array([case["C"]])
    places = newton_iteration(angles, tags, 1.0)
    assert places.converged.all()
    assert places.iterations[0] <= case["nia"]["iterations"]
    np.testing.assert_allclose(places.positions[0], case["nia"]["S"], atol=1e-8)
    rotation, _ = unit_quaternion(places.positions, tags)
    np.testing.assert_allclose(rotation[0], case["nia"]["R"], atol=1e-8)


def test_newtons_iteration_takes_at_most_8_iterations_at_the_papers_pose():
    _, angles, _ = trials(1000, 0.1, turned=False)
    places = newton_iteration(angles, np.tile(TAGS, (1000, 1, 1)))
    assert places.converged.all()
    assert places.iterations.max() <= 8


def test_the_unit_quaternion_is_the_best_rotation():
    rng = np.random.default_rng(3)
    places = rng.normal(size=(50, 4, 3))
    rotation, translation = unit_quaternion(places, np.tile(TAGS, (50, 1, 1)))
    s, c = places - places.mean(axis=1, keepdims=True), TAGS - TAGS.mean(axis=0)
    np.testing.assert_allclose(rotation, rotations.nearest(np.swapaxes(s, 1, 2) @ c), atol=1e-9)
    np.testing.assert_allclose(
        (TAGS @ np.swapaxes(rotation, -1, -2) + translation[:, None]).mean(axis=1), places.mean(1)
    )


# --- how good ---------------------------------------------------------------------------------


@degrees
@pytest.mark.parametrize("method", ["ml", "nia"])
def test_reaches_the_bound_in_metres_and_in_kilometres(sigma_deg, method):
    rotation, angles, noise = trials(1000, sigma_deg, turned=False)
    found = estimators.locate_doa(angles, TAGS, method, noise, "y>0")
    in_metres = ratios(found, rotation, noise)
    np.testing.assert_allclose(in_metres, 1.0, atol=0.05)
    small = estimators.locate_doa(angles[:200], 1e-3 * TAGS, method, noise, "y>0")
    np.testing.assert_allclose(small.translation, 1e-3 * found.translation[:200], atol=1e-6)
    np.testing.assert_allclose(small.rotation, found.rotation[:200], atol=1e-4)


@pytest.mark.parametrize("method", ["ml", "nia"])
def test_without_noise_the_pose_is_exact(method):
    rotation, angles, noise = trials(300, 0.0)
    found = estimators.locate_doa(angles, TAGS, method, noise, "y>0")
    good = np.linalg.norm(found.translation - T, axis=-1) < 0.1
    assert good.mean() > (0.99 if method == "ml" else 0.85)
    np.testing.assert_allclose(found.rotation[good], rotation[good], atol=1e-8)
    np.testing.assert_allclose(found.translation[good], np.tile(T, (good.sum(), 1)), atol=1e-8)


@pytest.mark.parametrize("half_space", ["y>0", None])
@pytest.mark.parametrize("sigma_deg", [0.0, 1.0])
def test_newtons_iteration_that_runs_away_says_nothing(sigma_deg, half_space):
    """Warnings are errors: no step leaves the finite range. What is told is near the body."""
    _, angles, noise = trials(3000, sigma_deg, seed=1)
    found = estimators.locate_doa(angles, TAGS, "nia", noise, half_space)
    gone = np.isnan(found.translation).any(axis=-1)
    assert 20 < gone.sum() < 200
    assert not found.converged[gone].any()
    assert np.isnan(found.rotation[gone]).all()
    assert np.isnan(found.covariance[gone]).all()
    assert np.isinf(found.cost[gone]).all()
    assert (found.rank[gone] == 0).all()
    for field in (found.rotation, found.covariance, found.cost):
        assert np.isfinite(field[~gone]).all()
    distance = np.linalg.norm(found.translation[~gone], axis=-1)
    assert distance.max() < 1e4
    assert distance[found.converged[~gone]].max() < 100


@degrees
@pytest.mark.parametrize("half_space", ["y>0", None])
def test_finds_the_global_optimum_of_brute_force(sigma_deg, half_space):
    """Against 60 random starts and the truth: nothing cheaper is found in any trial."""
    count = 40
    rotation, angles, noise = trials(count, sigma_deg, seed=5)
    found = estimators.locate_doa(angles, TAGS, "ml", noise, half_space)
    rng = np.random.default_rng(6)
    cost = DoaCost(angles[:, None], np.full((1, 1, 2, 4), noise.std_rad**-2), TAGS, np.zeros(3))
    turns = rotations.random(rng, (count, 60))
    toward = bearing.directions(angles).mean(axis=1)
    places = toward[:, None] * rng.uniform(3, 15, (count, 60, 1))
    if half_space is None:
        places[:, ::2, 1] *= -1
    places -= (turns @ TAGS.mean(axis=0)[:, None])[..., 0]
    turns[:, 0], places[:, 0] = rotation, T
    brute = minimize_pose(cost, turns, places, 25)
    centre = brute.translation[..., 1] + brute.rotation[..., 1, :] @ TAGS.mean(axis=0)
    legal = np.where((centre > 0) | (half_space is None), brute.at.cost, np.inf)
    assert (found.cost <= legal.min(axis=1) + 1e-6).all()
    assert found.rank.min() == 6


def test_newtons_iteration_alone_finds_nine_of_ten_random_rotations():
    _, angles, noise = trials(1000, 0.1)
    found = estimators.locate_doa(angles, TAGS, "nia", noise, "y>0")
    success = (np.linalg.norm(found.translation - T, axis=-1) < 0.5).mean()
    assert 0.87 < success < 0.95
    failed = ~np.isfinite(found.translation).all(axis=-1)
    assert (np.isinf(found.cost) == failed).all()
    assert (found.rank[failed] == 0).all()


def test_covariance_is_honest():
    rotation, angles, noise = trials(1000, 0.1)
    found = estimators.locate_doa(angles, TAGS, "ml", noise, "y>0")
    error = metrics.pose_error(found.rotation, found.translation, rotation, T)
    nees = metrics.nees(error, found.covariance).mean()
    assert abs(nees - 6) < 5 * np.sqrt(12 / 1000)


# --- the sign of y ----------------------------------------------------------------------------


def test_the_handedness_of_the_body_tells_its_side_or_the_ambiguity_is_reported():
    rotation, angles, noise = trials(500, 0.1, seed=2)
    found = estimators.locate_doa(angles, TAGS, "ml", noise)
    turn = np.linalg.norm(rotations.error(found.rotation, rotation), axis=-1)
    right = (turn < 0.2) & (np.abs(found.translation - T).max(axis=-1) < 0.5)
    reported = np.isfinite(found.alternatives.cost[:, 0])
    assert right.mean() > 0.985
    assert (right | reported).mean() > 0.995


@pytest.mark.parametrize("method", METHODS)
def test_the_other_side_is_the_mirror_image(method):
    _, angles, noise = trials(8, 0.01, seed=3)
    # The same body seen in a mirror is a body with mirrored tags.
    here = estimators.locate_doa(angles, TAGS, method, noise, "y>0")
    there = estimators.locate_doa(angles, TAGS[:, [1, 0, 2]] * [1, -1, 1], method, noise, "y<0")
    assert (here.translation[np.isfinite(here.cost)][:, 1] > 0).all()
    assert np.isfinite(there.translation).any()
    centre = there.translation[:, 1] + there.rotation[:, 1] @ (
        TAGS[:, [1, 0, 2]] * [1, -1, 1]
    ).mean(axis=0)
    assert (centre[np.isfinite(centre)] < 0).all()


def test_a_flat_body_has_a_twin_across_the_plane():
    tags = bodies.plate(3.0, 2.0)
    _, angles, noise = trials(50, 0.01, seed=4, tags=tags)
    found = estimators.locate_doa(angles, tags, "ml", noise)
    others = found.alternatives
    np.testing.assert_allclose(others.cost[:, 0], found.cost, atol=1e-6)
    positions = ranging.tag_positions(found.rotation, found.translation, tags)
    twin = ranging.tag_positions(others.rotation[:, 0], others.translation[:, 0], tags)
    np.testing.assert_allclose(twin, bearing.MIRROR * positions, atol=1e-6)


@pytest.mark.parametrize("half_space", ["y>0", None])
def test_three_tags_leave_several_poses_and_say_so(half_space):
    _, angles, noise = trials(50, 0.01, seed=4, tags=TAGS[:3])
    found = estimators.locate_doa(angles, TAGS[:3], "ml", noise, half_space)
    np.testing.assert_allclose(found.cost, 0, atol=1e-6)
    others = np.isfinite(found.alternatives.cost).sum(axis=1)
    assert (others > 0).mean() > (0.5 if half_space else 0.99)
    poses = np.concatenate([found.translation[:, None], found.alternatives.translation], axis=1)
    assert (np.abs(poses - T).max(axis=-1).min(axis=1) < 0.5).mean() > (0.99 if half_space else 0.3)


@pytest.mark.parametrize("shift", [[0.0, 0.1, 0.0], [0.0, -4.0, 0.0]])
def test_angles_no_direction_has_are_handled(shift):
    """A body across y = 0 and noise: some cosines are infeasible."""
    rng = np.random.default_rng(7)
    place = np.array([8.0, 0.0, 3.0]) + shift
    rotation = rotations.random(rng, (100,))
    noise = bearing.AngleNoise(np.deg2rad(1.0))
    angles = bearing.simulate(TAGS, rotation, place, noise, rng)
    if shift[1] > 0:
        assert ((np.cos(angles) ** 2).sum(axis=1) > 1).any()
    for method in METHODS:
        found = estimators.locate_doa(angles[:10], TAGS, method, noise)
        assert np.isfinite(found.cost).any()
    found = estimators.locate_doa(angles, TAGS, "ml", noise)
    cost = DoaCost(angles, np.full((2, 4), noise.std_rad**-2), TAGS, np.zeros(3))
    near = minimize_pose(cost, rotation, np.tile(place, (100, 1)), 40).at.cost
    assert (found.cost <= near + 1e-6).mean() > 0.97


# --- form -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_batch_is_a_loop_and_a_station_is_a_shift(method):
    _, angles, noise = trials(6, 0.1)
    station = np.array([1.0, 2.0, 3.0])
    whole = estimators.locate_doa(angles.reshape(2, 3, 2, 4), TAGS, method, noise, "y>0")
    assert whole.translation.shape == (2, 3, 3)
    assert whole.alternatives.rotation.shape == (2, 3, 3, 3, 3)
    moved = estimators.locate_doa(angles, TAGS, method, noise, "y>0", station)
    np.testing.assert_allclose(moved.translation - station, whole.translation.reshape(6, 3))
    if method in ("ml", "nia"):
        for k in range(6):
            alone = estimators.locate_doa(angles[k], TAGS, method, noise, "y>0")
            np.testing.assert_allclose(
                alone.translation, whole.translation.reshape(6, 3)[k], atol=1e-7
            )


def test_three_points_of_the_quartic():
    rng = np.random.default_rng(8)
    places = rng.normal(size=(3, 3, 200)) + np.array([0, 6, 0.0])[:, None]
    depth = np.sqrt((places**2).sum(axis=1))
    found = three_point_depths(places / depth[:, None], places)
    gap = np.abs(found - depth[..., None]).max(axis=0).min(axis=-1)
    assert np.quantile(gap, 0.98) < 1e-5


def test_derivatives_of_the_costs_by_finite_differences():
    rng = np.random.default_rng(9)
    rotation, angles, _ = trials(1, 1.0)
    station = np.array([0.5, -0.5, 0.2])
    doa = DoaCost(angles[0], np.full((2, 4), 50.0), TAGS, station)
    ranges = RangeCost(rng.uniform(6, 9, (2, 4)), np.ones((2, 4)), rng.normal(size=(2, 3)), TAGS)
    for cost in (doa, SumCost((doa, ranges))):
        at = cost(rotation[0], T)
        for axis, d in enumerate(1e-6 * np.eye(6)):
            plus, minus = (cost(rotations.exp(e[:3]) @ rotation[0], T + e[3:]) for e in (d, -d))
            np.testing.assert_allclose(
                at.gradient[axis], (plus.cost - minus.cost) / 2e-6, rtol=1e-4, atol=1e-4
            )
    true = bearing.angles(ranging.tag_positions(rotation[0], T, TAGS), station)
    exact = DoaCost(true, doa.weights, TAGS, station)(rotation[0], T)
    information = doa_bounds.doa_information(
        TAGS, rotation[0], T, bearing.AngleNoise(50**-0.5), station
    )
    np.testing.assert_allclose(exact.hessian, information, rtol=1e-9)
    assert exact.cost < 1e-20


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "best"}, "method must be one of 'ml', 'nia', 'pso', 'psa', got 'best'"),
        ({"half_space": "up"}, "half_space must be"),
        ({"noise": 0.1}, "noise must be a bearing.AngleNoise"),
        ({"tags": TAGS[:2], "angles": np.ones((2, 2))}, "tags must be at least 3"),
        ({"tags": TAGS[[0, 1, 1, 0]]}, "tags must be at least 3 and not on one line, got 4 on"),
        ({"angles": np.full((2, 4), np.nan)}, "angles must be finite"),
        ({"angles": np.full((2, 4), 90.0)}, "angles must be angles in radians"),
        ({"station": [1.0, 2.0]}, "station must have shape"),
        ({"distance_weight": 0.0}, "distance_weight must be"),
        ({"half_space": ["y>0"]}, "half_space must be"),
        ({"method": "pso", "rng": 7}, r"rng must be a numpy\.random\.Generator, .* got 7"),
    ],
)
def test_bad_input_is_named(changes, message):
    arguments: dict[str, Any] = {"angles": np.ones((2, 4)), "tags": TAGS, **changes}
    with pytest.raises(ValueError, match=message):
        estimators.locate_doa(**arguments)
