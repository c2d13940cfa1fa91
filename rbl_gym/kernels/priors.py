"""Checks of the initial pose and covariance of a filter, for `estimators.inputs`."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.kernels.jit import gufunc
from rbl_gym.kernels.linear_algebra import cholesky


@gufunc("(d,d),(s,s),(),()->()", "ffffb")
def is_sound(
    rotation: Any, covariance: Any, off_orthogonal: float, off_symmetric: float, sound: Any
) -> None:
    """Return whether a rotation is valid, and a covariance symmetric and positive definite."""
    Q, good = rotation, True
    for i in range(3):
        for j in range(i + 1):
            product = Q[i, 0] * Q[j, 0] + Q[i, 1] * Q[j, 1] + Q[i, 2] * Q[j, 2]
            # Also false for NaN.
            good = good and abs(product - (1.0 if i == j else 0.0)) <= off_orthogonal
    x = Q[0, 1] * Q[1, 2] - Q[0, 2] * Q[1, 1]
    y = Q[0, 2] * Q[1, 0] - Q[0, 0] * Q[1, 2]
    z = Q[0, 0] * Q[1, 1] - Q[0, 1] * Q[1, 0]
    good = good and x * Q[2, 0] + y * Q[2, 1] + z * Q[2, 2] > 0
    largest = 0.0
    for i in range(covariance.shape[0]):
        largest = max(largest, covariance[i, i])
    for i in range(covariance.shape[0]):
        for j in range(i):
            skew = abs(covariance[i, j] - covariance[j, i])
            good = good and skew <= off_symmetric * largest
    if good:
        good = cholesky(covariance, np.empty(covariance.shape))
    sound[0] = good
