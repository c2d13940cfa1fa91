"""rbl-gym place: designs, predictions, the check by real filters, what is written and printed."""

from __future__ import annotations

import json
import re
import sys

import matplotlib
import numpy as np
import pytest

pytest.importorskip("plotly", reason="needs the extra viz")

from rbl_gym import bounds, estimators, placement
from rbl_gym.app import place_answer, place_figures, place_html, place_report, place_summary
from rbl_gym.app.cli import main
from rbl_gym.geometry import bodies, obstacles
from rbl_gym.placement import criteria, layouts, scene_files
from rbl_gym.studies.placing import accuracy, design, requirements
from rbl_gym.studies.placing import check as place_check
from rbl_gym.studies.placing.answer import Question, place_anchors
from rbl_gym.studies.placing.out_of_plane import exchange_out_of_plane
from tests.test_scene_files import GOOD

N_TRIALS = 60


pytestmark = pytest.mark.usefixtures("coarse_design")


@pytest.fixture(scope="module")
def with_rack():
    return scene_files.of_mapping(GOOD, name="small")


@pytest.fixture(scope="module")
def placed(with_rack, coarse_design):
    return place_anchors(with_rack, Question(range(4, 6), seed=1, trials=N_TRIALS))


# --- results -----------------------------------------------------------------------------------


def test_the_design_is_legal_and_no_usual_layout_is_better(placed):
    problem, layout, result = placed
    assert layout.anchors.shape == (5, 3)
    off = np.abs(problem.mounts.project(layout.anchors) - layout.anchors)
    assert off.max() < 1e-6
    assert not scene_files.inside(layout.anchors, problem.context.racks).any()
    assert list(result["layouts"]) == sorted(
        result["layouts"], key=lambda name: result["layouts"][name]["score_m"]
    )
    usual = design.usual_layouts(problem, 1)
    assert set(usual) == set(layouts.LAYOUTS)
    assert all(anchors.shape == (5, 3) for anchors in usual.values())
    assert set(result["layouts"]) == {"designed", *layouts.LAYOUTS}
    assert min(row["ratio"] for row in result["layouts"].values()) == 1
    assert result["layouts"]["random"]["ratio"] > 1.1


@pytest.mark.parametrize("scene", ["auv_buoys", "satellite", "icassp2013"])
def test_every_kind_of_legal_space(scene):
    problem = scene_files.problem(scene, 4)
    placed = place_anchors(problem, Question(range(4, 5), trials=20))
    anchors = placed.design.anchors
    assert np.abs(problem.mounts.project(anchors) - anchors).max() < 1e-3
    assert place_figures.place_figure(placed) is not None


def test_a_plane_and_a_line_are_regions_too():
    for high in ([7, 5, 1], [7, 1, 1]):
        problem = scene_files.problem("uwb_room", 4, ([1, 1, 1], high))
        found = place_anchors(problem, Question(range(4, 5), trials=20))
        assert place_figures.place_figure(found) is not None
        assert found.result["predicted"]["position_m"]["worst"] < 1


def test_more_anchors_are_better(placed):
    rows = placed.result["against_number"]
    assert [row["n_anchors"] for row in rows] == [4, 5]
    assert rows[1]["score_m"] < rows[0]["score_m"]
    assert rows[1]["score_m"] == placed.result["predicted"]["score_m"]["rms"]


def test_predictions_are_the_bound_at_each_place(placed):
    """With the sight of every tag by itself, by plain loops."""
    problem, layout, _ = placed
    places = np.array([[2.0, 2.0, 1.0], [6.5, 4.5, 0.5], [3.5, 4.3, 1.0]])
    found = accuracy.accuracy(problem, layout.anchors, places, problem.zones[0])
    for index, spot in enumerate(places):
        squares = []
        for turn in requirements.turns("free", accuracy.TURNS):
            tags = spot + problem.tags @ turn.T
            sight = obstacles.in_sight(layout.anchors, tags, problem.obstacles.boxes).T
            information = accuracy.prior_of(problem, problem.zones[0])
            for seen, share in ((sight, 1.0), (~sight, 0.01)):
                information = information + share * bounds.range_information(
                    layout.anchors, problem.tags, turn, spot, problem.noise, seen
                )
            P = np.linalg.inv(information)
            d = np.diag(P)
            squares.append([d[3:].sum(), d[:3].sum(), d[3] + d[4], d[5], d[2]])
        expected = np.sqrt(np.mean(squares, axis=0))
        errors = [found.position, found.rotation, found.horizontal, found.height, found.heading]
        np.testing.assert_allclose([values[index] for values in errors], expected)


def test_the_search_scores_over_free_poses(with_rack):
    places = placement.positions(with_rack, with_rack.context)
    assert places.shape == (64, 3)
    assert not scene_files.inside(places, with_rack.context.racks).any()
    low, high = with_rack.corners()
    assert ((places >= low) & (places <= high)).all()


