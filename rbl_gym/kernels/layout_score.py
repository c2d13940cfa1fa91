"""The score of an anchor layout. The textbook form is `rbl_gym.placement.problem`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.linear_algebra import cholesky6, invert_factored6
from rbl_gym.kernels.pose_bound import (
    add_range_information,
    square_of_information,
    tag_square,
)
from rbl_gym.kernels.workspace import workspace


@gufunc("(p,s,s),(p,d,d),(n,d),(p)->()")
def weighted_square(information: Any, rotation: Any, tags: Any, weight: Any, square: Any) -> None:
    """Return the sum of b^2 over the poses, weighted, from the information at each."""
    work = workspace((2, 6, 6))
    total = 0.0
    for k in range(rotation.shape[0]):
        total += weight[k] * square_of_information(information[k], rotation[k], tags, work)
    square[0] = total


@gufunc("(m,d),(p,d,d),(p,d),(n,d),(s,s),(l),(p,m)->()")
def mean_square(
    anchors: Any, rotation: Any, translation: Any, tags: Any, prior: Any, law: Any, share: Any,
    square: Any,
) -> None:  # fmt: skip
    """Return the mean of b^2 over the poses; `share` has each anchor's information fraction."""
    work = workspace((3, 6, 6))
    shares = np.empty((anchors.shape[0], tags.shape[0]))
    total = 0.0
    for k in range(rotation.shape[0]):
        total += _pose_square(
            anchors, rotation[k], translation[k], tags, prior, law, share[k], shares, work
        )
    square[0] = total / rotation.shape[0]


@helper
def _pose_square(
    anchors: Any, rotation: Any, translation: Any, tags: Any, prior: Any, law: Any, share: Any,
    shares: Any, work: Any,
) -> float:  # fmt: skip
    """Return b^2 of a pose; write its covariance to ``work[2]``."""
    information, L, P = work[0], work[1], work[2]
    for m in range(anchors.shape[0]):
        for n in range(tags.shape[0]):
            shares[m, n] = share[m]
    for i in range(6):
        for j in range(6):
            information[i, j] = prior[i, j]
    add_range_information(information, anchors, tags, rotation, translation, law, shares)
    if not cholesky6(information, L):
        return math.nan
    invert_factored6(L, P)
    return tag_square(P, rotation, tags)
