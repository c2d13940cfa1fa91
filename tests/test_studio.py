"""The studio without a browser: states, maps, files, the worker."""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rbl_gym import placement
from rbl_gym.app import studio
from rbl_gym.app.studio import files, keeping, maps, place
from rbl_gym.app.studio.figures import body_figures, figures, usual_scores
from rbl_gym.app.studio.panel import Shown, headline, length, status
from rbl_gym.app.studio.place import PlacePage
from rbl_gym.app.studio.rays import under_pointer
from rbl_gym.app.studio.searches import add_best, optimise
from rbl_gym.app.studio.state import (
    Layout,
    Slice,
    State,
    add,
    cut,
    fix,
    move,
    open_state,
    place_body,
    plane,
    redo,
    remove,
    set_layout,
    snap,
    turn_knobs,
    undo,
)  # fmt: skip
from rbl_gym.app.studio.worker import Worker
from rbl_gym.app.studio.world import Knobs, knobs_of
from rbl_gym.placement import scene_files
from rbl_gym.placement.layout_files import read_layout
from rbl_gym.placement.problem import PlacementTask
from rbl_gym.studies.placing import design
from rbl_gym.studies.placing.accuracy import accuracy
from tests.helpers import ROOT, is_legal, with_kernels

WAREHOUSE = str(ROOT / "examples" / "warehouse.toml")


@pytest.fixture(scope="module")
def warehouse() -> State:
    return open_state(scene_files.problem(WAREHOUSE))


@pytest.fixture(scope="module")
def room() -> State:
    return open_state(scene_files.problem("uwb_room"))


def placement_score(now: State) -> float:
    """`placement.score` over the poses of a world, by a task that has them."""
    problem, sample = now.world.problem, now.world.sample

    task = PlacementTask(problem.scene, len(now.anchors), n_poses=len(sample.places))
    # The property is cached: what stands there is taken.
    offsets = (sample.places - problem.context.centre) / problem.context.half
    task.__dict__["poses"] = sample.rotation, offsets
    return float(placement.score(task, problem.context, now.anchors))


# --- states ----------------------------------------------------------------------------------


def test_the_score_is_that_of_placement(warehouse):
    assert warehouse.score == pytest.approx(placement_score(warehouse), rel=1e-9)
    moved = move(warehouse, 2, np.array([-20.0, 3.0, 2.0]))
    assert moved.score == pytest.approx(placement_score(moved), rel=1e-9)
    assert moved.score != warehouse.score


def test_a_layout_opens_at_the_best_of_the_usual_ones(room):
    assert room.score == pytest.approx(min(usual_scores(room.world, 6).values()))
    assert not room.fixed.any()
    assert not room.past


def test_an_anchor_snaps_to_the_nearest_legal_mount(room):
    moved = move(room, 0, np.array([0.3, 0.2, 9.0]))
    high = room.world.problem.mounts.bounds()[1]
    np.testing.assert_allclose(moved.anchors[0], [0.3, 0.2, high[2]])
    np.testing.assert_array_equal(moved.anchors[1:], room.anchors[1:])
    assert is_legal(placement.task("uwb_room"), moved.anchors).all()
    np.testing.assert_array_equal(snap(room.world, moved.anchors[0]), moved.anchors[0])


def test_an_anchor_goes_neither_into_an_obstacle_nor_onto_another(room):
    base = room.world.base
    scene = dataclasses.replace(base.scene, obstacles=[[0.0, 0, 3, 1, 1, 3]])
    blocked = dataclasses.replace(base, scene=scene)
    start = open_state(blocked, room.anchors)
    assert move(start, 0, np.array([0.0, 0.0, 9.0])) is start
    assert move(room, 0, room.anchors[1]) is room
    assert move(room, 0, room.anchors[0]) is room
    with pytest.raises(ValueError, match="another anchor is there"):
        add(room, room.anchors[1])


def test_undo_and_redo_go_through_the_layouts(room):
    one = move(room, 0, np.array([0.0, 0.0, 9.0]))
    two = remove(one, 3)
    assert undo(two).layout is one.layout
    assert undo(undo(two)).layout is room.layout
    assert undo(room) is room
    again = redo(redo(undo(undo(two))))
    assert again.layout is two.layout
    assert redo(again) is again
    # A change after undo leaves nothing to redo.
    assert redo(fix(undo(two), 1)).layout is not two.layout


