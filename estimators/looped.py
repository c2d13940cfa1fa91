"""A filter of one body for a batch of bodies: a Python loop over the batch."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.estimators.filter import (
    Filter,
    PoseBelief,
    belief_of,
    check_takes_noise,
    factory_of,
    make,
    parse_filter,
    reads,
)
from rbl_gym.measurements.ranging import LinkNoise, NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise


@dataclass(frozen=True, eq=False)
class _Body:
    """The filter of a body and its state."""

    filter: Filter
    state: Any


class _Bodies(NamedTuple):
    """States of the bodies of a batch.

    Attributes
    ----------
    bodies
        (...), an object array of `_Body`.
    """

    bodies: np.ndarray


def one_by_one(factory: str | Callable[..., Any]) -> Callable[..., Filter]:
    """Return the factory of a filter for batches, made from the factory of a filter of one body.

    The new filter loops over the leading axes. Each body has its own filter object, and every call
    works on a copy of it. So a filter that keeps its estimate in its attributes also works. It is
    as slow as the loop: for many worlds, write a filter that accepts leading axes.

    Parameters
    ----------
    factory
        Class or function with the arguments `tags`, `noise`, `process` and its own options, or the
        name of a filter. The four methods of its filter (`Filter`) get arrays without leading axes.

    Returns
    -------
    A factory with the same arguments, for `make`, `register`, `EstimatePose` and
    `VectorEstimatePose`. It can be pickled if `factory` can.

    Raises
    ------
    ValueError
        If the name is unknown, or `factory` cannot be called.

    Examples
    --------
    >>> from rbl_gym import estimators
    >>> from rbl_gym.testing import check_filter
    >>> check_filter(estimators.one_by_one("iekf"))
    """
    factory_of(parse_filter(factory)[0])
    return partial(_OneByOne, factory)


class _OneByOne:
    """A filter that gives each body of a batch to a filter of its own."""

    def __init__(
        self,
        factory: str | Callable[..., Any],
        *,
        tags: ArrayLike,
        noise: NoiseLaw,
        process: ProcessNoise,
        **options: Any,
    ) -> None:
        tags = check_array("tags", tags, ("N", 3))
        if tags.ndim != 2:
            raise ValueError(f"tags must be (N, 3) for one_by_one, got shape {tags.shape}")
        self._factory, self._noise = factory, noise
        self._filter: Filter = make(factory, tags=tags, noise=noise, process=process, **options)
        self.reads = reads(self._filter)

    def initial(
        self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike
    ) -> _Bodies:
        """Return the states of priors (..., 3, 3), (..., 3), (..., 6, 6)."""
        arrays = _aligned((), (rotation, 2), (translation, 1), (covariance, 2))
        bodies = np.empty(arrays[1].shape[:-1], dtype=object)
        for at in np.ndindex(bodies.shape):
            filter = copy.deepcopy(self._filter)
            state = filter.initial(*(array[at] for array in arrays))
            bodies[at] = _Body(filter, state)
        return _Bodies(bodies)

    def predict(self, state: _Bodies, twist: ArrayLike, dt: float) -> _Bodies:
        """Return the states after `dt` seconds of the twists (..., 6)."""
        core = 1 if self.reads == "twist" else 2
        (twists,) = _aligned(state.bodies.shape, (twist, core))
        bodies = _spread(state.bodies, twists.shape[: twists.ndim - core])
        for at, filter, one in _copies(bodies):
            bodies[at] = _Body(filter, filter.predict(one, twists[at], dt))
        return _Bodies(bodies)

    def update(
        self,
        state: _Bodies,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> _Bodies:
        """Return the states after ranges (..., M, N) to anchors (..., M, 3)."""
        if noise is not None:
            check_takes_noise(self._factory, self._filter, "the noise changes in every epoch")
        ranges, anchors = _aligned(state.bodies.shape, (ranges, 2), (anchors, 2))
        if noise is None and np.ndim(self._noise.variance(np.ones(ranges.shape[-2:]))) > 2:
            noise = self._noise  # a law with leading axes, one entry for each body
        if links is not None:
            links = np.broadcast_to(np.asarray(links, dtype=np.bool_), ranges.shape)
        bodies = _spread(state.bodies, ranges.shape[:-2])
        std = None
        if noise is not None and bodies.shape:
            variance = np.broadcast_to(noise.variance(ranges, links), ranges.shape)
            std = np.sqrt(variance if links is None else np.where(links, variance, 1.0))
        for at, filter, one in _copies(bodies):
            epoch: dict[str, Any] = {} if links is None else {"links": links[at]}
            if noise is not None:
                epoch["noise"] = noise if std is None else LinkNoise(std[at])
            bodies[at] = _Body(filter, filter.update(one, ranges[at], anchors[at], **epoch))
        return _Bodies(bodies)

    def belief(self, state: _Bodies) -> PoseBelief:
        """Return the beliefs of the bodies, stacked."""
        bodies = state.bodies
        beliefs = [belief_of(filter, one) for _, filter, one in _copies(bodies)]
        fields = (np.stack([np.asarray(one[k], np.float64) for one in beliefs]) for k in range(4))
        return PoseBelief(*(field.reshape(*bodies.shape, *field.shape[1:]) for field in fields))


def _aligned(batch: tuple[int, ...], *arrays: tuple[ArrayLike, int]) -> list[FloatArray]:
    """Return arrays with the same leading axes; each is given with the number of its other axes."""
    parts = [(np.asarray(array, dtype=np.float64), core) for array, core in arrays]
    lead = [array.shape[: array.ndim - core] for array, core in parts]
    batch = np.broadcast_shapes(batch, *lead)
    # Copies, so that a filter that writes into its arguments changes nothing else.
    return [
        np.broadcast_to(array, (*batch, *array.shape[array.ndim - core :])).copy()
        for array, core in parts
    ]


def _spread(bodies: np.ndarray, batch: tuple[int, ...]) -> np.ndarray:
    """Return a new array of bodies with the leading axes `batch`."""
    return np.broadcast_to(bodies, batch).copy()


def _copies(bodies: np.ndarray) -> Iterator[tuple[tuple[int, ...], Any, Any]]:
    """Yield index, filter and state of each body; filter and state are copies."""
    for at in np.ndindex(bodies.shape):
        body: Any = copy.deepcopy(bodies[at])
        yield at, body.filter, body.state
