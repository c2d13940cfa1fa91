"""Compute weights of ranges, and the Fisher information about the position of each single tag."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.measurements import ranging

__all__ = ["directions"]

# Internal functions without checks: their arguments were checked, or made here.
_DISTANCES = kernel(ranging.distances)


def directions(anchors: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distances (..., M, N) and unit vectors (..., M, N, 3) from anchors to positions.

    The unit vector is zero if an anchor and a position coincide.
    """
    difference = positions[..., None, :, :] - anchors[..., :, None, :]
    distance = np.sqrt(np.einsum("...i,...i->...", difference, difference))
    return distance, difference / np.where(distance > 0, distance, 1.0)[..., None]


def check_variance(noise: ranging.NoiseLaw, distance: FloatArray) -> None:
    """Raise ValueError if a law has zero variance at a nonzero distance (..., M, N)."""
    inverse_variance(noise.variance(distance), distance)


def inverse_variance(variance: FloatArray, distance: FloatArray) -> FloatArray:
    """Return weights (..., M, N) of ranges, squared or not; zero if anchor and tag coincide.

    There the range has no gradient, and the link gives no information.
    """
    with np.errstate(divide="ignore"):
        weight = np.where(distance > 0, 1 / variance, 0.0)
    if not np.isfinite(weight).all():
        where = np.broadcast_to(distance, weight.shape)[~np.isfinite(weight)][0]
        raise ValueError(
            f"noise must have a positive variance at every distance, got 0 at {where:g} m"
        )
    return weight


def raw_tag_information(
    anchors: FloatArray, positions: FloatArray, noise: ranging.NoiseLaw, links: BoolArray | None
) -> FloatArray:
    """Return the information (..., N, 3, 3) of the ranges about the position of each tag."""
    distance, unit = directions(anchors, positions)
    weight = inverse_variance(noise.variance(distance), distance)
    weight = weight if links is None else weight * links
    return np.einsum("...mni,...mnj->...nij", weight[..., None] * unit, unit)


def squared_tag_information(
    anchors: FloatArray, positions: FloatArray, noise: ranging.NoiseLaw, links: BoolArray | None
) -> FloatArray:
    """Return information ``4 A Pi_n A^T`` (..., N, 3, 3) about each tag, |s|^2 projected out."""
    distance = _DISTANCES(anchors, positions)
    weight = inverse_variance(noise.squared_range_variance(distance), distance)
    weight = weight if links is None else weight * links
    spread, weighted = weighted_spread(anchors, weight)
    return 4 * np.swapaxes(weighted, -1, -2) @ spread


def weighted_spread(anchors: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return anchors minus their weighted mean (..., N, M, 3), and this times weights (..., M, N).

    Their product ``A Pi A^T`` is the projection of the common unknown ``|s|^2`` out of the
    squared ranges, without forming Pi.
    """
    per_tag = np.swapaxes(weights, -1, -2)
    total = per_tag.sum(axis=-1, keepdims=True)
    mean = (per_tag / np.where(total > 0, total, 1.0)) @ anchors
    spread = anchors[..., None, :, :] - mean[..., :, None, :]
    return spread, per_tag[..., None] * spread
