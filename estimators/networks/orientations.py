"""Orientations of the nodes of a planar network from its edge angles.

The maximum-likelihood orientations minimise the sum of squared wrapped residuals
``proj(y - B theta)``, each over its variance. From the chordal start this takes a few solves with
one factorised graph Laplacian, for any number of cycles.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_one_of
from rbl_gym.estimators.networks.consensus import cycle_consensus
from rbl_gym.networks.edges import IntArray
from rbl_gym.networks.graphs import check_connected, spanning_tree, sum_to_root
from rbl_gym.networks.sensing import check_edge_angles, check_edge_values, proj

# A step is exact to rounding once no residual wraps; the next one is far below this.
_SETTLED_RAD = 1e-10
_MAX_STEPS = 100
# Least weight relative to the largest. Rounding would rotate two parts joined only by lighter
# edges.
LEAST_WEIGHT = 1e-12
_SMALLEST = 5e-324
_DENSE = 50  # nodes up to which all eigenvectors are computed
# Pivots of the dual matrix below this fraction of the sum of a node's weights count as zero.
_PIVOT_FLOOR = 1e-10


class ChordalOptimum(NamedTuple):
    """A stationary point of the chordal cost, and whether it is proved to be the global minimum."""

    theta: FloatArray  # (n,) radians, 0 at node 0
    # Sum of w |e^{i theta_j} - e^{i y} e^{i theta_i}|^2 = 2 w (1 - cos residual).
    cost: float
    certified: bool


def orientations(
    edges: ArrayLike,
    y: ArrayLike,
    n_nodes: int,
    method: str = "ml",
    *,
    weights: ArrayLike | None = None,
    **options: Any,
) -> FloatArray:
    """Estimate orientations (n,) of the nodes relative to node 0, radians in [-pi, pi).

    Parameters
    ----------
    edges, y, n_nodes
        (m, 2) and (m,) of a connected graph; y estimates ``theta_j - theta_i``, radians. An
        edge may occur twice. A single node has orientation 0.
    method
        ``"ml"``: least squares of the wrapped residuals from the chordal start. ``"chordal"``:
        phases of the complex least squares with ``z_0 = 1``. ``"cycle"``: the cycle iteration
        (14), then along a tree. ``"tree"``: y along the breadth-first tree. ``"spectral"``:
        phases of the eigenvector of the connection Laplacian's smallest eigenvalue.
    weights
        (m,) above 0: the information of each y (1 / variance), in any unit. Every weight must be
        at least `LEAST_WEIGHT` of the largest, because of rounding. None: equal weights. The
        methods ``"cycle"`` and ``"tree"`` accept no weights.
    options
        Options of `cycle_consensus`, with ``"cycle"``.

    Raises
    ------
    ValueError
        If the graph is not connected (the message names the components), or an argument is
        invalid.
    """
    check_one_of("method", method, tuple(METHODS))
    edges = check_connected(edges, n_nodes)
    y = check_edge_angles(y, edges)
    if options and method != "cycle":
        raise ValueError(f"options are allowed only with the method 'cycle', got {sorted(options)}")
    if weights is not None:
        if method not in _WEIGHTED:
            raise ValueError(
                f"weights must be None with the method {method!r}, got {weights!r:.80}"
            )
        weights = check_weights(weights, edges)
        options = {"weights": weights / weights.max(initial=_SMALLEST)}
    return proj(METHODS[method](edges, y, n_nodes, **options))


def cost(
    edges: ArrayLike, y: ArrayLike, theta: ArrayLike, weights: ArrayLike | None = None
) -> float:
    """Return the sum of squared wrapped residuals ``proj(y - (theta_j - theta_i))``, rad^2.

    With weights (m,), the sum is weighted.
    """
    residual = residuals(np.asarray(edges), np.asarray(y), np.asarray(theta))
    return float(residual @ residual if weights is None else residual**2 @ np.asarray(weights))


def check_weights(weights: ArrayLike | None, edges: IntArray) -> FloatArray:
    """Return checked `weights` of edges (m,), ones for None, or raise ValueError."""
    if weights is None:
        return np.ones(len(edges))
    array = check_edge_values("weights", weights, edges)
    if (array <= 0).any():
        row = int(np.argmax(array <= 0))
        raise ValueError(f"weights must be above 0, got {array[row]:g} at index {row}")
    if len(array) and array.min() < LEAST_WEIGHT * array.max():
        row = int(np.argmin(array))
        raise ValueError(
            f"weights must be at least {LEAST_WEIGHT:g} of the largest, "
            f"{array.max():g}, got {array[row]:g} at index {row}"
        )
    return array


def residuals(edges: IntArray, y: FloatArray, theta: FloatArray) -> FloatArray:
    """Return the wrapped residuals (m,)."""
    return proj(y - (theta[edges[:, 1]] - theta[edges[:, 0]])) if len(edges) else np.zeros(0)


def along_tree(edges: IntArray, y: FloatArray, n_nodes: int) -> FloatArray:
    """Return orientations (n,) summed along the breadth-first tree, not wrapped."""
    tree = spanning_tree(edges, n_nodes)
    return sum_to_root(tree.parent, y[tree.edge] * tree.sign if len(y) else np.zeros(1))


def chordal(
    edges: IntArray, y: FloatArray, n_nodes: int, weights: FloatArray | None = None
) -> FloatArray:
    """Return phases (n,) of ``min sum w |z_j - e^{iy} z_i|^2`` with ``z_0 = 1``."""
    return _chordal(edges, y, n_nodes, check_weights(weights, edges))[0]


def _chordal(
    edges: IntArray, y: FloatArray, n_nodes: int, weights: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return `chordal`, and the rank (n,) of the nodes in elimination order, node 0 first."""
    if n_nodes == 1:
        return np.zeros(1), np.zeros(1, dtype=np.intp)
    L = _laplacian(edges, weights * np.exp(-1j * y), n_nodes)
    right = -L[1:, [0]].toarray().ravel()
    factors = _factorised(L[1:, 1:])
    phases = np.angle(factors.solve(right))
    return np.concatenate([[0.0], phases]), np.concatenate([[0], 1 + factors.perm_c])


