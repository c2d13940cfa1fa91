"""The law of an unknown twist, trajectories drawn from it, and its posterior bound."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bounds, motion
from rbl_gym.bounds import twist as bound
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.motion import unknown_twist as ut
from tests.helpers import random_world

LAW = ut.WanderingTwist((0.3, 0.2, 0.1), 2.0, (0.4, 0.5, 0.6), (0.7, 0.8, 0.9))
PROCESS = motion.ProcessNoise((0.05, 0.1, 0.15), (0.2, 0.3, 0.4))
NOISE = ranging.RangeNoise(0.05, 0.001)
EPOCH = bounds.RangeEpoch(np.eye(3), np.eye(3), np.eye(3), np.ones(3), NOISE)


def moved(Q, t, twist, dt, pose_noise, twist_noise):
    """The model's step, as its docstring has it."""
    turned = rotations.exp(twist[:3] * dt + pose_noise[:3]) @ Q
    return turned, t + twist[3:] * dt + pose_noise[3:], twist + twist_noise


def difference(a, b):
    """Error (12,) of states a against b."""
    return np.concatenate([rotations.error(a[0], b[0]), a[1] - b[1], a[2] - b[2]])


def numeric_step(Q, t, twist, dt):
    """F (12, 12) and the noise's map G (12, 12) by central differences of the model."""
    step, zero = 1e-6, np.zeros(12)

    def end(error, noise):
        start = rotations.exp(error[:3]) @ Q, t + error[3:6], twist + error[6:]
        return moved(*start, dt, noise[:6], noise[6:])

    def columns(of):
        return np.stack(
            [difference(of(step * d), of(-step * d)) / (2 * step) for d in np.eye(12)], axis=1
        )

    return columns(lambda d: end(d, zero)), columns(lambda d: end(zero, d))


def noise_covariance(dt, process, law):
    q = law.std() ** 2
    pose = np.diag(dt**3 / 3 * q + dt * process.std() ** 2)
    return np.block([[pose, np.diag(dt**2 / 2 * q)], [np.diag(dt**2 / 2 * q), np.diag(dt * q)]])


def numeric_prediction(P, Q, t, twist, dt):
    F, G = numeric_step(Q, t, twist, dt)
    return F @ P @ F.T + G @ noise_covariance(dt, PROCESS, LAW) @ G.T


def test_prediction_of_the_covariance_by_finite_differences_of_the_model():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(3, 15, 15))
    P = A @ np.swapaxes(A, -1, -2)
    twists, dt = rng.normal(size=(3, 6)), 0.4
    got = bound.predict_covariance(P, twists, dt, PROCESS, LAW)
    for k in range(3):
        pose = rotations.random(rng), rng.normal(size=3)
        want = numeric_prediction(P[k, :12, :12], *pose, twists[k], dt)
        np.testing.assert_allclose(got[k, :12, :12], want, rtol=1e-6, atol=1e-6)
        # Three states that stand still keep their own covariance, and turn along with the pose.
        F, _ = numeric_step(*pose, twists[k], dt)
        np.testing.assert_allclose(got[k, :12, 12:], F @ P[k, :12, 12:], rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(got[k, 12:, 12:], P[k, 12:, 12:])
        alone = bound.predict_covariance(P[k], twists[k], dt, PROCESS, LAW)
        np.testing.assert_allclose(alone, got[k], rtol=1e-12, atol=1e-12)


def test_a_known_twist_is_that_of_the_plain_bound():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(6, 6))
    twist = rng.normal(size=6)
    got = bound.predict_covariance(A @ A.T, twist, 0.3, PROCESS, None)
    want = bounds.predict_covariance(A @ A.T, twist, 0.3, PROCESS)
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)


def test_bound_by_brute_force_is_the_last_block_of_the_whole_trajectorys_information():
    """All epochs' 12 states as one linear problem; its dense inverse against the recursion."""
    rng = np.random.default_rng(3)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    steps, dt = 4, 0.3
    path = ut.simulate_wandering(rotation, translation, LAW, PROCESS, dt, steps, rng)
    links = rng.random((steps + 1, 5, 4)) > 0.2
    prior = np.diag([0.1, 0.2, 0.1, 1.0, 0.5, 2.0, *LAW.prior_std() ** 2])
    whole = np.zeros((12 * (steps + 1),) * 2)
    whole[:12, :12] = np.linalg.inv(prior)
    J = np.linalg.inv(prior)
    for k in range(steps + 1):
        at = path.rotation[k], path.translation[k]
        rest = anchors, tags, *at, NOISE
        own = slice(12 * k, 12 * k + 12)
        if k:
            before = path.rotation[k - 1], path.translation[k - 1], path.twists[k - 1]
            F, G = numeric_step(*before, dt)
            both = slice(12 * k - 12, 12 * k + 12)
            rows = np.hstack([-F, np.eye(12)])
            information = np.linalg.inv(G @ noise_covariance(dt, PROCESS, LAW) @ G.T)
            whole[both, both] += rows.T @ information @ rows
            moved = bounds.UnknownTwist(before[2], dt, PROCESS, LAW)
            J = bounds.posterior_step(J, bounds.RangeEpoch(*rest, links[k]), moved)
        else:
            J = J.copy()
            J[:6, :6] += bounds.range_information(*rest, links[k])
        seen = bounds.range_information(*rest, links[k])
        whole[own, own][:6, :6] += seen
        want = np.linalg.inv(whole[: own.stop, : own.stop])[own, own]
        scale = np.sqrt(np.diag(want))
        np.testing.assert_allclose(
            np.linalg.inv(J) / scale / scale[:, None], want / scale / scale[:, None], atol=1e-6
        )


