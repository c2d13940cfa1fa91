"""Predicted errors at a position, over rotations of the body.

The textbook form is `rbl_gym.studies.placing.requirements`.
"""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import gufunc
from rbl_gym.kernels.linear_algebra import cholesky6, invert_factored6
from rbl_gym.kernels.pose_bound import tag_square
from rbl_gym.kernels.workspace import workspace


@gufunc("(t,s,s),(t,s,s),(t,d,d),(n,d)->(),(),(),(),(),()")
def mean_squares(
    base: Any, part: Any, rotation: Any, tags: Any,
    position: Any, rotated: Any, tag: Any, horizontal: Any, height: Any, heading: Any,
) -> None:  # fmt: skip
    """Compute mean squares of the six errors over the rotations, for information base + part."""
    F, L, P = workspace((6, 6)), workspace((6, 6)), workspace((6, 6))
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


@gufunc("(t,s,s),(t,s,s)->(),(),()")
def asked_squares(base: Any, part: Any, horizontal: Any, height: Any, heading: Any) -> None:
    """Compute `mean_squares` of the required errors from the factor inverse's last columns."""
    F, L = workspace((6, 6)), workspace((6, 6))
    across = up = turn = 0.0
    n_turns = base.shape[0]
    for t in range(n_turns):
        for i in range(6):
            for j in range(i + 1):
                F[i, j] = base[t, i, j] + part[t, i, j]
        if not cholesky6(F, L):
            horizontal[0] = height[0] = heading[0] = math.nan
            return
        # Of the lower factor's inverse, whose diagonal is that of L; variances are the squared
        # norms of its columns.
        c55, c44, c33, c22 = L[5, 5], L[4, 4], L[3, 3], L[2, 2]
        c54 = -c55 * L[5, 4] * c44
        c43 = -c44 * L[4, 3] * c33
        c53 = -c55 * (L[5, 3] * c33 + L[5, 4] * c43)
        c32 = -c33 * L[3, 2] * c22
        c42 = -c44 * (L[4, 2] * c22 + L[4, 3] * c32)
        c52 = -c55 * (L[5, 2] * c22 + L[5, 3] * c32 + L[5, 4] * c42)
        across += c33 * c33 + c43 * c43 + c53 * c53 + c44 * c44 + c54 * c54
        up += c55 * c55
        turn += c22 * c22 + c32 * c32 + c42 * c42 + c52 * c52
    horizontal[0], height[0], heading[0] = across / n_turns, up / n_turns, turn / n_turns
