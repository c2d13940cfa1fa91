"""The filter driven by an inertial sensor: against a textbook EKF, consistency in simulation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym import bounds, estimators, kernels, metrics, motion
from rbl_gym.bounds import inertial as inertial_bounds
from rbl_gym.estimators.bank.headings import HeadingBank
from rbl_gym.estimators.iekf.augmented_steps import carry_states
from rbl_gym.estimators.iekf.inertial import InertialEkf, fade
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import inertial, link_bias, ranging
from rbl_gym.motion import navigation
from rbl_gym.studies import monte_carlo
from rbl_gym.worlds import scene_bounds, scenes, simulation
from tests.helpers import with_kernels

TAGS = bodies.octahedron(0.8)
ANCHORS = np.array([[-6, -5, 0.5], [6, -5, 4], [6, 5, 0], [-6, 5, 3.5], [0, -6, 2], [1, 6, 5.0]])
NOISE = ranging.RangeNoise(0.05)
SENSOR = inertial.InertialSensor(gyro_noise=0.01, accel_noise=0.1, accel_walk=0.05, gyro_walk=0.01)
G = inertial.GRAVITY_M_S2
PRIOR = np.diag([0.05] * 3 + [0.2] * 3) ** 2


def made(**options) -> Any:
    return estimators.make(
        "iekf-imu", tags=TAGS, noise=NOISE, process=motion.ProcessNoise(),
        inertial=options.pop("inertial", SENSOR), **options,
    )  # fmt: skip


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def textbook_predict(R, p, v, bias, P, readings, h):
    """An error-state EKF of 15 states sample by sample, first order, with scipy's rotations."""
    for reading in readings:
        w, f = reading[:3] - bias[:3], reading[3:] - bias[3:]
        force = (R * Rotation.from_rotvec(0.5 * h * w)).apply(f)
        M = R.as_matrix()
        F = np.eye(15)
        F[:3, 9:12] = -M * h
        F[6:9, :3], F[6:9, 12:] = -skew(force) * h, -M * h
        F[3:6, 6:9] = h * np.eye(3)
        F[3:6, :3], F[3:6, 12:] = 0.5 * h * F[6:9, :3], 0.5 * h * F[6:9, 12:]
        Q = np.zeros((15, 15))
        Q[:3, :3] = SENSOR.gyro_noise**2 * h * np.eye(3)
        Q[6:9, 6:9] = SENSOR.accel_noise**2 * h * np.eye(3)
        Q[9:12, 9:12] = SENSOR.gyro_walk**2 * h * np.eye(3)
        Q[12:, 12:] = SENSOR.accel_walk**2 * h * np.eye(3)
        P = F @ P @ F.T + Q
        p = p + v * h + 0.5 * h**2 * (force - [0, 0, G])
        v = v + h * (force - [0, 0, G])
        R = R * Rotation.from_rotvec(h * w)
    return R, p, v, P


