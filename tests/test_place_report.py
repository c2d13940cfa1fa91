"""The report of a placement: from a plan to PDF, page and picture in one command."""

from __future__ import annotations

import itertools
import json
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

pytest.importorskip("shapely", reason="needs the extra placement")
pytest.importorskip("plotly", reason="needs the extra viz")

from rbl_gym.app import place_answer, place_figures, place_html, place_pdf, place_svg
from rbl_gym.app import place_shapes as shapes
from rbl_gym.app.cli import main
from rbl_gym.geometry import polygons
from rbl_gym.placement import scene_files
from rbl_gym.placement.plans import layers, toml_text
from rbl_gym.placement.plans.reading import read_drawing
from rbl_gym.studies.placing import accuracy, answer, choosing, judging
from tests.helpers import needs
from tests.plan_files import write_dxf, write_geojson, write_png

LAYOUT = "x_m,y_m,z_m\n0.05,2,2.5\n0.05,7,2.7\n11.95,1,2.5\n7,7.95,2.3\n3,7.95,2.7\n"
DXF = [
    *("--walls", "A-WALL-EXT,material=concrete", "--walls", "A-WALL-*,material=drywall"),
    *("--zones", "ZONES,position_m=0.3,heading_deg=20", "--obstacles", "FURNITURE,high_m=1"),
    *("--mounts", "A-WALL-EXT"),
]


