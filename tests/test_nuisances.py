"""Bounds with nuisances: brute force over all parameters, finite differences, Monte Carlo."""

# Worlds are unpacked from sequences of no fixed length.
# pyrefly: ignore-errors[bad-argument-count]
from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize
from scipy.linalg import block_diag

from rbl_gym import bounds, kernels, motion
from rbl_gym.bounds import information as fisher
from rbl_gym.bounds import twist
from rbl_gym.bounds.nuisances import GROUPS
from rbl_gym.geometry import rotations
from rbl_gym.measurements import noise_laws, offsets, ranging
from rbl_gym.measurements.inertial import SENSORS
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.motion import navigation
from rbl_gym.motion.unknown_twist import WanderingTwist
from tests.helpers import random_world

NOISE = ranging.RangeNoise(0.1, 0.01)
PROCESS = motion.ProcessNoise((0.05, 0.1, 0.15), (0.2, 0.3, 0.4))
STD = np.array([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0], [0.05, 0.05, 0.05], [0.2, 0.0, 0.1], [1, 1, 1]])


def world(seed, m=5, n=4):
    return random_world(np.random.default_rng(seed), m, n)


def members(groups, m, n):
    """Ones and zeros (G, m n): which ranges each bias lengthens, by loops."""
    owner = {"link": lambda i, k: i * n + k, "anchor": lambda i, k: i, "tag": lambda i, k: k,
             "common": lambda i, k: 0, "epoch": lambda i, k: 0}[groups]  # fmt: skip
    rows = np.zeros((m * n, m * n))
    for i in range(m):
        for k in range(n):
            rows[owner(i, k), i * n + k] = 1.0
    return rows[rows.any(axis=1)]


def ranges_at(places, error, moved, biases, rows):
    """Ranges (M N,) at another pose, of moved anchors, with biases, from the definition."""
    anchors, tags, rotation, translation = places
    turned = rotations.exp(error[:3]) @ rotation
    positions = tags @ turned.T + translation + error[3:]
    plain = np.linalg.norm(positions[None] - (anchors + moved)[:, None], axis=-1).ravel()
    return plain + rows.T @ biases


def jacobian(places, rows):
    """Derivative (M N, 6 + 3 M + G) of the ranges by pose, anchors' places, biases; numeric."""
    m, count, step = len(places[0]), len(rows), 1e-6
    size = 6 + 3 * m + count

    def at(d):
        return ranges_at(places, d[:6], d[6 : 6 + 3 * m].reshape(-1, 3), d[6 + 3 * m :], rows)

    return np.stack(
        [(at(step * e) - at(-step * e)) / (2 * step) for e in np.eye(size)], axis=-1
    )  # fmt: skip


def weights_of(places, noise=NOISE):
    d = ranges_at(places, np.zeros(6), 0.0, np.zeros(1), np.zeros((1, 1)))
    return 1 / noise.variance(d)


