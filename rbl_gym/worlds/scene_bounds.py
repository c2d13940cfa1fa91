"""The posterior Cramer-Rao bound along an episode of a scene."""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.bounds import inertial, posterior
from rbl_gym.bounds.nuisances import with_epoch
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
    """Posterior Cramer-Rao information (..., n, n) at the true pose of an epoch, and its score.

    n is 6; in a scene with an inertial sensor 15, of what ranges and its readings tell: pose,
    velocity, biases (`bounds.inertial`). From that of the epoch before, or from the prior at epoch
    0 (`previous` None). Links that gave nothing tell nothing.

    Parameters
    ----------
    scene, at, anchors, links
        The world at an epoch, where the anchors stand (..., M, 3), what measured (..., M, N).
    previous, prior_covariance
        Information (..., n, n) after the epoch before, and the prior at epoch 0.

    Returns
    -------
    The information, and the `bounds.score` (...) of its inverse.

    Raises
    ------
    ValueError
        If the information is singular or not finite.
    """
    law = ranging.numbers_of(scene.noise, scene.body.shape[-2])
    assert law is not None  # the laws of scenes have numbers
    if scene.inertial is not None:
        return _with_inertial(scene, at, anchors, links, previous, prior_covariance)
    if scene.links.offset is not None:
        return _with_offsets(scene, at, anchors, links, previous, prior_covariance)
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


def _with_inertial(
    scene: Scene,
    at: simulation.Epoch,
    anchors: FloatArray,
    links: BoolArray,
    previous: FloatArray | None,
    prior_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """`posterior_step` of all 15 states."""
    sensor = scene.inertial
    assert sensor is not None
    assert at.readings is not None
    assert at.bias is not None
    if previous is None:
        before = inertial.prior_information(prior_covariance, sensor, scene.speed_std_m_s)
    else:
        # As the true motion has them, but for the white noise, which the bound hardly sees.
        felt = at.readings - at.bias[..., None, :]
        steps = np.full(felt.shape[-2], scene.dt / felt.shape[-2])
        motion = bounds.InertialMotion(felt, steps, sensor)
        before = motion.predict(previous, 15, at.rotation)
    information = with_epoch(before, _seen(scene, at, anchors, links), 15)
    return _scored(scene, at, information)


def _with_offsets(
    scene: Scene,
    at: simulation.Epoch,
    anchors: FloatArray,
    links: BoolArray,
    previous: FloatArray | None,
    prior_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """`posterior_step` of ranges with offsets."""
    if previous is None:
        before = np.linalg.inv(prior_covariance)
    else:
        before = bounds.predict_information(previous, at.twist, scene.dt, scene.process)
    return _scored(scene, at, before + _seen(scene, at, anchors, links))


def _seen(scene: Scene, at: simulation.Epoch, anchors: FloatArray, links: BoolArray) -> FloatArray:
    """What the ranges tell about the pose (..., 6, 6)."""
    share = simulation.shares(scene, at, anchors, links)
    places = anchors, scene.body, at.rotation, at.translation
    return bounds.information_at(*places, scene.noise, share, scene.links.offset)


def _scored(
    scene: Scene, at: simulation.Epoch, information: FloatArray
) -> tuple[FloatArray, FloatArray]:
    if not all_finite(information):
        raise ValueError("the information about the pose is singular or not finite")
    covariance = np.linalg.inv(information)[..., :6, :6]
    return information, bounds.score(covariance, at.rotation, scene.body)


def information_size(scene: Scene) -> int:
    """Rows of the information that `posterior_step` carries along."""
    return 6 if scene.inertial is None else 15


def pose_covariance(information: FloatArray) -> FloatArray:
    """The bound (..., 6, 6) of the pose, from information about it and what else there is."""
    return np.linalg.inv(information)[..., :6, :6]
