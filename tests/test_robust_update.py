"""The robust update: wrong links have no influence, right ones keep theirs."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import estimators, metrics, motion
from rbl_gym.estimators.costs.losses import cut_huber, huber, loss_of, redescending
from rbl_gym.geometry import bodies, rotations
from rbl_gym.measurements import ranging
from rbl_gym.studies import monte_carlo
from rbl_gym.worlds import scenes
from tests.helpers import random_world, simulate

NOISE = ranging.RangeNoise(0.05, 0.001)
PROCESS = motion.ProcessNoise(0.02, 0.1)
TAGS = bodies.octahedron(0.8)
COVARIANCE = np.diag([0.02] * 3 + [0.1] * 3)


def make(**options):
    return estimators.make("iekf", tags=TAGS, noise=NOISE, process=PROCESS, **options)


def problem(seed, trials=None):
    """Anchors, poses, ranges with 5 m on every seventh of them, and the mask of the good ones."""
    rng = np.random.default_rng(seed)
    batch = () if trials is None else (trials,)
    anchors, _, rotation, translation = random_world(rng, 6, 6, batch)
    ranges = simulate(rng, anchors, TAGS, rotation, translation, NOISE)
    good = np.arange(36).reshape(6, 6) % 7 > 0
    offset = rng.standard_normal((*batch, 6)) @ np.sqrt(COVARIANCE)
    prior = rotations.exp(offset[..., :3]) @ rotation, translation + offset[..., 3:]
    return anchors, rotation, translation, ranges + np.where(good, 0.0, 5.0), good, prior


@pytest.mark.parametrize("cutoff", [4.0, 2.0, np.inf])
def test_the_cut_loss_and_its_weights(cutoff):
    def loss(squared):
        return (a[0] for a in loss_of(squared[None], cut_huber(1.5, cutoff)))

    x = np.linspace(0.05, 6.0, 120)
    cost, weight = loss(x**2)
    inside = np.minimum(x, cutoff)
    want = np.where(inside < 1.5, 0.5 * inside**2, 1.5 * inside - 0.5 * 1.5**2)
    np.testing.assert_allclose(cost, want)
    # The derivative of the cost by x is the weight times x.
    slope = (next(loss((x + 1e-6) ** 2)) - next(loss((x - 1e-6) ** 2))) / 2e-6
    away = np.abs(x - cutoff) > 1e-3
    np.testing.assert_allclose(slope[away], (weight * x)[away], atol=1e-5)


def test_the_redescending_loss_and_its_weights():
    """Weights min(1, (h / x)^2), half as large of late ranges; the cost is their integral."""
    x = np.linspace(-6.0, 6.0, 121)

    def loss(x):
        return (a[0] for a in loss_of(x[None] ** 2, redescending(0.8), x[None] > 0))

    _, weight = loss(x)
    want = np.minimum(1.0, (0.8 / np.maximum(np.abs(x), 1e-9)) ** 2) * np.where(x > 0, 0.5, 1.0)
    np.testing.assert_allclose(weight, want)
    slope = (next(loss(x + 1e-6)) - next(loss(x - 1e-6))) / 2e-6
    np.testing.assert_allclose(slope, weight * x, atol=1e-5)
    # Without a word on which are late it is that of early ones, and others do not ask.
    for other in (huber(1.0), cut_huber(1.5, 4.0)):
        for a, b in zip(
            loss_of(x[None] ** 2, other), loss_of(x[None] ** 2, other, x[None] > 0), strict=True
        ):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("trials", [None, 40])
def test_wrong_links_are_as_good_as_absent(trials):
    anchors, _, _, ranges, good, prior = problem(1, trials)
    filter = make(robust=True, iterations=20)
    state = filter.initial(*prior, COVARIANCE)
    told = filter.update(state, ranges, anchors)
    spared = filter.update(state, ranges, anchors, np.broadcast_to(good, ranges.shape))
    error = metrics.pose_error(*told[:2], *spared[:2])
    assert metrics.nees(error, spared.covariance).max() < 1e-6
    np.testing.assert_allclose(told.covariance, spared.covariance, rtol=1e-3)


def test_a_batch_with_wrong_links_is_a_loop_over_trials():
    anchors, _, _, ranges, _, prior = problem(2, 8)
    # Of some trials the prior knows so little that it cannot tell which links are wrong.
    wide = np.where(np.arange(8)[:, None, None] < 3, 100.0, 1.0) * COVARIANCE
    filter = make(robust=True)
    whole = filter.update(filter.initial(*prior, wide), ranges, anchors)
    for k in range(8):
        state = filter.initial(prior[0][k], prior[1][k], wide[k])
        single = filter.update(state, ranges[k], anchors[k])
        for a, b in zip(whole, single, strict=True):
            np.testing.assert_allclose(a[k], b, atol=1e-8)


def test_the_solution_is_a_minimum_of_the_cost_as_it_is_written():
    """Gradient by differences of prior + cut Huber's loss, link by link: no step is left."""
    anchors, _, _, ranges, _, prior = problem(3)
    filter = make(robust=True, iterations=20)
    state = filter.update(filter.initial(*prior, COVARIANCE), ranges, anchors)

    def cost(step):
        Q = rotations.exp(step[:3]) @ state.rotation
        t = state.translation + step[3:]
        error = np.concatenate([rotations.log(Q @ prior[0].T), t - prior[1]])
        total = 0.5 * error @ np.linalg.solve(COVARIANCE, error)
        for i, anchor in enumerate(anchors):
            for n, tag in enumerate(TAGS):
                std = np.sqrt(0.05**2 + (0.001 * ranges[i, n]) ** 2)
                x = min(abs(np.linalg.norm(Q @ tag + t - anchor) - ranges[i, n]) / std, 4.0)
                total += 0.5 * x**2 if x < 1.5 else 1.5 * x - 0.5 * 1.5**2
        return total

    gradient = np.array([(cost(d) - cost(-d)) / 2e-5 for d in 1e-5 * np.eye(6)])
    assert gradient @ state.covariance @ gradient < 1e-6


