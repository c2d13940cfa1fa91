"""Maximum-likelihood pose of one body, with a global search if the first solution is doubtful.

The textbook form is `estimators/locating/maximum_likelihood.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.eigen import eigen
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.linear_algebra import cholesky6, fill, invert_factored6, of_size
from rbl_gym.kernels.pose_solver import copy_pose, mirror, solve
from rbl_gym.kernels.range_cost import set_huber
from rbl_gym.kernels.rotation_fits import nearest_rotation
from rbl_gym.kernels.workspace import workspace, zeros

_cholesky3, _solve3, _invert3 = of_size(3)

# A cost this many standard deviations above its chi-square mean starts a global search.
SUSPICIOUS = 5.0
# So does a rotation with this standard deviation (rad): there may be other minima.
UNCERTAIN_RAD = 0.2
# So do anchors whose spread is this flat, and fewer anchors than this.
FLAT, FEW_ANCHORS = 0.05, 5
# Numbers of rotations at each position, the best of the net, from which a search starts, and of
# approximate minima that it refines.
STARTS, MINIMA = 5, 8
# Poses whose tags are closer than these fractions of the body's size are the same: before
# convergence, and after it.
NEAR, SAME = 2e-2, 1e-3
# Poses with a cost within 3 sigma of the best one are alternatives.
RIVAL_COST = 4.5


@gufunc("(m,n),(m,n),(m,d),(n,d)->(d,d),(d)")
def points_start(ranges, weights, anchors, tags, Q, t):
    """Compute a pose from the squared ranges: each tag separately, then the rotation that fits.

    NaN if fewer than three tags are determined.
    """
    fill(math.nan, Q)
    t[0] = t[1] = t[2] = math.nan
    n_anchors, n_tags = ranges.shape
    places, known = np.empty((n_tags, 3)), np.zeros(n_tags)
    G, L, b, mean = workspace((3, 3)), workspace((3, 3)), workspace((3,)), workspace((3,))
    count = 0
    for n in range(n_tags):
        total, middle = 0.0, 0.0
        mean[0] = mean[1] = mean[2] = 0.0
        for m in range(n_anchors):
            if weights[m, n] > 0:
                w = weights[m, n] / (4 * ranges[m, n] * ranges[m, n])
                total += w
                square = 0.0
                for i in range(3):
                    mean[i] += w * anchors[m, i]
                    square += anchors[m, i] * anchors[m, i]
                middle += w * (ranges[m, n] * ranges[m, n] - square)
        if total == 0.0:
            continue
        middle /= total
        for i in range(3):
            mean[i] /= total
        fill(0.0, G)
        b[0] = b[1] = b[2] = 0.0
        for m in range(n_anchors):
            if weights[m, n] > 0:
                w = weights[m, n] / (4 * ranges[m, n] * ranges[m, n])
                square = 0.0
                for i in range(3):
                    square += anchors[m, i] * anchors[m, i]
                d = ranges[m, n] * ranges[m, n] - square - middle
                for i in range(3):
                    across = w * (anchors[m, i] - mean[i])
                    b[i] -= 2 * across * d
                    for j in range(i + 1):
                        G[i, j] += 4 * across * (anchors[m, j] - mean[j])
        good = _cholesky3(G, L)
        for i in range(3):
            # A pivot this small relative to its diagonal entry, or that to the others, means rank
            # below 3.
            good = good and L[i, i] * L[i, i] * G[i, i] < 1e11
            good = good and G[i, i] > 1e-22 * (G[0, 0] + G[1, 1] + G[2, 2])
        if good:
            _solve3(L, b, places[n])
            known[n] = 1.0
            count += 1
    if count < 3:
        return
    centre, middle_of_tags, M = zeros((3,)), zeros((3,)), zeros((3, 3))
    for n in range(n_tags):
        if known[n] > 0:
            for i in range(3):
                centre[i] += places[n, i] / count
                middle_of_tags[i] += tags[n, i] / count
    for n in range(n_tags):
        if known[n] > 0:
            for i in range(3):
                for j in range(3):
                    M[i, j] += (places[n, i] - centre[i]) * (tags[n, j] - middle_of_tags[j])
    nearest_rotation(M, Q)
    for i in range(3):
        t[i] = centre[i]
        for j in range(3):
            t[i] -= Q[i, j] * middle_of_tags[j]


@helper
def in_doubt(H: Any, cost: float, weights: Any, anchors: Any) -> bool:
    """Return whether a solution may not be global: poor geometry, or a high cost."""
    n_anchors = anchors.shape[0]
    if n_anchors < FEW_ANCHORS:
        return True
    links = 0
    for m in range(n_anchors):
        for n in range(weights.shape[1]):
            links += weights[m, n] > 0
    free = max(links - 6, 1)
    if 2 * cost - (links - 6) > SUSPICIOUS * math.sqrt(2 * free):
        return True
    S, V = zeros((3, 3)), workspace((3, 3))
    mean = zeros((3,))
    for m in range(n_anchors):
        for i in range(3):
            mean[i] += anchors[m, i] / n_anchors
    for m in range(n_anchors):
        for i in range(3):
            for j in range(3):
                S[i, j] += (anchors[m, i] - mean[i]) * (anchors[m, j] - mean[j])
    eigen(S, V)
    least, most = min(S[0, 0], S[1, 1], S[2, 2]), max(S[0, 0], S[1, 1], S[2, 2])
    if least < FLAT * FLAT * most:
        return True
    L, P = workspace((6, 6)), workspace((6, 6))
    if not cholesky6(H, L):
        return True
    invert_factored6(L, P)
    return P[0, 0] + P[1, 1] + P[2, 2] > UNCERTAIN_RAD * UNCERTAIN_RAD


@helper
def candidate_places(ranges: Any, weights: Any, anchors: Any, places: Any) -> None:
    """Compute positions (3, 3) of the tags' centre: linear, and on both sides of a plane.

    They follow from the mean squared range of every anchor. The plane is that of the anchors with
    the smallest spread across it, where the linear solution is poor or undefined.
    """
    n_anchors, n_tags = ranges.shape
    squared, d = np.zeros(n_anchors), np.empty(n_anchors)
    S, V, mean = zeros((3, 3)), workspace((3, 3)), zeros((3,))
    seen = 0
    for m in range(n_anchors):
        count = 0
        for n in range(n_tags):
            if weights[m, n] > 0:
                count += 1
                squared[m] += ranges[m, n] * ranges[m, n]
        if count:
            squared[m] /= count
            seen += 1
            for i in range(3):
                mean[i] += anchors[m, i]
        else:
            squared[m] = -1.0
    for i in range(3):
        mean[i] /= max(seen, 1)
    middle = 0.0
    for m in range(n_anchors):
        d[m] = squared[m]
        for i in range(3):
            d[m] -= (anchors[m, i] - mean[i]) ** 2
        if squared[m] >= 0:
            middle += d[m] / seen
    pull = zeros((3,))
    for m in range(n_anchors):
        if squared[m] >= 0:
            for i in range(3):
                pull[i] -= 0.5 * (anchors[m, i] - mean[i]) * (d[m] - middle)
                for j in range(3):
                    S[i, j] += (anchors[m, i] - mean[i]) * (anchors[m, j] - mean[j])
    eigen(S, V)
    low, most = 0, 0.0
    for i in range(3):
        if S[i, i] < S[low, low]:
            low = i
        most = max(most, S[i, i])
    for k in range(3):
        for i in range(3):
            places[k, i] = mean[i]
    for j in range(3):
        if S[j, j] > 1e-9 * most:
            along = (V[0, j] * pull[0] + V[1, j] * pull[1] + V[2, j] * pull[2]) / S[j, j]
            for i in range(3):
                places[0, i] += V[i, j] * along
                if j != low:
                    places[1, i] += V[i, j] * along
    # The rest of the squared ranges in the plane is the squared height above it.
    height = 0.0
    for m in range(n_anchors):
        if squared[m] >= 0:
            height += squared[m] / seen
            for i in range(3):
                height -= (anchors[m, i] - places[1, i]) ** 2 / seen
    height = math.sqrt(max(height, 0.0))
    # The order of the sides must not depend on the sign of an eigenvector.
    largest = 0
    for i in range(1, 3):
        if abs(V[i, low]) > abs(V[largest, low]):
            largest = i
    if V[largest, low] < 0:
        height = -height
    for i in range(3):
        places[2, i] = places[1, i] - V[i, low] * height
        places[1, i] += V[i, low] * height


@helper
def cost_at(Q: Any, t: Any, ranges: Any, weights: Any, anchors: Any, tags: Any) -> float:
    """Return half the sum of squared whitened residuals."""
    total = 0.0
    for n in range(tags.shape[0]):
        x = Q[0, 0] * tags[n, 0] + Q[0, 1] * tags[n, 1] + Q[0, 2] * tags[n, 2] + t[0]
        y = Q[1, 0] * tags[n, 0] + Q[1, 1] * tags[n, 1] + Q[1, 2] * tags[n, 2] + t[1]
        z = Q[2, 0] * tags[n, 0] + Q[2, 1] * tags[n, 1] + Q[2, 2] * tags[n, 2] + t[2]
        for m in range(anchors.shape[0]):
            if weights[m, n] > 0:
                dx, dy, dz = x - anchors[m, 0], y - anchors[m, 1], z - anchors[m, 2]
                residual = math.sqrt(dx * dx + dy * dy + dz * dz) - ranges[m, n]
                total += 0.5 * weights[m, n] * residual * residual
    return total


@helper
def order_of(costs: Any, order: Any) -> None:
    """Compute indices of the smallest costs, best first, stable, as many as the output holds."""
    taken = np.zeros(len(costs), np.bool_)
    for k in range(len(order)):
        best = -1
        for i in range(len(costs)):
            # NaN comes last.
            if not taken[i] and (best < 0 or costs[i] < costs[best] or costs[best] != costs[best]):
                best = i
        taken[best] = True
        order[k] = best


@helper
def distance_of_tags(Q: Any, t: Any, R: Any, s: Any, tags: Any) -> float:
    """Return the largest squared distance of a tag between two poses."""
    longest = 0.0
    for n in range(tags.shape[0]):
        total = 0.0
        for i in range(3):
            gap = t[i] - s[i]
            for j in range(3):
                gap += (Q[i, j] - R[i, j]) * tags[n, j]
            total += gap * gap
        longest = max(longest, total)
    return longest


@helper
def body_size(tags: Any, centre: Any) -> float:
    """Return the largest squared distance from the tags' centre to a tag."""
    longest = 0.0
    for n in range(tags.shape[0]):
        total = 0.0
        for i in range(3):
            total += (tags[n, i] - centre[i]) ** 2
        longest = max(longest, total)
    return max(longest, 1e-24)