def maximum_likelihood(
    edges: IntArray,
    y: FloatArray,
    n_nodes: int,
    start: FloatArray | None = None,
    weights: FloatArray | None = None,
) -> FloatArray:
    """Return the weighted least squares (n,) of the wrapped residuals.

    Gauss-Newton steps wrap the residuals anew. All use one factorisation of the Laplacian. Once no
    residual wraps, a step is exact. `start` (n,) replaces the chordal start.
    """
    if n_nodes == 1:
        return np.zeros(1)
    weights = check_weights(weights, edges)
    theta, rank = _chordal(edges, y, n_nodes, weights) if start is None else (start, None)
    # Reuse the order of elimination of the chordal system for the nodes.
    names = np.arange(n_nodes) if rank is None else rank
    named = names[edges]
    at = np.empty(n_nodes)
    at[names] = theta
    L = _laplacian(named, weights, n_nodes)
    solve = _factorised(L[1:, 1:], "MMD_AT_PLUS_A" if rank is None else "NATURAL").solve
    for _ in range(_MAX_STEPS):
        step = solve(_gathered(named, weights * residuals(named, y, at), n_nodes)[1:])
        at[1:] += step
        if np.abs(step).max() <= _SETTLED_RAD:
            break
    return at[names]


def spectral(
    edges: IntArray, y: FloatArray, n_nodes: int, weights: FloatArray | None = None
) -> FloatArray:
    """Return phases (n,) of the eigenvector of the connection Laplacian's smallest eigenvalue."""
    weights = check_weights(weights, edges)
    # Scaled to mean weight 1, so that the shift below is small in comparison.
    weights = weights / weights.mean() if len(weights) else weights
    L = _laplacian(edges, weights * np.exp(-1j * y), n_nodes)
    if n_nodes <= _DENSE:
        vector = np.linalg.eigh(L.toarray())[1][:, 0]
    else:
        start = np.exp(1j * along_tree(edges, y, n_nodes))
        vector = scipy.sparse.linalg.eigsh(L, k=1, sigma=-1e-6, v0=start)[1][:, 0]
    phases = np.angle(vector)
    return phases - phases[0]


def _cycle(edges: IntArray, y: FloatArray, n_nodes: int, **options: Any) -> FloatArray:
    return along_tree(edges, cycle_consensus(edges, y, n_nodes, **options), n_nodes)


METHODS = {
    "ml": maximum_likelihood,
    "chordal": chordal,
    "cycle": _cycle,
    "tree": along_tree,
    "spectral": spectral,
}
_WEIGHTED = ("ml", "chordal", "spectral")


