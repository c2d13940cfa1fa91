"""Prediction and update of a pose with an unknown twist and biased links, for one body.

The textbook forms are `estimators/iekf/augmented.py` and `estimators/costs/bias_cost.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.bias_cost import innovation, linearize, shares, weigh, whiten
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.linear_algebra import (
    cholesky6,
    fill,
    invert_factored6,
    solve_factored6,
)
from rbl_gym.kernels.pose_filter import keep_wide
from rbl_gym.kernels.pose_solver import copy_pose, mirror
from rbl_gym.kernels.workspace import workspace

# Largest step (rad, m) on any axis.
_LONGEST = 1e12
# Weights that change by no more than this between two poses are considered equal.
_SAME_SHARE = 0.01


@helper
def move(
    Q0: Any, t0: Any, extra0: Any, P0: Any, twist: Any, dt: float, variance: Any, wander: Any,
    laws: Any, n_twist: int, Q: Any, t: Any, extra: Any, P: Any,
) -> None:  # fmt: skip
    """Predict pose, twist and biases: ``F P F^T + G Q G^T`` with decaying biases."""
    turn, J, both = workspace((3, 3)), workspace((3, 3)), workspace((3, 3))
    size = P0.shape[0]
    kept = np.empty(size)
    unknown = n_twist > 0
    reach = dt**3 / 3 if unknown else 0.0
    x, y, z = twist[0] * dt, twist[1] * dt, twist[2] * dt
    if unknown:
        x, y, z = extra0[0] * dt, extra0[1] * dt, extra0[2] * dt
    rotations.exp(x, y, z, turn)
    rotations.left_jacobian(x, y, z, J)
    rotations.compose(turn, Q0, Q)
    for i in range(3):
        t[i] = t0[i] + dt * (extra0[3 + i] if unknown else twist[3 + i])
    first = 6 + n_twist
    links = (size - first) // laws.shape[0] if laws.shape[0] > 0 else 1
    for i in range(first):
        kept[i] = 1.0
    for a in range(laws.shape[0]):
        decay = math.exp(-dt / laws[a, 1])
        for i in range(first + a * links, first + (a + 1) * links):
            kept[i] = decay
    # Rows of P, then columns: F acts on those of the pose, the decay on those of the biases.
    for j in range(size):
        for i in range(3):
            value = turn[i, 0] * P0[0, j] + turn[i, 1] * P0[1, j] + turn[i, 2] * P0[2, j]
            if unknown:
                value += dt * (J[i, 0] * P0[6, j] + J[i, 1] * P0[7, j] + J[i, 2] * P0[8, j])
            P[i, j] = value * kept[j]
            value = P0[3 + i, j]
            if unknown:
                value += dt * P0[9 + i, j]
            P[3 + i, j] = value * kept[j]
    for i in range(6, size):
        for j in range(size):
            P[i, j] = kept[i] * P0[i, j] * kept[j]
    for i in range(size):
        a0, a1, a2 = P[i, 0], P[i, 1], P[i, 2]
        for j in range(3):
            value = turn[j, 0] * a0 + turn[j, 1] * a1 + turn[j, 2] * a2
            if unknown:
                value += dt * (J[j, 0] * P[i, 6] + J[j, 1] * P[i, 7] + J[j, 2] * P[i, 8])
                P[i, 3 + j] += dt * P[i, 9 + j]
            P[i, j] = value
    # With acceleration noise q, the velocity change has variance q dt, the displacement q dt^3 / 3,
    # and their covariance is q dt^2 / 2.
    for i in range(3):
        for j in range(3):
            both[i, j] = J[i, j] * (dt * variance[j] + reach * wander[j])
    for i in range(3):
        for j in range(3):
            P[i, j] += both[i, 0] * J[j, 0] + both[i, 1] * J[j, 1] + both[i, 2] * J[j, 2]
            if unknown:
                cross = 0.5 * dt * dt * J[i, j] * wander[j]
                P[i, 6 + j] += cross
                P[6 + j, i] += cross
        P[3 + i, 3 + i] += dt * variance[3 + i] + reach * wander[3 + i]
        if unknown:
            cross = 0.5 * dt * dt * wander[3 + i]
            P[3 + i, 9 + i] += cross
            P[9 + i, 3 + i] += cross
            P[6 + i, 6 + i] += dt * wander[i]
            P[9 + i, 9 + i] += dt * wander[3 + i]
    for i in range(n_twist):
        extra[i] = extra0[i]
    for a in range(laws.shape[0]):
        begin = first + a * links
        decay = math.exp(-dt / laws[a, 1])
        fresh = 1 - decay * decay
        for i in range(links):
            extra[begin - 6 + i] = decay * extra0[begin - 6 + i]
            if fresh > 0:
                for j in range(links):
                    P[begin + i, begin + j] += fresh * laws[a, 2] * laws[a, 2]
                P[begin + i, begin + i] += fresh * laws[a, 0] * laws[a, 0]


@helper
def revise(
    Q0: Any, t0: Any, extra0: Any, P0: Any, ranges: Any, weights: Any, anchors: Any, tags: Any,
    start_Q: Any, start_t: Any, start_P: Any, iterations: int, loss: Any, n_twist: int,
    Q: Any, t: Any, extra: Any, P: Any,
) -> None:  # fmt: skip
    """Compute the most likely pose of an epoch whose ranges have biases, and further results."""
    size, n_tags = P0.shape[0], tags.shape[0]
    n_links = weights.shape[0] * n_tags
    first = 6 + n_twist
    n_laws = (size - first) // n_links
    count = 0
    sound = True
    chosen = np.empty(n_links, np.int64)
    for m in range(weights.shape[0]):
        for n in range(n_tags):
            if weights[m, n] > 0:
                chosen[count] = m * n_tags + n
                count += 1
    chosen = chosen[:count]
    six = workspace((7, 6, 6))
    information, A, best, L6, pose, at_start = six[0], six[1], six[2], six[3], six[4], six[5]
    g, new_g, step, e = six[6, 0], six[6, 1], six[6, 2], six[6, 3]
    small = workspace((3, 3, 3))
    D, turn, new_Q = small[0], small[1], small[2]
    new_t = workspace((3,))
    padded = (count + 3) // 4 * 4
    rows = np.zeros((4, padded, 6))
    of_pose, slope, H, B = rows[0], rows[1], rows[2], rows[3]
    own, L = np.empty((count, count)), np.empty((count, count))
    values, y = np.empty((4, count)), np.zeros(padded)
    told, variance, share, nu = values[0], values[1], values[2], values[3]
    for i in range(6):
        for j in range(6):
            A[i, j] = P0[i, j]
            at_start[i, j] = start_P[i, j]
    sound = cholesky6(A, L6)
    invert_factored6(L6, information)
    for k in range(count):
        told[k] = ranges[chosen[k] // n_tags, chosen[k] % n_tags]
        variance[k] = 1 / weights[chosen[k] // n_tags, chosen[k] % n_tags]
        share[k] = 1.0
        for j in range(6):
            of_pose[k, j] = 0.0
        for a in range(n_laws):
            row = first + a * n_links + chosen[k]
            told[k] -= extra0[row - 6]
            for j in range(6):
                of_pose[k, j] += P0[row, j]
    for k in range(count):
        for i in range(6):
            slope[k, i] = 0.0
            for j in range(6):
                slope[k, i] += of_pose[k, j] * information[j, i]
        for m in range(k + 1):
            total = 0.0
            for a in range(n_laws):
                for b in range(n_laws):
                    row = first + a * n_links + chosen[k]
                    total += P0[row, first + b * n_links + chosen[m]]
            for j in range(6):
                total -= slope[k, j] * of_pose[m, j]
            own[k, m] = own[m, k] = total
    copy_pose(start_Q, start_t, Q, t)
    robust = loss[0] < math.inf
    innovation(Q, t, Q0, t0, told, slope, chosen, anchors, tags, e, D, nu, H)
    for again in range(2):
        if again:
            fill(0.0, at_start)
        if robust:
            changed = shares(nu, H, own, variance, at_start, loss, share)
            if again and changed <= _SAME_SHARE:
                break
        elif again:
            break
        sound = weigh(own, variance, share, L) and sound
        # Damped Gauss-Newton as in `pose_solver.solve`.
        cost, decrease, damping, accepted = 0.0, 0.0, 0.0, True
        copy_pose(Q, t, new_Q, new_t)
        for k in range(iterations + 1):
            if k > 0:
                innovation(new_Q, new_t, Q0, t0, told, slope, chosen, anchors, tags, e, D, nu, H)
            whiten(L, nu, H, y, B)
            new = linearize(e, D, y, B, information, new_g, A)
            accepted = k == 0 or new <= cost * (1 + 1e-12) or decrease < 1e-8
            if accepted:
                cost = new
                damping = 0.1 * damping if damping > 1e-5 else 0.0
                copy_pose(new_Q, new_t, Q, t)
                for i in range(6):
                    g[i] = new_g[i]
                    for j in range(i + 1):
                        best[i, j] = A[i, j]
            else:
                damping = max(10 * damping, 1e-3)
            if k == iterations or (k > 0 and decrease < 1e-12):
                break
            for i in range(6):
                for j in range(i):
                    A[i, j] = best[i, j]
                A[i, i] = best[i, i] * (1 + damping + 1e-14) + 1e-300
            cholesky6(A, L6)
            solve_factored6(L6, g, step)
            decrease = 0.0
            for i in range(6):
                step[i] = min(max(-step[i], -_LONGEST), _LONGEST)
                decrease -= g[i] * step[i]
            decrease *= 1 + damping
            rotations.exp(step[0], step[1], step[2], turn)
            rotations.compose(turn, Q, new_Q)
            for i in range(3):
                new_t[i] = t[i] + step[3 + i]
        if not accepted:
            innovation(Q, t, Q0, t0, told, slope, chosen, anchors, tags, e, D, nu, H)
            whiten(L, nu, H, y, B)
    mirror(best)
    keep_wide(Q0, information, Q, weights, tags, best)
    sound = cholesky6(best, L6) and sound
    invert_factored6(L6, pose)
    if not sound:
        fill(math.nan, pose)
    # Of the extra states: information of the ranges given the pose, then that of the pose. The
    # innermost loops run over columns of one row, which the compiler makes vector operations, and
    # take four rows at a time, so that they seldom write.
    K = size - 6
    narrow = np.zeros((4, 6, K))
    with_pose, by_pose, moved, new = narrow[0], narrow[1], narrow[2], narrow[3]
    told_by, line = np.zeros((padded, K)), np.zeros(K)
    for j in range(6):
        for i in range(K):
            with_pose[j, i] = P0[6 + i, j]
    for j in range(6):
        for m in range(6):
            factor = information[m, j]
            for i in range(K):
                by_pose[j, i] += with_pose[m, i] * factor
    for k in range(count):
        for b in range(n_laws):
            for i in range(K):
                told_by[k, i] += P0[6 + i, first + b * n_links + chosen[k]]
        for j in range(6):
            factor = of_pose[k, j]
            for i in range(K):
                told_by[k, i] -= by_pose[j, i] * factor
    for k in range(count):
        for m in range(0, k - 3, 4):
            a, b, c, d = L[k, m], L[k, m + 1], L[k, m + 2], L[k, m + 3]
            for i in range(K):
                told_by[k, i] -= (
                    a * told_by[m, i] + b * told_by[m + 1, i]
                    + c * told_by[m + 2, i] + d * told_by[m + 3, i]
                )  # fmt: skip
        for m in range(k - k % 4, k):
            factor = L[k, m]
            for i in range(K):
                told_by[k, i] -= factor * told_by[m, i]
        for i in range(K):
            told_by[k, i] *= L[k, k]
    for i in range(K):
        line[i] = extra0[i]
    for j in range(6):
        for i in range(K):
            line[i] += by_pose[j, i] * e[j]
        for m in range(6):
            factor = (D[m, j] if m < 3 else 0.0) if j < 3 else (1.0 if m == j else 0.0)
            if factor != 0.0:
                for i in range(K):
                    moved[j, i] += by_pose[m, i] * factor
    for k in range(0, count, 4):
        a, b, c, d = y[k], y[k + 1], y[k + 2], y[k + 3]
        for i in range(K):
            line[i] += (
                a * told_by[k, i] + b * told_by[k + 1, i]
                + c * told_by[k + 2, i] + d * told_by[k + 3, i]
            )  # fmt: skip
        for j in range(6):
            a, b, c, d = B[k, j], B[k + 1, j], B[k + 2, j], B[k + 3, j]
            for i in range(K):
                moved[j, i] -= (
                    a * told_by[k, i] + b * told_by[k + 1, i]
                    + c * told_by[k + 2, i] + d * told_by[k + 3, i]
                )  # fmt: skip
    for i in range(K):
        extra[i] = line[i]
    for j in range(6):
        for m in range(6):
            factor = pose[m, j]
            for i in range(K):
                new[j, i] += moved[m, i] * factor
        for i in range(K):
            P[6 + i, j] = P[j, 6 + i] = new[j, i]
        for i in range(6):
            P[i, j] = pose[i, j]
    for i in range(K):
        for j in range(i + 1):
            line[j] = P0[6 + i, 6 + j]
        for m in range(6):
            a, b = by_pose[m, i], new[m, i]
            for j in range(i + 1):
                line[j] -= a * with_pose[m, j]
                line[j] += b * moved[m, j]
        for k in range(0, count, 4):
            a, b, c, d = told_by[k, i], told_by[k + 1, i], told_by[k + 2, i], told_by[k + 3, i]
            for j in range(i + 1):
                line[j] -= (
                    a * told_by[k, j] + b * told_by[k + 1, j]
                    + c * told_by[k + 2, j] + d * told_by[k + 3, j]
                )  # fmt: skip
        for j in range(i + 1):
            P[6 + i, 6 + j] = P[6 + j, 6 + i] = line[j]


@gufunc(
    "(d,d),(d),(k),(s,s),(p),(),(p),(p),(l,q),()->(d,d),(d),(k),(s,s)",
    "fffffffffiffff",
)
def predict(
    Q0, t0, extra0, P0, twist, dt, variance, wander, laws, n_twist, Q, t, extra, P
):  # fmt: skip
    """Run `move` for one interval."""
    move(Q0, t0, extra0, P0, twist, dt, variance, wander, laws, n_twist, Q, t, extra, P)


@gufunc(
    "(d,d),(d),(k),(s,s),(m,n),(m,n),(m,d),(n,d),(d,d),(d),(p,p),(),(l),()->(d,d),(d),(k),(s,s)",
    "fffffffffffififfff",
)
def update(
    Q0, t0, extra0, P0, ranges, weights, anchors, tags, start_Q, start_t, start_P, iterations,
    loss, n_twist, Q, t, extra, P,
):  # fmt: skip
    """Run `revise` for one epoch."""
    revise(
        Q0, t0, extra0, P0, ranges, weights, anchors, tags, start_Q, start_t, start_P, iterations,
        loss, n_twist, Q, t, extra, P,
    )  # fmt: skip
