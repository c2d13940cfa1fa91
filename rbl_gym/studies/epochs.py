"""The loop over epochs: a filter predicts, updates and says what it believes, epoch by epoch.

Everything that runs a filter over more than one epoch runs this loop: Monte Carlo, the benchmark,
replayed recordings, tracking among designed layouts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

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
    """What a filter is told of one epoch; arrays may have leading axes.

    Attributes
    ----------
    ranges, anchors
        Ranges (..., M, N) in metres and places of the anchors (..., M, 3).
    links
        (..., M, N), True where a range was measured; None: all.
    noise
        Law of this epoch; None: the law that the filter was made with.
    twist
        (..., 6), rad/s and m/s, of the interval that ends at this epoch; None: no time has
        passed, as at the first epoch.
    dt
        Length of that interval, seconds.
    inertial
        Readings (..., S, 6) of an inertial sensor in that interval, for a filter that takes them
        in place of the twist.
    odometry
        Readings (..., S, 6) of odometry in that interval, for a filter that takes them; NaN where
        there is none.
    steps
        Seconds (S,) for which each of these readings counts; None: they share `dt` alike.
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
    """A filter after an epoch: its state before and after the ranges, its belief, the epoch."""

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
    """Run a filter over epochs, one step after the other.

    Parameters
    ----------
    filter
        Made by `estimators.make`, or anything with its interface.
    prior
        Rotation (..., 3, 3), translation (..., 3) and covariance (..., 6, 6) at the first epoch,
        before its ranges.
    readings
        What the filter is told, an epoch each.
    restart
        Called with every belief and the anchors of its epoch. Where it returns a prior, the
        filter starts again from that one and takes the ranges of the same epoch.
    hold
        Called with the states before and after every prediction, for what is known besides:
        `rbl_gym.estimators.hold_level` of a level body. What it returns is updated.

    Yields
    ------
    Step
        One per epoch, as soon as it is there.
    """
    state = filter.initial(*prior)
    for reading in readings:
        told = reading.twist
        dt: Any = reading.dt
        if (sensor := reads(filter)) != "twist":
            measured = getattr(reading, sensor)
            if told is not None and measured is None:
                raise ValueError(f"the filter reads {_SENSORS[sensor]}, and there is none here")
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
    # A filter that knows no law of an epoch has no such argument.
    law = {} if reading.noise is None else {"noise": reading.noise}
    return filter.update(state, reading.ranges, reading.anchors, reading.links, **law)


def timed(steps: Iterable[Step]) -> Iterator[tuple[Step, float]]:
    """Steps, each with the processor time that it took, in seconds."""
    iterator = iter(steps)
    while True:
        start = time.process_time()
        try:
            step = next(iterator)
        except StopIteration:
            return
        yield step, time.process_time() - start


def stack_beliefs(beliefs: Iterable[PoseBelief]) -> PoseBelief:
    """Beliefs of K epochs as one, with arrays (K, ...)."""
    columns = zip(*beliefs, strict=True)
    return PoseBelief(*(np.array(column, dtype=np.float64) for column in columns))


# So many epochs of one body at once: their matrices fit into the processor's caches.
_CHUNK = 256


def innovations_of(
    filter: Filter, steps: Iterable[Step], tags: FloatArray, noise: NoiseLaw
) -> Iterator[tuple[list[Step], Innovations]]:
    """Steps in groups of K, each group with its innovations, arrays (K, ...).

    What `estimators.innovations` finds, of many epochs at once.

    Parameters
    ----------
    filter
        That made the steps.
    steps
        Of `track_epochs`.
    tags
        Places on the body (N, 3).
    noise
        Law of the ranges where an epoch has none of its own.
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
        ``e^T P^-1 e`` (...), of mean 6 for an honest belief; inf where the covariance is not
        positive.
    """

    pose: FloatArray
    tags_m: FloatArray
    nees: FloatArray


def pose_errors(
    belief: PoseBelief, rotation: FloatArray, translation: FloatArray, tags: FloatArray
) -> PoseErrors:
    """Errors of beliefs against true poses.

    What a filter that diverges overflows is inf or NaN here, and raises no warning.

    Parameters
    ----------
    belief
        Of the filter, arrays (...).
    rotation, translation
        The truth, (..., 3, 3) and (..., 3).
    tags
        True places on the body (N, 3).
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
    """Errors of K beliefs in position and rotation, (K,) each; NaN where truth is not known.

    Attributes
    ----------
    position_m, rotation_deg
        Lengths of the errors.
    position_std_m, rotation_std_deg
        Standard deviations that the beliefs claim, of all axes together.
    nees
        Of the same axes.
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
    """Errors and claimed standard deviations of beliefs along a track, for curves over time.

    Parameters
    ----------
    belief
        Arrays (K, ...).
    rotation, translation
        The truth (K, 3, 3), (K, 3); rotation None: positions alone are judged.
    known
        Epochs (K,) that have truth; None: all.
    planar
        Judge yaw and the position in x and y only.
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
    """Ends of the interval that holds the mean NEES of honest beliefs with this probability.

    Parameters
    ----------
    count
        Independent beliefs that the mean is over.
    dof
        Degrees of freedom of each.
    level
        Probability; half of the rest lies below, half above.
    """
    tail = 0.5 * (1 - level)
    low, high = (special.chdtri(dof * count, p) / count for p in (1 - tail, tail))
    return float(low), float(high)
