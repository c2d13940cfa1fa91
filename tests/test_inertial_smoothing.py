"""The smoother of a body with an inertial sensor."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import metrics
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.estimators.smoothing.equations import LogState
from rbl_gym.estimators.smoothing.inertial import InertialMotion
from rbl_gym.estimators.smoothing.smoother import LogModel, RangeLog, smooth
from rbl_gym.geometry import rotations
from rbl_gym.measurements import inertial
from rbl_gym.studies import monte_carlo
from rbl_gym.worlds import scenes

SENSOR = inertial.InertialSensor(gyro_noise=0.01, accel_noise=0.1, accel_walk=0.05, gyro_walk=0.01)


def moved(state, change, tilt):
    """The state with errors (K, 15) put on it, and the tilt with its own (2,)."""
    return (
        LogState(
            rotations.exp(change[:, :3]) @ state.rotation, state.translation + change[:, 3:6],
            state.extra + change[:, 6:15], state.constants,
        ),
        state.constants + tilt,
    )  # fmt: skip


def test_the_factor_against_finite_differences():
    rng = np.random.default_rng(0)
    readings = rng.standard_normal((2, 4, 6)) + [0, 0, 0, 0, 0, 9]
    factor = InertialMotion(
        readings, rng.uniform(0.01, 0.03, (2, 4)), SENSOR, gravity_tilt_rad=0.02
    )
    state = LogState(
        rotations.exp(0.3 * rng.standard_normal((3, 3))), rng.standard_normal((3, 3)),
        0.1 * rng.standard_normal((3, 9)), np.array([0.05, -0.02]),
    )  # fmt: skip
    rows = factor.linearize(state, np.arange(3.0), state.constants)
    assert rows.after is not None
    assert rows.constants is not None
    e = 1e-6

    def slope(change, tilt):
        ends = [moved(state, s * e * change, s * e * tilt) for s in (1, -1)]
        found = [factor.linearize(one, np.arange(3.0), own).residual for one, own in ends]
        return (found[0] - found[1]) / (2 * e)

    scale = np.abs(rows.before).max()
    for i in range(15):
        for k in range(3):
            change = np.zeros((3, 15))
            change[k, i] = 1.0
            got = slope(change, np.zeros(2))
            for j in range(2):
                expected = rows.before[j, :, i] * (k == j) + rows.after[j, :, i] * (k == j + 1)
                np.testing.assert_allclose(got[j] / scale, expected / scale, atol=1e-6)
    for i in range(2):
        got = slope(np.zeros((3, 15)), np.eye(2)[i])
        np.testing.assert_allclose(got / scale, rows.constants[..., i] / scale, atol=1e-6)


@pytest.fixture(scope="module")
def run():
    """Bodies with a sensor; the filter's states at all epochs; what the smoother finds."""
    scene = scenes.get({"name": "uwb_room", "inertial": "consumer", "steps": 8})
    trials = monte_carlo.simulate_trials(scene, 40, np.random.default_rng(1))
    episode: Any = trials.episode
    steps = list(monte_carlo.trial_steps(trials, monte_carlo.scene_filter(scene, "iekf-imu", {})))
    assert scene.inertial is not None
    motion = InertialMotion(
        episode.readings[:, 1:], scene.dt / 10, scene.inertial, scene.speed_std_m_s
    )
    log = RangeLog(
        scene.dt * np.arange(9), np.stack([m.ranges for m in trials.measurements], axis=1),
        episode.anchors[:, None],
    )  # fmt: skip
    prior = PoseState(episode.prior_rotation, episode.prior_translation, episode.prior_covariance)
    start = (
        np.stack([s.belief.rotation for s in steps], axis=1),
        np.stack([s.belief.translation for s in steps], axis=1),
    )
    found = smooth(log, LogModel(scene.body, scene.noise, motion), prior, start)
    return episode, steps, found


def test_at_the_last_epoch_it_is_the_filter(run):
    """To second order: the filter has linearized the past once, the smoother again."""
    _, steps, found = run
    assert found.converged.all()
    std = np.sqrt(np.diagonal(found.covariance[:, -1], axis1=-2, axis2=-1))
    error = metrics.pose_error(
        found.rotation[:, -1], found.translation[:, -1], steps[-1].belief.rotation,
        steps[-1].belief.translation,
    )  # fmt: skip
    assert np.sqrt(np.mean((error / std) ** 2)) < 0.2
    filtered = np.sqrt(np.diagonal(steps[-1].belief.covariance, axis1=-2, axis2=-1))
    np.testing.assert_allclose(std / filtered, 1, atol=0.1)


def test_it_is_honest_and_better_than_the_filter_before(run):
    episode, steps, found = run
    error = metrics.pose_error(
        found.rotation, found.translation, episode.rotation, episode.translation
    )
    truth = np.concatenate([episode.velocity, episode.bias], axis=-1)
    nees = metrics.nees(error, found.covariance).mean() / 6
    rest = metrics.nees(found.extra - truth, found.extra_covariance).mean() / 9
    # 40 bodies; the epochs of one are close to one draw: sqrt(2 / 240) and sqrt(2 / 360), 4 sigma.
    assert nees == pytest.approx(1, abs=0.36)
    assert rest == pytest.approx(1, abs=0.3)
    filtered = metrics.pose_error(
        steps[2].belief.rotation, steps[2].belief.translation, episode.rotation[:, 2],
        episode.translation[:, 2],
    )  # fmt: skip
    assert (np.square(error[:, 2]).mean(axis=0) < 0.9 * np.square(filtered).mean(axis=0)).all()


def test_what_is_no_factor():
    with pytest.raises(ValueError, match="sensor must be an InertialSensor, got 'best'"):
        InertialMotion(np.zeros((1, 2, 6)), 0.1, "best")  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ValueError, match="steps must be one number, or one for each of 2 samples"):
        InertialMotion(np.zeros((1, 2, 6)), np.zeros((1, 3)), SENSOR)