def test_maps_leave_obstacles_out_and_agree_with_predictions(placed):
    problem, layout, _ = placed
    plan = accuracy.accuracy_map(problem, layout.anchors)
    assert plan.at == 1.0
    spot = [plan.columns[0], plan.rows[-1], plan.at]
    found = accuracy.accuracy(problem, layout.anchors, np.array([spot]), problem.zones[0])
    assert plan.position[-1, 0] == pytest.approx(found.position[0])
    assert plan.rotation[-1, 0] == pytest.approx(np.rad2deg(found.rotation[0]))
    column, row = (np.abs(axis - x).argmin() for axis, x in ((plan.columns, 3.5), (plan.rows, 2.5)))
    assert np.isnan(plan.position[row, column])
    assert np.isfinite(plan.position).mean() > 0.8


# --- the check ---------------------------------------------------------------------------------


@pytest.mark.parametrize("trials", [800, pytest.param(3000, marks=pytest.mark.long)])
def test_filters_reach_what_is_predicted(trials):
    # Four standard deviations of an RMSE along one axis, and of a mean NEES of 6 components.
    wide, wide_nees = 4 / (2 * trials) ** 0.5, 4 * (12 / trials) ** 0.5
    problem = scene_files.problem("uwb_room")
    anchors = np.array([[8, 6, 3], [5, 8, 0.3], [2, 6, 3], [2, 2, 3], [5, 0, 0.3], [8, 2, 3.0]])
    filters = place_check.check_layout(problem, anchors, trials, 0)["filters"]
    assert list(filters) == ["iterated EKF", "locate, from nothing"]
    for figures in filters.values():
        assert figures["found"] > 0.999
        assert figures["holds"]
        assert figures["position_ratio"] == pytest.approx(1, abs=wide)
        assert figures["rotation_ratio"] == pytest.approx(1, abs=wide)
        assert figures["nees"] == pytest.approx(6, abs=wide_nees)
        (zone,) = figures["zones"]
        assert zone["position_rmse_m"] == pytest.approx(zone["position_predicted_m"], rel=wide)
        assert zone["heading_rmse_deg"] == pytest.approx(zone["heading_predicted_deg"], rel=wide)
        assert "within" not in zone


def test_lost_bodies_count_in_the_figures():
    """Without a prior, half of the bodies below a ceiling are put above it: both are said."""
    flat = [[0.2, 0.15, 0], [-0.2, 0.15, 0], [-0.2, -0.15, 0], [0.2, -0.15, 0]]
    tables = {
        **GOOD,
        "obstacles": [],
        "region": {"low": [1, 1, 0.3], "high": [3, 2, 1.0]},
        "body": {"tags": flat},
        "noise": {"floor_m": 0.03},
    }
    problem = scene_files.of_mapping(tables)
    anchors = np.array([[0, 0, 2], [4, 0, 2], [4, 3, 2], [0, 3, 2], [1.3, 1, 2], [2.6, 2, 2.0]])
    check = place_check.check_layout(problem, anchors, 400, 0)
    found = check["filters"]["locate, from nothing"]
    # The side is a toss of a coin: within four standard deviations of a half.
    assert found["found"] == pytest.approx(0.5, abs=0.1)
    assert found["position_rmse_found_m"] < 0.2
    # A mirror pose is about 2 x 1.35 m off.
    assert 1.0 < found["position_rmse_m"] < 3.0
    assert found["position_p95_m"] > 2.0
    assert not found["holds"]


def test_blocked_links_are_noisier_by_what_is_left_of_their_information(with_rack):
    anchors = np.array([[0, 0, 1], [8, 6, 1], [0, 6, 2.5], [8, 0, 2.5], [4, 3, 3.0]])
    drawn = place_check.draw_bodies(with_rack, anchors, 800, np.random.default_rng(0))
    tags = np.array(with_rack.scene.tags)
    positions = drawn.translation[:, None] + tags @ np.swapaxes(drawn.rotation, -1, -2)
    error = drawn.ranges - np.linalg.norm(positions[:, None] - anchors[:, None], axis=-1)
    blocked = drawn.told.std_m > 0.5
    assert 0.02 < blocked.mean() < 0.5
    assert error[~blocked].std() == pytest.approx(0.1, rel=0.03)
    # A range is never negative, which cuts a little of the noise.
    assert error[blocked].std() == pytest.approx(1.0, rel=0.1)


def test_a_filter_that_is_not_told_does_worse(with_rack, placed):
    filters = place_check.check_layout(with_rack, placed.design.anchors, 1000, 0)["filters"]
    told, untold = filters["iterated EKF"], filters["iterated EKF, not told"]
    assert told["nees"] == pytest.approx(6, abs=0.6)
    assert untold["position_ratio"] > told["position_ratio"]


