"""Answers of `place`: verdicts of zones, least numbers, contributions of anchors, given layouts."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json
import math

import numpy as np
import pytest

pytest.importorskip("shapely", reason="needs the extra placement")

from typing import Any

from scipy import stats

from rbl_gym import estimators
from rbl_gym.app import place_answer, place_report
from rbl_gym.app.cli import main
from rbl_gym.app.tables import new_console, new_table
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.placement import scene_files
from rbl_gym.studies.placing import (
    accuracy,
    choosing,
    contributions,
    judging,
    links,
    ranking,
    requirements,
)
from tests.helpers import Told, needs

# Ten brackets in a room of 12 x 8 m with a cupboard and a thin wall.
BRACKETS = [
    [0, 0.5, 2.7], [6, 0, 2.6], [12, 1, 0.4], [12, 7, 2.7], [6, 8, 2.5],
    [0, 7, 0.5], [3, 0, 0.6], [9, 8, 0.5], [0, 4, 2.8], [12, 4, 2.8],
]  # fmt: skip
ROOM: dict[str, Any] = {
    "name": "room",
    "anchors": {"number": 6},
    "mounts": [
        {"kind": "points", "points": BRACKETS[:6], "name": "steel", "cost": 2.0},
        {"kind": "points", "points": BRACKETS[6:], "name": "wood"},
    ],
    "walls": [{"line": [[4, 3], [8, 3]], "thickness_m": 0.1, "low_m": 0, "high_m": 3,
               "information": 0.5}],
    "obstacles": [{"low": [2, 5, 0], "high": [3.5, 5.5, 1.8]}],
    "zones": [
        {"name": "hall", "low": [1, 1, 0.3], "high": [7, 7, 1.5], "attitude": "level",
         "position_m": 0.075, "heading_deg": 6.5, "share": 0.9, "weight": 2.0},
        {"name": "bay", "polygon": [[8, 1], [11, 1], [11, 7], [9, 7]], "low_m": 0.3,
         "high_m": 1.0, "position_m": 0.09, "share": 0.8},
    ],
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.08},
}  # fmt: skip


pytestmark = pytest.mark.usefixtures("coarse_design")


def room(**zones_have):
    tables = copy.deepcopy(ROOM)
    for zone in tables["zones"]:
        zone.update(zones_have)
    return scene_files.of_mapping(tables)


def mounts(*chosen):
    return np.array(BRACKETS, dtype=float)[list(chosen)]


# --- verdicts ------------------------------------------------------------------------------------


def test_a_zone_is_judged_by_its_places():
    problem = room()
    anchors = mounts(0, 1, 2, 3, 5, 7, 8)
    for zone, judged in zip(problem.zones, judging.judge(problem, anchors, 0), strict=True):
        assert zone.contains(judged.places).all()
        assert not problem.obstacles.contain(judged.places).any()
        found = accuracy.accuracy(problem, anchors, judged.places, zone)
        within = found.horizontal <= (zone.position_m or math.inf)
        within &= np.rad2deg(found.heading) <= (zone.heading_deg or math.inf)
        row = judging.short_row(judged)
        assert row["share"] == within.mean()
        low, high = stats.binomtest(int(within.sum()), len(within)).proportion_ci(method="wilson")
        assert [row["share_low"], row["share_high"]] == pytest.approx([low, high])
        verdict = "pass" if low >= zone.share else "fail" if high < zone.share else "undecided"
        assert row["verdict"] == verdict
        assert row["pass"] == {"pass": True, "fail": False, "undecided": None}[verdict]


def test_more_places_are_drawn_until_a_zone_is_decided():
    problem = room()
    anchors = mounts(0, 1, 2, 3, 5, 7, 8)
    first = judging.judge_zone(problem, problem.zones[0], anchors, 0, most=judging.PLACES)
    # So close to what is asked that the first places cannot tell.
    near = room(share=round(judging.short_row(first)["share"] - 0.01, 3)).zones[0]
    first = judging.judge_zone(problem, near, anchors, 0, most=judging.PLACES)
    assert first.verdict == "undecided"
    assert len(first.places) == judging.PLACES
    judged = judging.judge_zone(problem, near, anchors, 0)
    assert judging.PLACES < len(judged.places) <= judging.MOST_PLACES
    assert judged.verdict != "undecided" or len(judged.places) == judging.MOST_PLACES
    np.testing.assert_array_equal(judged.places[: judging.PLACES], first.places)
    some = judged.errors.of_places(slice(judging.PLACES))
    np.testing.assert_array_equal(some, first.errors)
    widths = [high - low for low, high in (first.interval, judged.interval)]
    assert widths[1] < 0.75 * widths[0]


def test_positions_fill_a_zone_evenly_and_outside_obstacles():
    problem = room()
    zone = problem.zones[0]
    rng = np.random.default_rng(0)
    low, high = zone.bounds()
    corner = low + 0.5 * (high - low)
    shares = []
    for draw in (accuracy.draw_places, accuracy.spread_places):
        sets = [draw(problem, zone, rng, 600) for _ in range(60)]
        for places in sets:
            assert accuracy.is_free(problem, zone, places).all()
        shares.append([(places < corner).all(axis=-1).mean() for places in sets])
    # The mean is the same within four standard deviations; even sets vary much less.
    means, deviations = np.mean(shares, axis=1), np.std(shares, axis=1)
    assert abs(means[0] - means[1]) < 4 * deviations[0] / math.sqrt(60)
    assert deviations[1] < 0.5 * deviations[0]


def test_a_flat_zone_is_judged_and_drawn_at_its_height():
    tables = copy.deepcopy(ROOM)
    for zone in tables["zones"]:
        zone |= {"height_m": 0.2}
    tables["zones"][0]["low"][2] = tables["zones"][0]["high"][2] = 0.5
    tables["zones"][1]["low_m"] = tables["zones"][1]["high_m"] = 0.8
    problem = scene_files.of_mapping(tables)
    anchors = mounts(0, 1, 2, 3, 5, 7, 8)
    for judged, height in zip(judging.judge(problem, anchors, 0), (0.5, 0.8), strict=True):
        assert (judged.places[:, 2] == height).all()
        assert (judging.at_edges(problem, anchors, judged).places[:, 2] == height).all()
        assert accuracy.accuracy_map(problem, anchors, zone=judged.zone).at == height
        # The height is estimated, although the zone has only one.
        assert (judged.errors.height > 0.01).all()


def test_layouts_are_judged_side_by_side_at_the_same_positions():
    problem = room()
    one, other = mounts(0, 1, 2, 3, 5, 7, 8), mounts(0, 2, 4, 5, 9)
    for survive in (0, 1):
        judged = judging.judge(problem, one, 0, survive, most=judging.PLACES)
        got = judging.judge_beside(problem, other, judged, survive)
        want = judging.judge(problem, other, 0, survive, most=judging.PLACES)
        assert [judging.short_row(x) for x in got] == [judging.short_row(x) for x in want]


def test_a_zone_passes_at_the_limits_that_would_pass_and_not_below():
    problem = room()
    judged = judging.judge(problem, mounts(0, 1, 2, 3, 5), 0)[0]
    needs: Any = judging.would_pass(judged)
    zone, errors = judged.zone, judged.errors
    limits = judging.limits_of(zone)
    for factor in (1.0, 0.999):
        scaled = requirements.Limits(*(factor * needs["factor"] * x for x in limits))
        share = (requirements.relative_errors(errors, scaled) <= 1 + 1e-12).mean()
        assert (share >= zone.share) == (factor == 1)
    assert 1 / needs["factor"] == judging.short_row(judged)["margin"]
    heading_kept = np.rad2deg(errors.heading) <= zone.heading_deg
    if needs["position_m"] is None:
        assert heading_kept.mean() < zone.share
    else:
        share = (heading_kept & (errors.horizontal <= needs["position_m"] * (1 + 1e-12))).mean()
        assert share >= zone.share


def test_a_known_tilt_tells_as_much_as_the_four_other_numbers():
    problem, anchors = room(attitude="heading"), mounts(0, 1, 3, 5, 7, 9)
    zone = problem.zones[0]
    places = judging.judge_zone(problem, zone, anchors, 0).places[:20]
    found = accuracy.accuracy(problem, anchors, places, zone)
    rotation = requirements.turns("heading", accuracy.TURNS)
    F = links.layout_information(problem, anchors, places, rotation)
    parts = links.anchor_information(problem, anchors, places, rotation)
    np.testing.assert_allclose(parts.sum(axis=0), F, rtol=1e-9, atol=1e-9 * np.abs(F).max())
    F = F + accuracy.prior_of(problem, zone)
    four = np.linalg.inv(F[..., 2:, 2:])
    for values, square in (
        (found.heading, four[..., 0, 0]),
        (found.horizontal, four[..., 1, 1] + four[..., 2, 2]),
        (found.height, four[..., 3, 3]),
    ):
        np.testing.assert_allclose(values, np.sqrt(square.mean(axis=-1)), rtol=1e-5)


def test_the_predicted_share_is_that_of_maximum_likelihood():
    """Places whose error by `locate` over many epochs is within: to three standard deviations."""
    tables = copy.deepcopy(ROOM)
    tables["noise"]["floor_m"] = 0.02
    problem, rng = scene_files.of_mapping(tables), np.random.default_rng(5)
    zone, anchors = problem.zones[0], mounts(0, 1, 2, 3, 5, 7, 8)
    n_places, epochs = 60, 90
    errors = judging.judge_zone(problem, zone, anchors, 0, most=1).errors
    position_m = float(np.quantile(errors.horizontal, 0.7))
    heading_rad = float(np.quantile(errors.heading, 0.8))
    zone = dataclasses.replace(zone, position_m=position_m, heading_deg=math.degrees(heading_rad))
    judged = judging.judge_zone(problem, zone, anchors, 0, most=1)
    places = judged.places[:n_places]
    rotation = requirements.turns(zone.attitude, accuracy.TURNS)
    share = links.link_shares(problem, anchors, places, rotation)
    turns = np.tile(np.arange(accuracy.TURNS), epochs // accuracy.TURNS)
    Q = np.broadcast_to(rotation[turns], (n_places, len(turns), 3, 3))
    t = np.broadcast_to(places[:, None], (*Q.shape[:2], 3))
    distance = ranging.distances(anchors, ranging.tag_positions(Q, t, problem.tags))
    std = 0.02 / np.sqrt(share[:, turns])
    ranges = distance + std * rng.standard_normal(distance.shape)
    found = estimators.locate(ranges, anchors, problem.tags, ranging.LinkNoise(std))
    off = found.translation - t
    turned = rotations.log(found.rotation @ np.swapaxes(Q, -1, -2))
    # A pose in the mirror image is no small error: there must be none of them here.
    assert np.abs(turned).max() < 0.5
    horizontal = np.sqrt((off[..., :2] ** 2).sum(-1).mean(-1))
    heading = np.sqrt((turned[..., 2] ** 2).mean(-1))
    within = (horizontal <= position_m) & (heading <= heading_rad)
    # By the predicted errors: the chance of each place that its mean square over so many epochs
    # is within, two axes of position (as if alike) and one of heading.
    n, errors = len(turns), judged.errors.of_places(slice(n_places))
    chance = stats.chi2.cdf(2 * n * (position_m / errors.horizontal) ** 2, 2 * n)
    chance *= stats.chi2.cdf(n * (heading_rad / errors.heading) ** 2, n)
    predicted = (judged.relative[:n_places] <= 1).mean()
    assert 0.2 < predicted < 0.9
    spread = np.sqrt((chance * (1 - chance)).sum()) / n_places
    assert abs(within.mean() - chance.mean()) < 3 * spread
    # Places near the limit fall on either side of it alike.
    assert abs(within.mean() - predicted) < 3 * spread + abs(chance.mean() - predicted)
    assert abs(chance.mean() - predicted) < 0.1


# --- what anchors are for ------------------------------------------------------------------------


def test_without_an_anchor_is_the_layout_of_the_others():
    problem, anchors = room(), mounts(0, 1, 3, 5, 7, 9)
    judged = judging.judge(problem, anchors, 0, most=judging.PLACES)
    lost = [
        accuracy.accuracy_without_each(problem, anchors, one.places, one.zone) for one in judged
    ]
    rows = contributions.without_each(judged, lost)
    for k, row in enumerate(rows):
        others = judging.judge(problem, np.delete(anchors, k, axis=0), 0, most=judging.PLACES)
        squares = [zone.weight * (one.errors.score**2).mean() for zone, one in zip(
            problem.zones, others, strict=True)]  # fmt: skip
        assert row["score_m"] == pytest.approx(np.sqrt(sum(squares) / 3))
        for one, left in zip(others, row["zones"], strict=True):
            short = judging.short_row(one)
            assert left["share"] == short["share"]
            assert left["position_m"] == pytest.approx(short["rms_position_m"])
            assert left["heading_deg"] == pytest.approx(short["rms_heading_deg"])


def test_surviving_is_judged_by_the_anchor_that_is_missed_most():
    problem, anchors = room(), mounts(*range(9))
    for zone in problem.zones:
        judged = judging.judge_zone(problem, zone, anchors, 0, 1, judging.PLACES)
        shares = []
        for k in range(len(anchors)):
            left = np.delete(anchors, k, axis=0)
            one = judging.judge_zone(problem, zone, left, 0, 0, judging.PLACES)
            shares.append(judging.short_row(one)["share"])
        row = judging.short_row(judged)
        assert row["share"] == min(shares)
        assert shares[row["without_anchor"] - 1] == min(shares)


def test_one_more_anchor_goes_where_it_helps_most():
    problem, chosen = room(), [0, 1, 3, 5, 7]
    found = choosing.next_anchor(problem, mounts(*chosen), 0)
    assert found is not None
    place = found
    scores = {
        k: ranking.rank(judging.judge(problem, mounts(*chosen, k), 0, most=judging.PLACES))
        for k in range(10)
        if k not in chosen
    }
    reached = scores[int(np.abs(np.array(BRACKETS) - place).sum(axis=1).argmin())]
    # With it all zones pass, so b counts. The choice is made over fewer places.
    assert reached[:2] == (False, 0.0)
    assert reached[2] < 1.05 * min(one[2] for one in scores.values())
    assert reached[2] < np.median([one[2] for one in scores.values()])
    assert choosing.next_anchor(problem, mounts(*range(10)), 0) is None


def test_exchanges_meet_requirements_first_and_then_make_b_small():
    problem = room(position_m=0.09, heading_deg=8.0)
    starts = [mounts(0, 1, 2, 3, 4, 6, 7), mounts(3, 4, 5, 6, 7, 8, 9)]

    def rank(anchors):
        return ranking.rank(judging.judge(problem, anchors, 0))

    found = choosing.meeting(problem, starts, 0)
    np.testing.assert_array_equal(found, choosing.meeting(problem, starts, 0))
    assert rank(found) <= min(map(rank, starts))
    of_all = [rank(mounts(*chosen)) for chosen in itertools.combinations(range(10), 7)]
    assert not rank(found)[0]
    # Of those that pass, its b is among the smallest tenth.
    passing = sorted(b for fails, _, b in of_all if not fails)
    assert rank(found)[2] <= passing[len(passing) // 10]


def test_with_too_few_anchors_a_zone_that_can_be_met_is_met():
    # The bay's limit is out of reach of any choice; the hall's is not.
    tables = copy.deepcopy(ROOM)
    tables["zones"][1]["position_m"] = 0.001
    problem = scene_files.of_mapping(tables)
    found = choosing.meeting(problem, [mounts(*range(8))], 0)
    hall, bay = judging.judge(problem, found, 0)
    assert (hall.verdict, bay.verdict) == ("pass", "fail")


# --- the least number ----------------------------------------------------------------------------


@pytest.mark.parametrize(("survive", "count", "position_m"), [(0, 10, 0.075), (1, 8, 0.1)])
def test_the_least_number_is_that_of_an_exhaustive_search(survive, count, position_m):
    tables = copy.deepcopy(ROOM)
    tables["mounts"][1]["points"] = BRACKETS[6:count]
    for zone in tables["zones"]:
        zone["position_m"] = position_m
    problem = scene_files.of_mapping(tables)
    found = choosing.fewest_anchors(problem, range(3, count + 1), 0, survive)
    assert isinstance(found, choosing.Fewest)
    assert found.met
    assert choosing.is_met(judging.judge(problem, found.anchors, 0, survive))
    least = len(found.anchors)
    # No choice of one less passes.
    for chosen in itertools.combinations(range(count), least - 1):
        verdicts = (
            judging.judge_zone(problem, zone, mounts(*chosen), 0, survive).verdict
            for zone in problem.zones
        )
        assert not all(verdict == "pass" for verdict in verdicts), chosen
    assert found.proved
    assert found.one_less is not None
    assert len(found.one_less) == least - 1
    assert not choosing.is_met(found.judged_less)


def test_fixed_anchors_count_and_stay():
    tables = copy.deepcopy(ROOM)
    tables["anchors"]["fixed"] = [[6.0, 4.0, 2.9]]
    problem = scene_files.of_mapping(tables)
    told = Told()
    found = choosing.fewest_anchors(problem, range(3, 11), 0, 0, told)
    assert told.done == told.announced > 0
    assert found.met
    np.testing.assert_array_equal(found.anchors[0], [6, 4, 2.9])


def test_the_cheapest_of_the_least_number_is_taken():
    problem = room(position_m=0.2, heading_deg=20.0)
    found = choosing.fewest_anchors(problem, range(5, 11), 0)
    assert len(found.anchors) == 5
    assert found.one_less is None
    # Four are of wood, at half the price.
    assert problem.mounts.cost(found.anchors).sum() == 6


def test_what_cannot_be_met_is_said():
    found = choosing.fewest_anchors(room(), range(3, 4), 0)
    assert not found.met
    assert len(found.anchors) == 3
    # Not even with an anchor at every bracket: no search begins.
    problem, told = room(position_m=0.001), Told()
    with pytest.raises(ValueError, match="no number of anchors meets the requirements") as error:
        choosing.fewest_anchors(problem, range(3, 9), 0, 0, told)
    assert told.announced == 0
    for judged in judging.judge(problem, mounts(*range(10)), 0, most=judging.PLACES):
        factor = judging.would_pass(judged)["factor"]
        assert (
            f"zone {judged.zone.name!r} would pass only with limits {factor:.3g} times as large "
            "(hardest to meet: position_m = 0.001)"
        ) in str(error.value)
    with pytest.raises(ValueError, match="fewest needs a requirement"):
        choosing.fewest_anchors(scene_files.problem("uwb_room"), range(3, 9), 0)


# --- the command ---------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path):
    scene, layout = tmp_path / "room.json", tmp_path / "mine.csv"
    scene.write_text(json.dumps(ROOM))
    names = "abcdef"
    rows = [f"{n},{x},{y},{z}" for n, (x, y, z) in zip(names, BRACKETS, strict=False)]
    layout.write_text("\n".join(["name,x_m,y_m,z_m", *rows]))
    return ["place", "--scene", str(scene), "--trials", "40"], str(layout)


def run(capsys, *options):
    assert main([*options, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_my_layout_is_judged(files, capsys):
    command, layout = files
    result = run(capsys, *command, "--layout", layout)
    assert [anchor["name"] for anchor in result["anchors"]] == [*"abcdef"]
    assert [[anchor[k] for k in ("x_m", "y_m", "z_m")] for anchor in result["anchors"]] == (
        BRACKETS[:6]
    )
    assert result["method"] == "given"
    assert {anchor["mount"].split()[0] for anchor in result["anchors"]} == {"steel"}
    assert result["cost"] == 12
    judged = judging.judge(room(), mounts(*range(6)), 0)
    assert [row["share"] for row in result["zones"]] == [
        judging.short_row(one)["share"] for one in judged
    ]
    assert main([*command, "--layout", layout, "--details"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(place_report.verdict(result))
    assert shown.split(":")[0] in ("PASS", "FAIL", "TOO CLOSE TO TELL")
    for text in (
        "what each anchor is for",
        "one more anchor would help most",
        "cost of the mounts",
    ):
        assert text in shown


def test_all_tables_use_the_positions_of_the_verdict(files, capsys):
    command, layout = files
    result = run(capsys, *command, "--layout", layout)
    shares = [zone["share"] for zone in result["zones"]]
    for rows in (result["next_anchor"]["zones_now"], result["layouts"]["given"]["zones"]):
        assert [zone["share"] for zone in rows] == shares
    assert list(result["survey"][0]["within"].values()) == shares
    for anchor in result["anchors"]:
        left = [zone["share"] for zone in anchor["without"]["zones"]]
        assert all(np.array(left) <= shares)


def test_some_of_my_anchors_stay_and_the_others_move(files, capsys):
    command, layout = files
    options = ["--layout", layout, "--optimise", "--keep", "b,4"]
    result = run(capsys, *command, *options)
    kept = {a["name"]: [a["x_m"], a["y_m"], a["z_m"]] for a in result["anchors"] if a["fixed"]}
    assert kept == {"b": BRACKETS[1], "d": BRACKETS[3]}
    assert result["n_anchors"] == 6
    more = run(capsys, *command, "--layout", layout, "--optimise", "--keep", "all",
               "--anchors", "8")  # fmt: skip
    assert [anchor["name"] for anchor in more["anchors"][:6]] == [*"abcdef"]
    assert more["n_anchors"] == 8
    # No bracket holds two.
    places = {tuple(anchor[k] for k in ("x_m", "y_m", "z_m")) for anchor in more["anchors"]}
    assert len(places) == 8
    given = run(capsys, *command, "--layout", layout)
    # All three pass, so the search makes b small.
    reached = [x["predicted"]["score_m"]["rms"] for x in (given, result, more)]
    assert reached[0] >= reached[1] > reached[2]


def test_the_least_number_by_the_command(files, capsys):
    command, _ = files
    result = run(capsys, *command, "--fewest")
    fewest = result["fewest"]
    assert result["verdict"] == "pass"
    assert fewest["met"]
    assert fewest["proved"]
    assert fewest["margin"] >= 1
    assert fewest["one_less"]["n_anchors"] == result["n_anchors"] - 1
    failing = [zone for zone in fewest["one_less"]["zones"] if zone["verdict"] != "pass"]
    assert failing
    assert place_report.verdict(result).endswith(" passes.")
    assert main([*command, "--fewest"]) == 0
    assert "with one anchor fewer" in capsys.readouterr().out


def test_a_layout_that_survives(files, capsys):
    command, _ = files
    result = run(capsys, *command, "--anchors", "8", "--survive", "1")
    assert result["survive"] == 1
    for zone in result["zones"]:
        assert 1 <= zone["without_anchor"] <= 8
    assert "with any one anchor missing" in place_report.verdict(result)


def test_a_zone_that_is_too_close_to_tell_is_explained():
    row = {
        "name": "aisle", "verdict": "undecided", "places": 9600, "share": 0.9506,
        "share_low": 0.9461, "share_high": 0.9548, "required": {"share": 0.95},
    }  # fmt: skip
    (warning,) = place_answer.warnings(
        {
            "notes": [],
            "coplanar": False,
            "layouts": {},
            "zones": [row, {"verdict": "pass"}],
            "check": {"filters": {}},
        }
    )
    assert warning.startswith(
        "aisle is too close to tell: 95.1 % of 9600 places are within the limits (95 % interval "
        "94.61 to 95.48 %), and 95 % must be."
    )
    result = {"survive": 0, "n_anchors": 6, "verdict": "undecided", "zones": [row], "layouts": {}}
    assert place_report.verdict(result) == "TOO CLOSE TO TELL: 6 anchors, 0 of 1 zones pass."


def test_a_check_that_contradicts_the_prediction_is_told():
    good = {"found": 1.0, "holds": True, "position_ratio": 1.0, "rotation_ratio": 1.0}
    bad = good | {"holds": False, "position_ratio": 3.7}
    result = {
        "notes": [],
        "coplanar": False,
        "layouts": {},
        "zones": [],
        "check": {"filters": {"a": good, "b": bad}},
    }
    (warning,) = place_answer.warnings(result)
    assert "the errors of 'b' are 3.7 times the predicted ones" in warning
    assert "mirror" not in warning
    result["check"]["filters"] = {"a": good, "b": bad | {"found": 0.986}}
    *_, warning = place_answer.warnings(result | {"coplanar": True, "n_anchors": 3})
    assert "'b' has no pose or a wrong one for 1.4 % of the bodies; see the table" in warning
    assert warning.endswith("Probable cause: the mirror image behind the plane of the anchors.")
    # A filter that does not know the blocked links says nothing about the prediction.
    result["check"]["filters"] = {"a": good, "a, not told": bad}
    assert place_answer.warnings(result) == []


@needs("rich")
@pytest.mark.parametrize("width", [60, 80, 100, 130])
def test_no_heading_of_the_check_is_cut(capsys, width):
    parts = ("position", "m"), ("rotation", "deg")
    row = {"found": 1.0, "holds": False, "nees": 123.4, "zones": []} | {
        key: 0.012345
        for name, unit in parts
        for key in (f"{name}_rmse_{unit}", f"{name}_p95_{unit}", f"{name}_predicted_{unit}")
    }
    row |= {f"{name}_ratio": 3.755 for name, _ in parts}
    check = {"trials": 500, "filters": {"iterated EKF, not told": row}}
    rows = place_report._check(check)
    table = new_table(rows.title, rows.headings[:1], rows.headings[1:], whole=1)
    table.add_row(*rows.rows[0])
    new_console(width).print(table)
    shown = capsys.readouterr().out
    assert "…" not in shown
    assert max(map(len, shown.splitlines())) <= width
    assert all(word in shown for heading in rows.headings for word in heading.split())
    assert all(cell in shown for cell in rows.rows[0])


def test_the_verdict_says_what_to_do_next():
    result = {"survive": 0, "n_anchors": 6, "verdict": "fail", "zones": [{"verdict": "fail"}]}
    said = place_report.verdict(result | {"layouts": {"designed": {}}})
    assert said == "FAIL: 6 anchors, 0 of 1 zones pass. Try --fewest, or more --anchors."
    said = place_report.verdict(result | {"layouts": {"given": {}}})
    assert said.endswith("Try --optimise, or more --anchors.")
    figures = {"position_m": {"median": 0.1}, "heading_deg": {"median": 3.0}}
    said = place_report.verdict(
        {"survive": 0, "n_anchors": 6, "verdict": "no requirement", "zones": [figures]}
    )
    assert said == (
        "6 anchors: typical error horizontal position 0.1 m, heading 3 deg. No zone has a "
        "requirement."
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--keep", "a"], "--keep needs --layout"),
        (["--optimise"], "--optimise needs --layout"),
        (["--layout", "LAYOUT", "--fewest"], "--fewest searches for a layout"),
        (["--layout", "LAYOUT", "--keep", "a"], "--keep needs --optimise"),
        (["--layout", "LAYOUT", "--anchors", "7"], "--anchors with --layout needs --optimise"),
        (["--layout", "LAYOUT", "--optimise", "--keep", "z"], "--keep must name anchors"),
        (["--layout", "LAYOUT", "--optimise", "--anchors", "5"], "must be at least 6"),
        (["--anchors", "11"], "too few for the 11 anchors"),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_said(files, options, message, capsys):
    command, layout = files
    options = [layout if option == "LAYOUT" else option for option in options]
    assert main([*command, *options]) == 2
    assert message in capsys.readouterr().err
