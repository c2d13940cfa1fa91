"""The cost of one body's ranges at a pose, its gradient and Gauss-Newton Hessian.

The textbook form is `estimators/costs/range_cost.py`. Matrices are written only on and below the
diagonal. A link of weight 0 was not measured, and its range may have any value.
"""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.constants import CUTOFF, OF_LATE, POWER, SCALE, THRESHOLD
from rbl_gym.kernels.jit import helper, inlined


@inlined
def loss_of(squared: float, late: bool, loss: Any) -> tuple[float, float]:
    """Return the cost of a squared whitened residual, and the remaining fraction of its weight.

    `loss` is (threshold, cutoff, scale, power, late): Huber's loss up to a cutoff, or that of Geman
    and McClure if the scale is finite, or the redescending one if the power is 2. A late range,
    which is longer than expected, has its own fraction of all that.
    """
    threshold, cutoff, scale = loss[THRESHOLD], loss[CUTOFF], loss[SCALE]
    if scale < math.inf:
        square = scale * scale
        share = square / (squared + square)
        return 0.5 * squared * share, share * share
    inside = squared <= cutoff * cutoff
    if not inside:
        squared = cutoff * cutoff
    share = 1.0
    if squared > threshold * threshold:
        share = threshold / math.sqrt(squared)
    cost = share * squared * (1 - 0.5 * share)
    if loss[POWER] == 2.0:
        if share < 1:
            cost = threshold * threshold * (0.5 - math.log(share))
        share *= share
        if late:
            cost *= loss[OF_LATE]
            share *= loss[OF_LATE]
    return cost, share if inside else 0.0


@inlined
def set_huber(loss: Any, threshold: float) -> None:
    """Write Huber's loss to `loss`; half the square if the threshold is infinite."""
    loss[THRESHOLD] = threshold
    loss[CUTOFF] = loss[SCALE] = math.inf
    loss[POWER] = loss[OF_LATE] = 1.0


@inlined
def is_plain(loss: Any) -> bool:
    """Return whether a loss is half the square."""
    return loss[THRESHOLD] == math.inf and loss[CUTOFF] == math.inf and loss[SCALE] == math.inf


@inlined
def linearize(
    Q: Any, t: Any, ranges: Any, weights: Any, anchors: Any, tags: Any, loss: Any, g: Any, H: Any
) -> float:
    """Return the cost; write gradient (6,) and Hessian (6, 6) by (w, v) to g and H.

    With unit vectors u from anchors to a tag, ``S = sum_m w u u^T`` is the information about its
    position, and ``f = sum_m w (d - r) u`` the gradient there. ``[[Q c]x; I]`` maps both to the
    pose.
    """
    plain = is_plain(loss)
    cost = 0.0
    for i in range(6):
        g[i] = 0.0
        for j in range(i + 1):
            H[i, j] = 0.0
    for n in range(tags.shape[0]):
        x = Q[0, 0] * tags[n, 0] + Q[0, 1] * tags[n, 1] + Q[0, 2] * tags[n, 2]
        y = Q[1, 0] * tags[n, 0] + Q[1, 1] * tags[n, 1] + Q[1, 2] * tags[n, 2]
        z = Q[2, 0] * tags[n, 0] + Q[2, 1] * tags[n, 1] + Q[2, 2] * tags[n, 2]
        tx, ty, tz = x + t[0], y + t[1], z + t[2]
        fx = fy = fz = sxx = syx = syy = szx = szy = szz = 0.0
        for m in range(anchors.shape[0]):
            weight = weights[m, n]
            if weight == 0.0:
                continue
            ux, uy, uz = tx - anchors[m, 0], ty - anchors[m, 1], tz - anchors[m, 2]
            # If an anchor coincides with a tag the difference is zero, and so are all terms.
            square = max(ux * ux + uy * uy + uz * uz, 1e-200)
            distance = math.sqrt(square)
            residual = distance - ranges[m, n]
            if plain:
                cost += 0.5 * weight * residual * residual
            else:
                part, share = loss_of(weight * residual * residual, residual < 0, loss)
                cost += part
                weight *= share
            # The weight of the difference, which is not a unit vector: one root less to divide by.
            weight /= square
            pull = weight * distance * residual
            fx += pull * ux
            fy += pull * uy
            fz += pull * uz
            wx, wy, wz = weight * ux, weight * uy, weight * uz
            sxx += wx * ux
            syx += wy * ux
            syy += wy * uy
            szx += wz * ux
            szy += wz * uy
            szz += wz * uz
        g[0] += y * fz - z * fy
        g[1] += z * fx - x * fz
        g[2] += x * fy - y * fx
        g[3] += fx
        g[4] += fy
        g[5] += fz
        # [p]x S, whose transpose is the block of translation by rotation.
        axx, axy, axz = y * szx - z * syx, y * szy - z * syy, y * szz - z * szy
        ayx, ayy, ayz = z * sxx - x * szx, z * syx - x * szy, z * szx - x * szz
        azx, azy, azz = x * syx - y * sxx, x * syy - y * syx, x * szy - y * szx
        H[0, 0] += y * axz - z * axy
        H[1, 0] += y * ayz - z * ayy
        H[1, 1] += z * ayx - x * ayz
        H[2, 0] += y * azz - z * azy
        H[2, 1] += z * azx - x * azz
        H[2, 2] += x * azy - y * azx
        H[3, 0] += axx
        H[3, 1] += ayx
        H[3, 2] += azx
        H[4, 0] += axy
        H[4, 1] += ayy
        H[4, 2] += azy
        H[5, 0] += axz
        H[5, 1] += ayz
        H[5, 2] += azz
        H[3, 3] += sxx
        H[4, 3] += syx
        H[4, 4] += syy
        H[5, 3] += szx
        H[5, 4] += szy
        H[5, 5] += szz
    return cost


@helper
def squared_residuals(
    Q: Any, t: Any, ranges: Any, weights: Any, anchors: Any, tags: Any, out: Any
) -> None:
    """Compute squared whitened residuals (M, N), 0 for missing links."""
    for n in range(tags.shape[0]):
        x = Q[0, 0] * tags[n, 0] + Q[0, 1] * tags[n, 1] + Q[0, 2] * tags[n, 2] + t[0]
        y = Q[1, 0] * tags[n, 0] + Q[1, 1] * tags[n, 1] + Q[1, 2] * tags[n, 2] + t[1]
        z = Q[2, 0] * tags[n, 0] + Q[2, 1] * tags[n, 1] + Q[2, 2] * tags[n, 2] + t[2]
        for m in range(anchors.shape[0]):
            out[m, n] = 0.0
            if weights[m, n] > 0:
                dx, dy, dz = x - anchors[m, 0], y - anchors[m, 1], z - anchors[m, 2]
                residual = math.sqrt(dx * dx + dy * dy + dz * dz) - ranges[m, n]
                out[m, n] = weights[m, n] * residual * residual