def chordal_optimum(
    edges: ArrayLike,
    y: ArrayLike,
    n_nodes: int,
    start: ArrayLike | None = None,
    weights: ArrayLike | None = None,
) -> ChordalOptimum:
    """Minimise the chordal cost ``sum 2 w (1 - cos(y - theta_j + theta_i))``, with a proof.

    At a stationary point z the dual matrix is the connection Laplacian less a diagonal that
    makes ``S z = 0``. If S is positive semidefinite, no other z has a lower cost. Positive
    pivots without node 0 prove this.

    Parameters
    ----------
    edges, y, n_nodes
        As in `orientations`.
    start
        (n,) radians; None: the maximum-likelihood orientations.
    weights
        As in `orientations`.

    Raises
    ------
    ValueError
        As in `orientations`, and if the start has a wrong shape.
    """
    edges = check_connected(edges, n_nodes)
    y = check_edge_angles(y, edges)
    weights = check_weights(weights, edges)
    unit = float(weights.max(initial=_SMALLEST))
    weights = weights / unit
    if n_nodes == 1:
        return ChordalOptimum(np.zeros(1), 0.0, True)
    if start is None:
        theta = maximum_likelihood(edges, y, n_nodes, weights=weights)
    else:
        theta = check_array("start", start, (n_nodes,))
        if theta.ndim != 1:
            raise ValueError(f"start must have shape ({n_nodes},), got {theta.shape}")
        theta = theta - theta[0]
    for _ in range(_MAX_STEPS):
        residual = residuals(edges, y, theta)
        # Newton's curvature, bounded from below.
        curvature = weights * np.maximum(np.cos(residual), 0.1)
        L = _laplacian(edges, curvature, n_nodes)
        slope = _gathered(edges, weights * np.sin(residual), n_nodes)
        step = _factorised(L[1:, 1:]).solve(slope[1:])
        theta = theta + np.concatenate([[0.0], step])
        if np.abs(step).max() <= _SETTLED_RAD:
            break
    residual = residuals(edges, y, theta)
    value = float(unit * 4 * weights @ np.sin(residual / 2) ** 2)
    certified = _is_positive(_dual(edges, residual, n_nodes, weights)[1:, 1:])
    return ChordalOptimum(proj(theta), value, certified)


def _dual(
    edges: IntArray, residual: FloatArray, n_nodes: int, weights: FloatArray | None = None
) -> scipy.sparse.csc_matrix:
    """Return the dual matrix in the gauge of the solution, in which its null vector is 1.

    Rows and columns are divided by the roots of the nodes' sums of weights. This keeps
    definiteness, and makes pivots relative to the weights of their own node.
    """
    weights = check_weights(weights, edges)
    L = _laplacian(edges, weights * np.exp(-1j * residual), n_nodes)
    fitted = np.bincount(edges.ravel(), np.repeat(weights * np.cos(residual), 2), n_nodes)
    scale = scipy.sparse.diags(1 / np.sqrt(L.diagonal().real))
    return scipy.sparse.csc_matrix(scale @ (L + scipy.sparse.diags(fitted - L.diagonal())) @ scale)


def _is_positive(S: scipy.sparse.csc_matrix) -> bool:
    """Return whether a Hermitian matrix has only positive pivots, in symmetric elimination."""
    try:
        factors = _factorised(S)
    except RuntimeError:  # exactly singular
        return False
    in_order = np.array_equal(factors.perm_r, factors.perm_c)
    pivots = factors.U.diagonal().real
    return bool(in_order and (pivots > _PIVOT_FLOOR).all())


def _laplacian(edges: IntArray, links: np.ndarray, n_nodes: int) -> scipy.sparse.csc_matrix:
    """Return the Laplacian of complex links.

    It is the Hermitian matrix with ``-links`` at (i, j), their conjugates at (j, i), and the sums
    of their absolute values on the diagonal. For weights it is the graph Laplacian, for ``e^{-iy}``
    the connection Laplacian.
    """
    i, j = edges.T
    nodes = np.arange(n_nodes)
    degree = np.bincount(edges.ravel(), np.repeat(np.abs(links), 2), n_nodes)
    values = np.concatenate([-links, -np.conj(links), degree])
    rows, columns = np.concatenate([i, j, nodes]), np.concatenate([j, i, nodes])
    return scipy.sparse.csc_matrix((values, (rows, columns)), shape=(n_nodes, n_nodes))


def _factorised(A: scipy.sparse.csc_matrix, order: str = "MMD_AT_PLUS_A") -> Any:
    """Factorise a Hermitian matrix with diagonal pivots, in minimum-degree or natural order."""
    return scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(A),
        permc_spec=order,
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _gathered(edges: IntArray, values: FloatArray, n_nodes: int) -> FloatArray:
    """Return ``B^T values`` (n,)."""
    into, out = (np.bincount(edges[:, k], values, n_nodes) for k in (1, 0))
    return into - out  # pyrefly: ignore[bad-return]
