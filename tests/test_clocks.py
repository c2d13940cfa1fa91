"""Persistent clock offsets: a filter of the pose and of drifting clocks, against naive forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rbl_gym import bounds, estimators, metrics
from rbl_gym.bounds import twist as twist_bound
from rbl_gym.estimators import smoothing
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import offsets, ranging
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.measurements.offsets import Clock
from rbl_gym.motion import ProcessNoise, propagate
from rbl_gym.motion import unknown_twist as ut
from tests.helpers import draw_biases, over_bound, with_kernels
from tests.test_offsets import distances, groups, numeric_jacobian

M, N, DT = 6, 5, 0.1
NOISE = ranging.RangeNoise(0.05)
PROCESS = ProcessNoise(0.05, 0.1)
PRIOR = np.diag([0.04] * 3 + [0.25] * 3)
LAW = Clock("anchor", std_m=30.0, drift_m_s=2.0, walk_m=0.02, drift_walk_m_s=0.05)


def places(seed: int = 0):
    rng = np.random.default_rng(seed)
    return bodies.octahedron(18.0) + rng.uniform(-3, 3, (M, 3)), rng.normal(0, 0.5, (N, 3)), rng


def draw_clocks(law, times, groups, rng, batch=()):
    """Offsets (..., K, groups) of a `Clock` at times (K,), from the law about zero."""
    normals = rng.standard_normal((len(times), *batch, groups, 2))
    states = [normals[0] * [law.std_m, law.drift_m_s]]
    for dt, normal in zip(np.diff(times), normals[1:], strict=True):
        F, Q = law.transition(float(dt))
        values, vectors = np.linalg.eigh(Q)
        states.append(states[-1] @ F.T + normal @ (vectors * np.sqrt(np.maximum(values, 0.0))).T)
    return np.stack([state[..., 0] for state in states], axis=-2)


def naive_bound(anchors, tags, poses, law, kind):
    """Posterior bounds (K, 6, 6) of one track: information about pose, offsets and drifts."""
    U = groups(kind, M, N)
    G = U.shape[1]
    J = np.zeros((6 + 2 * G, 6 + 2 * G))
    J[:6, :6] = np.linalg.inv(PRIOR)
    J[6 : 6 + G, 6 : 6 + G] = np.eye(G) / law.std_m**2
    J[6 + G :, 6 + G :] = np.eye(G) / law.drift_m_s**2
    found = []
    for k, (rotation, translation, twist) in enumerate(poses):
        if k:
            F, Q = np.eye(6 + 2 * G), np.zeros((6 + 2 * G, 6 + 2 * G))
            F[:3, :3] = rotations.exp(DT * twist[:3])
            F[6:, 6:] = np.kron([[1, DT], [0, 1]], np.eye(G))
            Q[:6, :6] = PROCESS.covariance(twist, DT)
            w, q = law.walk_m**2, law.drift_walk_m_s**2
            block = [[w * DT + q * DT**3 / 3, q * DT**2 / 2], [q * DT**2 / 2, q * DT]]
            Q[6:, 6:] = np.kron(block, np.eye(G))
            J = np.linalg.inv(F @ np.linalg.inv(J) @ F.T + Q)
        H = numeric_jacobian(anchors, tags, rotation, translation)
        H = np.concatenate([H, U, np.zeros_like(U)], axis=1)
        J = J + H.T @ H / NOISE.floor_m**2
        found.append(np.linalg.inv(J)[:6, :6])
    return np.array(found)


@pytest.mark.parametrize("kind", offsets.OFFSETS)
def test_the_filter_stands_at_its_bound(kind):
    """150 trials: deviations of 3.3 % of the ratios of an epoch, of NEES/6 5 %; 7 epochs less."""
    batch, K = 150, 10
    law = Clock(kind, 30.0, 2.0, 0.02, 0.05)
    anchors, tags, rng = places()
    n = groups(kind, M, N).shape[1]
    clocks = draw_clocks(law, DT * np.arange(K), n, rng, (batch,))
    rotation = np.broadcast_to(rotations.random(rng), (batch, 3, 3))
    translation = np.zeros((batch, 3))
    make = {"tags": tags, "noise": NOISE, "process": PROCESS}
    filter = estimators.make("iekf", **make, clock=law)
    start = 0.2 * rng.standard_normal((batch, 3)), 0.5 * rng.standard_normal((batch, 3))
    first = rotations.exp(start[0]) @ rotation, translation + start[1], PRIOR
    state = filter.initial(*first)
    errors, nees, poses = [], [], []
    for k in range(K):
        twist = np.array([0.1, -0.2, 0.3, 1.0, 0.5, -0.2])
        if k:
            walked = twist + rng.standard_normal((batch, 6)) * PROCESS.std() / np.sqrt(DT)
            rotation, translation = propagate(rotation, translation, walked, DT)
            state = filter.predict(state, twist, DT)
        poses.append((rotation[0], translation[0], twist))
        far = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
        added = clocks[:, k].reshape((batch, *offsets.group_shape(kind, M, N)))
        ranges = far + 0.05 * rng.standard_normal(far.shape) + added
        state = filter.update(state, ranges, anchors)
        belief = filter.belief(state)
        errors.append(metrics.pose_error(*belief[:2], rotation, translation))
        nees.append(metrics.nees(errors[-1], belief.covariance).mean())
    bound = naive_bound(anchors, tags, poses, law, kind)
    for block in (slice(0, 3), slice(3, 6)):
        limit = np.trace(bound[:, block, block], axis1=-2, axis2=-1)
        square = np.square(np.array(errors)[..., block]).sum(axis=-1).mean(axis=-1)
        # The bound is that of one track; bodies near each other have about the same.
        assert np.sqrt(square / limit)[3:].mean() < 1.08
    assert abs(np.mean(nees[3:]) - 6) < 0.6


def test_one_linear_update():
    """As a Kalman filter with offsets and drifts as states, at a prior of a good pose."""
    anchors, tags, rng = places(1)
    rotation, translation = rotations.random(rng), rng.normal(0, 1, 3)
    P = 1e-8 * np.diag([1.0, 2, 1, 3, 1, 1])
    far = distances(anchors, tags, rotation, translation)
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS, clock=LAW)
    ranges = far + 0.01 * rng.standard_normal(far.shape) + 20 * rng.standard_normal((M, 1))
    state = filter.update(filter.initial(rotation, translation, P), ranges, anchors)
    U = groups("anchor", M, N)
    H = np.concatenate(
        [numeric_jacobian(anchors, tags, rotation, translation), U, np.zeros_like(U)], axis=1
    )
    whole = np.zeros((6 + 2 * M, 6 + 2 * M))
    whole[:6, :6] = P
    whole[6:, 6:] = np.diag([30.0**2] * M + [2.0**2] * M)
    S = H @ whole @ H.T + 0.05**2 * np.eye(M * N)
    want = whole - whole @ H.T @ np.linalg.solve(S, H @ whole)
    np.testing.assert_allclose(state.covariance, want, rtol=1e-3, atol=1e-9)
    F = np.kron([[1, 0.5], [0, 1]], np.eye(M))
    moved = filter.predict(state, np.zeros(6), 0.5)
    np.testing.assert_allclose(moved.extra, F @ state.extra)
    walk = LAW.transition(0.5)[1]
    np.testing.assert_allclose(
        moved.covariance[6:, 6:], F @ state.covariance[6:, 6:] @ F.T + np.kron(walk, np.eye(M))
    )


def test_what_is_no_clock_is_refused():
    make = {"tags": np.eye(3), "noise": NOISE, "process": PROCESS}
    with pytest.raises(ValueError, match="clock must be a Clock"):
        estimators.make("iekf", **make, clock="tag")
    with pytest.raises(ValueError, match="offset must be None"):
        estimators.make("iekf", **make, clock=LAW, offset="tag")
    with pytest.raises(ValueError, match="offset must be one of"):
        Clock("tags")
    filter = estimators.make("iekf", **make, clock=LAW)
    state = filter.initial(np.eye(3), np.zeros(3), PRIOR)
    state = filter.update(state, np.ones((M, 3)), places()[0])
    with pytest.raises(ValueError, match="must stay 6, as the state has a clock of each"):
        filter.update(state, np.ones((4, 3)), places()[0][:4])
    with pytest.raises(ValueError, match="ranges must be finite"):
        filter.update(state, np.full((M, 3), np.nan), places()[0])


def test_what_has_no_clock_is_refused():
    make: dict[str, Any] = {
        "tags": places()[1], "noise": NOISE, "process": PROCESS, "clock": LAW,
    }  # fmt: skip
    refused: list[tuple[str, Any]] = [("headings", 4), ("odometry", {})]
    for key, value in refused:
        with pytest.raises(ValueError, match="clock must be None if odometry"):
            estimators.make("iekf-log", **(make | {key: value}))


@with_kernels
@pytest.mark.parametrize("kind", ["tag", "anchor"])
def test_with_an_unknown_twist_and_biases_it_stands_at_its_bound(kind):
    """100 trials: ratios scatter by 3 % (6 epochs that go together), NEES/6 by 6 %."""
    batch, K = 100, 8
    clock = Clock(kind, 30.0, 2.0, 0.02, 0.05)
    anchors, tags, rng = places(1)
    # A small body that knows no distance sees its place as directions, which are not linear.
    tags = 2 * tags
    law = ut.WanderingTwist(0.3, 1.0, 0.2, 0.5)
    stays, moves = LinkBias(0.05, None, 0.05), LinkBias(0.03, 0.5)
    G, links = groups(kind, M, N).shape[1], M * N
    times = DT * np.arange(K)
    path = ut.simulate_wandering(
        np.broadcast_to(rotations.random(rng), (batch, 3, 3)), np.zeros((batch, 3)), law, PROCESS,
        DT, K - 1, rng,
    )  # fmt: skip
    added = sum(draw_biases(b, times, links, rng, (batch,)) for b in (stays, moves))
    added = added + draw_clocks(clock, times, G, rng, (batch,)) @ groups(kind, M, N).T
    filter = estimators.make(
        "iekf-log", tags=tags, noise=NOISE, process=PROCESS, robust=False, clock=clock,
        turn_rate_rad_s=0.3, speed_m_s=1.0, turn_acceleration=0.2, acceleration=0.5,
        constant_std_m=0.05, constant_common_m=0.05, drift_std_m=0.03, drift_time_s=0.5,
    )  # fmt: skip
    first = rotations.exp(0.2 * rng.standard_normal((batch, 3))) @ path.rotation[:, 0]
    state = filter.initial(first, 0.5 * rng.standard_normal((batch, 3)), PRIOR)
    # The bound: all states of one trial after the other's mean, F and Q by their blocks.
    n = 12 + 2 * links + 2 * G
    P = np.zeros((batch, n, n))
    P[:, :6, :6], P[:, range(6, 12), range(6, 12)] = PRIOR, law.prior_std() ** 2
    for k, bias in enumerate((stays, moves)):
        where = slice(12 + k * links, 12 + (k + 1) * links)
        P[:, where, where] = bias.covariance(links)
    std = np.repeat([clock.std_m, clock.drift_m_s], G)
    P[:, range(n - 2 * G, n), range(n - 2 * G, n)] = std**2
    S = np.concatenate([np.eye(links), np.eye(links), groups(kind, M, N)], axis=1)
    errors, nees, limits = [], [], []
    for k in range(K):
        pose = path.rotation[:, k], path.translation[:, k]
        if k:
            state = filter.predict(state, np.zeros(6), DT)
            P = twist_bound.predict_covariance(P, path.twists[:, k - 1], DT, PROCESS, law)
            F, Q = np.eye(n), np.zeros((n, n))
            where, kept = slice(12 + links, 12 + 2 * links), np.exp(-DT / 0.5)
            F[where, where] *= kept
            Q[where, where] = (1 - kept**2) * moves.covariance(links)
            last = slice(n - 2 * G, n)
            F[last, last], Q[last, last] = (np.kron(a, np.eye(G)) for a in clock.transition(DT))
            P = F @ P @ F.T + Q
        far = ranging.distances(anchors, ranging.tag_positions(*pose, tags))
        ranges = far + 0.05 * rng.standard_normal(far.shape) + added[:, k].reshape(far.shape)
        state = filter.update(state, ranges, anchors)
        _, J = bounds.range_jacobian(anchors, tags, *pose)
        H = np.zeros((batch, links, n))
        H[..., :6], H[..., 12 : 12 + S.shape[1]] = np.swapaxes(J, -1, -2), S
        gain = np.linalg.solve(H @ P @ np.swapaxes(H, -1, -2) + 0.05**2 * np.eye(links), H @ P)
        P = P - np.swapaxes(H @ P, -1, -2) @ gain
        error = metrics.pose_error(state.rotation, state.translation, *pose)
        errors.append(error**2)
        nees.append(metrics.nees(error, filter.belief(state).covariance))
        limits.append(np.diagonal(P, axis1=-2, axis2=-1)[:, :6])
    for block in (slice(0, 3), slice(3, 6)):
        found, limit = (np.array(a)[2:, :, block].mean() for a in (errors, limits))
        assert np.sqrt(found / limit) == pytest.approx(1, abs=0.12)
    assert np.mean(nees[2:]) / 6 == pytest.approx(1, abs=0.18)


@pytest.mark.parametrize("kind", ["tag", "anchor"])
def test_the_smoother_stands_at_the_bound_of_the_whole_log(kind):
    """60 tracks of 6 epochs: ratios scatter by 5 %, NEES/6 by 6 %; covariances by the dense one."""
    batch, K = 60, 6
    law = Clock(kind, 30.0, 2.0, 0.02, 0.05)
    anchors, tags, rng = places(2)
    U = groups(kind, M, N)
    G = U.shape[1]
    clocks = draw_clocks(law, DT * np.arange(K), G, rng, (batch,))
    twists = np.tile([0.1, -0.2, 0.3, 1.0, 0.5, -0.2], (batch, K - 1, 1))
    rotation, translation = rotations.random(rng), np.zeros(3)
    turned: list[Any] = [np.broadcast_to(rotation, (batch, 3, 3))]
    gone: list[Any] = [np.zeros((batch, 3))]
    for k in range(K - 1):
        walked = twists[:, k] + rng.standard_normal((batch, 6)) * PROCESS.std() / np.sqrt(DT)
        for track, new in zip(
            (turned, gone), propagate(turned[-1], gone[-1], walked, DT), strict=True
        ):
            track.append(new)
    Q, t = np.stack(turned, axis=1), np.stack(gone, axis=1)
    far = ranging.distances(anchors, ranging.tag_positions(Q, t, tags))
    added = (clocks @ U.T).reshape(far.shape)
    ranges = far + 0.05 * rng.standard_normal(far.shape) + added
    prior = (
        rotations.exp(0.2 * rng.standard_normal((batch, 3))) @ rotation,
        translation + 0.5 * rng.standard_normal((batch, 3)),
        PRIOR,
    )
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=PROCESS, clock=law)
    log = smoothing.RangeLog(DT * np.arange(K), ranges, anchors)
    start = smoothing.causal_track(filter, log, prior, twists)
    model = smoothing.LogModel(tags, NOISE, smoothing.KnownTwist(PROCESS, twists), clock=law)
    found = estimators.smooth(log, model, prior, start)
    assert found.converged.all()
    # All poses and clocks of the first track as one dense problem, at its truth.
    n = 6 + 2 * G
    H = np.zeros((n * K, n * K))
    H[:6, :6] = np.linalg.inv(PRIOR)
    H[range(6, n), range(6, n)] = np.repeat([law.std_m, law.drift_m_s], G) ** -2.0
    for k in range(K):
        own = slice(n * k, n * k + n)
        J = np.zeros((M * N, n))
        J[:, :6], J[:, 6 : 6 + G] = numeric_jacobian(anchors, tags, Q[0, k], t[0, k]), U
        H[own, own] += J.T @ J / 0.05**2
        if k:
            F, noise = np.eye(n), np.zeros((n, n))
            F[:3, :3] = rotations.exp(DT * twists[0, 0, :3])
            noise[:6, :6] = PROCESS.covariance(twists[0, 0], DT)
            F[6:, 6:], noise[6:, 6:] = (np.kron(a, np.eye(G)) for a in law.transition(DT))
            both, step = slice(n * k - n, n * k + n), np.hstack([-F, np.eye(n)])
            H[both, both] += step.T @ np.linalg.solve(noise, step)
    dense = np.linalg.inv(H)
    limit = np.array([dense[n * k : n * k + 6, n * k : n * k + 6] for k in range(K)])
    scale = np.sqrt(np.diagonal(limit, axis1=-2, axis2=-1))
    ratio = (found.covariance[0] - limit) / scale[:, :, None] / scale[:, None, :]
    assert np.abs(ratio).max() < 0.1
    error = metrics.pose_error(found.rotation, found.translation, Q, t)
    assert over_bound(error, limit) == pytest.approx([1, 1], abs=0.15)
    assert metrics.nees(error, found.covariance).mean() / 6 == pytest.approx(1, abs=0.2)
    with pytest.raises(ValueError, match="offset must be None with a clock"):
        smoothing.LogModel(tags, NOISE, model.motion, offset="tag", clock=law)