def test_links_without_information_are_not_measured(with_rack):
    tables = {**GOOD, "noise": {"floor_m": 0.1, "blocked_information": 0}}
    problem = scene_files.of_mapping(tables)
    anchors = np.array([[0, 0, 1], [8, 6, 1], [0, 6, 2.5], [8, 0, 2.5], [4, 3, 3.0]])
    drawn = place_check.draw_bodies(problem, anchors, 200, np.random.default_rng(0))
    assert not drawn.links.all()
    figures = place_check.check_layout(problem, anchors, 300, 0)["filters"]["iterated EKF"]
    assert figures["position_ratio_found"] == pytest.approx(1, abs=0.15)


# --- the command -------------------------------------------------------------------------------

COMMAND = ["place", "--scene", "uwb_room", "--anchors", "4", "--trials", "20", "--seed", "5"]


def test_the_command_writes_a_table_a_picture_a_page_and_figures(tmp_path, capsys):
    files = {end: tmp_path / "new" / f"x.{end}" for end in ("png", "html", "json")}
    options = ["--plot", str(files["png"]), "--html", str(files["html"]), "--json",
               str(files["json"]), "--details"]  # fmt: skip
    settings = dict(matplotlib.rcParams)
    assert main([*COMMAND, *options]) == 0
    assert dict(matplotlib.rcParams) == settings
    shown = capsys.readouterr().out
    for text in ("uwb_room: 4 anchors", "predicted over the region", "perimeter", "iterated EKF"):
        assert text in shown
    assert files["png"].stat().st_size > 50_000
    result = json.loads(files["json"].read_text())
    assert result["n_anchors"] == len(result["anchors"]) == 4


def test_the_figures_have_these_names(placed):
    result = json.loads(json.dumps(placed.result, allow_nan=False))
    assert set(result) == {
        "scene", "seed", "n_anchors", "verdict", "survive", "notes", "zones", "region", "obstacles",
        "tags_m", "method", "anchors", "cost", "coplanar", "out_of_plane", "next_anchor",
        "predicted", "criteria", "layouts", "check", "against_number", "survey",
    }  # fmt: skip
    assert set(result["anchors"][0]) == {
        "name", "x_m", "y_m", "z_m", "mount", "cost", "fixed", "sees", "without",
    }  # fmt: skip
    for name in ("position_m", "rotation_deg", "score_m"):
        figures = result["predicted"][name]
        assert set(figures) == {"rms", "median", "p95", "worst", "worst_at_m"}
        assert figures["median"] <= figures["p95"] <= figures["worst"]
    assert set(result["criteria"]) == set(criteria.Criteria._fields)
    assert set(result["check"]) == {
        "trials", "prior_rotation_deg", "prior_position_m", "through_walls", "filters",
    }  # fmt: skip
    both = [
        f"{name}_{of}{unit}"
        for name, unit in (("position", "m"), ("rotation", "deg"))
        for of in ("rmse_", "predicted_", "rmse_found_", "predicted_found_", "p95_")
    ]
    ratios = [f"{name}_ratio{of}" for name in ("position", "rotation") for of in ("", "_found")]
    assert set(result["check"]["filters"]["iterated EKF"]) == {
        "found", "without_pose", "wrong", "nees", "nees_found", "holds", "zones", *both, *ratios,
    }  # fmt: skip
    assert result["obstacles"] == [{"low_m": [3, 2, 0], "high_m": [4, 3, 2.5]}]


def test_the_page_needs_no_network_and_is_the_same_for_the_same_result(placed, tmp_path):
    for name in ("a.html", "b.html"):
        place_html.write_place(placed, str(tmp_path / name))
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert page == (tmp_path / "b.html").read_text(encoding="utf-8")
    assert not re.search(r"<(script|link|img)[^>]*(src|href)\s*=", page[:5000])
    assert not re.search(r"<script[^>]+src\s*=\s*[\"']?https?:", page)
    for text in ("against the number of anchors", "checked by Monte Carlo", "obstacles"):
        assert text in page
    assert "Plotly.newPlot" in page
    for rows in place_report.tables(placed.result):
        assert all(len(row) == len(rows.headings) for row in rows.rows)


def test_the_picture_is_the_same_for_the_same_result(placed, tmp_path):
    for name in ("a.png", "b.png"):
        figure = place_figures.place_figure(placed)
        figure.set_layout_engine("none")  # which takes most of the time
        figure.savefig(tmp_path / name, dpi=60)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_the_short_answer_has_the_verdict_first_and_the_notes_last(placed, capsys):
    place_summary.print_place(placed.result)
    short = capsys.readouterr().out
    place_summary.print_place(placed.result, details=True)
    long = capsys.readouterr().out
    assert len(short.splitlines()) < 0.5 * len(long.splitlines())
    parts = ["anchors", "the usual layouts", "checked by Monte Carlo", "One more anchor", "Note:"]
    for shown in (short, long):
        assert " ".join(shown.split()).startswith(place_report.verdict(placed.result))
    found = [short.find(part) for part in parts if part in short]
    assert found == sorted(found)
    assert "--details" in short
    assert "state requirements: use [[zones]]" in short
    assert "predicted over the region" not in short