@pytest.fixture(autouse=True, scope="module")
def coarse():
    """Few places: the tests look at what is written, not at the figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accuracy, "_MAP", 12)
        patch.setattr(accuracy, "_LEAST_MAP", 8)
        patch.setattr(judging, "PLACES", 120)
        patch.setattr(judging, "MOST_PLACES", 120)
        patch.setattr(choosing, "_LEAST_PLACES", 20)
        yield


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """The office of the tests with a zone that passes, one that fails, one that asks nothing."""
    path = tmp_path_factory.mktemp("plan") / "office.geojson"
    tables = layers.building(read_drawing(write_geojson(path))).tables
    tables["zones"][0] |= {"position_m": 5.0, "attitude": "level"}
    tables["zones"][1] |= {"heading_deg": 0.01}
    corner = {"name": "store", "polygon": [[7, 6], [9, 6], [9, 7], [7, 7]], "low_m": 1, "high_m": 1}
    tables["zones"].append(corner)
    problem = scene_files.of_mapping(toml_text.plain(tables), 5)
    rows = [line.split(",") for line in LAYOUT.splitlines()[1:]]
    anchors = problem.mounts.project(np.array(rows, float))
    question = answer.Question(range(5, 6), layout=anchors, trials=4)
    return answer.place_anchors(problem, question)


# --- one command -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "write", "options"),
    [
        pytest.param(
            "office.dxf", write_dxf, [*DXF, "--report", "new/x.pdf"], marks=needs("ezdxf")
        ),
        ("office.geojson", write_geojson, ["--plot", "new/x.png", "--export", "new/x.csv"]),
        ("office.png", write_png, ["--width", "12", "--html", "new/x.html"]),
    ],
)
def test_a_plan_goes_to_a_report_in_one_command(
    name, write, options, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / name)
    (tmp_path / "layout.csv").write_text(LAYOUT)
    command = ["place", "--scene", name, "--layout", "layout.csv", "--trials", "4", *options]
    assert main(command) == 0
    shown = capsys.readouterr()
    assert "12 x 8" in shown.err  # what was read
    assert "Assumed: an octahedron of 6 tags" in " ".join(shown.out.split())
    made = {path.suffix: path for path in (tmp_path / "new").iterdir()}
    assert all(str(path.relative_to(tmp_path)) in shown.out for path in made.values())
    if name == "office.dxf":
        assert made[".pdf"].read_bytes().startswith(b"%PDF")
    elif name == "office.geojson":
        head = "name,x_m,y_m,z_m,mount,above_floor_m,above_slab_m,slab,faces"
        assert made[".csv"].read_text().startswith(head)
        assert made[".png"].stat().st_size > 50_000
    else:
        page = made[".html"].read_text(encoding="utf-8")
        assert "Anchors for office" in page
        assert page.count('opacity="0.55"') == 1  # the picture behind the plan


def test_plan_writes_a_file_that_place_reads(tmp_path, capsys):
    plan, out = write_geojson(tmp_path / "office.geojson"), tmp_path / "new" / "office.toml"
    picture = tmp_path / "plan.png"
    command = ["plan", plan, "-o", str(out), "--anchors", "6", "--plot", str(picture)]
    assert main([*command, "--zones", "zone,attitude=level,height_m=0.3"]) == 0
    shown = capsys.readouterr().out
    assert "layers of the drawing" in shown
    assert "Assumed: an octahedron of 6 tags" in " ".join(shown.split())
    assert "requirements, for example: position_m = 0.10" in out.read_text("utf-8")
    assert f"building: {out}" in shown
    assert picture.stat().st_size > 20_000
    problem = scene_files.problem(str(out))
    assert (problem.name, problem.n_anchors, len(problem.zones)) == ("office", 6, 2)
    assert {(zone.attitude, zone.height_m) for zone in problem.zones} == {("level", 0.3)}
    assert problem.plan is not None
    assert str(problem.plan.drawing).endswith("office.geojson")
    assert "rbl-gym plan" in out.read_text().splitlines()[0]
    # The file can be drawn too, over a picture.
    over = ["--picture", write_png(tmp_path / "x.png"), "--metres-per-pixel", "0.05"]
    assert main(["plan", str(out), "--plot", str(picture), *over]) == 0


def test_plan_lists_layers_that_are_not_used_and_what_was_not_read(tmp_path, capsys):
    pytest.importorskip("ezdxf")
    assert main(["plan", write_dxf(tmp_path / "x.dxf"), "--json"]) == 0
    rows = {row["layer"]: row for row in json.loads(capsys.readouterr().out)["layers"]}
    assert rows["DIM"] == {
        "layer": "DIM", "taken_for": [], "entities": {}, "unread": {"DIMENSION": 1},
    }  # fmt: skip
    assert rows["ZONES"]["taken_for"] == ["zones"]
    assert main(["plan", str(tmp_path / "x.dxf"), "--zones", "ZONES"]) == 0
    shown = capsys.readouterr().out
    assert "not used: 8 entities on 3 layers (A-WALL-EXT, A-WALL-INT, FURNITURE)" in shown


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["plan", "x.png"], "x.png: a picture needs either --metres-per-pixel or --width"),
        (["plan", "nowhere.geojson"], "nowhere.geojson: No such file or directory"),
        (["plan", "x.dwg"], "x.dwg: DWG files cannot be read: save the drawing as DXF"),
        (["plan", "x.png", "--walls", "A"], "a picture has no layers: leave out --walls"),
        (["plan", "x.geojson", "--zones", "A,attitude=up"], "attitude must be one of free, level"),
        (["plan", "x.geojson", "--mounts", "A,kind=roof"], "--mounts A: kind must be one of wall"),
        (["plan", "x.geojson", "--walls", "A,x=1"], "unknown key 'x'; the keys are name, material"),
        (["plan", "office.geojson", "-o", "x.json"], "--out must end in .toml, got x.json"),
        (["place", "--scene", "uwb_room", "--walls", "A"], "--walls needs a drawing"),
        (["place", "--scene", "uwb_room", "--report", "x.doc"], "--report must end in .pdf"),
        (["place", "--scene", "uwb_room", "--export", "x.xls"], "--export must end in one of .csv"),
        (["place", "--scene", "bad.geojson"], "bad.geojson: not a GeoJSON file"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_with_status_2(
    command, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_png(tmp_path / "x.png")
    write_geojson(tmp_path / "office.geojson")
    write_geojson(tmp_path / "x.geojson")
    (tmp_path / "bad.geojson").write_text("[]")
    assert main(command) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert message in error[0]


# --- words -------------------------------------------------------------------------------------


def test_the_answer_is_in_words_and_signs(placed):
    zones = place_answer.zone_answers(placed.result)
    assert [zone.verdict for zone in zones] == ["pass", "fail", "no requirement"]
    assert zones[0].asks == "horizontal position 5 m in 95 % of the zone"
    assert zones[0].reached.startswith("100 % within (")
    assert zones[2].asks == zones[2].reached == ""
    assert place_answer.headline(placed.result) == "5 anchors: 1 of 2 zones meet their requirements"
    assert placed.result["verdict"] == "fail"
    assert len(place_answer.question(placed.result)) == 3


def test_all_is_said_only_of_all():
    assert place_answer.percent(1) == "100 %"
    assert place_answer.percent(0.9999) == "99.9 %"
    assert place_answer.percent(0.5) == "50 %"


# --- pictures ----------------------------------------------------------------------------------


def test_the_report_is_the_same_for_the_same_result(placed, tmp_path, monkeypatch):
    pages = place_pdf.report_pages
    monkeypatch.setattr(place_pdf, "report_pages", lambda *a: itertools.islice(pages(*a), 3))
    for name in ("a.pdf", "b.pdf"):
        place_pdf.write_pdf(placed, str(tmp_path / name))
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()


OVER = {
    "anchors": {"number": 4},
    "mounts": [{"kind": "ceiling", "polygon": [[0, 0], [10, 0], [10, 8], [0, 8]],
                "height_m": 2.6}],
    "slabs": [{"polygon": [[0, 0], [10, 0], [10, 8], [0, 8]], "z_m": 2.6}],
    "obstacles": [{"low": [4, 4.1, 0], "high": [6, 5, 0.5]}],
    "zones": [{"name": "ground", "polygon": [[1, 1], [9, 1], [9, 7], [1, 7]], "low_m": 0.2,
               "high_m": 1.0}],
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.1},
}  # fmt: skip


def test_floors_do_not_hide_the_zones_in_a_plan():
    problem = scene_files.of_mapping(OVER)
    assert len(shapes.solids(problem)) == 2
    (table,) = shapes.solids_in_plan(problem)
    assert (table.low_m, table.high_m) == (0.0, 0.5)


def test_slabs_are_outlined_with_name_and_heights():
    deck = {"name": "deck", "polygon": [[0, 0], [6, 0], [6, 8], [0, 8]], "z_m": 2.5}
    problem = scene_files.of_mapping(OVER | {"slabs": [deck | {"thickness_m": 0.2}]})
    (axes,) = place_figures.building_figure(problem).axes
    assert "deck, z 2.5 to 2.7 m" in [text.get_text() for text in axes.texts]
    outlines = [patch for patch in axes.patches if patch.get_linestyle() == ":"]
    assert [len(np.array(one.get_path().vertices)) for one in outlines] == [5]
    assert "dotted brown: slabs" in place_figures.legend_text(problem)
    names, at = [{"name": "A"}, {"name": "B"}], np.array([[1.0, 1, 3.0], [9, 1, 2.9]])
    design = SimpleNamespace(anchors=at)
    made: Any = SimpleNamespace(problem=problem, design=design, result={"anchors": names})
    head, first, second = place_pdf.mounting_rows(made)
    where = slice(head.index("z, above floor [m]"), head.index("mount"))
    assert first[where] == ["3.000", "0.30 above deck"]
    assert second[where] == ["2.900", "-"]


def test_the_wall_above_a_door_is_drawn_as_overhead(placed):
    tables = json.loads(json.dumps(OVER))
    tables["walls"] = [{"line": [[0, 4], [10, 4]], "high_m": 2.6}]
    tables["openings"] = [{"line": [[3, 4], [4, 4]]}, {"line": [[7, 4], [8, 4]], "low_m": 1}]
    problem = scene_files.of_mapping(tables)
    over = [s for s in shapes.solids_in_plan(problem) if shapes.is_overhead(problem, s)]
    ends = sorted(solid.corners[:, 0].tolist() for solid in over)
    assert [(min(x), max(x)) for x in ends] == [(3, 4), (7, 8)]
    assert {(solid.low_m, solid.high_m) for solid in over} == {(2.1, 2.6)}
    assert "dotted: overhead" in place_figures.legend_text(problem)
    assert "dotted" not in place_figures.legend_text(placed.problem)


def test_of_zones_above_each_other_the_label_names_those_that_the_map_hides():
    tables = json.loads(json.dumps(OVER))
    yard = {"name": "yard", "low": [11, 1, 0], "high": [14, 7, 2]}
    tables["zones"] += [OVER["zones"][0] | {"name": "first", "low_m": 3, "high_m": 4}, yard]
    problem = scene_files.of_mapping(tables)
    labels = shapes.zone_labels(problem, np.empty((0, 3)))
    assert [text for text, _ in labels] == [
        "first, z 3 to 4 m\nnot shown: ground, z 0.2 to 1 m", "yard",
    ]  # fmt: skip


def test_a_label_has_a_line_to_its_marker_if_it_is_far_or_another_marker_is_near():
    size, points = np.array([20.0, 10.0]), np.array([[0.0, 0.0], [30.0, 0.0], [300.0, 0.0]])
    for place, point, needed in (
        ([-14.0, 0.0], points[0], False),
        ([15.0, 0.0], points[0], True),  # as near to the second marker
        ([330.0, 0.0], points[2], True),  # 20 away from its own
        ([314.0, 0.0], points[2], False),
    ):
        found = shapes.needs_leader(np.array(place), size, point, points, 10.0)
        assert found == needed, place


def test_maps_have_no_holes_where_a_wall_crosses(placed):
    maps = shapes.maps_of(placed)
    for zone, one in zip(placed.problem.zones, maps, strict=True):
        layer = shapes.layer_of(zone, one, one.horizontal)
        assert np.isfinite(layer.values).all()
        assert (layer.values[layer.free] == one.horizontal[layer.free]).all()


def test_the_relative_map_is_the_largest_error_to_its_limit(placed):
    zone = placed.problem.zones[1]
    one = shapes.maps_of(placed)[1]
    found = shapes.values_of(zone, one, "relative")
    np.testing.assert_allclose(found, one.heading / 0.01)
    other = shapes.maps_of(placed)[2]
    assert np.isnan(shapes.values_of(placed.problem.zones[2], other, "relative")).all()


@pytest.mark.parametrize(
    ("method", "own", "told"),
    [
        ("search from greedy 4", "designed", True),
        ("search from greedy 4, exchanges for requirements", "designed", False),
        ("least number", "designed", False),
        ("given", "given", False),
    ],
)
def test_the_chart_says_if_the_search_was_not_for_the_margin(method, own, told):
    def row(margin):
        return {"verdict": "pass", "zones": [{"margin": margin}]}

    result = row(1.2) | {
        "survive": 0,
        "method": method,
        "layouts": {own: row(1.2), "ring": row(1.5)},
    }
    axes = Figure().add_subplot()
    place_figures.draw_chart(axes, result)
    assert ("minimised b, not this margin" in axes.get_xlabel()) == told


def test_colours_show_errors_near_the_limit_beside_large_ones():
    free = np.ones((1, 4), bool)
    layers = [shapes.Layer(None, 0, 1, 0, 1, np.array([[0.1, 0.2, 0.4, 25.0]]), free)]
    assert shapes.colour_range(layers, 0.3) == (0.1, pytest.approx(0.9))
    low, high = shapes.colour_range(layers, None)
    assert (low, high > 20) == (0.1, True)


def test_labels_lie_on_no_other(placed):
    """The texts of all maps, as they are drawn; anchors may stand as close as they like."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((20, 2)) * (900, 500), [[50, 50], [52, 51], [54, 49]]])
    sizes = np.tile([[44.0, 16.0]], (23, 1))
    found = shapes.spread_labels(points, sizes, np.array([[0, 0], [900, 500]]), 6.0)
    for a, b in itertools.combinations(found, 2):
        assert (np.abs(a - b) >= (44, 16)).any()
    assert np.linalg.norm(found - points, axis=-1).max() < 120
    figure = place_figures.place_figure(placed)
    renderer = FigureCanvasAgg(figure).get_renderer()
    for axes in figure.axes:
        boxes = [
            text.get_window_extent(renderer) for text in axes.texts if text.get_text().isdigit()
        ]
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def test_colours_of_pass_and_fail_differ_in_lightness():
    """Told apart without hue: their luminances differ, and the second is hatched."""

    def luminance(colour):
        parts = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
        return parts @ (0.2126, 0.7152, 0.0722)

    assert luminance(shapes.WITHIN) - luminance(shapes.BEYOND) > 0.15


