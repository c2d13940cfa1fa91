"""One filter after the other through a world of the benchmark, each with its figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds, estimators, metrics
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.linear.squared_range import geometric_rank
from rbl_gym.studies import replay
from rbl_gym.studies.bench import figures as bench_figures
from rbl_gym.studies.bench import recordings, worlds
from rbl_gym.studies.bench.figures import Errors, Reference
from rbl_gym.worlds import scenes
from rbl_gym.wrappers.estimate import check_takes_obstacles, update


class Tracked(NamedTuple):
    """What a filter did: pose (K, B, ...), covariance, how often it triggered, its seconds."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    trigger_rate: float | None
    seconds: float


class StoppedError(Exception):
    """A filter raised: at which epoch, and what."""

    def __init__(self, epoch: int, error: Exception) -> None:
        super().__init__(epoch, error)
        self.epoch, self.error = epoch, error


class Stage(NamedTuple):
    """A world as filters meet it.

    Attributes
    ----------
    make
        A filter of a name and options that knows what it is told.
    beliefs
        State and belief of a filter after every epoch.
    figures
        All figures of what it did.
    anchors, tags
        True geometry; `pose_rank` the directions of the pose that it determines, None where
        that depends on the way.
    batch
        Leading axes of a belief.
    """

    make: Callable[[str, dict[str, Any]], estimators.Filter]
    beliefs: Callable[[estimators.Filter], Iterator[tuple[Any, estimators.PoseBelief]]]
    figures: Callable[[Tracked], dict[str, Any]]
    anchors: FloatArray
    tags: FloatArray
    pose_rank: int | None
    batch: tuple[int, ...]


def scene_stage(spec: Any, condition: str, trials: int, seed: int) -> Stage:
    """The stage of a simulated scene."""
    world = worlds.simulate(scenes.get(spec), condition, trials, seed)
    told = world.told
    mirror = worlds.mirrored(world)
    expected, prior = _expected(world), _prior_tags(world)

    def make(name: str, options: dict[str, Any]) -> estimators.Filter:
        laws = {"tags": told.tags, "noise": told.noise, "process": told.process}
        filter = estimators.make(name, **laws, **options)
        check_takes_obstacles(name, filter, told)
        return filter

    def figures(tracked: Tracked) -> dict[str, Any]:
        distance = None
        if mirror is not None:
            distance = metrics.length(tracked.translation[-1] - mirror[-1])
        reference = Reference(expected, prior, distance)
        return bench_figures.figures(_errors(world, tracked), reference)

    rank = worlds.pose_rank(world)
    geometry = world.anchors, world.tags, rank
    return Stage(make, lambda f: _beliefs(world, f), figures, *geometry, (trials,))


def recording_stage(spec: Mapping[str, Any], condition: str, seed: int) -> Stage:
    """The stage of a recording; its trials are stretches of it."""
    log = recordings.load(spec)
    told, settings = recordings.stressed(log, condition, seed)

    def figures(tracked: Tracked) -> dict[str, Any]:
        track = replay.Track(told.times, *tracked[:3])
        return bench_figures.figures(recordings.errors(log, track), None)

    return Stage(
        lambda name, options: replay.named_filter(told, settings, name, options),
        lambda filter: replay.steps(told, settings, filter),
        figures,
        log.recording.anchors,
        log.recording.tags,
        None,
        (),
    )


def run(stage: Stage, name: str, options: dict[str, Any]) -> tuple[dict[str, Any], float | None]:
    """A filter on a stage: what a record says of it, and its microseconds per step and trial.

    `status` is ``"ok"``; ``"unobservable"`` where the geometry does not determine its states
    (it leans on its prior); ``"refused"`` where it raised a ValueError; ``"failed"`` where it
    raised anything else. `message` says at which epoch and what; no time is given of those two.
    """
    result: dict[str, Any] = {"status": "ok", "message": None}
    result["rank"], result["states"] = stage.pose_rank, 6
    try:
        filter = stage.make(name, options)
    except Exception as error:
        return result | _stopped(StoppedError(0, error)), None
    if isinstance(filter, estimators.KalmanFamily):
        result["rank"] = int(geometric_rank(stage.anchors, stage.tags).min())
        result["states"] = 12
    if result["rank"] is not None and result["rank"] < result["states"]:
        result["status"] = "unobservable"
    try:
        tracked = _track(stage.beliefs(filter), stage.batch)
    except StoppedError as stop:
        return result | _stopped(stop), None
    result["trigger_rate"] = bench_figures.plain(tracked.trigger_rate)
    steps = tracked.translation[..., 0].size
    return result | stage.figures(tracked), 1e6 * tracked.seconds / steps