def test_coplanar_anchors_are_warned_of(capsys):
    problem = scene_files.problem("auv_buoys", 3)
    result = place_anchors(problem, Question(range(3, 4), trials=20)).result
    assert result["coplanar"]
    assert result["criteria"]["conditioning"] is None
    (warning,) = place_answer.warnings(result)
    assert "on the other side of the plane" in warning
    assert "add a fourth" in warning
    place_summary.print_place(result)
    shown = capsys.readouterr().out
    assert "One note is at the end." in " ".join(shown.split("┏")[0].split())
    assert any(line.startswith("Note: All anchors lie in one") for line in shown.splitlines())


def test_an_exchange_that_removes_the_mirror_image_is_suggested():
    problem = scene_files.problem("drone_yard", 5)
    flat = problem.mounts.project(np.array(
        [[-60, -40, 0], [60, -40, 0], [60, 50, 0], [-60, 50, 0], [0, -60, 0.0]]
    ))  # fmt: skip
    result = place_anchors(problem, Question(range(5, 6), layout=flat, trials=20)).result
    move = result["out_of_plane"]
    place = np.array([move[key] for key in ("x_m", "y_m", "z_m")])
    (warning,) = (text for text in place_answer.warnings(result) if "in one plane" in text)
    assert f"Anchor {move['anchor']} moved to ({place[0]:.3f}, " in warning
    moved = flat.copy()
    moved[int(move["anchor"]) - 1] = place
    # One epoch of ranges to a flat body: with the exchange no other pose fits as well.
    tags, pose = bodies.plate(1.0, 1.0), (np.eye(3), np.array([10.0, 5.0, 20.0]))
    for anchors, more in ((flat, 1), (moved, 0)):
        ranges = np.linalg.norm(anchors[:, None] - (tags @ pose[0].T + pose[1]), axis=-1)
        found = estimators.locate(ranges, anchors, tags, problem.noise)
        assert np.isfinite(found.alternatives.cost).sum() == more
    buoys = scene_files.problem("auv_buoys", 4)
    on_water = 90.0 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    assert exchange_out_of_plane(buoys, on_water, 0) is None
    told = place_answer.warnings(result | {"out_of_plane": None})
    assert "allow mounts at another height" in "".join(told)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--anchors", "2"], "the number of anchors must be 3 to 256, got 2"),
        (["--anchors", "2..4"], "the number of anchors must be 3 to 256, got 2"),
        (["--region", "0,0,0,20,1,1"], "region must lie inside the room"),
        (["--region", "x=0:20,y=0:1,z=0:1"], "region must lie inside the room"),
        (["--racks", "9"], "racks must be an int from 0 to 2"),
        (["--scene", "nowhere"], "scene must be one of"),
        (["--scene", "nowhere.toml"], "rbl-gym place: nowhere.toml: No such file or directory"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_with_status_2(options, message, capsys):
    assert main([*COMMAND, *options]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert error[0].startswith("rbl-gym place: ")
    assert message in error[0]


@pytest.mark.parametrize(
    "options",
    [["--anchors", "x"], ["--anchors", "6..4"], ["--anchors", "3.."], ["--region", "1,2"],
     ["--region", "a,b,c,d,e,f"], ["--region", "1,9,1,7,0.5,2"], ["--region", "z=0:1"],
     ["--region", "x=3:1,y=0:1,z=0:1"], ["--trials", "0"]],
)  # fmt: skip
def test_what_cannot_be_read_is_a_usage_error(options, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([*COMMAND, *options])
    assert "must" in capsys.readouterr().err


def test_the_building_may_be_named_without_the_option(capsys):
    for words in (["place", "nowhere.toml"], ["place", "--scene", "nowhere.toml"]):
        assert main(words) == 2
        assert "place: nowhere.toml: No such file" in capsys.readouterr().err
    for words in (["place"], ["place", "uwb_room", "--scene", "hall"]):
        with pytest.raises(SystemExit, match="2"):
            main(words)
        assert "--scene" in capsys.readouterr().err


def test_a_missing_extra_is_named(monkeypatch, capsys):
    find = __import__("importlib.util").util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "plotly" else find(name)
    )
    monkeypatch.delitem(sys.modules, "plotly", raising=False)
    assert main([*COMMAND, "--html", "x"]) == 2
    assert "pip install 'rbl-gym[viz]'" in capsys.readouterr().err
