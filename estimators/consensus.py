"""Edge angles made consistent around cycles: the ring's least squares, the cycle iteration.

True edge angles sum to a multiple of 2 pi around every cycle, ``C psi = 2 pi k``. Measured
ones, y, do not; which k is meant is the branch. On a branch the least squares are a projection;
the iteration (14) reaches it with exchanges inside of each cycle only.
"""

# scipy.sparse comes without stubs, and pyright's guesses of it are wrong.
# pyright: reportOptionalSubscript=false, reportArgumentType=false
from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import ArrayLike, NDArray

from rbl_gym.checks import (
    FloatArray,
    check_array,
    check_count,
    check_generator,
    check_number,
    check_one_of,
)
from rbl_gym.network_graphs import BASES, check_connected, cycle_matrix
from rbl_gym.sensing_network import check_edge_angles, proj

_TURN = 2 * np.pi
_DENSE = 1500  # cycles up to which all eigenvalues are computed
ORDERS = ("synchronous", "asynchronous")
STEP_BOUNDS = ("rows", "product")


class CycleRun(NamedTuple):
    """A run of the cycle iteration."""

    psi: FloatArray  # (m,) consistent edge angles, radians, not wrapped
    branch: NDArray[np.intp]  # (q,) k of ``C psi = 2 pi k`` at the end
    steps: int  # of all cycles; asynchronous: rounds in which each cycle had its turn
    kappa: float | None  # None: each cycle divides by its length
    converged: bool
    history: FloatArray | None  # (steps + 1, m), y first


def ring_least_squares(y: ArrayLike) -> FloatArray:
    """Least-squares edge angles of one ring, (12)-(13): ``y - proj(sum y) / n``.

    Parameters
    ----------
    y
        (..., n) edge angles, all along the ring (1 to 2, 2 to 3, ..., n to 1), radians.
    """
    y = check_array("y", y, ("n",))
    return y - proj(y.sum(axis=-1, keepdims=True)) / y.shape[-1]


def eigenvalues(C: sp.csr_matrix) -> tuple[float, float]:
    """Smallest and largest eigenvalue of ``F = C C^T``; 1 and 1 where there is no cycle."""
    if C.shape[0] == 0:
        return 1.0, 1.0
    F = (C @ C.T).tocsc()
    if C.shape[0] <= _DENSE:
        values = np.linalg.eigvalsh(F.toarray())
        return float(values[0]), float(values[-1])
    start = np.ones(C.shape[0])
    high = sp.linalg.eigsh(F, k=1, v0=start, return_eigenvectors=False)
    low = sp.linalg.eigsh(F, k=1, sigma=0.0, v0=start, return_eigenvectors=False)
    return float(low[0]), float(high[0])


def largest_eigenvalue(C: sp.csr_matrix) -> float:
    """Largest eigenvalue of ``C C^T``."""
    if min(C.shape) <= 2 or C.shape[0] <= _DENSE:
        return eigenvalues(C)[1]
    start = np.ones(C.shape[0])
    return float(sp.linalg.eigsh(C @ C.T, k=1, v0=start, return_eigenvectors=False)[0])


def step_size(C: sp.csr_matrix, rule: str | None = None) -> float:
    """Step kappa of the cycle iteration; it converges where ``kappa < 2 / lambda_max(C C^T)``.

    Parameters
    ----------
    C
        Cycle matrix (q, m).
    rule
        None: ``2 / (1 + lambda_max)``, the fastest for the cycles of a spanning tree, whose
        smallest eigenvalue is at least 1. Bounds that cycles can agree on among neighbours, for
        lambda_max in its place: ``"rows"``, the largest row sum of ``|C C^T|`` (how many edges a
        cycle shares with all); ``"product"``, the longest cycle times the most cycles through
        an edge.
    """
    if rule is None:
        return 2.0 / (1.0 + largest_eigenvalue(C))
    check_one_of("kappa", rule, STEP_BOUNDS)
    if C.shape[0] == 0:
        return 1.0
    if rule == "rows":
        bound = abs(C @ C.T).sum(axis=1).max()
    else:
        bound = abs(C).sum(axis=1).max() * abs(C).sum(axis=0).max()
    return 2.0 / (1.0 + float(bound))


