"""rbl-gym network: solve the orientations of a planar network or pose graph from a file."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from rbl_gym import estimators
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.networks.orientations import LEAST_WEIGHT, cost, residuals
from rbl_gym.networks import g2o, graphs
from rbl_gym.networks.edges import IntArray
from rbl_gym.networks.g2o import PoseGraph

__all__ = ["Solved", "solve_network"]

WEIGHTS = ("information", "unit")
_WORST = 5  # number of listed edges


class Solved(NamedTuple):
    """A network and its orientations."""

    result: dict[str, Any]  # plain numbers
    graph: PoseGraph
    theta: FloatArray  # (n,)
    residual: FloatArray  # (m,) radians
    positions: FloatArray | None  # (n, 2), if the file has displacements


def solve_network(path: str, weights: str = "information") -> Solved:
    """Read a file, solve for the orientations, and test whether the chordal minimum is global.

    Parameters
    ----------
    path
        The file.
    weights
        ``"information"``: the information of theta, I33, of each edge; if the file has none,
        all edges have equal weights. ``"unit"``: equal weights in all cases.

    Raises
    ------
    ValueError
        If the file is not as described, the graph is not connected, or required information of
        theta is missing. The message names the file and its nodes.
    """
    graph = g2o.read_graph(path)
    try:
        return _solved(path, graph, weights)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _solved(path: str, graph: PoseGraph, weights: str) -> Solved:
    n_nodes = len(graph.ids)
    graphs.check_connected(graph.edges, n_nodes, graph.ids)
    weight = edge_weights(graph) if weights == "information" else np.ones(len(graph.edges))
    used = weight > max(LEAST_WEIGHT * weight.max(), 0.0)
    edges, y, w = graph.edges[used], graph.y[used], weight[used]
    if not used.all():
        try:
            graphs.check_connected(edges, n_nodes, graph.ids)
        except ValueError as error:
            raise ValueError(
                f"among the edges with information of theta (I33): {error}; --weights unit gives "
                "all edges the same weight"
            ) from error
    begin = time.perf_counter()
    theta = estimators.orientations(edges, y, n_nodes, weights=w)
    solved = time.perf_counter()
    optimum = estimators.chordal_optimum(edges, y, n_nodes, start=theta, weights=w)
    certified = time.perf_counter()
    residual = residuals(graph.edges, graph.y, theta)
    tree = estimators.orientations(edges, y, n_nodes, method="tree")
    worst = np.argsort(-np.abs(residual), kind="stable")[:_WORST]
    result = {
        "file": path,
        "nodes": n_nodes,
        "edges": len(graph.edges),
        "loops": len(graph.edges) - n_nodes + 1,
        "skipped_lines": graph.skipped,
        "weights": _said(graph, weights),
        "edges_without_weight": int((~used).sum()),
        "cost": cost(edges, y, theta, w),
        "tree_cost": cost(edges, y, tree, w),
        "chordal_cost": optimum.cost,
        "certified": optimum.certified,
        "cost_rad2": cost(graph.edges, graph.y, theta),
        "tree_cost_rad2": cost(graph.edges, graph.y, tree),
        "residual_rms_deg": float(np.degrees(np.sqrt(np.mean(residual**2)))),
        "residual_weighted_rms_deg": float(np.degrees(np.sqrt(cost(edges, y, theta, w) / w.sum()))),
        "residual_max_deg": float(np.degrees(np.abs(residual).max())),
        "worst_edges": [
            {
                "i": int(graph.ids[graph.edges[row, 0]]),
                "j": int(graph.ids[graph.edges[row, 1]]),
                "residual_deg": float(np.degrees(residual[row])),
                "weight": float(weight[row]),
            }
            for row in worst
        ],
        "seconds": solved - begin,
        "certificate_seconds": certified - solved,
    }
    return Solved(result, graph, theta, residual, _positions(graph, theta, weights))


def edge_weights(graph: PoseGraph) -> FloatArray:
    """Return the information of theta (m,), I33 of each edge; 1 if the file has none.

    An edge that is not on a cycle needs none: its angle is used unchanged. ValueError if some edges
    on cycles have information and others do not; the message names the first.
    """
    if graph.information is None:
        return np.ones(len(graph.edges))
    weight = graph.information[:, 2, 2]
    missing = np.isnan(weight)
    if not missing.any():
        return weight
    needed = missing & _on_cycles(graph.edges, len(graph.ids))
    if needed.any():
        i, j = graph.ids[graph.edges[np.argmax(needed)]]
        raise ValueError(
            f"every edge on a cycle must have information (I11 to I33), got none in edge {i} {j}; "
            "--weights unit gives all edges the same weight"
        )
    return np.where(missing, np.nanmax(weight) or 1.0, weight)


def _on_cycles(edges: IntArray, n_nodes: int) -> np.ndarray:
    """Return whether each edge (m,) is part of a cycle."""
    cycles = graphs.cycle_matrix(edges, n_nodes)
    return np.bincount(cycles.indices, minlength=len(edges)) > 0


def _said(graph: PoseGraph, weights: str) -> str:
    if weights == "unit":
        return "equal for all edges, as asked for"
    if graph.information is None:
        return "equal for all edges, as the file has no information"
    return "information of theta"


def _positions(graph: PoseGraph, theta: FloatArray, weights: str) -> FloatArray | None:
    """Return the least-squares positions of the displacements, rotated by the orientations.

    They are weighted by their information if all edges have it; None if it is not definite.
    """
    if graph.displacement is None:
        return None
    edges, n_nodes = graph.edges, len(theta)
    c, s = np.cos(theta[edges[:, 0]]), np.sin(theta[edges[:, 0]])
    turn = np.stack([c, -s, s, c], axis=-1).reshape(-1, 2, 2)
    information = np.broadcast_to(np.eye(2), turn.shape)
    if weights == "information" and graph.information is not None:
        information = graph.information[:, :2, :2]
        if not (np.isfinite(information).all() and (np.linalg.eigvalsh(information) > 0).all()):
            return None
    W = turn @ information @ turn.swapaxes(1, 2)
    m = len(edges)
    B = sp.kron(graphs.incidence(edges, n_nodes)[:, 1:], sp.eye(2), format="csr")
    weighted = B.T @ sp.bsr_matrix((W, np.arange(m), np.arange(m + 1)), shape=(2 * m, 2 * m))
    displacement = (turn @ graph.displacement[..., None]).ravel()
    places = scipy.sparse.linalg.spsolve(sp.csc_matrix(weighted @ B), weighted @ displacement)
    return np.concatenate([np.zeros((1, 2)), np.reshape(places, (-1, 2))])
