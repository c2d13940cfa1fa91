"""Compute Cramer-Rao bounds of networks: orientations from edge angles, frames from bearings.

All quantities are relative to node 0, whose frame is the reference: its orientation is 0 and its
position is the origin.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number
from rbl_gym.geometry import rotations
from rbl_gym.networks.edges import IntArray, check_edges
from rbl_gym.networks.graphs import check_connected, incidence
from rbl_gym.networks.sensing import check_pair, check_positions, directions_of

__all__ = [
    "bearing_jacobian",
    "frame_covariance",
    "orientation_covariance",
    "range_jacobian",
    "space_jacobian",
    "space_orientation_covariance",
]


def orientation_covariance(edges: ArrayLike, n_nodes: int, bearing_std_rad: float) -> FloatArray:
    """Return the bound (n - 1, n - 1) of orientations from edge angles of variance 2 sigma^2."""
    sigma = check_number("bearing_std_rad", bearing_std_rad, low=0.0)
    B = incidence(check_connected(edges, n_nodes), n_nodes)[:, 1:]
    return 2 * sigma**2 * np.linalg.inv((B.T @ B).toarray())


def edge_variance(n_edges: int, n_nodes: int, bearing_std_rad: float) -> float:
    """Return the mean bound of a consistent edge angle: ``2 sigma^2 (n - 1) / m``."""
    return 2 * bearing_std_rad**2 * (n_nodes - 1) / n_edges


def linked_covariance(
    links: BoolArray, bearing_std_rad: float | FloatArray, prior_std_rad: float
) -> FloatArray:
    """Return the orientation bound (..., n - 1, n - 1) of networks that may be disconnected.

    `links` (..., n, n) are the pairs that see each other. Nodes without a path to node 0 keep their
    prior, which keeps the bound finite: their links give no information on node 0.
    `bearing_std_rad` may be (..., 1, 1) for several networks.
    """
    weight = linked_to_0(links) / (2 * bearing_std_rad**2)
    information = np.eye(links.shape[-1]) * (weight.sum(axis=-1) + prior_std_rad**-2)[..., None]
    return np.linalg.inv((information - weight)[..., 1:, 1:])


def linked_to_0(links: BoolArray) -> BoolArray:
    """Return links (..., n, n) without those of nodes that have no path to node 0."""
    near = np.zeros(links.shape[:-1], dtype=np.bool_)
    near[..., 0] = True
    while ((more := near | (links & near[..., None, :]).any(axis=-1)) != near).any():
        near = more
    return links & near[..., None]


class Sensing(NamedTuple):
    """Sensor noise and prior knowledge of a network; of several networks arrays (..., 1, 1)."""

    bearing_std_rad: float
    length_std_m: float  # of a measured length
    # Mean and standard deviation of the length of a link before it is measured.
    typical_length_m: tuple[float, float]
    # Prior standard deviations of an orientation and a coordinate, relative to node 0.
    prior_std_rad: float
    prior_std_m: float


def linked_pose_covariance(
    positions: FloatArray, links: BoolArray, ranged: BoolArray, sensing: Sensing
) -> FloatArray:
    """Return the pose bound (..., 3 n - 3, 3 n - 3) of networks that may be disconnected.

    Rows: n - 1 orientations, then x and y of nodes 1 to n - 1, in the frame of node 0, as
    `frame_covariance`. Nodes without a path to node 0 keep their prior.

    Parameters
    ----------
    positions
        (..., n, 2) metres, in any frame with the orientation of node 0.
    links, ranged
        (..., n, n) symmetric: the pairs that see each other, and those with a measured distance.
        Any link has the typical length as a prior, without which non-rigid networks have no bound.
    sensing
        The standard deviations.
    """
    links = linked_to_0(links)
    weight = length_information(links, ranged & links, sensing)
    H = pose_information(positions, links, sensing.bearing_std_rad, weight)
    diagonal = np.arange(H.shape[-1])
    H[..., diagonal, diagonal] += prior_information(links.shape[-1], sensing)
    free = free_columns(links.shape[-1])
    return np.linalg.inv(H[..., free[:, None], free])


def length_information(links: BoolArray, ranged: BoolArray, sensing: Sensing) -> FloatArray:
    """Return the information (..., n, n) on the lengths of links, prior plus measured."""
    return links / sensing.typical_length_m[1] ** 2 + ranged / sensing.length_std_m**2


def prior_information(n_nodes: int, sensing: Sensing) -> FloatArray:
    """Return the prior information (..., 3 n), in the order of `bearing_jacobian`."""
    rotation, place = np.asarray(sensing.prior_std_rad), np.asarray(sensing.prior_std_m)
    each = np.stack(np.broadcast_arrays(rotation, place)) ** -2.0
    # Fields of several networks are (..., 1, 1).
    each = each[..., 0, 0] if each.ndim > 1 else each
    return np.repeat(np.moveaxis(each, 0, -1), [n_nodes, 2 * n_nodes], axis=-1)


def pose_information(
    positions: FloatArray,
    links: BoolArray,
    bearing_std_rad: float,
    of_lengths: FloatArray,
    nearest_m: float = 1e-9,
) -> FloatArray:
    """Return the Fisher information (..., 3 n, 3 n) of frames, columns as in `bearing_jacobian`.

    It contains both bearings of each link, and lengths with the information (..., n, n). For
    bearings, distances below `nearest_m` are replaced by it.
    """
    along, distance = lines_of_sight(positions)
    across = across_of(along, distance, nearest_m)
    weight = links / bearing_std_rad**2
    n_nodes = links.shape[-1]
    # Both bearings of a link and its length connect two positions ...
    tie = _outer(across) * (2 * weight)[..., None, None]
    tie += _outer(along) * of_lengths[..., None, None]
    # ... and a bearing connects the orientation of its observer to both positions.
    turn = -weight[..., None] * across
    diagonal = np.arange(n_nodes)
    places = -tie
    places[..., diagonal, diagonal, :, :] += tie.sum(axis=-3)
    turn[..., diagonal, diagonal, :] -= turn.sum(axis=-2)
    H = np.zeros((*links.shape[:-2], 3 * n_nodes, 3 * n_nodes))
    H[..., diagonal, diagonal] = weight.sum(axis=-1)
    flat = (*links.shape[:-2], n_nodes, 2 * n_nodes)
    H[..., :n_nodes, n_nodes:] = turn.reshape(flat)
    H[..., n_nodes:, :n_nodes] = turn.reshape(flat).swapaxes(-1, -2)
    H[..., n_nodes:, n_nodes:] = places.swapaxes(-3, -2).reshape(
        *links.shape[:-2], 2 * n_nodes, 2 * n_nodes
    )
    return H


def lines_of_sight(positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (..., n, n, 2) from i to j and distances (..., n, n), none of them 0."""
    apart = positions[..., None, :, :] - positions[..., :, None, :]
    distance = np.maximum(np.linalg.norm(apart, axis=-1), 1e-9)
    return apart / distance[..., None], distance


