"""Estimate the poses of all nodes of many small planar networks by joint maximum a posteriori.

This is the dense version of `network_frames`, for batches. Bearings and lengths between n nodes are
(n, n) matrices. Where nothing is measured, a prior applies. The result includes the covariance.

Bearings alone do not determine the distance of a node. In a network that is not rigid, parts could
shrink to a point without changing a bearing. The known limits of every link length prevent this.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.networks.bounds import (
    Sensing,
    across_of,
    free_columns,
    length_information,
    lines_of_sight,
    linked_to_0,
    pose_information,
    prior_information,
)
from rbl_gym.networks.sensing import proj

_MAX_STEPS = 60
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e9
_SETTLED = 1e-8  # radians, and fraction of a link's typical length
_REWEIGHTINGS = 3
_NEAREST = 0.03  # of the typical length
_HINT = 1e-6


class NetworkPoses(NamedTuple):
    """Poses of networks in the frame of node 0 (orientation 0, at the origin)."""

    orientations: FloatArray  # (..., n) radians in [-pi, pi)
    positions: FloatArray  # (..., n, 2) metres
    covariance: FloatArray  # (..., 3 n - 3, 3 n - 3), rows as `linked_pose_covariance`
    chi_square: FloatArray  # (...) of the residuals
    degrees: FloatArray  # (...) of freedom: measurements less what they determine


class _Measured(NamedTuple):
    links: BoolArray  # between nodes with a path to node 0
    bearings: FloatArray
    bearing_std: float
    lengths: FloatArray  # weighted mean of typical and measured length
    information: FloatArray  # of the lengths
    prior: FloatArray  # (3 n,) information
    nearest: float  # least distance in the derivatives, which bounds the information of bearings


def network_poses(
    links: BoolArray,
    bearings: FloatArray,
    lengths: FloatArray,
    sensing: Sensing,
    orientations: FloatArray,
    positions: FloatArray,
) -> NetworkPoses:
    """Estimate orientations and positions from bearings and lengths by Levenberg-Marquardt.

    Parameters
    ----------
    links, bearings
        (..., n, n) symmetric mask of measured pairs; (..., n, n) of j in the frame of i, radians.
    lengths
        (..., n, n) symmetric, metres, 0 if not measured. Only for pairs in `links`.
    sensing
        Standard deviations of the measurements and of the prior.
    orientations
        (..., n) start, near the truth.
    positions
        (..., n, 2), node 0 at the origin. A node without a path to node 0 keeps its orientation
        and position, with the standard deviations of the prior. For the other nodes the prior only
        bounds the variances; it does not pull the estimate.
    """
    links = linked_to_0(links)
    n_nodes = links.shape[-1]
    ranged, (typical, typical_std) = links & (lengths > 0), sensing.typical_length_m
    information = length_information(links, ranged, sensing)
    # Weighted mean of measured and typical length, so that one residual represents both.
    share = np.where(ranged, typical_std**2 / (typical_std**2 + sensing.length_std_m**2), 0.0)
    measured = _Measured(
        links,
        bearings,
        sensing.bearing_std_rad,
        typical + share * (lengths - typical),
        information,
        prior_information(n_nodes, sensing),
        _NEAREST * typical,
    )
    theta, places = orientations, _linear_start(measured, orientations, positions)
    damping = np.full(links.shape[:-2], _DAMPING)
    active = np.ones(links.shape[:-2], dtype=np.bool_)
    cost, slope = _slope(measured, theta, places)
    H = _information(measured, places)
    for _ in range(_MAX_STEPS):
        step = _solved(H, slope, damping)
        new_theta, new_places = _moved(theta, places, step)
        new_cost, new_slope = _slope(measured, new_theta, new_places)
        better = active & (new_cost <= cost)
        size = np.maximum(
            np.abs(step[..., :n_nodes]).max(axis=-1),
            np.abs(step[..., n_nodes:]).max(axis=-1) / typical,
        )
        theta = np.where(better[..., None], new_theta, theta)
        places = np.where(better[..., None, None], new_places, places)
        slope = np.where(better[..., None], new_slope, slope)
        cost = np.where(better, new_cost, cost)
        # At the minimum, rounding alone can prevent a decrease of the cost.
        active = active & (size > _SETTLED) & (damping < _MOST_DAMPING)
        damping = np.where(better, np.maximum(damping / 10, _LEAST_DAMPING), damping * 10)
        if not active.any():
            break
        H = np.where(better[..., None, None], _information(measured, places), H)
    of_lengths = np.where(ranged, lengths, 0.0), ranged / sensing.length_std_m**2
    return _found(measured, theta, places, *of_lengths)


def _found(
    measured: _Measured,
    theta: FloatArray,
    places: FloatArray,
    lengths: FloatArray,
    of_lengths: FloatArray,
) -> NetworkPoses:
    free = free_columns(theta.shape[-1])
    covariance = np.linalg.inv(_information(measured, places)[..., free[:, None], free])
    bearings, _ = _residuals(measured, theta, places)
    off = lengths - lines_of_sight(places)[1]
    chi_square = (bearings**2 * measured.links).sum(axis=(-2, -1)) / measured.bearing_std**2
    chi_square = chi_square + (off**2 * of_lengths).sum(axis=(-2, -1)) / 2
    count = measured.links.sum(axis=(-2, -1)) + (of_lengths > 0).sum(axis=(-2, -1)) / 2
    # Measurements determine tr(P H) unknowns, with H their information.
    H = _of(measured, places, of_lengths)
    used = (covariance * H[..., free[:, None], free]).sum(axis=(-2, -1))
    return NetworkPoses(proj(theta), places, covariance, chi_square, count - used)


def _information(measured: _Measured, places: FloatArray) -> FloatArray:
    H = _of(measured, places, measured.information)
    diagonal = np.arange(H.shape[-1])
    H[..., diagonal, diagonal] += measured.prior
    return H


def _of(measured: _Measured, places: FloatArray, of_lengths: FloatArray) -> FloatArray:
    return pose_information(
        places, measured.links, measured.bearing_std, of_lengths, measured.nearest
    )


def _solved(H: FloatArray, slope: FloatArray, damping: FloatArray) -> FloatArray:
    """Return the damped step (..., 3 n), 0 for node 0."""
    free = free_columns(slope.shape[-1] // 3)
    part = H[..., free[:, None], free]
    diagonal = np.arange(len(free))
    part[..., diagonal, diagonal] *= 1 + damping[..., None]
    step = np.zeros(slope.shape)
    step[..., free] = np.linalg.solve(part, slope[..., free, None])[..., 0]
    return step


def _moved(
    theta: FloatArray, places: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    n_nodes = theta.shape[-1]
    return theta + step[..., :n_nodes], places + step[..., n_nodes:].reshape(places.shape)


def _residuals(
    measured: _Measured, theta: FloatArray, places: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals of all bearings and lengths (..., n, n), measured or not."""
    along, distance = lines_of_sight(places)
    toward = np.arctan2(along[..., 1], along[..., 0])
    return proj(measured.bearings - toward + theta[..., None]), measured.lengths - distance


