"""Starts of a pose search if the ranges share an unknown offset."""

from __future__ import annotations

import itertools

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.costs.losses import loss_of
from rbl_gym.estimators.costs.map_problem import minimize
from rbl_gym.estimators.costs.range_cost import RangeCost, squared_residuals

# Grid of starts on every axis, in halves of the anchors' extent. Flat anchors get at least this
# fraction of their longest axis as extent.
_GRID = np.array(list(itertools.product((-0.8, 0.0, 0.8), repeat=3)))
_DEPTH = 0.5


def places_of_differences(part: RangeCost, net: FloatArray) -> FloatArray:
    """Return three positions (K, 3, 3) of the tags' centre that agree with range differences.

    They are the ends of short local searches from a grid of positions among the anchors, for trials
    (K, 1, ...). Each starts with the rotation of the net (S, 3, 3) that fits best there.
    """
    anchors, tags = part.anchors[:, 0], part.tags[:, 0]
    middle = anchors.mean(axis=-2, keepdims=True)
    _, axes = np.linalg.eigh(np.swapaxes(anchors - middle, -1, -2) @ (anchors - middle))
    along = (anchors - middle) @ axes
    low, high = along.min(axis=-2), along.max(axis=-2)
    reach = 0.5 * (high - low)
    reach = np.maximum(reach, _DEPTH * reach.max(axis=-1, keepdims=True))
    places = (0.5 * (high + low))[:, None] + _GRID * reach[:, None]
    places = middle + places @ np.swapaxes(axes, -1, -2)
    centre = tags.mean(axis=-2)[:, None, None]
    translation = places[:, :, None] - (net @ centre[..., None])[..., 0]
    rotation = np.broadcast_to(net, (*translation.shape[:-1], 3, 3))
    grid = part.each(lambda array, _: array[:, None])
    cost = loss_of(squared_residuals(grid, rotation, translation), grid.loss)[0].sum(axis=(-2, -1))
    best = np.argmin(cost, axis=-1)[:, :, None]
    found = minimize(
        part,
        np.take_along_axis(rotation, best[..., None, None], axis=2)[:, :, 0],
        np.take_along_axis(translation, best[..., None], axis=2)[:, :, 0],
        iterations=8,
        tolerance=0.1,
    )
    ends = (found.rotation @ centre[:, 0, :, :, None])[..., 0] + found.translation
    return _far_apart(ends, found.at.cost, 0.1 * reach.max(axis=-1))


def _far_apart(places: FloatArray, cost: FloatArray, least: FloatArray) -> FloatArray:
    """Return the best three of positions (K, P, 3), at least `least` (K,) apart if possible."""
    rows, cost = np.arange(len(places)), np.array(cost)
    chosen = []
    for _ in range(3):
        chosen.append(places[rows, np.argmin(cost, axis=-1)])
        gap = np.linalg.norm(places - chosen[-1][:, None], axis=-1)
        # Positions near a chosen one come after all others.
        cost = cost + np.where(gap < least[:, None], 1e30, 0.0)
    return np.stack(chosen, axis=1)
