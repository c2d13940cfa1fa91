"""Errors, NEES and score of a belief together. The textbook form is `rbl_gym.metrics`."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels import rotations
from rbl_gym.kernels.jit import gufunc
from rbl_gym.kernels.linear_algebra import cholesky6
from rbl_gym.kernels.pose_bound import tag_square
from rbl_gym.kernels.workspace import workspace


@gufunc("(d,d),(d),(s,s),(d,d),(d),(n,d)->(),(),(),(),()")
def judge(
    rotation_hat: Any, translation_hat: Any, covariance: Any, rotation: Any, translation: Any,
    tags: Any, rotation_error: Any, position_error: Any, tag_error: Any, nees: Any, score: Any,
) -> None:  # fmt: skip
    """Compute angle, distance, RMS tag displacement, ``e^T P^-1 e`` and score b of P."""
    work = workspace((7, 6))
    L, e, turn = work[:6], work[6], work[:3, :3]
    for i in range(3):
        e[3 + i] = translation_hat[i] - translation[i]
        for j in range(3):
            turn[i, j] = (
                rotation_hat[i, 0] * rotation[j, 0]
                + rotation_hat[i, 1] * rotation[j, 1]
                + rotation_hat[i, 2] * rotation[j, 2]
            )
    e[0], e[1], e[2] = rotations.log(turn)
    rotation_error[0] = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    position_error[0] = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
    total = 0.0
    for n in range(tags.shape[0]):
        for i in range(3):
            moved = e[3 + i]
            for j in range(3):
                moved += (rotation_hat[i, j] - rotation[i, j]) * tags[n, j]
            total += moved * moved
    tag_error[0] = math.sqrt(total / tags.shape[0])
    score[0] = math.sqrt(tag_square(covariance, rotation_hat, tags))
    nees[0] = math.nan
    if cholesky6(covariance, L):
        total = 0.0
        for i in range(6):
            left = e[i]
            for k in range(i):
                left -= L[i, k] * e[k]
            e[i] = left * L[i, i]
            total += e[i] * e[i]
        nees[0] = total
