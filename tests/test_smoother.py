"""The smoother: against dense least squares, Rauch, Tung and Striebel, and its bound."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy import integrate, optimize, stats

from rbl_gym import estimators, metrics, ranging
from rbl_gym.estimators.costs.losses import LATE, SQUARES, expected_square, huber, loss_of
from rbl_gym.estimators.smoothing import (
    Factor,
    KnownTwist,
    Level,
    LogModel,
    LogState,
    Motion,
    RangeLog,
    Rows,
    Smoothed,
    UnknownTwist,
    causal_track,
    equations,
    ranges,
    smooth,
)
from rbl_gym.geometry import rotations
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import WanderingTwist, simulate_wandering
from rbl_gym.worlds.scenes import SCENES
from tests.helpers import over_bound, random_world, smoothed_trials

WANDER = WanderingTwist(0.4, 1.0, 0.3, 0.8)
PROCESS = ProcessNoise(0.05, 0.1)
NOISE = ranging.RangeNoise(0.05)
PRIOR_STD = np.array([0.2] * 3 + [0.4] * 3)
BIASES = (LinkBias(0.1, None, 0.2), LinkBias(0.05, 1.5))


def world(seed, K=5, m=5, n=4, noise_m=0.05) -> tuple[Any, Any, Any, Any]:
    """A log of a wandering body, and its truth."""
    rng = np.random.default_rng(seed)
    anchors, tags, rotation, translation = random_world(rng, m, n)
    path = simulate_wandering(rotation, translation, WANDER, PROCESS, 0.1, K - 1, rng)
    Q, t = path.rotation, path.translation
    measured = ranging.distances(anchors, ranging.tag_positions(Q, t, tags))
    measured = measured + noise_m * rng.standard_normal(measured.shape)
    log = RangeLog(0.1 * np.arange(K), measured, anchors, rng.random(measured.shape) < 0.8)
    offset = PRIOR_STD * rng.standard_normal(6)
    prior = rotations.exp(offset[:3]) @ Q[0], t[0] + offset[3:], np.diag(PRIOR_STD**2)
    return log, tags, prior, path


def dense_residuals(log, tags, prior, law, biases, level):
    """The whitened residuals of a log as a function of all unknowns, straight from the laws."""
    K, (m, n) = len(log.times), log.ranges.shape[-2:]
    links = m * n
    dt = np.diff(log.times)
    constant, drifting = biases

    def unpack(x):
        w, t, twist, drift = np.split(x[: K * (12 + links)].reshape(K, -1), [3, 6, 12], axis=1)
        return rotations.exp(w) @ prior[0], t, twist, drift, x[K * (12 + links) :]

    def residuals(x):
        Q, t, twist, drift, stay = unpack(x)
        first = np.concatenate([rotations.error(Q[0], prior[0]), t[0] - prior[1]])
        rows = [first / PRIOR_STD, twist[0] / law.prior_std(), drift[0] / drifting.std_m]
        rows += [stay[:links] / constant.std_m, stay[links:] / constant.common_std_m]
        for k in range(K - 1):
            turned = rotations.log(Q[k + 1] @ Q[k].T)
            moved = np.concatenate([turned, t[k + 1] - t[k]]) - dt[k] * twist[k]
            q, p = law.std() ** 2, PROCESS.std() ** 2
            S = np.block(
                [
                    [np.diag(dt[k] * p + dt[k] ** 3 / 3 * q), np.diag(dt[k] ** 2 / 2 * q)],
                    [np.diag(dt[k] ** 2 / 2 * q), np.diag(dt[k] * q)],
                ]
            )
            both = np.concatenate([moved, twist[k + 1] - twist[k]])
            rows.append(np.linalg.solve(np.linalg.cholesky(S), both))
            kept = np.exp(-dt[k] / drifting.time_s)
            rows.append((drift[k + 1] - kept * drift[k]) / (drifting.std_m * np.sqrt(1 - kept**2)))
        for k in range(K):
            places = tags @ Q[k].T + t[k]
            far = np.linalg.norm(places[None] - log.anchors[:, None], axis=-1).ravel()
            off = far + drift[k] + stay[:links] + stay[links] - log.ranges[k].ravel()
            rows.append(off[log.links[k].ravel()] / NOISE.floor_m)
            share = 1.0 if k == 0 else dt[k - 1] / level.time_s
            rows.append(np.sqrt(share) * (t[k, 2:] - level.height_m) / level.height_std_m)
            rows.append(np.sqrt(share) * Q[k, :2, 2] / level.tilt_std_rad)
        return np.concatenate(rows)

    return residuals, unpack


def test_as_dense_least_squares_of_all_unknowns():
    log, tags, prior, path = world(1, 3, 4, 3)
    level = Level(float(path.translation[0, 2]), 0.3, 1.0, 2.0)
    model = LogModel(tags, NOISE, UnknownTwist(WANDER, PROCESS), BIASES, (level,))
    found = smooth(log, model, prior, (path.rotation, path.translation))
    residuals, unpack = dense_residuals(log, tags, prior, WANDER, BIASES, level)
    K, links = 3, 12
    start = np.zeros((K, 12 + links))
    start[:, :3] = rotations.error(path.rotation, np.broadcast_to(prior[0], (K, 3, 3)))
    start[:, 3:6] = path.translation
    x0 = np.concatenate([start.ravel(), np.zeros(links + 1)])
    best = optimize.least_squares(residuals, x0, xtol=1e-12, ftol=1e-14, gtol=1e-10)
    Q, t, twist, drift, stay = unpack(best.x)
    assert isinstance(found, Smoothed)
    assert found.converged
    np.testing.assert_allclose(found.cost, best.cost, rtol=1e-6)
    np.testing.assert_allclose(found.rotation, Q, atol=1e-5)
    np.testing.assert_allclose(found.translation, t, atol=1e-5)
    np.testing.assert_allclose(found.extra, twist, atol=1e-4)
    np.testing.assert_allclose(found.constants, stay, atol=1e-5)
    total = (drift + stay[:links] + stay[links]).reshape(K, 4, 3)
    np.testing.assert_allclose(found.biases, total, atol=1e-5)
    # The covariance, in the chart of the dense problem: w there is log(Q Q_prior^T).
    P = np.linalg.inv(best.jac.T @ best.jac)
    for k in range(K):
        at = slice(k * (12 + links), k * (12 + links) + 12)
        D = np.eye(12)
        D[:3, :3] = rotations.left_jacobian(best.x[at][:3])
        expected = D @ P[at, at] @ D.T
        np.testing.assert_allclose(found.covariance[k], expected[:6, :6], rtol=1e-3, atol=1e-7)
        np.testing.assert_allclose(
            found.extra_covariance[k], expected[6:, 6:], rtol=1e-3, atol=1e-6
        )
    stays = P[-links - 1 :, -links - 1 :]
    np.testing.assert_allclose(found.constants_covariance, stays, rtol=1e-3, atol=1e-7)


@dataclasses.dataclass(frozen=True)
class Fix:
    """A position fix at every epoch: linear."""

    places: np.ndarray
    std: float
    constants_std = np.zeros(0)

    def linearize(self, state, times, constants):
        A = np.zeros((*state.translation.shape, 6))
        A[..., 3:] = np.eye(3) / self.std
        return Rows((state.translation - self.places) / self.std, A)


def test_as_the_recursion_of_rauch_tung_and_striebel():
    rng = np.random.default_rng(2)
    K, dt, walk, std = 30, 0.2, 0.5, 0.3
    truth = np.cumsum(walk * np.sqrt(dt) * rng.standard_normal((K, 3)), axis=0)
    fixes = truth + std * rng.standard_normal((K, 3))
    # Ranges so coarse that they tell nothing.
    log = RangeLog(dt * np.arange(K), np.ones((K, 1, 1)), [[50.0, 0, 0]])
    model = LogModel(
        np.zeros((1, 3)), ranging.RangeNoise(1e7), KnownTwist(ProcessNoise(0.1, walk)),
        factors=(Fix(fixes, std),),
    )  # fmt: skip
    start = np.tile(np.eye(3), (K, 1, 1)), np.zeros((K, 3))
    found = smooth(log, model, (np.eye(3), np.zeros(3), np.eye(6)), start)
    mean, variance, before = np.zeros((K, 3)), np.zeros(K), np.zeros(K)
    m, p = np.zeros(3), 1.0
    for k in range(K):
        before[k] = p = p + (walk**2 * dt if k else 0.0)
        gain = p / (p + std**2)
        m, p = m + gain * (fixes[k] - m), (1 - gain) * p
        mean[k], variance[k] = m, p
    for k in reversed(range(K - 1)):
        gain = variance[k] / before[k + 1]
        mean[k] += gain * (mean[k + 1] - mean[k])
        variance[k] += gain**2 * (variance[k + 1] - before[k + 1])
    np.testing.assert_allclose(found.translation, mean, atol=1e-8)
    np.testing.assert_allclose(
        found.covariance[:, 3:, 3:], variance[:, None, None] * np.eye(3), rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize(
    "factor",
    [
        KnownTwist(PROCESS, np.random.default_rng(5).normal(0, 2.0, (3, 6))),
        UnknownTwist(WANDER, PROCESS),
        Level(1.0, 0.3, 0.2),
    ],
)
def test_derivatives_of_factors_by_finite_differences(factor):
    rng = np.random.default_rng(3)
    times, K = np.array([0.0, 0.3, 0.35, 0.9]), 4
    state = LogState(
        rotations.exp(rng.normal(0, 0.5, (K, 3))), rng.normal(0, 1, (K, 3)),
        rng.normal(0, 1, (K, 6)), np.zeros(0),
    )  # fmt: skip
    rows = factor.linearize(state, times, np.zeros(0))
    n, h = rows.before.shape[-1], 1e-6
    for k in range(K):
        for i in range(n):
            ends = []
            for sign in (1, -1):
                x = np.zeros((K, 12))
                x[k, i] = sign * h
                moved = equations.moved(state, x, np.zeros(0))
                ends.append(factor.linearize(moved, times, np.zeros(0)).residual)
            slope = (ends[0] - ends[1]) / (2 * h)
            expected = np.zeros_like(slope)
            if k < len(slope):
                expected[k] += rows.before[k, :, i]
            if rows.after is not None and k > 0:
                expected[k - 1] += rows.after[k - 1, :, i]
            np.testing.assert_allclose(
                slope, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max() + 1e-7
            )


def test_derivatives_of_ranges_by_finite_differences():
    rng = np.random.default_rng(4)
    log, tags, _, path = world(4, K=3)
    blocks, extra, constants = ranges.bias_blocks(BIASES, 20, 6, 0)
    gathered = ranges.LogRanges.gathered(
        log.ranges, np.full(log.ranges.shape, 0.01), log.links, log.anchors, tags, blocks
    )
    state = LogState(
        path.rotation, path.translation, rng.normal(0, 0.1, (3, extra)),
        rng.normal(0, 0.1, constants),
    )  # fmt: skip
    rows, _ = gathered.rows(state, huber(np.inf))
    assert rows.constants is not None
    h = 1e-6
    for i in range(6 + extra):
        x = np.zeros((3, 6 + extra))
        x[:, i] = h
        ends = [gathered.residual(equations.moved(state, s * x, np.zeros(21)))[0] for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * h) * np.sqrt(gathered.weights)
        np.testing.assert_allclose(slope, rows.before[..., i], atol=1e-6)
    for i in range(constants):
        y = np.zeros(constants)
        y[i] = h
        none = np.zeros((3, 6 + extra))
        ends = [gathered.residual(equations.moved(state, none, s * y))[0] for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * h) * np.sqrt(gathered.weights)
        np.testing.assert_allclose(slope, rows.constants[..., i], atol=1e-6)


def test_moving_and_turning_the_world_moves_and_turns_the_track():
    log, tags, prior, path = world(6, K=8)
    model = LogModel(tags, NOISE, UnknownTwist(WANDER, PROCESS), BIASES, loss=huber(1.5))
    one = smooth(log, model, prior, path[:2])
    T, shift = rotations.exp([0.4, -1.0, 0.7]), np.array([30.0, -20.0, 5.0])
    big = np.kron(np.eye(2), T)
    moved = log._replace(anchors=log.anchors @ T.T + shift)
    turned = T @ prior[0], T @ prior[1] + shift, big @ prior[2] @ big.T
    start = T @ path.rotation, path.translation @ T.T + shift
    other = smooth(moved, model, turned, start)
    np.testing.assert_allclose(other.rotation, T @ one.rotation, atol=1e-6)
    np.testing.assert_allclose(other.translation, one.translation @ T.T + shift, atol=1e-6)
    np.testing.assert_allclose(other.covariance, big @ one.covariance @ big.T, atol=1e-7)
    np.testing.assert_allclose(other.cost, one.cost, rtol=1e-8)


def test_a_batch_of_logs_is_each_of_them_and_anchors_may_move():
    logs = [world(seed, K=6) for seed in (7, 8)]
    tags, prior = (
        logs[0][1],
        [np.stack(column) for column in zip(*(w[2] for w in logs), strict=True)],
    )
    drift = 0.1 * np.arange(6)[:, None, None]
    each = [w[0]._replace(anchors=w[0].anchors + drift) for w in logs]
    columns = (np.stack(column) for column in list(zip(*each, strict=True))[:4])
    times, measured, anchors, links = columns
    both = RangeLog(times, measured, anchors, links)
    start = [np.stack([w[3][i] for w in logs]) for i in (0, 1)]
    model = LogModel(tags, NOISE, KnownTwist(ProcessNoise(1.0, 2.0)), BIASES)
    together = smooth(both, model, prior, start)
    for b, log in enumerate(each):
        alone = smooth(log, model, [p[b] for p in prior], [s[b] for s in start])
        for name in ("rotation", "translation", "covariance", "biases", "residuals", "freedom"):
            there, here = getattr(together, name)[b], getattr(alone, name)
            np.testing.assert_allclose(there, here, atol=1e-6, err_msg=name)


def test_ranges_with_a_time_each_and_a_deviation_each():
    log, tags, prior, path = world(9, K=12)
    order = np.argwhere(log.links)
    K = len(order)
    rng = np.random.default_rng(0)
    times = 0.1 * order[:, 0] + 0.02 * rng.random(K).round(3)
    order, times = order[np.argsort(times)], np.sort(times)
    spread = np.zeros((K, 5, 4))
    links, std = np.zeros((K, 5, 4), bool), np.ones((K, 5, 4))
    for k, (epoch, m, n) in enumerate(order):
        spread[k, m, n], links[k, m, n] = log.ranges[epoch, m, n], True
        std[k, m, n] = 0.05 if n else 0.08
    single = RangeLog(times, spread, log.anchors, links, ranging.LinkNoise(std))
    model = LogModel(tags, NOISE, UnknownTwist(WANDER, PROCESS))
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=ProcessNoise(1.0, 2.0))
    start = causal_track(filter, single, prior)
    found = smooth(single, model, prior, start)
    at = order[:, 0]
    error = metrics.pose_error(
        found.rotation, found.translation, path.rotation[at], path.translation[at]
    )
    filtered = metrics.pose_error(*start, path.rotation[at], path.translation[at])
    assert found.converged
    assert np.square(error).mean() < 0.5 * np.square(filtered).mean()
    assert metrics.nees(error, found.covariance).mean() / 6 < 3
    # The residual stands where the range was.
    assert (found.residuals[~links] == 0).all()
    assert np.std(found.residuals[links]) < 0.1


@pytest.mark.parametrize(("name", "seed"), [("uwb_room", 1), ("drone_yard", 2)])
def test_reaches_its_bound_with_honest_beliefs(name, seed):
    found, error, limit = smoothed_trials(SCENES[name], 40, seed)
    assert found.converged.all()
    # 40 trials of 101 epochs, of which some ten are independent of each other: 1 +- 0.02.
    assert over_bound(error, limit) == pytest.approx([1, 1], abs=0.06)
    assert 0.9 < metrics.nees(error, found.covariance).mean() / 6 < 1.1
    assert 0.97 < found.squares.sum() / found.freedom.sum() < 1.03


def test_losses_for_ranges_that_err_late():
    log, tags, prior, path = world(10, K=20)
    rng = np.random.default_rng(1)
    late = np.where(rng.random(log.ranges.shape) < 0.15, rng.exponential(1.0, log.ranges.shape), 0)
    log = log._replace(ranges=log.ranges + late)
    motion = UnknownTwist(WANDER, PROCESS)
    errors = []
    for loss in (SQUARES, huber(1.5), LATE):
        found = smooth(log, LogModel(tags, NOISE, motion, loss=loss), prior, path[:2])
        error = metrics.pose_error(found.rotation, found.translation, *path[:2])
        errors.append(np.sqrt(np.square(error).mean()))
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.5 * errors[0]


@pytest.mark.parametrize("loss", [SQUARES, huber(1.5), LATE])
def test_squares_have_their_expectation_under_every_loss(loss):
    """Of Gaussian errors, with the weights of the loss: 1 within 4 sigma of 1,300 ranges each."""
    found = [
        smooth(
            log, LogModel(tags, NOISE, UnknownTwist(WANDER, PROCESS), loss=loss), prior, path[:2]
        )
        for log, tags, prior, path in (world(seed, K=20, m=8) for seed in range(3))
    ]
    ratio = sum(f.squares.sum() for f in found) / sum(f.freedom.sum() for f in found)
    assert 0.87 < ratio < 1.13

    def weighted(x):
        return loss_of(np.array([[x * x]]), loss, np.array([[x > 0]]))[1].item() * x * x

    mean = integrate.quad(
        lambda x: weighted(x) * stats.norm.pdf(x), -9, 9, points=(-1.5, -1, 0, 1, 1.5)
    )[0]
    assert expected_square(loss) == pytest.approx(mean, abs=1e-5)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"times": [0.0, 0.2, 0.1, 0.3, 0.4]}, "times"),
        ({"times": np.arange(4)}, "times"),
        ({"ranges": np.full((5, 5, 4), np.nan)}, "ranges"),
        ({"anchors": np.zeros((3, 3))}, "links"),
    ],
)
def test_bad_logs_are_named(change, name):
    log, tags, prior, path = world(11)
    model = LogModel(tags, NOISE, UnknownTwist(WANDER, PROCESS))
    with pytest.raises(ValueError, match=name):
        smooth(log._replace(**change), model, prior, path[:2])


def test_laws_are_factors_and_motions():
    def states_of(motion: Motion) -> int:
        return 6 + len(motion.extra_std)

    def constants_of(factor: Factor) -> int:
        return len(factor.constants_std)

    assert [states_of(KnownTwist(PROCESS)), states_of(UnknownTwist(WANDER))] == [6, 12]
    assert [constants_of(Level(1.0, 0.1)), constants_of(KnownTwist(PROCESS))] == [0, 0]


def test_bad_models_are_named():
    _, tags, _, _ = world(12)
    with pytest.raises(ValueError, match="biases"):
        LogModel(tags, NOISE, UnknownTwist(WANDER, PROCESS), (0.1,))  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ValueError, match="height"):
        Level(1.0)
    with pytest.raises(ValueError, match="tilt_std_rad"):
        Level(tilt_std_rad=0.0)
