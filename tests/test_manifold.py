"""The iterated EKF: reference track, derivatives, global start, robustness, bound."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bounds, estimators, metrics, motion
from rbl_gym.estimators.costs.levenberg_marquardt import minimize_pose
from rbl_gym.estimators.costs.losses import SQUARES, huber
from rbl_gym.estimators.costs.map_problem import MapProblem, PoseState
from rbl_gym.estimators.costs.range_cost import RangeCost
from rbl_gym.estimators.filter import inverse
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from tests.helpers import load, over_bound, random_world, reference_filter, simulate

NOISE = ranging.RangeNoise(0.05, 0.001)
PROCESS = motion.ProcessNoise(0.02, 0.1)


def make(tags, **options):
    return estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS, **options)


def test_track_of_the_reference_implementation_from_its_first_step():
    track = load("track.json")
    filter = reference_filter("iekf", track)
    first, *others = track["steps"]
    given = first["IEKF6raw"]
    state = filter.initial(given["Q"], given["t"], given["P"])
    for step in others:
        state = filter.predict(state, track["twist"], 1.0)
        state = filter.update(state, np.sqrt(step["d"]), np.array(track["A"]).T)
        expected = step["IEKF6raw"]
        np.testing.assert_allclose(state.rotation, expected["Q"], rtol=0, atol=1e-6)
        np.testing.assert_allclose(state.translation, expected["t"], rtol=0, atol=1e-6)
        np.testing.assert_allclose(
            state.covariance, expected["P"], rtol=0, atol=1e-6 * np.abs(expected["P"]).max()
        )


def test_the_papers_vague_prior_finds_the_reference_pose_by_itself():
    track = load("track.json")
    filter = reference_filter("iekf", track)
    state = filter.initial(np.eye(3), np.zeros(3), np.diag([50.0] * 3 + [100.0] * 3))
    state = filter.predict(state, track["twist"], 1.0)
    first = track["steps"][0]
    state = filter.update(state, np.sqrt(first["d"]), np.array(track["A"]).T)
    # The reference treats the vague prior in its own way: equal to a thousandth of its sigma.
    np.testing.assert_allclose(state.rotation, first["IEKF6raw"]["Q"], atol=1e-5)
    np.testing.assert_allclose(state.translation, first["IEKF6raw"]["t"], atol=1e-5)


@pytest.mark.parametrize(("threshold", "tag_variance"), [(None, 0.0), (1.5, 0.0), (None, 0.01)])
def test_gradient_and_hessian_by_finite_differences(threshold, tag_variance):
    rng = np.random.default_rng(1)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    ranges[1, 2] += 3.0
    P = np.diag([0.3, 0.2, 0.4, 1.0, 2.0, 3.0])
    off = rotations.exp(0.3 * rng.standard_normal(3)) @ rotation
    weights = 1 / NOISE.variance(ranges) * (rng.random((5, 4)) > 0.2)
    loss = SQUARES if threshold is None else huber(threshold)
    prior = PoseState(off, translation + 0.2, P)
    positions = ranging.tag_positions(off, translation, tags)
    unit = bounds.directions(anchors, positions)[1] if tag_variance else None
    problem = MapProblem(
        prior, inverse(P), RangeCost(ranges, weights, anchors, tags, loss, tag_variance, unit)
    )
    at = problem(rotation, translation)
    step = 1e-5

    def moved(error):
        return problem(rotations.exp(error[:3]) @ rotation, translation + error[3:])

    for axis in range(6):
        d = step * np.eye(6)[axis]
        numeric = (moved(d).cost - moved(-d).cost) / (2 * step)
        np.testing.assert_allclose(at.gradient[axis], numeric, rtol=1e-6, atol=1e-4)
    if threshold is None:
        # Without residuals the Gauss-Newton Hessian is the exact one.
        true = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
        exact = MapProblem(
            PoseState(rotation, translation, P),
            inverse(P),
            RangeCost(true, weights, anchors, tags, SQUARES, tag_variance, unit),
        )
        hessian = exact(rotation, translation).hessian
        for axis in range(6):
            d = step * np.eye(6)[axis]
            plus = exact(rotations.exp(d[:3]) @ rotation, translation + d[3:])
            minus = exact(rotations.exp(-d[:3]) @ rotation, translation - d[3:])
            numeric = (plus.gradient - minus.gradient) / (2 * step)
            np.testing.assert_allclose(hessian[axis], numeric, atol=1e-4 * np.abs(hessian).max())


def test_vague_priors_reach_the_global_optimum_of_brute_force():
    """100 poses against a multi-start from 100 random rotations: not one is missed."""
    rng = np.random.default_rng(3)
    tags = bodies.pyramid(1.0)
    anchors, _, rotation, translation = random_world(rng, 6, 5, (100,))
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    P = np.diag([50.0] * 3 + [100.0] * 3)
    filter = make(tags)
    state = filter.update(filter.initial(np.eye(3), np.zeros((100, 3)), P), ranges, anchors)
    data = RangeCost(ranges[:, None], (1 / NOISE.variance(ranges))[:, None], anchors[:, None], tags)
    problem = MapProblem(PoseState(np.eye(3), np.zeros(3), P), inverse(P), data)
    starts = rotations.random(rng, (100,))
    brute = minimize_pose(problem, starts, translation[:, None], 30).at.cost.min(axis=1)
    found = problem(state.rotation[:, None], state.translation[:, None]).cost[:, 0]
    assert (found <= brute + 1e-6).all()
    error = metrics.pose_error(state.rotation, state.translation, rotation, translation)
    mean = metrics.nees(error, state.covariance).mean()
    # chi-square with 6 degrees: standard deviation of the mean of 100 is 0.35.
    assert abs(mean - 6) < 4 * 0.35


def test_reaches_the_posterior_bound_and_is_consistent():
    """One update of a drawn prior, 2000 trials: RMSE within 3 sigma of the bound, NEES 6."""
    rng = np.random.default_rng(4)
    trials = 2000
    tags = bodies.octahedron(0.8)
    anchors, _, rotation, translation = random_world(rng, 6, 6)
    std = np.array([0.15] * 3 + [0.5] * 3)
    offset = std * rng.standard_normal((trials, 6))
    ranges = simulate(
        rng, anchors, tags, np.broadcast_to(rotation, (trials, 3, 3)), translation, NOISE
    )
    filter = make(tags)
    prior = filter.initial(
        rotations.exp(offset[:, :3]) @ rotation, translation + offset[:, 3:], np.diag(std**2)
    )
    belief = filter.belief(filter.update(prior, ranges, anchors))
    error = metrics.pose_error(belief.rotation, belief.translation, rotation, translation)
    bound = bounds.pose_crb(anchors, tags, rotation, translation, NOISE, np.diag(std**-2.0))
    assert over_bound(error, bound) == pytest.approx([1, 1], abs=3 / np.sqrt(2 * trials))
    nees = metrics.nees(error, belief.covariance).mean()
    assert abs(nees - 6) < 4 * np.sqrt(12 / trials)


def test_planar_body_finds_its_heading_from_a_vague_prior():
    """Height, roll and pitch held by the prior; anchors and tags in one plane."""
    rng = np.random.default_rng(5)
    tags = bodies.plate(0.6, 0.3)[[0, 1, 2]]
    anchors = np.array([[0, 0, 0], [7, 0, 0], [7, 6, 0], [0, 6, 0]], float)
    heading = rng.uniform(-np.pi, np.pi, 100)
    rotation = rotations.from_euler_zyx(heading, np.zeros(100), np.zeros(100))
    translation = np.column_stack([rng.uniform(1, 5, (100, 2)), np.zeros(100)])
    noise = ranging.RangeNoise(0.02)
    ranges = simulate(rng, anchors, tags, rotation, translation, noise)
    filter = estimators.make("iekf", tags=tags, noise=noise, process=PROCESS)
    P = np.diag([1e-6, 1e-6, np.pi**2, 49.0, 49.0, 1e-6])
    state = filter.update(filter.initial(np.eye(3), [3.5, 3.0, 0.0], P), ranges, anchors)
    error = metrics.pose_error(state.rotation, state.translation, rotation, translation)
    assert np.abs(error[:, 2]).max() < np.deg2rad(25)
    assert np.abs(error[:, 3:5]).max() < 0.15


def test_huber_shrugs_off_reflected_paths():
    """10 % of ranges 5 m too long: the plain filter is metres off, the robust one is not."""
    rng = np.random.default_rng(6)
    tags = bodies.octahedron(0.8)
    anchors, _, rotation, translation = random_world(rng, 8, 6, (300,))
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    ranges = ranges + 5.0 * (rng.random(ranges.shape) < 0.1)
    median = {}
    for robust in (False, True):
        filter = make(tags, robust=robust)
        state = filter.initial(rotation, translation, np.diag([0.03] * 3 + [0.25] * 3))
        state = filter.update(state, ranges, anchors)
        median[robust] = np.median(np.linalg.norm(state.translation - translation, axis=-1))
    assert median[True] < 0.05 < 0.5 < median[False]


def test_one_iteration_is_overconfident_where_four_are_not():
    rng = np.random.default_rng(7)
    trials = 2000
    tags = bodies.pyramid(1.0)
    anchors, _, rotation, translation = random_world(rng, 5, 5, (trials,))
    std = np.array([0.35] * 3 + [0.5] * 3)
    offset = std * rng.standard_normal((trials, 6))
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    nees = {}
    for iterations in (1, 4):
        filter = make(tags, iterations=iterations)
        state = filter.initial(
            rotations.exp(offset[:, :3]) @ rotation, translation + offset[:, 3:], np.diag(std**2)
        )
        state = filter.update(state, ranges, anchors)
        error = metrics.pose_error(state.rotation, state.translation, rotation, translation)
        nees[iterations] = metrics.nees(error, state.covariance).mean()
    assert nees[1] > 10
    assert abs(nees[4] - 6) < 0.4


@pytest.mark.parametrize("batch", [(1,), (40,), (2, 3)])
@pytest.mark.parametrize("shared", [(), ("state",), ("twist",)], ids=str)
def test_prediction_of_a_batch_is_that_of_each_body(batch, shared):
    rng = np.random.default_rng(8)
    process = motion.ProcessNoise((0.01, 0.2, 0.03), (0.1, 0.4, 0.2))
    filter = IteratedEkf(random_world(rng, 4, 5)[1], ranging.RangeNoise(0.1), process)
    of = {key: () if key in shared else batch for key in ("state", "twist")}
    A = rng.normal(size=(*of["state"], 6, 6))
    state = filter.initial(
        rotations.random(rng, of["state"]),
        rng.normal(size=(*of["state"], 3)),
        A @ np.swapaxes(A, -1, -2) + np.eye(6),
    )
    twist = rng.normal(size=(*of["twist"], 6)) * 10.0 ** rng.uniform(-6, 0.5, (*of["twist"], 1))
    got = filter.predict(state, twist, 0.5)
    everything = PoseState(
        *(np.broadcast_to(field, (*batch, *field.shape[len(of["state"]) :])) for field in state)
    )
    twists = np.broadcast_to(twist, (*batch, 6))
    for k in np.ndindex(batch):
        want = filter.predict(PoseState(*(field[k] for field in everything)), twists[k], 0.5)
        for a, b in zip(got, want, strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-12, atol=1e-13)


def test_prediction_turns_the_covariance_with_the_body():
    filter = make(bodies.pyramid())
    P = np.diag([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    twist = np.array([0.0, 0.0, np.pi / 2, 1.0, 0.0, 0.0])
    state = filter.predict(filter.initial(np.eye(3), np.zeros(3), P), twist, 1.0)
    Jl = rotations.left_jacobian(twist[:3])
    np.testing.assert_allclose(
        state.covariance[:3, :3], np.diag([0.2, 0.1, 0.3]) + 0.02**2 * Jl @ Jl.T, atol=1e-12
    )
    np.testing.assert_allclose(state.translation, [1, 0, 0])


@pytest.mark.parametrize("proportional", [0.0, 0.01])
def test_lost_links_by_the_filters_own_law_are_those_of_the_same_deviations(proportional):
    rng = np.random.default_rng(8)
    anchors, tags, rotation, translation = random_world(rng, 6, 4)
    noise = ranging.RangeNoise(0.05, proportional)
    filter = estimators.make("iekf", tags=tags, noise=noise, process=motion.ProcessNoise(0.1, 0.1))
    state = filter.initial(rotation, translation, np.diag([0.01] * 3 + [0.04] * 3))
    ranges = ranging.simulate(anchors, tags, rotation, translation, noise, rng).ranges
    links = rng.random(ranges.shape) < 0.6
    # What is not measured may be anything that is a number.
    ranges[~links] = -1e3
    told = ranging.LinkNoise(
        np.where(links, noise.floor_m**2 + (proportional * ranges) ** 2, 1) ** 0.5
    )
    for mine, theirs in zip(
        filter.update(state, ranges, anchors, links),
        filter.update(state, ranges, anchors, links, noise=told),
        strict=True,
    ):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-12)
