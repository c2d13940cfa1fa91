"""Requirements of zones, and layouts chosen from candidates: against plain loops, all choices."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from rbl_gym import bounds, kernels
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements.ranging import RangeNoise
from rbl_gym.studies.placing import requirements as asked
from rbl_gym.studies.placing import stock_search

TAGS = bodies.octahedron(0.8)
NOISE = RangeNoise(0.1, 0.005)
PRIOR = np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])
LIMITS = asked.Limits(0.12, math.inf, math.radians(6.0))


def informations(anchors, places, rotation):
    """(M, L, T, 6, 6), one call each."""
    return np.array(
        [
            [
                [
                    bounds.range_information(anchor[None], TAGS, turn, place, NOISE)
                    for turn in rotation
                ]
                for place in places
            ]
            for anchor in anchors
        ]
    )


def poses(rng, n_places=15, attitude="free", limits=LIMITS, share=0.8, weight=1.0):
    places = np.array([8.0, 6.0, 1.5]) * rng.random((n_places, 3)) + np.array([1, 1, 0.3])
    rotation = asked.turns(attitude, 2)
    return stock_search.ZonePoses(places, rotation, PRIOR, TAGS, limits, share, weight)


def mounts(rng, count=9):
    """On the walls of a room, sparing nobody."""
    found = np.array([10.0, 8.0, 2.5]) * rng.random((count, 3)) + np.array([0, 0, 0.3])
    found[::2, 0] = 10.0 * (found[::2, 0] > 5)
    found[1::2, 1] = 8.0 * (found[1::2, 1] > 4)
    return found


def stock(seed=0, count=9, **limits):
    rng = np.random.default_rng(seed)
    anchors = mounts(rng, count)
    zones = (poses(rng, **limits), poses(rng, 10, "level", **limits))
    parts = tuple(informations(anchors, zone.places, zone.rotation) for zone in zones)
    return stock_search.Stock(zones, parts, rng.integers(1, 4, count).astype(float))


def plain_errors(information, rotation, tags):
    """Errors at one place by loops over turns: position, rotation, tags, horizontal, up, heading"""
    squares = []
    for F, Q in zip(information, rotation, strict=True):
        P = np.linalg.inv(F)
        tag = 0.0
        for c in tags:
            x, y, z = Q @ c
            J = np.hstack([-np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])
            tag += np.trace(J @ P @ J.T) / len(tags)
        d = np.diag(P)
        squares.append([d[3] + d[4] + d[5], d[0] + d[1] + d[2], tag, d[3] + d[4], d[5], d[2]])
    return np.sqrt(np.mean(squares, axis=0))


def plain_value(pool, chosen, survive=0):
    """The shortfall of the zones by loops and sorting, with errors 3 % larger; or log b - 100."""
    if survive:
        return max(plain_value(pool, [j for j in chosen if j != k]) for k in chosen)
    lacks, squares, weights = [], [], []
    for zone, part in zip(pool.zones, pool.parts, strict=True):
        relative, square = [], []
        for place in range(len(zone.places)):
            F = zone.prior + sum(part[k, place] for k in chosen)
            found = plain_errors(F, zone.rotation, zone.tags)
            ratio = max(found[3] / zone.limits.horizontal, found[5] / zone.limits.heading)
            relative.append(1.03 * ratio)
            square.append(found[2] ** 2)
        needed = [q for q in sorted(relative) if np.mean(np.array(relative) < q) < zone.share]
        above = [max(q, 1.0) for q in needed]
        lacks.append(
            0.3 * (1 - 1 / max(above))
            + 0.7 * np.mean([q > 1 for q in needed])
            + 0.1 * np.mean(np.log(above))
        )
        squares.append(np.mean(square))
        weights.append(zone.weight)
    lack = np.average(lacks, weights=weights)
    return lack if lack > 0 else math.log(np.average(squares, weights=weights)) / 2 - 100


def test_errors_are_those_of_the_inverse():
    rng = np.random.default_rng(3)
    zone = poses(rng, 4)
    F = PRIOR + informations(mounts(rng, 5), zone.places, zone.rotation).sum(axis=0)
    found = asked.errors_of(F, zone.rotation, TAGS)
    for place in range(4):
        want = plain_errors(F[place], zone.rotation, TAGS)
        np.testing.assert_allclose([values[place] for values in found], want, rtol=1e-10)
    # Of one more anchor, or less of one.
    part = informations(mounts(rng, 1), zone.places, zone.rotation)[0]
    added = asked.errors_of(F, zone.rotation, TAGS, part)
    np.testing.assert_allclose(added, asked.errors_of(F + part, zone.rotation, TAGS))
    np.testing.assert_allclose(asked.asked_of(F, part), added[3:])
    np.testing.assert_allclose(asked.asked_of(F), found[3:])
    assert isinstance(asked.asked_of(F), asked.Asked)


@pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")
def test_both_forms_of_the_errors_agree():
    rng = np.random.default_rng(4)
    root = rng.standard_normal((3, 1, 5, 2, 6, 6))
    part = rng.standard_normal((2, 5, 2, 6, 6))
    base, part = (x @ np.swapaxes(x, -1, -2) + np.eye(6) for x in (root, part))
    args = base, part, rotations.random(rng, (2,)), TAGS
    for form, used in ((asked._mean_squares, args), (asked._asked_squares, args[:2])):
        for mine, plain in zip(form.kernel(*used), form.textbook(*used), strict=True):
            assert mine.shape == plain.shape == (3, 2, 5)
            np.testing.assert_allclose(mine, plain, rtol=1e-9)


def test_no_information_is_refused():
    with pytest.raises(ValueError, match="information must be positive definite"):
        asked.errors_of(np.zeros((1, 1, 6, 6)), np.eye(3)[None], TAGS)


def test_turns_are_rotations_and_level_ones_leave_the_vertical_alone():
    free, level = asked.turns("free", 8), asked.turns("heading", 8)
    for turns in (free, level):
        np.testing.assert_allclose(
            turns @ np.swapaxes(turns, -1, -2), np.eye(3) + 0 * turns, atol=1e-12
        )
    np.testing.assert_allclose(level @ [0, 0, 1], np.tile([0, 0, 1], (8, 1)), atol=1e-12)
    headings = np.sort(np.arctan2(level[:, 1, 0], level[:, 0, 0]) % (2 * np.pi))
    np.testing.assert_allclose(np.diff(headings), np.pi / 4)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("count", [1, 19, 20, 100])
def test_the_value_at_a_share_is_the_least_that_fills_it(share, count):
    values = np.random.default_rng(count).permutation(count).astype(float)
    found = asked.value_at_share(values, share)
    fills = [x for x in np.sort(values) if (values <= x).sum() >= share * count - 1e-9]
    assert found == fills[0]


@pytest.mark.parametrize(("within", "places"), [(0, 10), (10, 10), (95, 100), (7, 600)])
def test_the_interval_is_wilsons(within, places):
    want = stats.binomtest(within, places).proportion_ci(0.95, method="wilson")
    np.testing.assert_allclose(asked.wilson_interval(within, places), tuple(want), atol=1e-12)


def test_the_interval_of_sets_is_students():
    rng = np.random.default_rng(3)
    drawn = rng.normal(0.9, 0.01, (4000, 8))
    low, high = asked.set_interval(drawn[0])
    known = stats.t.interval(0.95, 7, drawn[0].mean(), stats.sem(drawn[0]))
    assert (low, high) == pytest.approx(known)
    found = np.array([asked.set_interval(shares) for shares in drawn])
    held = ((found[:, 0] <= 0.9) & (found[:, 1] >= 0.9)).mean()
    # Four standard deviations of the share of 4000.
    assert held == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / 4000))


def test_a_place_is_within_where_no_limit_is_exceeded():
    ones = np.ones(3)
    errors = asked.Errors(ones, ones, ones, np.array([0.1, 0.3, 0.1]), ones, np.array([1, 1, 4.0]))
    relative = asked.relative_errors(errors, asked.Limits(horizontal=0.2, heading=2.0))
    np.testing.assert_allclose(relative, [0.5, 1.5, 2.0])
    assert asked.share_within(relative) == pytest.approx(1 / 3)
    assert not asked.Limits().any()


# --- choices of candidates -----------------------------------------------------------------------


@pytest.mark.parametrize("survive", [0, 1])
def test_values_are_those_of_plain_loops(survive):
    pool = stock()
    sides = set()
    for count in (4, 5, 7, 9):
        for chosen in ([*range(count)], [*range(9 - count, 9)]):
            plain, found = (
                plain_value(pool, chosen, survive),
                stock_search.value(pool, chosen, survive),
            )
            assert found == pytest.approx(plain, rel=1e-9)
            sides.add(plain < 0)
    assert sides == {True, False}


@pytest.mark.parametrize("survive", [0, 1])
def test_every_choice_is_tried(survive):
    pool = stock(1, 7)
    best, least = stock_search.all_choices(pool, 4, 1, survive)
    values = {
        chosen: stock_search.value(pool, chosen, survive)
        for chosen in itertools.combinations(range(7), 4)
        if 0 in chosen
    }
    assert tuple(best) == min(values, key=values.__getitem__)
    assert least == pytest.approx(min(values.values()), rel=1e-12)


@pytest.mark.parametrize("survive", [0, 1])
def test_exchanges_come_close_to_the_best_of_all_choices(survive):
    close = []
    for seed in range(5):
        pool = stock(seed)
        _, least = stock_search.all_choices(pool, 5, 0, survive)
        *_, (chosen, first) = stock_search.grown(pool, [], 5, survive)
        found, reached = stock_search.swapped(pool, chosen, 0, survive)
        assert len(set(found)) == 5
        assert reached == pytest.approx(stock_search.value(pool, found, survive), rel=1e-9)
        assert least - 1e-9 <= reached <= first + 1e-9
        # A tenth of the shortfall, or of b.
        close.append(reached <= least + 0.1)
    # Exchanges of single anchors may stop before the best choice, mostly of layouts that survive.
    assert sum(close) >= (3 if survive else 5)


def test_kept_anchors_stay():
    pool = stock(2)
    found, _ = stock_search.swapped(pool, [3, 1, 7, 0], keep=2)
    assert found[:2] == [3, 1]
    fewer, reached = stock_search.dropped(pool, [3, 1, 7, 0, 5], keep=4)
    assert fewer == [3, 1, 7, 0]
    assert reached == stock_search.value(pool, fewer)


def test_exchanges_save_what_the_requirement_leaves_to_spare():
    pool = stock(0, limits=asked.Limits(0.2, math.inf, math.radians(9)))
    chosen, reached = stock_search.swapped(pool, [*range(7)])
    assert reached < 0
    saved = stock_search.cheaper(pool, chosen)
    assert stock_search.value(pool, saved) < 0
    assert pool.cost[saved].sum() < pool.cost[chosen].sum()


def test_without_requirements_b_is_made_small():
    pool = stock(1, limits=asked.Limits())
    squares = []
    for zone, part in zip(pool.zones, pool.parts, strict=True):
        F = zone.prior + part[[0, 3, 4, 8]].sum(axis=0)
        squares.append(np.mean([plain_errors(f, zone.rotation, TAGS)[2] ** 2 for f in F]))
    b = np.sqrt(np.mean(squares))
    assert stock_search.value(pool, [0, 3, 4, 8]) == pytest.approx(math.log(b) - 100)


def test_the_shortfall_is_zero_only_if_the_share_is_within():
    relative = np.array([0.4, 3.0, 1.0, 0.7, 0.9])
    assert asked.shortfall(relative, 0.8) == 0
    assert asked.shortfall(relative, 0.81) == pytest.approx(
        0.3 * 2 / 3 + 0.7 / 5 + 0.1 * math.log(3) / 5
    )
    # What is far beyond its limit costs little more than what is beyond it.
    assert asked.shortfall(np.full(5, 100.0), 1.0) < 1.5
    many = np.stack([relative, 2 * relative])
    np.testing.assert_array_equal(
        asked.shortfall(many, 1.0), [asked.shortfall(one, 1.0) for one in many]
    )
