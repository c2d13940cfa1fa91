"""States other than the pose of one body: update with the pose, and prediction.

The textbook forms are `augmented.py` and `inertial.py` in `estimators/iekf/`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.jit import gufunc
from rbl_gym.kernels.linear_algebra import cholesky6, fill, invert_factored6, multiply
from rbl_gym.kernels.workspace import workspace


@gufunc("(d,d),(d),(k),(p,p),(d,d),(d),(q,q)->(k),(p,p)")
def carry(
    Q0: Any, t0: Any, x0: Any, P0: Any, Q: Any, t: Any, new: Any, x: Any, P: Any
) -> None:  # fmt: skip
    """Update further states by their correlation with the pose, and the joint covariance."""
    k = x0.shape[0]
    room, D, turn, e = workspace((3, 6, 6)), workspace((3, 3)), workspace((3, 3)), workspace((6,))
    own, L, inverse = room[0], room[1], room[2]
    gain, slope, across = np.empty((k, 6)), np.empty((k, 6)), np.empty((k, 6))
    for i in range(6):
        for j in range(6):
            own[i, j] = P0[i, j]
            P[i, j] = new[i, j]
    if not cholesky6(own, L):
        for i in range(k):
            x[i] = math.nan
        fill(math.nan, P)
        return
    invert_factored6(L, inverse)
    for i in range(3):
        for j in range(3):
            turn[i, j] = Q[i, 0] * Q0[j, 0] + Q[i, 1] * Q0[j, 1] + Q[i, 2] * Q0[j, 2]
        e[3 + i] = t[i] - t0[i]
    e[0], e[1], e[2] = rotations.log(turn)
    rotations.left_jacobian_inverse(e[0], e[1], e[2], D)
    for i in range(k):
        x[i] = x0[i]
        for j in range(6):
            total = 0.0
            for m in range(6):
                total += P0[6 + i, m] * inverse[m, j]
            gain[i, j] = total
            x[i] += total * e[j]
        # An error of the new pose is one of the old pose times blkdiag(Jl^-1, I).
        for j in range(3):
            slope[i, j] = gain[i, 0] * D[0, j] + gain[i, 1] * D[1, j] + gain[i, 2] * D[2, j]
            slope[i, 3 + j] = gain[i, 3 + j]
    for i in range(6):
        for j in range(6):
            own[i, j] = new[i, j]
    multiply(slope, own, across)
    for i in range(k):
        for j in range(6):
            P[6 + i, j] = P[j, 6 + i] = across[i, j]
        for j in range(i + 1):
            total = P0[6 + i, 6 + j]
            for m in range(6):
                total += across[i, m] * slope[j, m] - gain[i, m] * P0[6 + j, m]
            P[6 + i, 6 + j] = P[6 + j, 6 + i] = total


@gufunc("(k),(p,p),(l,c),(),()->(k),(p,p)", "ffffiff")
def fade(x0: Any, P0: Any, laws: Any, dt: float, n_twist: int, x: Any, P: Any) -> None:
    """Predict biases of the links over `dt` seconds: decay towards zero, and random walk."""
    n, count, start = P0.shape[0], laws.shape[0], 6 + n_twist
    links = (n - start) // count
    kept = np.empty(n)
    for i in range(n):
        kept[i] = 1.0
    for law in range(count):
        share = math.exp(-dt / laws[law, 1])
        for i in range(links):
            kept[start + law * links + i] = share
    for i in range(n):
        for j in range(n):
            P[i, j] = P0[i, j] * (kept[i] * kept[j])
    for i in range(n - 6):
        x[i] = x0[i] * kept[6 + i]
    for law in range(count):
        first = start + law * links
        fresh = 1 - math.exp(-2 * dt / laws[law, 1])
        own, common = fresh * laws[law, 0] ** 2, fresh * laws[law, 2] ** 2
        for i in range(links):
            P[first + i, first + i] += own
            for j in range(links):
                P[first + i, first + j] += common