@helper
def starts(
    ranges: Any, weights: Any, anchors: Any, tags: Any, net: Any, centre: Any, Qs: Any, ts: Any
) -> None:
    """Compute the best rotations of the net at three positions, as poses (3 STARTS, ...)."""
    places, cost, order = workspace((3, 3)), np.empty(len(net)), np.empty(STARTS, np.int64)
    candidate_places(ranges, weights, anchors, places)
    t = np.empty((len(net), 3))
    for p in range(3):
        for k in range(len(net)):
            for i in range(3):
                t[k, i] = places[p, i]
                for j in range(3):
                    t[k, i] -= net[k, i, j] * centre[j]
            cost[k] = cost_at(net[k], t[k], ranges, weights, anchors, tags)
        order_of(cost, order)
        for s in range(STARTS):
            copy_pose(net[order[s]], t[order[s]], Qs[p * STARTS + s], ts[p * STARTS + s])


@helper
def search(
    ranges: Any, weights: Any, anchors: Any, tags: Any, net: Any, has_first: bool,
    Q: Any, t: Any, other_Q: Any, other_t: Any, other_cost: Any, loss: Any, g: Any, H: Any,
) -> tuple[float, bool]:  # fmt: skip
    """Find the best of many local solutions and alternatives; `has_first`: (Q, t) is a solution."""
    centre = zeros((3,))
    for n in range(tags.shape[0]):
        for i in range(3):
            centre[i] += tags[n, i] / tags.shape[0]
    size = body_size(tags, centre)
    count = 3 * STARTS + 1
    Qs, ts, costs = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty(count)
    good, counted = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    starts(ranges, weights, anchors, tags, net, centre, Qs, ts)
    copy_pose(Q, t, Qs[count - 1], ts[count - 1])
    if not has_first:
        count -= 1
    order = np.empty(count, np.int64)
    for stage in range(2):
        # Coarsely from all starts; then completely from the distinct results.
        for s in range(count):
            if stage == 0 or counted[s]:
                costs[s], good[s] = solve(
                    Qs[s], ts[s], False, Q, t, H, ranges, weights, anchors, tags, loss, 0,
                    100 if stage else 10, 1e-4 if stage else 1e-2, g, H,
                )  # fmt: skip
            else:
                costs[s] = math.inf
        order_of(costs[:count], order)
        kept = 0
        for k in range(count):
            s = order[k]
            if stage == 0:
                new = kept < MINIMA
            else:
                # If more minima are as good as the best, keep as many as the output holds.
                new = counted[s] and kept <= len(other_cost)
                new = new and (k == 0 or (good[s] and costs[s] < costs[order[0]] + RIVAL_COST))
            least = (SAME if stage else NEAR) ** 2 * size
            for before in range(k):
                b = order[before]
                new = new and not (
                    counted[b] and distance_of_tags(Qs[s], ts[s], Qs[b], ts[b], tags) <= least
                )
            counted[s] = new
            if new:
                kept += 1
                if stage == 1 and k > 0:
                    copy_pose(Qs[s], ts[s], other_Q[kept - 2], other_t[kept - 2])
                    other_cost[kept - 2] = costs[s]
    copy_pose(Qs[order[0]], ts[order[0]], Q, t)
    # If many poses are nearly as good, the valley of the cost is long.
    return solve(Q, t, False, Q, t, H, ranges, weights, anchors, tags, loss, 0, 100, 1e-6, g, H)


