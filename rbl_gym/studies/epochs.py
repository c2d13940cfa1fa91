"""Run a filter over epochs: predict, update and return the belief, epoch by epoch.

All code that runs a filter over several epochs uses this loop: Monte Carlo, the benchmark,
replayed recordings, tracking with designed layouts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym import metrics
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import Filter, PoseBelief, hold_level
from rbl_gym.estimators.filter import belief_of, reads
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.measurements.ranging import NoiseLaw

__all__ = [
    "AxisErrors",
    "PoseErrors",
    "Reading",
    "Step",
    "axis_errors",
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

    @property
    def count(self) -> int:  # pyrefly: ignore[bad-override]
        """The number of epochs."""
        return 1


def track_epochs(
    filter: Filter,
    prior: Prior,
    readings: Iterable[Reading],
    restart: Callable[[PoseBelief, FloatArray], Prior | None] | None = None,
    level: Level | None = None,
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
    level
        Known height and tilt of the body, applied after every prediction
        (`rbl_gym.estimators.hold_level`).

    Yields
    ------
    Step
        One per epoch, as soon as it is available.
    """
    state = filter.initial(*prior)
    for reading in readings:
        step = next_step(filter, state, reading, restart, level)
        state = step.state
        yield step


def next_step(
    filter: Filter, state: Any, reading: Reading, restart: Any, level: Level | None
) -> Step:
    """Return the step of an epoch from the state at the epoch before it."""
    told = reading.twist
    dt: Any = reading.dt
    if (sensor := reads(filter)) != "twist":
        measured = getattr(reading, sensor)
        if told is not None and measured is None:
            raise ValueError(f"the filter needs {_SENSORS[sensor]}, but the readings have none")
        told, dt = measured, reading.dt if reading.steps is None else reading.steps
    predicted = state
    if told is not None:
        predicted = filter.predict(state, told, dt)
        predicted = predicted if level is None else hold_level(state, predicted, level)
    state = _updated(filter, predicted, reading)
    belief = belief_of(filter, state)
    if restart is not None and (other := restart(belief, reading.anchors)) is not None:
        predicted = filter.initial(*other)
        state = _updated(filter, predicted, reading)
        belief = belief_of(filter, state)
    return Step(predicted, state, belief, reading)


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
