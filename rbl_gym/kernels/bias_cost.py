"""Cost of an epoch whose ranges have biases, and its derivatives.

The textbook form is `estimators/costs/bias_cost.py`.
"""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels import rotations
from rbl_gym.kernels.jit import helper
from rbl_gym.kernels.linear_algebra import cholesky
from rbl_gym.kernels.range_cost import loss_of


@helper
def innovation(
    Q: Any, t: Any, Q0: Any, t0: Any, told: Any, slope: Any, chosen: Any, anchors: Any, tags: Any,
    e: Any, D: Any, nu: Any, H: Any,
) -> None:  # fmt: skip
    """Compute nu (L,), H = -dnu (L, 6) by (w, v), e (6,) and the rotation D (3, 3) of de."""
    for i in range(3):
        e[3 + i] = t[i] - t0[i]
        for j in range(3):
            D[i, j] = Q[i, 0] * Q0[j, 0] + Q[i, 1] * Q0[j, 1] + Q[i, 2] * Q0[j, 2]
    e[0], e[1], e[2] = rotations.log(D)
    rotations.left_jacobian_inverse(e[0], e[1], e[2], D)
    n_tags = tags.shape[0]
    for k in range(nu.shape[0]):
        m, n = chosen[k] // n_tags, chosen[k] % n_tags
        x = Q[0, 0] * tags[n, 0] + Q[0, 1] * tags[n, 1] + Q[0, 2] * tags[n, 2]
        y = Q[1, 0] * tags[n, 0] + Q[1, 1] * tags[n, 1] + Q[1, 2] * tags[n, 2]
        z = Q[2, 0] * tags[n, 0] + Q[2, 1] * tags[n, 1] + Q[2, 2] * tags[n, 2]
        ux, uy, uz = x + t[0] - anchors[m, 0], y + t[1] - anchors[m, 1], z + t[2] - anchors[m, 2]
        # If an anchor coincides with a tag the difference is zero, and so are all terms.
        distance = math.sqrt(max(ux * ux + uy * uy + uz * uz, 1e-200))
        ux, uy, uz = ux / distance, uy / distance, uz / distance
        value = told[k] - distance
        for j in range(6):
            value -= slope[k, j] * e[j]
        nu[k] = value
        for j in range(3):
            H[k, j] = slope[k, 0] * D[0, j] + slope[k, 1] * D[1, j] + slope[k, 2] * D[2, j]
            H[k, 3 + j] = slope[k, 3 + j]
        H[k, 0] += y * uz - z * uy
        H[k, 1] += z * ux - x * uz
        H[k, 2] += x * uy - y * ux
        H[k, 3] += ux
        H[k, 4] += uy
        H[k, 5] += uz


@helper
def whiten(L: Any, nu: Any, H: Any, y: Any, B: Any) -> None:
    """Compute ``y = L^-1 nu`` and ``B = L^-1 H`` for seven right sides at the same time."""
    for k in range(nu.shape[0]):
        r, a, b, c, d, e, f = nu[k], H[k, 0], H[k, 1], H[k, 2], H[k, 3], H[k, 4], H[k, 5]
        for m in range(k):
            factor = L[k, m]
            r -= factor * y[m]
            a -= factor * B[m, 0]
            b -= factor * B[m, 1]
            c -= factor * B[m, 2]
            d -= factor * B[m, 3]
            e -= factor * B[m, 4]
            f -= factor * B[m, 5]
        scale = L[k, k]
        y[k] = r * scale
        B[k, 0], B[k, 1], B[k, 2] = a * scale, b * scale, c * scale
        B[k, 3], B[k, 4], B[k, 5] = d * scale, e * scale, f * scale


@helper
def linearize(e: Any, D: Any, white: Any, B: Any, information: Any, g: Any, A: Any) -> float:
    """Return the cost at a pose; write its gradient and lower half of the Hessian to g and A.

    `white` and B are the whitened innovations and their derivatives.
    """
    cost = 0.0
    for i in range(6):
        pull = 0.0
        for j in range(6):
            pull += information[i, j] * e[j]
        cost += 0.5 * e[i] * pull
        g[i] = pull
    x, y, z = g[0], g[1], g[2]
    for i in range(3):
        g[i] = D[0, i] * x + D[1, i] * y + D[2, i] * z
    for i in range(6):
        for j in range(i + 1):
            # D^T I D, where D is blkdiag(D, I).
            total = 0.0
            if i < 3:
                for a in range(3):
                    for b in range(3):
                        total += D[a, i] * information[a, b] * D[b, j]
            elif j < 3:
                for b in range(3):
                    total += information[i, b] * D[b, j]
            else:
                total = information[i, j]
            A[i, j] = total
    for k in range(white.shape[0]):
        cost += 0.5 * white[k] * white[k]
        for i in range(6):
            g[i] -= B[k, i] * white[k]
            for j in range(i + 1):
                A[i, j] += B[k, i] * B[k, j]
    return cost


@helper
def weigh(own: Any, variance: Any, share: Any, L: Any) -> bool:
    """Factor ``L L^T = own + R`` with variances R of the links, divided by their shares."""
    for i in range(own.shape[0]):
        for j in range(i + 1):
            L[i, j] = own[i, j]
        L[i, i] = (own[i, i] + variance[i]) / share[i]
    return cholesky(L, L)


@helper
def shares(nu: Any, H: Any, own: Any, variance: Any, P: Any, loss: Any, share: Any) -> float:
    """Compute weights of the innovations at a pose of covariance P; return their largest change."""
    most = 0.0
    for k in range(nu.shape[0]):
        expected = own[k, k] + variance[k]
        for i in range(6):
            for j in range(6):
                expected += H[k, i] * P[i, j] * H[k, j]
        left = loss_of(nu[k] * nu[k] / expected, nu[k] > 0, loss)[1]
        most = max(most, abs(left - share[k]))
        share[k] = left
    return most
