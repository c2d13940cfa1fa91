"""Model planar relative sensing networks: nodes measure bearings of others in their own frames.

Node i has the unknown position ``p_i`` and orientation ``theta_i``. Nodes within the sensing
radius measure each other's bearing in their own frames. The two bearings of an edge give the
difference of the orientations of its nodes, (8).

Source: G. Piovan, I. Shames, B. Fidan, F. Bullo, B. D. O. Anderson, "On frame and orientation
localization for relative sensing networks". Equation numbers are those of the paper.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    FloatArray,
    as_float,
    check_array,
    check_count,
    check_finite,
    check_number,
)
from rbl_gym.geometry import rotations
from rbl_gym.networks.edges import MOST_NODES, IntArray, check_edges
from rbl_gym.networks.graphs import components

__all__ = [
    "SensingNetwork", "directions", "edge_angles", "measure_bearings", "measure_in_space", "proj",
    "random_network", "true_bearings", "unit_disk_edges",
]  # fmt: skip

_LARGEST_ANGLE = 1e6
_TURN = 2 * np.pi


class SensingNetwork(NamedTuple):
    """Nodes, edges, and the measured bearings."""

    positions: FloatArray  # (n, 2) metres
    orientations: FloatArray  # (n,) radians, that of node 0 is 0
    edges: IntArray  # (m, 2), i < j
    bearings: FloatArray  # (m, 2) of j seen by i and of i seen by j, each in its own frame

    @property
    def y(self) -> FloatArray:
        """Return the edge angles (m,), see `edge_angles`."""
        return edge_angles(self.bearings)


def proj(angle: ArrayLike) -> FloatArray:
    """Wrap angles to the half-open [-pi, pi); angles inside are unchanged to the last bit."""
    angle = check_finite("angle", as_float("angle", angle))
    wrapped = angle - _TURN * np.floor((angle + np.pi) / _TURN)
    # Rounding can give a value at the open end, or just below the closed one.
    wrapped = np.where(wrapped >= np.pi, wrapped - _TURN, wrapped)
    wrapped = np.maximum(wrapped, -np.pi)
    return np.where((angle >= -np.pi) & (angle < np.pi), angle, wrapped)


def check_pair(name: str, pair: ArrayLike, n_nodes: int) -> tuple[int, int]:
    """Return a pair of nodes, or raise ValueError."""
    pairs = check_edges([pair], n_nodes, name)  # pyrefly: ignore[bad-argument-type]
    if not len(pairs):
        raise ValueError(f"{name} must be two nodes, got {pair!r:.80}")
    return int(pairs[0, 0]), int(pairs[0, 1])


def check_edge_values(
    name: str, values: ArrayLike, edges: IntArray, trailing: int = 0
) -> FloatArray:
    """Return `values` as finite floats, one (or a row of `trailing`) for each edge."""
    shape = (len(edges), trailing) if trailing else (len(edges),)
    array = as_float(name, values)
    if array.size == 0 == len(edges):
        return np.zeros(shape)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, a row for each edge, got {array.shape}")
    return check_finite(name, array)


def unit_disk_edges(positions: ArrayLike, radius_m: float, blind_m: float = 0.0) -> IntArray:
    """Return the edges (m, 2), i < j and sorted, of nodes at most `radius_m` apart.

    Nodes closer than `blind_m` do not see each other.
    """
    positions = check_positions(positions)
    radius_m = check_number("radius_m", radius_m, low=0.0)
    pairs = np.sort(
        scipy.spatial.KDTree(positions).query_pairs(radius_m, output_type="ndarray"), axis=1
    )
    if blind_m > 0:
        apart = np.linalg.norm(positions[pairs[:, 1]] - positions[pairs[:, 0]], axis=1)
        pairs = pairs[apart >= blind_m]
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].astype(np.intp)


def directions(positions: ArrayLike, edges: ArrayLike) -> FloatArray:
    """Return the direction (m,) in the world frame from i to j of every edge.

    Raises
    ------
    ValueError
        If the nodes of an edge have the same position: there is no bearing.
    """
    positions = check_positions(positions)
    return directions_of(positions, check_edges(edges, len(positions)))


def directions_of(positions: FloatArray, edges: IntArray) -> FloatArray:
    """Compute `directions` of checked positions and edges."""
    apart = positions[edges[:, 1]] - positions[edges[:, 0]]
    same = (apart == 0).all(axis=1)
    if same.any():
        pair = edges[int(np.argmax(same))].tolist()
        raise ValueError(
            f"positions of nodes with an edge must differ, those of nodes {pair} are the same"
        )
    return np.arctan2(apart[:, 1], apart[:, 0])


def check_edge_angles(y: ArrayLike, edges: IntArray) -> FloatArray:
    """Return edge angles y (m,), or raise ValueError; very large angles are invalid."""
    array = check_edge_values("y", y, edges)
    if (np.abs(array) > _LARGEST_ANGLE).any():
        raise ValueError(
            f"y must be angles in radians of at most {_LARGEST_ANGLE:g}, got "
            f"{np.abs(array).max():g}"
        )
    return array


def true_bearings(positions: ArrayLike, orientations: ArrayLike, edges: ArrayLike) -> FloatArray:
    """Return noise-free bearings (m, 2): of j in the frame of i, and of i in the frame of j."""
    positions = check_positions(positions)
    edges = check_edges(edges, len(positions))
    toward = directions_of(positions, edges)
    turned = check_array("orientations", orientations, (len(positions),))
    if turned.ndim != 1:
        raise ValueError(f"orientations must have shape (n,), got {turned.shape}")
    turned = turned[edges]
    return proj(toward[:, None] + [0.0, np.pi] - turned)


def measure_bearings(
    positions: ArrayLike,
    orientations: ArrayLike,
    edges: ArrayLike,
    bearing_std_rad: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Simulate bearings (m, 2): true bearings plus independent N(0, sigma^2), wrapped.

    Parameters
    ----------
    positions, orientations
        (n, 2) metres and (n,) radians.
    edges
        (m, 2).
    bearing_std_rad
        sigma, the standard deviation of one bearing; an edge angle then has 2 sigma^2.
    rng
        Source of the noise.
    """
    sigma = check_number("bearing_std_rad", bearing_std_rad, low=0.0)
    exact = true_bearings(positions, orientations, edges)
    return proj(exact + sigma * rng.standard_normal(exact.shape))


