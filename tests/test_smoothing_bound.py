"""Block-tridiagonal systems and the smoothing bound, against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bounds, kernels
from rbl_gym.bounds import smoothing, tridiagonal
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import TwistSensor, WanderingTwist
from tests.helpers import random_world

FORMS = ["textbook", *(["kernel"] if kernels.enabled() else [])]
NOISE = ranging.RangeNoise(0.1)
LAW = WanderingTwist(0.4, 2.0, 0.3, 1.0)


def chain(rng, batch, K, n):
    """Information of K states in a row, its blocks, and the dense matrix."""
    H = np.zeros((*batch, K * n, K * n))
    for k in range(K):
        J = np.zeros((*batch, 2 * n, K * n))
        last = min(k + 2, K)
        J[..., n * k : n * last] = rng.standard_normal((*batch, 2 * n, n * (last - k)))
        H += np.swapaxes(J, -1, -2) @ J
    blocks = H.reshape((*batch, K, n, K, n))
    D = np.stack([blocks[..., k, :, k, :] for k in range(K)], axis=-3)
    U = np.zeros(D.shape)
    for k in range(K - 1):
        U[..., k, :, :] = blocks[..., k, :, k + 1, :]
    return D, U, H


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("batch", "K", "n"), [((), 1, 4), ((), 7, 6), ((2, 3), 4, 3)])
def test_blocks_as_the_dense_inverse(form, batch, K, n):
    rng = np.random.default_rng(K)
    D, U, H = chain(rng, batch, K, n)
    right = rng.standard_normal((*batch, K, n, 2))
    x = getattr(tridiagonal.solve_blocks, form)(D, U, right)
    expected = np.linalg.solve(H, right.reshape((*batch, K * n, 2)))
    np.testing.assert_allclose(x.reshape(expected.shape), expected, rtol=1e-9, atol=1e-9)
    P = getattr(tridiagonal.inverse_blocks, form)(D, U)
    dense = np.linalg.inv(H).reshape((*batch, K, n, K, n))
    for k in range(K):
        np.testing.assert_allclose(
            P[..., k, :, :], dense[..., k, :, k, :], rtol=1e-9, atol=1e-9 * np.abs(dense).max()
        )


@pytest.mark.parametrize("form", FORMS)
def test_no_information_is_nan_of_its_trial(form):
    D, U, _ = chain(np.random.default_rng(1), (2,), 3, 2)
    D[0, 1] = -np.eye(2)
    P = getattr(tridiagonal.inverse_blocks, form)(D, U)
    assert np.isnan(P[0]).any()
    assert np.isfinite(P[1]).all()


def truth(seed, K=6):
    rng = np.random.default_rng(seed)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    twists, dt = rng.normal(0, 0.5, (K - 1, 6)), rng.uniform(0.1, 0.4, K - 1)
    Q, t = [rotation], [translation]
    for k in range(K - 1):
        Q.append(rotations.exp(twists[k, :3] * dt[k]) @ Q[-1])
        t.append(t[-1] + twists[k, 3:] * dt[k])
    return anchors, tags, np.array(Q), np.array(t), twists, dt


@pytest.mark.parametrize(
    ("law", "sensor"), [(None, None), (LAW, None), (LAW, TwistSensor(0.2, 0.5, frame="body"))]
)
def test_last_epoch_is_the_posterior_bound_and_earlier_ones_are_lower(law, sensor):
    anchors, tags, Q, t, twists, dt = truth(2)
    process, prior = ProcessNoise(0.1, 0.2), np.diag([0.1] * 3 + [0.3] * 3)
    moved = twists, dt, process
    moved = bounds.KnownTwist(*moved) if law is None else bounds.UnknownTwist(*moved, law, sensor)
    found = smoothing.smoothing_crb(bounds.RangeEpoch(anchors, tags, Q, t, NOISE), moved, prior)
    n = found.shape[-1]
    P = np.zeros((n, n))
    P[:6, :6] = prior
    if law is not None:
        P[range(6, 12), range(6, 12)] = law.prior_std() ** 2
    J = np.linalg.inv(P)
    J[:6, :6] += bounds.range_information(anchors, tags, Q[0], t[0], NOISE)
    for k in range(len(twists)):
        # The smoother's bound lies below the filter's, which lies below the prediction.
        gained = np.linalg.inv(J) - found[k]
        assert np.linalg.eigvalsh(gained).min() > -1e-9
        assert np.trace(gained[:6, :6]) > 1e-3 * np.trace(found[k, :6, :6])
        epoch = bounds.RangeEpoch(anchors, tags, Q[k + 1], t[k + 1], NOISE)
        J = bounds.posterior_step(J, epoch, moved._replace(twist=twists[k], dt=float(dt[k])))
    np.testing.assert_allclose(found[-1], np.linalg.inv(J), rtol=1e-6, atol=1e-12)


def test_against_the_dense_information_of_all_epochs():
    anchors, tags, Q, t, twists, dt = truth(3, 4)
    process, prior = ProcessNoise(0.1, 0.2), np.diag([0.1] * 3 + [0.3] * 3)
    links = np.random.default_rng(0).random((4, 5, 4)) < 0.7
    H = np.zeros((4, 6, 4, 6))
    H[0, :, 0] = np.linalg.inv(prior)
    for k in range(4):
        H[k, :, k] += bounds.range_information(anchors, tags, Q[k], t[k], NOISE, links[k])
    for k in range(3):
        F = np.eye(6)
        F[:3, :3] = rotations.exp(twists[k, :3] * dt[k])
        J = np.zeros((6, 4, 6))
        J[:, k], J[:, k + 1] = -F, np.eye(6)
        J = J.reshape(6, 24)
        weight = np.linalg.inv(process.covariance(twists[k], dt[k]))
        H += (J.T @ weight @ J).reshape(4, 6, 4, 6)
    expected = np.linalg.inv(H.reshape(24, 24)).reshape(4, 6, 4, 6)
    epochs = bounds.RangeEpoch(anchors, tags, Q, t, NOISE, links)
    found = smoothing.smoothing_crb(epochs, bounds.KnownTwist(twists, dt, process), prior)
    for k in range(4):
        np.testing.assert_allclose(found[k], expected[k, :, k], rtol=1e-6, atol=1e-10)


def test_leading_axes_and_a_body_that_stands_still():
    anchors, tags, Q, t, twists, _ = truth(4)
    still = ProcessNoise(0.0, 0.0)
    zero, prior = np.zeros_like(twists), np.eye(6)
    at = anchors, tags, np.stack([Q[:1]] * 6, axis=1)[0], np.stack([t[:1]] * 6, axis=1)[0]
    told = bounds.RangeEpoch(*at, NOISE), bounds.KnownTwist(zero, 0.1, still)
    one = smoothing.smoothing_crb(*told, prior)
    both = smoothing.smoothing_crb(*told, np.stack([prior, prior]))
    np.testing.assert_allclose(both[1], one, rtol=1e-9)
    # All epochs measure one pose.
    information = np.eye(6) + 6 * bounds.range_information(*at[:2], Q[0], t[0], NOISE)
    np.testing.assert_allclose(one[3], np.linalg.inv(information), rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "name"),
    [({"dt": -0.1}, "dt"), ({"twist": np.zeros((2, 6))}, "twist"), ({"process": 1}, "process")],
)
def test_bad_input_is_named(change, name):
    anchors, tags, Q, t, twists, _ = truth(5)
    motion = bounds.KnownTwist(twists, 0.1, ProcessNoise(0.1, 0.1))._replace(**change)
    with pytest.raises(ValueError, match=name):
        smoothing.smoothing_crb(bounds.RangeEpoch(anchors, tags, Q, t, NOISE), motion, np.eye(6))