def test_fixed_anchors_stay(room):
    held = fix(room, 1)
    assert fix(held, 1) is held
    for change in (lambda: move(held, 1, np.zeros(3)), lambda: remove(held, 1)):
        with pytest.raises(ValueError, match="anchor 2 is fixed"):
            change()
    *_, (done, found) = optimise(held)
    assert done == 1.0
    np.testing.assert_array_equal(found.anchors[1], room.anchors[1])
    np.testing.assert_array_equal(found.problem.fixed, room.anchors[[1]])
    assert found.score < held.score
    assert fix(held, 1, False).fixed.sum() == 0


def test_numbers_of_anchors_have_limits(room):
    few = set_layout(room, Layout(room.anchors[:3], room.fixed[:3]))
    with pytest.raises(ValueError, match="at least 3"):
        remove(few, 0)
    many = set_layout(room, Layout(np.zeros((256, 3)), np.zeros(256, bool)))
    for change in (add, add_best):
        with pytest.raises(ValueError, match="256"):
            change(many)
    with pytest.raises(ValueError, match="1 to 6, got 7"):
        move(room, 6, np.zeros(3))


def test_one_more_anchor_helps_most_where_it_is_best(room):
    far, best = add(room), add_best(room)
    assert len(far.anchors) == len(best.anchors) == 7
    assert best.score < room.score
    assert best.score <= far.score * (1 + 1e-9)
    assert is_legal(placement.task("uwb_room"), far.anchors).all()


@pytest.mark.parametrize("name", ["room", pytest.param("warehouse", marks=with_kernels)])
def test_optimising_only_gets_better_and_is_one_change(name, request):
    start = request.getfixturevalue(name)
    for k in range(1, 4):
        start = move(start, k, start.anchors[0] + 0.3 * k)
    steps = list(optimise(start))
    scores = [start.score, *(found.score for _, found in steps)]
    assert (np.diff(scores) <= 1e-12).all()
    assert scores[-1] < 0.9 * scores[0]
    assert undo(steps[-1][1]).layout is start.layout
    assert steps[-1][1].world.setting.legal(steps[-1][1].anchors).all()
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)


def test_a_state_opens_with_fixed_anchors_and_refuses_illegal_ones(room):
    problem = room.world.base
    held = dataclasses.replace(problem, fixed=room.anchors[:2])
    start = open_state(held)
    np.testing.assert_array_equal(start.anchors[:2], room.anchors[:2])
    assert start.fixed.tolist() == [True, True, False, False, False, False]
    # A complete layout is one to go on with.
    whole = open_state(dataclasses.replace(problem, fixed=room.anchors))
    assert not whole.fixed.any()
    with pytest.raises(ValueError, match=r"anchors\[1\]"):
        open_state(problem, room.anchors * np.where(np.arange(6) == 1, 0.5, 1.0)[:, None])
    with pytest.raises(ValueError, match="3 to 256"):
        open_state(problem, room.anchors[:2])


def test_a_first_layout_has_no_two_anchors_at_one_place():
    pytest.importorskip("shapely")
    points = [[x, y, 3.0] for x in (0.0, 6.0) for y in (0.0, 4.0)]
    tables = {
        "mounts": [{"kind": "points", "points": points}],
        "anchors": {"number": 4},
        "region": {"low": [1, 1, 0.5], "high": [5, 3, 2]},
        "body": {"shape": "octahedron"},
        "noise": {"floor_m": 0.1},
    }
    start = open_state(scene_files.of_mapping(tables))
    assert sorted(start.anchors.tolist()) == points


# --- knobs -----------------------------------------------------------------------------------


def test_knobs_as_they_are_leave_the_problem_as_it_is(warehouse):
    assert warehouse.world.problem is warehouse.world.base
    assert knobs_of(warehouse.world.base) == pytest.approx(Knobs(0.1, 6, 0.8, 20.0))


