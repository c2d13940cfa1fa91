"""The filter for logs: late ranges, soft knowledge of height and tilt, consistency."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from rbl_gym import estimators, metrics, motion
from rbl_gym.estimators import hold_level
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.estimators.named import iekf_log
from rbl_gym.estimators.smoothing import Level
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.motion.unknown_twist import WanderingTwist, simulate_wandering
from tests.helpers import draw_biases, with_kernels

TAGS = bodies.octahedron(0.8)[:4]
ANCHORS = np.array([[0.0, 0, 0], [10, 0, 3], [10, 8, 0], [0, 8, 3], [5, 0, 3], [5, 8, 0.5]])
NOISE = ranging.RangeNoise(0.1)
STILL = motion.ProcessNoise(0.0, 0.0)
LAW = WanderingTwist(0.3, 0.5, 0.5, 1.0)


def tails(rng, shape, share):
    """Late ranges: reflected paths of 0.75 m on average."""
    return (rng.random(shape) < share) * rng.exponential(0.75, shape)


@functools.cache
def tracked(robust, late, trials=100, steps=25, dt=0.1, seed=0):
    """NEES per degree of freedom and position RMSE (m) of bodies that follow the filter's law."""
    rng = np.random.default_rng(seed)
    Q, t = rotations.random(rng, (trials,)), rng.uniform([3, 2, 1], [7, 6, 2], (trials, 3))
    path = simulate_wandering(Q, t, LAW, STILL, dt, steps, rng)
    shape = (trials, len(ANCHORS), len(TAGS))
    times, links = dt * np.arange(steps + 1), shape[1] * shape[2]
    laws = LinkBias(0.05, None, 0.1), LinkBias(0.05, 3.0)
    biases = np.sum([draw_biases(law, times, links, rng, (trials,)) for law in laws], axis=0)
    filter: Any = estimators.make(
        "iekf-log", tags=TAGS, noise=NOISE, process=STILL, robust=robust,
        turn_rate_rad_s=0.3, speed_m_s=0.5,
    )  # fmt: skip
    P = np.diag([0.03] * 3 + [0.1] * 3)
    off = np.sqrt(np.diag(P)) * rng.standard_normal((trials, 6))
    state = filter.initial(rotations.exp(off[:, :3]) @ Q, t + off[:, 3:], P)
    nees, squares = [], []
    for k in range(steps + 1):
        if k:
            state = filter.predict(state, None, dt)
        pose = path.rotation[:, k], path.translation[:, k]
        exact = ranging.distances(ANCHORS, ranging.tag_positions(*pose, TAGS))
        noise = 0.1 * rng.standard_normal(shape) + tails(rng, shape, late)
        state = filter.update(state, exact + biases[:, k].reshape(shape) + noise, ANCHORS)
        belief = filter.belief(state)
        error = metrics.pose_error(belief.rotation, belief.translation, *pose)
        nees.append(metrics.nees(error, belief.covariance).mean() / 6)
        squares.append((error[:, 3:] ** 2).sum(axis=-1).mean())
    return np.mean(nees), np.sqrt(np.mean(squares))


def test_the_filter_for_logs_is_consistent_with_its_own_law():
    """100 bodies of 6 degrees: one epoch's mean has a standard deviation of 0.06."""
    assert tracked(False, 0.0)[0] == pytest.approx(1.0, abs=0.15)


@with_kernels
def test_late_ranges_cost_the_redescending_loss_least_and_its_belief_stays_honest():
    """Two ranges in five late; measured: 0.51, 0.20 and 0.18 m, NEES 47, 2.5 and 1.4."""
    found = {robust: tracked(robust, 0.4) for robust in (False, True, "late")}
    assert found["late"][1] < 0.95 * found[True][1] < 0.6 * found[False][1]
    assert 0.7 < found["late"][0] < 1.7 < found[True][0]
    # Without late ranges it gives away a quarter, and says so.
    nees, rmse = tracked("late", 0.0)
    assert nees == pytest.approx(1.1, abs=0.2)
    assert rmse < 1.4 * tracked(False, 0.0)[1]


