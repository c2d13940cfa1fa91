"""Run a filter over epochs: predict, update and return the belief, epoch by epoch.

All code that runs a filter over several epochs uses this loop: Monte Carlo, the benchmark,
replayed recordings, tracking with designed layouts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym import metrics
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import Filter, Innovations, PoseBelief, innovations
from rbl_gym.estimators.filter import reads
from rbl_gym.measurements.ranging import LinkNoise, NoiseLaw

__all__ = [
    "AxisErrors",
    "PoseErrors",
    "Reading",
    "Step",
    "axis_errors",
    "innovations_of",
    "nees_interval",
    "pose_errors",
    "stack_beliefs",
    "timed",
    "track_epochs",
]

_SENSORS = {"inertial": "an inertial sensor", "odometry": "odometry"}

Prior = tuple[ArrayLike, ArrayLike, ArrayLike]


class Reading(NamedTuple):
    """The input of a filter at one epoch; arrays may have leading axes.

    Attributes
    ----------
    ranges, anchors
        Ranges (..., M, N) in metres and anchor positions (..., M, 3).
    links
        Mask (..., M, N), True if a range was measured; None: all.
    noise
        Noise law of this epoch; None: the noise law of the filter.
    twist
        Twist (..., 6), rad/s and m/s, of the interval that ends at this epoch; None: no interval,
        as at the first epoch.
    dt
        Length of that interval, seconds.
    inertial
        Readings (..., S, 6) of an inertial sensor in that interval, for a filter that uses them
        instead of the twist.
    odometry
        Readings (..., S, 6) of odometry in that interval, for a filter that uses them; NaN if
        not measured.
    steps
        Duration (S,) of each of these readings, seconds; None: equal parts of `dt`.
    """

    ranges: FloatArray
    anchors: FloatArray
    links: BoolArray | None = None
    noise: NoiseLaw | None = None
    twist: FloatArray | None = None
    dt: float = 0.0
    inertial: FloatArray | None = None
    odometry: FloatArray | None = None
    steps: FloatArray | None = None


class Step(NamedTuple):
    """The state of a filter before and after the ranges of an epoch, its belief, and the epoch."""

    predicted: Any
    state: Any
    belief: PoseBelief
    reading: Reading


def track_epochs(
    filter: Filter,
    prior: Prior,
    readings: Iterable[Reading],
    restart: Callable[[PoseBelief, FloatArray], Prior | None] | None = None,
    hold: Callable[[Any, Any], Any] | None = None,
) -> Iterator[Step]:
    """Run a filter over epochs, and yield each step.

    Parameters
    ----------
    filter
        A filter from `estimators.make`, or an object with the same interface.
    prior
        Rotation (..., 3, 3), translation (..., 3) and covariance (..., 6, 6) at the first epoch,
        before its ranges.
    readings
        The inputs of the filter, one per epoch.
    restart
        Called with every belief and the anchors of its epoch. If it returns a prior, the filter
        restarts from it and uses the ranges of the same epoch again.
    hold
        Called with the states before and after every prediction, to apply constraints such as
        `rbl_gym.estimators.hold_level`. The state that it returns is updated.

    Yields
    ------
    Step
        One per epoch, as soon as it is available.
    """
    state = filter.initial(*prior)
    for reading in readings:
        told = reading.twist
        dt: Any = reading.dt
        if (sensor := reads(filter)) != "twist":
            measured = getattr(reading, sensor)
            if told is not None and measured is None:
                raise ValueError(f"the filter needs {_SENSORS[sensor]}, but the readings have none")
            told, dt = measured, reading.dt if reading.steps is None else reading.steps
        if told is not None:
            moved = filter.predict(state, told, dt)
            state = moved if hold is None else hold(state, moved)
        predicted, state = state, _updated(filter, state, reading)
        belief = filter.belief(state)
        if restart is not None and (other := restart(belief, reading.anchors)) is not None:
            predicted = filter.initial(*other)
            state = _updated(filter, predicted, reading)
            belief = filter.belief(state)
        yield Step(predicted, state, belief, reading)


def _updated(filter: Filter, state: Any, reading: Reading) -> Any:
    # A filter without support for a noise law per epoch has no such argument.
    law = {} if reading.noise is None else {"noise": reading.noise}
    return filter.update(state, reading.ranges, reading.anchors, reading.links, **law)


def timed(steps: Iterable[Step]) -> Iterator[tuple[Step, float]]:
    """Yield steps, each with its processor time in seconds."""
    iterator = iter(steps)
    while True:
        start = time.process_time()
        try:
            step = next(iterator)
        except StopIteration:
            return
        yield step, time.process_time() - start


def seconds_per_step(taken: Sequence[float]) -> float:
    """Return the mean of the times of `timed`, without the first, which also loads kernels."""
    return float(np.mean(taken[1:] or taken))


def stack_beliefs(beliefs: Iterable[PoseBelief]) -> PoseBelief:
    """Stack the beliefs of K epochs to one, with arrays (K, ...)."""
    columns = zip(*beliefs, strict=True)
    return PoseBelief(*(np.array(column, dtype=np.float64) for column in columns))


# Epochs of one body per group: their matrices fit into the processor caches.
_CHUNK = 256


def innovations_of(
    filter: Filter, steps: Iterable[Step], tags: FloatArray, noise: NoiseLaw
) -> Iterator[tuple[list[Step], Innovations]]:
    """Yield steps in groups of K, each group with its innovations, arrays (K, ...).

    The innovations are those of `estimators.innovations`, for many epochs at once.

    Parameters
    ----------
    filter
        The filter of the steps.
    steps
        Steps from `track_epochs`.
    tags
        Tag positions on the body (N, 3).
    noise
        Noise law of epochs without their own.
    """
    kept: list[Step] = []
    shapes: list[tuple[int, ...]] = []
    for step in steps:
        trials = math.prod(step.belief.translation.shape[:-1])
        before, shapes = shapes, _shapes(step)
        if kept and (len(kept) * trials >= _CHUNK or shapes != before):
            yield kept, _innovations(filter, kept, tags, noise)
            kept = []
        kept.append(step)
    if kept:
        yield kept, _innovations(filter, kept, tags, noise)


def _shapes(step: Step) -> list[tuple[int, ...]]:
    return [a.shape for a in (*step.predicted, *step.state, *step.reading[:2])]


def _innovations(
    filter: Filter, steps: list[Step], tags: FloatArray, noise: NoiseLaw
) -> Innovations:
    before, after = (
        type(states[0])(*(np.array(field) for field in zip(*states, strict=True)))
        for states in ([step.predicted for step in steps], [step.state for step in steps])
    )
    readings = [step.reading for step in steps]
    ranges = np.array([reading.ranges for reading in readings])
    shape = ranges.shape[1:]
    anchors = np.array([reading.anchors for reading in readings])
    missing = (1,) * (ranges.ndim - anchors.ndim)
    anchors = anchors.reshape(len(anchors), *missing, *anchors.shape[1:])
    all_there = np.ones(shape, dtype=np.bool_)
    links = np.array(
        [
            all_there
            if r.links is None
            else (r.links if r.links.shape == shape else np.broadcast_to(r.links, shape))
            for r in readings
        ]
    )
    own = [reading.noise for reading in readings]
    variance = np.broadcast_to(noise.variance(ranges, links), ranges.shape).copy()
    for k, law in enumerate(own):
        if law is not None:
            variance[k] = law.variance(ranges[k], links[k])
    law = LinkNoise(np.sqrt(np.where(links, variance, 1.0)))
    return innovations(filter, before, after, ranges, anchors, tags, law, links)


class PoseErrors(NamedTuple):
    """Errors of beliefs.

    Attributes
    ----------
    pose
        (..., 6), radians and metres: ``Q_hat = exp(w) Q``, ``t_hat = t + v``.
    tags_m
        Root mean square displacement (...) of the tags.
    nees
        ``e^T P^-1 e`` (...), with mean 6 for a consistent belief; inf if the covariance is
        not positive definite.
    """

    pose: FloatArray
    tags_m: FloatArray
    nees: FloatArray


def pose_errors(
    belief: PoseBelief, rotation: FloatArray, translation: FloatArray, tags: FloatArray
) -> PoseErrors:
    """Return the errors of beliefs relative to true poses.

    Overflow of a diverging filter gives inf or NaN, without a warning.

    Parameters
    ----------
    belief
        Belief of the filter, arrays (...).
    rotation, translation
        The truth, (..., 3, 3) and (..., 3).
    tags
        True tag positions on the body (N, 3).
    """
    truth = rotation, translation
    with np.errstate(all="ignore"):
        error = metrics.pose_error(belief.rotation, belief.translation, *truth)
        tags_m = metrics.tag_error(belief.rotation, belief.translation, *truth, tags)
        singular = np.linalg.slogdet(belief.covariance)[0] == 0
        safe = np.where(singular[..., None, None], np.eye(6), belief.covariance)
        nees = metrics.nees(error, safe)
    return PoseErrors(error, tags_m, np.where(singular | ~(nees >= 0), np.inf, nees))


class AxisErrors(NamedTuple):
    """Errors of K beliefs in position and rotation, (K,) each; NaN if the truth is unknown.

    Attributes
    ----------
    position_m, rotation_deg
        Norms of the errors.
    position_std_m, rotation_std_deg
        Standard deviations of the beliefs, of all axes together.
    nees
        NEES of the same axes.
    """

    position_m: FloatArray
    rotation_deg: FloatArray
    position_std_m: FloatArray
    rotation_std_deg: FloatArray
    nees: FloatArray


def axis_errors(
    belief: PoseBelief,
    rotation: FloatArray | None,
    translation: FloatArray,
    known: BoolArray | None = None,
    planar: bool = False,
) -> AxisErrors:
    """Return errors and standard deviations of beliefs along a track, for curves over time.

    Parameters
    ----------
    belief
        Arrays (K, ...).
    rotation, translation
        The truth (K, 3, 3), (K, 3); rotation None: only positions are compared.
    known
        Epochs (K,) with truth; None: all.
    planar
        Compare only yaw and the position in x and y.
    """
    turn, move = ([2], [3, 4]) if planar else ([0, 1, 2], [3, 4, 5])
    axes = move if rotation is None else turn + move
    expected = belief.rotation if rotation is None else rotation
    error = metrics.pose_error(belief.rotation, belief.translation, expected, translation)
    nees = metrics.nees(error[:, axes], belief.covariance[:, axes][:, :, axes])
    missing = np.zeros(len(error), dtype=np.bool_) if known is None else ~known
    error[missing] = nees[missing] = np.nan
    if rotation is None:
        error[:, :3] = np.nan
    std = np.sqrt(np.diagonal(belief.covariance, axis1=-2, axis2=-1))
    return AxisErrors(
        np.linalg.norm(error[:, move], axis=-1),
        np.rad2deg(np.linalg.norm(error[:, turn], axis=-1)),
        np.linalg.norm(std[:, move], axis=-1),
        np.rad2deg(np.linalg.norm(std[:, turn], axis=-1)),
        nees,
    )


def nees_interval(count: int = 1, dof: int = 6, level: float = 0.95) -> tuple[float, float]:
    """Return the interval that contains the mean NEES of consistent beliefs with a probability.

    Parameters
    ----------
    count
        Number of independent beliefs in the mean.
    dof
        Degrees of freedom of each.
    level
        Probability; half of the remainder lies below, half above.
    """
    tail = 0.5 * (1 - level)
    low, high = (scipy.special.chdtri(dof * count, p) / count for p in (1 - tail, tail))
    return float(low), float(high)