def test_the_bound_of_a_batch_is_that_of_each():
    rng = np.random.default_rng(4)
    anchors, tags, rotation, translation = random_world(rng, 5, 4, (3,))
    twists = rng.normal(size=(3, 6))
    sensor = ut.TwistSensor(0.1, 0.3, "body")
    J = np.eye(12) * rng.uniform(1, 5, (3, 1, 1))
    epoch = bounds.RangeEpoch(anchors, tags, rotation, translation, NOISE)
    moved = bounds.UnknownTwist(twists, 0.2, PROCESS, LAW, sensor)
    got = bounds.posterior_step(J, epoch, moved)
    for k in range(3):
        one = bounds.RangeEpoch(anchors[k], tags, rotation[k], translation[k], NOISE)
        want = bounds.posterior_step(J[k], one, moved._replace(twist=twists[k]))
        np.testing.assert_allclose(got[k], want, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("frame", ut.FRAMES)
def test_what_a_sensor_tells_by_finite_differences_of_its_reading(frame):
    rng = np.random.default_rng(5)
    sensor = ut.TwistSensor(0.1, 0.4, frame)
    Q, twist = rotations.random(rng), rng.normal(size=6)
    step = 1e-6
    H = []
    for d in step * np.eye(12):
        ends = (
            sensor.read(rotations.exp(sign * d[:3]) @ Q, twist + sign * d[6:]) for sign in (1, -1)
        )
        H.append((next(ends) - next(ends)) / (2 * step))
    H = np.transpose(H)
    want = H.T @ np.diag([0.1**-2] * 3 + [0.4**-2] * 3) @ H
    np.testing.assert_allclose(sensor.information(twist), want, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(sensor.in_world(Q, sensor.read(Q, twist)), twist, atol=1e-12)
    gyro = ut.TwistSensor(gyro_std_rad_s=0.1, frame=frame).information(twist)
    np.testing.assert_allclose(gyro, H[:3].T @ H[:3] / 0.1**2, rtol=1e-6, atol=1e-6)


def test_drawn_trajectories_have_the_laws_moments():
    rng = np.random.default_rng(6)
    trials, dt = 20_000, 0.5
    at = np.broadcast_to(np.eye(3), (trials, 3, 3))
    law = ut.WanderingTwist(0.02, 2.0, 0.05, 0.7)
    still = motion.ProcessNoise(0.01, 0.1)
    path = ut.simulate_wandering(at, np.zeros(3), law, still, dt, 2, rng)
    twists = path.twists
    turn = rotations.error(path.rotation[:, 2], path.rotation[:, 1])
    moves = np.concatenate([turn, path.translation[:, 2] - path.translation[:, 1]], axis=-1)
    noise = np.concatenate([moves - dt * twists[:, 1], twists[:, 2] - twists[:, 1]], axis=-1)
    want = noise_covariance(dt, still, law)
    scale = np.sqrt(np.diag(want))
    got = noise.T @ noise / trials / scale / scale[:, None]
    # Entries of a sample covariance in units of its standard deviations: at most sqrt(2 / trials).
    np.testing.assert_allclose(got, want / scale / scale[:, None], atol=6 * np.sqrt(2 / trials))
    spread = twists[:, 0].std(axis=0) / law.prior_std()
    np.testing.assert_allclose(spread, 1.0, atol=5 / np.sqrt(2 * trials))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ut.WanderingTwist(turn_rate_rad_s=-1), "turn_rate_rad_s must not be negative"),
        (
            lambda: ut.WanderingTwist(speed_m_s=(1, 2)),  # pyrefly: ignore[bad-argument-type]
            "speed_m_s must be one number or three",
        ),
        (lambda: ut.WanderingTwist(acceleration=np.nan), "acceleration must be finite"),
        (lambda: ut.TwistSensor(gyro_std_rad_s=0), "gyro_std_rad_s must be a finite number"),
        (lambda: ut.TwistSensor(frame="moon"), "frame must be one of"),
        (
            lambda: ut.simulate_wandering(
                np.eye(3), np.zeros(3), LAW, PROCESS, 0.1, 0, np.random.default_rng(0)
            ),
            "steps must be a positive int",
        ),
        (
            lambda: ut.simulate_wandering(
                np.eye(3), np.zeros(3), PROCESS, PROCESS, 0.1, 1, np.random.default_rng(0)  # pyrefly: ignore[bad-argument-type]
            ),
            "law must be a WanderingTwist, got ProcessNoise",
        ),
        (
            lambda: ut.simulate_wandering(np.eye(3), np.zeros(3), LAW, PROCESS, 0.1, 1, 0),  # pyrefly: ignore[bad-argument-type]
            "rng must be a numpy.random.Generator, .* got 0",
        ),
        (
            lambda: bounds.posterior_step(
                np.eye(12), EPOCH, bounds.UnknownTwist(np.zeros(6), 0.1, LAW, LAW)  # pyrefly: ignore[bad-argument-type]
            ),
            "process must be a motion.ProcessNoise, got WanderingTwist",
        ),
        (
            lambda: bounds.posterior_step(
                np.zeros((12, 12)), EPOCH, bounds.UnknownTwist(np.zeros(6), 0.1, PROCESS, LAW)
            ),
            "J must be positive definite",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