@pytest.mark.parametrize("groups", GROUPS)
def test_joint_information_by_finite_differences(groups):
    places = world(1)
    links = np.random.default_rng(2).random((5, 4)) > 0.2
    rows = members(groups, 5, 4)
    H = jacobian(places, rows)
    scale = np.concatenate([np.ones(6), STD.ravel(), np.full(len(rows), 0.3)])
    want = (H * scale).T @ ((links.ravel() * weights_of(places))[:, None] * H * scale)
    law = LinkBias(0.3, common_std_m=0.2)
    nuisances = bounds.Nuisances(None, STD, law, groups)
    got = bounds.epoch_information(bounds.RangeEpoch(*places, NOISE, links), nuisances)
    assert got.shape[-1] == 6 + nuisances.count(5, 4) == len(scale) + 1
    np.testing.assert_allclose(got[:-1, :-1], want, rtol=1e-6, atol=1e-4)
    # What is common to all links comes last.
    H = np.append(H * scale, np.full((20, 1), 0.2), axis=1)
    want = H.T @ (links.ravel() * weights_of(places) * H[:, -1])
    np.testing.assert_allclose(got[-1], want, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("offset", [None, *offsets.OFFSETS])
@pytest.mark.parametrize("std", [0.2, STD[:, 0], STD], ids=["one", "each", "axes"])
def test_bound_with_surveyed_anchors_is_the_block_of_the_whole_inverse(offset, std):
    places = random_world(np.random.default_rng(3), 5, 6)
    prior = np.diag([9.0] * 3 + [4.0] * 3)
    rows = np.zeros((0, 30)) if offset is None else members(offset, 5, 6)
    H = jacobian(places, rows)
    joint = H.T @ (weights_of(places)[:, None] * H)
    joint[:6, :6] += prior
    each = np.broadcast_to(np.reshape(std, (-1, 1) if np.ndim(std) == 1 else np.shape(std)), (5, 3))
    place = range(6, 21)
    # A place that is known to nothing is one that is known to a millionth.
    joint[place, place] += 1 / np.maximum(each.ravel(), 1e-6) ** 2
    want = np.linalg.inv(joint)[:6, :6]
    got = bounds.pose_crb(*places, NOISE, prior, offset=offset, anchor_std_m=std)
    scale = np.sqrt(np.diag(want))
    np.testing.assert_allclose(
        got / scale / scale[:, None], want / scale / scale[:, None], atol=1e-5
    )
    epoch, nuisances = bounds.RangeEpoch(*places, NOISE), bounds.Nuisances(offset, std)
    np.testing.assert_allclose(
        bounds.epoch_crb(epoch, nuisances, prior), got, rtol=1e-7, atol=1e-12
    )


def test_a_survey_that_is_exact_is_none_and_one_that_is_useless_leaves_the_prior():
    places = world(4)
    plain = bounds.range_information(*places, NOISE)
    np.testing.assert_array_equal(
        bounds.range_information(*places, NOISE, anchor_std_m=np.zeros((5, 3))), plain
    )
    traces = [
        np.trace(bounds.range_information(*places, NOISE, anchor_std_m=std)[3:, 3:])
        for std in (0.0, 1e-4, 0.01, 0.1, 1.0)
    ]
    assert (np.diff(traces) < 0).all()
    assert traces[1] == pytest.approx(traces[0], rel=1e-3)
    # With anchors anywhere the absolute place is open: all bodies may be moved together.
    J = bounds.range_information(*places, NOISE, anchor_std_m=1e4)
    shift = np.r_[0.0, 0, 0, 1, 0, 0]
    assert shift @ J @ shift < 1e-6


@pytest.mark.parametrize(
    "law", [NOISE, ranging.RangeNoise(0.1, 0.01, 1), ranging.SquaredRangeNoise(0.2)]
)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)], ids=str)
@pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")
def test_information_by_its_kernel(batch, law):
    rng = np.random.default_rng(5)
    places = random_world(rng, 5, 4, batch)
    share = np.where(rng.random((*batch, 5, 4)) < 0.3, 0.0, rng.random((*batch, 5, 4)))
    args = np.eye(6), *places, noise_laws.numbers_of(law, 4), share, STD
    form = fisher._anchor_information
    got, want = form.kernel(*args), form.textbook(*args)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())
    # An anchor on a tag: that range tells nothing, in both.
    still = (
        places[0],
        places[0][..., :4, :],
        np.broadcast_to(np.eye(3), (*batch, 3, 3)),
        0 * places[3],
    )
    args = np.eye(6), *still, noise_laws.numbers_of(noise_laws.RangeNoise(0.1), 4), share, STD
    got, want = form.kernel(*args), form.textbook(*args)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())


def test_a_bias_of_each_link_is_noise_within_one_epoch():
    places = world(6)
    both = ranging.RangeNoise(float(np.hypot(0.1, 0.3)))
    epoch = bounds.RangeEpoch(*places, ranging.RangeNoise(0.1))
    got = bounds.epoch_crb(epoch, bounds.Nuisances(bias=LinkBias(0.3)))
    np.testing.assert_allclose(got, bounds.pose_crb(*places, both), rtol=1e-9)


