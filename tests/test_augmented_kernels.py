"""Kernels of the iterated EKF with more states than the pose, and their textbook forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbl_gym import kernels
from rbl_gym.estimators.costs.bias_cost import update_augmented
from rbl_gym.estimators.iekf.augmented import LOSSES
from rbl_gym.estimators.iekf.augmented_steps import predict_augmented
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from tests.helpers import random_world, simulate

pytestmark = pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")

LAWS = np.array([[0.05, np.inf, 0.1], [0.03, 2.0, 0.02]])
PROCESS, WANDER = 0.01 * np.arange(1.0, 7), 0.02 * np.arange(2.0, 8)


def assert_near(got, want, tolerance=1e-9):
    for a, b in zip(got, want, strict=True):
        scale = max(1.0, np.abs(b).max(initial=0.0))
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * scale)


def world(seed, m, n, n_twist, laws, batch):
    """A state of which no covariance is zero, its anchors and tags."""
    rng = np.random.default_rng(seed)
    anchors, tags, rotation, translation = random_world(rng, m, n, batch)
    k = n_twist + laws * m * n
    A = rng.normal(size=(*batch, 2 * k + 12, 6 + k)) @ np.diag([0.05] * 3 + [0.2] * 3 + [0.1] * k)
    P = np.swapaxes(A, -1, -2) @ A + 1e-4 * np.eye(6 + k)
    extra = 0.1 * rng.standard_normal((*batch, k))
    return rng, (rotation, translation, extra, P), anchors, tags


worlds = st.tuples(
    st.integers(0, 999),
    st.integers(1, 6),
    st.integers(1, 4),
    st.sampled_from([0, 6]),
    st.integers(0, 2),
    st.sampled_from([(), (3,)]),
)


@given(worlds, st.floats(0, 2))
def test_prediction(of, dt):
    rng, state, _, _ = world(*of)
    _, _, _, n_twist, laws, batch = of
    twist = rng.standard_normal((*batch, 6))
    args = *state, twist, dt, PROCESS, WANDER, LAWS[:laws], n_twist
    assert_near(predict_augmented.kernel(*args), predict_augmented.textbook(*args), 1e-12)


@given(worlds, st.sampled_from(sorted(LOSSES, key=str)), st.floats(0, 1), st.sampled_from([1, 4]))
def test_update(of, robust, lost, iterations):
    rng, state, anchors, tags = world(*of)
    _, m, n, n_twist, _, batch = of
    links = rng.random((*batch, m, n)) >= lost
    rotation, translation = state[:2]
    ranges = simulate(rng, anchors, tags, rotation, translation, ranging.RangeNoise(0.05)) + 0.1
    ranges += 2 * (rng.random(ranges.shape) < 0.2)
    off = 0.1 * rng.standard_normal((*batch, 6))
    args = (
        *state, np.where(links, ranges, np.nan), links / 0.05**2, anchors, tags,
        rotations.exp(off[..., :3]) @ rotation, translation + off[..., 3:], state[3][..., :6, :6],
        iterations, LOSSES[robust], n_twist,
    )  # fmt: skip
    with np.errstate(all="ignore"):
        assert_near(update_augmented.kernel(*args), update_augmented.textbook(*args))


def test_a_covariance_that_is_none_is_nan_in_both_forms():
    _, (rotation, translation, extra, P), anchors, tags = world(1, 4, 3, 6, 1, ())
    P = P.copy()
    P[0, 0] = -1.0
    args = (
        rotation, translation, extra, P, np.full((4, 3), 5.0), np.ones((4, 3)), anchors, tags,
        rotation, translation, P[:6, :6], 4, LOSSES[False], 6,
    )  # fmt: skip
    with np.errstate(all="ignore"):
        assert np.isnan(update_augmented.kernel(*args)[3]).any()
        assert np.isnan(update_augmented.textbook(*args)[3]).any()
