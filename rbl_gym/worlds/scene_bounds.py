"""The posterior Cramer-Rao bound along an episode of a scene."""

from __future__ import annotations

import numpy as np

from rbl_gym.bounds import posterior
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.measurements import ranging
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scene import Scene

__all__ = ["posterior_of_episode", "posterior_step"]


def posterior_step(
    scene: Scene,
    at: simulation.Epoch,
    anchors: FloatArray,
    links: BoolArray,
    previous: FloatArray | None,
    prior_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Posterior Cramer-Rao information (..., 6, 6) at the true pose of an epoch, and its score.

    From that of the epoch before, or from the prior at epoch 0 (`previous` None). Links that
    gave nothing tell nothing.

    Parameters
    ----------
    scene, at, anchors, links
        The world at an epoch, where the anchors stand (..., M, 3), what measured (..., M, N).
    previous, prior_covariance
        Information (..., 6, 6) after the epoch before, and the prior at epoch 0.

    Returns
    -------
    The information, and the `bounds.score` (...) of its inverse.

    Raises
    ------
    ValueError
        If the information is singular or not finite.
    """
    step = 0.0 if previous is None else scene.dt
    before = np.linalg.inv(prior_covariance) if previous is None else previous
    share = simulation.shares(scene, at, anchors, links)
    information, score = _recursion(
        scene, before, np.array([step]), at.twist[..., None, :], anchors[..., None, :, :],
        at.rotation[..., None, :, :], at.translation[..., None, :], share[..., None, :, :],
    )  # fmt: skip
    return information[..., 0, :, :], score[..., 0]


def posterior_of_episode(
    scene: Scene, episode: simulation.Episode, links: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """`posterior_step` of all epochs (..., T + 1, ...) of an episode whose anchors stand still."""
    at = simulation.whole(episode)
    anchors = episode.anchors[..., None, :, :]
    step = np.full(scene.steps + 1, scene.dt)
    step[0] = 0.0
    before = np.linalg.inv(episode.prior_covariance)
    share = simulation.shares(scene, at, anchors, links)
    anchors = np.broadcast_to(anchors, (*share.shape[:-2], *anchors.shape[-2:]))
    return _recursion(scene, before, step, at.twist, anchors, at.rotation, at.translation, share)


def _recursion(
    scene: Scene,
    before: FloatArray,
    step: FloatArray,
    twist: FloatArray,
    anchors: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    share: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    law = ranging.numbers_of(scene.noise, len(scene.tags))
    assert law is not None  # the laws of scenes have numbers
    information, score = posterior.of_ranges(
        before, twist, step, scene.process.std(), anchors, scene.body, rotation, translation, law,
        share,
    )  # fmt: skip
    if not np.isfinite(score).all():
        raise ValueError("the information about the pose is singular or not finite")
    return information, score