def across_of(along: FloatArray, distance: FloatArray, nearest_m: float) -> FloatArray:
    """Return the derivative (..., n, n, 2) of the direction from i to j by the position of j."""
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    return across / np.maximum(distance, nearest_m)[..., None]


def _outer(vectors: FloatArray) -> FloatArray:
    return vectors[..., :, None] * vectors[..., None, :]


def bearing_jacobian(positions: ArrayLike, edges: ArrayLike) -> scipy.sparse.csr_matrix:
    """Return the derivative (2 m, 3 n) of bearings by n orientations, then x and y of each node.

    Rows are in the order of ``bearings.ravel()``: of j seen by i, of i seen by j, edge by edge.
    """
    positions = check_positions(positions)
    n_nodes = len(positions)
    edges = check_edges(edges, n_nodes)
    toward = directions_of(positions, edges)
    apart = positions[edges[:, 1]] - positions[edges[:, 0]]
    across = np.column_stack([-np.sin(toward), np.cos(toward)])
    length = np.linalg.norm(apart, axis=1, keepdims=True)
    if (length == 0).any():
        i, j = edges[int(np.argmin(length))]
        raise ValueError(
            f"positions of nodes with an edge must differ, those of {i} and {j} are the same"
        )
    across /= length
    both = np.repeat(across, 2, axis=0)
    places = n_nodes + 2 * np.repeat(edges, 2, axis=0)[:, :, None] + [0, 1]
    columns = np.column_stack([edges.ravel(), places.reshape(-1, 4)])
    values = np.column_stack([np.full(2 * len(edges), -1.0), -both, both])
    return sparse_rows(values, columns, 3 * n_nodes)