def test_the_prediction_against_a_textbook_filter():
    """To first order in the length of a sample: they agree better as samples get shorter."""
    rng = np.random.default_rng(0)
    filter = made(speed_m_s=2.0)
    assert isinstance(filter, InertialEkf)
    assert isinstance(filter, estimators.AugmentedEkf)
    R = Rotation.from_rotvec([0.3, -0.2, 1.0])
    state = filter.initial(R.as_matrix(), [1.0, 2, 3], PRIOR)
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(state.covariance))[6:], [2] * 3 + [0.01] * 3 + [0.1] * 3
    )
    readings = np.repeat(rng.standard_normal((1, 6)) + [0, 0, 0, 0, 0, 9], 400, axis=0)
    found = state
    for part in np.split(readings, 100):
        # Walks within an interval count after it.
        found = filter.predict(found, part, 0.004)
    R, p, v, P = textbook_predict(
        R, np.array([1.0, 2, 3]), np.zeros(3), np.zeros(6), state.covariance, readings, 0.001
    )
    np.testing.assert_allclose(found.rotation, R.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(found.translation, p, atol=1e-9)
    np.testing.assert_allclose(found.extra[:3], v, atol=1e-9)
    scale = np.sqrt(np.diagonal(P))
    scale = np.outer(scale, scale)
    np.testing.assert_allclose(found.covariance / scale, P / scale, atol=1e-3)


def test_the_update_against_a_textbook_filter():
    """Near its prior a Gauss-Newton update is that of an EKF."""
    rng = np.random.default_rng(1)
    filter = made(speed_m_s=2.0)
    Q = rotations.random(rng)
    state = filter.predict(
        filter.initial(Q, [0.1, 0.2, 1.0], PRIOR), rng.standard_normal((10, 6)), 0.1
    )
    distance, J = bounds.range_jacobian(ANCHORS, TAGS, state.rotation, state.translation)
    H = np.concatenate([J.T, np.zeros((J.shape[-1], 9))], axis=1)
    nu = 1e-5 * rng.standard_normal(J.shape[-1])
    S = H @ state.covariance @ H.T + 0.05**2 * np.eye(len(nu))
    K = state.covariance @ H.T @ np.linalg.inv(S)
    step, P = K @ nu, (np.eye(15) - K @ H) @ state.covariance
    found = filter.update(state, distance + nu.reshape(distance.shape), ANCHORS)
    np.testing.assert_allclose(rotations.error(found.rotation, state.rotation), step[:3], atol=1e-9)
    np.testing.assert_allclose(found.translation - state.translation, step[3:6], atol=1e-9)
    np.testing.assert_allclose(found.extra - state.extra, step[6:], atol=1e-8)
    np.testing.assert_allclose(found.covariance, P, atol=1e-6)


@pytest.mark.skipif(not kernels.enabled(), reason="needs numba")
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_the_kernel_that_carries_states_along_and_its_textbook(batch):
    rng = np.random.default_rng(8)
    A = rng.standard_normal((*batch, 17, 17))
    Q, turn = rotations.random(rng, batch), 0.5 * rng.standard_normal((*batch, 3))
    P, t = A @ np.swapaxes(A, -1, -2), rng.standard_normal((2, *batch, 3))
    # What is known of the pose afterwards is not more than nothing, nor more than before.
    new = 0.3 * P[..., :6, :6]
    state = Q, t[0], rng.standard_normal((*batch, 11)), P, rotations.exp(turn) @ Q, t[1], new
    one, other = (form(*state) for form in (carry_states.textbook, carry_states.kernel))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.skipif(not kernels.enabled(), reason="needs numba")
@pytest.mark.parametrize("batch", [(), (3,)])
def test_the_kernel_that_forgets_biases_and_its_textbook(batch):
    rng = np.random.default_rng(9)
    A = rng.standard_normal((*batch, 27, 27))
    laws = np.array([[0.2, np.inf, 0.3], [0.1, 2.0, 0.05]])
    state = rng.standard_normal((*batch, 21)), A @ np.swapaxes(A, -1, -2), laws
    dt = rng.uniform(0.1, 3, batch)
    one, other = (form(*state, dt, 9) for form in (fade.textbook, fade.kernel))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_samples_may_have_lengths_of_their_own_and_bodies_their_own_readings():
    rng = np.random.default_rng(2)
    filter = made(drift_std_m=0.1, drift_time_s=3.0, gravity_tilt_rad=0.02)
    Q = rotations.random(rng, (4,))
    state = filter.initial(Q, np.zeros((4, 3)), PRIOR)
    state = filter.update(state, ranging.distances(ANCHORS, TAGS + [0, 0, 1.0]), ANCHORS)
    readings, steps = rng.standard_normal((4, 5, 6)), rng.uniform(0.01, 0.03, (4, 5))
    together = filter.predict(state, readings, steps)
    for i in range(4):
        one = filter.predict(
            estimators.AugmentedState(*(field[i] for field in state)), readings[i], steps[i]
        )
        for a, b in zip(one, together, strict=True):
            np.testing.assert_allclose(a, b[i], atol=1e-12)
    once = filter.predict(state, readings[:, :, :], np.full(5, 0.02))
    again = filter.predict(state, readings, 0.1)
    np.testing.assert_allclose(once.covariance, again.covariance, rtol=1e-12)


def test_drifting_biases_of_links_are_forgotten():
    filter = made(bias_std_m=0.2, common_std_m=0.3, drift_std_m=0.1, drift_time_s=2.0)
    state = filter.initial(np.eye(3), np.zeros(3), PRIOR)
    state = filter.update(state, ranging.distances(ANCHORS, TAGS) + 0.1, ANCHORS)
    links = len(ANCHORS) * len(TAGS)
    assert state.extra.shape == (9 + 2 * links,)
    later = filter.predict(state, np.tile([0, 0, 0, 0, 0, G], (10, 1)), 4.0)
    np.testing.assert_allclose(later.extra[9:], state.extra[9:] * np.repeat([1, np.exp(-2)], links))
    kept, before = later.covariance[15:, 15:], state.covariance[15:, 15:]
    np.testing.assert_allclose(kept[:links, :links], before[:links, :links], atol=1e-12)
    fresh = (1 - np.exp(-4)) * link_bias.LinkBias(0.1, 2.0).covariance(links)
    expected = np.exp(-4) * before[links:, links:] + fresh
    np.testing.assert_allclose(kept[links:, links:], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"inertial": "best"}, "inertial.kind must be one of"),
        ({"speed_m_s": -1.0}, "speed_m_s must be a finite number"),
        ({"gravity_tilt_rad": 3.0}, "gravity_tilt_rad must be a finite number"),
        ({"headings": 0}, "headings must be a positive int, got 0"),
        ({"drift_std_m": 0.1, "drift_time_s": 0.0}, "time_s must be a finite number"),
    ],
)
def test_what_is_no_filter(options, message):
    with pytest.raises(ValueError, match=message):
        made(**options)


