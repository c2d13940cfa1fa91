"""A track of one body with an unknown twist and biased links: many epochs in one call.

The textbook form is `track_augmented` in `estimators/iekf/augmented_steps.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.augmented_filter import move, revise
from rbl_gym.kernels.constants import VAGUE
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.workspace import workspace

# Larger than any variance.
_HUGE = 1e300


@helper
def variance_of(P: Any, h: Any) -> float:
    """Return ``h^T P h`` of a row h (6,) of the pose."""
    total = 0.0
    for i in range(6):
        for j in range(6):
            total += h[i] * P[i, j] * h[j]
    return total


@helper
def hold(P0: Any, level: Any, Q: Any, t: Any, extra: Any, P: Any) -> None:
    """Update a predicted state by the known height and tilt; see `estimators/level.py`.

    P0 is the covariance before the prediction. `level` has height and its standard deviation, and
    that of the tilt, infinite if unknown.
    """
    size = P.shape[0]
    step, crossed = np.zeros(size), np.empty(size)
    h, turn, old = workspace((6,)), workspace((3, 3)), workspace((3, 3))
    x, y, z = Q[0, 2], Q[1, 2], Q[2, 2]
    for row in range(3):
        std = level[1] if row == 0 else level[2]
        if not std < math.inf:
            continue
        for i in range(6):
            h[i] = 0.0
        if row == 0:
            left = level[0] - t[2]
            h[5] = 1.0
        elif row == 1:
            left = -x
            h[1], h[2] = z, -y
        else:
            left = -y
            h[0], h[2] = -z, x
        predicted = variance_of(P, h)
        added = max(predicted - variance_of(P0, h), 0.0)
        information = added / (std * std * (std * std + added))
        share = information / (1 + information * predicted)
        for i in range(6):
            left -= h[i] * step[i]
        for i in range(size):
            total = 0.0
            for j in range(6):
                total += P[i, j] * h[j]
            crossed[i] = total
        for i in range(size):
            gain = share * crossed[i]
            step[i] += gain * left
            for j in range(size):
                P[i, j] -= gain * crossed[j]
    for i in range(3):
        t[i] += step[3 + i]
        for j in range(3):
            old[i, j] = Q[i, j]
    rotations.exp(step[0], step[1], step[2], turn)
    rotations.compose(turn, old, Q)
    for i in range(size - 6):
        extra[i] += step[6 + i]


@gufunc(
    "(d,d),(d),(k),(s,s),(e,p),(e),(p),(p),(l,q),(),(h),(e,m,n),(e,m,n),(e,m,d),(n,d),(),(r)->"
    "(e,d,d),(e,d),(e,k),(e,s,s),(e,d,d),(e,d),(e,k),(e,s,s),()",
    "fffffffffifffffifffffffffi",
)
def track(
    start_Q, start_t, start_extra, start_P, twist, dt, variance, wander, laws, n_twist, level,
    ranges, weights, anchors, tags, iterations, loss, Q0, t0, extra0, P0, Q, t, extra, P, count,
):  # fmt: skip
    """Predict and update epoch by epoch, until one needs a search or is not determined.

    `count` is the number of epochs that were done.
    """
    held = level[1] < math.inf or level[2] < math.inf
    own = workspace((6, 6))
    count[0] = 0
    for e in range(dt.shape[0]):
        if e == 0:
            old_Q, old_t, old_extra, old_P = start_Q, start_t, start_extra, start_P
        else:
            old_Q, old_t, old_extra, old_P = Q[e - 1], t[e - 1], extra[e - 1], P[e - 1]
        move(
            old_Q, old_t, old_extra, old_P, twist[e], dt[e], variance, wander, laws, n_twist,
            Q0[e], t0[e], extra0[e], P0[e],
        )  # fmt: skip
        if held:
            hold(old_P, level, Q0[e], t0[e], extra0[e], P0[e])
        if not P0[e, 0, 0] + P0[e, 1, 1] + P0[e, 2, 2] <= VAGUE:
            return
        for i in range(6):
            for j in range(6):
                own[i, j] = P0[e, i, j]
        revise(
            Q0[e], t0[e], extra0[e], P0[e], ranges[e], weights[e], anchors[e], tags, Q0[e], t0[e],
            own, iterations, loss, n_twist, Q[e], t[e], extra[e], P[e],
        )  # fmt: skip
        if not P[e, 0, 0] < _HUGE:
            return
        count[0] = e + 1
