"""Kalman filters of 12 states on squared ranges: prediction, update, constraint, belief.

The state is ``[vec Q; t]``, columns of Q first. The tags are s_n = Q c_n + t. Weights are inverse
variances of the squared ranges, (M, 1) if all tags share them, otherwise (M, N), and zero for lost
links. The textbook forms are in `estimators/linear/`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels import rotations
from rbl_gym.kernels.jit import gufunc, helper, inlined
from rbl_gym.kernels.linear_algebra import factor_semidefinite, fill, of_size
from rbl_gym.kernels.workspace import workspace, zeros

_STATES = 12
# Larger than any length.
HUGE = 1e50
_cholesky, _, _invert_factored = of_size(_STATES)


@gufunc("(p),(s),()->(p)")
def predict_mean(mean: Any, twist: Any, dt: float, new_mean: Any) -> None:
    """Compute ``x <- F x + [0; v dt]`` with the twist (w, v).

    F is blkdiag(R, R, R, I) with ``R = exp(w dt)``.
    """
    R = workspace((3, 3))
    rotations.exp(dt * twist[0], dt * twist[1], dt * twist[2], R)
    for i in range(3):
        for k in range(3):
            new_mean[3 * k + i] = (
                R[i, 0] * mean[3 * k] + R[i, 1] * mean[3 * k + 1] + R[i, 2] * mean[3 * k + 2]
            )
        new_mean[9 + i] = mean[9 + i] + dt * twist[3 + i]


@gufunc("(p,p),(s),(),(p)->(p,p)")
def predict_covariance(P: Any, twist: Any, dt: float, rate: Any, new_P: Any) -> None:
    """Compute ``P <- F P F^T + dt diag(rate)``, F as in `predict_mean`."""
    work = workspace((2, 3, 3))
    R, half = work[0], work[1]
    rotations.exp(dt * twist[0], dt * twist[1], dt * twist[2], R)
    for k in range(4):
        for m in range(k + 1):
            row, column = 3 * k, 3 * m
            for i in range(3):
                for j in range(3):
                    if k == 3:
                        half[i, j] = P[row + i, column + j]
                    else:
                        half[i, j] = (
                            R[i, 0] * P[row, column + j]
                            + R[i, 1] * P[row + 1, column + j]
                            + R[i, 2] * P[row + 2, column + j]
                        )
            for i in range(3):
                for j in range(3):
                    if m == 3:
                        value = half[i, j]
                    else:
                        value = half[i, 0] * R[j, 0] + half[i, 1] * R[j, 1] + half[i, 2] * R[j, 2]
                    if k != m or j <= i:
                        new_P[row + i, column + j] = value
                        new_P[column + j, row + i] = value
    for i in range(_STATES):
        new_P[i, i] += dt * rate[i]


@helper
def _weighted_mean(anchors: Any, weights: Any, column: int) -> tuple[float, float, float]:
    """Compute the weighted mean of the anchors."""
    total = x = y = z = 0.0
    for m in range(anchors.shape[0]):
        w = weights[m, column]
        total += w
        x += w * anchors[m, 0]
        y += w * anchors[m, 1]
        z += w * anchors[m, 2]
    if total > 0:
        return x / total, y / total, z / total
    return 0.0, 0.0, 0.0


@helper
def spread(anchors: Any, weights: Any, column: int, G: Any) -> None:
    """Compute the upper triangle of ``G = 4 A Pi A^T``, the information about a tag position."""
    x, y, z = _weighted_mean(anchors, weights, column)
    xx = xy = xz = yy = yz = zz = 0.0
    for m in range(anchors.shape[0]):
        w = 4 * weights[m, column]
        a, b, c = anchors[m, 0] - x, anchors[m, 1] - y, anchors[m, 2] - z
        xx += w * a * a
        xy += w * a * b
        xz += w * a * c
        yy += w * b * b
        yz += w * b * c
        zz += w * c * c
    G[0], G[1], G[2], G[3], G[4], G[5] = xx, xy, xz, yy, yz, zz


@helper
def _add_information(H: Any, anchors: Any, tags: Any, weights: Any) -> None:
    """Add ``sum_n (c_e c_e^T) kron G_n`` to the lower blocks of H."""
    n_tags, n_weights = tags.shape[0], weights.shape[1]
    G = np.empty((n_weights, 6))
    for n in range(n_weights):
        spread(anchors, weights, n, G[n])
    for k in range(4):
        for m in range(k + 1):
            gram = xx = xy = xz = yy = yz = zz = 0.0
            for n in range(n_tags):
                s = 1.0
                if k < 3:
                    s = tags[n, k]
                if m < 3:
                    s *= tags[n, m]
                gram += s
                if n_weights > 1:
                    xx += s * G[n, 0]
                    xy += s * G[n, 1]
                    xz += s * G[n, 2]
                    yy += s * G[n, 3]
                    yz += s * G[n, 4]
                    zz += s * G[n, 5]
            if n_weights == 1:
                xx, xy, xz = gram * G[0, 0], gram * G[0, 1], gram * G[0, 2]
                yy, yz, zz = gram * G[0, 3], gram * G[0, 4], gram * G[0, 5]
            i, j = 3 * k, 3 * m
            H[i, j] += xx
            H[i + 1, j] += xy
            H[i + 2, j] += xz
            H[i + 1, j + 1] += yy
            H[i + 2, j + 1] += yz
            H[i + 2, j + 2] += zz
            if m < k:
                H[i, j + 1] += xy
                H[i, j + 2] += xz
                H[i + 1, j + 2] += yz


@inlined
def innovation(
    mean: Any, ranges: Any, anchors: Any, tags: Any, weights: Any, arms: Any, y: Any
) -> None:
    """Compute ``y = sum_n c_e kron (b_n - G_n s_n)`` (4, 3) from squared range residuals.

    ``b_n - G_n s_n = -2 sum_m w (a_m - a) (r_mn^2 - |a_m - s_n|^2)``, where a is the weighted mean
    of the anchors. The term |s_n|^2 of each square cancels. `arms` are the c_n of c_e = [c_n; 1]:
    the tags, or the tags relative to their centroid.
    """
    for k in range(4):
        for i in range(3):
            y[k, i] = 0.0
    column = 0
    x0, x1, x2 = _weighted_mean(anchors, weights, 0)
    for n in range(tags.shape[0]):
        c0, c1, c2 = tags[n, 0], tags[n, 1], tags[n, 2]
        s0 = mean[0] * c0 + mean[3] * c1 + mean[6] * c2 + mean[9]
        s1 = mean[1] * c0 + mean[4] * c1 + mean[7] * c2 + mean[10]
        s2 = mean[2] * c0 + mean[5] * c1 + mean[8] * c2 + mean[11]
        if weights.shape[1] > 1:
            column = n
            x0, x1, x2 = _weighted_mean(anchors, weights, n)
        b0 = b1 = b2 = total = 0.0
        for m in range(anchors.shape[0]):
            d0, d1, d2 = anchors[m, 0] - s0, anchors[m, 1] - s1, anchors[m, 2] - s2
            r = ranges[m, n]
            e = weights[m, column] * (d0 * d0 + d1 * d1 + d2 * d2 - r * r)
            total += e
            b0 += e * d0
            b1 += e * d1
            b2 += e * d2
        # Less the part of the mean, for a_m - a in place of a_m - s.
        b0 = 2 * (b0 - total * (x0 - s0))
        b1 = 2 * (b1 - total * (x1 - s1))
        b2 = 2 * (b2 - total * (x2 - s2))
        for k in range(4):
            c = arms[n, k] if k < 3 else 1.0
            y[k, 0] += c * b0
            y[k, 1] += c * b1
            y[k, 2] += c * b2


@helper
def _take_covariance(P: Any, anchors: Any, tags: Any, weights: Any, new_P: Any) -> None:
    work = workspace((2, _STATES, _STATES))
    L, information = work[0], work[1]
    _cholesky(P, L)
    _invert_factored(L, information)
    _add_information(information, anchors, tags, weights)
    _cholesky(information, L)
    _invert_factored(L, new_P)


@gufunc("(p,p),(m,d),(n,d),(m,w)->(p,p)")
def update_covariance(P: Any, anchors: Any, tags: Any, weights: Any, new_P: Any) -> None:
    """Compute ``(P^-1 + information)^-1``, the posterior covariance, which needs no ranges."""
    _take_covariance(P, anchors, tags, weights, new_P)


@gufunc("(p,p)->(p,p)")
def inverse(matrix: Any, inverted: Any) -> None:
    """Compute the inverse of a symmetric positive definite matrix of the filter's size."""
    L = workspace((_STATES, _STATES))
    _cholesky(matrix, L)
    _invert_factored(L, inverted)