@pytest.mark.parametrize("headings", [1, 3])
@pytest.mark.parametrize(
    ("readings", "dt", "message"),
    [
        (np.zeros(6), 0.1, r"readings must have shape \(..., S, 6\), got \(6,\)"),
        (np.full((2, 6), np.nan), 0.1, "readings must be finite"),
        (np.zeros((2, 6)), -0.1, "dt must be a finite number"),
        (np.zeros((2, 6)), [0.1, -0.1], "dt must not be negative"),
        (np.zeros((2, 6)), "soon", "dt must be a number, got 'soon'"),
    ],
)
def test_what_cannot_be_predicted(headings, readings, dt, message):
    filter = made(headings=headings)
    state = filter.initial(np.eye(3), np.zeros(3), PRIOR)
    with pytest.raises(ValueError, match=message):
        filter.predict(state, readings, dt)


# --- headings --------------------------------------------------------------------------------


def bank_run(rng, headings, batch=()):
    """A body that circles, of unknown heading; what the bank believes at the end, and the truth."""
    filter = made(headings=headings, speed_m_s=1.0, bias_std_m=0.05)
    scene = scenes.get({"name": "uwb_room", "inertial": SENSOR, "steps": 20})
    episode: Any = simulation.draw_episode(scene, rng, batch)
    level, spread = navigation.attitude(
        np.concatenate(
            [np.zeros((*batch, 1, 3)), inertial.specific_force(episode.rotation[..., 0, :, :],
             np.zeros(3))[..., None, :]], axis=-1), SENSOR
    )  # fmt: skip
    covariance = np.zeros((*batch, 6, 6))
    covariance[..., :3, :3], covariance[..., 3:, 3:] = spread, 0.3**2 * np.eye(3)
    state = filter.initial(level, episode.translation[..., 0, :], covariance)
    for k in range(21):
        at = simulation.epoch_of(episode, k)
        assert isinstance(at, simulation.Epoch)
        if k:
            state = filter.predict(state, at.readings, scene.dt)
        measured = simulation.measure_epoch(scene, at, episode.anchors)
        state = filter.update(state, measured.ranges, episode.anchors, measured.links)
    return filter, state, episode


def test_the_heading_is_found_among_several():
    rng = np.random.default_rng(3)
    for _ in range(3):
        filter, state, episode = bank_run(rng, 6)
        assert isinstance(filter, HeadingBank)
        assert filter.reads == "inertial"
        belief = filter.belief(state)
        error = rotations.error(belief.rotation, episode.rotation[-1])
        assert np.linalg.norm(error) < math.radians(10)
        # What has lost or is the same is gone.
        assert len(state.log_weights) < 3
        leader = filter.leader(state)
        np.testing.assert_allclose(leader.rotation, belief.rotation, atol=0.01)


def test_a_batch_of_banks_keeps_its_shape():
    filter, state, episode = bank_run(np.random.default_rng(4), 6, (5,))
    assert state.log_weights.shape == (5, 6)
    np.testing.assert_allclose(np.exp(state.log_weights).sum(axis=-1), 1)
    belief = filter.belief(state)
    error = rotations.error(belief.rotation, episode.rotation[:, -1])
    assert (np.linalg.norm(error, axis=-1) < math.radians(10)).all()


# --- simulation ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["drone_yard", "uwb_room"])
def test_it_reaches_its_bound_and_is_honest_in_all_fifteen_states(name):
    scene = scenes.get({"name": name, "inertial": "consumer", "steps": 25})
    trials = monte_carlo.simulate_trials(scene, 200, np.random.default_rng(5))
    episode: Any = trials.episode
    filter = monte_carlo.scene_filter(scene, "iekf-imu", {})
    square, nees = np.zeros(2), []
    for k, step in enumerate(monte_carlo.trial_steps(trials, filter)):
        pose = metrics.pose_error(
            step.belief.rotation, step.belief.translation, episode.rotation[:, k],
            episode.translation[:, k],
        )  # fmt: skip
        rest = step.state.extra - np.concatenate(
            [episode.velocity[:, k], episode.bias[:, k]], axis=-1
        )
        nees.append(metrics.nees(np.concatenate([pose, rest], axis=-1), step.state.covariance) / 15)
        square += (pose**2).mean(axis=0).reshape(2, 3).sum(axis=-1)
    bound = np.diagonal(trials.bound, axis1=-2, axis2=-1).mean(axis=(0, 1)).reshape(2, 3).sum(-1)
    # Errors of an epoch go with those of the next: about 5 independent ones in 26. Root mean
    # squares of 3 axes are then known to 1 %, NEES of 15 states to 1.2 %; 4 sigma.
    np.testing.assert_allclose(np.sqrt(square / 26 / bound), 1, atol=0.05)
    assert np.mean(nees) == pytest.approx(1, abs=0.05)


