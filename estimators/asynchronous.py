"""Asynchronous ranges: one at a time, each with its own time, possibly out of order.

Radios measure one link after another, and a range may arrive after later ones. `Asynchronous` runs
any filter of `rbl_gym.estimators.Filter` on such a stream. It predicts the state to the time of
every range. If a range arrives out of order within a short window, `Asynchronous` goes back and
repeats the later updates. The result equals that of the ordered stream to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_count, check_number
from rbl_gym.estimators.filter import Filter, PoseBelief
from rbl_gym.estimators.iekf.inertial import InertialEkf
from rbl_gym.estimators.iekf.odometry import OdometryEkf
from rbl_gym.estimators.linear.kalman import KalmanFamily
from rbl_gym.measurements.ranging import LinkNoise, NoiseLaw


class TimedRange(NamedTuple):
    """One range of a stream.

    Attributes
    ----------
    time
        Seconds.
    anchor, tag
        Indices of the link.
    range
        (...), metres.
    twist
        (..., 6) of the preceding interval; None: the filter estimates it.
    noise
        Noise model of the range; None: the noise model of the filter.
    anchors
        (..., M, 3) at its time; None: fixed anchors.
    """

    time: float
    anchor: int
    tag: int
    range: FloatArray
    twist: FloatArray | None
    noise: NoiseLaw | None = None
    anchors: FloatArray | None = None


class Checkpoint(NamedTuple):
    """The filter's state right after a range (None: the start)."""

    time: float
    state: Any
    measured: TimedRange | None


class Stream(NamedTuple):
    """State of a stream of ranges.

    Attributes
    ----------
    checkpoints
        In order of time: the last one before the window, and all inside it.
    dropped
        Number of ranges left out because they came too late for the window.
    """

    checkpoints: tuple[Checkpoint, ...]
    dropped: int

    @property
    def time(self) -> float:
        """Time of the newest range, seconds."""
        return self.checkpoints[-1].time


