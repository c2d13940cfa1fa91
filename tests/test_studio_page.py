"""The page of the studio, served by viser; and in a browser, if there is one."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rbl_gym.app import place_pdf, studio
from rbl_gym.app.cli import main
from rbl_gym.app.studio import Studio, place, state
from rbl_gym.app.studio.panel import length
from rbl_gym.placement import scene_files
from rbl_gym.studies.placing import design
from tests.helpers import ROOT, with_kernels
from tests.test_studio import placement_score

pytest.importorskip("viser", reason="needs the extra studio")

WAREHOUSE = str(ROOT / "examples" / "warehouse.toml")
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
# Without a graphics card.
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def designed(problem: Any, seed: int) -> design.Design:
    return design.Design(design.usual_layouts(problem, seed)["grid"], "grid", {})


@pytest.fixture
def served(request, tmp_path, monkeypatch) -> Iterator[Studio]:
    # The search takes seconds, and has tests of its own.
    monkeypatch.setattr(place.design, "design_layout", designed)
    options = studio.Options(
        port=0, folder=tmp_path, browser=False, report=lambda _, __, path: Path(path).touch()
    )
    found = studio.show(scene_files.problem(getattr(request, "param", WAREHOUSE)), options=options)
    yield found
    found.stop()


def until(condition: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait for a condition, or fail."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


CAMERA = np.array([0.0, -60.0, 50.0])


def drag(page: Any, index: int, *places: tuple[float, float, float]) -> None:
    phases = ["start", *["update"] * (len(places) - 2), "end"]
    for phase, point in zip(phases, places, strict=True):
        page.drag(index, phase, CAMERA, np.array(point))


@with_kernels
def test_a_dragged_anchor_changes_map_and_figures(served):
    page = served.page
    page.settle()
    before, shown = page.figures.score_m, page.map.values
    drag(page, 0, (-4, -10, 4), (-6, -10, 4), (-8, -10, 4))
    assert page.settle()
    np.testing.assert_allclose(page.state.anchors[0], [-8.0, -10.0, 4.0])
    assert len(page.state.past) == 1
    assert page.figures.score_m == pytest.approx(placement_score(page.state), rel=1e-9)
    assert page.figures.score_m != before
    assert not np.array_equal(page.map.values, shown, equal_nan=True)
    # Let go, it is refined.
    assert page.map.values.size > 3000
    page.edit(state.undo)
    page.settle()
    assert page.figures.score_m == before


@with_kernels
def test_a_fixed_anchor_is_not_dragged_and_one_hand_holds_at_a_time(served):
    page = served.page
    page.edit(lambda now: state.fix(now, 0))
    drag(page, 0, (-4, -10, 4), (-8, -10, 4))
    page.settle()
    assert "Anchor 1 is fixed" in page.status
    layout = page.state.anchors
    page.drag(1, "start", CAMERA, np.array([0.0, -10, 4]))
    page.drag(2, "start", CAMERA, np.array([0.0, -10, 4]))
    page.drag(2, "end", CAMERA, np.array([5.0, -10, 4]))
    page.drag(1, "end", CAMERA, np.array([3.0, -10, 4]))
    page.settle()
    np.testing.assert_allclose(page.state.anchors[1], [3.0, -10.0, 4.0])
    np.testing.assert_array_equal(page.state.anchors[2:], layout[2:])


@with_kernels
def test_optimising_can_be_stopped_and_goes_on_while_the_slice_moves(served):
    page = served.page
    before = page.state.score
    page.optimise()
    page.cut(share=0.2)
    until(lambda: page.state.score < before)
    page.stop_work()
    assert page.settle()
    assert page.state.slice.share == 0.2
    assert page.state.score < before
    assert page.status == "Stopped."
    assert len(page.state.past) == 1


def test_files_are_saved_in_the_folder_and_nowhere_else(served, tmp_path):
    page = served.page
    page.edit(state.add)
    page.settle()
    page.save("hall")
    page.settle()
    page.write_report("hall")
    until(lambda: page.status == "Saved: hall.toml, hall.csv, hall.pdf")
    saved = scene_files.problem(str(tmp_path / "hall.toml"))
    np.testing.assert_array_equal(saved.fixed, page.state.anchors)
    page.save("../hall")
    page.settle()
    assert page.status.startswith("Not done: the name must be")
    page.write_report("../hall")
    until(lambda: page.status.startswith("Not done: the name must be"))
    names = {"hall.toml", "hall.csv", "hall.pdf", "warehouse-layout-autosave.toml"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert not list(tmp_path.parent.glob("hall*"))


def test_lists_are_loaded_and_bad_ones_get_a_message(served):
    page, anchors = served.page, served.page.state.anchors
    page.load("bad.csv", b"x_m,y_m\n1,2\n")
    page.settle()
    assert page.status.startswith("Not done: bad.csv")
    page.load("off.csv", b"x_m,y_m,z_m\n0,0,1\n1,1,1\n2,2,1\n")
    page.settle()
    assert "is not a legal position" in page.status
    np.testing.assert_array_equal(page.state.anchors, anchors)
    page.load("three.csv", b"x_m,y_m,z_m\n0,0,6\n1,1,6\n2,10,1\n")
    page.settle()
    assert page.state.anchors.tolist() == [[0, 0, 6], [1, 1, 6], [2, 10, 1]]


@with_kernels
def test_a_session_goes_on_after_the_server_was_killed(served, tmp_path):
    page = served.page
    page.edit(state.add)
    page.settle()  # nothing is asked to stop
    options = studio.Options(port=0, folder=tmp_path, browser=False)
    again = studio.show(scene_files.problem(WAREHOUSE), options=options)
    try:
        assert len(again.page.state.anchors) == 8
        again.page.restore()
        again.page.settle()
        np.testing.assert_array_equal(again.page.state.anchors, page.state.anchors)
    finally:
        again.stop()


def test_the_server_is_on_loopback_and_speaks_to_its_own_pages_alone(served):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    assert served.url.startswith("http://127.0.0.1:")
    address = served.url.replace("http", "ws")
    with pytest.raises(InvalidStatus, match="403"):
        connect(address, origin="http://example.org:8080")  # pyrefly: ignore[bad-argument-type]
    with connect(address, origin=served.url):
        pass
    assert served.server.request_share_url() is None
    for host in ("192.0.2.1", "no such host"):
        with pytest.raises(ValueError, match="host must be an address of this machine"):
            studio.show(
                scene_files.problem(WAREHOUSE), options=studio.Options(host=host, browser=False)
            )


def test_a_notebook_shows_the_page(served):
    assert f'src="{served.url}"' in served._repr_html_()


# --- the command -----------------------------------------------------------------------------


@with_kernels
def test_the_command_serves_a_file_with_its_tables_and_report(tmp_path, monkeypatch, capsys):
    seen: dict[str, Any] = {}

    def wait(opened: Studio) -> None:
        page = opened.page
        page.save("hall")
        page.write_report("hall")
        until(lambda: page.status.endswith("hall.pdf") or page.status.startswith("Not done"), 60)
        seen.update(anchors=page.state.anchors, url=opened.url, status=page.status)
        opened.stop()

    monkeypatch.setattr(Studio, "wait", wait)
    monkeypatch.setattr(place.design, "design_layout", designed)
    layout = tmp_path / "layout.csv"
    layout.write_text("x_m,y_m,z_m\n0,0,6\n10,1,6\n2,10,1\n-9,-10,4\n")
    folder = tmp_path / "new"
    arguments = ["--layout", str(layout), "--folder", str(folder), "--port", "0", "--no-browser"]
    monkeypatch.setattr(place_pdf, "write_pdf", lambda placed, path: Path(path).write_text("x"))
    assert main(["studio", WAREHOUSE, *arguments]) == 0
    assert seen["status"] == "Saved: hall.toml, hall.csv, hall.pdf"
    assert seen["anchors"].shape == (4, 3)
    told = capsys.readouterr().out
    assert seen["url"] in told
    assert str(folder) in told
    # What only the file knows is kept: its region, its name.
    tables = scene_files.load(str(folder / "hall.toml"))
    assert tables["name"] == "warehouse"
    assert tables["region"] == scene_files.load(WAREHOUSE)["region"]


def test_the_command_says_what_is_wrong_with_a_file(tmp_path, capsys):
    bad = tmp_path / "bad.toml"
    bad.write_text("name = 3")
    for arguments in (["nowhere"], [str(bad)], [str(tmp_path / "none.toml")]):
        assert main(["studio", *arguments, "--no-browser"]) == 2
        assert capsys.readouterr().err.startswith("rbl-gym studio: ")


# --- in a browser ----------------------------------------------------------------------------


@pytest.fixture
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not CHROMIUM:
        pytest.skip("chromium is not installed")
    with api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield found
        found.close()


def on_screen(camera: Any, point: np.ndarray) -> tuple[float, float]:
    """Pixels of a point in the window of a client's camera."""
    from rbl_gym.app.studio.scene_view import view_axes

    forward = np.asarray(camera.look_at) - np.asarray(camera.position)
    right, up, ahead = view_axes(forward) @ (point - np.asarray(camera.position))
    scale = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
    x, y = scale * right / ahead, scale * up / ahead
    return 0.5 * camera.image_width + x, 0.5 * camera.image_height - y