def test_knobs_change_what_they_say(warehouse):
    noisy = turn_knobs(warehouse, noise_m=0.2)
    assert knobs_of(noisy.world.problem).noise_m == 0.2
    assert noisy.score > warehouse.score
    large = turn_knobs(warehouse, size_m=1.6)
    np.testing.assert_allclose(large.world.problem.tags, 2 * warehouse.world.base.tags)
    more = turn_knobs(warehouse, n_tags=9)
    assert more.world.problem.tags.shape == (9, 3)
    assert np.ptp(more.world.problem.tags, axis=0).max() == pytest.approx(0.8)
    clear = turn_knobs(warehouse, loss_db=0.0)
    assert clear.world.problem.obstacles.blocked_information == 1.0
    assert clear.score < warehouse.score


# --- maps ------------------------------------------------------------------------------------


def test_a_map_has_the_accuracy_of_its_cells(warehouse):
    found = maps.slice_map(warehouse)
    rows, columns = found.values.shape
    assert 600 <= rows * columns <= 1000
    low, high = warehouse.world.problem.corners()
    x = low[0] + (np.array([5, 20]) + 0.5) / columns * (high - low)[0]
    y = low[1] + (np.array([3, 9]) + 0.5) / rows * (high - low)[1]
    places = np.array([[x[0], y[0], 1.75], [x[1], y[1], 1.75]])
    zone = warehouse.world.problem.zones[0]
    want = accuracy(warehouse.world.problem, warehouse.anchors, places, zone).position
    np.testing.assert_allclose(found.values[[3, 9], [5, 20]], want, rtol=1e-9)
    # Inside of racks there is none.
    assert np.isnan(found.values).any()


def test_a_section_runs_over_x_and_z(warehouse):
    tilted = cut(warehouse, quantity="heading", up=2, share=0.25)
    assert tilted.slice == Slice("heading", 2, 0.25)
    assert plane(tilted)[0][1] == tilted.body[1] == -4.0
    found = maps.slice_map(tilted, maps.REFINED)
    assert found.low[1] == found.high[1] == -4.0
    assert found.values.size == pytest.approx(maps.REFINED, rel=0.1)


def test_the_body_moves_on_the_slice_and_past_racks(warehouse):
    moved = place_body(warehouse, np.array([5.0, 1.0, 9.0]))
    np.testing.assert_allclose(moved.body, [5.0, 1.0, 1.75])
    assert place_body(moved, np.array([5.0, 4.5, 0.0])).body.tolist() == moved.body.tolist()
    told = body_figures(moved)
    want = accuracy(moved.world.problem, moved.anchors, moved.body[None], moved.world.base.zones[0])
    assert told.position_m == pytest.approx(want.position[0])
    sees = moved.world.problem.obstacles.sees(moved.anchors, moved.body[None])[0]
    np.testing.assert_array_equal(told.seen > 0.5, sees)


def test_many_anchors_get_fewer_cells(warehouse):
    rng = np.random.default_rng(0)
    many = warehouse.world.problem.mounts.draw(rng.random((64, 3)))
    crowded = set_layout(warehouse, Layout(many, np.zeros(64, bool)))
    assert maps.slice_map(crowded).values.size <= 220


def test_the_picture_is_clear_off_the_zones_and_red_where_errors_are_large():
    values = np.full((8, 10), np.nan)
    values[:, :5], values[4:, :5] = 0.1, 0.4
    corner = np.zeros(3)
    found = maps.SliceMap(values, corner, corner + 1, 1, maps.QUANTITIES["position"], (0.1, 0.4))
    shown = maps.picture(found)
    height, width = shown.shape[:2]
    assert shown[:, -1, 3].max() == 0
    assert shown[:, 0, 3].min() > 0
    # The upper rows of the picture are those of large y.
    assert shown[0, 0, 0] > shown[0, 0, 2]
    assert shown[height - 1, 0, 0] < shown[height - 1, 0, 2]
    assert width / height == 10 / 8


@with_kernels
def test_colours_are_kept_while_a_layout_changes(warehouse):
    before = maps.slice_map(warehouse)
    *_, (_, better) = optimise(warehouse)
    during = maps.slice_map(better, before=before)
    assert during.limits == before.limits
    assert np.nanmean(during.values) < np.nanmean(before.values)
    other = cut(better, quantity="heading")
    assert maps.slice_map(other, before=before).limits != before.limits
    fresh = maps.slice_map(better)
    assert fresh.beside(fresh._replace(limits=(0.9 * fresh.limits[0], fresh.limits[1]))).limits != (
        fresh.limits
    )
    assert fresh.beside(fresh._replace(limits=(0.1, 9.0))).limits == fresh.limits


