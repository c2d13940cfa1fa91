"""Runs of a filter over a batch of episodes, with everything that judges it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds, estimators, metrics
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.linear.kalman import KalmanState
from rbl_gym.measurements import ranging
from rbl_gym.worlds import scene_bounds, simulation
from rbl_gym.worlds.scene import Scene
from rbl_gym.wrappers.estimate import check_takes_obstacles


class World(NamedTuple):
    """A batch of episodes with its measurements and its posterior Cramer-Rao bound.

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


def simulate_world(scene: Scene, trials: int, rng: np.random.Generator) -> World:
    """Episodes of a scene, with anchors that stay where they start."""
    episode = simulation.draw_episode(scene, rng, (trials,))
    measurements, covariances = [], []
    information = None
    for epoch in range(scene.steps + 1):
        at = simulation.epoch_of(episode, epoch)
        measured = simulation.measure(scene, at, episode.anchors)
        information, _ = scene_bounds.posterior_step(
            scene, at, episode.anchors, measured.links, information, episode.prior_covariance
        )
        measurements.append(measured)
        covariances.append(np.linalg.inv(information))
    return World(scene, episode, measurements, np.array(covariances))


def make(scene: Scene, name: str, options: dict[str, Any]) -> estimators.Filter:
    """A named filter that knows the scene's tags and laws."""
    filter = estimators.make(
        name, tags=scene.tags, noise=scene.noise, process=scene.process, **options
    )
    check_takes_obstacles(name, filter, scene)
    return filter


def beliefs(world: World, filter: estimators.Filter) -> Iterator[tuple[Any, estimators.PoseBelief]]:
    """State and belief of a filter after every epoch, started from the episodes' prior."""
    episode = world.episode
    state = filter.initial(
        episode.prior_rotation, episode.prior_translation, episode.prior_covariance
    )
    for epoch, measured in enumerate(world.measurements):
        if epoch:
            state = filter.predict(state, episode.twists[:, epoch], world.scene.dt)
        state = filter.update(
            state, measured.ranges, episode.anchors, measured.links, **_law(world, epoch)
        )
        yield state, filter.belief(state)


def _law(world: World, epoch: int) -> dict[str, ranging.NoiseLaw]:
    """The argument `noise` of an epoch, where obstacles give it a law of its own."""
    if not world.scene.obstacles:
        return {}
    measured = world.measurements[epoch]
    at = simulation.epoch_of(world.episode, epoch)
    quality = simulation.link_quality(world.scene, at, world.episode.anchors)
    return {
        "noise": simulation.perceived_noise(world.scene, measured.ranges, measured.links, quality)
    }


def run(
    world: World, name: str, options: dict[str, Any], advance: Callable[[], None] = lambda: None
) -> Trace:
    """A named filter over all episodes of a world; `advance` is called after every epoch."""
    scene, episode = world.scene, world.episode
    tags = np.asarray(scene.tags)
    filter = make(scene, name, options)
    rows = []
    start = time.process_time()
    seconds = 0.0
    for epoch, (state, belief) in enumerate(beliefs(world, filter)):
        seconds += time.process_time() - start
        truth = episode.rotation[:, epoch], episode.translation[:, epoch]
        error = metrics.pose_error(belief.rotation, belief.translation, *truth)
        rows.append(
            (
                np.linalg.norm(belief.matrix - truth[0], axis=(-2, -1)),
                metrics.mean_angular_error(belief.matrix, truth[0]),
                error,
                metrics.nees(error, belief.covariance),
                bounds.score(belief.covariance, belief.rotation, tags),
                *_own_variances(state),
                getattr(state, "constrained", np.zeros(len(error))),
            )
        )
        advance()
        start = time.process_time()
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Trace._make([*columns, seconds / columns[0].size])


def _own_variances(state: Any) -> tuple[FloatArray, FloatArray]:
    """Of the rotation's Frobenius error and of the translation."""
    variance = np.diagonal(state.covariance, axis1=-2, axis2=-1)
    if isinstance(state, KalmanState):
        return variance[..., :9].sum(-1), variance[..., 9:].sum(-1)
    # |exp(w) Q - Q|_F^2 = 2 |w|^2 to first order.
    return 2 * variance[..., :3].sum(-1), variance[..., 3:6].sum(-1)


def rms(values: FloatArray, axis: int | None = None) -> Any:
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values), axis=axis))
