"""Filters of a third party that go wrong: what the benchmark's tests name as tests.fragile:..."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path
from typing import Any

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


not_callable = 3
