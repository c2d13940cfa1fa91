"""The gradient of a layout's score: against differences, for every law, limit and loss."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bodies, placement, ranging, rotations
from rbl_gym.measurements.noise_laws import numbers_of
from rbl_gym.placement import Gain, Sample, gradient, score_and_gradient
from rbl_gym.placement import sample as samples

LAWS = {
    "own": ranging.RangeNoise(0.1, 0.01),
    "constant": ranging.RangeNoise(0.1),
    "reference": ranging.RangeNoise(0.1, 0.02, reference_tag=1),
    "proportional": ranging.RangeNoise(0.0, 0.01),
    "squared": ranging.SquaredRangeNoise(0.1),
}
GAINS = {
    "everywhere": Gain(),
    "range": Gain(25.0, 15.0),
    "hard range": Gain(20.0),
    "view": Gain(half_angle_rad=1.5, angle_edge_rad=1.4),
    "both": Gain(25.0, 15.0, 1.5, 1.0),
}


def sample(rng, n=7):
    prior = rng.normal(size=(n, 6, 6))
    weight = rng.random(n)
    return Sample(
        rotations.random(rng, (n,)),
        rng.uniform(-8, 8, (n, 3)),
        weight / weight.sum(),
        0.1 * np.eye(6) + 0.01 * prior @ np.swapaxes(prior, -1, -2),
        np.zeros(n, int),
    )


def differences(function, anchors, step):
    """Derivative (M, 3) by Richardson's extrapolation of central differences."""
    found = np.empty(anchors.shape)
    for index in np.ndindex(anchors.shape):
        moved = np.zeros(anchors.shape)
        moved[index] = step
        one, two = (
            (function(anchors + k * moved) - function(anchors - k * moved)) / (2 * k * step)
            for k in (1, 2)
        )
        found[index] = (4 * one - two) / 3
    return found


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("gain", GAINS)
def test_gradient_is_that_of_differences(law, gain):
    rng = np.random.default_rng([len(law), len(gain)])
    poses, tags = sample(rng), bodies.pyramid(1.0)
    anchors, normals = rng.normal(0, 12, (2, 5, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[0] = 0.0
    # Losses of walls, for each tag.
    share = rng.choice([1.0, 0.7, 0.05, 0.0], (7, 5, 5))
    args = poses, tags, LAWS[law], share, GAINS[gain], normals
    score, gradient = score_and_gradient(anchors, *args)
    found = differences(lambda x: score_and_gradient(x, *args)[0], anchors, 1e-3)
    # At the ends of an edge the third derivative jumps.
    np.testing.assert_allclose(gradient, found, atol=1e-7 * max(1.0, np.abs(gradient).max()))
    assert np.abs(gradient).max() > 1e-4
    assert score > 0


def test_every_problem_of_a_batch_has_a_law_of_its_own():
    rng = np.random.default_rng(5)
    poses, tags = sample(rng, len(LAWS)), bodies.pyramid(1.0)
    anchors = rng.normal(0, 12, (len(LAWS), 4, 3))
    numbers = np.array([numbers_of(law, len(tags)) for law in LAWS.values()])
    share = np.ones((len(poses.places), 4, len(tags)))
    told = np.zeros_like(anchors), *poses[:4], tags, numbers, Gain().numbers, share
    score, slopes = gradient.of_arrays(anchors, *told)
    for k, law in enumerate(LAWS.values()):
        alone = score_and_gradient(anchors[k], poses, tags, law)
        np.testing.assert_allclose(score[k], alone[0], rtol=1e-9)
        np.testing.assert_allclose(slopes[k], alone[1], rtol=1e-9, atol=1e-12)


def test_score_is_the_root_of_the_weighted_mean_square_by_hand():
    rng = np.random.default_rng(3)
    poses, tags = sample(rng), bodies.pyramid(1.0)
    anchors, normals = rng.normal(0, 12, (2, 5, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    gain, total = Gain(25.0, 15.0, 1.5, 1.0), 0.0
    for Q, t, weight, F in zip(*poses[:4], strict=True):
        F = F.copy()
        jacobians = []
        for c in tags:
            x, y, z = Q @ c
            J = np.array([[0, z, -y, 1, 0, 0], [-z, 0, x, 0, 1, 0], [y, -x, 0, 0, 0, 1.0]])
            jacobians.append(J)
            for a, normal in zip(anchors, normals, strict=True):
                d = t + Q @ c - a
                r = np.linalg.norm(d)
                edge = min(max((25 - r) / 15, 0), 1)
                least, full = np.cos(1.5), np.cos(0.5)
                view = min(max((normal @ d / r - least) / (full - least), 0), 1)
                g = edge**2 * (3 - 2 * edge) * view**2 * (3 - 2 * view)
                q = J.T @ d / r
                F += g / (0.1**2 + (0.01 * r) ** 2) * np.outer(q, q)
        P = np.linalg.inv(F)
        total += weight * np.mean([np.trace(J @ P @ J.T) for J in jacobians])
    score, _ = score_and_gradient(anchors, poses, tags, LAWS["own"], gain=gain, normals=normals)
    np.testing.assert_allclose(score, total**0.5, rtol=1e-10)


def test_the_environments_score_is_that_of_its_poses():
    for scene in ("drone_yard", "auv_buoys"):
        task = placement.task(scene)
        rng = np.random.default_rng(5)
        context = placement.draw_contexts(task, rng)
        anchors = task.scene.anchor_region.draw(rng.random((3, task.n_anchors, 3)))
        score, gradient = score_and_gradient(
            anchors, samples.of_context(task, context), task.scene.body, task.scene.noise
        )
        np.testing.assert_allclose(score, placement.score(task, context, anchors), rtol=1e-9)
        assert gradient.shape == anchors.shape


def test_bad_arguments_are_named():
    rng = np.random.default_rng(0)
    poses, tags, anchors = sample(rng), bodies.pyramid(1.0), rng.normal(0, 9, (4, 3))
    law = LAWS["own"]
    for call, message in (
        (lambda: score_and_gradient(anchors[:, :2], poses, tags, law), "anchors must have shape"),
        (lambda: score_and_gradient(anchors, poses, tags, law, np.ones((7, 3))), "share must have"),
        (
            lambda: score_and_gradient(anchors, poses, tags, ranging.LinkNoise(np.ones((4, 5)))),
            "noise must be a law whose",
        ),
        (lambda: Gain(-1.0), "max_range_m"),
        (lambda: Gain(5.0, 6.0), "range_edge_m"),
        (lambda: Gain(half_angle_rad=4.0), "half_angle_rad"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