def _beliefs(
    world: worlds.World, filter: estimators.Filter
) -> Iterator[tuple[Any, estimators.PoseBelief]]:
    state = filter.initial(*world.prior)
    for epoch, seen in enumerate(world.observations):
        if epoch:
            state = filter.predict(state, world.twists[epoch], world.told.dt)
        state = update(filter, state, seen, world.told)
        yield state, filter.belief(state)


def _track(beliefs: Iterator[tuple[Any, estimators.PoseBelief]], batch: tuple[int, ...]) -> Tracked:
    """All beliefs of a filter; a StoppedError where it raises or gives none."""
    rows, triggers, epoch = [], [], 0
    start = time.process_time()
    # What a filter that diverges overflows is told by its figures.
    with np.errstate(all="ignore"):
        try:
            for state, belief in beliefs:
                rows.append((belief.rotation, belief.translation, belief.covariance))
                for value, core in zip(rows[-1], ((3, 3), (3,), (6, 6)), strict=True):
                    if np.shape(value) != (*batch, *core):
                        raise TypeError(
                            f"beliefs must have arrays (..., 3, 3), (..., 3), (..., 6, 6) for "
                            f"batch {batch}, got {[np.shape(array) for array in rows[-1]]}; see "
                            "rbl_gym.testing.check_filter"
                        )
                triggers.append(getattr(state, "constrained", None))
                epoch += 1
        except Exception as error:
            raise StoppedError(epoch, error) from error
    seconds = time.process_time() - start
    rotation, translation, covariance = (
        np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)
    )
    rate = None if triggers[0] is None else float(np.mean(triggers))
    return Tracked(rotation, translation, covariance, rate, seconds)


def _stopped(stop: StoppedError) -> dict[str, Any]:
    """A ValueError is a refusal, in words that name what is missing; anything else is a fault."""
    refused = isinstance(stop.error, ValueError)
    kind = "" if refused else f"{type(stop.error).__name__}: "
    return {
        "status": "refused" if refused else "failed",
        "message": f"at epoch {stop.epoch}: {kind}{stop.error}",
    }


def _errors(world: worlds.World, tracked: Tracked) -> Errors:
    truth = world.rotation, world.translation
    with np.errstate(all="ignore"):
        error = metrics.pose_error(tracked.rotation, tracked.translation, *truth)
        tags = metrics.tag_error(tracked.rotation, tracked.translation, *truth, world.tags)
        try:
            nees = metrics.nees(error, tracked.covariance)
        except np.linalg.LinAlgError:
            nees = np.full(tags.shape, np.inf)
    # A covariance that is not positive claims the impossible.
    nees = np.where(nees >= 0, nees, np.inf)
    return Errors(
        metrics.length(error[..., 3:]), np.rad2deg(metrics.length(error[..., :3])), tags, nees
    )


def _expected(world: worlds.World) -> dict[str, FloatArray]:
    """Errors (K, B) that the bound expects, by part."""
    variance = np.diagonal(world.bound, axis1=-2, axis2=-1)
    return {
        "position_m": np.sqrt(variance[..., 3:].sum(axis=-1)),
        "rotation_deg": np.rad2deg(np.sqrt(variance[..., :3].sum(axis=-1))),
        "tags_m": bounds.score(world.bound, world.rotation, world.tags),
    }


def _prior_tags(world: worlds.World) -> FloatArray:
    """Tag error (B,) that the prior expects; no rotation is farther off than a random one."""
    rotation, _, covariance = world.prior
    spread = np.sqrt(np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1) / 3)
    scale = np.ones((*covariance.shape[:-2], 6))
    scale[..., :3] = np.minimum(1.0, 1.0 / spread)[..., None]
    capped = covariance * scale[..., :, None] * scale[..., None, :]
    return bounds.score(capped, rotation, world.tags)