@pytest.mark.parametrize("robust", [True, "late"])
def test_the_pose_filter_is_honest_on_late_ranges(robust):
    rng = np.random.default_rng(1)
    trials, P = 300, np.diag([0.03] * 3 + [0.1] * 3)
    Q, t = rotations.random(rng, (trials,)), rng.uniform([3, 2, 1], [7, 6, 2], (trials, 3))
    exact = ranging.distances(ANCHORS, ranging.tag_positions(Q, t, TAGS))
    ranges = exact + 0.1 * rng.standard_normal(exact.shape) + tails(rng, exact.shape, 0.2)
    off = np.sqrt(np.diag(P)) * rng.standard_normal((trials, 6))
    filter = estimators.make("iekf", tags=TAGS, noise=NOISE, process=STILL, robust=robust)
    state = filter.initial(rotations.exp(off[:, :3]) @ Q, t + off[:, 3:], P)
    belief = filter.belief(filter.update(state, ranges, ANCHORS))
    error = metrics.pose_error(belief.rotation, belief.translation, Q, t)
    nees = metrics.nees(error, belief.covariance).mean() / 6
    if robust == "late":
        assert 0.5 < nees < 1.5
        found = estimators.locate(ranges, ANCHORS, TAGS, NOISE, "robust-late")
        plain = estimators.locate(ranges, ANCHORS, TAGS, NOISE, "robust")
        rms = [np.sqrt(((f.translation - t) ** 2).sum(axis=-1).mean()) for f in (found, plain)]
        assert rms[0] < 0.95 * rms[1]
    else:
        # Overconfident beside the loss for late ranges.
        assert nees > 1.2


def test_one_tag_tells_a_place_and_leaves_the_rotation_wide():
    rng = np.random.default_rng(3)
    filter = iekf_log(np.zeros((1, 3)), NOISE, STILL)
    state = filter.initial(np.eye(3), [4.0, 3, 1], np.diag([9.0] * 3 + [1.0] * 3))
    for _ in range(30):
        state = filter.predict(state, None, 0.1)  # pyrefly: ignore[bad-argument-type]
        ranges = ranging.distances(ANCHORS, np.array([[5.0, 4, 1.5]]))
        ranges = ranges + 0.1 * rng.standard_normal(ranges.shape)
        state = filter.update(state, ranges, ANCHORS)
    belief = filter.belief(state)
    assert np.linalg.norm(belief.translation - [5, 4, 1.5]) < 0.2
    assert np.linalg.eigvalsh(belief.covariance[:3, :3]).min() >= 9.0


# --- soft knowledge of height and tilt ----------------------------------------------------------

LEVEL = Level(height_m=1.0, height_std_m=0.2, tilt_std_rad=0.05)


def known(P):
    return np.sqrt(P[..., [5, 0, 1], [5, 0, 1]])


def test_a_stationary_body_keeps_its_deviations_and_forgets_where_it_was():
    S = np.array([0.2, 0.05, 0.05])
    start = np.diag([0.05**2, 0.05**2, 0.01, 0.1, 0.1, 0.2**2])
    for walk in (0.01, 0.1, 10.0):
        state = PoseState(np.eye(3), np.array([0.0, 0, 1.3]), start)
        for _ in range(3):
            P = state.covariance + walk**2 * np.eye(6)
            state = hold_level(state, state._replace(covariance=P), LEVEL)
            np.testing.assert_allclose(known(state.covariance), S, rtol=1e-9)
        # Knowledge of x and y, and of the heading, is untouched.
        rest = [2, 3, 4]
        np.testing.assert_allclose(
            state.covariance[rest, rest], start[rest, rest] + 3 * walk**2, rtol=1e-9
        )
    assert state.translation[2] == pytest.approx(1.0, abs=1e-3)
    # Without a prediction nothing is learned, however often it is called.
    same = hold_level(state, state, LEVEL)
    for a, b in zip(same, state, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-15)


