"""Run the filters of the benchmark on a world, and compute their figures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds, estimators, metrics
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.linear.squared_range import geometric_rank
from rbl_gym.studies import monte_carlo, replay
from rbl_gym.studies.bench import recordings, worlds
from rbl_gym.studies.bench.figures import BenchErrors, Reference, error_figures, json_number
from rbl_gym.studies.epochs import (
    Step,
    pose_errors,
    seconds_per_step,
    stack_beliefs,
    timed,
    track_epochs,
)
from rbl_gym.worlds import scenes

# Further words of a message for a filter that does not accept leading axes.
_ONE_BODY = (
    ". A filter must accept leading batch axes (here {batch}), and {name} accepts a single body: "
    "write its formulas for arrays (..., 3, 3), or add a line Batched = "
    "rbl_gym.estimators.one_by_one(...), which loops over the bodies, to its module, and name "
    "Batched here"
)


class Tracked(NamedTuple):
    """The run of a filter: beliefs (K, B, ...), number of triggers, processor time of a step."""

    belief: estimators.PoseBelief
    trigger_rate: float | None
    seconds: float


class StoppedError(Exception):
    """Raised if a filter raised an error: the epoch and the error."""

    def __init__(self, epoch: int, error: Exception) -> None:
        super().__init__(epoch, error)
        self.epoch, self.error = epoch, error


class BenchStage(NamedTuple):
    """A world of the benchmark, on which filters run.

    `make` makes a filter from a name and options, with the laws known to filters; `track` runs it
    over all epochs; `figures` computes all figures of a run. `anchors` and `tags` are the true
    geometry, `pose_rank` the number of pose directions that it determines, None if this depends on
    the path, and `batch` the leading axes of a belief.
    """

    make: Callable[[str | Callable[..., Any], dict[str, Any]], estimators.Filter]
    track: Callable[[estimators.Filter], Iterator[Step]]
    figures: Callable[[Tracked], dict[str, Any]]
    anchors: FloatArray
    tags: FloatArray
    pose_rank: int | None
    batch: tuple[int, ...]


def scene_stage(spec: Any, condition: str, trials: int, seed: int) -> BenchStage:
    """Return the stage of a simulated scene."""
    world = worlds.simulate_condition(scenes.get(spec), condition, trials, seed)
    told = world.told
    mirror = worlds.mirrored(world)
    expected, prior = _expected(world), _prior_tags(world)

    def figures(tracked: Tracked) -> dict[str, Any]:
        distance = None
        if mirror is not None:
            distance = metrics.length(tracked.belief.translation[-1] - mirror[-1])
        reference = Reference(expected, prior, distance)
        return error_figures(_errors(world, tracked.belief), reference)

    rank = worlds.pose_rank(world)
    geometry = world.anchors, world.tags, rank
    return BenchStage(
        lambda name, options: monte_carlo.scene_filter(told, name, options),
        lambda filter: track_epochs(filter, world.prior, world.readings),
        figures,
        *geometry,
        (trials,),
    )


def recording_stage(spec: Mapping[str, Any], condition: str, seed: int) -> BenchStage:
    """Return the stage of a recording; its trials are segments of it."""
    log = recordings.load_recording(spec)
    told, settings = recordings.stressed(log, condition, seed)

    def figures(tracked: Tracked) -> dict[str, Any]:
        track = replay.Track(told.times, *tracked.belief[:3])
        return error_figures(recordings.recording_errors(log, track), None)

    return BenchStage(
        lambda name, options: replay.named_filter(told, settings, name, options),
        lambda filter: replay.recording_steps(told, settings, filter),
        figures,
        log.recording.last_anchors,
        log.recording.tags,
        None,
        (),
    )


def run_filter(
    stage: BenchStage, name: str, options: dict[str, Any]
) -> tuple[dict[str, Any], float | None]:
    """Run a filter on a stage; return its record, and its microseconds per step and trial.

    `status` is ``"ok"``; ``"unobservable"`` if the geometry does not determine the states (the
    filter then relies on its prior); ``"ValueError"`` if the filter raised one; ``"failed"`` if it
    raised another error. For the last two, `message` gives the epoch and the error, and there is no
    time.
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
        tracked = _track(stage.track(filter), stage.batch)
    except StoppedError as stop:
        stopped = _stopped(stop)
        if _takes_one_body(stage, name, options, stop.epoch):
            stopped["message"] += _ONE_BODY.format(batch=stage.batch, name=name)
        return result | stopped, None
    result["trigger_rate"] = json_number(tracked.trigger_rate)
    trials = tracked.belief.translation[0, ..., 0].size
    return result | stage.figures(tracked), 1e6 * tracked.seconds / trials