class Log:
    """Epochs of a moving body with lost links, and F and Q (6, 6) of the intervals."""

    def __init__(self, seed, epochs=4, dt=0.5):
        rng = np.random.default_rng(seed)
        self.anchors, self.tags, Q, t = random_world(rng, 5, 4)
        self.dt, self.twists = dt, rng.normal(0, 0.4, (epochs - 1, 6))
        self.poses, self.F, self.Q = [(Q, t)], [], []
        for move in self.twists:
            turn = rotations.exp(move[:3] * dt)
            Q, t = turn @ Q, t + dt * move[3:]
            self.poses.append((Q, t))
            self.F.append(block_diag(turn, np.eye(3)))
            self.Q.append(PROCESS.covariance(move, dt))
        self.links = rng.random((epochs, 5, 4)) > 0.2

    def epoch(self, k):
        return bounds.RangeEpoch(self.anchors, self.tags, *self.poses[k], NOISE, self.links[k])

    def places(self, k):
        return self.anchors, self.tags, *self.poses[k]


@pytest.mark.parametrize("time_s", [None, 1.0, 1e-3])
@pytest.mark.parametrize("groups", ["link", "anchor"])
def test_recursion_by_brute_force(groups, time_s):
    """All poses, all places of anchors, all biases at all epochs, as one problem; its inverse."""
    log, K = Log(7), 4
    rows = members(groups, 5, 4)
    G, prior = len(rows), np.diag([0.1] * 3 + [1.0] * 3)
    # Parameters: the poses, the anchors' places, the biases of each epoch.
    n = 6 * K + 15 + G * K
    whole = np.zeros((n, n))
    at_anchors = np.arange(6 * K, 6 * K + 15)
    whole[:6, :6] += np.linalg.inv(prior)
    whole[at_anchors, at_anchors] += 1 / 0.2**2

    def biases(k):
        return np.arange(6 * K + 15 + G * k, 6 * K + 15 + G * (k + 1))

    kept = 1 - 1e-7 if time_s is None else np.exp(-log.dt / time_s)
    whole[biases(0), biases(0)] += 1 / 0.3**2
    for k in range(K):
        if k:
            both = np.arange(6 * k - 6, 6 * k + 6)
            step = np.hstack([-log.F[k - 1], np.eye(6)])
            whole[np.ix_(both, both)] += step.T @ np.linalg.solve(log.Q[k - 1], step)
            both = np.r_[biases(k - 1), biases(k)]
            step = np.hstack([-kept * np.eye(G), np.eye(G)])
            whole[np.ix_(both, both)] += step.T @ step / (0.3**2 * (1 - kept**2))
        H = jacobian(log.places(k), rows)
        where = np.r_[6 * k : 6 * k + 6, at_anchors, biases(k)]
        whole[np.ix_(where, where)] += H.T @ (
            (log.links[k].ravel() * weights_of(log.places(k)))[:, None] * H
        )
    want = np.linalg.inv(whole)[6 * K - 6 : 6 * K, 6 * K - 6 : 6 * K]
    nuisances = bounds.Nuisances(None, 0.2, LinkBias(0.3, time_s), groups)
    J = bounds.with_nuisances(np.linalg.inv(prior), nuisances.count(5, 4))
    for k in range(K):
        moved = bounds.KnownTwist(log.twists[k - 1], log.dt, PROCESS) if k else None
        J = bounds.posterior_step(J, log.epoch(k), moved, nuisances)
    got = np.linalg.inv(bounds.marginal_information(J))
    scale = np.sqrt(np.diag(want))
    # The brute force has its own rounding: biases that are tied by 1e-7 of their variance.
    np.testing.assert_allclose(
        got / scale / scale[:, None], want / scale / scale[:, None], atol=2e-5
    )


