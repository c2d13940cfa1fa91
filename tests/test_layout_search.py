"""Searches on the score: against brute force, never worse than their start."""

from __future__ import annotations

import dataclasses
import itertools
import sys

import numpy as np
import pytest

from rbl_gym import placement
from rbl_gym.placement import Context, layouts
from rbl_gym.placement import search as layout_search
from rbl_gym.placement.search import (
    SEARCHES,
    along_gradient,
    cma_es,
    expand,
    greedy,
    hybrid,
    shared_layout,
)
from tests.helpers import is_legal, needs

QUICK = {"generations": 6, "population": 6}


def problem(scene="uwb_room", n_anchors=2, batch=(), racks=0, seed=0, n_poses=5):
    task = dataclasses.replace(placement.task(scene, n_anchors, racks), n_poses=n_poses)
    return task, placement.draw_contexts(task, np.random.default_rng(seed), batch)


def rng(seed=1):
    return np.random.default_rng(seed)


def candidates_of(task, n=7, seed=2):
    return task.scene.anchor_region.draw(rng(seed).random((n, 3)))


def brute_greedy(task, context, candidates, swaps):
    """Greedy, and then single swaps, by scoring whole layouts."""
    chosen: list[int] = []

    def value(indices):
        return float(placement.score(task, context, candidates[list(indices)]))

    for _ in range(task.n_anchors):
        free = [k for k in range(len(candidates)) if k not in chosen]
        chosen.append(min(free, key=lambda k: value([*chosen, k])))
    improved = swaps
    while improved:
        improved = False
        for i in range(len(chosen)):
            free = [k for k in range(len(candidates)) if k not in chosen]
            new = min(free, key=lambda k: value([*chosen[:i], k, *chosen[i + 1 :]]))
            if value([*chosen[:i], new, *chosen[i + 1 :]]) < value(chosen) * (1 - 1e-9):
                chosen[i], improved = new, True
    return candidates[chosen]


@pytest.mark.parametrize("scene", ["uwb_room", "auv_buoys", "satellite"])
@pytest.mark.parametrize("swaps", [False, True])
@pytest.mark.parametrize("n_anchors", [1, 3])
def test_greedy_is_what_scoring_whole_layouts_gives(scene, swaps, n_anchors):
    task, context = problem(scene, n_anchors)
    candidates = candidates_of(task)
    found = greedy(task, context, rng(), candidates, swaps=swaps)
    np.testing.assert_array_equal(found, brute_greedy(task, context, candidates, swaps))


def test_greedy_past_racks_is_what_scoring_whole_layouts_gives():
    task, context = problem("uwb_room", 3, racks=2, seed=4)
    candidates = candidates_of(task)
    found = greedy(task, context, rng(), candidates, swaps=True)
    np.testing.assert_array_equal(found, brute_greedy(task, context, candidates, True))


@pytest.mark.parametrize("seed", range(5))
def test_swaps_come_near_the_best_of_all_and_leave_no_better_neighbour(seed):
    task, context = problem("drone_yard", 3, seed=seed)
    candidates = candidates_of(task, 8, seed)
    found = greedy(task, context, rng(), candidates, swaps=True)
    score = placement.score(task, context, found)
    best = min(
        float(placement.score(task, context, candidates[list(three)]))
        for three in itertools.combinations(range(8), 3)
    )
    assert best * (1 - 1e-9) <= score < 1.03 * best
    for i, new in itertools.product(range(3), candidates):
        neighbour = found.copy()
        neighbour[i] = new
        if len({tuple(anchor) for anchor in neighbour}) == 3:
            assert placement.score(task, context, neighbour) >= score * (1 - 1e-8)


def test_swaps_are_never_worse_than_greedy_and_greedy_than_its_random_candidates():
    task, context = problem("uwb_room", 4, (12,), racks=1)
    plain = placement.score(task, context, greedy(task, context, rng()))
    swapped = placement.score(task, context, layout_search.greedy_swaps(task, context, rng()))
    assert (swapped <= plain * (1 + 1e-9)).all()
    assert (swapped < plain * (1 - 1e-6)).any()
    chance = placement.score(task, context, layouts.random(task, context, rng()))
    assert (plain < chance).all()


def test_no_candidate_is_taken_twice():
    task, context = problem("uwb_room", 4)
    candidates = candidates_of(task, 4)
    found = greedy(task, context, rng(), candidates, swaps=True)
    assert {tuple(a) for a in found} == {tuple(a) for a in candidates}


def test_mounts_are_candidates_and_contexts_may_have_their_own():
    task, context = problem("uwb_room", 3, (2,))
    mounts = placement.mounts(task)
    found = greedy(task, context, rng(), mounts)
    assert {tuple(a) for a in found.reshape(-1, 3)} <= {tuple(a) for a in mounts}
    own = np.stack([candidates_of(task, seed=3), candidates_of(task, seed=4)])
    found = greedy(task, context, rng(), own)
    for i in range(2):
        one = Context(*(field[i] for field in context))
        np.testing.assert_array_equal(found[i], greedy(task, one, rng(), own[i]))


def test_best_of_random_is_the_best_of_the_same_draws():
    task, context = problem("auv_buoys", 3, (2,))
    found = layout_search.best_of_random(task, context, rng(), tries=20)
    drawn = task.scene.anchor_region.draw(rng().random((2, 20, 3, 3)))
    scores = placement.score(task, expand(context), drawn)
    for i in range(2):
        np.testing.assert_array_equal(found[i], drawn[i, scores[i].argmin()])


