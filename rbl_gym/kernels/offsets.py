"""Ranges with an unknown offset in common, one body: what they tell, and their cost.

The textbook forms are `rbl_gym.measurements.offsets` in `rbl_gym.bounds.pose` and in
`rbl_gym.estimators.costs.range_cost`. Kinds of offset: 1 by tag, 2 by anchor, 3 of the epoch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.kernels.epoch import tag_position
from rbl_gym.kernels.jit import gufunc, helper
from rbl_gym.kernels.noise_laws import reference_of, weight


@helper
def group_of(m: int, n: int, offset: int) -> int:
    """Which offset a link has."""
    if offset == 1:
        return n
    return m if offset == 2 else 0


@helper
def derivative(translation: Any, x: float, y: float, z: float, anchor: Any, J: Any) -> float:
    """Distance of a tag at (x, y, z) from an anchor; its derivative by the pose error into J."""
    dx, dy, dz = x - anchor[0], y - anchor[1], z - anchor[2]
    # Where both coincide the difference is zero, and so are all the terms.
    distance = math.sqrt(max(dx * dx + dy * dy + dz * dz, 1e-200))
    dx, dy, dz = dx / distance, dy / distance, dz / distance
    x, y, z = x - translation[0], y - translation[1], z - translation[2]
    J[0], J[1], J[2] = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    J[3], J[4], J[5] = dx, dy, dz
    return distance


@helper
def add_centred(Q: Any, t: Any, anchors: Any, tags: Any, weights: Any, offset: int, H: Any) -> None:
    """Add the information of ranges of known weights (M, N) to the lower half of H (6, 6).

    That is ``sum w (J - h / s) (J - h / s)^T``, ``h = sum w J`` and ``s = sum w`` of a group.
    """
    groups = max(anchors.shape[0], tags.shape[0])
    mean, total, J = np.zeros((groups, 6)), np.zeros(groups), np.empty(6)
    for again in range(2):
        for n in range(tags.shape[0]):
            x, y, z = tag_position(Q, t, tags, n)
            for m in range(anchors.shape[0]):
                w = weights[m, n]
                if w == 0.0:
                    continue
                derivative(t, x, y, z, anchors[m], J)
                g = group_of(m, n, offset)
                if again:
                    for i in range(6):
                        J[i] -= mean[g, i] / total[g]
                    for i in range(6):
                        for j in range(i + 1):
                            H[i, j] += w * J[i] * J[j]
                else:
                    total[g] += w
                    for i in range(6):
                        mean[g, i] += w * J[i]


@gufunc("(p,p),(m,d),(n,d),(d,d),(d),(l),(m,n),()->(p,p)", "fffffffif")
def information(
    prior, anchors, tags, rotation, translation, law, share, offset, told
):  # fmt: skip
    """A prior's information and that of ranges with offsets, of which each link has a share."""
    weights = np.empty(share.shape)
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
    add_centred(rotation, translation, anchors, tags, weights, offset, told)
    for i in range(6):
        for j in range(i + 1):
            told[j, i] = told[i, j]
    for i in range(6):
        for j in range(6):
            told[i, j] += prior[i, j]
