"""Run a filter over a batch of episodes, and evaluate it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds, estimators, metrics
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.linear.kalman import KalmanState
from rbl_gym.measurements import ranging
from rbl_gym.measurements.noise_laws import WeakenedNoise
from rbl_gym.studies.epochs import (
    Reading,
    Step,
    pose_errors,
    seconds_per_step,
    stack_beliefs,
    timed,
    track_epochs,
)
from rbl_gym.worlds import scene_bounds, simulation
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers.estimate import scene_filter

__all__ = [
    "SimulatedTrials",
    "Trace",
    "bound_of",
    "measure_episode",
    "rms",
    "scene_filter",
    "simulate_trials",
    "told_readings",
    "track_trials",
    "trial_steps",
]


class SimulatedTrials(NamedTuple):
    """A batch of episodes with their measurements and their posterior Cramer-Rao bound.

    `bound` (K, B, 6, 6) is a covariance per epoch and trial.
    """

    scene: Scene
    episode: simulation.Episode
    measurements: Sequence[ranging.Measurement]
    bound: FloatArray


class Trace(NamedTuple):
    """Results of a filter per epoch and trial: arrays (K, B) unless noted.

    Attributes
    ----------
    frobenius
        Frobenius norm of the error of the raw rotation estimate.
    angular
        Mean angle between columns (rad), of the raw estimate.
    error
        Pose error of the belief (K, B, 6).
    nees, score
        NEES ``e^T P^-1 e`` and score b in metres of the belief.
    own_rotation, own_translation
        Variances from the own covariance of the filter: of the Frobenius error of the rotation
        (tr P_q of the tracking paper), and of the translation (tr P_t).
    constrained
        Whether the update projected the rotation onto SO(3).
    seconds
        Processor time of one step of one trial, seconds.
    """

    frobenius: FloatArray
    angular: FloatArray
    error: FloatArray
    nees: FloatArray
    score: FloatArray
    own_rotation: FloatArray
    own_translation: FloatArray
    constrained: FloatArray
    seconds: float


def simulate_trials(scene: Scene, trials: int, rng: np.random.Generator) -> SimulatedTrials:
    """Simulate episodes of a scene with fixed anchors."""
    episode = simulation.draw_episode(scene, rng, (trials,))
    measurements = measure_episode(scene, episode)
    links = [measured.links for measured in measurements]
    return SimulatedTrials(scene, episode, measurements, bound_of(scene, episode, links))


def measure_episode(scene: Scene, episode: simulation.Episode) -> list[ranging.Measurement]:
    """Return ranges and links (B, M, N) of every epoch of episodes with fixed anchors."""
    anchors = episode.anchors[:, None]
    measured = simulation.measure_epoch(scene, simulation.whole(episode), anchors)
    columns = (np.moveaxis(column, 1, 0) for column in measured)
    return [ranging.Measurement(*epoch) for epoch in zip(*columns, strict=True)]


def bound_of(scene: Scene, episode: simulation.Episode, links: Iterable[BoolArray]) -> FloatArray:
    """Return posterior Cramer-Rao bounds (K, B, 6, 6) at true poses, for links (K, B, M, N)."""
    covariances, information = [], None
    for epoch, measured in enumerate(links):
        at = simulation.epoch_of(episode, epoch)
        information, _ = scene_bounds.posterior_step(
            scene, at, episode.anchors, measured, information, episode.prior_covariance
        )
        covariances.append(scene_bounds.pose_covariance(information))
    return np.array(covariances)


def told_readings(
    scene: Scene,
    episode: simulation.Episode,
    measurements: Sequence[ranging.Measurement],
    told: Scene | None = None,
    anchors: FloatArray | None = None,
) -> list[Reading]:
    """Return the inputs of filters for episodes with fixed anchors, one per epoch.

    In scenes with obstacles each epoch has its own law: receivers know the quality of a link.

    Parameters
    ----------
    scene, episode, measurements
        The truth, and the measurements.
    told
        The scene as known to filters; None: the true scene.
    anchors
        Anchor positions (B, M, 3) known to filters; None: the true ones, or the surveyed ones if
        the scene has a survey.
    """
    told = scene if told is None else told
    if anchors is None:
        anchors = simulation.surveyed(simulation.epoch_of(episode, 0), episode.anchors)
    readings = []
    for epoch, measured in enumerate(measurements):
        at, quality = simulation.epoch_of(episode, epoch), None
        if scene.weakens:
            quality = simulation.link_quality(scene, at, episode.anchors)
        readings.append(told_reading(told, at, measured, anchors, quality, first=not epoch))
    return readings


def told_reading(
    told: Scene,
    at: simulation.Epoch,
    measured: ranging.Measurement,
    anchors: FloatArray,
    quality: FloatArray | None,
    first: bool,
) -> Reading:
    """Return the input of filters for one epoch; the first has no twist.

    `told` is the scene as known to filters, as are the `anchors` (..., M, 3). `quality` (..., M) is
    the share of their information that links keep; None: all of it.
    """
    law = None if quality is None else WeakenedNoise(told.noise, quality)
    twist, inertial = (None, None) if first else (at.twist, at.readings)
    return Reading(measured.ranges, anchors, measured.links, law, twist, told.dt, inertial)


def trial_steps(trials: SimulatedTrials, filter: estimators.Filter) -> Iterator[Step]:
    """Run a filter over all trials at once, epoch by epoch, from their priors."""
    episode = trials.episode
    prior = episode.prior_rotation, episode.prior_translation, episode.prior_covariance
    readings = told_readings(trials.scene, episode, trials.measurements)
    return track_epochs(filter, prior, readings)


def track_trials(
    trials: SimulatedTrials,
    name: str,
    options: dict[str, Any],
    advance: Callable[[], None] = lambda: None,
) -> Trace:
    """Run a named filter over all trials, and evaluate it.

    Parameters
    ----------
    trials
        Trials from `simulate_trials`.
    name, options
        Name and options of the filter (`estimators.make`).
    advance
        Called after every epoch.
    """
    episode, tags = trials.episode, np.asarray(trials.scene.tags)
    beliefs, rows, times = [], [], []
    filter = scene_filter(trials.scene, name, options)
    for step, taken in timed(trial_steps(trials, filter)):
        times.append(taken)
        beliefs.append(step.belief)
        none = np.zeros(step.belief.translation.shape[:-1])
        rows.append((*_own_variances(step), getattr(step.state, "constrained", none)))
        advance()
    belief = stack_beliefs(beliefs)
    count = len(beliefs)
    rotation = np.moveaxis(episode.rotation[:, :count], 1, 0)
    translation = np.moveaxis(episode.translation[:, :count], 1, 0)
    errors = pose_errors(belief, rotation, translation, tags)
    own_rotation, own_translation, constrained = map(np.array, zip(*rows, strict=True))
    return Trace(
        np.linalg.norm(belief.matrix - rotation, axis=(-2, -1)),
        metrics.mean_angular_error(belief.matrix, rotation),
        errors.pose,
        errors.nees,
        bounds.score(belief.covariance, belief.rotation, tags),
        own_rotation,
        own_translation,
        constrained,
        seconds_per_step(times) * count / errors.nees.size,
    )


def _own_variances(step: Step) -> tuple[FloatArray, FloatArray]:
    """Return the variances of the Frobenius error of the rotation, and of the translation."""
    if isinstance(step.state, KalmanState):
        variance = np.diagonal(step.state.covariance, axis1=-2, axis2=-1)
        return variance[..., :9].sum(-1), variance[..., 9:].sum(-1)
    variance = np.diagonal(step.belief.covariance, axis1=-2, axis2=-1)
    # |exp(w) Q - Q|_F^2 = 2 |w|^2 to first order.
    return 2 * variance[..., :3].sum(-1), variance[..., 3:6].sum(-1)


def rms(values: FloatArray, axis: int | None = None) -> Any:
    """Return the root mean square; inf if a value is inf."""
    with np.errstate(over="ignore"):
        return np.sqrt(np.mean(np.square(values), axis=axis))