def range_jacobian(positions: ArrayLike, pairs: ArrayLike) -> scipy.sparse.csr_matrix:
    """Return derivative (k, 3 n) of distances of node pairs, columns as in `bearing_jacobian`."""
    positions = check_positions(positions)
    n_nodes = len(positions)
    pairs = check_edges(pairs, n_nodes)
    toward = directions_of(positions, pairs)
    along = np.column_stack([np.cos(toward), np.sin(toward)])
    columns = (n_nodes + 2 * pairs[:, :, None] + [0, 1]).reshape(-1, 4)
    return sparse_rows(np.concatenate([-along, along], axis=1), columns, 3 * n_nodes)


def sparse_rows(values: FloatArray, columns: IntArray, width: int) -> scipy.sparse.csr_matrix:
    """Return the sparse matrix (m, width) of entries (m, k) at columns (m, k)."""
    rows, each = values.shape
    return scipy.sparse.csr_matrix(
        (values.ravel(), columns.ravel(), each * np.arange(rows + 1)), shape=(rows, width)
    )


def free_columns(n_nodes: int) -> IntArray:
    """Return the columns (3 n - 3,) of the Jacobians for unknowns: all but those of node 0."""
    known = [0, n_nodes, n_nodes + 1]
    return np.setdiff1d(np.arange(3 * n_nodes), known)


def frame_covariance(
    positions: ArrayLike,
    edges: ArrayLike,
    bearing_std_rad: float,
    known_pair: tuple[int, int] | None = None,
    ranges_of: ArrayLike | None = None,
    range_std_m: float | None = None,
) -> FloatArray:
    """Return the bound (3 n - 3, 3 n - 3) of n - 1 orientations, then x and y of nodes 1 to n - 1.

    Parameters
    ----------
    positions
        (n, 2) metres, in any frame; the bound is in the frame of node 0 with that orientation.
    edges
        (m, 2), both bearings of each edge are measured.
    bearing_std_rad
        sigma of a bearing.
    known_pair
        Two nodes whose distance is known exactly.
    ranges_of, range_std_m
        Pairs (k, 2) whose distances are measured, and sigma of such a range. One of the two is
        needed: bearings have no scale.

    Raises
    ------
    ValueError
        If the frames are not determined.
    """
    positions = check_positions(positions)
    J = bearing_jacobian(positions, edges) / check_number(
        "bearing_std_rad", bearing_std_rad, low=1e-12
    )
    rows: list[Any] = [J]
    if ranges_of is not None:
        rows.append(
            range_jacobian(positions, ranges_of)
            / check_number("range_std_m", range_std_m, low=1e-12)
        )
    elif known_pair is None:
        raise ValueError(
            "either known_pair or ranges must be given, as one of them sets the scale; got neither"
        )
    free = free_columns(len(positions))
    J = scipy.sparse.csr_matrix(scipy.sparse.vstack(rows))[:, free].toarray()
    if known_pair is not None:
        # Motions that keep the known distance: the null space of its one row.
        pair = check_pair("known_pair", known_pair, len(positions))
        row = range_jacobian(positions, [pair])[:, free].toarray()[0]
        basis = np.linalg.svd(row[None])[2][1:].T
    else:
        basis = np.eye(len(free))
    values, vectors = np.linalg.eigh(basis.T @ (J.T @ J) @ basis)
    if len(values) and values[0] <= 1e-12 * values[-1]:
        missing = int((values <= 1e-12 * values[-1]).sum())
        raise ValueError(
            f"edges must determine all frames, but {missing} of their unknowns remain free: add "
            "edges"
        )
    factor = basis @ vectors / np.sqrt(values)
    return factor @ factor.T