@dataclass(frozen=True, eq=False)
class Asynchronous:
    """Filter for ranges that arrive one at a time, possibly out of order; pure functions.

    Parameters
    ----------
    filter
        An iterated EKF whose `predict` takes a twist, or a filter of your own. ValueError for the
        linear filters, to which single ranges tell nothing, and for those that take sensor readings
        (``"iekf-imu"``, ``"iekf-log"`` with odometry).
    anchors
        (M, 3), positions in metres. Each call of `add` may give other positions.
    n_tags
        Number of tags on the body.
    window_s
        How much older than the newest range a range may be, seconds.

    Example
    -------
    >>> links = Asynchronous(filter, anchors, n_tags=6, window_s=0.1)
    >>> stream = links.start(filter.initial(rotation, translation, covariance), time=0.0)
    >>> stream = links.add(stream, time=0.013, anchor=2, tag=5, range=7.31)
    >>> links.belief(stream)
    """

    filter: Filter
    anchors: FloatArray
    n_tags: int
    window_s: float = 0.1

    def __post_init__(self) -> None:
        kind = type(self.filter).__name__
        if isinstance(self.filter, KalmanFamily):
            raise ValueError(
                f"filter must use single ranges, got {kind}: it uses differences between the "
                "ranges of an epoch; use an iterated EKF"
            )
        if isinstance(self.filter, InertialEkf | OdometryEkf):
            raise ValueError(
                f"filter must predict from a twist, got {kind}: it needs the readings of a sensor"
            )
        object.__setattr__(self, "anchors", check_array("anchors", self.anchors, ("M", 3)))
        if self.anchors.ndim != 2:
            raise ValueError(f"anchors must be (M, 3), got shape {self.anchors.shape}")
        object.__setattr__(self, "n_tags", check_count("n_tags", self.n_tags))
        check_number("window_s", self.window_s, low=0.0)

    def start(self, state: Any, time: float) -> Stream:
        """Return a stream from a state of the filter at a time (s).

        One range does not determine a pose. If the pose is unknown, start from the filter's
        state after a first epoch of all links.
        """
        return Stream((Checkpoint(check_number("time", time), state, None),), 0)

    def add(
        self,
        stream: Stream,
        time: float,
        anchor: int,
        tag: int,
        range: ArrayLike,
        twist: ArrayLike | None = (0.0,) * 6,
        noise: NoiseLaw | None = None,
        *,
        std_m: float | None = None,
        anchors: ArrayLike | None = None,
    ) -> Stream:
        """Return the stream with one more range.

        A range from before the start, or older than the newest range by more than the window, is
        left out and counted in `dropped`.

        Parameters
        ----------
        time
            Time of the range, seconds.
        anchor, tag
            Indices of the link.
        range
            (...), metres; with leading axes for several bodies with the same times.
        twist
            (..., 6) of the interval that ends at this range. By default zero, a random walk; None
            for a filter that estimates the twist.
        noise
            Noise model of this range, for instance ``LinkNoise([[0.05]])``; None: the filter's.
        std_m
            Standard deviation of this range, metres, in place of `noise`.
        anchors
            (..., M, 3), all anchors at this time, if they move; None: fixed anchors.

        Raises
        ------
        ValueError
            If an index is out of range, or the range, standard deviation, twist or anchors are
            invalid.
        """
        time = check_number("time", time)
        anchor = check_count("anchor", anchor, least=0, most=len(self.anchors) - 1)
        tag = check_count("tag", tag, least=0, most=self.n_tags - 1)
        value = check_array("range", range, ())
        if (value <= 0).any():
            raise ValueError(f"range must be positive, got {value.min()}")
        if twist is not None:
            twist = check_array("twist", twist, (6,))
        if std_m is not None:
            if noise is not None:
                raise ValueError("std_m and noise must not both be given: each sets the noise law")
            noise = LinkNoise(np.array([[check_number("std_m", std_m, low=1e-9)]]))
        if anchors is not None:
            anchors = check_array("anchors", anchors, ("M", 3))
            if anchors.shape[-2] != len(self.anchors):
                raise ValueError(
                    f"anchors must have shape ({len(self.anchors)}, 3), the number of anchors must "
                    f"not change; got {anchors.shape}"
                )
        measured = TimedRange(time, anchor, tag, value, twist, noise, anchors)
        newest = max(time, stream.time)
        if time < stream.checkpoints[0].time or time < newest - self.window_s:
            return stream._replace(dropped=stream.dropped + 1)
        kept = [point for point in stream.checkpoints if point.time <= time]
        later = [point.measured for point in stream.checkpoints[len(kept) :]]
        for each in (measured, *later):
            kept.append(self._advanced(kept[-1], each))  # pyrefly: ignore[bad-argument-type]
        # A range at the window's edge starts from the last checkpoint at or before the edge.
        first = max(
            k for k, point in enumerate(kept) if k == 0 or point.time < newest - self.window_s
        )
        return Stream(tuple(kept[first:]), stream.dropped)

    def _advanced(self, point: Checkpoint, measured: TimedRange) -> Checkpoint:
        state = self._moved(point, measured.time, measured.twist)
        shape = (len(self.anchors), self.n_tags)
        ranges = np.zeros((*measured.range.shape, *shape))
        ranges[..., measured.anchor, measured.tag] = measured.range
        links = np.zeros(shape, np.bool_)
        links[measured.anchor, measured.tag] = True
        # A filter of an older interface has no argument `noise`; pass it only if a range has one.
        law = {} if measured.noise is None else {"noise": measured.noise}
        anchors = self.anchors if measured.anchors is None else measured.anchors
        state = self.filter.update(state, ranges, anchors, links, **law)
        return Checkpoint(measured.time, state, measured)

    def _moved(self, point: Checkpoint, time: float, twist: FloatArray | None) -> Any:
        if time == point.time:
            return point.state
        return self.filter.predict(point.state, twist, time - point.time)  # pyrefly: ignore[bad-argument-type]

    def state(
        self, stream: Stream, time: float | None = None, twist: ArrayLike | None = (0.0,) * 6
    ) -> Any:
        """Return the filter's state at a time, seconds, at or after the newest range.

        `time` None: the time of the newest range.
        """
        newest = stream.checkpoints[-1]
        if time is None:
            return newest.state
        time = check_number("time", time)
        if time < newest.time:
            raise ValueError(
                f"time must be at least {newest.time:g} s, the time of the newest range, got "
                f"{time:g} s"
            )
        return self._moved(
            newest, time, None if twist is None else check_array("twist", twist, (6,))
        )

    def belief(
        self, stream: Stream, time: float | None = None, twist: ArrayLike | None = (0.0,) * 6
    ) -> PoseBelief:
        """Return the belief over the pose at a time, as `state`."""
        return self.filter.belief(self.state(stream, time, twist))
