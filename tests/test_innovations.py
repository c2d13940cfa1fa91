"""Innovations of an update: against the textbook form at the prior, likelihood, rejected ranges."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rbl_gym import estimators, motion
from rbl_gym.estimators.innovation import (
    GATE,
    OUTLIER_DENSITY,
    OUTLIER_SHARE,
    innovations,
    whitened,
)
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from tests.helpers import random_world

NOISE = ranging.RangeNoise(0.05)
# So little that the ranges are linear in it.
SMALL = np.diag([1e-6] * 3 + [1e-4] * 3)


def epoch(seed: int = 1):
    rng = np.random.default_rng(seed)
    anchors, tags, rotation, translation = random_world(rng, 5, 4)
    true = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    ranges = true + 0.05 * rng.standard_normal(true.shape)
    return anchors, tags, (rotation, translation), ranges, rng.random(true.shape) < 0.8


def textbook(prior, ranges, anchors, tags, links, covariance, extra=None):
    """v and S at the prior, derivatives by finite differences; `extra`: covariance of biases."""

    def foretold(error):
        Q = rotations.exp(error[:3]) @ prior[0]
        places = tags @ Q.T + prior[1] + error[3:]
        return np.linalg.norm(places - anchors[:, None], axis=-1)

    H = np.stack([(foretold(e) - foretold(-e))[links] / 2e-6 for e in 1e-6 * np.eye(6)], axis=1)
    v = (ranges - foretold(np.zeros(6)))[links]
    S = H @ covariance @ H.T + 0.05**2 * np.eye(len(v))
    return v, S if extra is None else S + extra[np.ix_(links.ravel(), links.ravel())]


@pytest.mark.parametrize("name", ["iekf", "iekf-cv", "iekf-bank", "iekf-bias", "kf"])
def test_innovations_are_those_of_the_textbook(name):
    anchors, tags, prior, ranges, links = epoch()
    biases = {"bias_std_m": 0.03, "common_std_m": 0.1} if name == "iekf-bias" else {}
    process = motion.ProcessNoise(0.02, 0.1)
    filter = estimators.make(name, tags=tags, noise=NOISE, process=process, **biases)
    before = filter.initial(*prior, SMALL)
    after = filter.update(before, ranges, anchors, links)
    found = innovations(filter, before, after, ranges, anchors, tags, NOISE, links)
    extra = 0.03**2 * np.eye(20) + 0.1**2 if biases else None
    # The KF family knows its prior as 12 states: what it says of the pose is the belief.
    P = filter.belief(before).covariance
    v, S = textbook(prior, ranges, anchors, tags, links, P, extra)
    np.testing.assert_allclose(found.innovation[links], v, atol=1e-4)
    np.testing.assert_allclose(found.std[links], np.sqrt(np.diag(S)), rtol=1e-3)
    assert (found.used == links).all()
    assert found.dof == links.sum()
    assert not found.innovation[~links].any()
    assert not found.std[~links].any()
    assert found.nis == pytest.approx(v @ np.linalg.solve(S, v), rel=1e-2)
    density = stats.multivariate_normal(np.zeros(len(v)), S).logpdf(v)
    assert found.log_likelihood == pytest.approx(
        density + len(v) * np.log(1 - OUTLIER_SHARE), rel=1e-3
    )


def test_the_nis_is_twice_the_cost_of_the_update():
    """From a wide prior too, where innovations at the prior mean nothing."""
    anchors, tags, (rotation, translation), ranges, _ = epoch(2)
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=motion.ProcessNoise())
    prior = rotations.exp([0.3, -0.2, 0.2]) @ rotation, translation + [0.3, 0.2, -0.3]
    P = np.diag([0.1] * 3 + [0.2] * 3)
    before = filter.initial(*prior, P)
    after = filter.update(before, ranges, anchors)
    found = innovations(filter, before, after, ranges, anchors, tags, NOISE)
    moved = [*rotations.error(after.rotation, prior[0]), *(after.translation - prior[1])]
    cost = np.sum((found.residual / 0.05) ** 2) + np.array(moved) @ np.linalg.solve(P, moved)
    # The difference is of second order in the way from the prior.
    assert found.nis == pytest.approx(cost, rel=0.02)


def test_wrong_ranges_are_refused_at_a_constant_price():
    anchors, tags, prior, ranges, _ = epoch(3)
    filter = estimators.make(
        "iekf", tags=tags, noise=NOISE, process=motion.ProcessNoise(), robust=True
    )
    told = anchors, tags, NOISE
    before = filter.initial(*prior, SMALL)
    links = np.ones(ranges.shape, bool)
    links[1, 2] = links[3, 0] = False
    honest = innovations(
        filter, before, filter.update(before, ranges, anchors, links), ranges, *told, links
    )
    for late in (1.0, 3.0):
        wrong = ranges + late * ~links
        found = innovations(filter, before, filter.update(before, wrong, anchors), wrong, *told)
        assert (found.used == links).all()
        assert found.dof == 18
        assert (np.abs(found.residual[~links]) > GATE * 0.05).all()
        assert found.nis == pytest.approx(honest.nis)
        price = 2 * np.log(OUTLIER_SHARE * OUTLIER_DENSITY)
        assert found.log_likelihood == pytest.approx(honest.log_likelihood + price)


def test_a_state_that_is_not_finite_has_no_likelihood():
    anchors, tags, prior, ranges, _ = epoch(4)
    filter = estimators.make("iekf", tags=tags, noise=NOISE, process=motion.ProcessNoise())
    rotation, translation = (np.stack([a, a]) for a in prior)
    before = filter.initial(rotation, translation, SMALL)
    after = filter.update(before, ranges, anchors)
    lost = after._replace(translation=after.translation * [[1.0], [np.nan]])
    found = innovations(filter, before, lost, ranges, anchors, tags, NOISE)
    assert np.isfinite(found.nis).tolist() == [True, False]
    assert found.nis[1] == -found.log_likelihood[1] == np.inf


@pytest.mark.parametrize(("links", "states"), [(24, 24), (12, 0), (8, 54), (1, 0), (60, 3)])
def test_the_kernel_of_the_statistic_equals_its_textbook_form(links, states):
    rng = np.random.default_rng(links + states)
    trials, size = 6, 6 + states
    jacobian = rng.standard_normal((trials, links, 6))
    slope = np.where(rng.random((links, states)) < 0.2, 1.0, 0.0)
    # A direction without variance, as with known heights.
    root = rng.standard_normal((trials, size, size - 1))
    covariance = root @ root.swapaxes(1, 2)
    moved = 0.01 * rng.standard_normal((trials, size))
    residual = 0.1 * rng.standard_normal((trials, links))
    variance = rng.uniform(0.01, 0.1, (trials, links))
    measured = rng.random((trials, links)) < 0.8
    used = measured & (rng.random((trials, links)) < 0.9)
    covariance[4, 0, 0] = residual[5, 0] = np.nan
    used[3] = False
    epoch = jacobian, slope, covariance, moved, residual, variance, measured, used
    found = whitened(*epoch)
    with np.errstate(invalid="ignore"):
        want = whitened.textbook(*epoch)
    np.testing.assert_array_equal(found[-1], want[-1])
    np.testing.assert_array_equal(found[-1][:4], True)
    assert not found[-1][5]
    sound = found[-1]
    for one, other in zip(found[:-1], want[:-1], strict=True):
        np.testing.assert_allclose(one[sound], other[sound], rtol=1e-9, atol=1e-9)
