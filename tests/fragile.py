"""Filters of a third party that go wrong: what the benchmark's tests name as tests.fragile:..."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from rbl_gym import estimators

PARENT = "RBL_TEST_PARENT"


def kills_its_worker(*, marker: str, tags: Any, noise: Any, process: Any) -> Any:
    """An iterated EKF; the first worker that makes one, besides the parent, is killed by it."""
    path = Path(tempfile.gettempdir()) / marker
    if os.environ.get(PARENT) != str(os.getpid()) and not path.exists():
        path.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    return estimators.make("iekf", tags=tags, noise=noise, process=process)


def stumbles(*, epoch: int = 1, tags: Any, noise: Any, process: Any) -> Any:
    """Raises a TypeError at an epoch."""
    inner = estimators.make("iekf", tags=tags, noise=noise, process=process)
    seen = []

    class Stumbles:
        initial, predict, belief = inner.initial, inner.predict, inner.belief

        def update(self, state: Any, ranges: Any, anchors: Any, links: Any = None) -> Any:
            seen.append(1)
            if len(seen) > epoch:
                raise TypeError("stumbled")
            return inner.update(state, ranges, anchors, links)

    return Stumbles()


def refuses_the_paper(*, tags: Any, noise: Any, process: Any) -> Any:
    """A ValueError on a law that is not of its kind; a belief of the wrong shape elsewhere."""
    if not hasattr(noise, "floor_m"):
        raise ValueError("noise must have a floor")
    inner = estimators.make("iekf", tags=tags, noise=noise, process=process)

    class Flat:
        initial, predict, update = inner.initial, inner.predict, inner.update

        def belief(self, state: Any) -> Any:
            belief = inner.belief(state)
            return belief._replace(covariance=belief.covariance[..., :3, :3])

    return Flat()


class Tuples:
    """Dead reckoning whose belief is a plain tuple."""

    def __init__(self, *, tags: Any, noise: Any, process: Any) -> None:
        self.inner = estimators.make("iekf", tags=tags, noise=noise, process=process)

    def initial(self, *prior: Any) -> Any:
        """As the iterated EKF does."""
        return self.inner.initial(*prior)

    def predict(self, state: Any, twist: Any, dt: float) -> Any:
        """As the iterated EKF does."""
        return self.inner.predict(state, twist, dt)

    def update(
        self, state: Any, ranges: Any, anchors: Any, links: Any = None, noise: Any = None
    ) -> Any:
        """Ignores the ranges."""
        return state

    def belief(self, state: Any) -> Any:
        """Only three of the four fields."""
        return tuple(self.inner.belief(state)[:3])


class _Pair(NamedTuple):
    mean: Any
    spread: Any


class OtherState(Tuples):
    """Dead reckoning whose state has other names."""

    def initial(self, *prior: Any) -> Any:
        """A state without the field covariance."""
        return _Pair(prior[:2], prior[2])

    def predict(self, state: Any, twist: Any, dt: float) -> Any:
        """As the iterated EKF does."""
        rotation, translation = state.mean
        inner = self.inner.initial(rotation, translation, state.spread)
        found = self.inner.predict(inner, twist, dt)
        return _Pair(found[:2], found[2])

    def belief(self, state: Any) -> Any:
        """All four fields."""
        rotation, translation = state.mean
        return estimators.PoseBelief(rotation, translation, state.spread, rotation)


not_callable = 3