# --- space ------------------------------------------------------------------------------------


def space_jacobian(positions: ArrayLike, edges: ArrayLike) -> FloatArray:
    """Return the derivative (6 m, 6 n) of bearings in space, frames parallel to the world.

    Columns: shifts of node 0, of node 1, ..., then rotations w, ``R = exp(w) R``, of node 0, and so
    on. Rows: the direction of j seen by i, of i seen by j, edge by edge.

    Parameters
    ----------
    positions
        (n, 3) metres.
    edges
        (m, 2), both nodes of an edge measure the other's direction in their own frame.
    """
    positions = check_array("positions", positions, ("n", 3))
    if positions.ndim != 2:
        raise ValueError(f"positions must have shape (n, 3), got {positions.shape}")
    n_nodes = len(positions)
    edges = check_edges(edges, n_nodes)
    rows = np.zeros((len(edges), 2, 3, 2, n_nodes, 3))
    for k, (i, j) in enumerate(edges):
        apart = positions[j] - positions[i]
        length = float(np.linalg.norm(apart))
        if length == 0:
            raise ValueError(
                f"positions of nodes with an edge must differ, those of {i} and {j} are the same"
            )
        u = apart / length
        # d u = (I - u u^T) (dp_j - dp_i) / length; a rotation w of the observer adds -w x u.
        shift = (np.eye(3) - np.outer(u, u)) / length
        turn = rotations.hat(u)
        for side, (node, sense) in enumerate(((i, 1), (j, -1))):
            rows[k, side, :, 0, j], rows[k, side, :, 0, i] = sense * shift, -sense * shift
            rows[k, side, :, 1, node] = sense * turn
    return rows.reshape(-1, 6 * n_nodes)


def space_orientation_covariance(
    positions: ArrayLike, edges: ArrayLike, bearing_std_rad: float
) -> FloatArray:
    """Return the bound (3 (n - 1), 3 (n - 1)) of rotations relative to node 0, in space.

    It is for nodes 1 to n - 1, from mutual bearings with noise of `bearing_std_rad` about each axis
    perpendicular to them.

    Raises
    ------
    ValueError
        If the bearings leave more freedom than a shift, a rotation and the scale of the whole.
    """
    sigma = check_number("bearing_std_rad", bearing_std_rad, low=0.0)
    J = space_jacobian(positions, edges)
    n_nodes = J.shape[1] // 6
    scale = np.zeros(6 * n_nodes)
    scale[: 3 * n_nodes] = (np.asarray(positions) - np.asarray(positions)[0]).ravel()
    kept = np.delete(np.arange(6 * n_nodes), [0, 1, 2, *range(3 * n_nodes, 3 * n_nodes + 3)])
    # Bearings do not determine the scale. Fixing it makes the rest regular and changes no
    # orientation.
    known = np.vstack([J, scale / np.linalg.norm(scale)])[:, kept]
    values = np.linalg.svd(known, compute_uv=False)
    if values[-1] < 1e-9 * values[0]:
        raise ValueError(
            "edges must determine all orientations at these positions, but "
            f"{int((values < 1e-9 * values[0]).sum())} motions remain free: add edges"
        )
    return sigma**2 * np.linalg.inv(known.T @ known)[3 * (n_nodes - 1) :, 3 * (n_nodes - 1) :]