def test_the_page_needs_no_network_and_says_it_all(placed, tmp_path):
    path = tmp_path / "x.html"
    place_html.write_place(placed, str(path))
    page = path.read_text(encoding="utf-8")
    assert not re.search(r"<script[^>]+src\s*=\s*[\"']?https?:", page)
    assert 'name="viewport" content="width=device-width' in page
    for text in ("PASS", "FAIL", "mounting list", 'data-map="heading/', "store", "Plotly.newPlot"):
        assert text in page
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', page)
    data = json.loads(text)
    assert data["first"] == "relative"
    zone = data["maps"][data["level"]][0]
    assert zone["zone"] == "open plan"
    assert np.array(zone["values"]["horizontal"], float).shape[0] >= 8


def test_the_plan_of_the_page_has_a_scale(placed):
    page = place_svg.plan_part(placed)
    found = re.search(r'class="ruler" style="width: ([\d.]+)%">([\d.]+) m<', page)
    assert found is not None
    share, length = found.groups()
    edges = shapes.limits(placed.problem, placed.design.anchors)
    width = float(np.ptp(edges[:, 0]))
    assert float(length) / width == pytest.approx(float(share) / 100, abs=1e-4)
    assert 0.1 <= float(share) / 100 <= 0.25


def test_the_report_has_these_pages(placed):
    pages = list(place_pdf.report_pages(placed))
    titles = [page.texts[0].get_text() for page in pages]
    assert titles[:2] == [
        "Anchors for office",
        "Plan: anchors, zones, and where anchors may be mounted",
    ]
    for title in ("Requirements", "Error of heading", "Mounting list", "How to read it"):
        assert title in titles
    words = {text.get_text() for page in pages for text in page.texts}
    assert {"✗ FAIL", "✓ PASS"} <= words


