"""The iterated EKF with an unknown twist or biased links: brute force, bound, consistency."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats

from rbl_gym import bounds, estimators, metrics, motion
from rbl_gym.estimators.iekf.augmented import AugmentedEkf, AugmentedState
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.named import iekf_bias, iekf_cv
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.motion import unknown_twist as ut
from rbl_gym.worlds import scenes
from tests.helpers import draw_biases, random_world, simulate, with_kernels

NOISE = ranging.RangeNoise(0.05, 0.001)
PROCESS = motion.ProcessNoise(0.02, 0.1)


def random_state(rng, filter, anchors, rotation, translation, k):
    """A state with `k` extra states and a covariance of which nothing is zero."""
    A = rng.normal(size=(12 + 2 * k, 6 + k)) @ np.diag([0.05] * 3 + [0.2] * 3 + [0.1] * k)
    offset = 0.1 * rng.standard_normal(6)
    return AugmentedState(
        rotations.exp(offset[:3]) @ rotation,
        translation + offset[3:],
        0.1 * rng.standard_normal(k),
        A.T @ A + 1e-4 * np.eye(6 + k),
    )


def brute_force(state, ranges, anchors, tags, links, sums):
    """Maximum a posteriori of all states at once, and the inverse of J^T J there."""
    root = np.linalg.cholesky(np.linalg.inv(state.covariance)).T
    std = np.sqrt(NOISE.variance(ranges))

    def pose(e):
        return rotations.exp(e[:3]) @ state.rotation, state.translation + e[3:6]

    def residual(e):
        Q, t = pose(e)
        distance = ranging.distances(anchors, ranging.tag_positions(Q, t, tags))
        biases = (sums @ (state.extra + e[6:])).reshape(ranges.shape)
        return np.concatenate([root @ e, ((distance + biases - ranges) / std)[links]])

    found = optimize.least_squares(
        residual, np.zeros(len(state.covariance)), "3-point", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    # From the chart of the prior to the error at the pose found.
    D = np.eye(len(found.x))
    D[:3, :3] = rotations.left_jacobian_inverse(found.x[:3])
    J = found.jac @ D
    return *pose(found.x), state.extra + found.x[6:], np.linalg.inv(J.T @ J)


@pytest.mark.parametrize(("twist", "laws"), [(True, 0), (False, 1), (False, 2), (True, 1)], ids=str)
@pytest.mark.parametrize("missing", [False, True])
def test_update_is_the_maximum_a_posteriori_of_all_states_by_brute_force(twist, laws, missing):
    rng = np.random.default_rng(4)
    anchors, tags, rotation, translation = random_world(rng, 5, 3)
    pose = IteratedEkf(tags, NOISE, PROCESS, iterations=20)
    law = ut.WanderingTwist() if twist else None
    filter = AugmentedEkf(pose, law, None, (LinkBias(0.1),) * laws)
    n_twist = 6 if twist else 0
    state = random_state(rng, filter, anchors, rotation, translation, n_twist + 15 * laws)
    links = rng.random((5, 3)) > (0.4 if missing else -1)
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE) + 0.1
    sums = np.hstack([np.zeros((15, n_twist)), *[np.eye(15)] * laws])
    want = brute_force(state, ranges, anchors, tags, links, sums)
    got = filter.update(state, np.where(links, ranges, np.nan), anchors, links)
    for a, b, tolerance in zip(got, want, (1e-6, 1e-6, 1e-6, 1e-4), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1, np.abs(b).max()))
    # The same among others, each with links of its own.
    others = np.stack([links, rng.random((5, 3)) > 0.3])
    batch = filter.update(state, np.where(others, ranges, 0), anchors, others)
    for a, b in zip(batch, got, strict=True):
        np.testing.assert_allclose(a[0], b, rtol=0, atol=1e-6)
    alone = filter.update(state, ranges, anchors, others[1])
    for a, b in zip(batch, alone, strict=True):
        np.testing.assert_allclose(a[1], b, rtol=0, atol=1e-6)


@pytest.mark.parametrize("robust", [False, True])
def test_without_further_unknowns_they_are_the_plain_filter(robust):
    rng = np.random.default_rng(2)
    anchors, tags, rotation, translation = random_world(rng, 5, 4, (4,))
    options = {"tags": tags, "noise": NOISE, "process": PROCESS, "robust": robust}
    plain = estimators.make("iekf", **options)
    still = estimators.make(
        "iekf-cv", **options, turn_rate_rad_s=0, speed_m_s=0, turn_acceleration=0, acceleration=0
    )
    exact = estimators.make("iekf-bias", **options, bias_std_m=0, common_std_m=0)
    filters = (plain, still) if robust else (plain, still, exact)
    states = [f.initial(rotation, translation, 0.04 * np.eye(6)) for f in filters]
    for _ in range(3):
        ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
        states = [f.predict(s, np.zeros(6), 0.2) for f, s in zip(filters, states, strict=True)]
        states = [f.update(s, ranges, anchors) for f, s in zip(filters, states, strict=True)]
        want, *others = (f.belief(s) for f, s in zip(filters, states, strict=True))
        for got in others:
            for a, b in zip(got, want, strict=True):
                np.testing.assert_allclose(a, b, atol=1e-7)


@pytest.mark.parametrize(
    ("sensor", "options"),
    [
        (None, {}),
        (ut.TwistSensor(0.05, None, "body"), {"gyro_std_rad_s": 0.05, "frame": "body"}),
        (ut.TwistSensor(0.05, 0.2), {"gyro_std_rad_s": 0.05, "speed_std_m_s": 0.2}),
    ],
    ids=["nothing", "gyro", "odometry"],
)
def test_unknown_twist_in_the_drone_yard_reaches_the_bound_and_is_consistent(sensor, options):
    """500 bodies drawn from the law: RMSE within 5 % of the bound of 12 states, NEES 12."""
    scene = scenes.get("drone_yard")
    rng = np.random.default_rng(3)
    trials, steps = 500, 30
    law = ut.WanderingTwist(scene.spin_rad_s, 3.0, 0.1, 1.0)
    low, high = scene.volume.bounds()
    rotation = rotations.random(rng, (trials,))
    start = rng.uniform(low, high, (trials, 3))
    path = ut.simulate_wandering(rotation, start, law, scene.process, scene.dt, steps, rng)
    tags, anchors = np.asarray(scene.tags), np.asarray(scene.anchors)
    filter = iekf_cv(
        tags, scene.noise, scene.process, turn_rate_rad_s=law.turn_rate_rad_s,
        speed_m_s=law.speed_m_s, turn_acceleration=0.1, acceleration=1.0, **options,
    )  # fmt: skip
    P = scene.prior_covariance
    offset = np.sqrt(np.diag(P)) * rng.standard_normal((trials, 6))
    state = filter.initial(rotations.exp(offset[:, :3]) @ rotation, start + offset[:, 3:], P)
    J = np.diag([*1 / np.diag(P), *law.prior_std() ** -2.0])
    J = np.broadcast_to(J, (trials, 12, 12)).copy()
    J[:, :6, :6] += bounds.range_information(anchors, tags, rotation, start, scene.noise)
    squares, variances, nees = [], [], []
    for k in range(steps + 1):
        pose = path.rotation[:, k], path.translation[:, k]
        if k:
            twist, reading = path.twists[:, k - 1], None
            if sensor is not None:
                std = np.where(np.isfinite(sensor.std()), sensor.std(), 0.0)
                reading = sensor.read(path.rotation[:, k - 1], twist)
                reading = reading + std * rng.standard_normal((trials, 6))
            state = filter.predict(state, reading, scene.dt)
            moved = bounds.UnknownTwist(twist, scene.dt, scene.process, law, sensor)
            epoch = bounds.RangeEpoch(anchors, tags, *pose, scene.noise)
            J = bounds.posterior_step(J, epoch, moved)
        ranges = simulate(rng, anchors, tags, *pose, scene.noise)
        state = filter.update(state, ranges, anchors)
        error = metrics.pose_error(state.rotation, state.translation, *pose)
        error = np.concatenate([error, state.extra - path.twists[:, k]], axis=-1)
        squares.append((error**2).mean(axis=0))
        variances.append(np.diagonal(np.linalg.inv(J), axis1=-2, axis2=-1).mean(axis=0))
        nees.append(metrics.nees(error, state.covariance))
    ratio = [
        np.sqrt(np.sum(np.array(squares)[:, block]) / np.sum(np.array(variances)[:, block]))
        for block in (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12))
    ]
    assert max(ratio) < 1.05
    assert min(ratio) > 0.95
    # Of 500 trials alike: the sum of their NEES is chi-square of 6000 degrees.
    for k in (0, steps // 2, steps):
        low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], 12 * trials)
        assert low < nees[k].sum() < high


def test_a_gyroscope_makes_the_rotation_better():
    P = np.diag([0.01] * 3 + [1.0] * 9)
    law, noise = ut.WanderingTwist(1.0, 1.0, 1.0, 1.0), motion.ProcessNoise()
    tags = bodies.octahedron()
    without = iekf_cv(tags, NOISE, noise, 1, False, 1.0, 1.0, 1.0, 1.0)
    with_it = iekf_cv(tags, NOISE, noise, 1, False, 1.0, 1.0, 1.0, 1.0, gyro_std_rad_s=0.01)
    state = AugmentedState(np.eye(3), np.zeros(3), np.zeros(6), P)
    reading = np.array([0.5, 0, 0, 9.0, 9, 9])
    blind, seen = (f.predict(state, reading, 0.1) for f in (without, with_it))
    assert law.std()[0] == 1.0
    np.testing.assert_array_equal(blind.rotation, np.eye(3))
    np.testing.assert_allclose(rotations.log(seen.rotation), [0.05, 0, 0], atol=1e-4)
    np.testing.assert_array_equal(seen.translation, np.zeros(3))
    assert seen.covariance[0, 0] < blind.covariance[0, 0] - 0.009


def biased_recording(rng, trials, steps, law):
    """A planar body on a circle among 8 anchors, ranges with biases of a law."""
    tags = np.array([[-0.07, -0.14, 0], [-0.07, 0.14, 0], [0.2, 0.14, 0]])
    sides = [[-4, 3], [0, 3], [4, 3], [4, 0], [4, -3], [0, -3], [-4, -3], [-4, 0]]
    anchors = np.column_stack([sides, np.zeros(8)])
    times = 0.1 * np.arange(steps)
    phase = rng.uniform(0, 2 * np.pi, (trials, 1)) + 0.2 * times
    heading = np.zeros((trials, steps, 3))
    heading[..., 2] = phase + np.pi / 2
    rotation = rotations.exp(heading)
    translation = np.stack([2 * np.cos(phase), 2 * np.sin(phase), 0 * phase], axis=-1)
    biases = draw_biases(law, times, 24, rng, (trials,)).reshape((trials, steps, 8, 3))
    noise = ranging.RangeNoise(0.03)
    ranges = simulate(rng, anchors, tags, rotation, translation, noise) + biases
    twist = np.array([0, 0, 0.2, 0, 0, 0])
    twists = np.broadcast_to(twist, (trials, steps, 6)).copy()
    twists[:, 1:, 3:] = np.diff(translation, axis=1) / 0.1
    return times, anchors, tags, rotation, translation, ranges, noise, twists


@with_kernels
@pytest.mark.parametrize(
    ("law", "gain"),
    [(LinkBias(0.05, None, 0.2), 2.0), (LinkBias(0.05, 2.0), 1.05)],
    ids=["constant", "wandering"],
)
def test_biases_of_links_are_learned_and_the_covariance_stays_honest(law, gain):
    """The plain filter is overconfident by far; the one that learns the biases is better."""
    rng = np.random.default_rng(4)
    trials, steps = 150, 60
    times, anchors, tags, rotation, translation, ranges, noise, twists = biased_recording(
        rng, trials, steps, law
    )
    process = motion.ProcessNoise((0, 0, 0.02), (0.02, 0.02, 0))
    P = np.diag([1e-6, 1e-6, 0.04, 0.04, 0.04, 1e-6])
    offset = np.sqrt(np.diag(P)) * rng.standard_normal((trials, 6))
    options = {"bias_std_m": law.std_m, "bias_time_s": law.time_s, "common_std_m": law.common_std_m}
    filters = [
        estimators.make("iekf", tags=tags, noise=noise, process=process),
        estimators.make("iekf-bias", tags=tags, noise=noise, process=process, **options),
    ]
    rms, nees = [], []
    for filter in filters:
        state = filter.initial(
            rotations.exp(offset[:, :3]) @ rotation[:, 0], translation[:, 0] + offset[:, 3:], P
        )
        for k in range(steps):
            if k:
                state = filter.predict(state, twists[:, k], times[k] - times[k - 1])
            state = filter.update(state, ranges[:, k], anchors)
        belief = filter.belief(state)
        error = metrics.pose_error(
            belief.rotation, belief.translation, rotation[:, -1], translation[:, -1]
        )[:, 2:5]
        rms.append(np.sqrt((error[:, 1:] ** 2).sum(axis=-1).mean()))
        nees.append(metrics.nees(error, belief.covariance[:, 2:5, 2:5]).mean() / 3)
    assert rms[0] > gain * rms[1]
    assert nees[0] > 4
    # The truth moves without the noise that the filters allow for: honest, if anything careful.
    assert 0.4 < nees[1] < 1.2


@pytest.mark.parametrize("twist", [None, ut.WanderingTwist()], ids=["known", "unknown"])
def test_biases_are_forgotten_as_their_law_says(twist):
    rng = np.random.default_rng(6)
    anchors, tags, rotation, translation = random_world(rng, 4, 3)
    law = LinkBias(0.3, 2.0, 0.1)
    filter = AugmentedEkf(IteratedEkf(tags, NOISE, PROCESS), twist, biases=(law,))
    biases = slice(-12, None)
    state = filter.initial(rotation, translation, 0.01 * np.eye(6))
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE) + 0.3
    state = filter.update(state, ranges, anchors)
    later = filter.predict(state, np.zeros(6), 1.0)
    np.testing.assert_allclose(later.extra[biases], np.exp(-0.5) * state.extra[biases])
    np.testing.assert_array_equal(later.extra[:-12], state.extra[:-12])
    own = state.covariance[biases, biases]
    want = np.exp(-1) * own + (1 - np.exp(-1)) * law.covariance(12)
    np.testing.assert_allclose(later.covariance[biases, biases], want)
    much_later = filter.predict(state, np.zeros(6), 100.0)
    own = much_later.covariance[biases, biases]
    np.testing.assert_allclose(own, law.covariance(12), atol=1e-12)


def test_a_vague_prior_finds_its_pose_beside_one_that_knows():
    rng = np.random.default_rng(8)
    anchors, _, rotation, translation = random_world(rng, 6, 5, (3,))
    tags = bodies.pyramid()
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    ranges = ranges + 0.05 * rng.standard_normal(ranges.shape)
    filter = iekf_bias(tags, NOISE, PROCESS, robust=True, bias_std_m=0.05, common_std_m=0.05)
    P = np.stack([np.diag([10.0] * 3 + [100.0] * 3), 0.01 * np.eye(6), np.diag([10.0] * 6)])
    start = rotation.copy()
    start[0] = rotations.exp([2.0, 1.0, 0.0]) @ rotation[0]
    state = filter.update(filter.initial(start, translation, P), ranges, anchors)
    error = metrics.pose_error(state.rotation, state.translation, rotation, translation)
    assert np.abs(error[:, :3]).max() < 0.6
    assert (metrics.nees(error, filter.belief(state).covariance) < 30).all()


def test_what_cannot_be_is_refused():
    rng = np.random.default_rng(10)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    ranges = simulate(rng, anchors, tags, rotation, translation, NOISE)
    biased = iekf_bias(tags, NOISE, PROCESS)
    state = biased.update(biased.initial(rotation, translation, np.eye(6) * 0.01), ranges, anchors)
    with pytest.raises(ValueError, match=r"the number of anchors must stay 5, .*, got 4"):
        biased.update(state, ranges[:4], anchors[:4])
    with pytest.raises(ValueError, match="twist must be given"):
        biased.predict(state, None, 0.1)
    with pytest.raises(ValueError, match="twist must have shape"):
        biased.predict(state, np.zeros(5), 0.1)
    with pytest.raises(ValueError, match="dt must be a finite number"):
        biased.predict(state, np.zeros(6), -1)
    with pytest.raises(ValueError, match="ranges must be positive"):
        biased.update(state, -ranges, anchors)
    with pytest.raises(ValueError, match="std_m must be a finite number"):
        iekf_bias(tags, NOISE, PROCESS, bias_std_m=-1)
    with pytest.raises(ValueError, match="time_s must be a finite number"):
        iekf_bias(tags, NOISE, PROCESS, bias_time_s=0)
    with pytest.raises(ValueError, match="has no option 'bias_std_m'"):
        estimators.make("iekf-cv", tags=tags, noise=NOISE, process=PROCESS, bias_std_m=1)