def _track(steps: Iterator[Step], batch: tuple[int, ...]) -> Tracked:
    """Return all beliefs of a filter; raise StoppedError if it fails or has no beliefs."""
    beliefs, triggers, times = [], [], []
    # Overflow of a diverging filter shows in its figures.
    with np.errstate(all="ignore"):
        try:
            for step, taken in timed(steps):
                times.append(taken)
                shapes = [np.shape(array) for array in step.belief[:3]]
                if shapes != [(*batch, *core) for core in ((3, 3), (3,), (6, 6))]:
                    raise TypeError(
                        f"beliefs must have arrays (..., 3, 3), (..., 3), (..., 6, 6) for "
                        f"batch {batch}, got {shapes}; see rbl_gym.testing.check_filter"
                    )
                beliefs.append(step.belief)
                triggers.append(getattr(step.state, "constrained", None))
        except Exception as error:
            raise StoppedError(len(beliefs), error) from error
    rate = None if triggers[0] is None else float(np.mean(triggers))
    return Tracked(stack_beliefs(beliefs), rate, seconds_per_step(times))


def _takes_one_body(stage: BenchStage, name: str, options: dict[str, Any], epoch: int) -> bool:
    """Return whether a filter that stopped at an epoch works for each body alone."""
    if not stage.batch or epoch > 1:  # the first prediction is that of epoch 1
        return False
    try:
        filter = stage.make(estimators.one_by_one(name), options)
        _track(itertools.islice(stage.track(filter), epoch + 1), stage.batch)
    except Exception:
        return False
    return True


def _stopped(stop: StoppedError) -> dict[str, Any]:
    """Return the status: ``"ValueError"`` for a ValueError, ``"failed"`` for any other error."""
    wrong = isinstance(stop.error, ValueError)
    kind = "" if wrong else f"{type(stop.error).__name__}: "
    return {
        "status": "ValueError" if wrong else "failed",
        "message": f"at epoch {stop.epoch}: {kind}{stop.error}",
    }


def _errors(world: worlds.BenchWorld, belief: estimators.PoseBelief) -> BenchErrors:
    found = pose_errors(belief, world.rotation, world.translation, world.tags)
    turn, shift = metrics.length(found.pose[..., :3]), metrics.length(found.pose[..., 3:])
    return BenchErrors(shift, np.rad2deg(turn), found.tags_m, found.nees)


def _expected(world: worlds.BenchWorld) -> dict[str, FloatArray]:
    """Return the errors (K, B) expected by the bound, by part."""
    variance = np.diagonal(world.bound, axis1=-2, axis2=-1)
    return {
        "position_m": np.sqrt(variance[..., 3:].sum(axis=-1)),
        "rotation_deg": np.rad2deg(np.sqrt(variance[..., :3].sum(axis=-1))),
        "tags_m": bounds.score(world.bound, world.rotation, world.tags),
    }


def _prior_tags(world: worlds.BenchWorld) -> FloatArray:
    """Return the tag error (B,) expected by the prior; rotation errors are at most random ones."""
    rotation, _, covariance = world.prior
    spread = np.sqrt(np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1) / 3)
    scale = np.ones((*covariance.shape[:-2], 6))
    scale[..., :3] = np.minimum(1.0, 1.0 / spread)[..., None]
    capped = covariance * scale[..., :, None] * scale[..., None, :]
    return bounds.score(capped, rotation, world.tags)
