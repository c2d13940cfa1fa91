"""Soft constraint on height and tilt in a filter, for a body that stays about level.

Height and tilt are stationary Gaussian processes about their known values, with standard deviation
S. If a prediction adds the variance D, the update is an observation of the known value with
standard deviation ``S sqrt(1 + S^2 / D)``. Repeated updates leave a variance of S^2 unchanged.
After a long time the observation has the standard deviation S itself.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.geometry import rotations


def hold_level(before: Any, predicted: Any, level: Level) -> Any:
    """Return the predicted state of a filter, updated by the known height and tilt.

    The prior of the filter must include this knowledge: its standard deviations of height and tilt
    must not be larger than those of `level`.

    Parameters
    ----------
    before, predicted
        States before and after a prediction, of the iterated EKFs: NamedTuples with `rotation`,
        `translation`, `covariance` (..., n, n) of (w, v) and other states, and these in `extra`.
    level
        Known height and tilt.

    Returns
    -------
    A state of the type of `predicted`.

    Raises
    ------
    ValueError
        If the states are of another filter.

    Examples
    --------
    >>> level = Level(height_m=0.5, height_std_m=0.2, tilt_std_rad=0.05)
    >>> state = hold_level(state, filter.predict(state, twist, dt), level)
    """
    fields = getattr(predicted, "_fields", ())
    if fields[:2] != ("rotation", "translation") or set(fields[2:]) - {
        "extra",
        "covariance",
        "log_weights",
        "log_evidence",
    }:
        raise ValueError(
            "level needs the state of an iterated EKF ('iekf', 'iekf-cv', 'iekf-bias', "
            f"'iekf-log'), got a state with {', '.join(fields) or type(predicted).__name__}"
        )
    return held(before, predicted, level.numbers)


def held(before: Any, predicted: Any, level: FloatArray) -> Any:
    """Return the state of `hold_level` for the numbers (3,) of a level."""
    P0, P = before.covariance, predicted.covariance
    Q, t = predicted.rotation, predicted.translation
    extra = getattr(predicted, "extra", np.zeros((*t.shape[:-1], 0)))
    step = np.zeros(P.shape[:-1])
    for row, value, std in _known(Q, t, level):
        h = np.concatenate([row, np.zeros((*row.shape[:-1], P.shape[-1] - 6))], axis=-1)
        added = _variance(P, h) - _variance(P0, h[..., : P0.shape[-1]])
        added = np.maximum(added, 0.0)
        information = added / (std**2 * (std**2 + added))
        crossed = (P @ h[..., None])[..., 0]
        # Later rows are linearized about the step of the rows before them.
        left = value - (h * step).sum(axis=-1)
        gain = crossed * (information / (1 + information * _variance(P, h)))[..., None]
        step = step + gain * left[..., None]
        P = P - gain[..., None] * crossed[..., None, :]
    P = 0.5 * (P + np.swapaxes(P, -1, -2))
    found = {
        "rotation": rotations.exp(step[..., :3]) @ Q,
        "translation": t + step[..., 3:6],
        "covariance": P,
    }
    if hasattr(predicted, "extra"):
        found["extra"] = extra + step[..., 6:]
    return predicted._replace(**found)


def _known(
    Q: FloatArray, t: FloatArray, level: FloatArray
) -> list[tuple[FloatArray, FloatArray, float]]:
    """Return rows (..., 6) by the pose error, residuals (...) and standard deviations."""
    known: list[tuple[FloatArray, FloatArray, float]] = []
    height, height_std, tilt_std = level.tolist()
    if height_std < math.inf:
        row = np.zeros((*t.shape[:-1], 6))
        row[..., 5] = 1.0
        known.append((row, height - t[..., 2], height_std))
    if tilt_std < math.inf:
        # An error w rotates the body's z axis u by w x u; for a level body u is (0, 0, 1).
        x, y, z = np.moveaxis(Q[..., :, 2], -1, 0)
        for place, parts in ((0, (0 * z, z, -y)), (1, (-z, 0 * z, x))):
            row = np.zeros((*t.shape[:-1], 6))
            row[..., :3] = np.stack(parts, axis=-1)
            known.append((row, -(x, y)[place], tilt_std))
    return known


def _variance(P: FloatArray, h: FloatArray) -> FloatArray:
    return np.einsum("...i,...ij,...j->...", h, P, h)