@helper
def _take_mean(
    mean: Any, P: Any, ranges: Any, anchors: Any, tags: Any, weights: Any, new_mean: Any
) -> None:
    y = workspace((4, 3))
    innovation(mean, ranges, anchors, tags, weights, tags, y)
    x = workspace((_STATES,))
    for i in range(_STATES):
        x[i] = mean[i]
    for k in range(4):
        for j in range(3):
            # By rows of the symmetric P: 12 sums at once.
            for i in range(_STATES):
                x[i] += P[3 * k + j, i] * y[k, j]
    for i in range(_STATES):
        new_mean[i] = x[i]


@gufunc("(p),(p,p),(m,n),(m,d),(n,d),(m,w)->(p)")
def update_mean(
    mean: Any, P: Any, ranges: Any, anchors: Any, tags: Any, weights: Any, new_mean: Any
) -> None:
    """Compute ``x + P y``, the posterior mean, with the posterior covariance P."""
    _take_mean(mean, P, ranges, anchors, tags, weights, new_mean)


@gufunc("(t,p),(p,p),(t,m,n),(m,d),(n,d),(m,w)->(t,p)")
def update_means(
    means: Any, P: Any, ranges: Any, anchors: Any, tags: Any, weights: Any, new_means: Any
) -> None:
    """Compute `update_mean` of many trials with one P, whose y is linear in x and ``r^2``.

    NaN for trials with a range that is not positive. ``y = y_0 - G x + sum_n c_e kron sum_m
    W_mn r_mn^2``, with ``W = -2 w (a_m - a)``. Positions are relative to an anchor: large
    coordinates would cost digits.
    """
    n_anchors, n_tags = anchors.shape[0], tags.shape[0]
    G, gain = zeros((_STATES, _STATES)), workspace((_STATES, _STATES))
    _add_information(G, anchors, tags, weights)
    for i in range(_STATES):
        for j in range(_STATES):
            gain[i, j] = P[i, j]
            if j < i:
                G[j, i] = G[i, j]
    W, origin = np.empty((n_tags * n_anchors, 3)), zeros((_STATES,))
    y_0, y, x = zeros((_STATES,)), workspace((_STATES,)), workspace((_STATES,))
    for i in range(3):
        origin[9 + i] = anchors[0, i]
    for n in range(n_tags):
        column = n if weights.shape[1] > 1 else 0
        x0, x1, x2 = _weighted_mean(anchors, weights, column)
        for m in range(n_anchors):
            w, row = -2 * weights[m, column], n * n_anchors + m
            W[row, 0] = w * (anchors[m, 0] - x0)
            W[row, 1] = w * (anchors[m, 1] - x1)
            W[row, 2] = w * (anchors[m, 2] - x2)
            square = 0.0
            for i in range(3):
                square += (anchors[m, i] - origin[9 + i]) ** 2
            for k in range(4):
                c = tags[n, k] if k < 3 else 1.0
                for i in range(3):
                    y_0[3 * k + i] -= c * square * W[row, i]
    for t in range(means.shape[0]):
        for i in range(_STATES):
            y[i] = y_0[i]
            x[i] = means[t, i]
        for j in range(_STATES):
            value = x[j] - origin[j]
            for i in range(_STATES):
                y[i] -= value * G[j, i]
        sound = True
        for n in range(n_tags):
            b0 = b1 = b2 = 0.0
            for m in range(n_anchors):
                r, row = ranges[t, m, n], n * n_anchors + m
                sound = sound and 0.0 < r < HUGE
                square = r * r
                b0 += square * W[row, 0]
                b1 += square * W[row, 1]
                b2 += square * W[row, 2]
            for k in range(4):
                c = tags[n, k] if k < 3 else 1.0
                y[3 * k] += c * b0
                y[3 * k + 1] += c * b1
                y[3 * k + 2] += c * b2
        for j in range(_STATES):
            for i in range(_STATES):
                x[i] += y[j] * gain[j, i]
        for i in range(_STATES):
            new_means[t, i] = x[i] if sound else math.nan


