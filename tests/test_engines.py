"""Both engines of the KF family against each other, and the choice between them."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import estimators, motion
from rbl_gym.estimators.linear import engines
from rbl_gym.estimators.linear.kalman import KalmanState
from rbl_gym.estimators.linear.squared_range import information
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.wrappers import EstimatePose
from tests.helpers import simulate

FAMILY = ["kf", "uc-kf", "et-kf", "kf-ortho"]
NOISE = ranging.SquaredRangeNoise(0.05)
PROCESS = motion.ProcessNoise(0.02, 0.1)
PRIOR = np.diag([0.02] * 3 + [1.0] * 3)


def turned_tags(rng):
    """Centred, and their principal axes are not those of the body frame."""
    tags = rng.uniform(-0.5, 0.5, (6, 3))
    return tags - tags.mean(axis=0)


TAGS = {
    "aligned": bodies.pyramid(1.0),
    "turned": turned_tags(np.random.default_rng(0)),
    "uncentred": bodies.pyramid(1.0) + [0.3, -0.1, 0.2],
    "plate": bodies.plate(),
}


def shell(rng, shape):
    places = rng.standard_normal((*shape, 3))
    return 15 * places / np.linalg.norm(places, axis=-1, keepdims=True)


class Run:
    """20 epochs of a batch, and the states of a filter over any part of it."""

    def __init__(
        self, tags, batch, *, prior=PRIOR, process=PROCESS, noise=NOISE, fixed=False, lost=()
    ) -> None:
        rng = np.random.default_rng(3)
        self.laws: dict[str, Any] = {"tags": tags, "noise": noise, "process": process}
        if fixed:
            self.laws["weights"] = rng.uniform(0.5, 2.0, 7)
        self.anchors, self.prior, self.epochs = shell(rng, (7,)), prior, []
        rotation, translation = rotations.random(rng, batch), rng.uniform(-3, 3, (*batch, 3))
        self.start = rotations.exp(0.1 * rng.standard_normal((*batch, 3))) @ rotation, translation
        for step in range(20):
            twist = 0.4 * rng.standard_normal((6,) if fixed else (*batch, 6))
            rotation, translation = motion.propagate(rotation, translation, twist, 0.1)
            ranges = simulate(rng, self.anchors, tags, rotation, translation, noise)
            links = rng.random(ranges.shape) > 0.2 if step in lost else np.ones(ranges.shape, bool)
            self.epochs.append((twist, ranges, links))

    def states(self, name, engine, pick=(), plain=False):
        filter = estimators.make(name, engine=engine, **self.laws)
        state = filter.initial(self.start[0][pick], self.start[1][pick], self.prior)
        states = []
        for twist, ranges, links in self.epochs:
            twist = twist if twist.ndim == 1 else twist[pick]
            state = filter.predict(state, twist, 0.1)
            links = None if plain and links.all() else links[pick]
            states.append(filter.update(state, ranges[pick], self.anchors, links))
            state = states[-1]
        return states


def assert_equal(got, want):
    for state, other in zip(got, want, strict=True):
        np.testing.assert_allclose(state.mean, other.mean, rtol=1e-9, atol=1e-9)
        scale = np.abs(other.covariance).max()
        np.testing.assert_allclose(state.covariance, other.covariance, rtol=1e-9, atol=1e-9 * scale)
        np.testing.assert_array_equal(state.constrained, other.constrained)


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize("tags", TAGS)
@pytest.mark.parametrize(
    "case",
    [
        {},
        {"lost": (4, 5)},
        {"process": motion.ProcessNoise((0.01, 0.02, 0.03), (0.1, 0.2, 0.0))},
        {"noise": ranging.RangeNoise(0.02, 0.002)},
        {"fixed": True},
    ],
    ids=["plain", "lost links", "anisotropic process", "weights of each link", "fixed weights"],
)
def test_a_batch_is_a_loop_of_filterpy(name, tags, case):
    run = Run(TAGS[tags], (2, 2), **case)
    together = run.states(name, "auto")
    for pick in ((0, 0), (1, 1)):
        part = [
            KalmanState(s.mean[pick], np.broadcast_to(s.covariance, (2, 2, 12, 12))[pick],
                        s.constrained[pick])
            for s in together
        ]  # fmt: skip
        assert_equal(part, run.states(name, "filterpy", pick))


@pytest.mark.parametrize("name", FAMILY)
def test_a_covariance_that_all_trials_have_in_common_is_held_once(name):
    common = Run(TAGS["turned"], (12,), fixed=True).states(name, "auto")
    assert common[-1].covariance.shape == (12, 12)
    assert common[-1].mean.shape == (12, 12)
    each = Run(TAGS["turned"], (12,), fixed=True, prior=np.tile(PRIOR, (12, 1, 1)))
    each = each.states(name, "auto")
    assert each[-1].covariance.shape == (12, 12, 12)
    assert_equal([s._replace(covariance=np.tile(s.covariance, (12, 1, 1))) for s in common], each)
    plain = Run(TAGS["turned"], (12,), fixed=True, lost=(3,)).states(name, "auto", plain=True)
    assert_equal(plain[:3], common[:3])
    lost = Run(TAGS["turned"], (12,), fixed=True, lost=(3,)).states(name, "auto")
    assert [s.covariance.ndim for s in lost[2:5]] == [2, 3, 3]


def test_auto_is_filterpy_for_one_body_and_batched_for_all_else(monkeypatch):
    calls = []
    for kind in (engines.FilterPy, engines.Batched):
        for method in ("predict", "update"):
            plain = getattr(kind, method)

            def counted(*arguments, kind=kind, plain=plain):
                calls.append(kind)
                return plain(*arguments)

            monkeypatch.setattr(kind, method, counted)
    one, many = Run(TAGS["aligned"], ()), Run(TAGS["aligned"], (1,))
    for run, engine, expected in (
        (one, "auto", engines.FilterPy),
        (many, "auto", engines.Batched),
        (one, "batched", engines.Batched),
        (one, "filterpy", engines.FilterPy),
    ):
        calls.clear()
        run.states("kf", engine)
        assert calls == [expected] * 40
    filter = estimators.make("kf", **one.laws)
    state = filter.initial(*one.start, PRIOR)
    _, ranges, links = one.epochs[0]
    calls.clear()
    # One state, and many bodies' worth of anything else.
    filter.predict(state, np.zeros((2, 6)), 0.1)
    filter.update(state, np.stack([ranges] * 2), one.anchors, links)
    filter.update(state, ranges, np.stack([one.anchors] * 2), links)
    filter.update(state, ranges, one.anchors, np.stack([links, ~links]))
    filter.update(state, ranges, one.anchors, noise=ranging.LinkNoise(np.ones((2, *ranges.shape))))
    assert calls == [engines.Batched] * 5


def test_filterpy_by_name_refuses_a_batch():
    filter = estimators.make(
        "kf", tags=bodies.pyramid(), noise=NOISE, process=PROCESS, engine="filterpy"
    )
    state = filter.initial(np.eye(3), np.zeros((4, 3)), np.eye(6))
    with pytest.raises(
        ValueError, match=r"tracks only one body, got a state with leading axes \(4,\)"
    ):
        filter.predict(state, np.zeros(6), 1.0)
    state = filter.initial(np.eye(3), np.zeros(3), np.eye(6))
    with pytest.raises(ValueError, match="tracks only one body, got a twist"):
        filter.predict(state, np.zeros((2, 6)), 1.0)
    with pytest.raises(ValueError, match="engine must be one of"):
        estimators.make("kf", tags=TAGS["plate"], noise=NOISE, process=PROCESS, engine="torch")


@pytest.mark.parametrize("scene", ["uwb_room", "drone_yard", "satellite", "camsap2013", "hall"])
@pytest.mark.parametrize("name", FAMILY)
def test_estimate_pose_runs_filterpy_and_equals_the_batched_engine(scene, name, monkeypatch):
    def states(engine):
        env = gym.make("rbl_gym:RBL/Tracking-v0", scene=scene, reward="none")
        env = EstimatePose(env, name, {"engine": engine} if engine else None)
        env.reset(seed=5)
        found = [env._state]
        for _ in range(15):
            env.step(env.action_space.sample() * 0)
            found.append(env._state)
        return found

    used = []
    plain = engines.FilterPy.update
    monkeypatch.setattr(engines.FilterPy, "update", lambda *a: used.append(1) or plain(*a))
    by_default = states(None)
    assert len(used) == 16
    batched = states("batched")
    assert len(used) == 16
    assert_equal(by_default, batched)
    assert "filterpy" in sys.modules


@pytest.mark.parametrize("weights", [None, np.linspace(1, 2, 7)], ids=["measured", "fixed"])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, r"ranges must be finite, got nan at index \(9, 3, 2\)"),
        (np.inf, r"ranges must be finite, got inf at index \(9, 3, 2\)"),
        (-1.0, r"ranges must be positive where measured, got -1.0 at index \(9, 3, 2\)"),
        (0.0, r"ranges must be positive where measured, got 0.0 at index \(9, 3, 2\)"),
    ],
)
def test_no_engine_lets_a_bad_range_through(weights, value, message):
    rng = np.random.default_rng(6)
    tags = TAGS["turned"]
    filter = estimators.make("kf", tags=tags, noise=NOISE, process=PROCESS, weights=weights)
    anchors, ranges = shell(rng, (7,)), rng.uniform(12, 18, (12, 7, len(tags)))
    ranges[9, 3, 2] = value
    state = filter.initial(np.eye(3), np.zeros((12, 3)), PRIOR)
    for measured in (ranges, np.asfortranarray(ranges)):
        with pytest.raises(ValueError, match=message):
            filter.update(state, measured, anchors)
    single = KalmanState(state.mean[0], state.covariance, state.constrained[0])
    with pytest.raises(ValueError, match="ranges must be"):
        filter.update(single, ranges[9], anchors)


@pytest.mark.parametrize("tags", TAGS)
@pytest.mark.parametrize("scale", [1.0, 1e4, 1e8])
def test_the_batched_engine_keeps_the_digits_of_a_vague_prior(tags, scale):
    rng = np.random.default_rng(8)
    tags, anchors = TAGS[tags], shell(rng, (9, 7))
    ranges = rng.uniform(12, 18, (9, 7, len(tags)))
    root = rng.standard_normal((9, 12, 12))
    prior = scale * (root @ root.swapaxes(-1, -2) + np.eye(12))
    epoch = engines.LinearEpoch(ranges, anchors, tags, np.ones((9, 7, 1)))
    want = exact_posterior(prior, information(epoch.statistic())[0])
    _, got = engines.Batched.update(rng.standard_normal((9, 12)), prior, epoch)
    np.testing.assert_array_equal(got, got.swapaxes(-1, -2))
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-8 * np.abs(want).max())


def exact_posterior(P: Any, matrix: Any):
    """``(I + P G)^-1 P`` by elimination in long doubles."""
    result = []
    for prior, told in zip(P.astype(np.longdouble), matrix.astype(np.longdouble), strict=True):
        rows = np.concatenate([np.eye(12) + prior @ told, prior], axis=1)
        for i in range(12):
            best = i + int(np.argmax(np.abs(rows[i:, i])))
            rows[[i, best]] = rows[[best, i]]
            rows[i] /= rows[i, i]
            others = np.arange(12) != i
            rows[others] -= rows[others, i, None] * rows[i]
        result.append(rows[:, 12:])
    return np.array(result, dtype=np.float64)
