"""The usual layouts: legal, of the right shape, the same for the same generator, as described."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from rbl_gym import placement
from rbl_gym.placement import Context, layouts
from rbl_gym.placement.layouts import LAYOUTS
from tests.helpers import is_legal

SCENES = ("uwb_room", "drone_yard", "auv_buoys", "satellite", "icassp2013")
every_layout = pytest.mark.parametrize("name", LAYOUTS)
every_scene = pytest.mark.parametrize("scene", SCENES)


def problem(scene, n_anchors=None, batch=(), racks=0, seed=0):
    task = placement.task(scene, n_anchors, racks)
    return task, placement.draw_contexts(task, np.random.default_rng(seed), batch)


def rng(seed=1):
    return np.random.default_rng(seed)


@every_scene
@every_layout
def test_layouts_are_legal_whatever_the_scene_and_the_number(name, scene):
    for n_anchors in (1, 2, 3, 5, 9):
        task, context = problem(scene, n_anchors, (3,))
        anchors = layouts.layout(name, task, context, rng())
        assert anchors.shape == (3, n_anchors, 3)
        assert anchors.dtype == np.float64
        assert is_legal(task, anchors).all()
        assert np.isfinite(placement.score(task, context, anchors)).all()


@every_scene
@every_layout
def test_batches_are_loops_and_the_generator_decides(name, scene):
    task, context = problem(scene, batch=(2, 3))
    anchors = layouts.layout(name, task, context, rng())
    assert anchors.shape == (2, 3, task.n_anchors, 3)
    assert anchors.tobytes() == layouts.layout(name, task, context, rng()).tobytes()
    assert anchors.flags.writeable
    drawn = rng()
    for index in np.ndindex(2, 3):
        one = Context(*(field[index] for field in context))
        np.testing.assert_allclose(anchors[index], layouts.layout(name, task, one, drawn))
    assert layouts.layout(name, task, Context(*(f[:0] for f in context)), rng()).shape == (
        0, 3, task.n_anchors, 3,
    )  # fmt: skip


@every_scene
@every_layout
def test_anchors_stand_apart(name, scene):
    task, context = problem(scene)
    anchors = layouts.layout(name, task, context, rng())
    gaps = [np.linalg.norm(a - b) for a, b in itertools.combinations(anchors, 2)]
    low, high = task.scene.anchor_region.bounds()
    assert min(gaps) > 0.01 * np.linalg.norm(high - low)


@every_layout
def test_racks_do_not_move_the_usual_layouts(name):
    task, context = problem("uwb_room", 5, (2,), racks=2)
    bare = placement.task("uwb_room", 5)
    without = context._replace(racks=context.racks[:, :0])
    np.testing.assert_array_equal(
        layouts.layout(name, task, context, rng()), layouts.layout(name, bare, without, rng())
    )


def test_random_layouts_differ_and_are_drawn_by_the_region():
    task, context = problem("auv_buoys", batch=(2,))
    anchors = layouts.random(task, context, rng())
    assert (anchors[0] != anchors[1]).any()
    wanted = task.scene.anchor_region.draw(rng().random((2, 4, 3)))
    np.testing.assert_array_equal(anchors, wanted)


def test_corners_are_corners():
    task, context = problem("auv_buoys")
    anchors = layouts.corners(task, context, rng())
    wanted = {(x, y, 0.0) for x in (-200, 200) for y in (-200, 200)}
    assert {tuple(anchor) for anchor in anchors} == wanted
    task, context = problem("uwb_room", 4)
    x, y, z = layouts.corners(task, context, rng()).T
    np.testing.assert_allclose(x, [0, 10, 10, 0])
    np.testing.assert_allclose(y, [0, 0, 8, 8])
    np.testing.assert_allclose(z, [0.3, 3, 0.3, 3])


@pytest.mark.parametrize("scene", ["drone_yard", "uwb_room"])
def test_sixteen_corners_and_middles_are_all_different(scene):
    task, context = problem(scene, 16)
    anchors = layouts.corners(task, context, rng())
    assert len({tuple(anchor.round(9)) for anchor in anchors}) == 16


def test_the_grid_is_regular_and_on_the_ceiling():
    task, context = problem("uwb_room")
    anchors = layouts.grid(task, context, rng())
    wanted = {(x, y, 3.0) for x in (10 / 6, 5, 50 / 6) for y in (2.0, 6.0)}
    assert {tuple(a) for a in anchors.round(6)} == {tuple(a) for a in np.round(list(wanted), 6)}
    task, context = problem("uwb_room", 1)
    np.testing.assert_allclose(layouts.grid(task, context, rng()), [[5, 4, 3]])


def test_the_perimeter_is_walked_in_equal_steps():
    task, context = problem("uwb_room", 9)
    anchors = layouts.perimeter(task, context, rng())
    x, y, z = anchors.T
    low, high = task.scene.anchor_region.bounds()
    on_edge = np.isin(x, [low[0], high[0]]) | np.isin(y, [low[1], high[1]])
    assert on_edge.all()
    np.testing.assert_allclose(z, [0.3, 3] * 4 + [0.3])
    # Where each stands on the way around.
    way = np.where(y == 0, x, np.where(x == 10, 10 + y, np.where(y == 8, 28 - x, 36 - y)))
    np.testing.assert_allclose(np.diff(way), 36 / 9)


def test_the_ring_follows_the_region():
    task, context = problem("auv_buoys", batch=(20,))
    anchors = layouts.ring(task, context, rng(), width=0.5, height=0.25)
    radius = 0.5 * context.half[:, :2].mean(axis=-1) - 0.25 * context.centre[:, 2]
    away = anchors[..., :2] - context.centre[:, None, :2]
    inside = (np.abs(anchors[..., :2]) < 200).all(axis=(-1, -2))
    assert inside.sum() > 5
    np.testing.assert_allclose(
        np.linalg.norm(away, axis=-1)[inside], np.broadcast_to(radius[:, None], (20, 4))[inside]
    )
    np.testing.assert_allclose(away[inside].mean(axis=1), 0, atol=1e-9)


def test_layouts_of_a_shell_are_spread_over_a_sphere():
    task, context = problem("satellite", 9)
    for name in ("corners", "grid", "perimeter", "ring"):
        anchors = layouts.layout(name, task, context, rng())
        np.testing.assert_allclose(np.linalg.norm(anchors, axis=-1), 100)
        assert np.linalg.norm(anchors.mean(axis=0)) < 15


def test_the_ring_beats_random_and_the_grid_where_it_was_tuned():
    for scene in ("auv_buoys", "drone_yard"):
        task, context = problem(scene, batch=(48,))
        logs = {name: np.log(placement.score(task, context, layouts.layout(
            name, task, context, rng()))).mean() for name in LAYOUTS}  # fmt: skip
        assert min(logs, key=logs.__getitem__) == "ring"


def test_an_unknown_layout_is_refused():
    task, context = problem("uwb_room")
    with pytest.raises(ValueError, match=r"layout must be one of 'random', .*, got 'star'"):
        layouts.layout("star", task, context, rng())