def convergence_factor(C: sp.csr_matrix, kappa: float) -> float:
    """Factor of a step on the error: ``max |1 - kappa lambda_i|`` over the eigenvalues of C C^T."""
    low, high = eigenvalues(C)
    return max(abs(1 - kappa * low), abs(1 - kappa * high))


def printed_factor(C: sp.csr_matrix, kappa: float) -> float:
    """Theorem 19's factor ``1 - kappa (2 - kappa lambda_max)``, of the SQUARED error.

    True for the cycles of a spanning tree only, where ``lambda_min >= 1``.
    """
    return 1 - kappa * (2 - kappa * largest_eigenvalue(C))


def cycle_projection(C: sp.csr_matrix, y: ArrayLike, branch: ArrayLike | None = None) -> FloatArray:
    """Least-squares edge angles (m,) with ``C psi = 2 pi k``, exactly.

    Parameters
    ----------
    C, y
        Cycle matrix (q, m) and edge angles (m,).
    branch
        k (q,), whole numbers; None: the nearest, cycle by cycle.

    Raises
    ------
    ValueError
        On another shape, or a branch that is not of whole numbers.
    """
    C = sp.csr_matrix(C)
    y = check_array("y", y, (C.shape[1],)) if C.shape[1] else np.zeros(0)
    if y.ndim != 1:
        raise ValueError(f"y must have shape ({C.shape[1]},), got {y.shape}")
    if C.shape[0] == 0:
        return y.copy()
    off = _around(C @ y, None if branch is None else _TURN * _whole(branch, C.shape[0]))
    return y - C.T @ scipy.sparse.linalg.spsolve((C @ C.T).tocsc(), off)


def cycle_consensus(
    edges: ArrayLike,
    y: ArrayLike,
    n_nodes: int,
    cycles: str | sp.csr_matrix = "bfs",
    kappa: float | str | None = None,
    **options: object,
) -> FloatArray:
    """Consistent edge angles psi (m,) by the cycle iteration (14); `cycle_iteration`'s `psi`.

    Arguments as `cycle_iteration`.

    Raises
    ------
    ValueError
        As `cycle_iteration`.
    RuntimeError
        If it does not converge in `max_steps`.
    """
    run = cycle_iteration(edges, y, n_nodes, cycles, kappa, **options)  # pyright: ignore[reportArgumentType]
    if not run.converged:
        raise RuntimeError(f"the cycle iteration did not converge in {run.steps} steps")
    return run.psi


