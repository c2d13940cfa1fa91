"""Frames of a planar network: orientations and positions of all nodes from raw bearings.

Bearings determine the shape; one known distance, or ranges, determines its scale. A linear start is
refined by joint maximum likelihood of orientations and positions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_number
from rbl_gym.estimators.networks.orientations import maximum_likelihood
from rbl_gym.networks.bounds import bearing_jacobian, free_columns, range_jacobian, sparse_rows
from rbl_gym.networks.graphs import check_connected
from rbl_gym.networks.rigidity import check_frames, check_joint
from rbl_gym.networks.sensing import (
    IntArray,
    check_edge_values,
    check_pair,
    edge_angles,
    proj,
    true_bearings,
)

_MAX_STEPS = 200
_DAMPING, _LEAST_DAMPING = 1e-3, 1e-9
_SETTLED = 1e-9  # radians, and fraction of the network's size
_REWEIGHTINGS = 3


class FrameEstimate(NamedTuple):
    """Orientations and positions of all nodes, in the frame of node 0.

    Attributes
    ----------
    orientations
        (n,), radians in [-pi, pi); 0 at node 0.
    positions
        (n, 2), metres; node 0 is the origin.
    cost
        Sum of squared whitened residuals.
    converged
        Whether the iteration converged.
    """

    orientations: FloatArray
    positions: FloatArray
    cost: float
    converged: bool


class _Measured(NamedTuple):
    edges: IntArray
    bearings: FloatArray  # (m, 2)
    bearing_std: float
    ranges: FloatArray  # (m,), 0 for none
    range_std: float
    known: tuple[int, int] | None
    length: float


def frames(
    edges: ArrayLike,
    bearings: ArrayLike,
    n_nodes: int,
    known_pair: tuple[int, int] | None = None,
    length_m: float | None = None,
    *,
    bearing_std_rad: float = 1.0,
    ranges: ArrayLike | None = None,
    range_std_m: float | None = None,
) -> FrameEstimate:
    """Estimate orientations and positions from bearings by joint maximum likelihood.

    These are Problems 9 and 10 of Piovan et al.; see `consensus`.

    Parameters
    ----------
    edges, bearings, n_nodes
        (m, 2) and (m, 2): of j seen by i, of i seen by j, each in its own frame, radians.
    known_pair, length_m
        Two nodes and their exact distance; not together with ranges.
    bearing_std_rad
        Standard deviation of a bearing; used only with ranges.
    ranges, range_std_m
        Measured lengths (m,) of the edges, metres, 0 for none, and their standard deviation. They
        determine the scale, and also improve the orientations.

    Raises
    ------
    ValueError
        If the frames are not determined because the graph is not connected, or not (with ranges:
        jointly) rigid, Proposition 16. The message names the components or the missing rank.
    """
    edges = check_connected(edges, n_nodes)
    bearings = check_edge_values("bearings", bearings, edges, 2)
    measured = _measured(
        edges, bearings, n_nodes, known_pair, length_m, bearing_std_rad, ranges, range_std_m
    )
    if n_nodes == 1:
        return FrameEstimate(np.zeros(1), np.zeros((1, 2)), 0.0, True)
    # Generic rigidity, because the true positions are unknown.
    anywhere = np.random.default_rng(0).uniform(size=(n_nodes, 2))
    if measured.known is None:
        check_joint(anywhere, edges, edges[measured.ranges > 0])
    else:
        check_frames(anywhere, edges)
    theta = maximum_likelihood(edges, edge_angles(bearings), n_nodes)
    return _joint(measured, theta, _linear_start(measured, theta))


def _measured(
    edges: IntArray, bearings: FloatArray, n_nodes: int, known: Any, length: Any,
    bearing_std: Any, ranges: Any, range_std: Any,
) -> _Measured:  # fmt: skip
    bearing_std = check_number("bearing_std_rad", bearing_std, low=1e-12)
    lengths = np.zeros(len(edges)) if ranges is None else check_edge_values("ranges", ranges, edges)
    if (lengths < 0).any():
        raise ValueError(f"ranges must not be negative, got {lengths.min()}")
    if (known is None) == (not lengths.any()) and n_nodes > 1:
        raise ValueError(
            "either known_pair or ranges must be given, as one of them sets the scale; got "
            + ("neither" if known is None else "both")
        )
    std = 1.0
    if lengths.any():
        std = check_number("range_std_m", range_std, low=1e-12)
    if known is not None:
        known = check_pair("known_pair", known, n_nodes)
        length = check_number("length_m", length, low=1e-12)
    return _Measured(edges, bearings, bearing_std, lengths, std, known, length or 1.0)


def _linear_start(measured: _Measured, theta: FloatArray) -> FloatArray:
    """Return linear positions (n, 2), node 0 at the origin.

    Edges have no component across their direction. Along it they have the measured lengths, or else
    a common scale. The weights are updated by the estimated lengths, because a bearing error shifts
    a far node more.
    """
    edges, bearings = measured.edges, measured.bearings
    toward = theta[edges[:, 0]] + bearings[:, 0]
    toward = toward + 0.5 * proj(theta[edges[:, 1]] + bearings[:, 1] + np.pi - toward)
    unit = np.column_stack([np.cos(toward), np.sin(toward)])
    along = _differences(edges, unit, len(theta))
    across = _differences(edges, np.column_stack([-unit[:, 1], unit[:, 0]]), len(theta))
    ranged = measured.ranges > 0
    positions, weight = np.zeros((len(theta), 2)), np.ones(len(edges))
    for _ in range(_REWEIGHTINGS):
        flat = across.T @ scipy.sparse.diags(weight) @ across
        if ranged.any():
            rows = along[ranged]
            solved = scipy.sparse.linalg.spsolve(
                scipy.sparse.csc_matrix(flat + rows.T @ rows), rows.T @ measured.ranges[ranged]
            )
        else:
            solved = _of_scale_one(flat, np.asarray(along.mean(axis=0)).ravel())
        positions[1:] = solved.reshape(-1, 2)
        apart = np.linalg.norm(positions[edges[:, 1]] - positions[edges[:, 0]], axis=1)
        weight = 1 / np.maximum(apart / np.median(apart), 0.1) ** 2
    return _scaled(measured, positions)


def _of_scale_one(flat: scipy.sparse.spmatrix, mean_length: FloatArray) -> FloatArray:
    """Minimise the quadratic form with mean length 1 along the edges."""
    row = scipy.sparse.csr_matrix(mean_length)
    bordered = scipy.sparse.bmat([[flat, row.T], [row, None]], format="csc")
    right = np.zeros(len(mean_length) + 1)
    right[-1] = 1.0
    return scipy.sparse.linalg.spsolve(bordered, right)[:-1]


def _scaled(measured: _Measured, positions: FloatArray) -> FloatArray:
    if measured.known is None:
        return positions
    i, j = measured.known
    return positions * (measured.length / np.linalg.norm(positions[j] - positions[i]))


def _differences(edges: IntArray, vectors: FloatArray, n_nodes: int) -> scipy.sparse.csr_matrix:
    """Return rows (m, 2 n - 2) of ``v' (p_j - p_i)`` for each edge's vector v, node 0 at origin."""
    columns = (2 * edges[:, :, None] + [0, 1]).reshape(-1, 4)
    values = np.concatenate([-vectors, vectors], axis=1)
    return sparse_rows(values, columns, 2 * n_nodes)[:, 2:]


def _joint(measured: _Measured, theta: FloatArray, positions: FloatArray) -> FrameEstimate:
    """Run Levenberg-Marquardt on all bearings and ranges.

    Bearings do not depend on scale. The damping suppresses changes of scale; it is set at the end.
    """
    n_nodes = len(theta)
    free = free_columns(n_nodes)
    residual = _residuals(measured, theta, positions)
    cost, damping, converged = float(residual @ residual), _DAMPING, False
    J = _jacobian(measured, positions)[:, free]
    for _ in range(_MAX_STEPS):
        information = J.T @ J
        damped = information + scipy.sparse.diags(damping * information.diagonal())
        step = np.zeros(3 * n_nodes)
        step[free] = scipy.sparse.linalg.spsolve(scipy.sparse.csc_matrix(damped), J.T @ residual)
        new = theta + step[:n_nodes], positions + step[n_nodes:].reshape(-1, 2)
        size = max(
            np.abs(step[:n_nodes]).max(), np.abs(step[n_nodes:]).max() / np.abs(positions).max()
        )
        new_residual = _residuals(measured, *new)
        if (new_cost := float(new_residual @ new_residual)) <= cost:
            (theta, positions), residual, cost = new, new_residual, new_cost
            J = _jacobian(measured, positions)[:, free]
            damping = max(damping / 10, _LEAST_DAMPING)
        elif damping > 1e6:
            break
        else:
            damping *= 10
        # At the minimum, rounding alone can prevent a decrease of the cost.
        if size <= _SETTLED:
            converged = True
            break
    return FrameEstimate(proj(theta), _scaled(measured, positions), cost, converged)


def _residuals(measured: _Measured, theta: FloatArray, positions: FloatArray) -> FloatArray:
    """Return all whitened residuals, bearings first."""
    edges, ranged = measured.edges, measured.ranges > 0
    angles = proj(measured.bearings - true_bearings(positions, theta, edges)) / measured.bearing_std
    apart = positions[edges[ranged, 1]] - positions[edges[ranged, 0]]
    lengths = (measured.ranges[ranged] - np.linalg.norm(apart, axis=1)) / measured.range_std
    return np.concatenate([angles.ravel(), lengths])


def _jacobian(measured: _Measured, positions: FloatArray) -> scipy.sparse.csr_matrix:
    """Return the derivative of the whitened predictions."""
    ranged = measured.edges[measured.ranges > 0]
    rows: list[Any] = [bearing_jacobian(positions, measured.edges) / measured.bearing_std]
    rows.append(range_jacobian(positions, ranged) / measured.range_std)
    return scipy.sparse.csr_matrix(scipy.sparse.vstack(rows))
