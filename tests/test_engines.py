"""Every path of the batched engine against the plain 12 x 12 form, and which path is taken."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from rbl_gym import bodies, estimators, motion, ranging, rotations
from rbl_gym.estimators import dense_filter, engines, four_filters, kalman, unitary
from rbl_gym.estimators.four_filters import inverse, join, principal_frame, remembered, split
from rbl_gym.estimators.least_squares import procrustes, vec
from rbl_gym.estimators.shared_covariance import shared
from rbl_gym.estimators.squared_range import (
    extended,
    information,
    moments,
    paper_matrices,
    statistic,
)
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


@pytest.fixture(autouse=True)
def _few_trials_are_many(monkeypatch):
    """Small batches take the fast paths too."""
    monkeypatch.setattr(engines, "FEW_TRIALS", 8)
    monkeypatch.setattr(kalman, "FEW_TRIALS", 8)


def plain(monkeypatch):
    """Switch to the plain form: no state is split, no covariance taken for shared."""
    monkeypatch.setattr(engines, "FEW_TRIALS", 10**9)
    monkeypatch.setattr(kalman, "FEW_TRIALS", 10**9)


def track(name, tags, batch, *, steps=20, prior=PRIOR, process=PROCESS, noise=NOISE, fixed=False,
          common_twist=False, lost=(), seed=3, edit=lambda state: state):  # fmt: skip
    """States of a run."""
    rng = np.random.default_rng(seed)
    anchors = shell(rng, (7,) if fixed else (*batch, 7))
    rotation, translation = rotations.random(rng, batch), rng.uniform(-3, 3, (*batch, 3))
    weights = rng.uniform(0.5, 2.0, 7) if fixed else None
    filter = estimators.make(name, tags=tags, noise=noise, process=process, weights=weights)
    start = rotations.exp(0.1 * rng.standard_normal((*batch, 3))) @ rotation
    state = edit(filter.initial(start, translation, prior))
    states = []
    for step in range(steps):
        twist = 0.4 * rng.standard_normal((6,) if common_twist else (*batch, 6))
        rotation, translation = motion.propagate(rotation, translation, twist, 0.1)
        ranges = simulate(rng, anchors, tags, rotation, translation, noise)
        links = rng.random(ranges.shape) > 0.2 if step in lost else None
        state = filter.update(filter.predict(state, twist, 0.1), ranges, anchors, links)
        states.append(state)
    return states


def assert_equal(got, want):
    for state, other in zip(got, want, strict=True):
        np.testing.assert_allclose(state.mean, other.mean, rtol=1e-9, atol=1e-9)
        scale = np.abs(other.covariance).max()
        np.testing.assert_allclose(state.covariance, other.covariance, rtol=1e-9, atol=1e-9 * scale)
        np.testing.assert_array_equal(state.constrained, other.constrained)


def count_calls(monkeypatch, module, name):
    calls = []
    original = getattr(module, name)

    def counted(*args, **kwargs):
        calls.append(args)
        return original(*args, **kwargs)

    monkeypatch.setattr(module, name, counted)
    return calls


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize("tags", TAGS)
@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (4, 5)], ids=str)
def test_20_steps_equal_the_plain_form(name, tags, batch, monkeypatch):
    fast = track(name, TAGS[tags], batch)
    assert fast[-1].mean.shape == (*batch, 12)
    assert fast[-1].covariance.shape == (*batch, 12, 12)
    plain(monkeypatch)
    assert_equal(fast, track(name, TAGS[tags], batch))


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize(
    "case",
    [
        {"lost": (4, 5)},
        {"process": motion.ProcessNoise((0.01, 0.02, 0.03), (0.1, 0.2, 0.0))},
        {"process": motion.ProcessNoise(0.0, 0.0)},
        {"prior": 100 * np.eye(12)},
        {"noise": ranging.RangeNoise(0.02, 0.002)},
        {"noise": ranging.RangeNoise(0.02, 0.002, reference_tag=0)},
        {"fixed": True, "common_twist": True},
        {"fixed": True},
        {"fixed": True, "common_twist": True, "lost": (4, 5)},
    ],
    ids=["lost links", "anisotropic process", "no process", "vague", "weights of each link",
         "reference tag", "shared", "shared but for the twist", "shared, lost links"],
)  # fmt: skip
@pytest.mark.parametrize("tags", ["turned", "uncentred"])
def test_special_cases_equal_the_plain_form(name, case, tags, monkeypatch):
    fast = track(name, TAGS[tags], (3, 4), **case)
    plain(monkeypatch)
    assert_equal(fast, track(name, TAGS[tags], (3, 4), **case))


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize("tags", ["aligned", "turned"])
@pytest.mark.parametrize("where", ["columns of Q", "rotation and translation", "anisotropic"])
def test_a_state_with_cross_terms_takes_the_general_path(name, tags, where, monkeypatch):
    def edit(state):
        covariance = state.covariance.copy()
        if where == "columns of Q":
            covariance[3, 0, 4] = covariance[3, 4, 0] = 1e-3
        elif where == "rotation and translation":
            covariance[3, 2, 10] = covariance[3, 10, 2] = 1e-3
        else:
            covariance[:, np.arange(3), np.arange(3)] *= 1.5
        return state._replace(covariance=covariance)

    calls = count_calls(monkeypatch, engines, "dense_update")
    fast = track(name, TAGS[tags], (12,), edit=edit)
    structured = where == "anisotropic" and tags == "aligned"
    # Information wears the cross terms off; the fast path may come back.
    assert not calls if structured else len(calls) > 4
    plain(monkeypatch)
    assert_equal(fast, track(name, TAGS[tags], (12,), edit=edit))


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize("tags", ["aligned", "turned"])
def test_the_intended_path_is_taken(name, tags, monkeypatch):
    four = count_calls(monkeypatch, engines, "filter_update")
    common = count_calls(monkeypatch, engines, "shared_update")
    dense = count_calls(monkeypatch, engines, "dense_update")
    general = count_calls(monkeypatch, engines, "batched_update")
    columns = count_calls(monkeypatch, kalman, "column_fit")

    def taken(tags, batch, **case):
        for calls in (four, common, dense, general, columns):
            calls.clear()
        track(name, tags, batch, steps=3, **case)
        return len(four), len(common), len(dense), len(general), len(columns)

    newton = 3 * (name == "uc-kf")
    assert taken(TAGS[tags], (12,)) == (3, 0, 0, 0, newton)
    assert taken(TAGS[tags], (12,), fixed=True) == (3, 0, 0, 0, newton)
    assert taken(TAGS[tags], (12,), fixed=True, common_twist=True) == (0, 3, 0, 0, newton)
    assert taken(TAGS["uncentred"], (12,)) == (0, 0, 3, 0, 0)
    assert taken(TAGS["uncentred"], (12,), fixed=True, common_twist=True) == (0, 3, 0, 0, 0)
    assert taken(TAGS[tags], ()) == (0, 0, 0, 0, 0)
    assert taken(TAGS[tags], (12,), lost=(0, 1, 2)) == (0, 0, 0, 3, 0)


def test_a_shared_covariance_stays_shared_and_one_reset_trial_ends_it():
    states = track("kf", TAGS["uncentred"], (12,), fixed=True, common_twist=True)
    assert shared(states[-1].covariance) is not None
    mask = np.arange(12) == 4
    reset = [
        np.where(mask.reshape(-1, *[1] * (new.ndim - 1)), old, new)
        for old, new in zip(states[0], states[-1], strict=True)
    ]
    assert shared(reset[1]) is None
    np.testing.assert_array_equal(reset[1][4], states[0].covariance[4])


@pytest.mark.parametrize("tags", ["aligned", "turned"])
def test_a_state_survives_where_and_pickle_on_the_fast_path(tags, monkeypatch):
    states = track("kf", TAGS[tags], (12,), steps=5)
    mask = np.arange(12) % 3 == 0
    mixed = kalman.KalmanState(*(
        np.where(mask.reshape(-1, *[1] * (new.ndim - 1)), old, new)
        for old, new in zip(states[1], states[-1], strict=True)
    ))  # fmt: skip
    frame = principal_frame(TAGS[tags])
    assert frame is not None
    assert split(frame, mixed.covariance) is not None
    copy = pickle.loads(pickle.dumps(mixed))
    filter = estimators.make("kf", tags=TAGS[tags], noise=NOISE, process=PROCESS)
    rng = np.random.default_rng(1)
    anchors = shell(rng, (6,))
    ranges = rng.uniform(12, 18, (12, 6, len(TAGS[tags])))
    first, second = (filter.update(state, ranges, anchors) for state in (mixed, copy))
    np.testing.assert_allclose(first.mean, second.mean, rtol=1e-12)
    single = [filter.update(kalman.KalmanState(*(a[k] for a in mixed)), ranges[k], anchors)
              for k in range(12)]  # fmt: skip
    np.testing.assert_allclose(first.mean, [s.mean for s in single], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("tags", ["aligned", "turned", "plate"])
def test_split_and_join_are_inverses_and_the_covariance_is_the_users(tags):
    rng = np.random.default_rng(2)
    frame = principal_frame(TAGS[tags])
    assert frame is not None
    assert np.linalg.det(frame.axes) == pytest.approx(1)
    root = rng.standard_normal((4, 9, 3, 3))
    dense = root @ root.swapaxes(-1, -2)
    blocks = np.ascontiguousarray(dense.transpose(2, 3, 0, 1))
    covariance = join(frame, blocks, (9,))
    again = split(frame, covariance)
    assert again is not None
    np.testing.assert_allclose(again, blocks, atol=1e-13)
    expected = np.zeros((9, 4, 3, 4, 3))
    for k in range(3):
        for m in range(3):
            for n in range(3):
                expected[:, m, :, n] += frame.axes[m, k] * frame.axes[n, k] * dense[k]
    expected[:, 3, :, 3] = dense[3]
    np.testing.assert_allclose(covariance, expected.reshape(9, 12, 12), atol=1e-13)
    spoilt = covariance.copy()
    spoilt[4, 1, 7] += 1e-6
    assert split(frame, spoilt) is None


def test_only_the_whole_joined_covariance_is_remembered(monkeypatch):
    frame = principal_frame(TAGS["turned"])
    assert frame is not None
    blocks = np.einsum("ij,kb->ijkb", np.eye(3), np.linspace(1, 2, 32).reshape(4, 8))
    for batch in ((8,), (2, 4)):
        covariance = join(frame, blocks, batch)
        assert split(frame, covariance) is blocks
        with pytest.raises(ValueError, match="read-only"):
            covariance[0, 0, 0] = 1.0
        with pytest.raises(ValueError, match="WRITEABLE"):
            covariance.flags.writeable = True
        assert type(covariance) is np.ndarray
        others = (
            covariance[::-1], covariance[:4], covariance[..., :9, :9], covariance.copy(),
            covariance.swapaxes(-1, -2), np.where(True, covariance, 0.0), covariance + 0.0,
            np.asarray(covariance.base)[::-1], pickle.loads(pickle.dumps(covariance)),
            np.broadcast_to(covariance, (3, *covariance.shape)),
        )  # fmt: skip
        assert not any(remembered(frame, np.asarray(other)) is not None for other in others)
        assert remembered(frame._replace(aligned=True), covariance) is None
    calls = count_calls(monkeypatch, four_filters, "_within")
    track("kf", TAGS["turned"], (12,))
    # Of the prior alone.
    assert len(calls) == 1


def test_tags_off_their_centroid_have_no_frame():
    assert principal_frame(TAGS["uncentred"]) is None
    assert principal_frame(TAGS["aligned"] + 1e-9) is None
    assert principal_frame(np.zeros((2, 4, 3))) is None


def test_a_block_that_is_not_positive_is_left_to_the_general_path():
    rng = np.random.default_rng(4)
    root = rng.standard_normal((8, 3, 3))
    dense = root @ root.swapaxes(-1, -2)
    inverses = inverse(np.moveaxis(dense, 0, -1))
    assert inverses is not None
    np.testing.assert_allclose(np.moveaxis(inverses, -1, 0), np.linalg.inv(dense), rtol=1e-9)
    for diagonal in ([0, 1, 1], [1, 0, 1], [1, 1, 0], [1, np.nan, 1]):
        assert inverse(np.diag(diagonal).astype(float)[..., None]) is None


@pytest.mark.parametrize("noise", [0.01, 0.5, 2.0])
def test_the_column_fit_is_procrustes(noise):
    """Far from a rotation too, where the Hessian is not positive at the start."""
    rng = np.random.default_rng(5)
    root = rng.standard_normal((40, 3, 3, 3))
    blocks = root @ root.swapaxes(-1, -2) + 0.01 * np.eye(3)
    target = rotations.random(rng, (40,)) + noise * rng.standard_normal((40, 3, 3))
    got = unitary.column_fit(np.moveaxis(target, 0, -1), blocks.transpose(2, 3, 1, 0))
    got = np.moveaxis(got, -1, 0)
    weight = np.zeros((40, 3, 3, 3, 3))
    for k in range(3):
        weight[:, k, :, k] = np.linalg.inv(blocks[:, k])
    want = procrustes(weight.reshape(40, 9, 9), vec(target), rotations.nearest(target))[0]
    rotations.check_rotation("rotation", got, tolerance=1e-12)
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_the_last_chunk_of_a_large_batch_counts_too(monkeypatch):
    whole = track("kf", TAGS["turned"], (25,), steps=2)
    common = track("kf", TAGS["turned"], (25,), steps=2, fixed=True, common_twist=True)
    monkeypatch.setattr("rbl_gym.estimators.squared_range._CHUNK", 7 * 6 * 4)
    assert_equal(track("kf", TAGS["turned"], (25,), steps=2), whole)
    assert_equal(track("kf", TAGS["turned"], (25,), steps=2, fixed=True, common_twist=True), common)


@pytest.mark.parametrize("weights", [None, np.linspace(1, 2, 7)], ids=["measured", "fixed"])
@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, r"ranges must be finite, got nan at index \(9, 3, 2\)"),
        (np.inf, r"ranges must be finite, got inf at index \(9, 3, 2\)"),
        (-1.0, r"ranges must be positive where measured, got -1.0 at \(9, 3, 2\)"),
        (0.0, r"ranges must be positive where measured, got 0.0 at \(9, 3, 2\)"),
    ],
)
def test_no_path_lets_a_bad_range_through(weights, centred, value, message, monkeypatch):
    monkeypatch.setattr("rbl_gym.estimators.squared_range._CHUNK", 7 * 6 * 4)
    monkeypatch.setattr("rbl_gym.estimators.inputs._PART", 100)
    rng = np.random.default_rng(6)
    tags = TAGS["turned" if centred else "uncentred"]
    filter = estimators.make("kf", tags=tags, noise=NOISE, process=PROCESS, weights=weights)
    anchors = shell(rng, (7,))
    own_anchors = np.repeat(anchors[None], 12, axis=0)
    ranges = rng.uniform(12, 18, (12, 7, len(tags)))
    ranges[9, 3, 2] = value
    state = filter.initial(np.eye(3), np.zeros((12, 3)), PRIOR)
    for places in (anchors, own_anchors):
        for measured in (ranges, np.asfortranarray(ranges)):
            with pytest.raises(ValueError, match=message):
                filter.update(state, measured, places)
    single = kalman.KalmanState(*(array[0] for array in state))
    with pytest.raises(ValueError, match="ranges must be"):
        filter.update(single, ranges[9], anchors)


@pytest.mark.parametrize("tags", TAGS)
@pytest.mark.parametrize("scale", [1.0, 1e4, 1e8])
def test_the_dense_filter_keeps_the_digits_of_a_vague_prior(tags, scale):
    rng = np.random.default_rng(8)
    tags, anchors = TAGS[tags], shell(rng, (9, 7))
    ranges, weights = rng.uniform(12, 18, (9, 7, len(tags))), np.ones((9, 7, 1))
    root = rng.standard_normal((9, 12, 12))
    prior = scale * (root @ root.swapaxes(-1, -2) + np.eye(12))
    mean = rng.standard_normal((9, 12))
    matrix, vector = information(statistic(ranges, anchors, tags, weights))
    want = exact_posterior(prior, matrix)
    centred = dense_filter.centred_frame(tags)
    G, B = moments(ranges, anchors, centred.frame.tags, weights)
    # The arguments stay what they are.
    arguments = mean.T.copy(), prior.transpose(1, 2, 0).copy()
    got = dense_filter.update(centred, *arguments, G, B)
    assert got is not None
    np.testing.assert_array_equal(arguments[0], mean.T)
    np.testing.assert_array_equal(arguments[1], prior.transpose(1, 2, 0))
    covariance = got[1].transpose(2, 0, 1)
    np.testing.assert_array_equal(covariance, covariance.swapaxes(-1, -2))
    np.testing.assert_allclose(covariance, want, rtol=1e-6, atol=1e-8 * np.abs(want).max())
    np.testing.assert_allclose(
        got[0].T,
        engines.correct(mean, want, matrix, vector),
        rtol=1e-6,
        atol=1e-8 * np.sqrt(scale),
    )


def exact_posterior(P: Any, matrix: Any):
    """``(I + P G)^-1 P`` by elimination in long doubles."""
    result = []
    for prior, told in zip(P.astype(np.longdouble), matrix.astype(np.longdouble), strict=True):
        rows = np.concatenate([np.eye(12) + prior @ told, prior], axis=1)
        for i in range(12):
            best = i + np.argmax(np.abs(rows[i:, i]))
            rows[[i, best]] = rows[[best, i]]
            rows[i] /= rows[i, i]
            others = np.arange(12) != i
            rows[others] -= rows[others, i, None] * rows[i]
        result.append(rows[:, 12:])
    return np.array(result, dtype=np.float64)


def test_the_dense_filter_leaves_a_singular_block_to_the_general_form(monkeypatch):
    def edit(state):
        covariance = state.covariance.copy()
        covariance[2, 10] = covariance[2, :, 10] = 0
        return state._replace(covariance=covariance)

    still = motion.ProcessNoise(0.0, 0.0)
    calls = count_calls(monkeypatch, engines, "batched_update")
    fast = track("kf", TAGS["aligned"], (12,), edit=edit, process=still, steps=2)
    assert calls
    plain(monkeypatch)
    assert_equal(fast, track("kf", TAGS["aligned"], (12,), edit=edit, process=still, steps=2))


def test_the_model_kept_for_shared_epochs_is_that_of_the_anchors_now():
    """Written to in place, the anchors are new ones; many tags and few take other products."""
    rng = np.random.default_rng(9)
    for n_tags in (4, 20):
        tags = rng.uniform(-0.5, 0.5, (n_tags, 3))
        weights = rng.uniform(1, 2, 7)
        filter = estimators.make("kf", tags=tags, noise=NOISE, process=PROCESS, weights=weights)
        state = filter.initial(np.eye(3), np.zeros((12, 3)), PRIOR)
        anchors = np.empty((7, 3))
        for _ in range(2):
            anchors[:] = shell(rng, (7,))
            ranges = rng.uniform(12, 18, (12, 7, n_tags))
            got = filter.update(state, ranges, anchors)
            assert shared(got.covariance) is not None
            want = engines.plain_update(
                state.mean, state.covariance, statistic(ranges, anchors, tags, weights[:, None])
            )
            np.testing.assert_allclose(got.mean, want[0], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(got.covariance, want[1], rtol=1e-9, atol=1e-12)


def test_moments_in_parts_are_those_of_the_statistic(monkeypatch):
    rng = np.random.default_rng(7)
    anchors, tags = shell(rng, (11, 7)) + 1e4, TAGS["uncentred"]
    ranges, weights = rng.uniform(12, 18, (11, 7, len(tags))), rng.uniform(1e-6, 1, (11, 7, 1))
    want = paper_matrices(statistic(ranges, anchors, tags, weights))
    monkeypatch.setattr("rbl_gym.estimators.squared_range._COLUMNS", 7 * 4)
    for got, expected in zip(moments(ranges, anchors, extended(tags), weights), want, strict=True):
        np.testing.assert_allclose(np.moveaxis(got, -1, 0), expected, rtol=1e-7)


def test_vague_rotation_of_tags_far_from_their_origin_keeps_its_digits():
    """By way of the centroid some 1e-2 of the covariance would be lost."""
    rng = np.random.default_rng(3)
    tags = rng.uniform(-0.5, 0.5, (5, 3)) + [30.0, 0, 0]
    anchors = 40 * rng.standard_normal((80, 6, 3))
    ranges = ranging.simulate(anchors, tags, np.eye(3), np.zeros(3), NOISE, rng).ranges
    kf = estimators.make("kf", tags=tags, noise=NOISE, process=motion.ProcessNoise(0.1, 0.1))
    P = np.diag([1e8] * 9 + [1.0] * 3)
    mean = np.tile(np.append(np.eye(3).ravel(), np.zeros(3)), (80, 1))
    prior = kf.initial(np.eye(3), np.zeros(3), P)
    wide = prior._replace(mean=mean, covariance=np.tile(P, (80, 1, 1)))
    state = kf.update(wide, ranges, anchors)
    alone = [kf.update(prior, ranges[k], anchors[k]).covariance for k in range(5)]
    scale = np.sqrt(np.diagonal(np.array(alone), axis1=1, axis2=2))
    scale = scale[:, :, None] * scale[:, None]
    np.testing.assert_allclose(state.covariance[:5] / scale, np.array(alone) / scale, atol=1e-3)
