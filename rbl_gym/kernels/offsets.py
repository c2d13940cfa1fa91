"""Ranges with a common unknown offset, for one body: their information and cost.

The textbook forms are `rbl_gym.measurements.offsets` in `rbl_gym.bounds.information` and in
`estimators/costs/range_cost.py`. Kinds of offset: 1 per tag, 2 per anchor, 3 per epoch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.epoch import tag_position
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.noise_laws import reference_of, weight
from rbl_gym.kernels.range_cost import is_plain, loss_of, squared_residuals
from rbl_gym.kernels.workspace import workspace, zeros

# Steps to the best offset for a loss other than squares.
STEPS = 20


@helper
def group_of(m: int, n: int, offset: int) -> int:
    """Return the index of a link's offset."""
    if offset == 1:
        return n
    return m if offset == 2 else 0


@helper
def derivative(translation: Any, x: float, y: float, z: float, anchor: Any, J: Any) -> float:
    """Return the distance of a tag at (x, y, z) from an anchor; write its pose derivative to J."""
    dx, dy, dz = x - anchor[0], y - anchor[1], z - anchor[2]
    # If both coincide the difference is zero, and so are all terms.
    distance = math.sqrt(max(dx * dx + dy * dy + dz * dz, 1e-200))
    dx, dy, dz = dx / distance, dy / distance, dz / distance
    x, y, z = x - translation[0], y - translation[1], z - translation[2]
    J[0], J[1], J[2] = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    J[3], J[4], J[5] = dx, dy, dz
    return distance


@helper
def add_centred(
    Q: Any, t: Any, anchors: Any, tags: Any, weights: Any, residuals: Any, offset: int, g: Any,
    H: Any,
) -> None:  # fmt: skip
    """Add gradient and information of ranges with known weights and residuals (M, N).

    With ``C = J - h / s``, ``h = sum w J`` and ``s = sum w`` of a group, the information is ``sum w
    C C^T``. Its lower half is added to H (6, 6). The gradient is ``sum w x C``.
    """
    groups = max(anchors.shape[0], tags.shape[0])
    mean, total, J = np.zeros((groups, 6)), np.zeros(groups), workspace((6,))
    for again in range(2):
        for n in range(tags.shape[0]):
            x, y, z = tag_position(Q, t, tags, n)
            for m in range(anchors.shape[0]):
                w = weights[m, n]
                if w == 0.0:
                    continue
                derivative(t, x, y, z, anchors[m], J)
                k = group_of(m, n, offset)
                if again:
                    for i in range(6):
                        J[i] -= mean[k, i] / total[k]
                    for i in range(6):
                        g[i] += w * residuals[m, n] * J[i]
                        for j in range(i + 1):
                            H[i, j] += w * J[i] * J[j]
                else:
                    total[k] += w
                    for i in range(6):
                        mean[k, i] += w * J[i]


