"""The posterior bound of scenes against the recursion of `bounds`, step by step."""

from __future__ import annotations

import numpy as np
import pytest

from rbl_gym import bounds
from rbl_gym.bounds import posterior
from rbl_gym.bounds.doa import doa_information
from rbl_gym.geometry import rotations
from rbl_gym.measurements import noise_laws
from rbl_gym.measurements.bearing import AngleNoise
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
def test_steps_equal_the_plain_recursion(name, links):
    scene = scenes.get({"name": name, "links": links, "steps": 6})
    episode = simulation.draw_episode(scene, np.random.default_rng(1), (7,))
    whole = simulation.whole(episode)
    seen = simulation.measure_epoch(scene, whole, episode.anchors[:, None]).links
    want, got = np.linalg.inv(episode.prior_covariance), None
    for k in range(scene.steps + 1):
        at = simulation.epoch_of(episode, k)
        if k:
            want = bounds.predict_information(want, at.twist, scene.dt, scene.process)
        share = simulation.shares(scene, at, episode.anchors, seen[:, k])
        want = want + bounds.information_at(
            episode.anchors, scene.body, at.rotation, at.translation, scene.noise, share
        )
        plain = bounds.score(np.linalg.inv(want), at.rotation, scene.tags)
        got, score = scene_bounds.posterior_step(
            scene, at, episode.anchors, seen[:, k], got, episode.prior_covariance
        )
        assert_close(got, want, 1e-9)
        np.testing.assert_allclose(score, plain, rtol=1e-9)


def test_uneven_noise_is_predicted_all_the_same():
    root = np.array([1.0, -300.0, 0, 0, 0, 0])
    J = np.outer(root, root) + 1e-2 * np.eye(6)
    twist, process = np.array([0.8, 0.8, 0.3, 0, 0, 0]), ProcessNoise((0.1, 3.0, 0.1), 0.3)
    scene = scenes.get("uwb_room")
    got, _ = posterior.step_of_ranges(
        J, twist, 1.0, process.std(), np.ones((4, 3)), scene.body, np.eye(3), np.zeros(3),
        noise_laws.numbers_of(scene.noise, len(scene.tags)), np.zeros((4, len(scene.body))),
    )  # fmt: skip
    assert_close(got, bounds.predict_information(J, twist, 1.0, process), 1e-9)


def test_an_anchor_on_a_tag_tells_nothing_of_that_tag():
    scene = scenes.get("uwb_room")
    anchors = np.array([scene.tags[0], (5.0, 0, 1), (0, 6, 2)])
    got, _ = posterior.step_of_ranges(
        np.eye(6), np.zeros(6), 0.0, np.ones(6), anchors, scene.body, np.eye(3), np.zeros(3),
        noise_laws.numbers_of(scene.noise, len(scene.tags)), np.ones((3, len(scene.body))),
    )  # fmt: skip
    seen = bounds.range_information(anchors, scene.tags, np.eye(3), np.zeros(3), scene.noise)
    assert_close(got, np.eye(6) + seen, 1e-12)


@pytest.mark.parametrize(
    ("J", "prior"),
    [(np.zeros((2, 6, 6)), np.eye(6)), (np.full((2, 6, 6), np.nan), np.eye(6)), (None, -np.eye(6))],
)
def test_singular_information_is_refused(J, prior):
    scene = scenes.get("uwb_room")
    episode = simulation.draw_episode(scene, np.random.default_rng(0), (2,))
    links = np.zeros((2, scene.n_anchors, len(scene.tags)), bool)
    with pytest.raises(ValueError, match="information about the pose is singular or not finite"):
        scene_bounds.posterior_step(
            scene, simulation.epoch_of(episode, 0), episode.anchors, links, J, prior
        )


def test_angles_have_the_same_recursion():
    rng = np.random.default_rng(3)
    scene, process, noise = scenes.get("uwb_room"), ProcessNoise(0.1, 0.3), AngleNoise(0.01)
    rotation, translation = rotations.random(rng, (5,)), rng.normal(0, 9, (5, 3))
    twist, station = rng.standard_normal((5, 6)), rng.normal(0, 9, (5, 3))
    got, score = posterior.step_of_angles(
        np.eye(6), twist, 0.2, process.std(), station, scene.body, rotation, translation,
        noise.std_rad,
    )  # fmt: skip
    told = doa_information(scene.tags, rotation, translation, noise, station)
    want = bounds.predict_information(np.eye(6), twist, 0.2, process) + told
    assert_close(got, want, 1e-9)
    b = bounds.score(np.linalg.inv(want), rotation, scene.tags)
    np.testing.assert_allclose(score, b, rtol=1e-9)