def body_step(log, moved, n):
    """F and Q (n, n) of a body's states under an unknown twist, or with an inertial sensor."""
    F, Q = np.eye(n), np.zeros((n, n))
    if n == 12:
        turn = log.twists[0][:3] * log.dt
        F[:3, :3], F[:3, 6:9] = rotations.exp(turn), log.dt * rotations.left_jacobian(turn)
        F[3:6, 9:12] = log.dt * np.eye(3)
        return F, twist.predict_covariance(Q, log.twists[0], log.dt, PROCESS, moved.law)
    gone = navigation.preintegrate(moved.readings, moved.steps, np.zeros(6), moved.sensor)
    before, T = np.matmul(np.array(log.poses[1][0]), gone.rotation.T), float(gone.duration)
    W = np.kron(np.eye(3), before)
    F[3:6, :3] = -rotations.hat(before @ gone.translation)
    F[6:9, :3] = -rotations.hat(before @ gone.velocity)
    F[3:6, 6:9] = T * np.eye(3)
    F[:9, 9:15] = W @ gone.jacobian
    Q[:9, :9] = W @ gone.covariance @ W.T
    walks = np.repeat([moved.sensor.gyro_walk, moved.sensor.accel_walk], 3)
    Q[9:15, 9:15] = T * np.diag(walks) ** 2
    return F, Q


@pytest.mark.parametrize("n", [12, 15])
def test_nuisances_beside_an_unknown_twist_and_an_inertial_sensor(n):
    log, nuisances = Log(8), bounds.Nuisances("tag", 0.1, LinkBias(0.2, 3.0), "anchor")
    rng, count = np.random.default_rng(9), nuisances.count(5, 4)
    law = WanderingTwist(0.4, 2.0, 0.3, 1.0)
    if n == 12:
        moved = bounds.UnknownTwist(log.twists[0], 0.5, PROCESS, law)
    else:
        moved = bounds.InertialMotion(rng.normal(0, 1, (5, 6)), 0.1, SENSORS["consumer"])
    A = rng.normal(size=(n + count, n + count))
    J = A @ A.T + 5 * np.eye(n + count)
    F, Q = body_step(log, moved, n)
    kept = np.r_[np.ones(15), np.full(count - 15, np.exp(-0.5 / 3.0))]
    F, Q = block_diag(F, np.diag(kept)), block_diag(Q, np.diag(1 - kept**2))
    want = np.linalg.inv(F @ np.linalg.inv(J) @ F.T + Q)
    told = bounds.epoch_information(log.epoch(1), nuisances)
    where = np.r_[0:6, n : n + count]
    want[np.ix_(where, where)] += told
    got = bounds.posterior_step(J, log.epoch(1), moved, nuisances)
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-7 * np.abs(want).max())


def test_the_bound_is_reached_by_maximum_a_posteriori_over_epochs():
    """200 logs: a MAP estimate of pose, places and biases has the bound's variance, 4 sigma."""
    rng = np.random.default_rng(10)
    anchors, tags, rotation, translation = world(8, 6, 5)
    anchors = 10 * anchors / np.linalg.norm(anchors, axis=-1, keepdims=True) + translation
    places, rows = (anchors, tags, rotation, translation), members("tag", 6, 5)
    noise, std, bias, trials, epochs = ranging.RangeNoise(0.02), 0.05, 0.1, 200, 3
    nuisances = bounds.Nuisances(None, std, LinkBias(bias), "tag")
    prior = np.diag([1 / 0.3**2] * 3 + [1.0] * 3)
    J = bounds.with_nuisances(prior, nuisances.count(6, 5))
    still = bounds.KnownTwist(np.zeros(6), 0.1, motion.ProcessNoise())
    for k in range(epochs):
        J = bounds.posterior_step(
            J, bounds.RangeEpoch(*places, noise), still if k else None, nuisances
        )
    told = bounds.marginal_information(J)
    squares = []
    for _ in range(trials):
        moved, biases = std * rng.standard_normal(18), bias * rng.standard_normal(5)
        first = rng.standard_normal(6) / np.sqrt(np.diag(prior))
        true = ranges_at(places, np.zeros(6), moved.reshape(-1, 3), biases, rows)
        # Of a body that stands the mean of the epochs' ranges tells all.
        measured = true + 0.02 / np.sqrt(epochs) * rng.standard_normal(30)

        def residuals(x, measured=measured, first=first):
            at = ranges_at(places, x[:6], x[6:24].reshape(-1, 3), x[24:], rows)
            own = np.sqrt(np.diag(prior)) * (x[:6] - first)
            whitened = (at - measured) * np.sqrt(epochs) / 0.02
            return np.concatenate([whitened, x[6:24] / std, x[24:] / bias, own])

        found = optimize.least_squares(residuals, np.zeros(29), method="lm").x
        squares.append(found[:6] @ told @ found[:6])
    assert abs(np.mean(squares) - 6) < 4 * np.sqrt(12 / trials)


