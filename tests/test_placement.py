"""Placement problems: contexts and scores against textbook loops, and properties of scores."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest
from scipy import stats

from rbl_gym.geometry import rotations
from rbl_gym.placement import Context, PlacementTask
from rbl_gym.placement import criteria as layout_criteria
from rbl_gym.placement import problem as placement
from rbl_gym.worlds import scenes
from tests.helpers import is_legal
from tests.test_obstacles import depth_by_sampling

TASKS = {
    "uwb_room": (None, 0), "room with racks": (5, 2), "drone_yard": (None, 0),
    "auv_buoys": (None, 0), "satellite": (None, 0), "icassp2013": (None, 0),
}  # fmt: skip
every_task = pytest.mark.parametrize("kind", TASKS)


def make(kind: str, n_poses: int = 6, **fields) -> PlacementTask:
    """A task with few poses, so that the loops below are quick."""
    n_anchors, racks = TASKS[kind]
    scene = "uwb_room" if racks else kind
    task = placement.task(scene, n_anchors, racks)
    return dataclasses.replace(task, n_poses=n_poses, **fields)


def problem(task: PlacementTask, seed=0, batch=(), layouts=()):
    """Contexts of the batch, and layouts drawn for each."""
    rng = np.random.default_rng(seed)
    context = placement.draw_contexts(task, rng, batch)
    anchors = task.scene.anchor_region.draw(rng.random((*layouts, *batch, task.n_anchors, 3)))
    return context, anchors


def skew(a):
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def textbook(task: PlacementTask, context: Context, anchors):
    """Posterior covariances (P, 6, 6), b (P,), and the middles W (P, 6, 6), by loops."""
    tags = np.array(task.scene.tags)
    reference = getattr(task.scene.noise, "reference_tag", None)
    law: Any = task.scene.noise
    low, high = np.array(task.scene.volume.low), np.array(task.scene.volume.high)
    prior = np.diag([math.radians(60) ** -2] * 3 + [((high - low).max() / 2) ** -2] * 3)
    covariances, scores, middles = [], [], []
    for Q, offset in zip(*task.poses, strict=True):
        t = context.centre + offset * context.half
        F = prior.copy()
        for a in anchors:
            depths = [depth_by_sampling(a, t, rack, 4001) for rack in context.racks]
            assert all(abs(depth) > 1e-3 for depth in depths), "choose another seed"
            share = 0.01 if any(depth > 0 for depth in depths) else 1.0
            for c in tags:
                r = np.linalg.norm(Q @ c + t - a)
                scale = r if reference is None else np.linalg.norm(Q @ tags[reference] + t - a)
                unit = (Q @ c + t - a) / r
                gradient = np.concatenate([np.cross(Q @ c, unit), unit])
                variance = law.floor_m**2 + (law.proportional * scale) ** 2
                F += share * np.outer(gradient, gradient) / variance
        P = np.linalg.inv(F)
        W = np.zeros((6, 6))
        for c in tags:
            J = np.hstack([-skew(Q @ c), np.eye(3)])
            W += J.T @ J / len(tags)
        covariances.append(P)
        scores.append(math.sqrt(np.trace(W @ P)))
        middles.append(W)
    return np.array(covariances), np.array(scores), np.array(middles)


# --- tasks and contexts -----------------------------------------------------------------------


def test_the_tasks_are_those_of_the_reference():
    numbers = {"uwb_room": 6, "drone_yard": 6, "auv_buoys": 4, "satellite": 5}
    for name, n_anchors in numbers.items():
        task = placement.task(name)
        assert (task.n_anchors, task.racks, task.n_poses) == (n_anchors, 0, 32)
    assert placement.task("uwb_room", racks=2).n_anchors == 5
    assert placement.task("uwb_room", 3, 1).n_anchors == 3
    std = 1 / np.sqrt(np.diag(placement.task("uwb_room").prior_information))
    np.testing.assert_allclose(std, [math.pi / 3] * 3 + [4] * 3)
    std = 1 / np.sqrt(np.diag(placement.task("auv_buoys").prior_information))
    np.testing.assert_allclose(std[3:], 150)


def test_poses_are_fixed_and_fill_the_region():
    rotation, offsets = placement.task("uwb_room").poses
    for other in (placement.task("satellite"), placement.task("uwb_room", 3, 2)):
        np.testing.assert_array_equal(other.poses[0], rotation)
        np.testing.assert_array_equal(other.poses[1], offsets)
    assert np.abs(offsets).max() <= 1
    assert (np.abs(offsets).max(axis=0) > 0.8).all()
    np.testing.assert_allclose(rotations.log(rotation).shape, (32, 3))
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2), [np.eye(3)] * 32, atol=1e-12
    )


@every_task
def test_regions_lie_in_the_volume_and_are_uniform(kind):
    task = make(kind)
    context, _ = problem(task, 1, (4000,))
    low, high = task.scene.volume.bounds()
    assert (context.centre - context.half >= low - 1e-9).all()
    assert (context.centre + context.half <= high + 1e-9).all()
    share = context.half / (0.5 * (high - low))
    room = (context.centre - context.half - low) / np.maximum(high - low - 2 * context.half, 1e-12)
    for i, (least, most) in enumerate([(0.15, 0.6), (0.15, 0.6), (0.3, 1)]):
        uniform = stats.uniform(least, most - least)
        assert stats.kstest(share[:, i], uniform.cdf).pvalue > 1e-3
        assert stats.kstest(room[:, i], stats.uniform(0, 1).cdf).pvalue > 1e-3
    places = placement.positions(task, context)
    assert (np.abs(places - context.centre[:, None]) <= context.half[:, None] + 1e-9).all()


def test_racks_stand_on_the_floor_in_the_middle_of_the_room():
    task = placement.task("uwb_room", racks=2)
    racks = placement.draw_contexts(task, np.random.default_rng(2), (2000,)).racks
    assert racks.shape == (2000, 2, 6)
    x, y, z, hx, hy, hz = np.moveaxis(racks, -1, 0)
    np.testing.assert_array_equal(z, hz)
    thin, long = np.minimum(hx, hy), np.maximum(hx, hy)
    # 4.5 standard deviations of a share of 4000 coins.
    assert abs((hx > hy).mean() - 0.5) < 4.5 * 0.5 / 4000**0.5
    ranges = {"x": (x, 1.5, 8.5), "y": (y, 1.2, 6.8), "thin": (thin, 0.2, 0.4),
              "long": (long, 1, 2), "height": (hz, 0.6, 1.2)}  # fmt: skip
    for values, low, high in ranges.values():
        assert stats.kstest(values.ravel(), stats.uniform(low, high - low).cdf).pvalue > 1e-3


@every_task
def test_contexts_are_functions_of_their_uniforms(kind):
    task = make(kind)
    size = placement.context_uniforms(task)
    assert size == 6 + 6 * task.racks
    uniforms = np.random.default_rng(3).random((2, 3, size))
    many = placement.build_contexts(task, uniforms)
    drawn = placement.draw_contexts(task, np.random.default_rng(3), (2, 3))
    for a, b in zip(many, drawn, strict=True):
        np.testing.assert_array_equal(a, b)
    for index in np.ndindex(2, 3):
        one = placement.build_contexts(task, uniforms[index])
        for a, b in zip(many, one, strict=True):
            np.testing.assert_array_equal(a[index], b)
    assert many.racks.shape == (2, 3, task.racks, 6)


def test_the_whole_volume_is_a_context():
    task = placement.task("drone_yard")
    context = placement.whole_volume(task)
    np.testing.assert_allclose([*context.centre, *context.half], [0, 0, 22.5, 50, 50, 17.5])
    assert context.racks.shape == (0, 6)
    assert placement.score(task, context, problem(task)[1]).shape == ()


# --- scores -----------------------------------------------------------------------------------


@every_task
def test_score_and_criteria_against_the_textbook(kind):
    task = make(kind)
    context, anchors = problem(task, 5, (2,))
    scores = placement.score(task, context, anchors)
    criteria = layout_criteria.criteria(task, context, anchors)
    for i in range(2):
        one = Context(*(field[i] for field in context))
        P, b, W = textbook(task, one, anchors[i])
        np.testing.assert_allclose(scores[i], math.sqrt((b**2).mean()), rtol=1e-9)
        # The error in metres at the tags has the eigenvalues of W P.
        values = np.array(
            [np.sort(np.linalg.eigvals(w @ p).real) for w, p in zip(W, P, strict=True)]
        )
        volume = np.linalg.det(W) * np.linalg.det(P)
        wanted = {
            "score_m": math.sqrt((b**2).mean()),
            "position_m": math.sqrt(np.mean([np.trace(p[3:, 3:]) for p in P])),
            "rotation_rad": math.sqrt(np.mean([np.trace(p[:3, :3]) for p in P])),
            "d_optimal_m": math.exp(np.log(volume).mean() / 12),
            "e_optimal_m": math.sqrt(values[:, -1].mean()),
            "worst_m": b.max(),
        }
        for name, value in wanted.items():
            np.testing.assert_allclose(getattr(criteria, name)[i], value, rtol=1e-8, err_msg=name)


def test_conditioning_is_that_of_the_weighted_anchors_less_their_mean():
    task = make("drone_yard", n_poses=3)
    context, anchors = problem(task, 6)
    logs = []
    for t in context.centre + task.poses[1] * context.half:
        r = np.linalg.norm(anchors - t, axis=-1)
        weights = 1 / (4 * r**2 * (0.1**2 + (0.001 * r) ** 2))
        mean = weights @ anchors / weights.sum()
        logs.append(math.log(np.linalg.cond(np.sqrt(weights)[:, None] * (anchors - mean))))
    got = layout_criteria.criteria(task, context, anchors).conditioning
    np.testing.assert_allclose(got, math.exp(np.mean(logs)), rtol=1e-9)


@pytest.mark.parametrize("n_anchors", [1, 2, 3])
def test_conditioning_of_too_few_anchors_is_infinite(n_anchors):
    task = placement.task("auv_buoys", n_anchors)
    context, anchors = problem(task, 7, (2,))
    criteria = layout_criteria.criteria(task, context, anchors)
    assert np.isposinf(criteria.conditioning).all()
    assert all(np.isfinite(value).all() for value in criteria[:-1])


def test_conditioning_of_flat_and_of_coincident_anchors_is_huge_but_a_number():
    task = placement.task("drone_yard", 5)
    context, anchors = problem(task, 8)
    flat = anchors * [1, 1, 0]
    assert layout_criteria.criteria(task, context, flat).conditioning > 1e11
    same = np.broadcast_to(anchors[:1], anchors.shape)
    criteria = layout_criteria.criteria(task, context, same)
    assert all(np.isfinite(value) for value in criteria)


def test_tags_on_a_line_have_criteria_too():
    scene = scenes.get({"name": "drone_yard", "tags": [[-1, 0, 0], [0, 0, 0], [1, 0, 0]]})
    task = placement.task(scene)
    context, anchors = problem(task, 9)
    criteria = layout_criteria.criteria(task, context, anchors)
    assert np.isfinite(criteria).all()
    np.testing.assert_allclose(criteria.score_m, placement.score(task, context, anchors))


@every_task
def test_information_is_additive_over_the_anchors(kind):
    task = make(kind)
    context, anchors = problem(task, 10, (3,))
    total = placement.information(task, context, anchors)
    parts = [
        placement.information(task, context, anchors[:, m : m + 1]) for m in range(task.n_anchors)
    ]
    np.testing.assert_allclose(total, sum(parts), rtol=1e-9, atol=1e-9 * np.abs(total).max())
    np.testing.assert_allclose(
        placement.score_of(task, np.sum(parts, axis=0)),
        placement.score(task, context, anchors),
        rtol=1e-9,
    )


@every_task
def test_the_order_of_anchors_does_not_matter_and_more_never_hurt(kind):
    task = make(kind)
    context, anchors = problem(task, 11, (4,))
    scores = placement.score(task, context, anchors)
    shuffled = placement.score(
        task, context, anchors[:, np.random.default_rng(0).permutation(task.n_anchors)]
    )
    np.testing.assert_allclose(shuffled, scores, rtol=1e-9)
    fewer = placement.score(task, context, anchors[:, :-1])
    assert (fewer > scores).all()


@every_task
def test_batches_are_loops(kind):
    task = make(kind)
    context, anchors = problem(task, 12, (2, 3), (4,))
    scores = placement.score(task, context, anchors)
    criteria = layout_criteria.criteria(task, context, anchors)
    assert scores.shape == (4, 2, 3)
    for index in np.ndindex(scores.shape):
        one = Context(*(field[index[1:]] for field in context))
        np.testing.assert_allclose(
            scores[index], placement.score(task, one, anchors[index]), rtol=1e-9
        )
        alone = layout_criteria.criteria(task, one, anchors[index])
        for a, b in zip(criteria, alone, strict=True):
            np.testing.assert_allclose(a[index], b, rtol=1e-6)
    # One layout for all contexts, and many layouts of one context.
    shared = placement.score(task, context, anchors[0, 0, 0])
    np.testing.assert_allclose(shared[0, 0], scores[0, 0, 0], rtol=1e-9)
    one = Context(*(field[1, 2] for field in context))
    np.testing.assert_allclose(
        placement.score(task, one, anchors[:, 1, 2]), scores[:, 1, 2], rtol=1e-9
    )
    with pytest.raises(ValueError, match="anchors must not be empty"):
        placement.score(task, context, anchors[:0])


def test_moving_region_racks_and_anchors_together_changes_no_score():
    task = make("room with racks")
    context, anchors = problem(task, 14, (6,))
    scores = placement.score(task, context, anchors)
    shift = np.array([3.0, -2, 0.5])
    racks = context.racks + np.concatenate([shift, np.zeros(3)])
    moved = placement.score(
        task, Context(context.centre + shift, context.half, racks), anchors + shift
    )
    np.testing.assert_allclose(moved, scores, rtol=1e-9)


def test_a_world_of_another_size_has_scores_of_that_size():
    """In centimetres every length, and the score, is a hundred times as large."""
    task = make("drone_yard")
    context, anchors = problem(task, 15, (3,))
    noise: Any = task.scene.noise
    k = 100.0
    grown = scenes.get({
        "name": "drone_yard",
        "volume": {name: [k * x for x in getattr(task.scene.volume, name)]
                   for name in ("low", "high")},
        "tags": (k * np.array(task.scene.tags)).tolist(),
        "noise": {"floor_m": k * noise.floor_m},
    })  # fmt: skip
    large = placement.score(
        dataclasses.replace(task, scene=grown),
        Context(k * context.centre, k * context.half, context.racks),
        k * anchors,
    )
    np.testing.assert_allclose(large, k * placement.score(task, context, anchors), rtol=1e-9)


def test_blocked_links_carry_one_percent():
    task = make("room with racks")
    region = Context(np.array([5.0, 4, 1.2]), np.array([0.3, 0.3, 0.3]), np.empty((0, 6)))
    anchors = np.array([[0.0, 4, 1], [10, 4, 1], [5, 0, 1], [5, 8, 2], [2, 2, 3]])
    alone = [placement.information(task, region, anchors[m : m + 1]) for m in range(5)]
    # A wall of a rack before the first anchor; behind the last one, out of the way, another.
    racks = np.array([[1.0, 4, 1, 0.2, 2, 1.2], [0.5, 0.5, 1, 0.2, 0.3, 1.0]])
    blocked = region._replace(racks=racks)
    seen = np.array([0, 1, 1, 1, 1.0])
    np.testing.assert_array_equal(placement.sight_fractions(task, blocked, anchors), seen)
    shares = np.where(seen > 0, 1.0, 0.01)
    wanted = sum(share * part for share, part in zip(shares, alone, strict=True))
    np.testing.assert_allclose(placement.information(task, blocked, anchors), wanted, rtol=1e-9)
    scene = dataclasses.replace(task.scene, blocked_information=0.0)
    dark = dataclasses.replace(task, scene=scene)
    np.testing.assert_allclose(placement.information(dark, blocked, anchors), sum(alone[1:]))


def test_an_anchor_that_sees_nothing_and_anchors_in_one_place_score_badly():
    """No pseudo-inverse: what is not known costs the prior."""
    task = placement.task("auv_buoys")
    context, anchors = problem(task, 16)
    one_place = np.broadcast_to(anchors[:1], anchors.shape)
    assert placement.score(task, context, one_place) > 10 * placement.score(task, context, anchors)
    nothing = placement.score_of(task, np.zeros((task.n_poses, 6, 6)))
    _, _, W = textbook(task, Context(*(f[()] for f in context)), anchors[:0])
    prior = np.linalg.inv(task.prior_information)
    np.testing.assert_allclose(nothing**2, np.trace(W @ prior, axis1=-2, axis2=-1).mean())


def test_random_layouts_of_the_room_score_as_measured():
    """Reference: .282 m, geometric mean, in the room with two racks (M = 5)."""
    task = placement.task("uwb_room", racks=2)
    context, anchors = problem(task, 17, (48,), (8,))
    mean = np.exp(np.log(placement.score(task, context, anchors)).mean())
    assert abs(mean / 0.282 - 1) < 0.1


# --- mounts and sight -------------------------------------------------------------------------


def test_the_mounts_are_those_of_the_reference():
    wanted = set()
    for z in (0.3, 1.6, 3.0):
        wanted |= {(x, y, z) for x in (0, 2.5, 5, 7.5, 10) for y in (0, 8)}
        wanted |= {(x, y, z) for x in (0, 10) for y in (2, 4, 6)}
    wanted |= {(x, y, 3.0) for x in (2.5, 5, 7.5) for y in (2, 4, 6)}
    task = placement.task("uwb_room")
    points = placement.mounts(task)
    assert points.shape == (57, 3)
    assert {tuple(point) for point in points.round(9)} == wanted
    assert is_legal(task, points).all()


def test_mounts_need_walls():
    with pytest.raises(ValueError, match="scene must have walls for mount points, got 'auv_buoys'"):
        placement.mounts(placement.task("auv_buoys"))


def test_sight_fractions_count_poses():
    task = make("room with racks", n_poses=16)
    context, anchors = problem(task, 18, (3,))
    fractions = placement.sight_fractions(task, context, anchors)
    for i, m in np.ndindex(fractions.shape):
        count = 0
        for place in context.centre[i] + task.poses[1] * context.half[i]:
            depths = [depth_by_sampling(anchors[i, m], place, rack) for rack in context.racks[i]]
            count += max(depths) < 0
        np.testing.assert_allclose(fractions[i, m], count / 16)
    assert 0 < fractions.mean() < 1
    free = context._replace(racks=np.empty((3, 0, 6)))
    np.testing.assert_array_equal(placement.sight_fractions(task, free, anchors), np.ones((3, 5)))


# --- what is refused --------------------------------------------------------------------------


def test_what_a_task_keeps_cannot_be_written_to():
    task = placement.task("uwb_room", 4)
    for array in (*task.poses, task.prior_information):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("attic",), "scene must be one of"),
        (
            ("camsap2013",),
            "scene must have a volume, that of 'camsap2013' is a point",
        ),
        (("uwb_room", 0), "n_anchors must be an int from 1 to 1000000, got 0"),
        (("uwb_room", 2.0), "n_anchors must be an int from 1 to 1000000, got 2.0"),
        (("uwb_room", True), "n_anchors must be an int from 1 to 1000000, got True"),
        (("uwb_room", 4, 3), "racks must be an int from 0 to 2, got 3"),
        (("uwb_room", 4, -1), "racks must be an int from 0 to 2, got -1"),
        (("uwb_room", None, "two"), "racks must be an int from 0 to 2, got 'two'"),
        (("auv_buoys", 4, 1), "racks must be 0 outside a named room, got 1 in 'auv_buoys'"),
    ],
)
def test_bad_tasks_are_refused(arguments, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        placement.task(*arguments)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"scene": "uwb_room"}, "scene must be a Scene such as scenes.get"),
        ({"n_poses": 0}, "n_poses must be"),
    ],
)
def test_bad_fields_are_refused(fields, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        dataclasses.replace(placement.task("uwb_room"), **fields)


@pytest.mark.parametrize("function", [placement.score, layout_criteria.criteria])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"anchors": np.zeros((3, 2))}, "anchors must have shape (..., M, 3), got (3, 2)"),
        ({"anchors": np.zeros((0, 3))}, "anchors must have shape (..., M, 3), got (0, 3)"),
        ({"anchors": [[0, 0, np.nan]]}, "anchors must be finite, got nan at index (0, 2)"),
        ({"anchors": "here"}, "anchors must be an array of real numbers"),
        ({"centre": np.full(3, np.nan)}, "centre must be finite"),
        ({"half": np.ones(2)}, "half must have shape (..., 3), got (2,)"),
        ({"racks": np.ones((1, 5))}, "racks must have shape (..., K, 6), got (1, 5)"),
        ({"racks": np.full((1, 6), np.inf)}, "racks must be finite, got inf at index (0, 0)"),
    ],
)
def test_bad_problems_are_refused(function, change, message):
    task = placement.task("uwb_room")
    context, anchors = problem(task)
    arguments = {"anchors": anchors, **context._asdict(), **change}
    broken = Context(*(arguments[name] for name in Context._fields))
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        function(task, broken, arguments["anchors"])


def test_information_that_is_no_number_is_refused():
    task = placement.task("uwb_room")
    bad = np.full((task.n_poses, 6, 6), np.nan)
    with pytest.raises(ValueError, match="information must be positive definite"):
        placement.score_of(task, bad)
    with pytest.raises(ValueError, match="information must be positive definite"):
        placement.score_of(task, np.broadcast_to(-1e3 * np.eye(6), bad.shape))
