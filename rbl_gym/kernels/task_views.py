"""Observations of the learning tasks. The textbook forms are in `wrappers/views.py`."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import gufunc, helper


@helper
def belief_view(rotation: Any, covariance: Any, prior_variance: Any, out: Any) -> None:
    """Write log standard deviations minus the prior's, and two columns of Q, to (12,)."""
    for i in range(6):
        out[i] = 0.5 * math.log(max(covariance[i, i], 1e-24) / prior_variance[i]) + 1.0
    for i in range(3):
        out[6 + i], out[9 + i] = rotation[i, 0], rotation[i, 1]


@helper
def cut(out: Any, limit: float) -> None:
    """Cut entries to +-limit."""
    for i in range(out.shape[0]):
        out[i] = min(max(out[i], -limit), limit)


@gufunc("(d),(d,d),(p,p),(t),(m,d),(p),(),(),(k)->(m),(k)", "fffffffbfif")
def mobile_anchors(
    translation: Any, rotation: Any, covariance: Any, twist: Any, anchors: Any,
    prior_variance: Any, speed: float, sort: bool, limits: Any, order: Any, out: Any,
) -> None:  # fmt: skip
    """Compute the order of the craft by bearing, and the view in that order."""
    m = anchors.shape[0]
    for i in range(m):
        order[i] = i
        # An insertion sort by the bearings, which are temporarily stored in `out`.
        out[i] = math.atan2(anchors[i, 1] - translation[1], anchors[i, 0] - translation[0])
        j = i
        while sort and j > 0 and out[order[j - 1]] > out[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i
    out[0] = translation[2] / 50
    out[1], out[2] = twist[3] / speed, twist[4] / speed
    belief_view(rotation, covariance, prior_variance, out[3:15])
    z = translation[2] / 100
    for k in range(m):
        x = (anchors[order[k], 0] - translation[0]) / 100
        y = (anchors[order[k], 1] - translation[1]) / 100
        out[15 + 2 * k], out[16 + 2 * k] = x, y
        out[15 + 2 * m + k] = 0.5 * math.log(max(x * x + y * y + z * z, 1e-16))
    cut(out, limits[0])


@gufunc("(d),(d,d),(p,p),(t),(p),(),(d),(d),(k)->(k)")
def anchor_selection(
    translation: Any, rotation: Any, covariance: Any, twist: Any, prior_variance: Any,
    speed: float, centre: Any, half: Any, limits: Any, out: Any,
) -> None:  # fmt: skip
    """Compute the view: position, velocity, belief."""
    for i in range(3):
        out[i] = (translation[i] - centre[i]) / half[i]
        out[3 + i] = twist[3 + i] / speed
    belief_view(rotation, covariance, prior_variance, out[6:18])
    cut(out, limits[0])