def edge_angles(bearings: ArrayLike) -> FloatArray:
    """Return edge angles y (m,), (8): ``proj(a - b + pi)`` estimates ``theta_j - theta_i``.

    Parameters
    ----------
    bearings
        (m, 2): a of j in the frame of i, b of i in the frame of j, radians.
    """
    bearings = as_float("bearings", bearings)
    if bearings.size == 0:
        return np.zeros(0)
    a, b = check_array("bearings", bearings, ("m", 2)).T
    return proj(a - b + np.pi)


def measure_in_space(
    positions: ArrayLike,
    orientations: ArrayLike,
    edges: ArrayLike,
    bearing_std_rad: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Simulate noisy directions (..., m, 2, 3) along the edges of nodes in space, unit vectors.

    They are those of j in the frame of i, and of i in the frame of j. Each is rotated by ``exp(n)``
    with n from N(0, sigma^2) about every axis.

    Parameters
    ----------
    positions, orientations
        (..., n, 3) metres and (..., n, 3, 3), from a node's frame to the world's.
    edges
        (m, 2).
    bearing_std_rad, rng
        sigma, and the source of the noise.
    """
    positions = check_array("positions", positions, ("n", 3))
    n_nodes = positions.shape[-2]
    orientations = check_array("orientations", orientations, (n_nodes, 3, 3))
    sigma = check_number("bearing_std_rad", bearing_std_rad, low=0.0)
    i, j = check_edges(edges, n_nodes).T
    apart = positions[..., j, :] - positions[..., i, :]
    length = np.linalg.norm(apart, axis=-1, keepdims=True)
    if not length.all():
        edge = np.argwhere(length[..., 0] == 0)[0][-1]
        pair = [int(i[edge]), int(j[edge])]
        raise ValueError(
            f"positions of nodes with an edge must differ, those of nodes {pair} are the same"
        )
    toward = np.stack([apart, -apart], axis=-2) / length[..., None]
    observers = np.stack([orientations[..., i, :, :], orientations[..., j, :, :]], axis=-3)
    exact = np.einsum("...ba,...b->...a", observers, toward)
    turns = rotations.exp(sigma * rng.standard_normal(exact.shape))
    return (turns @ exact[..., None])[..., 0]


def random_network(
    n_nodes: int, mean_degree: float, bearing_std_rad: float, rng: np.random.Generator
) -> SensingNetwork:
    """Return a random network: nodes uniform in a square of unit density, and a unit-disk graph.

    Orientations are random. Nodes outside the largest connected component are left out, so that the
    network may have fewer nodes than `n_nodes`.

    Parameters
    ----------
    n_nodes, mean_degree
        Number of nodes, and mean number of neighbours of a node.
    bearing_std_rad, rng
        Noise of the measured bearings, and the source of all randomness.
    """
    n_nodes = check_count("n_nodes", n_nodes, most=MOST_NODES)
    mean_degree = check_number("mean_degree", mean_degree, low=0.0)
    positions = rng.uniform(0.0, math.sqrt(n_nodes), (n_nodes, 2))
    edges = unit_disk_edges(positions, math.sqrt(mean_degree / np.pi))
    label = components(edges, n_nodes)
    keep = label == np.bincount(label).argmax()
    renamed = np.cumsum(keep) - 1
    edges = renamed[edges[keep[edges[:, 0]]]]
    positions = positions[keep]
    theta = rng.uniform(-np.pi, np.pi, len(positions))
    theta = proj(theta - theta[0])
    bearings = measure_bearings(positions, theta, edges, bearing_std_rad, rng)
    return SensingNetwork(positions, theta, edges, bearings)


def check_positions(positions: ArrayLike) -> FloatArray:
    """Return node positions (n, 2) as an array, or raise ValueError."""
    array = check_array("positions", positions, ("n", 2))
    if array.ndim != 2:
        raise ValueError(f"positions must have shape (n, 2), got {array.shape}")
    return array
