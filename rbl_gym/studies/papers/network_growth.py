"""Measure the outlook of the network paper: kappa against n (Section IV-E), and nodes in space."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.spatial import Delaunay

from rbl_gym.checks import FloatArray
from rbl_gym.estimators import triangle_frames
from rbl_gym.estimators.networks import consensus
from rbl_gym.estimators.networks.triangle import TRIANGLE_EDGES
from rbl_gym.geometry import rotations
from rbl_gym.networks import bounds, sensing

__all__ = ["kappa_growth", "three_in_space"]

WORST_SIZES = (6, 8, 11, 16, 23, 32)
TRIANGULATION_SIZES = (10, 20, 40, 80, 160, 320)
# Number of largest sizes to which slopes in n are fitted.
_FITTED = 4
SHAPES = {
    "equilateral": [[0, 0, 0], [1, 0, 0], [0.5, 0.75**0.5, 0]],
    "flat": [[0, 0, 0], [1, 0, 0], [0.5, 0.1, 0]],
}
SPACE_STD_RAD = (0.001, 0.01, 0.05)


def kappa_growth(rng: np.random.Generator) -> dict[str, Any]:
    """Return kappa by every rule, and its true factor, for growing networks.

    Returns
    -------
    ``worst``: complete graphs with the fundamental cycles of a path, which have O(n) edges each.
    ``triangulation``: Delaunay triangulations of points uniform in a square, with their triangles
    as cycles. Each has `rows` and, by rule, the `slope` of log kappa over log n.
    """
    graphs = {
        "worst": [(n, path_cycles(n)) for n in WORST_SIZES],
        "triangulation": [(n, triangles(rng.uniform(0, 1, (n, 2)))) for n in TRIANGULATION_SIZES],
    }
    return {name: _grown(sizes) for name, sizes in graphs.items()}


def _grown(sizes: list[tuple[int, sp.csr_matrix]]) -> dict[str, Any]:
    rows: list[dict[str, Any]] = []
    for n_nodes, C in sizes:
        kappa = {rule: consensus.step_size(C, rule) for rule in consensus.STEP_RULES}
        factor = {rule: consensus.convergence_factor(C, one) for rule, one in kappa.items()}
        low, high = consensus.eigenvalues(C)
        rows.append(
            {
                "nodes": n_nodes,
                "edges": C.shape[1],
                "loops": C.shape[0],
                "lambda_min": low,
                "lambda_max": high,
                "kappa": kappa,
                "factor": factor,
            }
        )
    at = np.log([row["nodes"] for row in rows[-_FITTED:]])
    slope = {
        rule: float(np.polyfit(at, np.log([row["kappa"][rule] for row in rows[-_FITTED:]]), 1)[0])
        for rule in consensus.STEP_RULES
    }
    return {"rows": rows, "slope": slope}


def path_cycles(n_nodes: int) -> sp.csr_matrix:
    """Return cycles of the complete graph: an edge (i, j) and the path i, i + 1, ..., j back."""
    pairs = list(itertools.combinations(range(n_nodes), 2))
    column = {pair: k for k, pair in enumerate(pairs)}
    closing = [pair for pair in pairs if pair[1] > pair[0] + 1]
    C = sp.lil_matrix((len(closing), len(pairs)))
    for row, (i, j) in enumerate(closing):
        C[row, column[i, j]] = 1
        C[row, [column[k, k + 1] for k in range(i, j)]] = -1
    return sp.csr_matrix(C)


def triangles(places: FloatArray) -> sp.csr_matrix:
    """Return the triangles of the Delaunay triangulation of points (n, 2), a cycle basis."""
    corners = np.sort(Delaunay(places).simplices, axis=1)
    sides = corners[:, [0, 1, 1, 2, 0, 2]].reshape(-1, 2)
    edges, column = np.unique(sides, axis=0, return_inverse=True)
    rows = np.repeat(np.arange(len(corners)), 3)
    values = np.tile([1.0, 1.0, -1.0], len(corners))
    return sp.csr_matrix((values, (rows, column.ravel())), shape=(len(corners), len(edges)))


def three_in_space(trials: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Estimate the orientations of three nodes from mutual bearings, and compare with the bound.

    Returns
    -------
    A row for each shape and noise: root mean square rotation error of nodes 1 and 2 relative to
    node 0, its bound, their ratio, and the standard deviation of the error of the sum of the
    interior angles over ``sqrt(6) sigma``.
    """
    rows = []
    for (shape, places), sigma in itertools.product(SHAPES.items(), SPACE_STD_RAD):
        turned = rotations.random(rng, (trials, 3))
        seen = sensing.measure_in_space(places, turned, TRIANGLE_EDGES, sigma, rng)
        found = triangle_frames(seen)
        truth = np.swapaxes(turned[:, :1], -1, -2) @ turned
        error = rotations.log(found.rotation @ np.swapaxes(truth, -1, -2))[:, 1:]
        rmse = float(np.sqrt(np.mean(np.sum(error**2, axis=-1))))
        P = bounds.space_orientation_covariance(places, TRIANGLE_EDGES, sigma)
        bound = float(np.sqrt(np.trace(P) / 2))
        rows.append(
            {
                "shape": shape,
                "bearing_std_rad": sigma,
                "rmse_rad": rmse,
                "bound_rad": bound,
                "ratio": rmse / bound,
                "misfit": float(np.std(found.misfit) / (6**0.5 * sigma)),
            }
        )
    return rows