def _slope(
    measured: _Measured, theta: FloatArray, places: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the cost (...) and minus half its gradient (..., 3 n)."""
    along, distance = lines_of_sight(places)
    across = across_of(along, distance, measured.nearest)
    bearings, lengths = _residuals(measured, theta, places)
    turned = measured.links * bearings / measured.bearing_std**2
    stretched = measured.information * lengths
    pull = turned[..., None] * across
    # `across` of (j, i) is the negative of that of (i, j).
    moved = -(pull + stretched[..., None] * along).sum(axis=-2) + pull.sum(axis=-3)
    slope = [-turned.sum(axis=-1), moved.reshape(*theta.shape[:-1], -1)]
    cost = (turned * bearings).sum(axis=(-2, -1)) + (stretched * lengths).sum(axis=(-2, -1)) / 2
    return cost, np.concatenate(slope, axis=-1)


def _linear_start(measured: _Measured, theta: FloatArray, positions: FloatArray) -> FloatArray:
    """Return positions (..., n, 2) by linear least squares.

    Links have their length along their direction and no component across it. The weights are
    updated by the estimated lengths, because a bearing error shifts a far node more.
    """
    links, tied = measured.links, measured.information
    toward = theta[..., None] + measured.bearings
    back = toward.swapaxes(-1, -2) + np.pi
    toward = toward + 0.5 * proj(back - toward)
    along = np.stack([np.cos(toward), np.sin(toward)], axis=-1)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    n_nodes = theta.shape[-1]
    # A weak prior that keeps unmeasured nodes in place and hardly affects the others.
    prior = _HINT * measured.prior[-1]
    places, apart = positions, measured.lengths
    for _ in range(_REWEIGHTINGS):
        flat = links / (measured.bearing_std * np.maximum(apart, 0.1 * measured.lengths)) ** 2
        tie = flat[..., None, None] * across[..., :, None] * across[..., None, :]
        tie = tie + tied[..., None, None] * along[..., :, None] * along[..., None, :]
        A = -tie
        node = np.arange(n_nodes)
        A[..., node, node, :, :] += tie.sum(axis=-3) + prior * np.eye(2)
        A = A.swapaxes(-3, -2).reshape(*theta.shape[:-1], 2 * n_nodes, 2 * n_nodes)
        right = prior * positions - ((tied * measured.lengths)[..., None] * along).sum(axis=-2)
        right = right.reshape(*theta.shape[:-1], -1)
        places = np.zeros(positions.shape)
        solved = np.linalg.solve(A[..., 2:, 2:], right[..., 2:, None])
        places[..., 1:, :] = solved.reshape(*theta.shape[:-1], n_nodes - 1, 2)
        apart = lines_of_sight(places)[1]
    return places
