"""The search of `place`: samples, greedy and swaps, fresh candidates, descent, whole layouts."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from rbl_gym import placement
from rbl_gym.placement import design, scene_files, setting
from rbl_gym.placement.descent import descend
from rbl_gym.placement.exchange import choose, refresh, swap
from rbl_gym.placement.sample import of_context, sample
from tests.helpers import needs, with_kernels

shapely = needs("shapely")

HALL = {
    "name": "hall",
    "anchors": {"kind": "room", "low": [0, 0, 0.5], "high": [20, 12, 4], "number": 5},
    "region": {"low": [1, 1, 0.5], "high": [19, 11, 2]},
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.1, "proportional": 0.01},
}
WALLS = [
    {"low": [9.9, 0, 0], "high": [10.1, 8, 4]},
    {"low": [4, 5.9, 0], "high": [10, 6.1, 4]},
    {"low": [14, 3, 0], "high": [14.2, 12, 3]},
]
# Two rooms with a wall of little loss between them, mounts on walls only, one anchor that stays.
OFFICE = {
    "name": "office",
    "anchors": {"number": 6, "fixed": [[0.0, 0.0, 2.5]], "max_range_m": 15.0, "range_edge_m": 5.0,
                "half_angle_deg": 85.0},
    "mounts": [
        {"kind": "wall", "line": [[0, 0], [12, 0], [12, 8], [0, 8]], "closed": True,
         "low_m": 2.0, "high_m": 2.8, "side": "left"},
    ],
    "walls": [{"line": [[6, 0], [6, 6]], "thickness_m": 0.1, "low_m": 0, "high_m": 3,
               "information": 0.3}],
    "zones": [
        {"name": "left", "polygon": [[1, 1], [5, 1], [5, 7], [1, 7]], "low_m": 0.5, "high_m": 2.0,
         "weight": 3.0},
        {"name": "right", "polygon": [[7, 1], [11, 1], [11, 7]], "low_m": 0.5, "high_m": 2.0,
         "attitude": "heading"},
    ],
    "body": {"shape": "octahedron", "size_m": 0.8},
    "noise": {"floor_m": 0.1},
}  # fmt: skip


def rng(seed=1):
    return np.random.default_rng(seed)


def problem(tables=HALL, **more):
    return scene_files.of_mapping({**tables, **more})


def seen(problem, n_places=60):
    return setting.of_problem(problem, sample(problem, n_places))


@shapely
def test_samples_are_of_all_zones_by_their_weights():
    office = problem(OFFICE)
    poses = sample(office, 400, turns=2, seed=3)
    assert poses.weight.sum() == pytest.approx(1)
    for index, zone in enumerate(office.zones):
        of_zone = poses.zone == index
        assert of_zone.sum() >= 2 * 64
        assert poses.weight[of_zone].sum() == pytest.approx(zone.weight / 4)
        assert zone.contains(poses.places[of_zone]).all()
    np.testing.assert_array_equal(poses.places[::2], poses.places[1::2])
    assert np.abs(poses.rotation[::2] - poses.rotation[1::2]).max() > 0.1
    # Where the heading alone is estimated the body stands upright, and its tilt is known.
    upright = poses.zone == 1
    np.testing.assert_allclose(poses.rotation[upright][:, 2], [[0, 0, 1]] * upright.sum())
    assert (poses.prior[upright][:, 0, 0] > 1e6).all()
    assert (poses.prior[~upright][:, 0, 0] < 10).all()
    # A part has places of all zones.
    index = [poses.every(4, first) for first in range(4)]
    assert sorted(np.concatenate(index).tolist()) == list(range(len(poses.places)))
    part = poses.part(index[1])
    assert part.weight[part.zone == 0].sum() == pytest.approx(0.75)
    assert part.weight.sum() == pytest.approx(1)
    with pytest.raises(ValueError, match="n_places must be"):
        sample(office, 0)


def test_a_setting_of_an_environment_has_its_score():
    task = placement.task("uwb_room", None, 2)
    context = placement.draw_contexts(task, rng())
    one = setting.of_task(task, context)
    anchors = task.scene.anchor_region.draw(rng().random((task.n_anchors, 3)))
    expected = placement.score(task, context, anchors)
    assert one.score(anchors) == pytest.approx(float(expected), rel=1e-9)
    assert one.score_and_gradient(anchors)[0] == pytest.approx(float(expected), rel=1e-9)
    assert of_context(task, context).weight.sum() == pytest.approx(1)


@shapely
def test_parts_add_up_and_anchors_that_stay_are_in_the_prior():
    office = problem(OFFICE)
    free = office.mounts.draw(rng().random((5, 3)))
    one = seen(office)
    whole = setting.of_problem(dataclasses.replace(office, fixed=np.empty((0, 3))), one.sample)
    prior = sample(office, 60).prior
    whole = whole._replace(sample=whole.sample._replace(prior=prior))
    both = np.concatenate([office.fixed, free])
    np.testing.assert_allclose(one.told(free), whole.told(both), rtol=1e-9, atol=1e-9)
    assert one.score(free) == pytest.approx(whole.score_and_gradient(both)[0], rel=1e-9)
    _, gradient = one.score_and_gradient(free)
    np.testing.assert_allclose(gradient, whole.score_and_gradient(both)[1][1:], rtol=1e-7)


@pytest.mark.parametrize("obstacles", [[], WALLS], ids=["free", "walls"])
def test_greedy_is_that_of_whole_layouts(obstacles):
    one = seen(problem(obstacles=obstacles))
    candidates = one.region.draw(rng().random((30, 3)))
    found = choose(one, one.parts(candidates), 5)
    expected: list[int] = []
    for _ in range(5):
        free = [k for k in range(30) if k not in expected]
        expected.append(min(free, key=lambda k: one.score(candidates[[*expected, k]])))
    assert found == expected


def test_lazy_greedy_is_as_good_as_greedy_that_looks_at_all():
    one = seen(problem(obstacles=WALLS), 40)
    candidates = one.region.draw(rng().random((60, 3)))
    parts = one.parts(candidates)
    found = choose(one, parts, 14)
    assert len(set(found)) == 14
    total, expected = one.sample.prior, []
    for _ in range(14):
        squares = one.squares(total + parts)
        squares[expected] = np.inf
        expected.append(int(squares.argmin()))
        total = total + parts[expected[-1]]
    assert one.score(candidates[found]) <= 1.001 * one.score(candidates[expected])


def test_swaps_leave_no_better_neighbour():
    one = seen(problem(obstacles=WALLS), 40)
    candidates = one.region.draw(rng(4).random((9, 3)))
    parts = one.parts(candidates)
    start = [0, 1, 2]
    found = swap(one, parts, start, rounds=10)
    assert len(set(found)) == 3
    least = one.score(candidates[found])
    assert least < one.score(candidates[start])
    for place, new in itertools.product(range(3), set(range(9)) - set(found)):
        other = [*found[:place], new, *found[place + 1 :]]
        assert one.score(candidates[other]) > least * (1 - 1e-3)
    # As many as there are candidates: nothing to swap with.
    assert swap(one, parts, list(range(9))) == list(range(9))


@pytest.mark.parametrize(
    "tables",
    [{**HALL, "obstacles": WALLS}, pytest.param(OFFICE, marks=shapely)],
    ids=["hall", "office"],
)
def test_fresh_candidates_and_descent_stay_legal_and_never_hurt(tables):
    one = seen(problem(tables))
    anchors = one.region.draw(rng(2).random((200, 3)))
    anchors = anchors[one.legal(anchors)][:5]
    fresh, score = refresh(one, anchors, rng())
    assert one.legal(fresh).all()
    assert score < one.score(anchors)
    assert score == pytest.approx(one.score(fresh), rel=1e-9)
    moved, better = descend(one, fresh, 20)
    assert one.legal(moved).all()
    assert better <= score * (1 + 1e-9)
    assert better == pytest.approx(one.score(moved), rel=1e-9)
    again, _ = refresh(one, anchors, rng())
    assert again.tobytes() == fresh.tobytes()


@pytest.mark.parametrize("scene", ["auv_buoys", "drone_yard", "satellite", "uwb_room"])
def test_descent_finds_a_place_without_slope(scene):
    """In the legal space no small move of an anchor makes the score better by much."""
    task = placement.task(scene)
    one = setting.of_task(task, placement.draw_contexts(task, rng(3)))
    start = one.region.draw(rng(3).random((task.n_anchors, 3)))
    found, score = descend(one, start, 300)
    assert score < 0.95 * one.score(start)
    assert one.legal(found).all()
    size = 1e-4 * float(np.ptp(one.region.bounds(), axis=0).max())
    near = one.region.project(found + size * rng(4).normal(size=(60, *found.shape)))
    assert min(one.score(layout) for layout in near) > score * (1 - 1e-4)


@with_kernels
def test_layouts_are_legal_the_same_by_seed_and_better_past_walls_than_greedy(monkeypatch):
    monkeypatch.setattr(design, "STAGES", (64, 96, 96))
    monkeypatch.setattr(design, "_CANDIDATES", 80)
    monkeypatch.setattr(design, "_ANCHORS", 10)
    hall = problem(obstacles=WALLS)
    found, name = design.find_layout(hall, rng())
    assert name.startswith("greedy")
    again, _ = design.find_layout(hall, rng())
    assert found.tobytes() == again.tobytes()
    judge = setting.of_problem(hall, sample(hall, 500, seed=9))
    assert judge.legal(found).all()
    candidates = design.free_candidates(hall, rng(), 200)
    greedy = candidates[choose(judge, judge.parts(candidates), 5)]
    assert judge.score(found) < 0.97 * judge.score(greedy)


@shapely
def test_anchors_that_stay_come_first_and_starts_are_completed(monkeypatch):
    monkeypatch.setattr(design, "STAGES", (16, 16, 16))
    monkeypatch.setattr(design, "_CANDIDATES", 20)
    monkeypatch.setattr(design, "_ANCHORS", 5)
    office = problem(OFFICE)
    steps: list[int] = []
    start = office.mounts.draw(rng().random((2, 3)))
    found, _ = design.find_layout(office, rng(), {"given": start}, lambda: steps.append(1))
    assert found.shape == (6, 3)
    assert len(steps) == len(design.STAGES)
    np.testing.assert_array_equal(found[:1], office.fixed)
    assert setting.of_problem(office, sample(office, 9)).legal(found[1:]).all()
    every = dataclasses.replace(office, fixed=found)
    assert design.find_layout(every, rng())[1] == "fixed"


@shapely
def test_of_a_list_of_mounts_the_best_are_taken(monkeypatch):
    monkeypatch.setattr(design, "STAGES", (64, 64, 64))
    points = problem().mounts.draw(rng(5).random((9, 3))).tolist()
    listed = {key: value for key, value in HALL.items() if key != "anchors"}
    hall = scene_files.of_mapping({
        **listed, "anchors": {"number": 4}, "mounts": [{"kind": "points", "points": points}]
    })  # fmt: skip
    found, _ = design.find_layout(hall, rng())
    one = seen(hall, 64)
    best = min(
        one.score(np.array([points[k] for k in four]))
        for four in itertools.combinations(range(9), 4)
    )
    assert one.score(found) <= 1.01 * best
    assert np.abs(found[:, None] - np.array(points)).max(axis=-1).min(axis=-1).max() < 1e-9
