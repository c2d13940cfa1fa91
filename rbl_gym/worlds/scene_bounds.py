"""The posterior Cramer-Rao bound along an episode of a scene."""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.bounds import inertial, posterior
from rbl_gym.bounds.motions import Motion
from rbl_gym.bounds.nuisances import information_of, with_epoch
from rbl_gym.checks import BoolArray, FloatArray, all_finite
from rbl_gym.measurements import ranging
from rbl_gym.measurements.inertial import InertialSensor
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scene import Scene

__all__ = ["posterior_step"]

_SINGULAR = (
    "the information about the pose is singular or not finite: the prior, process or noise of the "
    "scene is too small or too large"
)


def posterior_step(
    scene: Scene,
    at: simulation.Epoch,
    anchors: FloatArray,
    links: BoolArray,
    previous: FloatArray | None,
    prior_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return posterior Cramer-Rao information (..., n, n) at the true pose, and its score.

    n is 6. In a scene with an inertial sensor it is 15, for ranges and its readings: pose,
    velocity, biases (`bounds.inertial`). With survey errors of the anchors it is larger by 3 M. The
    recursion starts from the information of the previous epoch, or from the prior at epoch 0
    (`previous` None). Links without ranges contribute nothing.

    Parameters
    ----------
    scene, at, anchors, links
        The world at an epoch, anchor positions (..., M, 3), links that measured (..., M, N).
    previous, prior_covariance
        Information (..., n, n) after the previous epoch, and the prior covariance at epoch 0.

    Returns
    -------
    The information, and the `bounds.score` (...) of its inverse.

    Raises
    ------
    ValueError
        If the information is singular or not finite.
    """
    law = ranging.numbers_of(scene.noise, scene.body.shape[-2])
    assert law is not None  # all laws of scenes have `numbers`
    if scene.inertial is not None or scene.links.offset is not None or scene.survey_std_m > 0:
        return _joint_step(scene, at, anchors, links, previous, prior_covariance)
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
        raise ValueError(_SINGULAR)
    return information, score


def _joint_step(
    scene: Scene,
    at: simulation.Epoch,
    anchors: FloatArray,
    links: BoolArray,
    previous: FloatArray | None,
    prior_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return `posterior_step` with further states, or with offsets of the ranges."""
    unknown = bounds.Nuisances(scene.links.offset, scene.survey_std_m)
    count = unknown.count(scene.n_anchors, len(scene.tags))
    states = 6 if scene.inertial is None else 15
    if previous is None:
        before = np.linalg.inv(prior_covariance)
        if scene.inertial is not None:
            speed = scene.speed_std_m_s
            before = inertial.prior_information(prior_covariance, scene.inertial, speed)
        before = bounds.with_nuisances(before, count)
    else:
        before = _motion_of(scene, at).predict(previous, states, at.rotation)
    epoch = bounds.RangeEpoch(anchors, scene.body, at.rotation, at.translation, scene.noise)
    share = simulation.shares(scene, at, anchors, links)
    information = with_epoch(before, information_of(epoch, unknown, share), states)
    if not all_finite(information):
        raise ValueError(_SINGULAR)
    return information, bounds.score(pose_covariance(information), at.rotation, scene.body)


def _motion_of(scene: Scene, at: simulation.Epoch) -> Motion:
    """Return the motion that led to an epoch."""
    if scene.inertial is None:
        return bounds.KnownTwist(at.twist, scene.dt, scene.process)
    return felt_motion(at, scene.dt, scene.inertial)


def felt_motion(at: simulation.Epoch, dt: float, sensor: InertialSensor) -> Motion:
    """Return the motion that led to an epoch, known by the readings of a sensor."""
    assert at.readings is not None
    assert at.bias is not None
    # As the true motion, except for the white noise, which hardly changes the bound.
    felt = at.readings - at.bias[..., None, :]
    return bounds.InertialMotion(felt, np.full(felt.shape[-2], dt / felt.shape[-2]), sensor)


def information_size(scene: Scene) -> int:
    """Return the size of the information that `posterior_step` propagates."""
    states = 6 if scene.inertial is None else 15
    return states + 3 * scene.n_anchors * (scene.survey_std_m > 0)


def pose_covariance(information: FloatArray) -> FloatArray:
    """Return the pose bound (..., 6, 6) from information about the pose and other states."""
    return np.linalg.inv(information)[..., :6, :6]