@gufunc(
    "(m,n),(m,n),(m,d),(n,d),(d,d),(d),(s,d,d),(k,p)->(d,d),(d),(),(p),(p,p),(),(k,d,d),(k,d),(k)",
    "fffffffffffffbfff",
)
def most_likely_pose(
    ranges, weights, anchors, tags, start_Q, start_t, net, slots,
    Q, t, cost, g, H, converged, other_Q, other_t, other_cost,
):  # fmt: skip
    """Compute the most likely pose, and others that are about as likely."""
    for k in range(len(slots)):
        other_cost[k] = math.inf
        for i in range(3):
            other_t[k, i] = 0.0
            for j in range(3):
                other_Q[k, i, j] = 1.0 if i == j else 0.0
    loss = workspace((5,))
    set_huber(loss, math.inf)
    usable = True
    for i in range(3):
        usable = usable and math.isfinite(start_t[i])
        for j in range(3):
            usable = usable and math.isfinite(start_Q[i, j])
    copy_pose(start_Q, start_t, Q, t)
    converged[0] = False
    if usable:
        cost[0], converged[0] = solve(
            Q, t, False, Q, t, H, ranges, weights, anchors, tags, loss, 0, 12, 3e-6, g, H
        )
    if not converged[0] or in_doubt(H, cost[0], weights, anchors):
        cost[0], converged[0] = search(
            ranges, weights, anchors, tags, net, usable, Q, t, other_Q, other_t, other_cost,
            loss, g, H,
        )  # fmt: skip
    mirror(H)
