"""The smoother on ranges with an unknown offset in common: dense least squares, bound, shifts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import optimize

from rbl_gym import metrics, ranging
from rbl_gym.estimators.costs.losses import huber
from rbl_gym.estimators.smoothing import KnownTwist, LogModel, RangeLog, smooth
from rbl_gym.geometry import rotations
from rbl_gym.measurements import offsets
from rbl_gym.motion import ProcessNoise
from rbl_gym.worlds import scenes
from tests.helpers import over_bound, smoothed_trials

every_offset = pytest.mark.parametrize("offset", offsets.OFFSETS)
NOISE = ranging.RangeNoise(0.05)
PROCESS = ProcessNoise(0.5, 1.0)


def world(
    offset: str, seed: int = 0, K: int = 3, m: int = 6, n: int = 4
) -> tuple[Any, Any, Any, Any]:
    rng = np.random.default_rng(seed)
    anchors, tags = rng.uniform(-8, 8, (m, 3)), rng.normal(0, 0.5, (n, 3))
    walk = 0.1 * rng.standard_normal((K, 6))
    rotation = rotations.exp(np.cumsum(walk[:, :3], axis=0)) @ rotations.random(rng)
    translation = rng.normal(0, 1, 3) + np.cumsum(walk[:, 3:], axis=0)
    ranges = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    ranges = ranges + 0.05 * rng.standard_normal(ranges.shape)
    ranges += 50 * rng.standard_normal((K, *offsets.group_shape(offset, m, n)))
    log = RangeLog(0.1 * np.arange(K), ranges, anchors, rng.random(ranges.shape) < 0.9)
    prior = rotation[0], translation[0], np.diag([0.04] * 3 + [0.09] * 3)
    return log, tags, prior, (rotation, translation)


@every_offset
def test_as_dense_least_squares_of_poses_and_offsets(offset):
    log, tags, prior, (rotation, translation) = world(offset)
    K, m, n = log.ranges.shape
    groups = np.zeros((m, n), int) + {
        "tag": np.arange(n), "anchor": np.arange(m)[:, None], "epoch": 0
    }[offset]  # fmt: skip
    G = groups.max() + 1

    def residuals(x):
        w, v, c = x[: 3 * K].reshape(K, 3), x[3 * K : 6 * K].reshape(K, 3), x[6 * K :]
        Q, t, c = rotations.exp(w) @ rotation, translation + v, c.reshape(K, G)
        rows = [rotations.error(Q[0], prior[0]) / 0.2, (t[0] - prior[1]) / 0.3]
        for k in range(K - 1):
            rows += [rotations.log(Q[k + 1] @ Q[k].T) / (0.5 * 0.1**0.5)]
            rows += [(t[k + 1] - t[k]) / (1.0 * 0.1**0.5)]
        for k in range(K):
            places = tags @ Q[k].T + t[k]
            far = np.linalg.norm(places[None] - log.anchors[:, None], axis=-1)
            rows.append(((far + c[k][groups] - log.ranges[k])[log.links[k]]) / 0.05)
        return np.concatenate(rows)

    best = optimize.least_squares(
        residuals, np.zeros(K * (6 + G)), xtol=1e-14, ftol=1e-14, gtol=1e-12, x_scale="jac"
    )
    model = LogModel(tags, NOISE, KnownTwist(PROCESS, np.zeros((K - 1, 6))), offset=offset)
    found = smooth(log, model, prior, (rotation, translation))
    assert found.converged
    Q = rotations.exp(best.x[: 3 * K].reshape(K, 3)) @ rotation
    np.testing.assert_allclose(found.rotation, Q, atol=1e-4)
    t = translation + best.x[3 * K : 6 * K].reshape(K, 3)
    np.testing.assert_allclose(found.translation, t, atol=1e-4)
    P = np.linalg.pinv(best.jac.T @ best.jac, rcond=1e-14)
    std = np.sqrt(np.diag(P)[3 * K : 6 * K]).reshape(K, 3)
    mine = np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1)[:, 3:])
    np.testing.assert_allclose(mine, std, rtol=1e-3)
    np.testing.assert_allclose(found.cost, best.cost, rtol=1e-5)


@pytest.mark.parametrize("loss", [None, huber(1.5)], ids=["squares", "huber"])
def test_a_constant_more_changes_nothing(loss):
    log, tags, prior, start = world("tag", 3)
    law = {} if loss is None else {"loss": loss}
    model = LogModel(tags, NOISE, KnownTwist(PROCESS, np.zeros((2, 6))), offset="tag", **law)
    other = log._replace(ranges=log.ranges + 1e4 * np.random.default_rng(1).random((3, 1, 4)))
    one, two = (smooth(a, model, prior, start) for a in (log, other))
    np.testing.assert_allclose(one.translation, two.translation, atol=1e-6)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(one.residuals, two.residuals, atol=1e-6)


def test_reaches_its_bound_with_honest_beliefs():
    """60 trials of 31 epochs: the ratio's deviation is about 2 %, that of NEES/6 about 1 %."""
    scene = scenes.get({"name": "uwb_room", "steps": 30, "links": {"offset": "tag"}})
    found, error, limit = smoothed_trials(scene, 60, 2, offset="tag")
    assert found.converged.all()
    assert max(over_bound(error, limit)) < 1.05
    assert abs(metrics.nees(error, found.covariance).mean() - 6) < 0.3
    np.testing.assert_allclose(found.squares.sum() / found.freedom.sum(), 1, atol=0.04)


def test_what_is_no_offset_is_refused():
    with pytest.raises(ValueError, match="offset must be one of"):
        LogModel(np.eye(3), NOISE, KnownTwist(PROCESS), offset="clock")