@with_kernels
@pytest.mark.parametrize("served", ["uwb_room"], indirect=True)
def test_in_a_browser_an_anchor_is_dragged_optimised_and_saved(served, browser, tmp_path):
    page = served.page
    window = browser.new_page(viewport={"width": 1000, "height": 600})
    window.goto(served.url)
    window.get_by_text(length(page.figures.score_m), exact=True).first.wait_for(timeout=60_000)
    until(served.server.get_clients)
    camera = next(iter(served.server.get_clients().values())).camera
    # The panel is docked after the first picture.
    until(lambda: camera.image_width < 800)

    before, anchor = page.figures.score_m, page.state.anchors[3]
    window.wait_for_timeout(500)
    x, y = on_screen(camera, anchor)
    window.mouse.move(x, y)
    window.mouse.down()
    for step in range(1, 5):
        window.mouse.move(x + 12 * step, y + 3 * step)
    until(lambda: (page.state.anchors[3] != anchor).any())
    window.mouse.up()
    page.settle()
    assert page.state.anchors[3][2] == 3.0
    assert page.figures.score_m == pytest.approx(placement_score(page.state), rel=1e-9)
    assert page.figures.score_m != before
    window.get_by_text(length(page.figures.score_m), exact=True).first.wait_for()

    dragged = page.figures.score_m
    window.get_by_role("button", name="Optimise from here").click()
    window.get_by_text("Optimised: b is").wait_for(timeout=60_000)
    page.settle()
    assert page.figures.score_m < dragged

    window.get_by_text("Save", exact=True).click()
    window.locator('input[value="uwb_room-layout"]').fill("by hand")
    window.get_by_role("button", name="Scene and list").click()
    window.get_by_text("Saved: by hand.toml, by hand.csv").wait_for()
    saved = scene_files.problem(str(tmp_path / "by hand.toml"))
    np.testing.assert_array_equal(saved.fixed, page.state.anchors)

    second = browser.new_page(viewport={"width": 1000, "height": 600})
    second.goto(served.url)
    second.get_by_text(length(page.figures.score_m), exact=True).first.wait_for(timeout=60_000)
    assert "Saved: by hand.toml" in second.inner_text("body")
