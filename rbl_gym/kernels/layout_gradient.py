"""The gradient of a layout's score. The textbook form is `rbl_gym.placement.gradient`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.epoch import tag_position
from rbl_gym.kernels.gain import share_and_slope
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.linear_algebra import cholesky6, invert_factored6
from rbl_gym.kernels.noise_laws import reference_of, weight, weight_slopes
from rbl_gym.kernels.pose_bound import add_range_information, tag_square
from rbl_gym.kernels.workspace import workspace


@gufunc("(m,d),(m,d),(p,d,d),(p,d),(p),(p,s,s),(n,d),(l),(g),(p,m,n)->(),(m,d)")
def square_and_gradient(
    anchors: Any, normals: Any, rotation: Any, translation: Any, weights: Any, prior: Any,
    tags: Any, law: Any, gain: Any, share: Any, square: Any, gradient: Any,
) -> None:  # fmt: skip
    """Return the weighted sum of b^2 over poses, and its derivative by the anchor positions.

    With ``K = P (mean_n J_n^T J_n) P`` and ``q = J_n^T d``, a link of weight g reduces b^2 by ``g
    q^T K q``. The derivative by the anchor includes those of g and of ``d = s_n - a_m``.
    """
    n_anchors, n_tags = anchors.shape[0], tags.shape[0]
    work, K = workspace((3, 6, 6)), workspace((6, 6))
    information, L, P = work[0], work[1], work[2]
    # The gain of each link at a pose and its derivative, and its information with the gain.
    gains, shares = np.empty((n_tags, n_anchors, 4)), np.empty((n_anchors, n_tags))
    limited = gain[0] < math.inf or gain[2] > -2
    total = x = y = z = 0.0
    for m in range(n_anchors):
        for i in range(3):
            gradient[m, i] = 0.0
    for k in range(rotation.shape[0]):
        Q, t = rotation[k], translation[k]
        for n in range(n_tags):
            if limited:
                x, y, z = tag_position(Q, t, tags, n)
            for m in range(n_anchors):
                shares[m, n] = share[k, m, n]
                if limited:
                    d0, d1, d2 = x - anchors[m, 0], y - anchors[m, 1], z - anchors[m, 2]
                    told, a, b, c = share_and_slope(
                        gain, d0, d1, d2, normals[m, 0], normals[m, 1], normals[m, 2]
                    )
                    shares[m, n] *= told
                    gains[n, m, 0], gains[n, m, 1] = told, a
                    gains[n, m, 2], gains[n, m, 3] = b, c
        for i in range(6):
            for j in range(6):
                information[i, j] = prior[k, i, j]
        add_range_information(information, anchors, tags, Q, t, law, shares)
        if not cholesky6(information, L):
            total = math.nan
            break
        invert_factored6(L, P)
        total += weights[k] * tag_square(P, Q, tags)
        _spread(P, Q, tags, work, K)
        for n in range(n_tags):
            x, y, z = tag_position(Q, t, tags, n)
            u, v, w = x - t[0], y - t[1], z - t[2]
            reference = reference_of(law, n)
            a, b, c = x, y, z
            if reference != n:
                a, b, c = tag_position(Q, t, tags, reference)
            for m in range(n_anchors):
                d0, d1, d2 = x - anchors[m, 0], y - anchors[m, 1], z - anchors[m, 2]
                r0, r1, r2 = a - anchors[m, 0], b - anchors[m, 1], c - anchors[m, 2]
                s, of_reference = d0 * d0 + d1 * d1 + d2 * d2, r0 * r0 + r1 * r1 + r2 * r2
                if not s > 0 or share[k, m, n] == 0:
                    continue
                full = 2 * weights[k] * weight(law, s, of_reference)
                alpha, beta = weight_slopes(law, s, of_reference)
                # q = (c x d, d), y = K q, and J y = y_w x c + y_v.
                q0, q1, q2 = v * d2 - w * d1, w * d0 - u * d2, u * d1 - v * d0
                y0, y1, y2, y3, y4, y5 = _times(K, q0, q1, q2, d0, d1, d2)
                told = q0 * y0 + q1 * y1 + q2 * y2 + d0 * y3 + d1 * y4 + d2 * y5
                f = full * shares[m, n]
                gradient[m, 0] += f * (y1 * w - y2 * v + y3 - told * (alpha * d0 + beta * r0))
                gradient[m, 1] += f * (y2 * u - y0 * w + y4 - told * (alpha * d1 + beta * r1))
                gradient[m, 2] += f * (y0 * v - y1 * u + y5 - told * (alpha * d2 + beta * r2))
                if limited:
                    f = 0.5 * full * share[k, m, n] * told
                    gradient[m, 0] += f * gains[n, m, 1]
                    gradient[m, 1] += f * gains[n, m, 2]
                    gradient[m, 2] += f * gains[n, m, 3]
    square[0] = total


@helper
def _spread(P: Any, rotation: Any, tags: Any, work: Any, K: Any) -> None:
    """Compute ``K = P (mean_n J_n^T J_n) P``; the first two of `work` are workspace."""
    C, product = work[0], work[1]
    for i in range(6):
        for j in range(6):
            C[i, j] = 0.0
    for n in range(tags.shape[0]):
        a, b, c = tags[n, 0], tags[n, 1], tags[n, 2]
        x = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
        y = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
        z = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
        C[0, 0] += y * y + z * z
        C[1, 1] += x * x + z * z
        C[2, 2] += x * x + y * y
        C[0, 1] -= x * y
        C[0, 2] -= x * z
        C[1, 2] -= y * z
        # [c]x, the upper right block.
        C[0, 4] -= z
        C[0, 5] += y
        C[1, 3] += z
        C[1, 5] -= x
        C[2, 3] -= y
        C[2, 4] += x
    for i in range(3):
        C[3 + i, 3 + i] = float(tags.shape[0])
    for i in range(6):
        for j in range(i):
            C[i, j] = C[j, i]
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += P[i, k] * C[k, j]
            product[i, j] = total / tags.shape[0]
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += product[i, k] * P[k, j]
            K[i, j] = total


@helper
def _times(
    K: Any, a: float, b: float, c: float, d: float, e: float, f: float
) -> tuple[float, float, float, float, float, float]:
    return (
        K[0, 0] * a + K[0, 1] * b + K[0, 2] * c + K[0, 3] * d + K[0, 4] * e + K[0, 5] * f,
        K[1, 0] * a + K[1, 1] * b + K[1, 2] * c + K[1, 3] * d + K[1, 4] * e + K[1, 5] * f,
        K[2, 0] * a + K[2, 1] * b + K[2, 2] * c + K[2, 3] * d + K[2, 4] * e + K[2, 5] * f,
        K[3, 0] * a + K[3, 1] * b + K[3, 2] * c + K[3, 3] * d + K[3, 4] * e + K[3, 5] * f,
        K[4, 0] * a + K[4, 1] * b + K[4, 2] * c + K[4, 3] * d + K[4, 4] * e + K[4, 5] * f,
        K[5, 0] * a + K[5, 1] * b + K[5, 2] * c + K[5, 3] * d + K[5, 4] * e + K[5, 5] * f,
    )
