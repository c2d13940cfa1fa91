"""The posterior Cramer-Rao bound along an episode of a scene."""

from __future__ import annotations

import numpy as np

from rbl_gym.bounds import posterior
from rbl_gym.checks import BoolArray, FloatArray, all_finite
from rbl_gym.measurements import ranging
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scene import Scene

__all__ = ["posterior_step"]


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
    law = ranging.numbers_of(scene.noise, len(scene.tags))
    assert law is not None  # the laws of scenes have numbers
    information, score = posterior.step_of_ranges(
        np.linalg.inv(prior_covariance) if previous is None else previous,
        at.twist,
        0.0 if previous is None else scene.dt,
        scene.process.std(),
        anchors,
        scene.body,
        at.rotation,
        at.translation,
        law,
        simulation.shares(scene, at, anchors, links),
    )
    if not all_finite(score):
        raise ValueError("the information about the pose is singular or not finite")
    return information, score
