"""Predicted errors at a place, over turns of the body.

The textbook form is `rbl_gym.studies.placing.requirements`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.jit import gufunc
from rbl_gym.kernels.linear_algebra import cholesky6, invert_factored6
from rbl_gym.kernels.pose_bound import tag_square


@gufunc("(t,s,s),(t,s,s),(t,d,d),(n,d)->(),(),(),(),(),()")
def mean_squares(
    base: Any, part: Any, rotation: Any, tags: Any,
    position: Any, rotated: Any, tag: Any, horizontal: Any, height: Any, heading: Any,
) -> None:  # fmt: skip
    """Means over the turns of the squares of the six figures, of the information base + part."""
    F, L, P = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    position[0] = rotated[0] = tag[0] = horizontal[0] = height[0] = heading[0] = 0.0
    n_turns = base.shape[0]
    for t in range(n_turns):
        for i in range(6):
            for j in range(i + 1):
                F[i, j] = base[t, i, j] + part[t, i, j]
        if not cholesky6(F, L):
            position[0] = rotated[0] = tag[0] = math.nan
            horizontal[0] = height[0] = heading[0] = math.nan
            return
        invert_factored6(L, P)
        across = P[3, 3] + P[4, 4]
        position[0] += (across + P[5, 5]) / n_turns
        rotated[0] += (P[0, 0] + P[1, 1] + P[2, 2]) / n_turns
        tag[0] += tag_square(P, rotation[t], tags) / n_turns
        horizontal[0] += across / n_turns
        height[0] += P[5, 5] / n_turns
        heading[0] += P[2, 2] / n_turns