def test_the_bound_by_hand():
    """J' = (F J^-1 F^T + Q)^-1 + H^T R^-1 H, with F and Q from a preintegration."""
    rng = np.random.default_rng(6)
    start = inertial_bounds.prior_information(PRIOR, SENSOR, 2.0)
    np.testing.assert_allclose(np.diagonal(np.linalg.inv(start))[6:9], 4.0)
    readings = rng.standard_normal((5, 6))
    moved = navigation.preintegrate(readings, 0.02, np.zeros(6), SENSOR)
    before, t = rotations.random(rng), np.array([0.5, 0.2, 1.0])
    F, W = np.eye(15), np.kron(np.eye(3), before)
    F[3:6, :3], F[6:9, :3] = (
        -skew(before @ moved.translation), -skew(before @ moved.velocity)
    )  # fmt: skip
    F[3:6, 6:9] = 0.1 * np.eye(3)
    F[:9, 9:] = W @ moved.jacobian
    Q = np.zeros((15, 15))
    Q[:9, :9] = W @ moved.covariance @ W.T
    Q[9:, 9:] = 0.1 * np.diag(np.repeat([SENSOR.gyro_walk, SENSOR.accel_walk], 3)) ** 2
    expected = np.linalg.inv(F @ np.linalg.inv(start) @ F.T + Q)
    after = before @ moved.rotation
    expected[:6, :6] += bounds.range_information(ANCHORS, TAGS, after, t, NOISE)
    epoch = bounds.RangeEpoch(ANCHORS, TAGS, after, t, NOISE)
    sensed = bounds.InertialMotion(readings, 0.02, SENSOR)
    found = bounds.posterior_step(start, epoch, sensed)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    with pytest.raises(
        ValueError, match=r"J must have shape \(..., 15, 15\) or \(..., 17, 17\), got"
    ):
        bounds.posterior_step(np.eye(6), epoch, sensed)


def test_the_tilt_of_gravity_costs_information():
    start = inertial_bounds.prior_information(PRIOR, SENSOR, 2.0, 0.02)
    assert start.shape == (17, 17)
    readings = np.tile([0.1, 0, 0, 0, 0, G], (10, 1))
    epoch = bounds.RangeEpoch(ANCHORS, TAGS, np.eye(3), np.zeros(3), NOISE)
    sensed = bounds.InertialMotion(readings, 0.01, SENSOR)
    for _ in range(5):
        start = bounds.posterior_step(start, epoch, sensed)
    plain = inertial_bounds.prior_information(PRIOR, SENSOR, 2.0)
    for _ in range(5):
        plain = bounds.posterior_step(plain, epoch, sensed)
    wide, narrow = (np.diagonal(np.linalg.inv(J))[:6] for J in (start, plain))
    assert (wide >= narrow - 1e-12).all()
    assert wide[3:].sum() > 1.001 * narrow[3:].sum()


@with_kernels
def test_biases_converge_within_their_covariance():
    scene = scenes.get({"name": "uwb_room", "inertial": "consumer", "steps": 60})
    trials: Any = monte_carlo.simulate_trials(scene, 100, np.random.default_rng(7))
    filter = monte_carlo.scene_filter(scene, "iekf-imu", {})
    *_, last = monte_carlo.trial_steps(trials, filter)
    error = last.state.extra[:, 3:9] - trials.episode.bias[:, -1]
    P = last.state.covariance[:, 9:15, 9:15]
    # 600 values of mean 1: standard deviation sqrt(2 / 600), 5 sigma.
    assert metrics.nees(error, P).mean() / 6 == pytest.approx(1, abs=0.29)
    prior = np.sqrt((inertial.SENSORS["consumer"].prior_std ** 2).reshape(2, 3).sum(axis=-1))
    found = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1).mean(axis=0).reshape(2, 3).sum(axis=-1))
    assert (found < [0.25 * prior[0], 0.6 * prior[1]]).all()
    assert scene_bounds.information_size(scene) == 15
