"""The page for watching filters, served by viser; and in a browser, if there is one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from rbl_gym import recordings
from rbl_gym.app import studio
from rbl_gym.app.cli import main
from rbl_gym.app.studio import Studio
from rbl_gym.app.studio.watch_panel import chosen
from rbl_gym.app.studio.watch_view import ellipsoid, letterbox, link_lines
from rbl_gym.studies import replay
from rbl_gym.studies.watching.frames import Frame
from rbl_gym.studies.watching.live import Disturbances, stage_of_scene
from rbl_gym.studies.watching.program import (
    LIVE,
    Program,
    env_program,
    live_program,
    program_of,
    recorded_program,
    room_of,
)
from rbl_gym.worlds import scenes
from tests.helpers import ROOT
from tests.test_studio_page import ARGUMENTS, CHROMIUM, until
from tests.test_studio_watch import random_policy, truth_of

pytest.importorskip("viser", reason="needs the extra studio")

OPTIONS = studio.Options(port=0, browser=False, seed=3)


@pytest.fixture
def served() -> Iterator[Studio]:
    scene = scenes.get("uwb_room")
    program = live_program(stage_of_scene(scene, 40), LIVE, room_of(scene), 3)
    found = studio.show(program, options=OPTIONS)
    yield found
    found.stop()


def test_the_page_shows_the_frames_that_the_generator_makes(served):
    page = served.page
    for _ in range(5):
        page.step()
    page.disturb(Disturbances(nlos=0.2))
    for _ in range(10):
        page.step()
    assert page.settle()
    program = page.program
    calm = Disturbances()
    told = Disturbances(nlos=0.2)
    made = program.start(program.filters, 3, lambda epoch: told if epoch > 5 else calm)
    for shown, expected in zip(page.frames, made, strict=False):
        np.testing.assert_array_equal(shown.truth.translation, expected.truth.translation)
        for one, other in zip(shown.tracks, expected.tracks, strict=True):
            np.testing.assert_array_equal(one.belief.covariance, other.belief.covariance)
    assert len(page.frames) == 16
    assert page.frames[10].links.reflected.any()


def test_it_plays_seeks_and_begins_anew(served):
    page = served.page
    page.set_speed(np.inf)
    page.play_or_pause()
    until(lambda: len(page.frames) > 10)
    page.play_or_pause()
    page.settle()
    count, first = len(page.frames), page.frames[0].truth.translation
    page.seek(4)
    page.settle()
    assert (page.at, len(page.frames)) == (4, count)
    page.restart(("uc-kf",), 5)
    page.settle()
    assert len(page.frames) == 1
    assert [track.label for track in page.frames[0].tracks] == ["uc-kf"]
    assert not np.allclose(page.frames[0].truth.translation, first)


def test_a_filter_that_does_not_fit_leaves_the_page_as_it_was(served):
    page = served.page
    page.step()
    page.restart(("iekf-imu",), 0)
    page.settle()
    assert "inertial" in page.status
    assert len(page.frames) == 2
    page.step()
    page.settle()
    assert len(page.frames) == 3


def test_an_episode_ends_and_begins_again(served):
    page = served.page
    page.set_speed(np.inf)
    page.play_or_pause()
    until(lambda: page.status == "The episode is over.")
    page.settle()
    assert len(page.frames) == 41
    page.play_or_pause()
    until(lambda: len(page.frames) < 41)
    page.play_or_pause()


def test_the_ellipsoid_holds_95_percent():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6))
    covariance = root @ root.T
    found = ellipsoid(covariance)
    assert found is not None
    half, axes = found
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    drawn = rng.multivariate_normal(np.zeros(6), covariance, 20_000)[:, 3:] @ axes
    # Three standard deviations are 0.5 %.
    assert ((drawn / half) ** 2).sum(axis=1).__le__(1).mean() == pytest.approx(0.95, abs=0.005)
    assert ellipsoid(np.full((6, 6), np.nan)) is None


def test_links_go_from_anchors_to_tags_by_their_kinds():
    program = program_of(scenes.get("uwb_room"), ("iekf/robust=true",), 3)
    told = Disturbances(nlos=0.3, lost=0.3)
    frame: Frame = next(program.start(program.filters, 3, lambda _: told))
    drawn = link_lines(frame, 0, program.tags, 1.0)
    assert sum(map(len, drawn.values())) == 36
    assert len(drawn["lost"]) == 36 - frame.links.measured.sum()
    assert len(drawn["rejected"]) == frame.tracks[0].rejected.sum()
    rotation, translation = truth_of(frame)
    assert rotation is not None
    tags = program.tags @ rotation.T + translation
    for anchor, tag in np.concatenate(list(drawn.values())):
        assert (anchor == frame.anchors).all(axis=1).any()
        assert np.abs(tag - tags).max(axis=1).min() < 1e-12


def asked(tmp_path, monkeypatch, *options: str) -> Studio:
    """What the command opens, without waiting."""
    found: list[Studio] = []
    monkeypatch.setattr(Studio, "wait", lambda self: found.append(self))
    common = ["--no-browser", "--port", "0", "--folder", str(tmp_path)]
    assert main(["studio", *options, *common]) == 0
    return found[0]


def test_the_command_watches_buildings_and_recordings(tmp_path, monkeypatch):
    warehouse = str(ROOT / "examples" / "warehouse.toml")
    opened = asked(tmp_path, monkeypatch, warehouse, "--watch", "--filter", "iekf", "--seed", "2")
    opened.page.step()
    opened.page.settle()
    assert [len(frame.tracks) for frame in opened.page.frames] == [1, 1]
    opened.stop()
    log = ROOT / "examples" / "log"
    files = [f"--{name}={log / f'{name}.csv'}" for name in ("ranges", "anchors", "tags", "truth")]
    opened = asked(tmp_path, monkeypatch, *files, "--filter", "iekf")
    assert np.isfinite(opened.page.frames[0].tracks[0].position_m)
    opened.stop()


ID = "RBL/AnchorPlacement-v0"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ([], "SCENE|FILE must be given"),
        (["--watch"], "SCENE|FILE must be given"),
        (["uwb_room", "--anchors", "x.csv"], "--anchors must be a number"),
        (["--ranges", "r.csv", "--anchors", "4"], "--anchors must be a file"),
        (["uwb_room", "--ranges", "r.csv"], "must be left out"),
        (["uwb_room", "--watch", "--filter", "kalmann"], "filter must be one of"),
        (["--env", "RBL/Nothing-v0"], "--env RBL/Nothing-v0"),
        (["--policy", "none.npz"], "none.npz"),
        (
            ["--policy", "none.npz", "--env", ID, "--reference", "ring"],
            "--reference needs --policy",
        ),
        (["--env", ID, "--reference", "ring"], "--reference needs --policy without --env"),
    ],
)
def test_the_command_says_what_is_wrong(options, says, capsys):
    assert main(["studio", *options, "--no-browser", "--port", "0"]) != 0
    assert says in capsys.readouterr().err


@pytest.mark.skipif(not CHROMIUM, reason="needs chromium")
def test_in_a_browser_a_filter_breaks_and_the_robust_one_holds(served):
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    page = served.page
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        window = browser.new_page(viewport={"width": 800, "height": 500})
        window.set_default_timeout(90_000)
        window.goto(served.url)
        # Without a graphics card a picture takes long: nothing waits for one.
        window.get_by_role("button", name="Play").wait_for(state="attached")
        window.get_by_label("Wrong anchor").dispatch_event("click")
        window.get_by_role("button", name="Play").dispatch_event("click")
        until(lambda: len(page.frames) > 8)
        window.get_by_role("button", name="Pause").dispatch_event("click")
        assert "iekf/robust=true" in window.content()
        browser.close()
    assert page.settle()
    told = page.frames[-1].told - page.frames[-1].anchors
    assert np.linalg.norm(told[0]) == pytest.approx(0.5)
    errors = np.array([[t.position_m for t in f.tracks] for f in page.frames[3:]])
    assert errors[:, 1].mean() < errors[:, 0].mean()


def test_the_command_plays_a_policy_in_another_scene(tmp_path, capsys):
    policy = random_policy("auv_buoys", tmp_path)
    scene = tmp_path / "five.json"
    scene.write_text('{"name": "auv_buoys", "n_anchors": 5}')
    assert main(["studio", str(scene), "--policy", policy, "--no-browser"]) != 0
    assert "does not fit" in capsys.readouterr().err


def test_the_command_plays_environments_and_policies(tmp_path, monkeypatch):
    opened = asked(tmp_path, monkeypatch, "--env", "RBL/AnchorSelection-v0", "--filter", "uc-kf")
    program: Program = opened.page.program
    assert program.filters == ("iekf/iterations=2", "uc-kf")
    opened.stop()
    policy = random_policy("auv_buoys", tmp_path)
    opened = asked(tmp_path, monkeypatch, "--policy", policy, "--reference", "ring")
    for _ in range(4):
        opened.page.step()
    opened.page.settle()
    assert [len(frame.anchors) for frame in opened.page.frames] == [0, 1, 2, 3, 4]
    assert opened.page.status == ""
    opened.stop()
    opened = asked(tmp_path, monkeypatch, "auv_buoys", "--policy", policy, "--env", ID)
    assert opened.page.program.title == f"{ID}: auv_buoys-0"
    opened.page.step()
    opened.page.settle()
    assert len(opened.page.frames[1].anchors) == 1
    opened.stop()


def test_a_client_cannot_name_a_filter_that_is_not_offered():
    own = ("uc-kf", "mine:make")
    assert chosen(["iekf", "os:system"], own) == ("iekf",)
    assert chosen(["os:system", "none"], own) == own
    assert chosen(["mine:make", "iekf/robust=late", "mine:make"], own) == (
        "mine:make", "iekf/robust=late",
    )  # fmt: skip


@pytest.mark.parametrize("aspect", [0.5, 2.0, 3.0])
def test_a_picture_keeps_its_proportions(aspect):
    picture = np.zeros((40, 80, 3), np.uint8)
    found = letterbox(picture, aspect)
    assert found.shape[1] / found.shape[0] == pytest.approx(aspect, abs=0.02)
    assert (found == 0).all(axis=-1).sum() == 40 * 80


def test_environments_that_are_no_rooms_are_shown_as_pictures():
    env = gym.make("rbl_gym:RBL/PlanarNetwork-v0", render_mode="rgb_array")
    opened = studio.show(env_program(env), options=OPTIONS)
    opened.page.step()
    opened.page.settle()
    assert (opened.page.status, len(opened.page.frames)) == ("", 2)
    opened.stop()


def test_a_recording_is_shown_with_its_track():
    folder = ROOT / "examples" / "log"
    files: dict[str, Any] = {name: folder / f"{name}.csv" for name in ("ranges", "anchors", "tags")}
    log = recordings.read_recording(recordings.Files(**files))
    log = log._replace(**{name: getattr(log, name)[:10] for name in ("times", "ranges", "links")})
    track = replay.track_recording(log, replay.Settings.of(filter="iekf"))
    opened = studio.show(log, track, options=OPTIONS)
    opened.page.step()
    opened.page.settle()
    frame = opened.page.frames[1]
    assert frame.truth is None
    np.testing.assert_array_equal(frame.tracks[0].belief.translation, track.translation[1])
    assert recorded_program(log, {"a": track}).filters == ("a",)
    opened.stop()
    with pytest.raises(ValueError, match="what must be"):
        studio.show("uwb_room", options=OPTIONS)