def test_where_most_links_contradict_the_prior_they_all_count():
    """A confident prior 3 m off: Huber's loss pulls it back, no gate shuts the ranges out."""
    anchors, rotation, translation, ranges, good, _ = problem(4)
    ranges = np.where(good, ranges, ranges - 5.0)
    filter = make(robust=True)
    state = filter.initial(rotation, translation + [3.0, 0, 0], 0.01 * COVARIANCE)
    off = []
    for _ in range(60):
        state = filter.update(filter.predict(state, np.zeros(6), 0.1), ranges, anchors)
        off.append(np.linalg.norm(state.translation - translation))
    assert off[0] > 1.0
    assert off[-1] < 0.1


def tracked(world, robust: bool):
    """Errors over the bound, of rotation and translation, and the trace of the filter."""
    trace = monte_carlo.track_trials(world, "iekf", {"robust": robust})
    square = np.square(trace.error).mean(axis=1)
    variance = np.diagonal(world.bound, axis1=-2, axis2=-1).mean(axis=1)
    parts = ((array[:, :3].sum(-1), array[:, 3:].sum(-1)) for array in (square, variance))
    return [np.sqrt(a / b).mean() for a, b in zip(*parts, strict=True)], trace


@pytest.mark.parametrize("scene", ["uwb_room", "drone_yard"])
def test_one_range_in_ten_over_a_reflection(scene):
    """300 trials x 16 epochs: within 1.15 of the CLEAN bound, honest; the plain filter is lost."""
    base = {"name": scene, "steps": 15}
    links = {"nlos_probability": 0.1}
    world = monte_carlo.simulate_trials(
        scenes.get({**base, "links": links}), 300, np.random.default_rng(5)
    )
    assert min(tracked(world, robust=False)[0]) > 3
    ratio, trace = tracked(world, robust=True)
    assert max(ratio) < 1.15
    assert abs(trace.nees.mean() - 6) < 0.5
    assert np.linalg.norm(trace.error[..., 3:], axis=-1).max() < 3.0


def test_half_the_links_lost():
    """Within 1.05 of the bound for the links that remain."""
    scene = scenes.get({"name": "uwb_room", "steps": 15, "links": {"drop_probability": 0.5}})
    world = monte_carlo.simulate_trials(scene, 300, np.random.default_rng(6))
    for robust in (False, True):
        ratio, trace = tracked(world, robust)
        assert max(ratio) < 1.05
        assert abs(trace.nees.mean() - 6) < 0.4


def test_robust_location_where_few_anchors_are_not_in_a_plane():
    """Without some pairs of its anchors this yard is flat: the search must not run forever."""
    scene = scenes.get("drone_yard")
    rng = np.random.default_rng(7)
    tags, anchors = np.array(scene.tags), np.array(scene.anchors)
    rotation = rotations.random(rng, (30,))
    translation = rng.uniform([-50, -50, 5], [50, 50, 40], (30, 3))
    model = ranging.LinkModel(nlos_probability=0.35)
    ranges = ranging.simulate(anchors, tags, rotation, translation, scene.noise, rng, model).ranges
    found = estimators.locate(ranges, anchors, tags, scene.noise, "robust")
    assert np.isfinite(found.translation).all()
    near = np.linalg.norm(found.translation - translation, axis=-1) < 3.0
    assert near.mean() > 0.5
