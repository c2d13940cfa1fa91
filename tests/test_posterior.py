"""The fast forms of the posterior bound against `bounds`, step by step."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bounds
from rbl_gym.bounds import posterior
from rbl_gym.geometry import rotations
from rbl_gym.motion import ProcessNoise
from rbl_gym.worlds import scene_bounds, scenes, simulation

NAMES = sorted(scenes.SCENES)
LOSSY = {"drop_probability": 0.3}


def assert_close(got, want, rtol):
    scale = np.sqrt(np.diagonal(want, axis1=-2, axis2=-1))
    scale = scale[..., :, None] * scale[..., None, :]
    np.testing.assert_allclose(got / scale, want / scale, rtol=0, atol=rtol)


@pytest.mark.parametrize("links", [{}, LOSSY, {"reach_m": 500.0}], ids=["all", "lossy", "near"])
@pytest.mark.parametrize("name", NAMES)
def test_steps_of_many_worlds_and_of_one_equal_the_plain_recursion(name, links):
    scene = scenes.get({"name": name, "links": links, "steps": 6})
    episode = simulation.draw_episode(scene, np.random.default_rng(1), (7,))
    alone = simulation.Episode(*(None if field is None else field[2] for field in episode))  # pyright: ignore[reportArgumentType]
    course = scene_bounds.posterior_course(scene, alone)
    want, got, P = None, None, alone.prior_covariance
    for k in range(scene.steps + 1):
        at = simulation.epoch_of(episode, k)
        seen = simulation.measure(scene, at, episode.anchors).links
        rest = at, episode.anchors, seen
        want = scene_bounds.posterior_information(scene, *rest, want, episode.prior_covariance)
        got, score = scene_bounds.posterior_step(scene, *rest, got, episode.prior_covariance)
        assert_close(got, want, 1e-9)
        plain = bounds.score(np.linalg.inv(want), at.rotation, scene.tags)
        np.testing.assert_allclose(score, plain, rtol=1e-9)
        P = course.predict(k, P) if k else P
        shares = simulation.shares(scene, at, episode.anchors, seen)
        P = posterior.update(P, course.information(k, alone.anchors, scene.noise, shares[2]))
        np.testing.assert_allclose(course.score(k, P), plain[2], rtol=1e-9)


def test_uneven_noise_that_spoils_the_pivots_is_predicted_all_the_same():
    scene = scenes.get("uwb_room")
    rng = np.random.default_rng(0)
    root = np.array([1.0, -300.0, 0, 0, 0, 0])
    J = np.tile(np.outer(root, root) + 1e-2 * np.eye(6), (5, 1, 1))
    twist = np.tile([0.8, 0.8, 0.3, 0, 0, 0], (5, 1))
    process = ProcessNoise((0.1, 3.0, 0.1), 0.3)
    anchors, rotation = rng.normal(0, 9, (5, 4, 3)), rotations.random(rng, (5,))
    links = np.zeros((5, 4, len(scene.tags)), bool)
    got, _ = posterior.step_many(
        J, posterior.Interval(twist, 1.0, process), anchors, scene.tags, rotation,
        np.zeros((5, 3)), scene.noise, links,
    )  # fmt: skip
    assert_close(got, bounds.predict_information(J, twist, 1.0, process), 1e-9)


def test_an_anchor_on_a_tag_tells_nothing_of_that_tag():
    scene = scenes.get("uwb_room")
    anchors = np.array([[scene.tags[0], (5.0, 0, 1), (0, 6, 2)]])
    links, eye = np.ones((1, 3, len(scene.tags)), bool), np.eye(3)[None]
    got, _ = posterior.step_many(
        np.eye(6)[None], None, anchors, scene.tags, eye, np.zeros((1, 3)), scene.noise, links
    )
    want = np.eye(6) + bounds.range_information(
        anchors[0], scene.tags, np.eye(3), np.zeros(3), scene.noise
    )
    assert_close(got[0], want, 1e-12)


@pytest.mark.parametrize("J", [np.zeros((2, 6, 6)), np.full((2, 6, 6), np.nan)])
def test_singular_information_is_refused(J):
    scene = scenes.get("uwb_room")
    links, eye = np.zeros((2, 3, len(scene.tags)), bool), np.tile(np.eye(3), (2, 1, 1))
    with pytest.raises(ValueError, match="information about the pose is singular"):
        posterior.step_many(
            J, None, np.ones((2, 3, 3)), scene.tags, eye, np.zeros((2, 3)), scene.noise, links
        )
