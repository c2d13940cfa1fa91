"""Prediction and update of the iterated EKF, for one body.

The textbook forms are `pose_steps.py` and `robust_update.py` in `estimators/iekf/`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.constants import (
    CUTOFF,
    CUTOFFS,
    GATE,
    HUBER,
    LARGEST_SHARE_OUT,
    LATE_HUBER,
    LATE_SHARE,
    OF_LATE,
    POWER,
    THRESHOLD,
    VAGUE,
)
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.linear_algebra import cholesky6, fill, invert_factored6
from rbl_gym.kernels.offsets import squared_residuals_of
from rbl_gym.kernels.pose_solver import copy_pose, mirror, solve
from rbl_gym.kernels.range_cost import loss_of, set_huber
from rbl_gym.kernels.workspace import workspace, zeros

# Larger than any length.
HUGE = 1e50
# The largest weight: compilers make slow code of a comparison with infinity.
LARGEST = 1e300
# Values of `robust`: squares, Huber's loss with a gate, the loss for late ranges.
SQUARES, GATED, LATE = 0, 1, 2
# Tags this thin relative to their length (squared) count as collinear.
THIN = 0.01


@gufunc("(d,d),(d),(p,p),(p),(),(p)->(d,d),(d),(p,p)")
def predict(Q0, t0, P0, twist, dt, variance, Q, t, P):
    """Predict pose and covariance: ``F P F^T + dt G S G^T``."""
    turn, J, half = workspace((3, 3)), workspace((3, 3)), workspace((3, 3))
    x, y, z = twist[0] * dt, twist[1] * dt, twist[2] * dt
    rotations.exp(x, y, z, turn)
    rotations.left_jacobian(x, y, z, J)
    rotations.compose(turn, Q0, Q)
    rotations.compose(turn, P0, half)
    for i in range(3):
        t[i] = t0[i] + twist[3 + i] * dt
        for j in range(i + 1):
            total = 0.0
            for k in range(3):
                total += half[i, k] * turn[j, k] + dt * variance[k] * J[i, k] * J[j, k]
            P[i, j] = total
            P[j, i] = total
        for j in range(3):
            P[3 + i, 3 + j] = P0[3 + i, 3 + j]
            total = 0.0
            for k in range(3):
                total += turn[i, k] * P0[k, 3 + j]
            P[i, 3 + j] = total
            P[3 + j, i] = total
        P[3 + i, 3 + i] += dt * variance[3 + i]


@helper
def invert(A: Any, L: Any, out: Any) -> bool:
    """Compute the inverse of a positive definite matrix, workspace L; else NaN and return False."""
    good = cholesky6(A, L)
    if good:
        invert_factored6(L, out)
    else:
        fill(math.nan, out)
    return good


@helper
def weigh(ranges: Any, shares: Any, law: Any, anchors: Any, signed: bool, weights: Any) -> bool:
    """Compute weights of an epoch: fractions over variances; return False for invalid numbers.

    `shares` are 0 for missing links. `law` has the numbers of `noise_laws`, for an epoch without
    lost links; or it is of kind 2, with the weights themselves in `shares`.
    """
    squared_range, given = law[0] == 1, law[0] == 2
    floor, growth, reference = law[1] * law[1], law[2] * law[2], int(law[3])
    for m in range(anchors.shape[0]):
        for i in range(3):
            if not abs(anchors[m, i]) < HUGE:
                return False
        for n in range(shares.shape[1]):
            share, distance = shares[m, n], ranges[m, n]
            if share == 0:
                weights[m, n] = 0.0
                continue
            if not (-HUGE if signed else 0.0) < distance < HUGE:
                return False
            weight = share
            if not given:
                told_by = distance if reference < 0 else ranges[m, reference]
                if squared_range:
                    weight *= 4 * distance * distance / (floor * told_by * told_by)
                else:
                    weight /= floor + growth * told_by * told_by
            if not 0 < weight < LARGEST:
                return False
            weights[m, n] = weight
    return True


@helper
def count_beyond(squared: Any, cutoff: float) -> int:
    """Return the number of links whose squared whitened residual is beyond a cutoff."""
    count = 0
    for m in range(squared.shape[0]):
        for n in range(squared.shape[1]):
            if squared[m, n] > cutoff * cutoff:
                count += 1
    return count


@helper
def leave_out(P0: Any, squared: Any, tags: Any, width: float, kept: Any) -> None:
    """Set weights of links that contradict the prior to zero, unless there are too many.

    `squared` and the weights `kept` are those at the prior. The variance of an innovation is at
    most that of the range plus the square of `width` times ``sqrt(tr P_v) + |c| sqrt(tr P_w)``.
    """
    of_rotation = math.sqrt(P0[0, 0] + P0[1, 1] + P0[2, 2])
    of_place = math.sqrt(P0[3, 3] + P0[4, 4] + P0[5, 5])
    out, links = 0, 0
    for again in range(2):
        for n in range(tags.shape[0]):
            x, y, z = tags[n, 0], tags[n, 1], tags[n, 2]
            reach = width * (of_place + math.sqrt(x * x + y * y + z * z) * of_rotation)
            for m in range(squared.shape[0]):
                weight = kept[m, n]
                beyond = squared[m, n] > GATE * GATE * (1 + weight * reach * reach)
                if again:
                    if beyond:
                        kept[m, n] = 0.0
                else:
                    out += beyond
                    links += weight > 0
        if out == 0 or out > LARGEST_SHARE_OUT * links:
            return


@helper
def is_wrong(squared: Any, weights: Any, kept: Any) -> bool:
    """Return whether a pose contradicts the choice of `leave_out`, for any link."""
    for m in range(squared.shape[0]):
        for n in range(squared.shape[1]):
            if (squared[m, n] > GATE * GATE) != (kept[m, n] != weights[m, n]):
                return True
    return False


@helper
def data_cost(squared: Any, loss: Any) -> float:
    """Return the cost of squared whitened residuals."""
    total = 0.0
    for m in range(squared.shape[0]):
        for n in range(squared.shape[1]):
            total += loss_of(squared[m, n], False, loss)[0]
    return total


@helper
def carry(A: Any, information: Any, sign: float, H: Any) -> None:
    """Compute ``H += sign A^T I A`` of matrices (6, 6)."""
    for j in range(6):
        for i in range(6):
            for k in range(6):
                moved = 0.0
                for m in range(6):
                    moved += information[k, m] * A[m, j]
                H[i, j] += sign * A[k, i] * moved


@helper
def keep_wide(Q0: Any, information: Any, Q: Any, weights: Any, tags: Any, H: Any) -> None:
    """Rotate the prior's information with the body if the measured tags are nearly collinear.

    For the reason see `estimators/costs/unseen_directions.py`.
    """
    cx = cy = cz = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    heard = 0
    for again in range(2):
        for n in range(tags.shape[0]):
            is_heard = False
            for m in range(weights.shape[0]):
                if weights[m, n] > 0:
                    is_heard = True
                    break
            if not is_heard:
                continue
            x, y, z = tags[n, 0] - cx, tags[n, 1] - cy, tags[n, 2] - cz
            if again:
                xx += x * x
                xy += x * y
                xz += x * z
                yy += y * y
                yz += y * z
                zz += z * z
            else:
                heard += 1
                sx += x
                sy += y
                sz += z
        if heard == 0:
            return
        cx, cy, cz = sx / heard, sy / heard, sz / heard
    trace = xx + yy + zz
    # The sum of products of two eigenvalues, divided by the square of their sum.
    pairs = xx * yy + yy * zz + xx * zz - xy * xy - xz * xz - yz * yz
    if not pairs <= THIN * trace * trace:
        return
    back, there, turned = workspace((3, 3)), workspace((3, 3)), workspace((3, 3))
    D, T = zeros((6, 6)), zeros((6, 6))
    a, b = workspace((3,)), workspace((3,))
    for i in range(3):
        a[i] = Q0[i, 0] * cx + Q0[i, 1] * cy + Q0[i, 2] * cz
        b[i] = Q[i, 0] * cx + Q[i, 1] * cy + Q[i, 2] * cz
        for j in range(3):
            back[i, j] = Q0[i, 0] * Q[j, 0] + Q0[i, 1] * Q[j, 1] + Q0[i, 2] * Q[j, 2]
            there[j, i] = back[i, j]
    x, y, z = rotations.log(there)
    rotations.left_jacobian_inverse(x, y, z, turned)
    for i in range(3):
        D[3 + i, 3 + i] = T[3 + i, 3 + i] = 1.0
        for j in range(3):
            D[i, j], T[i, j] = turned[i, j], back[i, j]
    # [Q0 c]x back - [Q c]x: an error about the tags' centre is the same in the body frame.
    for j in range(3):
        T[3, j] = a[1] * back[2, j] - a[2] * back[1, j]
        T[4, j] = a[2] * back[0, j] - a[0] * back[2, j]
        T[5, j] = a[0] * back[1, j] - a[1] * back[0, j]
    T[3, 1] += b[2]
    T[3, 2] -= b[1]
    T[4, 0] -= b[2]
    T[4, 2] += b[0]
    T[5, 0] += b[1]
    T[5, 1] -= b[0]
    carry(D, information, -1.0, H)
    carry(T, information, 1.0, H)


@helper
def most_likely(
    Q0: Any, t0: Any, P0: Any, ranges: Any, shares: Any, law: Any, anchors: Any, tags: Any,
    start_Q: Any, start_t: Any, options: Any, Q: Any, t: Any, P: Any,
) -> float:  # fmt: skip
    """Compute the most likely pose of an epoch near a start, and its covariance; return its cost.

    `options` are the kind of the ranges' offsets, the number of iterations, and `robust`.

    With GATED, links that the prior contradicts are left out (stage 0). If the resulting pose
    contradicts this choice, the update starts again with Huber's loss on all links (1), and leaves
    out those beyond each cutoff (2 and 3). With LATE it goes from Huber's loss to the redescending
    one.
    """
    offset, iterations, robust = options[0], options[1], options[2]
    H, information, L = workspace((6, 6)), workspace((6, 6)), workspace((6, 6))
    g, loss = workspace((6,)), workspace((5,))
    set_huber(loss, math.inf)
    weights = np.empty(shares.shape)
    kept, tolerance = weights, 1e-6
    squared = kept
    links, total = 0, math.nan
    sound = weigh(ranges, shares, law, anchors, offset != 0, weights)
    if not (sound and invert(P0, L, information)):
        copy_pose(Q0, t0, Q, t)
        fill(math.nan, P)
        return math.nan
    if robust != SQUARES:
        loss[THRESHOLD] = HUBER
    if robust == LATE:
        tolerance = 1e-2
    if robust == GATED:
        squared, kept = np.empty(weights.shape), np.empty(weights.shape)
        for m in range(weights.shape[0]):
            for n in range(weights.shape[1]):
                kept[m, n] = weights[m, n]
                links += weights[m, n] > 0
        squared_residuals_of(Q0, t0, ranges, weights, anchors, tags, loss, offset, squared)
        # An offset is determined by the other ranges, which are as uncertain.
        leave_out(P0, squared, tags, 1.0 if offset == 0 else 2.0, kept)
    for stage in range(4):
        if stage == 1 and robust == LATE:
            loss[THRESHOLD], loss[POWER], loss[OF_LATE], tolerance = (
                LATE_HUBER,
                2.0,
                LATE_SHARE,
                1e-6,
            )
        elif stage == 1:
            if not is_wrong(squared, weights, kept):
                break
            kept, tolerance = weights, 1e-2
        elif stage > 1:
            tolerance = 1e-6
            cutoff = CUTOFFS[stage - 2]
            doubted = count_beyond(squared, cutoff) > LARGEST_SHARE_OUT * links
            loss[CUTOFF] = math.inf if doubted else cutoff
        if stage == 0 or (stage == 1 and robust == GATED):
            copy_pose(start_Q, start_t, Q, t)
        total, _ = solve(
            Q, t, True, Q0, t0, information, ranges, kept, anchors, tags, loss, offset,
            iterations, tolerance, g, H,
        )  # fmt: skip
        if robust == SQUARES or (robust == LATE and stage == 1):
            break
        if robust == LATE:
            continue
        cutoff, loss[CUTOFF] = loss[CUTOFF], math.inf
        squared_residuals_of(Q, t, ranges, weights, anchors, tags, loss, offset, squared)
        loss[CUTOFF] = cutoff
    mirror(H)
    keep_wide(Q0, information, Q, weights, tags, H)
    if not invert(H, L, P):
        total = math.nan
    if robust == GATED:
        # A link that contradicts the pose has a limited cost, however it was left out.
        of_prior = total
        if offset != 0:
            squared_residuals_of(Q, t, ranges, kept, anchors, tags, loss, offset, squared)
        for m in range(weights.shape[0]):
            for n in range(weights.shape[1]):
                if kept[m, n] > 0:
                    of_prior -= loss_of(squared[m, n], False, loss)[0]
        loss[CUTOFF] = GATE
        if offset != 0:
            squared_residuals_of(Q, t, ranges, weights, anchors, tags, loss, offset, squared)
        total = of_prior + data_cost(squared, loss)
    return total


@gufunc(
    "(d,d),(d),(p,p),(m,n),(m,n),(q),(m,d),(n,d),(d,d),(d),(o)->(d,d),(d),(p,p),()",
    "ffffffffffiffff",
)
def update(
    Q0, t0, P0, ranges, shares, law, anchors, tags, start_Q, start_t, options, Q, t, P, cost
):  # fmt: skip
    """Compute the most likely pose of an epoch near a start, its covariance, and its cost."""
    cost[0] = most_likely(
        Q0, t0, P0, ranges, shares, law, anchors, tags, start_Q, start_t, options, Q, t, P
    )


@gufunc(
    "(d,d),(d),(p,p),(m,n),(m,n),(q),(m,d),(n,d),(o)->(d,d),(d),(p,p)",
    "ffffffffifff",
)
def update_near(Q0, t0, P0, ranges, shares, law, anchors, tags, options, Q, t, P):
    """Compute `update` from the prior pose; NaN if the prior is vague about the rotation."""
    copy_pose(Q0, t0, Q, t)
    fill(math.nan, P)
    if P0[0, 0] + P0[1, 1] + P0[2, 2] <= VAGUE:
        most_likely(Q0, t0, P0, ranges, shares, law, anchors, tags, Q0, t0, options, Q, t, P)