def test_everything_broadcasts():
    anchors, tags, rotation, translation = random_world(np.random.default_rng(12), 5, 4, (3, 2))
    nuisances = bounds.Nuisances("epoch", STD, LinkBias(0.1, 2.0), "tag")
    J = bounds.with_nuisances(np.eye(6), nuisances.count(5, 4))
    moved = bounds.KnownTwist(np.ones((2, 6)), [0.1, 0.2], PROCESS)
    epoch = bounds.RangeEpoch(anchors, tags, rotation, translation, NOISE)
    got = bounds.posterior_step(J, epoch, moved, nuisances)
    one = bounds.RangeEpoch(anchors[2, 1], tags, rotation[2, 1], translation[2, 1], NOISE)
    moved = bounds.KnownTwist(np.ones(6), 0.2, PROCESS)
    want = bounds.posterior_step(J, one, moved, nuisances)
    np.testing.assert_allclose(got[2, 1], want, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: bounds.Nuisances("tags"), "offset must be one of"),
        (lambda w: bounds.Nuisances(groups="wall"), "groups must be one of"),
        (lambda w: bounds.Nuisances(bias=0.1), "bias must be a LinkBias or None, got 0.1"),  # pyrefly: ignore[bad-argument-type]
        (lambda w: bounds.Nuisances(anchor_std_m=-0.1), "anchor_std_m must not be negative"),
        (lambda w: bounds.pose_crb(*w, NOISE, anchor_std_m=[0.1, 0.2]),
         r"anchor_std_m must be one number, or have shape \(5,\) or \(5, 3\), got \(2,\)"),
        (lambda w: bounds.pose_crb(*w, NOISE, anchor_std_m=0.1, tag_std_m=0.1),
         "anchor_std_m needs model 'raw' and tag_std_m = 0"),
        (lambda w: bounds.marginal_information(np.eye(5)), r"joint must have shape \(..., 6"),
        (lambda w: bounds.marginal_information(np.diag([1.0] * 7 + [0])), "joint must be"),
        (lambda w: bounds.epoch_information(bounds.RangeEpoch(*w[:3], w[3] * np.nan, NOISE)),
         "translation must be finite"),
        (lambda w: bounds.epoch_information(bounds.RangeEpoch(*w, 0.1)),  # pyrefly: ignore[bad-argument-count]
         "noise must be a noise law such as"),
        (lambda w: bounds.posterior_step(
            np.eye(8), bounds.RangeEpoch(*w, NOISE), None, bounds.Nuisances(bias=LinkBias(0.1))),
         r"J must have shape \(..., 26, 26\) or .* with 20 nuisance states, got \(8, 8\)"),
        (lambda w: bounds.posterior_step(
            np.eye(6), bounds.RangeEpoch(*w, NOISE), bounds.KnownTwist(np.zeros(6), -1, PROCESS)),
         "dt must not be negative"),
    ],
)  # fmt: skip
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(world(13))
