"""Initial tracks for the smoother, from a filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.estimators.filter import Filter
from rbl_gym.measurements.noise_laws import LinkNoise

if TYPE_CHECKING:
    from rbl_gym.estimators.smoothing.smoother import RangeLog

__all__ = ["causal_track"]


def causal_track(
    filter: Filter, log: RangeLog, prior: Sequence[ArrayLike], twists: ArrayLike | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return rotations (..., K, 3, 3) and translations (..., K, 3) estimated by a filter.

    Parameters
    ----------
    filter
        A filter from `rbl_gym.estimators.make`.
    log
        The log; its times (K,) are common to all trials.
    prior
        Rotation (..., 3, 3), translation (..., 3), covariance (..., 6, 6) at the first epoch.
    twists
        (..., K - 1, 6) of the intervals; None: zero.

    Raises
    ------
    ValueError
        If the filter raises it.
    """
    times = check_array("times", log.times, ("K",))
    if times.ndim != 1:
        raise ValueError(
            "log.times must have shape (K,), as the filter steps all trials at the same times, got "
            f"shape {times.shape}"
        )
    ranges, anchors = np.asarray(log.ranges, float), np.asarray(log.anchors, float)
    twists = np.zeros((len(times) - 1, 6)) if twists is None else np.asarray(twists, float)
    state: Any = filter.initial(*prior)
    beliefs = []
    for k, time in enumerate(times):
        if k > 0 and time > times[k - 1]:
            state = filter.predict(state, twists[..., k - 1, :], float(time - times[k - 1]))
        law = {} if log.noise is None else {"noise": _law_at(log.noise, k)}
        links = None if log.links is None else np.asarray(log.links)[..., k, :, :]
        places = anchors if anchors.ndim == 2 else anchors[..., min(k, anchors.shape[-3] - 1), :, :]
        state = filter.update(state, ranges[..., k, :, :], places, links, **law)
        beliefs.append(filter.belief(state)[:2])
    rotation, translation = zip(*beliefs, strict=True)
    return np.stack(rotation, axis=-3), np.stack(translation, axis=-2)


def _law_at(noise: Any, k: int) -> Any:
    """Return the noise model of one epoch from that of all epochs."""
    if isinstance(noise, LinkNoise) and noise.std_m.ndim > 2:
        return LinkNoise(noise.std_m[..., k, :, :])
    return noise
