"""rbl-gym network: orientations of a planar network or pose graph from a file."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from rbl_gym import estimators, g2o, network_graphs
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.network_orientations import cost, residuals
from rbl_gym.g2o import PoseGraph


class Solved(NamedTuple):
    """A network and its orientations."""

    result: dict[str, Any]  # plain numbers
    graph: PoseGraph
    theta: FloatArray  # (n,)
    residual: FloatArray  # (m,) radians
    positions: FloatArray | None  # (n, 2), where the file has displacements


def run(path: str) -> Solved:
    """Read a file, solve, certify.

    Raises
    ------
    ValueError
        If the file is not as described, or the graph is not connected.
    """
    graph = g2o.read_graph(path)
    edges, y, n_nodes = graph.edges, graph.y, len(graph.ids)
    network_graphs.check_connected(edges, n_nodes)
    begin = time.perf_counter()
    theta = estimators.orientations(edges, y, n_nodes)
    solved = time.perf_counter()
    optimum = estimators.chordal_optimum(edges, y, n_nodes, start=theta)
    certified = time.perf_counter()
    residual = residuals(edges, y, theta)
    tree = estimators.orientations(edges, y, n_nodes, method="tree")
    result = {
        "file": path,
        "nodes": n_nodes,
        "edges": len(edges),
        "loops": len(edges) - n_nodes + 1,
        "cost_rad2": cost(edges, y, theta),
        "tree_cost_rad2": cost(edges, y, tree),
        "chordal_cost": optimum.cost,
        "certified": optimum.certified,
        "residual_rms_deg": float(np.degrees(np.sqrt(np.mean(residual**2)))),
        "residual_max_deg": float(np.degrees(np.abs(residual).max())),
        "seconds": solved - begin,
        "certificate_seconds": certified - solved,
    }
    return Solved(result, graph, theta, residual, _positions(graph, theta))


def _positions(graph: PoseGraph, theta: FloatArray) -> FloatArray | None:
    """Least squares of the displacements, once turned by the orientations."""
    if graph.displacement is None:
        return None
    n_nodes = len(theta)
    turned = np.exp(1j * theta[graph.edges[:, 0]]) * (graph.displacement @ [1, 1j])
    B = network_graphs.incidence(graph.edges, n_nodes)[:, 1:]
    solve = scipy.sparse.linalg.factorized(sp.csc_matrix(B.T @ B))
    right = B.T @ turned
    places = np.column_stack([solve(right.real), solve(right.imag)])
    return np.concatenate([np.zeros((1, 2)), places])