@helper
def _weigh(ranges: Any, law: Any, weights: Any) -> bool:
    """Compute inverse variances of the squared ranges; return whether all ranges are positive.

    `weights` has shape (M, N), or (M, 1) for a law with a reference tag.
    """
    sound, reference = True, int(law[3])
    for m in range(ranges.shape[0]):
        for n in range(ranges.shape[1]):
            sound = sound and 0.0 < ranges[m, n] < HUGE
        for n in range(weights.shape[1]):
            square = ranges[m, n if reference < 0 else reference] ** 2
            if law[0] == 1:
                weights[m, n] = 1 / (law[1] * law[1] * square)
            else:
                variance = law[1] * law[1] + law[2] * law[2] * square
                weights[m, n] = 1 / (4 * square * variance)
            sound = sound and 0.0 < weights[m, n] < math.inf
    return sound


@helper
def _says_nothing(P: Any, anchors: Any, vague_entry: float) -> bool:
    rotation = place = extent = 0.0
    for i in range(9):
        rotation = max(rotation, P[i, i])
    for i in range(3):
        place = max(place, P[9 + i, 9 + i])
        low = high = anchors[0, i]
        for m in range(anchors.shape[0]):
            low, high = min(low, anchors[m, i]), max(high, anchors[m, i])
        extent = max(extent, high - low)
    return rotation > vague_entry or place > extent * extent


