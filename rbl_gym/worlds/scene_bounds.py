"""The posterior Cramer-Rao bound along an episode of a scene."""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.bounds import posterior
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.measurements import ranging
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scene import Scene

__all__ = ["posterior_information", "posterior_step"]


def posterior_information(
    scene: Scene,
    at: simulation.Epoch,
    anchors: FloatArray,
    links: BoolArray,
    previous: FloatArray | None,
    prior_covariance: FloatArray,
) -> FloatArray:
    """Posterior Cramer-Rao information (..., 6, 6) at the true pose of an epoch.

    From that of the epoch before, or from the prior at epoch 0 (`previous` None). Links that
    gave nothing tell nothing.

    Parameters
    ----------
    scene, at, anchors, links
        The world at an epoch, where the anchors stand (..., M, 3), what measured (..., M, N).
    previous, prior_covariance
        Information (..., 6, 6) after the epoch before, and the prior at epoch 0.
    """
    if previous is None:
        predicted = np.linalg.inv(prior_covariance)
    else:
        predicted = bounds.predict_information(previous, at.twist, scene.dt, scene.process)
    share = simulation.shares(scene, at, anchors, links)
    return predicted + bounds.information_at(
        anchors, np.asarray(scene.tags), at.rotation, at.translation, scene.noise, share
    )


def posterior_step(
    scene: Scene,
    at: simulation.Epoch,
    anchors: FloatArray,
    links: BoolArray,
    previous: FloatArray | None,
    prior_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """`posterior_information` (B, 6, 6) of B worlds, fast, and the score (B,) of its inverse.

    Arguments as `posterior_information`.
    """
    interval = None
    if previous is not None:
        interval = posterior.Interval(at.twist, scene.dt, scene.process)
    return posterior.step_many(
        np.linalg.inv(prior_covariance) if previous is None else previous,
        interval,
        anchors,
        scene.tags,
        at.rotation,
        at.translation,
        scene.noise,
        simulation.shares(scene, at, anchors, links),
    )


def posterior_course(scene: Scene, episode: simulation.Episode) -> posterior.Course:
    """What the bound of one episode needs and no action changes."""
    return posterior.course(
        episode.rotation,
        ranging.tag_positions(episode.rotation, episode.translation, scene.tags),
        episode.twists,
        np.asarray(scene.tags),
        scene.dt,
        scene.process,
    )
