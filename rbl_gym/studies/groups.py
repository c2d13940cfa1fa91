"""Groups of consecutive epochs: a filter over a whole log, and the innovations of its steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators import Filter, Innovations, PoseBelief, innovations
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.measurements.ranging import LinkNoise, NoiseLaw
from rbl_gym.studies.epochs import Prior, Reading, Step, next_step, track_epochs

__all__ = ["Steps", "beliefs_of", "each", "innovations_of", "joined", "track_log"]

T = TypeVar("T", bound=tuple[Any, ...])

# Epochs of one body per group: their matrices fit into the processor caches.
_CHUNK = 256


class Steps(NamedTuple):
    """The steps of E consecutive epochs: the arrays of `Step` with an axis of epochs in front."""

    predicted: Any
    state: Any
    belief: PoseBelief
    reading: Reading

    @property
    def count(self) -> int:  # pyrefly: ignore[bad-override]
        """The number of epochs."""
        return len(self.belief.translation)

    def each(self) -> Iterator[Step]:
        """Yield the step of each epoch."""
        for k, reading in enumerate(each(self.reading)):
            yield Step(_at(self.predicted, k), _at(self.state, k), _at(self.belief, k), reading)


def track_log(
    filter: Filter,
    prior: Prior,
    log: Reading,
    restart: Callable[[PoseBelief, FloatArray], Prior | None] | None = None,
    level: Level | None = None,
) -> Iterator[Step | Steps]:
    """Run a filter over the epochs of one body; faster than `track_epochs`, with the same results.

    A filter whose attribute ``tracks`` is True has a method ``track``, which runs many epochs in
    one call (`rbl_gym.estimators.AugmentedEkf.track`). Epochs that this method does not take, and
    all epochs of other filters, are run one by one.

    Parameters
    ----------
    filter, prior, restart, level
        As in `track_epochs`.
    log
        The inputs at E epochs (`each`).

    Yields
    ------
    Step or Steps
        One per epoch, or per group of consecutive epochs.
    """
    if not getattr(filter, "tracks", False):
        yield from track_epochs(filter, prior, each(log), restart, level)
        return
    state, start = filter.initial(*prior), 0
    while start < len(log.ranges):
        part = _part(log, slice(start, start + _CHUNK))
        steps = _tracked(filter, state, part, restart, level)
        if steps is None:
            steps = next_step(filter, state, next(each(part)), restart, level)
            state = steps.state
        else:
            state = _at(steps.state, -1)
        start += steps.count
        yield steps


def _tracked(
    filter: Any, state: Any, part: Reading, restart: Any, level: Level | None
) -> Steps | None:
    """Return the steps of the first epochs of a log, without a restart; None: none."""
    try:
        found = filter.track(state, *part[:6], level)
    except (ValueError, np.linalg.LinAlgError):
        return None  # that epoch alone raises the error
    if found is None:
        return None
    belief = filter.belief(found[1])
    count = len(belief.translation)
    if restart is not None:
        told = (restart(_at(belief, k), part.anchors[k]) is not None for k in range(count))
        count = next((k for k, is_told in enumerate(told) if is_told), count)
    if count == 0:
        return None
    first = slice(count)
    before, after = (_at(states, first) for states in found)
    return Steps(before, after, _at(belief, first), _part(part, first))


def beliefs_of(steps: Iterable[Step | Steps]) -> PoseBelief:
    """Return the beliefs of all epochs, arrays (K, ...)."""
    return joined(s.belief if isinstance(s, Steps) else _at(s.belief, None) for s in steps)


def joined(groups: Iterable[T]) -> T:
    """Return the NamedTuples of arrays of several groups as one of all epochs."""
    groups = [*groups]
    return type(groups[0])(*map(np.concatenate, zip(*groups, strict=True)))


def innovations_of(
    filter: Filter, steps: Iterable[Step | Steps], tags: FloatArray, noise: NoiseLaw
) -> Iterator[tuple[Steps, Innovations]]:
    """Yield the steps of groups of E epochs, each group with its innovations, arrays (E, ...).

    The innovations are those of `estimators.innovations`, for many epochs at once.

    Parameters
    ----------
    filter
        The filter of the steps.
    steps
        Steps from `track_epochs` or `track_log`.
    tags
        Tag positions on the body (N, 3).
    noise
        Noise law of epochs without their own.
    """
    for group in _grouped(steps, noise):
        ranges, anchors, links, law, *_ = group.reading
        missing = (1,) * (ranges.ndim - anchors.ndim)
        anchors = anchors.reshape(len(anchors), *missing, *anchors.shape[1:])
        told = ranges, anchors, tags, noise if law is None else law, links
        yield group, innovations(filter, group.predicted, group.state, *told)


def _grouped(steps: Iterable[Step | Steps], noise: NoiseLaw) -> Iterator[Steps]:
    """Yield the steps in groups, single ones with those after them that have the same shapes."""
    kept: list[Step] = []
    shapes: list[tuple[int, ...]] = []
    for step in steps:
        if isinstance(step, Steps):
            if kept:
                yield _stacked(kept, noise)
                kept = []
            yield step
            continue
        trials = math.prod(step.belief.translation.shape[:-1])
        before, shapes = (
            shapes,
            [a.shape for a in (*step.predicted, *step.state, *step.reading[:2])],
        )
        if kept and (len(kept) * trials >= _CHUNK or shapes != before):
            yield _stacked(kept, noise)
            kept = []
        kept.append(step)
    if kept:
        yield _stacked(kept, noise)


def _stacked(steps: list[Step], noise: NoiseLaw) -> Steps:
    columns: list[list[Any]] = [[step[part] for step in steps] for part in range(3)]
    predicted, state, belief = (
        type(column[0])(*map(np.stack, zip(*column, strict=True))) for column in columns
    )
    readings = [step.reading for step in steps]
    ranges = np.array([reading.ranges for reading in readings])
    anchors = np.array([reading.anchors for reading in readings])
    shape = ranges.shape[1:]
    all_there = np.ones(shape, dtype=np.bool_)
    links = np.array(
        [
            all_there
            if r.links is None
            else (r.links if r.links.shape == shape else np.broadcast_to(r.links, shape))
            for r in readings
        ]
    )
    variance = np.broadcast_to(noise.variance(ranges, links), ranges.shape).copy()
    for k, law in enumerate(reading.noise for reading in readings):
        if law is not None:
            variance[k] = law.variance(ranges[k], links[k])
    law = LinkNoise(np.sqrt(np.where(links, variance, 1.0)))
    return Steps(predicted, state, belief, Reading(ranges, anchors, links, law))


def _at(arrays: Any, index: Any) -> Any:
    """Return the arrays of a NamedTuple at an index of their first axis."""
    return type(arrays)(*(array[index] for array in arrays))


def each(log: Reading) -> Iterator[Reading]:
    """Yield the reading of each epoch of a log.

    Parameters
    ----------
    log
        The inputs at E epochs, without sensors of the body: ranges (E, M, N), anchors (E, M, 3),
        links (E, M, N), twist (E, 6) and dt (E,), with 0 s for no interval. The noise law may be a
        `LinkNoise` with standard deviations (E, M, N).
    """
    for k in range(len(log.ranges)):
        one = _part(log, k)
        dt, complete = float(one.dt), one.links is None or one.links.all()
        links, twist = None if complete else one.links, one.twist if dt > 0 else None
        yield one._replace(links=links, twist=twist, dt=dt)


def _part(log: Reading, index: Any) -> Reading:
    """Return a part of a log, or one of its epochs."""
    links, twist = (None if a is None else a[index] for a in (log.links, log.twist))
    law, dt = log.noise, np.broadcast_to(log.dt, len(log.ranges))[index]
    law = LinkNoise(law.std_m[index]) if isinstance(law, LinkNoise) else law
    return Reading(log.ranges[index], log.anchors[index], links, law, twist, dt)
