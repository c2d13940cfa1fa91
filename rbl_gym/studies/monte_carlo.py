"""Runs of a filter over a batch of episodes, with everything that judges it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds, estimators, metrics
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.linear.kalman import KalmanState
from rbl_gym.measurements import ranging
from rbl_gym.measurements.noise_laws import WeakenedNoise
from rbl_gym.studies.epochs import Reading, Step, pose_errors, stack_beliefs, timed, track_epochs
from rbl_gym.worlds import scene_bounds, simulation
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers.estimate import check_reads, check_takes_obstacles, inertial_options

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
    """What a filter did, per epoch and trial: arrays (K, B) unless said.

    Attributes
    ----------
    frobenius
        Frobenius norm of the raw rotation estimate's error.
    angular
        Mean angle between columns (rad), of the raw estimate.
    error
        Pose error of the belief (K, B, 6).
    nees, score
        Of the belief: ``e^T P^-1 e``; b in metres.
    own_rotation, own_translation
        Variances that the filter claims in its own state: of the rotation's Frobenius error
        (the tracking paper's tr P_q), and of the translation (tr P_t).
    constrained
        Whether the update put the rotation back onto SO(3).
    seconds
        Processor time of one step of one trial.
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
    """Episodes of a scene, with anchors that stay where they start."""
    episode = simulation.draw_episode(scene, rng, (trials,))
    measurements = measure_episode(scene, episode)
    links = [measured.links for measured in measurements]
    return SimulatedTrials(scene, episode, measurements, bound_of(scene, episode, links))


def measure_episode(scene: Scene, episode: simulation.Episode) -> list[ranging.Measurement]:
    """Ranges and links (B, M, N) of every epoch of episodes whose anchors stand still."""
    anchors = episode.anchors[:, None]
    measured = simulation.measure_epoch(scene, simulation.whole(episode), anchors)
    columns = (np.moveaxis(column, 1, 0) for column in measured)
    return [ranging.Measurement(*epoch) for epoch in zip(*columns, strict=True)]


def bound_of(scene: Scene, episode: simulation.Episode, links: Iterable[BoolArray]) -> FloatArray:
    """Posterior Cramer-Rao covariances (K, B, 6, 6) of true poses, by the links (K, B, M, N)."""
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
    """What filters are told of episodes whose anchors stand still, an entry per epoch.

    In scenes with obstacles each epoch has a law of its own: receivers learn how good a link is.

    Parameters
    ----------
    scene, episode, measurements
        The truth, and what was measured.
    told
        The scene as filters know it; None: as it is.
    anchors
        Places (B, M, 3) that filters are told; None: the true ones, or the surveyed ones where
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
    """What filters are told of one epoch.

    Parameters
    ----------
    told
        The scene as filters know it.
    at, measured
        The epoch, and what was measured.
    anchors
        Places (..., M, 3) that filters are told.
    quality
        Share (..., M) of their information that links keep; None: all of it.
    first
        Whether the epoch is the first, to which no twist leads.
    """
    law = None if quality is None else WeakenedNoise(told.noise, quality)
    twist, inertial = (None, None) if first else (at.twist, at.readings)
    return Reading(measured.ranges, anchors, measured.links, law, twist, told.dt, inertial)


def scene_filter(scene: Scene, name: str, options: dict[str, Any]) -> estimators.Filter:
    """A named filter that knows the scene's tags and laws.

    Raises
    ------
    ValueError
        As `estimators.make`; and for a filter that takes no law of an epoch, in a scene whose
        obstacles give one to every epoch.
    """
    options = {**scene.links.options, **inertial_options(name, scene), **options}
    filter = estimators.make(
        name, tags=scene.tags, noise=scene.noise, process=scene.process, **options
    )
    check_takes_obstacles(name, filter, scene)
    check_reads(name, filter, scene)
    return filter


def trial_steps(trials: SimulatedTrials, filter: estimators.Filter) -> Iterator[Step]:
    """A filter over all trials at once, epoch by epoch, started from their priors."""
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
    """A named filter over all trials, and everything that judges it.

    Parameters
    ----------
    trials
        Of `simulate_trials`.
    name, options
        Of the filter (`estimators.make`).
    advance
        Called after every epoch.
    """
    episode, tags = trials.episode, np.asarray(trials.scene.tags)
    beliefs, rows, seconds = [], [], 0.0
    filter = scene_filter(trials.scene, name, options)
    for step, taken in timed(trial_steps(trials, filter)):
        seconds += taken
        beliefs.append(step.belief)
        none = np.zeros(step.belief.translation.shape[:-1])
        rows.append((*_own_variances(step.state), getattr(step.state, "constrained", none)))
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
        seconds / errors.nees.size,
    )


def _own_variances(state: Any) -> tuple[FloatArray, FloatArray]:
    """Of the rotation's Frobenius error and of the translation."""
    variance = np.diagonal(state.covariance, axis1=-2, axis2=-1)
    if isinstance(state, KalmanState):
        return variance[..., :9].sum(-1), variance[..., 9:].sum(-1)
    # |exp(w) Q - Q|_F^2 = 2 |w|^2 to first order.
    return 2 * variance[..., :3].sum(-1), variance[..., 3:6].sum(-1)


def rms(values: FloatArray, axis: int | None = None) -> Any:
    """Root mean square; inf where any is."""
    with np.errstate(over="ignore"):
        return np.sqrt(np.mean(np.square(values), axis=axis))