@with_kernels
def test_figures_follow_the_layout(warehouse):
    asking = dataclasses.replace(
        warehouse.world.base,
        zones=tuple(
            dataclasses.replace(zone, position_m=0.12) for zone in warehouse.world.base.zones
        ),
    )
    start = open_state(asking, warehouse.anchors)
    *_, (_, better) = optimise(start)
    before, after = figures(start), figures(better)
    assert after.score_m < before.score_m
    assert after.zones[0].share > before.zones[0].share
    np.testing.assert_allclose(
        figures(start, few=True).zones[0].share, before.zones[0].share, atol=0.2
    )


def test_the_panel_shows_names_as_text(warehouse):
    evil = "<img src=x onerror=alert(1)> {1+1}"
    zones = tuple(dataclasses.replace(z, name=evil) for z in warehouse.world.base.zones)
    start = open_state(dataclasses.replace(warehouse.world.base, zones=zones), warehouse.anchors)
    shown = Shown(start, figures(start), maps.slice_map(start), {"usual": None}, 2, 0.5, evil)
    for page in (headline(shown), status(shown)):
        assert "<img" not in page
        assert "&lt;img" in page


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.0031, "3.1 mm"), (0.0999, "10.0 cm"), (1.234, "1.23 m"), (12.34, "12.3 m"), (250, "250 m")],
)
def test_lengths_are_read_easily(metres, text):
    assert length(metres) == text


# --- the pointer -----------------------------------------------------------------------------


def test_the_pointer_takes_the_wall_that_is_near_the_anchor(room):
    low, high = room.world.problem.mounts.bounds()
    camera = np.array([0.0, low[1] - 20, high[2] - 1.0])
    level = np.array([1.0, 0.0, high[2] - 1.0])
    for near in (low[1], high[1]):
        anchor = np.array([0.0, near, high[2] - 1.0])
        found = under_pointer(room.world, camera, level, anchor)
        assert found[1] == pytest.approx(near)
        # On the line of sight.
        assert np.cross(found - camera, level - camera) == pytest.approx(0, abs=1e-6)


def test_the_pointer_beside_the_room_takes_its_edge(room):
    high = room.world.problem.mounts.bounds()[1]
    camera = np.array([0.0, -30.0, 3.0])
    found = under_pointer(room.world, camera, np.array([0.0, 0.0, 60.0]), room.anchors[0])
    assert found[2] == pytest.approx(high[2])


# --- files -----------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", [WAREHOUSE, "uwb_room", "auv_buoys", "satellite"])
def test_a_saved_scene_is_the_same_problem(scene, tmp_path):
    problem = scene_files.problem(scene)
    tables = scene_files.load(scene) if scene.endswith(".toml") else files.tables_of(problem)
    start = turn_knobs(open_state(problem), noise_m=0.07, size_m=1.2, loss_db=10.0)
    start = move(start, 0, start.anchors[1] + 1.0)
    scene_path, list_path = files.save(start, tables, tmp_path / "new", "my layout")
    found = scene_files.problem(str(scene_path))
    np.testing.assert_array_equal(found.fixed, start.anchors)
    again = open_state(found)
    assert again.score == pytest.approx(start.score, rel=1e-12)
    np.testing.assert_allclose(read_layout(str(list_path)).positions, start.anchors, atol=1e-3)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "my layout.csv",
        "my layout.toml",
    ]


def test_losses_of_walls_are_saved_with_them(tmp_path):
    office = str(ROOT / "examples" / "office.toml")
    pytest.importorskip("shapely")
    start = turn_knobs(open_state(scene_files.problem(office)), loss_db=30.0)
    scene_path, _ = files.save(start, scene_files.load(office), tmp_path, "office")
    again = open_state(scene_files.problem(str(scene_path)))
    assert again.score == pytest.approx(start.score, rel=1e-9)