def test_level_is_the_kalman_update_of_its_observation():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(4, 12, 8)) * 0.1
    P = np.swapaxes(A, -1, -2) @ A + 1e-4 * np.eye(8)
    Q = rotations.exp(0.2 * rng.standard_normal((4, 3)))
    t, extra = rng.normal(size=(4, 3)), rng.normal(size=(4, 2))
    before = estimators.AugmentedState(Q, t, extra, 0.5 * P)
    state = before._replace(covariance=P)
    got = hold_level(before, state, Level(height_m=1.0, height_std_m=0.2))
    h = np.eye(8)[5]
    for k in range(4):
        added = 0.5 * P[k, 5, 5]
        R = 0.2**2 * (1 + 0.2**2 / added)
        gain = P[k] @ h / (h @ P[k] @ h + R)
        np.testing.assert_allclose(got.extra[k], extra[k] + gain[6:] * (1 - t[k, 2]))
        want = (np.eye(8) - np.outer(gain, h)) @ P[k]
        np.testing.assert_allclose(got.covariance[k], want, atol=1e-12)
    # The derivative of the upright axis, by differences.
    tilted = hold_level(before, state, Level(tilt_std_rad=1e-4))
    upright = [np.linalg.norm(s.rotation[:, :2, 2], axis=-1) for s in (tilted, state)]
    assert (upright[0] < 0.1 * upright[1]).all()


def test_soft_knowledge_is_honest_and_worth_having():
    """Anchors and tags in planes: 200 bodies whose height and tilt are drawn from what is known."""
    rng = np.random.default_rng(2)
    trials = 200
    anchors, tags = ANCHORS.copy(), np.array([[0.3, 0, 0], [-0.2, 0.3, 0], [-0.2, -0.3, 0]])
    anchors[:, 2] = 0.0
    process, level = motion.ProcessNoise((0.02, 0.02, 0.1), 0.1), LEVEL
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=process)
    heading = rng.uniform(-3, 3, trials)
    z, tilt = 1 + 0.2 * rng.standard_normal(trials), 0.05 * rng.standard_normal((trials, 2))
    turn = np.stack([np.zeros(trials), np.zeros(trials), heading], axis=-1)
    lean = np.concatenate([tilt, np.zeros((trials, 1))], axis=-1)
    Q = rotations.exp(lean) @ rotations.exp(turn)
    t = np.stack([*rng.uniform(3, 6, (2, trials)), z], axis=-1)
    P = np.diag([0.05**2, 0.05**2, 0.02, 0.1, 0.1, 0.2**2])
    off = np.sqrt(np.diag(P)) * rng.standard_normal((trials, 6)) * [0, 0, 1, 1, 1, 0]
    start = rotations.exp(off[:, :3]) @ rotations.exp(turn)
    states = [filter.initial(start, np.stack([*(t + off[:, 3:]).T[:2], 0 * z + 1], -1), P)] * 2
    for k in range(15):
        exact = ranging.distances(anchors, ranging.tag_positions(Q, t, tags))
        ranges = exact + 0.1 * rng.standard_normal(exact.shape)
        for i, state in enumerate(states):
            if k:
                moved = filter.predict(state, np.zeros(6), 1.0)
                state = hold_level(state, moved, level) if i == 0 else moved
            states[i] = filter.update(state, ranges, anchors)
    held, free = (filter.belief(s) for s in states)
    error = metrics.pose_error(held.rotation, held.translation, Q, t)
    # Bodies that stand still are held by a filter that lets them walk.
    assert 0.3 < metrics.nees(error, held.covariance).mean() / 6 < 1.3
    assert (known(held.covariance) <= np.array([0.2, 0.05, 0.05]) + 1e-9).all()
    assert known(free.covariance)[:, 1:].mean() > 1.2 * known(held.covariance)[:, 1:].mean()


def test_level_is_of_iterated_filters():
    filter = estimators.make("kf", tags=TAGS, noise=NOISE, process=STILL)
    state = filter.initial(np.eye(3), np.zeros(3), np.eye(6))
    with pytest.raises(ValueError, match="level needs the state of an iterated EKF"):
        hold_level(state, state, LEVEL)
