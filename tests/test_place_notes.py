"""Notes of a placement: the requirement that decides, better usual layouts, a high NEES."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("shapely", reason="needs the extra placement")

from rbl_gym.app import (
    place_answer,
    place_figures,
    place_pdf,
    place_report,
    place_summary,
    place_svg,
)
from rbl_gym.app import place_shapes as shapes
from rbl_gym.app.place_notes import (
    cause_of,
    deciding_notes,
    lever_notes,
    nees_notes,
    through_walls_notes,
    usual_notes,
)
from rbl_gym.placement import scene_files
from rbl_gym.studies.placing import accuracy, check
from rbl_gym.studies.placing.answer import Question, place_anchors
from rbl_gym.studies.placing.given import given_notes, mount_names
from rbl_gym.studies.placing.judging import at_edges, judge, judge_beside, short_row, zone_row
from rbl_gym.studies.placing.layout_export import mounting_list
from rbl_gym.studies.placing.lever import lever_row

HALL = {
    "mounts": [{"kind": "ceiling", "polygon": [[0, 0], [12, 0], [12, 8], [0, 8]], "height_m": 3}],
    "zones": [
        {
            "name": "hall",
            "polygon": [[1, 1], [11, 1], [11, 7], [1, 7]],
            "low_m": 0.5,
            "high_m": 1.5,
            "attitude": "heading",
            "position_m": 0.5,
            "heading_deg": 2.0,
            "share": 0.9,
        }
    ],
    "body": {"tags": [[0.3, 0, 0], [-0.3, 0, 0]]},
    "noise": {"floor_m": 0.1},
    "anchors": {"number": 4},
}
ANCHORS = np.array([[0.5, 0.5, 3], [11.5, 0.5, 3], [11.5, 7.5, 3], [0.5, 7.5, 3.0]])


def judged_row(problem):
    (judged,) = judge(problem, ANCHORS, 0)
    return judged, short_row(judged)


def test_the_requirement_that_decides_and_the_distance_of_the_tags_that_meets_it():
    problem = scene_files.of_mapping(HALL)
    judged, row = judged_row(problem)
    decides = row["decides"]
    assert decides["requirement"] == "heading_deg"
    assert decides["limit"] == 2.0
    errors = np.sort(np.rad2deg(judged.judged.heading))
    assert decides["value"] == errors[int(np.ceil(0.9 * len(errors))) - 1]
    assert decides["value"] > 2 * judged.judged.horizontal.max() / 0.5
    (note,) = deciding_notes({"zones": [row], "tags_m": problem.tags.tolist()})
    assert note.startswith("The heading decides in zone 'hall': at 90 % of the positions ")
    needed = 0.6 * decides["value"] / 2
    assert f"that distance would have to be about {needed:.2f} m instead of 0.60 m" in note
    # With that distance the error is the limit: the rule holds to 5 %.
    tags = [[needed / 2, 0, 0], [-needed / 2, 0, 0]]
    wider = scene_files.of_mapping(HALL | {"body": {"tags": tags}})
    assert judged_row(wider)[1]["decides"]["value"] == pytest.approx(2.0, rel=0.05)


def test_requirements_that_only_fail_together():
    zone = {
        "name": "a", "verdict": "fail", "required": {"share": 0.95},
        "decides": {"requirement": "heading_deg", "value": 7.7, "limit": 8.0},
    }  # fmt: skip
    (note,) = deciding_notes({"zones": [zone], "tags_m": [[0, 0, 0]]})
    assert note == (
        "The heading decides in zone 'a': at 95 % of the positions 7.70 deg (required: 8 deg), but "
        "at other positions other requirements are missed."
    )


def test_a_position_that_decides_with_one_anchor_less():
    zone = {
        "name": "a", "verdict": "fail", "required": {"share": 0.95},
        "decides": {"requirement": "position_m", "value": None, "limit": 0.3},
    }  # fmt: skip
    result: dict[str, Any] = {"zones": [zone | {"verdict": "pass"}], "tags_m": [[0, 0, 0]]}
    assert deciding_notes(result) == []
    result["fewest"] = {"one_less": {"n_anchors": 5, "zones": [zone]}}
    assert deciding_notes(result) == [
        "With 5 anchors, the horizontal position decides in zone 'a': at 95 % of the positions it "
        "is not determined."
    ]


def trolley(attitude, shift=0.0):
    tags = [[0.5, 0, 1.1 - shift], [-0.5, 0.3, 1.1 - shift], [-0.5, -0.3, 1.1 - shift]]
    zone = HALL["zones"][0] | {"attitude": attitude, "low_m": shift, "high_m": shift + 0.02}
    return scene_files.of_mapping(HALL | {"zones": [zone], "body": {"tags": tags}})


def test_the_lever_of_the_tags_is_named():
    """The errors it promises are those of the files that are changed as it says."""
    problem, lower = trolley("level"), np.array([1, 1, 0.7])
    anchors = np.vstack([ANCHORS, ANCHORS[:2] * lower])
    (judged,) = judge(problem, anchors, 0)
    lever = lever_row(problem, anchors, judged)
    assert lever is not None
    centre = problem.tags.mean(axis=0)
    assert lever["distance_m"] == pytest.approx(np.linalg.norm(centre))
    assert lever["position_m"] > 3 * lever["at_tags_m"]
    (known,) = judge(trolley("heading"), anchors, 0)
    assert lever["known_tilt_m"] == np.quantile(known.judged.horizontal[:600], 0.95)
    # The tags are nearly above the origin: the zones differ by the height, and by 0.17 m sideways.
    (moved,) = judge(trolley("level", 1.1), anchors, 0)
    assert lever["at_tags_m"] == pytest.approx(np.quantile(moved.errors.horizontal, 0.95), rel=0.1)
    row = zone_row(judged, at_edges(problem, anchors, judged)) | {"lever": lever}
    (note,) = lever_notes({"zones": [row]})
    assert note.startswith("Most of the horizontal error in zone 'hall' is the tilt times the")
    assert "(1.11 m)" in note
    assert 'attitude = "heading"' in note
    # The origin at the tags, or a known tilt: nothing to say.
    for other in (trolley("level", 1.1), trolley("heading")):
        (judged,) = judge_beside(other, anchors, judge(other, anchors, 0))
        assert lever_notes({"zones": [row | {"lever": lever_row(other, anchors, judged)}]}) == []


def test_the_check_iterates_until_it_converges():
    """Four iterations from 0.5 m and 10 deg lost 4 of these 1000 bodies, far from any minimum."""
    precise = scene_files.of_mapping(
        HALL
        | {"zones": [HALL["zones"][0] | {"low_m": 0, "high_m": 0.02}]}
        | {"body": {"tags": trolley("heading").tags.tolist()}, "noise": {"floor_m": 0.01}}
    )
    heights = [[0, 0, 0], [0, 0, -1.2], [0, 0, 0], [0, 0, -1.2]]
    anchors = np.vstack([ANCHORS + heights, [6, 4, 3]])
    figures = check.check_layout(precise, anchors, 1000, 0)["filters"]["iterated EKF"]
    assert figures["found"] == 1
    assert figures["wrong"] is None
    assert figures["holds"]
    assert cause_of("a", figures) == ""


def test_the_cause_of_wrong_poses_is_named():
    """A mirror image above anchors of one height agrees with the ranges."""
    problem = trolley("heading", -1.3)
    above = scene_files.of_mapping(
        HALL
        | {"zones": [HALL["zones"][0] | {"low_m": 1.3, "high_m": 1.32, "name": "low hall"}]}
        | {"body": {"tags": problem.tags.tolist()}, "noise": {"floor_m": 0.03}}
    )
    figures = check.check_layout(above, ANCHORS, 600, 0)["filters"]["iterated EKF"]
    wrong = figures["wrong"]
    assert wrong["bodies"] == round(600 * (1 - figures["found"])) == wrong["fit"]
    assert wrong["zones"] == ["low hall"]
    assert wrong["height_m"] > 10 * wrong["horizontal_m"]
    text = cause_of("a", figures)
    assert text.startswith(f" Wrong poses of 'a': {wrong['bodies']}, in 'low hall'.")
    assert "The error is mainly in the height" in text
    assert "false minima" not in text
    far = figures | {"wrong": wrong | {"fit": 0, "bodies": 1}, "position_ratio_found": 1.02}
    assert cause_of("a", far) == (
        " Wrong poses of 'a': 1, in 'low hall'. 1 does not agree with the ranges: false minima, "
        "from a start that is too far away. Without them the position RMSE is 1.02 times the "
        "predicted one."
    )


def test_bodies_that_reach_through_a_wall_are_counted():
    # The zone ends at a thin wall; the tags are 0.3 m ahead and behind.
    wall = {"line": [[11, 0], [11, 8]], "high_m": 3.0, "thickness_m": 0.02, "material": "glass"}
    problem = scene_files.of_mapping(HALL | {"walls": [wall]})
    checked = check.check_layout(problem, ANCHORS, 400, 0)
    drawn = check.draw_bodies(problem, ANCHORS, 400, np.random.default_rng([0, 1]))
    ahead = np.abs(0.3 * drawn.rotation[:, 0, 0])
    through = (drawn.translation[:, 0] + ahead > 10.99).mean()
    assert 0 < through < 0.05
    assert checked["through_walls"] == [{"name": "hall", "share": through}]
    (note,) = through_walls_notes({"check": checked, "tags_m": problem.tags.tolist()})
    assert f"at {100 * through:.1f} % of the poses in 'hall'" in note
    assert "the farthest tag is 0.30 m from the origin" in note
    free = check.check_layout(scene_files.of_mapping(HALL), ANCHORS, 20, 0)
    assert through_walls_notes({"check": free, "tags_m": [[0, 0, 0]]}) == []


def layout(score_m, *verdicts):
    zones = [{"verdict": verdict, "share": 0.5} for verdict in verdicts]
    overall = "pass" if set(verdicts) == {"pass"} else "fail"
    return {"score_m": score_m, "verdict": overall, "zones": zones}


def test_a_usual_layout_that_passes_more_zones_or_has_a_much_smaller_b_is_named():
    layouts = {"designed": layout(1.2, "fail", "fail"), "grid": layout(1.0, "pass", "fail")}
    (note,) = usual_notes({"layouts": layouts})
    assert note.startswith(
        "The usual layout 'grid' passes more zones: 1 of 2 (the designed layout: 0). The"
    )
    layouts = {"designed": layout(1.2, "pass", "pass"), "ring": layout(0.12, "pass", "fail")}
    (note,) = usual_notes({"layouts": layouts})
    assert "b of the usual layout 'ring' is 10 times smaller, 0.120 m against 1.20 m" in note
    assert "layouts.ring.anchors_m" in note
    layouts["ring"] = layout(0.9, "pass", "pass")
    assert usual_notes({"layouts": layouts}) == []
    assert usual_notes({"layouts": {"given": layouts["designed"], "ring": layouts["ring"]}}) == []


def test_a_nees_that_is_too_large_is_told_although_the_errors_agree():
    row = {"found": 0.99, "holds": True, "nees": 19.94, "nees_found": 6.1}
    filters = {"iterated EKF": row, "iterated EKF, not told": row, "locate": row | {"nees": 6.9}}
    (note,) = nees_notes({"check": {"trials": 500, "filters": filters}})
    assert note.startswith("The NEES of 'iterated EKF' is 19.94, and should be near 6")
    assert "1 % of the bodies" in note
    assert note.endswith("the NEES of the others is 6.10.")


@pytest.mark.parametrize("survive", [0, 1])
def test_pictures_say_which_anchors_they_assume(survive):
    question = Question(range(4, 5), layout=ANCHORS, survive=survive, trials=20)
    placed = place_anchors(scene_files.of_mapping(HALL), question)
    figure = place_figures.place_figure(placed)
    *maps, chart = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(maps) >= 2
    words = "after the loss of the anchor that hurts most"
    assert all((words in title) == bool(survive) for title in maps)
    headline = place_answer.headline(placed.result)
    for text in (figure.get_suptitle(), chart, headline):
        assert ("with any one anchor missing" in text) == bool(survive)
    assert (words in place_svg.plan_part(placed)) == bool(survive)


def test_maps_and_table_of_the_worst_loss_at_each_place():
    question = Question(range(4, 5), layout=ANCHORS, survive=1, trials=20)
    placed = place_anchors(scene_files.of_mapping(HALL), question)
    problem = placed.problem
    (worst,) = shapes.maps_of(placed)
    each = [accuracy.accuracy_map(problem, np.delete(ANCHORS, k, axis=0)) for k in range(4)]
    for name in ("horizontal", "heading", "height"):
        largest = np.max([getattr(one, name) for one in each], axis=0)
        np.testing.assert_allclose(getattr(worst, name), largest, rtol=1e-6)
    (zone,) = placed.result["zones"]
    (judged,) = judge(problem, ANCHORS, 0, 1)
    assert judged.without is not None
    across = judged.without.horizontal / 0.5
    turned = np.rad2deg(judged.without.heading) / 2.0
    within = (np.maximum(across, turned) <= 1).all(axis=0).mean()
    assert zone["any_loss"]["share"] == within
    assert zone["any_loss"]["position_m"]["worst"] == judged.without.horizontal.max()
    assert zone["any_loss"]["share"] <= zone["share"]
    titles = [rows.title for rows in place_report.tables(placed.result)]
    assert titles[1] == "after the loss of the anchor that hurts most at each place"


def test_given_anchors_in_a_wall_or_just_off_a_mount_are_named():
    walls = {
        "mounts": [
            *HALL["mounts"],
            {"kind": "wall", "name": "west", "line": [[0, 8], [0, 0]], "low_m": 1, "high_m": 2.5},
        ],
        "walls": [{"line": [[0, 8], [0, 0]], "thickness_m": 0.2, "high_m": 3}],
        "obstacles": [{"low": [9, 0, 0], "high": [10, 0.5, 2]}],
    }
    problem = scene_files.of_mapping(HALL | walls)
    anchors = [[0.1, 2, 2], [0.15, 4, 2], [0.05, 5, 2], [9.5, 0.2, 1], [6, 4, 3], [6, 4, 1]]
    names = ["on", "off", "in", "box", "up", "free"]
    box, wall, off, free = given_notes(problem, np.array(anchors, float), names)
    assert wall.startswith("Anchor 'in' is inside a wall or an obstacle: x -0.10 to 0.10 m, y 0.00")
    assert box.startswith("Anchor 'box' is inside a wall or an obstacle: x 9.00 to 10.00 m")
    assert "'off' is 0.05 m from 'west' (nearest point of the mount: (0.100, 4.000, 2.000))." in off
    assert off.count("nearest") == 1
    assert free.startswith("Anchor 'free' at (6.000, 4.000, 1.000) is on no mount")
    placed = place_anchors(
        problem, Question(range(4, 5), layout=np.array(anchors[:4]), trials=4, survive=0)
    )
    assert sum("inside a wall" in note for note in place_answer.warnings(placed.result)) == 2
    assert place_answer.question(placed.result)[0] == "How good are these 4 anchors in 'file'?"


@pytest.mark.parametrize("side", ["left", "right", "both"])
@pytest.mark.parametrize("turned", [False, True])
def test_mounts_on_the_outside_of_a_wall_are_named(side, turned):
    line = [[0, 0], [12, 0]] if not turned else [[12, 0], [0, 0]]
    wall = {"line": line, "thickness_m": 0.2, "high_m": 3}
    mount = {"kind": "wall", "name": "south", "line": line, "low_m": 2, "high_m": 2.8}
    tables = {"walls": [wall], "mounts": [*HALL["mounts"], mount | {"side": side}]}
    notes = scene_files.of_mapping(HALL | tables).notes
    # The hall is at the left of a wall along +x.
    inside = "right" if turned else "left"
    if side in (inside, "both"):
        assert notes == ()
    else:
        assert notes == (
            "Anchors on 'south' (mounts[1]) see no zone, but on the other side of the line they "
            f'would: side is "{side}"; give side = "{inside}".',
        )


def test_given_anchors_on_no_mount_are_named_and_a_wrong_unit():
    problem = scene_files.of_mapping(HALL | {"anchors": {"number": 4, "fixed": [[6, 1, 2]]}})
    anchors = np.array([[0.5, 0.5, 3], [6, 4, 2.4], [15, 4, 3], [6, 1, 2], [1, 1, 3.005]])
    assert mount_names(problem, anchors) == ["ceiling 1", *["no mount"] * 3, "ceiling 1"]
    (note,) = given_notes(problem, anchors, list("abcde"))
    assert note == (
        "Anchor 'b' at (6.000, 4.000, 2.400) is on no mount: the nearest point of one is 0.60 m "
        "away (ceiling 1); anchor 'c' at (15.000, 4.000, 3.000) is on no mount: the nearest point "
        "of one is 3.00 m away (ceiling 1)."
    )
    (note,) = given_notes(problem, 1000 * ANCHORS, list("abcd"))
    assert note.endswith(" Are the positions in mm? The file must have metres.")
    (note,) = given_notes(problem, ANCHORS + 500, list("abcd"))
    assert "Check the unit and the origin" in note
    assert [row["mount"] for row in mounting_list(problem, anchors)][1:3] == ["no mount"] * 2


def test_the_first_page_has_all_zones_above_the_footnote(tmp_path):
    zones = [HALL["zones"][0] | {"name": name} for name in ("A", "B", "C", "D")]
    problem = scene_files.of_mapping(HALL | {"zones": zones})
    placed = place_anchors(
        problem, Question(range(4, 5), layout=ANCHORS, trials=4, survive=1, names=("P", "Q"))
    )
    page = place_pdf._title_page(placed.result)
    heights = {text.get_text(): text.get_position()[1] for text in page.texts}
    assert {"A", "B", "C", "D"} <= set(heights)
    assert heights["D"] - 0.04 > max(y for text, y in heights.items() if "Cramer" in text) + 0.02
    assert place_answer.question(placed.result)[0].endswith("in 'file', also if any one fails?")
    table = place_report.tables(placed.result)
    shown = next(one for one in table if "worst without" in one.headings)
    assert {row[-1] for row in shown.rows} <= {"1", "2", "3", "4"} | {"P", "Q"}


def test_one_tag_has_no_heading_anywhere(capsys):
    """The figure would be that of the prior, 60 deg."""
    zone = HALL["zones"][0] | {"position_m": 0.5, "share": 0.9}
    del zone["heading_deg"]
    problem = scene_files.of_mapping(HALL | {"zones": [zone], "body": {"tags": [[0, 0, 0]]}})
    placed = place_anchors(problem, Question(range(4, 5), layout=ANCHORS, trials=20))
    result = placed.result
    assert set(result["zones"][0]["heading_deg"].values()) == {None}
    assert [q.field for q in shapes.quantities(problem)] == ["horizontal"]
    for details in (False, True):
        place_summary.print_place(result, details)
    shown = capsys.readouterr().out
    texts = [page_text(page) for page in place_pdf.report_pages(placed)]
    assert "heading not determined" in " ".join(texts)
    for text in (shown, *texts):
        assert "60.0" not in text
    # Two tags determine it.
    two = scene_files.of_mapping(HALL)
    assert [q.field for q in shapes.quantities(two)] == ["horizontal", "heading"]


def page_text(page):
    return " ".join(text.get_text() for text in page.texts)


def test_the_table_of_zones_has_the_error_at_the_required_share(capsys):
    placed = place_anchors(
        scene_files.of_mapping(HALL), Question(range(4, 5), layout=ANCHORS, trials=4)
    )
    (zone,) = placed.result["zones"]
    (judged,) = judge(placed.problem, ANCHORS, 0)
    errors = np.sort(judged.judged.horizontal)
    assert zone["position_m"]["at_share"] == errors[int(np.ceil(0.9 * len(errors))) - 1]
    place_summary.print_place(placed.result)
    shown = capsys.readouterr().out
    assert "horizontal p90 (m)" in shown
    assert "p95" not in shown
    other = zone | {"required": zone["required"] | {"share": 0.8}}
    place_summary.print_place(placed.result | {"zones": [zone, other]})
    shown = capsys.readouterr().out
    assert "(p90)" in shown
    assert "(p80)" in shown


def test_a_lone_no_of_the_filter_that_is_not_told_is_explained():
    told, blind = {"holds": True}, {"holds": False}
    filters = {"iterated EKF": told, "iterated EKF, not told": blind}
    assert "does not contradict the verdict" in place_answer.only_not_told({"filters": filters})
    filters["iterated EKF"] = blind
    assert place_answer.only_not_told({"filters": filters}) == ""