def test_a_saved_scene_finds_the_drawing_behind_it(room, tmp_path):
    tables = files.tables_of(room.world.base)
    (tmp_path / "plans").mkdir()
    tables["plan"] = {"image": "floor.png", "metres_per_pixel": 0.02}
    problem = scene_files.of_mapping({**tables, "anchors": {**tables["anchors"], "number": 6}},
                                     folder=tmp_path / "plans")  # fmt: skip
    start = open_state(problem, room.anchors)
    scene_path, _ = files.save(start, tables, tmp_path / "out", "x")
    found = scene_files.problem(str(scene_path)).plan
    assert found is not None
    assert os.path.normpath(str(found.image)) == str(tmp_path / "plans" / "floor.png")


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".", "..", "a\\b", "x" * 90, "/etc/x", "a\n"])
def test_names_of_files_stay_in_the_folder(name):
    if name == "a\n":
        assert files.check_name(name) == "a"
        return
    with pytest.raises(ValueError, match="name must be"):
        files.check_name(name)


def test_nobody_elses_file_is_written_over(room, tmp_path):
    tables = files.tables_of(room.world.base)
    (tmp_path / "mine.toml").write_text("name = 'mine'\n")
    (tmp_path / "list.csv").write_text("x_m\n")
    for name in ("mine", "list"):
        with pytest.raises(ValueError, match="choose another name"):
            files.save(room, tables, tmp_path, name)
    assert (tmp_path / "mine.toml").read_text() == "name = 'mine'\n"
    files.save(room, tables, tmp_path, "other")
    files.save(add(room), tables, tmp_path, "other")
    assert len(scene_files.problem(str(tmp_path / "other.toml")).fixed) == 7


def test_a_file_that_cannot_be_written_leaves_the_old_one(room, tmp_path):
    path = tmp_path / "x.toml"
    path.write_text("old")

    def write(_):
        raise RuntimeError

    with pytest.raises(RuntimeError):
        files.replace(path, write)
    assert [p.name for p in tmp_path.iterdir()] == ["x.toml"]
    assert path.read_text() == "old"


def test_a_layout_is_kept_as_it_is_worked_on(room, tmp_path):
    path = files.autosave(room, files.tables_of(room.world.base), tmp_path)
    np.testing.assert_array_equal(scene_files.problem(str(path)).fixed, room.anchors)


def test_the_last_session_is_offered_unless_it_was_saved_since(room, tmp_path):
    tables = files.tables_of(room.world.base)
    more = add(room)
    kept = files.autosave(more, tables, tmp_path)
    saved, _ = files.save(more, tables, tmp_path, "by hand")
    for seconds, offered in ((-5, True), (5, False)):
        at = kept.stat().st_mtime + seconds
        os.utime(saved, (at, at))
        found = files.last_session(room, tmp_path)
        assert (found is not None) is offered
    # Neither of these is a save of this problem.
    saved.write_text(saved.read_text().replace('"uwb_room"', '"another"'))
    (tmp_path / "broken.toml").write_text(f"# {files.HEAD}\nname =")
    (tmp_path / "other.toml").write_text("name = 'uwb_room'\n")
    for path in tmp_path.glob("*.toml"):
        os.utime(path, (kept.stat().st_mtime + 5 * (path != kept),) * 2)
    found = files.last_session(room, tmp_path)
    assert found is not None
    np.testing.assert_array_equal(found, more.anchors)


# --- the page without a server ---------------------------------------------------------------


class NoDisplay:
    """Shows nothing."""

    def __init__(self, *_):
        self.panel = self

    def offer_restore(self, visible):
        self.offered = visible

    def show(self, shown):
        self.shown = shown

    def notify(self, *_):
        pass


@pytest.fixture
def opened(tmp_path, monkeypatch):
    """Opens pages without a server; a search finds the grid around the fixed anchors."""
    searched, pages = [], []

    def search(problem, seed):
        searched.append(problem.fixed)
        grid = design.usual_layouts(problem, seed)["grid"][len(problem.fixed) :]
        return design.Design(np.concatenate([problem.fixed, grid]), "grid", {})

    def opening(start):
        page = PlacePage(None, start, files.tables_of(start.world.base), tmp_path)
        pages.append(page)
        assert page.settle()
        return page

    monkeypatch.setattr(place, "Display", NoDisplay)
    monkeypatch.setattr(place.design, "design_layout", search)
    opening.searched = searched  # pyrefly: ignore[missing-attribute]
    yield opening
    for page in pages:
        page.stop()