@gufunc("(p),(p,p),(m,n),(l),(m,d),(n,d),()->(p),(p,p)")
def update(
    mean: Any, P: Any, ranges: Any, law: Any, anchors: Any, tags: Any, vague_entry: float,
    new_mean: Any, new_P: Any,
) -> None:  # fmt: skip
    """Compute mean and covariance after an epoch without lost links, from the law's numbers.

    NaN if a range is not positive or the prior has no information.
    """
    weights = np.empty((ranges.shape[0], ranges.shape[1] if law[3] < 0 else 1))
    if _weigh(ranges, law, weights) and not _says_nothing(P, anchors, vague_entry):
        _take_covariance(P, anchors, tags, weights, new_P)
        _take_mean(mean, new_P, ranges, anchors, tags, weights, new_mean)
        return
    fill(math.nan, new_P)
    for i in range(_STATES):
        new_mean[i] = math.nan


@gufunc("(p,p),(m,n),(l),(m,d),()->(m,n)")
def weigh(
    P: Any, ranges: Any, law: Any, anchors: Any, vague_entry: float, weights: Any
) -> None:  # fmt: skip
    """Compute inverse variances of the squared ranges; NaN in the cases of `update`."""
    if not _weigh(ranges, law, weights) or _says_nothing(P, anchors, vague_entry):
        fill(math.nan, weights)


@gufunc("(m,n),(m,d),(n,d),(m,w),(p)->(p),(p,p)")
def compress(ranges: Any, anchors: Any, tags: Any, weights: Any, like: Any, z: Any, H: Any) -> None:
    """Compute twelve measurements z with unit noise, and their H, equivalent to an epoch.

    ``H^T H`` is the information and ``H^T z`` its vector, where H is the transposed Cholesky
    factor. `like` (12,) only defines the shapes of the results.
    """
    L, information = workspace((_STATES, _STATES)), zeros((_STATES, _STATES))
    y = workspace((4, 3))
    _add_information(information, anchors, tags, weights)
    factor_semidefinite(information, L)
    innovation(zeros((_STATES,)), ranges, anchors, tags, weights, tags, y)
    for i in range(_STATES):
        total = y[i // 3, i % 3]
        for k in range(i):
            total -= L[i, k] * z[k]
        z[i] = total / L[i, i] if L[i, i] > 0 else 0.0
        for j in range(_STATES):
            H[i, j] = L[j, i]


@gufunc("(p,p),(m,d),()->()", "fffb")
def is_vague(P: Any, anchors: Any, vague_entry: float, vague: Any) -> None:
    """Return whether a covariance is uninformative: of an entry of Q, or beyond the extent."""
    vague[0] = _says_nothing(P, anchors, vague_entry)
