"""The statistic without ranges: the law of raw ranges, to the last moment, and filters of both."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rbl_gym import bodies, estimators, motion, ranging, rotations, scenes, statistic
from rbl_gym.app import monte_carlo
from rbl_gym.estimators import squared_range
from tests.helpers import random_world, simulate

NOISE = ranging.SquaredRangeNoise(0.05)
PROCESS = motion.ProcessNoise(0.02, 0.1)
FLAT = np.array([1.0, 1.0, 0.0])
PYRAMID = bodies.pyramid(1.0)
# Tags as they come: centred, elsewhere, coplanar (straight and tilted), too few.
TAGS = {
    "pyramid": PYRAMID,
    "off centre": PYRAMID + [0.3, -0.2, 0.1],
    "plate": bodies.plate(),
    "tilted plate": bodies.plate() @ rotations.exp(np.array([0.4, -0.3, 0.2])) + 0.1,
    "one tag": PYRAMID[:1] + 0.2,
}


def raw_statistic(ranges, anchors, tags, rotation, translation):
    """G and B of ranges, weighted at the true ranges."""
    true = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    weights = 1 / NOISE.squared_range_variance(true)
    stat = squared_range.statistic(ranges, anchors, tags, weights)
    return squared_range.paper_matrices(stat)


def make(name, **options):
    filter = estimators.make(name, **options)
    assert isinstance(filter, estimators.KalmanFamily)
    return filter


def gram(tags):
    extended = squared_range.extended(tags)
    return extended.T @ extended


@pytest.mark.parametrize("tags", TAGS.values(), ids=TAGS)
@pytest.mark.parametrize("m", [1, 2, 3, 4, 7, "flat"])
def test_mean_and_covariance_are_those_of_the_model_at_any_rank(m, tags):
    rng = np.random.default_rng(1)
    anchors, _, rotation, translation = random_world(rng, 6 if m == "flat" else m, 1)
    if m == "flat":
        anchors = anchors * FLAT @ rotations.random(rng)
    true = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    G_want, B_want = raw_statistic(true, anchors, tags, rotation, translation)
    world = anchors, tags, rotation, translation, NOISE
    G, B = statistic.measure_statistic(*world, np.zeros((3, 4)))
    size = 4 / NOISE.sigma_m**2  # of G, whose entries are zero for one anchor
    np.testing.assert_allclose(G, G_want, atol=1e-12 * size)
    np.testing.assert_allclose(B, B_want, atol=1e-11 * size)
    # B is linear in the normals: one normal at a time gives its covariance.
    one_each = statistic.measure_statistic(*world, np.eye(12).reshape(12, 3, 4)).B - B
    columns = one_each.swapaxes(-1, -2).reshape(12, 12)
    want = np.kron(gram(tags), G_want)
    np.testing.assert_allclose(columns.T @ columns, want, atol=1e-11 * np.abs(want).max() + 1e-12)


def test_leading_axes_broadcast_and_trials_are_independent_of_their_neighbours():
    rng = np.random.default_rng(2)
    anchors, tags, rotation, translation = random_world(rng, 6, 5, (3, 4))
    normals = rng.standard_normal((3, 4, 3, 4))
    both = statistic.measure_statistic(anchors, tags, rotation, translation, NOISE, normals)
    assert both.G.shape == (3, 4, 3, 3)
    assert both.B.shape == (3, 4, 3, 4)
    own_tags = np.broadcast_to(tags, (3, 1, 5, 3))
    again = statistic.measure_statistic(anchors, own_tags, rotation, translation, NOISE, normals)
    for whole, with_own in zip(both, again, strict=True):
        np.testing.assert_allclose(whole, with_own, rtol=1e-11)
    for i in np.ndindex(3, 4):
        one = statistic.measure_statistic(
            anchors[i], tags, rotation[i], translation[i], NOISE, normals[i]
        )
        for whole, single in zip(both, one, strict=True):
            np.testing.assert_allclose(whole[i], single, rtol=1e-11)


def test_blocks_of_many_anchors_are_one_call_each():
    rng = np.random.default_rng(3)
    anchors, tags, rotation, translation = random_world(rng, 200, 5, (150,))
    normals = rng.standard_normal((150, 3, 4))
    whole = statistic.measure_statistic(anchors, tags, rotation, translation, NOISE, normals)
    half = statistic.measure_statistic(
        anchors[75:], tags, rotation[75:], translation[75:], NOISE, normals[75:]
    )
    np.testing.assert_allclose(whole.G[75:], half.G, rtol=1e-12)
    np.testing.assert_allclose(whole.B[75:], half.B, rtol=1e-9)


@pytest.mark.parametrize("tags", [TAGS["off centre"], TAGS["tilted plate"]], ids=["body", "plate"])
@pytest.mark.parametrize("mode", ["raw", "statistic"])
def test_both_modes_draw_one_law(mode, tags):
    """Mean and covariance of the 12 numbers within 5 of their standard deviations; normality."""
    trials = 20_000
    rng = np.random.default_rng(4)
    anchors, _, rotation, translation = random_world(rng, 6, 1)
    poses = np.broadcast_to(rotation, (trials, 3, 3)), np.broadcast_to(translation, (trials, 3))
    if mode == "raw":
        ranges = simulate(rng, anchors, tags, *poses, NOISE)
        G, B = raw_statistic(ranges, anchors, tags, *poses)
    else:
        G, B = statistic.simulate_statistic(anchors, tags, *poses, NOISE, rng)
    model = np.concatenate([rotation, translation[:, None]], axis=1)
    noise = B - G @ model @ gram(tags)
    seen = noise.swapaxes(-1, -2).reshape(trials, 12)
    covariance = np.kron(gram(tags), G.reshape(-1, 3, 3)[0])
    std = np.sqrt(np.diagonal(covariance))
    assert (np.abs(seen.mean(axis=0)) < 5 * std / np.sqrt(trials)).all()
    # Variance of a sample covariance of normals: (C_ij^2 + C_ii C_jj) / trials.
    spread = np.sqrt((covariance**2 + np.outer(std, std) ** 2) / trials)
    assert (np.abs(np.cov(seen.T) - covariance) < 5 * spread).all()
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-9 * values[-1]
    assert kept.sum() == (9 if tags is TAGS["tilted plate"] else 12)
    white = seen @ vectors[:, kept] / np.sqrt(values[kept])
    assert stats.kstest(white.ravel(), "norm").pvalue > 1e-3
    squares = (white**2).sum(axis=1)
    assert stats.kstest(squares, stats.chi2(int(kept.sum())).cdf).pvalue > 1e-3


def test_rmse_of_the_kf_is_that_of_raw_ranges():
    """RMSE over trials and steps of both modes within 4 standard deviations of each other."""
    trials, steps = 3000, 6
    # One draw of anchors: those of every trial their own have tails that hide a difference.
    anchors, tags, *_ = random_world(np.random.default_rng(5), 6, 5)
    *_, rotation, translation = random_world(np.random.default_rng(6), 6, 5, (trials,))
    found = {}
    for mode in ("raw", "statistic"):
        rng = np.random.default_rng([6, mode == "raw"])
        truth = motion.Path(rotation, translation)
        filter = make("kf", tags=tags, noise=NOISE, process=PROCESS)
        start = rotations.exp(0.1 * rng.standard_normal((trials, 3))) @ rotation
        state = filter.initial(start, translation, np.diag([0.01] * 3 + [0.25] * 3))
        errors = []
        for _ in range(steps):
            twist = 0.3 * rng.standard_normal((trials, 6))
            truth = motion.Path(*motion.propagate(*truth, twist, 0.1))
            state = filter.predict(state, twist, 0.1)
            if mode == "statistic":
                both = statistic.simulate_statistic(anchors, tags, *truth, NOISE, rng)
                state = filter.update_statistic(state, *both)
            else:
                true = ranging.distances(anchors, ranging.tag_positions(*truth, tags))
                weights = 1 / NOISE.squared_range_variance(true)
                weighted = make("kf", tags=tags, noise=NOISE, process=PROCESS, weights=weights)
                ranges = simulate(rng, anchors, tags, *truth, NOISE)
                state = weighted.update(state, ranges, anchors)
            belief = filter.belief(state)
            turn = rotations.error(belief.rotation, truth.rotation)
            shift = belief.translation - truth.translation
            errors.append([(turn**2).sum(-1), (shift**2).sum(-1)])
        found[mode] = np.mean(errors, axis=0)  # over the steps: (2, trials)
    for raw, drawn in zip(found["raw"], found["statistic"], strict=True):
        allowed = 4 * np.sqrt((raw.var() + drawn.var()) / trials)
        assert abs(raw.mean() - drawn.mean()) < allowed
        assert allowed < 0.1 * raw.mean()  # or the test says nothing


def test_monte_carlo_of_the_tracking_paper_agrees_in_both_modes():
    """RMSE of KF per step, both modes, within 4 standard deviations."""
    scene = scenes.get({"name": "camsap2013", "steps": 5})
    errors = []
    for seed, observation in enumerate(monte_carlo.OBSERVATIONS):
        rng = np.random.default_rng([11, seed])
        world = monte_carlo.simulate_world(scene, 4000, rng, observation)
        trace = monte_carlo.run(world, "kf", {})
        errors.append([trace.frobenius**2, (trace.error[..., 3:] ** 2).sum(axis=-1)])
    raw, drawn = np.array(errors)
    allowed = 4 * np.sqrt((raw.var(axis=-1) + drawn.var(axis=-1)) / raw.shape[-1])
    assert (np.abs(raw.mean(axis=-1) - drawn.mean(axis=-1)) < allowed).all()
    assert (allowed < 0.2 * raw.mean(axis=-1)).all()  # or the test says nothing


def test_monte_carlo_names_what_has_no_statistic():
    rng = np.random.default_rng(12)
    with pytest.raises(ValueError, match="observation must be one of 'ranges', 'statistic'"):
        monte_carlo.simulate_world(scenes.get("camsap2013"), 2, rng, "raw")
    with pytest.raises(ValueError, match="noise must be a SquaredRangeNoise"):
        monte_carlo.simulate_world(scenes.get("uwb_room"), 2, rng, "statistic")
    lossy = scenes.get({"name": "camsap2013", "links": {"drop_probability": 0.1}})
    with pytest.raises(ValueError, match="scene must have all its links"):
        monte_carlo.simulate_world(lossy, 2, rng, "statistic")
    world = monte_carlo.simulate_world(scenes.get("camsap2013"), 2, rng, "statistic")
    with pytest.raises(ValueError, match="filter must be of the KF family"):
        monte_carlo.run(world, "iekf", {})


# --- filters ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["kf", "uc-kf", "et-kf", "kf-ortho"])
@pytest.mark.parametrize("tags", ["pyramid", "off centre", "turned"])
@pytest.mark.parametrize("batch", [(), (7,), (10, 12)])
def test_update_from_the_statistic_is_the_update_from_ranges(name, tags, batch):
    rng = np.random.default_rng(7)
    body = PYRAMID @ rotations.random(rng) if tags == "turned" else TAGS[tags]
    if tags == "turned":
        body = body - body.mean(axis=0)
    anchors, _, rotation, translation = random_world(rng, 6, 1, batch)
    ranges = simulate(rng, anchors, body, rotation, translation, NOISE)
    weights = 1 / NOISE.squared_range_variance(ranges)
    G, B = squared_range.paper_matrices(
        squared_range.statistic(ranges, anchors, body, weights)
    )  # fmt: skip
    prior = rotations.exp(0.1 * rng.standard_normal((*batch, 3))) @ rotation
    for engine in ("batched", "filterpy") if batch == () else ("batched",):
        filter = make(name, tags=body, noise=NOISE, process=PROCESS, engine=engine)
        state = filter.initial(prior, translation, np.diag([0.01] * 3 + [0.25] * 3))
        state = filter.predict(state, 0.3 * rng.standard_normal((*batch, 6)), 0.1)
        want, got = filter.update(state, ranges, anchors), filter.update_statistic(state, G, B)
        np.testing.assert_allclose(got.mean, want.mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(got.covariance, want.covariance, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(got.constrained, want.constrained)


@pytest.mark.parametrize("tags", ["pyramid", "plate"])
def test_one_covariance_of_all_trials_stays_one(tags):
    rng = np.random.default_rng(8)
    anchors, _, rotation, translation = random_world(rng, 6, 1)
    body = TAGS[tags]
    poses = np.broadcast_to(rotation, (100, 3, 3)), np.broadcast_to(translation, (100, 3))
    G, B = statistic.simulate_statistic(anchors, body, *poses, NOISE, rng)
    filter = make("kf", tags=body, noise=NOISE, process=PROCESS)
    state = filter.initial(*poses, np.diag([0.01] * 3 + [0.25] * 3))
    together, apart = (filter.update_statistic(state, g, B) for g in (G[0], G))
    assert not any(together.covariance.strides[:-2])
    np.testing.assert_allclose(together.mean, apart.mean, atol=1e-9)
    np.testing.assert_allclose(together.covariance, apart.covariance, atol=1e-9)


# --- bad inputs -------------------------------------------------------------------------------


def simulate_with(**changes):
    anchors, tags, rotation, translation = random_world(np.random.default_rng(9), 6, 5)
    world = {
        "anchors": anchors, "tags": tags, "rotation": rotation, "translation": translation,
        "noise": NOISE, "rng": np.random.default_rng(0),
    }  # fmt: skip
    return statistic.simulate_statistic(**(world | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"anchors": np.full((6, 3), np.nan)}, r"anchors must be finite, got nan"),
        ({"anchors": np.zeros((6, 2))}, r"anchors must have shape \(\.\.\., M, 3\), got \(6, 2\)"),
        ({"tags": np.full((5, 3), np.inf)}, "tags must be finite"),
        ({"rotation": -np.eye(3)}, "rotation must be a proper rotation"),
        ({"translation": [0.0, np.nan, 0.0]}, "translation must be finite"),
        ({"noise": ranging.RangeNoise()}, "noise must be a SquaredRangeNoise"),
        (
            {"tags": np.zeros((1, 3)), "anchors": np.eye(3), "translation": [1.0, 0.0, 0.0]},
            "anchors must not stand on the first tag",
        ),
    ],
)
def test_bad_worlds_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        simulate_with(**changes)


@pytest.mark.parametrize(
    ("G", "B", "message"),
    [
        (np.eye(2), np.zeros((3, 4)), r"G must have shape \(\.\.\., 3, 3\)"),
        (np.eye(3), np.zeros((3, 3)), r"B must have shape \(\.\.\., 3, 4\)"),
        (np.eye(3) * np.nan, np.zeros((3, 4)), "G must be finite"),
        (np.eye(3), np.full((3, 4), np.inf), "B must be finite"),
        (np.triu(np.ones((3, 3))), np.zeros((3, 4)), "G must be symmetric"),
        (np.diag([1.0, -1.0, 1.0]), np.zeros((3, 4)), "G must be positive semidefinite"),
        (np.eye(3)[[1, 0, 2]], np.zeros((3, 4)), "G must be positive semidefinite"),
        (1.5 * np.eye(3) - 0.8, np.zeros((3, 4)), "G must be positive semidefinite"),
        (np.zeros((2, 3, 3)) + np.eye(3), np.zeros((3, 3, 4)), "G and B must have one batch"),
    ],
)
def test_bad_statistics_are_named(G, B, message):
    filter = make("kf", tags=PYRAMID, noise=NOISE, process=PROCESS)
    state = filter.initial(np.eye(3), np.zeros(3), 0.01 * np.eye(6))
    with pytest.raises(ValueError, match=message):
        filter.update_statistic(state, G, B)


def test_a_vague_rotation_needs_rank_12():
    rng = np.random.default_rng(10)
    anchors, _, rotation, translation = random_world(rng, 6, 1)
    for body, places in ((PYRAMID, anchors * FLAT), (TAGS["plate"], anchors)):
        filter = make("kf", tags=body, noise=NOISE, process=PROCESS)
        both = statistic.simulate_statistic(places, body, rotation, translation, NOISE, rng)
        vague = filter.initial(rotation, translation, 100 * np.eye(12))
        with pytest.raises(ValueError, match=r"determine only rank [89] of the filter's 12 states"):
            filter.update_statistic(vague, *both)
        known = filter.initial(rotation, translation, 0.01 * np.eye(6))
        assert np.isfinite(filter.update_statistic(known, *both).mean).all()
    filter = make("kf", tags=PYRAMID, noise=NOISE, process=PROCESS)
    both = statistic.simulate_statistic(anchors, PYRAMID, rotation, translation, NOISE, rng)
    filter.update_statistic(filter.initial(rotation, translation, 100 * np.eye(12)), *both)


def test_filterpy_takes_one_body():
    filter = make("kf", tags=PYRAMID, noise=NOISE, process=PROCESS, engine="filterpy")
    state = filter.initial(np.eye(3), np.zeros(3), 0.01 * np.eye(6))
    with pytest.raises(ValueError, match="must be of one body"):
        filter.update_statistic(state, np.eye(3), np.zeros((2, 3, 4)))
