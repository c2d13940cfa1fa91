"""HTML pages: their contents, and that a browser opens them without an error."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("plotly", reason="the extra viz is not installed")

from rbl_gym.app import page, solids, track_html, track_pages
from rbl_gym.app.cli import main
from rbl_gym.app.story import Beliefs, Story, enlargement, errors_of
from rbl_gym.geometry import rotations
from rbl_gym.rendering.drawing import RADIUS_95
from rbl_gym.studies.papers import camsap2013
from tests.test_cli import arguments, files  # noqa: F401 (a fixture)

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next((found for name in BROWSERS if (found := shutil.which(name))), None)
# What the browser says of drawing without a graphics card is no error of the page.
HARMLESS = ("willReadFrequently", "GL Driver Message")


class Text(HTMLParser):
    """The texts of table cells, row by row."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.open = False

    def handle_starttag(self, tag, attrs):
        if tag == "tr":
            self.rows.append([])
        self.open = tag in ("td", "th")

    def handle_endtag(self, tag):
        self.open = self.open and tag not in ("td", "th")

    def handle_data(self, data):
        if self.open:
            self.rows[-1].append(data)


def cells(text: str) -> list[list[str]]:
    parser = Text()
    parser.feed(text)
    return parser.rows


def opened(path: Path, script: str = "") -> str:
    """The page's elements after it was opened, in a browser that reported no error."""
    assert BROWSER is not None
    if script:
        # Run when the page has been: what the user would click.
        text = path.read_text(encoding="utf-8")
        run = f"<script>window.addEventListener('load', () => {{ {script} }});</script></body>"
        path.write_text(text.replace("</body>", run), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader",
               "--enable-unsafe-swiftshader", f"--user-data-dir={path.parent / 'profile'}",
               "--virtual-time-budget=2000", "--enable-logging=stderr", "--dump-dom"]  # fmt: skip
    done = subprocess.run(
        [BROWSER, *options, path.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    said = [line for line in done.stderr.splitlines() if ":CONSOLE:" in line]
    assert [line for line in said if not any(word in line for word in HARMLESS)] == []
    return done.stdout


needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome on the path")


@pytest.fixture(scope="module")
def result() -> dict:
    return camsap2013.tracking_experiment(5, 1)


@pytest.fixture(scope="module")
def demo(result) -> str:
    return track_pages.demo_page(result, camsap2013.example(1))


HEADINGS = ["filter", "scene", "ratio", "flips", "verdict"]
ROWS = [
    ["iekf", "auv", 1.02, None, "consistent"],
    ["<kf>", "yard", 10.5, 0.25, "optimistic"],
    ["uc-kf", "yard", 2.25, None, True],
]


def board(headings=HEADINGS, rows=ROWS) -> str:
    parts = [page.table("who is best", headings, rows), page.note("a < b")]
    return page.document("who is best", parts)


# --- tables -------------------------------------------------------------------------------------


def test_a_table_shows_every_row():
    text = board()
    assert cells(text) == [
        HEADINGS,
        ["iekf", "auv", "1.02", "-", "consistent"],
        ["<kf>", "yard", "10.5", "0.25", "optimistic"],
        ["uc-kf", "yard", "2.25", "-", "yes"],
    ]
    assert "<title>who is best</title>" in text
    assert "a &lt; b" in text
    assert "<kf>" not in text
    assert not re.search(r"(src|href)\s*=", text)


@pytest.mark.parametrize(
    ("text", "number"),
    [("x1.20", 1.2), ("0.3 m", 0.3), ("12,500", 12500), (-2, -2), ("nan", None), ("kf", None),
     (True, None), (None, None), ("1e999", None), (np.float64(0.5), 0.5)],
)  # fmt: skip
def test_cells_sort_by_the_number_they_begin_with(text, number):
    assert page._number(text) == number


@needs_browser
def test_a_click_on_a_heading_sorts_and_a_second_one_turns_the_order(tmp_path):
    path = tmp_path / "board.html"
    page.write(board(), str(path))
    script = """
      const seen = [], heads = document.querySelectorAll("th");
      const look = () => seen.push([...document.querySelectorAll("td:first-child")]
        .map(cell => cell.textContent.replace(/[<>]/g, "")).join(" "));
      look();
      for (const column of [2, 2, 3, 3, 0]) { heads[column].click(); look(); }
      document.body.dataset.seen = seen.join(", ");
    """
    (seen,) = re.findall('data-seen="(.*?)"', opened(path, script))
    assert seen.split(", ") == [
        "iekf kf uc-kf",
        "iekf uc-kf kf",
        "kf uc-kf iekf",  # ratio, up and down
        "kf uc-kf iekf",
        "kf uc-kf iekf",  # flips: what is missing comes last either way
        "kf iekf uc-kf",
    ]


@needs_browser
def test_long_tables_can_be_filtered(tmp_path):
    path = tmp_path / "board.html"
    rows = [[f"f{k}", "yard" if k % 2 else "room"] for k in range(20)]
    page.write(board(["filter", "scene"], rows), str(path))
    script = (
        "const f = document.querySelector('input'); f.value = 'YARD f1';"
        "f.dispatchEvent(new Event('input'));"
    )
    hidden = re.findall(r"<tr( hidden=\"\")?><td", opened(path, script))
    assert [not mark for mark in hidden] == [k in (1, 11, 13, 15, 17, 19) for k in range(20)]


# --- tracks -------------------------------------------------------------------------------------


@needs_browser
def test_the_page_of_the_demo_opens_and_its_slider_moves_body_and_cursor(demo, tmp_path):
    path = tmp_path / "demo.html"
    page.write(demo, str(path))
    script = """
      Plotly.animate("track", ["20"], {mode: "immediate", frame: {duration: 0}}).then(() => {
        const moving = document.getElementById("track").data;
        document.body.dataset.at = moving[moving.length - 1].x.join(" ");
      });
    """
    elements = opened(path, script)
    assert 'data-at="20 20"' in elements
    assert elements.count("<canvas") >= 2
    assert len(re.findall(r'class="[^"]*slider-group', elements)) >= 1
    assert len(re.findall(r'class="[^"]*scatterlayer', elements)) >= 3


def test_logarithmic_axes_are_labelled_with_whole_numbers(result):
    shown = track_pages._curves(result)
    every: list[Any] = [*shown.select_yaxes()]
    axes = [axis for axis in every if axis.type == "log"]
    assert len(axes) == 3
    for axis in axes:
        assert [float(text) for text in axis.ticktext] == list(axis.tickvals)
    assert track_html.log_ticks(0.013, 0.2)["ticktext"] == [
        "0.01", "0.02", "0.05", "0.1", "0.2", "0.5", "1", "2", "5",
    ]  # fmt: skip
    short = track_html.log_ticks(0.016, 0.031)["tickvals"]
    assert [mark for mark in short if 0.016 <= mark <= 0.031] == [0.02, 0.025, 0.03]


def test_a_page_needs_no_network_and_is_the_same_for_the_same_result(demo):
    again = track_pages.demo_page(camsap2013.tracking_experiment(5, 1), camsap2013.example(1))
    # Only the times of the processor differ.
    table = r"<td data-value=\"[\d.]+\">[\d.]+</td></tr>"
    assert re.sub(table, "", demo) == re.sub(table, "", again)
    assert not re.search(r"<script[^>]+src\s*=", demo)
    assert not re.search(r"<link[^>]+href\s*=", demo)
    assert demo.count("<!DOCTYPE html>") == 1


def story(axes: str = "xyz", known: bool = True) -> Story:
    rng = np.random.default_rng(0)
    count = 7
    covariance = np.tile(np.diag([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]) ** 2, (count, 1, 1))
    w, v = 0.1 * rng.normal(size=(2, count, 3))
    rotation, translation = rotations.random(rng, (count,)), rng.normal(size=(count, 3))
    belief = Beliefs(rotations.exp(w) @ rotation, translation + v, covariance, "#1b7f5c")
    where = np.arange(count) != 2
    truth = (rotation, translation, where) if known else None
    names = ["a", "b", "c"]
    return Story(np.arange(count) / 10, np.eye(3), names, np.eye(3), truth, {"f": belief}, axes)


def test_errors_of_a_story_are_those_that_were_put_in():
    rng = np.random.default_rng(0)
    w, v = 0.1 * rng.normal(size=(2, 7, 3))
    told = story()
    found = errors_of(told, told.beliefs["f"])
    known = np.arange(7) != 2
    for values in (found.position_m, found.rotation_deg, found.nees):
        assert np.isnan(values[2])
    np.testing.assert_allclose(found.position_m[known], np.linalg.norm(v, axis=1)[known])
    degrees = np.rad2deg(np.linalg.norm(w, axis=1))
    np.testing.assert_allclose(found.rotation_deg[known], degrees[known])
    np.testing.assert_allclose(found.position_std_m, np.sqrt(14))
    expected = ((w / [0.1, 0.2, 0.3]) ** 2 + (v / [1, 2, 3]) ** 2).sum(axis=1)
    np.testing.assert_allclose(found.nees[known], expected[known])
    flat = errors_of(story("xy"), told.beliefs["f"])
    np.testing.assert_allclose(flat.position_m[known], np.linalg.norm(v[:, :2], axis=1)[known])
    np.testing.assert_allclose(flat.rotation_std_deg, np.rad2deg(0.3))


def drawn(told: Story) -> Any:
    """plotly does not declare what figures hold."""
    return track_html.track_figure(told)


def test_curves_break_at_gaps_of_the_log():
    told = story()
    late = told._replace(times=told.times + np.where(np.arange(7) > 3, 5.0, 0.0))
    lines = [trace for trace in drawn(late).data if trace.name == "f" and trace.x]
    # Errors, NEES and the path of the belief: the fifth point is the break.
    flat = [line for line in lines if line.type == "scatter"]
    assert len(flat) == 3
    assert all(line.x[4] is None and line.y[4] is None and len(line.x) == 8 for line in flat)
    path = next(line for line in lines if line.type == "scatter3d" and len(line.x) == 8)
    assert path.z[4] is None
    assert path.z[3] is not None
    # The areas below 3 sigma are closed before the break, and again after it.
    areas = [trace for trace in drawn(late).data if trace.name == "3 sigma"]
    assert len(areas) == 2
    for area in areas:
        assert area.fill == "toself"
        corners = [list(area.x[:7]), list(area.x[7:])]
        assert corners[0] == [0, 0.1, 0.2, 0.3, 0.3, 0, None]
        assert corners[1] == [5.4, 5.5, 5.6, 5.6, 5.4, None]
        assert [k for k, y in enumerate(area.y) if y == 0] == [4, 5, 10, 11]


@pytest.mark.parametrize("known", [True, False])
def test_every_moment_changes_the_same_traces(known):
    shown = drawn(story(known=known))
    kinds = [type(trace) for trace in shown.data]
    assert len(shown.frames) == 7
    for frame in shown.frames:
        assert [kinds[k] for k in frame.traces] == [type(trace) for trace in frame.data]
    assert len(shown.layout.sliders[0].steps) == 7


def test_errors_of_a_body_with_one_tag_at_its_origin_are_not_enlarged():
    assert enlargement(story()._replace(tags=np.zeros((1, 3)))) == 1.0


def test_scenes_have_equal_scales():
    scene = drawn(story()).layout.scene
    spans = [np.ptp(getattr(scene, f"{name}axis").range) for name in "xyz"]
    ratios = [getattr(scene.aspectratio, name) for name in "xyz"]
    np.testing.assert_allclose(np.divide(spans, ratios), spans[0] / ratios[0])


def test_an_ellipsoid_holds_95_percent_and_its_net_is_closed():
    covariance = np.diag([1.0, 4.0, 0.25])
    shape = solids.ellipsoid(np.array([1.0, 2.0, 3.0]), covariance)
    points = np.array([shape[name] for name in "xyz"], dtype=float).T - [1.0, 2.0, 3.0]
    length = np.einsum("ki,ij,kj->k", points, np.linalg.inv(covariance), points)
    np.testing.assert_allclose(length, RADIUS_95**2, rtol=1e-3)
    triangles = np.array([solids.net()[name] for name in "ijk"]).T
    assert triangles.min() == 0
    assert triangles.max() == len(points) - 1
    # Every inner edge belongs to two triangles, the rings at the poles to one.
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(sides, axis=0, return_counts=True)
    assert set(counts) == {1, 2}
    assert (counts == 1).sum() == 2 * 16


# --- commands -----------------------------------------------------------------------------------


@pytest.mark.parametrize("with_truth", [True, False])
def test_a_replay_writes_its_page(with_truth, files, tmp_path, capsys):  # noqa: F811
    path, figures = tmp_path / "track.html", tmp_path / "x.json"
    given = files if with_truth else {k: v for k, v in files.items() if k != "truth"}
    for name in {"ranges", "truth"} & given.keys():
        file = Path(given[name])
        file.write_text("\n".join(file.read_text().splitlines()[:32]))
    options = ["--html", str(path), "--json", str(figures), *["--smooth"] * with_truth]
    assert main([*arguments(given), *options]) == 0
    text = path.read_text(encoding="utf-8")
    result = json.loads(figures.read_text())
    assert f"{result['epochs']} epochs" in text
    assert ("p95" in text) is with_truth
    assert ("<h2>smoothed<" in text) is with_truth
    if BROWSER is not None and not with_truth:
        assert opened(path).count("<canvas") >= 2


def test_a_bench_writes_its_page(tmp_path, capsys):
    path, out = tmp_path / "bench.html", tmp_path / "bench.jsonl"
    options = ["--filters", "iekf,kf", "--scenes", "uwb_room,icassp2013", "--trials", "4",
               "--conditions", "nominal,nlos", "--out", str(out), "--html", str(path)]  # fmt: skip
    assert main(["bench", *options]) == 0
    assert f"page: {path}" in capsys.readouterr().out
    text = path.read_text(encoding="utf-8")
    rows = cells(text)
    assert len(rows) == 1 + 2 * 2 * 2
    records = [json.loads(line) for line in out.read_text().splitlines()]
    figures = {(r["scene"], r["condition"], r["filter"]): r for r in records if "tags_m" in r}
    for row in rows[1:]:
        ratio = figures[row[0], row[1], row[2]]["tags_m"]["to_bound"]
        assert row[rows[0].index("x bound")] == f"{ratio:#.4g}"
    if BROWSER is not None:
        assert "heatmap" in opened(path)