def cycle_iteration(
    edges: ArrayLike,
    y: ArrayLike,
    n_nodes: int,
    cycles: str | sp.csr_matrix = "bfs",
    kappa: float | str | None = None,
    *,
    tol: float = 1e-12,
    max_steps: int = 100_000,
    history: bool = False,
    order: str = "synchronous",
    rng: np.random.Generator | None = None,
    loss: float = 0.0,
    branch: ArrayLike | None = None,
) -> CycleRun:
    """The cycle-distributed iteration, (14): ``psi <- psi - kappa C^T proj(C psi)`` from y.

    Parameters
    ----------
    edges, y, n_nodes
        (m, 2) and (m,) of a connected graph; y estimates ``theta_j - theta_i``, radians.
    cycles
        A basis of `network_graphs.cycle_matrix`, or a cycle matrix of one's own.
    kappa
        Step; None or a rule of `step_size`. Asynchronous: a number, or None for one over the
        length of the cycle, which no cycle has to ask another for.
    tol, max_steps
        It ends when the cycles' remaining ``proj(C psi)`` has a norm of at most `tol`, or after
        so many steps.
    history
        Whether to keep all psi on the way.
    order
        ``"synchronous"``, or ``"asynchronous"``: one cycle at a time, in random order.
    rng
        Source of the order and of losses.
    loss
        Probability that a cycle's message is lost on its way around: its turn then passes
        without effect.
    branch
        k (q,) of ``C psi = 2 pi k``, whole numbers, where it is known, for instance from an
        earlier estimate; None: each cycle takes the nearest, at every step.

    Raises
    ------
    ValueError
        If the graph is not connected, or kappa is not in ``(0, 2 / lambda_max)``.
    """
    edges = check_connected(edges, n_nodes)
    psi = check_edge_angles(y, edges).copy()
    C = cycle_matrix(edges, n_nodes, check_one_of("cycles", cycles, BASES)) \
        if isinstance(cycles, str) else sp.csr_matrix(cycles)  # fmt: skip
    if C.shape[1] != len(edges):
        raise ValueError(f"cycles must have a column per edge, {len(edges)}, got {C.shape}")
    check_one_of("order", order, ORDERS)
    tol = check_number("tol", tol, low=0.0)
    max_steps = check_count("max_steps", max_steps, least=0)
    loss = check_number("loss", loss, low=0.0, high=1.0)
    one_by_one = order == "asynchronous"
    if one_by_one or loss:
        check_generator("rng", rng)
    step = _step(C, kappa, one_by_one)
    target = None if branch is None else _TURN * _whole(branch, C.shape[0])
    lengths = np.maximum(np.diff(C.indptr), 1)
    gain = 1 / lengths if step is None else np.full(len(lengths), step)
    kept = [psi.copy()] if history else None
    transposed = C.T.tocsr()
    steps, converged = 0, False
    while not (converged := bool(np.linalg.norm(off := _around(C @ psi, target)) <= tol)):
        if steps == max_steps:
            break
        heard = np.ones(len(off), dtype=np.bool_) if not loss else rng.random(len(off)) >= loss  # pyright: ignore[reportOptionalMemberAccess]
        if one_by_one:
            turns = rng.permutation(len(off))  # pyright: ignore[reportOptionalMemberAccess]
            _one_by_one(C, psi, gain, target, turns[heard[turns]])
        else:
            psi -= transposed @ (gain * off * heard)
        steps += 1
        if kept is not None:
            kept.append(psi.copy())
    reached = np.rint((C @ psi - off) / _TURN).astype(np.intp)
    return CycleRun(psi, reached, steps, step, converged, None if kept is None else np.array(kept))


def _step(C: sp.csr_matrix, kappa: float | str | None, one_by_one: bool) -> float | None:
    """Step to use, checked against the true condition; None: one over the cycle's length."""
    if one_by_one and kappa is None:
        return None
    if kappa is None or isinstance(kappa, str):
        return step_size(C, kappa)
    # One cycle alone is a row of C C^T: its length is the eigenvalue.
    limit = 2 / max(np.diff(C.indptr).max(initial=1) if one_by_one else largest_eigenvalue(C), 1.0)
    kappa = check_number("kappa", kappa)
    if not 0 < kappa < limit:
        raise ValueError(f"kappa must lie in (0, {limit:.6g}) to converge, got {kappa:g}")
    return kappa


def _whole(branch: ArrayLike, size: int) -> FloatArray:
    array = check_array("branch", branch, (size,)) if size else np.zeros(0)
    if array.shape != (size,) or (array != np.rint(array)).any():
        raise ValueError(f"branch must be {size} whole numbers, one a cycle, got {branch!r:.80}")
    return array


def _around(sums: FloatArray, target: FloatArray | None) -> FloatArray:
    """What is left of the cycles' sums: to the nearest multiple of 2 pi, or to the target."""
    return proj(sums) if target is None else sums - target


def _one_by_one(
    C: sp.csr_matrix, psi: FloatArray, gain: FloatArray, target: FloatArray | None,
    turns: NDArray[np.intp],
) -> None:  # fmt: skip
    """Each cycle of `turns` in its turn, on the edges as they are by then."""
    for row in turns:
        part = slice(C.indptr[row], C.indptr[row + 1])
        edges, signs = C.indices[part], C.data[part]
        left = _around(signs @ psi[edges], None if target is None else target[row])
        psi[edges] -= gain[row] * float(left) * signs