@needs("cmaes")
@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.parametrize("scene", ["uwb_room", "auv_buoys", "satellite"])
def test_searches_are_legal_deterministic_and_better_than_chance(name, scene):
    task, context = problem(scene, 4, (2, 1), n_poses=4)
    options = QUICK if name == "cma-es" else {}
    found = SEARCHES[name](task, context, rng(), **options)
    assert found.shape == (2, 1, 4, 3)
    assert is_legal(task, found).all()
    assert found.tobytes() == SEARCHES[name](task, context, rng(), **options).tobytes()
    chance = layouts.random(task, expand(expand(context)), rng(5))
    chance = placement.score(task, expand(expand(context)), chance)[..., 0, 0]
    assert np.log(placement.score(task, context, found)).mean() < np.log(chance).mean()
    single = Context(*(field[0, 0] for field in context))
    assert SEARCHES[name](task, single, rng(), **options).shape == (4, 3)


@pytest.mark.parametrize(("scene", "racks"), [("uwb_room", 1), ("drone_yard", 0), ("satellite", 0)])
def test_along_the_gradient_it_is_better_than_the_ring_and_than_swaps(scene, racks):
    task, context = problem(scene, 4, (6,), racks=racks, n_poses=16)
    found = np.log(placement.score(task, context, along_gradient(task, context, rng())))
    others = layouts.ring(task, context, rng()), layout_search.greedy_swaps(task, context, rng())
    ring, swapped = (np.log(placement.score(task, context, other)) for other in others)
    assert found.mean() < min(ring.mean(), swapped.mean())
    longest = np.log(placement.score(task, context, hybrid(task, context, rng())))
    assert longest.mean() < found.mean() + 1e-4


def test_along_the_gradient_a_given_start_is_never_made_worse():
    task, context = problem("uwb_room", 4, (4,), racks=1, n_poses=16)
    start = layouts.random(task, context, rng())
    before = placement.score(task, context, start)
    after = placement.score(task, context, along_gradient(task, context, rng(), 10, start))
    assert (after <= before * (1 + 1e-9)).all()
    assert np.log(after).mean() < np.log(before).mean() - 0.1
    shared = along_gradient(task, context, rng(), 10, start[0])
    each = along_gradient(task, context, rng(), 10, np.broadcast_to(start[0], start.shape))
    np.testing.assert_array_equal(shared, each)


@needs("cmaes")
@pytest.mark.parametrize("scene", ["uwb_room", "auv_buoys", "satellite"])
def test_cma_es_is_never_worse_than_its_start(scene):
    task, context = problem(scene, 4, (3,))
    start = layouts.random(task, context, rng())
    before = placement.score(task, context, start)
    for generations in (0, 1, 8):
        found = cma_es(task, context, rng(), generations, 6, start)
        after = placement.score(task, context, found)
        assert (after <= before * (1 + 1e-9)).all()
    assert (after < before).any()
    shared = cma_es(task, context, rng(), 0, start=start[0])
    np.testing.assert_allclose(shared, np.broadcast_to(start[0], shared.shape), atol=1e-6)


@needs("cmaes")
def test_more_generations_are_never_worse():
    task, context = problem("drone_yard", 3, (2,))
    scores = [
        placement.score(task, context, cma_es(task, context, rng(), n, 6)) for n in (0, 5, 20)
    ]
    assert (scores[1] <= scores[0]).all()
    assert (scores[2] <= scores[1]).all()


@needs("cmaes")
def test_a_shared_layout_is_good_for_all():
    task, contexts = problem("auv_buoys", 4, (6,))
    found = shared_layout(task, contexts, rng(), 15, 8)
    assert found.shape == (4, 3)
    assert is_legal(task, found).all()
    assert found.tobytes() == shared_layout(task, contexts, rng(), 15, 8).tobytes()
    chance = task.scene.anchor_region.draw(rng(7).random((50, 1, 4, 3)))
    logs = np.log(placement.score(task, contexts, chance)).mean(axis=-1)
    assert np.log(placement.score(task, contexts, found)).mean() < logs.mean() - 0.3


def test_expand_adds_an_axis_for_layouts():
    _, context = problem("uwb_room", 3, (2, 5), racks=2)
    shapes = [field.shape for field in expand(context)]
    assert shapes == [(2, 5, 1, 3), (2, 5, 1, 3), (2, 5, 1, 2, 6)]


def test_without_cmaes_the_message_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cmaes", None)
    task, context = problem()
    for search in (cma_es, lambda *args: shared_layout(task, expand(context), rng())):
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'rbl-gym\[placement\]'"):
            search(task, context, rng())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t, c: greedy(t, c, rng(), np.zeros((1, 3))), "candidates must be at least n_an"),
        (lambda t, c: greedy(t, c, rng(), np.full((9, 3), np.nan)), "candidates must be finite"),
        (lambda t, c: greedy(t, c, rng(), np.zeros((9, 2))), "candidates must have shape"),
        (lambda t, c: layout_search.best_of_random(t, c, rng(), 0), "tries must be"),
        (lambda t, c: cma_es(t, c, rng(), start=np.zeros((3, 3))), "start must have shape"),
        (lambda t, c: along_gradient(t, c, rng(), start=np.zeros((3, 3))), "start must have shape"),
        (lambda t, c: cma_es(t, c, rng(), start=np.full((2, 3), np.inf)), "start must be finite"),
        (lambda t, c: shared_layout(t, c, rng()), "contexts must have one batch axis"),
    ],
)
def test_bad_arguments_are_named(call, message):
    task, context = problem()
    with pytest.raises(ValueError, match=message):
        call(task, context)