@helper
def medians(residuals: Any, weights: Any, offset: int, found: Any) -> None:
    """Compute the median of each group's residuals, the lower one of two; 0 if empty."""
    sorted_, count = np.empty(residuals.size), 0
    for k in range(len(found)):
        count = 0
        for m in range(residuals.shape[0]):
            for n in range(residuals.shape[1]):
                if weights[m, n] > 0 and group_of(m, n, offset) == k:
                    place = count
                    while place > 0 and sorted_[place - 1] > residuals[m, n]:
                        sorted_[place] = sorted_[place - 1]
                        place -= 1
                    sorted_[place] = residuals[m, n]
                    count += 1
        found[k] = sorted_[(count - 1) // 2] if count > 0 else 0.0


@helper
def take_out(
    Q: Any, t: Any, ranges: Any, weights: Any, anchors: Any, tags: Any, loss: Any, offset: int,
    shifted: Any,
) -> None:  # fmt: skip
    """Subtract the most likely offsets at a pose from the ranges: `shifted` (M, N)."""
    groups = max(anchors.shape[0], tags.shape[0])
    found, mean, total = np.zeros(groups), np.empty(groups), np.empty(groups)
    residuals = np.zeros(ranges.shape)
    for n in range(tags.shape[0]):
        x, y, z = tag_position(Q, t, tags, n)
        for m in range(anchors.shape[0]):
            if weights[m, n] > 0:
                dx, dy, dz = x - anchors[m, 0], y - anchors[m, 1], z - anchors[m, 2]
                residuals[m, n] = math.sqrt(dx * dx + dy * dy + dz * dz) - ranges[m, n]
    plain = is_plain(loss)
    if not plain:
        medians(residuals, weights, offset, found)
    for _ in range(1 if plain else STEPS):
        for k in range(groups):
            mean[k] = total[k] = 0.0
        for m in range(ranges.shape[0]):
            for n in range(ranges.shape[1]):
                w = weights[m, n]
                if w > 0:
                    k = group_of(m, n, offset)
                    if not plain:
                        left = residuals[m, n] - found[k]
                        w *= loss_of(w * left * left, left < 0, loss)[1]
                    mean[k] += w * residuals[m, n]
                    total[k] += w
        for k in range(groups):
            if total[k] > 0:
                found[k] = mean[k] / total[k]
    for m in range(ranges.shape[0]):
        for n in range(ranges.shape[1]):
            shifted[m, n] = ranges[m, n] + found[group_of(m, n, offset)]


@helper
def linearize_shifted(
    Q: Any, t: Any, ranges: Any, weights: Any, anchors: Any, tags: Any, loss: Any, offset: int,
    g: Any, H: Any,
) -> float:  # fmt: skip
    """Compute `range_cost.linearize` of ranges with offsets."""
    shifted, left = np.empty(ranges.shape), np.zeros(ranges.shape)
    take_out(Q, t, ranges, weights, anchors, tags, loss, offset, shifted)
    plain, cost = is_plain(loss), 0.0
    for i in range(6):
        g[i] = 0.0
        for j in range(i + 1):
            H[i, j] = 0.0
    for n in range(tags.shape[0]):
        x, y, z = tag_position(Q, t, tags, n)
        for m in range(anchors.shape[0]):
            w = weights[m, n]
            if w > 0:
                dx, dy, dz = x - anchors[m, 0], y - anchors[m, 1], z - anchors[m, 2]
                residual = math.sqrt(dx * dx + dy * dy + dz * dz) - shifted[m, n]
                part, share = 0.5 * w * residual * residual, 1.0
                if not plain:
                    part, share = loss_of(w * residual * residual, residual < 0, loss)
                cost += part
                shifted[m, n], left[m, n] = residual, w * share
    add_centred(Q, t, anchors, tags, left, shifted, offset, g, H)
    return cost


@helper
def squared_residuals_of(
    Q: Any, t: Any, ranges: Any, weights: Any, anchors: Any, tags: Any, loss: Any, offset: int,
    out: Any,
) -> None:  # fmt: skip
    """Compute squared whitened residuals (M, N), 0 for missing links; `offset` 0: no offsets."""
    if offset == 0:
        squared_residuals(Q, t, ranges, weights, anchors, tags, out)
        return
    shifted = np.empty(ranges.shape)
    take_out(Q, t, ranges, weights, anchors, tags, loss, offset, shifted)
    squared_residuals(Q, t, shifted, weights, anchors, tags, out)


@gufunc("(p,p),(m,d),(n,d),(d,d),(d),(l),(m,n),()->(p,p)", "fffffffif")
def information(
    prior, anchors, tags, rotation, translation, law, share, offset, told
):  # fmt: skip
    """Add the information of ranges with offsets, times each link's fraction, to a prior's."""
    weights, nothing, g = np.empty(share.shape), np.zeros(share.shape), zeros((6,))
    for n in range(tags.shape[0]):
        reference = reference_of(law, n)
        x, y, z = tag_position(rotation, translation, tags, n)
        a, b, c = tag_position(rotation, translation, tags, reference)
        for m in range(anchors.shape[0]):
            p, q, r = anchors[m, 0], anchors[m, 1], anchors[m, 2]
            square = (x - p) ** 2 + (y - q) ** 2 + (z - r) ** 2
            of_reference = (a - p) ** 2 + (b - q) ** 2 + (c - r) ** 2
            weights[m, n] = share[m, n] * weight(law, square, of_reference) * square
    for i in range(6):
        for j in range(6):
            told[i, j] = 0.0
    add_centred(rotation, translation, anchors, tags, weights, nothing, offset, g, told)
    for i in range(6):
        for j in range(i + 1):
            told[j, i] = told[i, j]
    for i in range(6):
        for j in range(6):
            told[i, j] += prior[i, j]