def designed(page: PlacePage) -> float:
    """b of the designed layout, once it was searched beside the page."""
    end = time.monotonic() + 30
    display: Any = page._display
    while display.shown.others.get("designed") is None:
        assert time.monotonic() < end
        time.sleep(0.01)
    return float(display.shown.others["designed"])


def worse(room: State) -> State:
    """Anchors near one another: much is to be gained."""
    return open_state(room.world.base, snap(room.world, room.anchors * [0.2, 0.2, 1.0] + [2, 2, 3]))


@with_kernels
def test_an_optimised_layout_is_in_the_autosave(room, opened, tmp_path):
    page = opened(worse(room))
    before = page.state.score
    page.optimise()
    assert page.settle()
    assert page.state.score < before
    kept = scene_files.problem(str(tmp_path / "uwb_room-layout-autosave.toml")).fixed
    np.testing.assert_array_equal(kept, page.state.anchors)


@with_kernels
def test_an_optimisation_is_in_the_autosave_as_it_goes_and_when_stopped(
    room, opened, tmp_path, monkeypatch
):
    steps = [move(room, 0, np.array([0.1 * step, 0.0, 9.0])) for step in range(1, 5)]
    clock, seen = [0.0], []

    def kept():
        found = scene_files.problem(str(tmp_path / "uwb_room-layout-autosave.toml")).fixed
        return [np.array_equal(found, step.anchors) for step in steps].index(True)

    def search(*_):
        for number, better in enumerate(steps):
            clock[0] = 0.6 * number
            if number == 3:
                page.stop_work()
            yield 0.5, better
            seen.append(kept())

    monkeypatch.setattr(place.searches, "optimise", search)
    monkeypatch.setattr(keeping, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    page = opened(room)
    page.optimise()
    assert page.settle()
    # Once a second at most; and where it was stopped.
    assert seen == [0, 0, 2]
    assert kept() == 3


def test_a_saved_layout_is_not_kept_once_more(room, opened, tmp_path):
    page = opened(room)
    page.edit(add)
    page.settle()
    path = tmp_path / "uwb_room-layout-autosave.toml"
    page.save("by hand")
    page.cut(share=0.2)
    page.settle()
    os.utime(path, (1, 1))
    page.stop()
    assert path.stat().st_mtime == 1
    assert not opened(room)._display.offered


def test_what_is_designed_of_a_saved_file_is_designed_freely(room, opened, tmp_path):
    start = worse(room)
    scene, _ = files.save(start, files.tables_of(room.world.base), tmp_path, "by hand")
    page = opened(open_state(scene_files.problem(str(scene))))
    assert designed(page) < 0.8 * page.state.score
    assert [len(fixed) for fixed in opened.searched] == [0]
    # Those that the user fixed stay.
    again = opened(fix(page.state, 1))
    assert designed(again) < again.state.score
    np.testing.assert_array_equal(opened.searched[1], start.anchors[1:2])


# --- the worker ------------------------------------------------------------------------------


def test_the_worker_keeps_the_order_and_the_last_of_a_key():
    done, errors, gate = [], [], threading.Event()
    worker = Worker(errors.append)
    worker.post(gate.wait)
    for number in range(5):
        worker.post(lambda n=number: done.append(n), "drag")
    worker.post(lambda: done.append("after"))
    worker.post(lambda: 1 // 0)
    gate.set()
    assert worker.settle(5)
    assert done == [4, "after"]
    assert [type(error) for error in errors] == [ZeroDivisionError]
    worker.stop()


def test_tasks_come_between_the_steps_of_long_work():
    done: list = []
    worker = Worker(done.append)

    def steps():
        for number in range(3):
            if number == 1:
                worker.post(lambda: done.append("task"))
            done.append(number)
            yield

    worker.when_idle(steps())
    assert worker.settle(5)
    assert done == [0, 1, "task", 2]
    worker.stop()


def test_the_studio_says_what_it_cannot_show():
    with pytest.raises(ValueError, match="what must be a Problem"):
        studio.show("uwb_room", options=studio.Options(browser=False))
