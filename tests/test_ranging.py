"""The range model: sampled noise has the stated variance, links fail at the stated rate."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.noise_laws import StackedNoise
from rbl_gym.measurements.ranging import LinkModel, RangeNoise, SquaredRangeNoise

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
SEEDS = st.integers(0, 2**32 - 1)
DRAWS = 20_000
# A sample variance of n Gaussian draws has relative deviation sqrt(2 / n); 4.5 of them.
VARIANCE_RTOL = 4.5 * (2 / DRAWS) ** 0.5

RANGES = np.array([[10.0, 12.0, 8.0], [40.0, 41.0, 43.0]])
# Every law of scenes as it comes, and what else two of them can be.
LAWS = [
    *(law() for law in ranging.NOISE_LAWS.values()),
    RangeNoise(0.05, 0.002),
    RangeNoise(0.0, 0.002),
    RangeNoise(0.05, 0.002, reference_tag=0),
    RangeNoise(0.0, 0.002, reference_tag=2),
    RangeNoise(0.02, 0.002, reference_tag=-1),
    SquaredRangeNoise(0.05),
]


def samples(law: ranging.NoiseLaw, seed: int) -> np.ndarray:
    normals = np.random.default_rng(seed).standard_normal((DRAWS, *RANGES.shape))
    return law.sample(np.broadcast_to(RANGES, normals.shape), normals)


# --- noise laws -------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_sampled_ranges_have_the_stated_variance_and_no_bias(law):
    error = samples(law, 0) - RANGES
    want = np.broadcast_to(law.variance(RANGES), RANGES.shape)
    # Beside the sampling error, 1e-3 for the second order of the squared law.
    np.testing.assert_allclose(error.var(axis=0), want, rtol=VARIANCE_RTOL + 1e-3)
    np.testing.assert_array_less(np.abs(error.mean(axis=0)), 4.5 * np.sqrt(want / DRAWS) + 1e-4)


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_sampled_squared_ranges_have_the_stated_variance(law):
    squared = samples(law, 1) ** 2
    want = np.broadcast_to(law.squared_range_variance(RANGES), RANGES.shape)
    tag = getattr(law, "reference_tag", None)
    if tag is not None:  # the papers' common variance is that of the reference tag
        squared, want = squared[..., tag], want[..., tag]
    np.testing.assert_allclose(squared.var(axis=0), want, rtol=VARIANCE_RTOL + 1e-3)


def test_squared_law_is_exact_on_the_squared_range():
    squared = samples(SquaredRangeNoise(0.05), 2) ** 2
    want = (0.05 * RANGES[:, :1]) ** 2 * np.ones(3)
    np.testing.assert_allclose(squared.var(axis=0), want, rtol=VARIANCE_RTOL)
    off = np.abs(squared.mean(axis=0) - RANGES**2)
    np.testing.assert_array_less(off, 4.5 * np.sqrt(want / DRAWS))


def test_variance_by_hand():
    own = RangeNoise(0.3, 0.04).variance(np.array([[10.0, 20.0]]))
    np.testing.assert_allclose(own, [[0.09 + 0.16, 0.09 + 0.64]])
    common = RangeNoise(0.3, 0.04, reference_tag=1)
    np.testing.assert_allclose(common.variance(np.array([[10.0, 20.0]])), [[0.73]])
    np.testing.assert_allclose(
        common.squared_range_variance(np.array([[10.0, 20.0]])), [[4 * 400 * 0.73]]
    )
    law = SquaredRangeNoise(0.1)
    np.testing.assert_allclose(law.squared_range_variance(np.array([[10.0, 20.0]])), [[1.0]])
    np.testing.assert_allclose(law.variance(np.array([[10.0, 20.0]])), [[1 / 400, 1 / 1600]])


@pytest.mark.parametrize(
    ("law", "columns"),
    [(RangeNoise(), 3), (RangeNoise(reference_tag=0), 1), (SquaredRangeNoise(), 1)],
    ids=str,
)
def test_variance_common_to_the_tags_comes_with_one_column(law, columns):
    shape = law.squared_range_variance(np.broadcast_to(RANGES, (5, 2, 3))).shape
    assert shape == (5, 2, columns)


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_noise_never_makes_a_range_negative(law):
    ranges = law.sample(RANGES, np.full(RANGES.shape, -1e5))
    np.testing.assert_array_equal(ranges, 0)


@PROPERTY
@given(SEEDS, st.sampled_from(LAWS))
def test_laws_take_a_batch_as_a_loop(seed, law):
    rng = np.random.default_rng(seed)
    ranges, normals = rng.uniform(1, 50, (2, 4, 3, 5)), rng.standard_normal((2, 4, 3, 5))
    links = rng.random((2, 4, 3, 5)) < 0.5
    for index in np.ndindex(2, 4):
        one = ranges[index]
        np.testing.assert_allclose(
            law.variance(ranges, links)[index], law.variance(one, links[index])
        )
        sampled = law.sample(ranges, normals)[index]
        np.testing.assert_allclose(sampled, law.sample(one, normals[index]))


@PROPERTY
@given(SEEDS, st.sampled_from(LAWS))
def test_laws_keep_their_meaning_in_millimetres(seed, law):
    rng = np.random.default_rng(seed)
    ranges, normals = rng.uniform(1, 50, (3, 5)), rng.standard_normal((3, 5))
    metres = {key: value for key, value in vars(law).items() if key.endswith("_m")}
    scaled = dataclasses.replace(law, **{key: 1e3 * value for key, value in metres.items()})
    for got, want in [
        (scaled.variance(1e3 * ranges), 1e6 * law.variance(ranges)),
        (scaled.squared_range_variance(1e3 * ranges), 1e12 * law.squared_range_variance(ranges)),
        (scaled.sample(1e3 * ranges, normals), 1e3 * law.sample(ranges, normals)),
    ]:
        np.testing.assert_allclose(got, want, rtol=1e-12)


# --- the reference link -----------------------------------------------------------------------


@pytest.mark.parametrize("tag", [0, 1, 2, -1, -2, -3])
def test_reference_range_is_that_of_the_tag_also_from_the_end(tag):
    got = ranging.reference_range(RANGES, tag)
    assert got.shape == (2, 1)
    np.testing.assert_array_equal(got[:, 0], RANGES[:, tag])


@pytest.mark.parametrize("tag", [0, 2, -1])
def test_mean_of_the_measured_ranges_stands_in_for_a_missing_reference(tag):
    links = np.ones((3, 3), bool)
    links[1, tag] = False
    links[2] = False
    ranges = np.where(links, np.arange(1.0, 10).reshape(3, 3), 0.0)
    got = ranging.reference_range(ranges, tag, links)[:, 0]
    measured = [r for r, there in zip(ranges[1], links[1], strict=True) if there]
    np.testing.assert_allclose(got, [ranges[0, tag], sum(measured) / 2, 1.0])


def test_ranges_without_a_link_do_not_enter_the_stand_in():
    links = np.array([[False, True, True]])
    a, b = (ranging.reference_range(np.array([[x, 4.0, 6.0]]), 0, links) for x in (0.0, 99.0))
    np.testing.assert_array_equal(a, [[5.0]])
    np.testing.assert_array_equal(b, a)


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_variance_stays_finite_and_of_measured_links_positive_with_links_lost(law):
    links = np.array([[False, True, True], [False, False, False]])
    variance = law.variance(np.where(links, RANGES, 0.0), links)
    assert (np.broadcast_to(variance, RANGES.shape)[links] > 0).all()
    assert np.isfinite(variance).all()


def test_links_of_many_epochs_mask_one_set_of_ranges():
    links = np.random.default_rng(0).random((7, 2, 3)) < 0.5
    got = ranging.reference_range(RANGES, 0, links)
    assert got.shape == (7, 2, 1)
    np.testing.assert_array_equal(got[4], ranging.reference_range(RANGES, 0, links[4]))


# --- geometry ---------------------------------------------------------------------------------


@PROPERTY
@given(SEEDS)
def test_distances_and_tag_positions_equal_a_loop(seed):
    rng = np.random.default_rng(seed)
    anchors, tags = rng.normal(0, 9, (2, 4, 3)), rng.standard_normal((5, 3))
    rotation, translation = rotations.random(rng, (2,)), rng.normal(0, 9, (2, 3))
    positions = ranging.tag_positions(rotation, translation, tags)
    got = ranging.distances(anchors, positions)
    for i in range(2):
        world = np.stack([rotation[i] @ tag + translation[i] for tag in tags])
        np.testing.assert_allclose(positions[i], world, atol=1e-13)
        np.testing.assert_allclose(got[i], cdist(anchors[i], world), rtol=1e-12)


# --- links ------------------------------------------------------------------------------------

TRUE = np.broadcast_to(RANGES, (DRAWS, 2, 3))
QUIET = RangeNoise(1e-9)


def measured(model: LinkModel, seed: int = 0) -> ranging.Measurement:
    rng = np.random.default_rng(seed)
    return ranging.measure(
        TRUE, QUIET, rng.standard_normal(TRUE.shape), model, rng.random((DRAWS, 2, 2, 3))
    )


def assert_share(events: np.ndarray, probability: float) -> None:
    """The share of events is the probability to 4.5 standard deviations."""
    deviation = (probability * (1 - probability) / events.size) ** 0.5
    assert abs(events.mean() - probability) <= 4.5 * deviation


@pytest.mark.parametrize("probability", [0.0, 0.1, 0.7, 1.0])
def test_links_drop_as_often_as_stated(probability):
    got = measured(LinkModel(drop_probability=probability))
    assert_share(~got.links, probability)
    np.testing.assert_array_equal(got.ranges[~got.links], 0.0)
    np.testing.assert_allclose(got.ranges[got.links], TRUE[got.links], atol=1e-7)
    assert not got.nlos.any()


@pytest.mark.parametrize("probability", [0.0, 0.1, 1.0])
def test_reflected_ranges_are_biased_as_often_as_stated(probability):
    got = measured(LinkModel(nlos_probability=probability, nlos_bias_m=3.0))
    assert got.links.all()
    assert_share(got.nlos, probability)
    np.testing.assert_allclose(got.ranges - TRUE, np.where(got.nlos, 3.0, 0.0), atol=1e-7)


def test_drops_and_reflections_are_independent():
    got = measured(LinkModel(drop_probability=0.3, nlos_probability=0.2))
    assert_share(~got.links, 0.3)
    assert_share(got.nlos[got.links], 0.2)
    assert not got.nlos[~got.links].any()


def test_reach_cuts_by_true_distance():
    true = np.array([[9.0, 10.0, 10.0 + 1e-9]])
    got = ranging.measure(true, RangeNoise(1.0), np.full((1, 3), 5.0), LinkModel(reach_m=10.0))
    np.testing.assert_array_equal(got.links, [[True, True, False]])
    np.testing.assert_array_equal(got.ranges, [[14.0, 15.0, 0.0]])


def test_without_a_link_model_every_link_measures():
    normals = np.random.default_rng(0).standard_normal(RANGES.shape)
    got = ranging.measure(RANGES, LAWS[1], normals)
    np.testing.assert_array_equal(got.ranges, LAWS[1].sample(RANGES, normals))
    assert got.links.all()
    assert not got.nlos.any()


@pytest.mark.parametrize("model", [None, LinkModel(), LinkModel(0.3, 30.0, 0.2)])
def test_simulate_is_measure_of_the_true_distances(model):
    rng = np.random.default_rng(4)
    anchors, tags = rng.normal(0, 20, (4, 3)), rng.standard_normal((5, 3))
    Q, t = rotations.random(rng, (6,)), rng.standard_normal((6, 3))
    got = ranging.simulate(anchors, tags, Q, t, LAWS[1], np.random.default_rng(9), model)
    again = np.random.default_rng(9)
    normals = again.standard_normal((6, 4, 5))
    true = np.stack([cdist(anchors, tags @ Q[i].T + t[i]) for i in range(6)])
    want = ranging.measure(true, LAWS[1], normals, model, again.random((6, 2, 4, 5)))
    np.testing.assert_array_equal(got.links, want.links)
    np.testing.assert_array_equal(got.nlos, want.nlos)
    np.testing.assert_allclose(got.ranges, want.ranges, rtol=1e-12)


@pytest.mark.parametrize(
    ("model", "random"),
    [(LinkModel(), False), (LinkModel(reach_m=1.0), False), (LinkModel(0.1), True),
     (LinkModel(nlos_probability=0.1), True)],
)  # fmt: skip
def test_only_probabilities_need_uniforms(model, random):
    assert model.is_random is random
    normals = np.zeros(RANGES.shape)
    if random:
        with pytest.raises(ValueError, match="uniforms must be given for a link model with prob"):
            ranging.measure(RANGES, LAWS[0], normals, model)
    else:
        ranging.measure(RANGES, LAWS[0], normals, model)


# --- errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "fields", "message"),
    [
        (RangeNoise, {"floor_m": -1}, "floor_m must be a finite number of at least 0, got -1.0"),
        (RangeNoise, {"floor_m": "0.1"}, "floor_m must be a number, got '0.1'"),
        (RangeNoise, {"proportional": np.nan}, "proportional must be a finite number"),
        (RangeNoise, {"floor_m": 0.0}, "floor_m and proportional must not both be zero"),
        (RangeNoise, {"reference_tag": 0.5}, "reference_tag must be None or an int, got 0.5"),
        (RangeNoise, {"reference_tag": 1.0}, "reference_tag must be None or an int, got 1.0"),
        (RangeNoise, {"reference_tag": "a"}, "reference_tag must be None or an int, got 'a'"),
        (RangeNoise, {"reference_tag": np.nan}, "reference_tag must be None or an int, got nan"),
        (SquaredRangeNoise, {"sigma_m": 0.0}, "sigma_m must be a finite number"),
        (SquaredRangeNoise, {"sigma_m": np.inf}, "sigma_m must be a finite number"),
        (LinkModel, {"drop_probability": 1.1}, "drop_probability must be a finite number"),
        (LinkModel, {"nlos_probability": -0.1}, "nlos_probability must be a finite number"),
        (LinkModel, {"nlos_bias_m": -1}, "nlos_bias_m must be a finite number of at least 0"),
        (LinkModel, {"reach_m": -1}, "reach_m must be a finite number of at least 0, got -1.0"),
    ],
)
def test_bad_parameter_is_refused(kind, fields, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        kind(**fields)


@pytest.mark.parametrize("tag", [3, -4])
def test_reference_to_a_tag_that_is_not_there_is_refused(tag):
    message = f"reference_tag must be below the number of tags 3, got {tag}"
    with pytest.raises(ValueError, match=message):
        RangeNoise(0.1, reference_tag=tag).variance(RANGES)


def test_stacked_laws_equal_each_alone():
    rng = np.random.default_rng(2)
    laws = [
        RangeNoise(0.1),
        RangeNoise(0.05, 0.02),
        RangeNoise(0.0, 0.01, reference_tag=0),
        RangeNoise(0.02, 0.01, reference_tag=2),
        SquaredRangeNoise(0.3),
    ]
    stacked = StackedNoise(np.array([law.numbers for law in laws]))
    ranges = rng.uniform(1, 30, (len(laws), 4, 3))
    links = rng.random(ranges.shape) < 0.6
    normals = rng.standard_normal(ranges.shape)
    for i, law in enumerate(laws):
        for mask in (None, links):
            own = None if mask is None else mask[i]
            used = np.ones((4, 3), bool) if own is None else own
            for name in ("variance", "squared_range_variance"):
                got = getattr(stacked, name)(ranges, mask)[i]
                want = np.broadcast_to(getattr(law, name)(ranges[i], own), (4, 3))
                np.testing.assert_allclose(got[used], want[used], rtol=1e-12)
        got = stacked.sample(ranges, normals)[i]
        np.testing.assert_allclose(got, law.sample(ranges[i], normals[i]), rtol=1e-12)