def test_far_anchors_are_shown_at_the_edge():
    problem = scene_files.problem("satellite", 4)
    anchors = problem.mounts.draw(np.random.default_rng(1).random((4, 3)))
    assert shapes.is_far(problem, anchors)
    edges = shapes.limits(problem, anchors)
    place, outside = shapes.shown_place(anchors[0, :2], edges)
    assert outside
    assert ((place > edges[0]) & (place < edges[1])).all()


# --- solids ------------------------------------------------------------------------------------


def test_caps_of_prisms_fill_their_outline():
    ring = np.array([(0, 0), (4, 0), (4, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)], float)
    for outline in (ring, ring[::-1]):
        triangles = outline[polygons.ears(outline)]
        areas = [abs(polygons.area(triangle)) for triangle in triangles]
        assert len(areas) == len(ring) - 2
        assert sum(areas) == pytest.approx(abs(polygons.area(ring)))
        centres = triangles.mean(axis=1)
        assert polygons.contains(ring, centres).all()


def test_slits_of_holes_are_not_drawn():
    outline = np.array([(0, 0), (9, 0), (9, 9), (0, 9.0)])
    hole = np.array([(3, 3), (3, 6), (6, 6), (6, 3.0)])
    from rbl_gym.placement.plans.rings import opened

    ring = opened(outline, (hole,))
    assert ring is not None
    sides = shapes.sides_of(ring)
    lengths = np.linalg.norm(np.diff(sides, axis=1)[:, 0], axis=-1)
    assert lengths.sum() == pytest.approx(36 + 12, abs=0.01)
