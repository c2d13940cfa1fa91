"""Consistent edge angles around cycles: least squares of a ring, and the cycle iteration.

True edge angles sum to a multiple of 2 pi around every cycle, ``C psi = 2 pi k``. Measured angles y
do not. The integers k are the branch. On a branch, the least-squares solution is a projection. The
iteration (14) converges to it with exchanges only inside each cycle. The cycles may be any set,
also dependent ones; then not every k has a solution psi.

Source: G. Piovan, I. Shames, B. Fidan, F. Bullo, B. D. O. Anderson, "On frame and orientation
localization for relative sensing networks". Equation numbers are those of the paper.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from rbl_gym.checks import (
    FloatArray,
    check_array,
    check_count,
    check_generator,
    check_number,
    check_one_of,
)
from rbl_gym.networks.graphs import BASES, CYCLES, check_connected, check_cycles, cycle_matrix
from rbl_gym.networks.sensing import check_edge_angles, proj

_TURN = 2 * np.pi
_DENSE = 1500  # cycles or edges up to which matrices are dense
_ZERO = 1e-9  # eigenvalues and pivots below this fraction of the largest are zero
_PATIENCE = 100  # rounds of random order after which branches count as contradictory
ORDERS = ("synchronous", "asynchronous")
STEP_RULES = ("theorem", "best", "trace", "rows")


class CycleExchange(NamedTuple):
    """Communication between the cycles of `cycle_iteration`.

    With `order` ``"synchronous"`` all cycles correct their edges at once; with ``"asynchronous"``
    one cycle at a time, in random order. `rng` draws the order and the losses. `loss` is the
    probability that a message is lost; then the cycle makes no correction in its turn.
    """

    order: str = "synchronous"
    rng: np.random.Generator | None = None
    loss: float = 0.0


class CycleRun(NamedTuple):
    """Result of the cycle iteration."""

    psi: FloatArray  # (m,) consistent edge angles, radians, not wrapped
    branch: NDArray[np.intp]  # (q,) k of ``C psi = 2 pi k`` at the end
    steps: int  # of all cycles; asynchronous: rounds with one turn of each cycle
    kappa: float | None  # None: each cycle divides by its length
    converged: bool  # all cycle errors are zero to the tolerance
    consistent: bool  # False: the branches are contradictory, no psi satisfies all cycles
    history: FloatArray | None  # (steps + 1, m), y first


def ring_least_squares(y: ArrayLike) -> FloatArray:
    """Return least-squares edge angles of one ring, (12)-(13): ``y - proj(sum y) / n``.

    Parameters
    ----------
    y
        (..., n) edge angles, all in the same direction of the ring (1 to 2, 2 to 3, ..., n to 1),
        radians.
    """
    y = check_array("y", y, ("n",))
    return y - proj(y.sum(axis=-1, keepdims=True)) / y.shape[-1]


def eigenvalues(C: scipy.sparse.csr_matrix) -> tuple[float, float]:
    """Return the smallest nonzero and the largest eigenvalue of ``F = C C^T``; 1, 1 without cycles.

    ValueError if there are more than 1500 dependent cycles over more than 1500 edges.
    """
    if C.shape[0] == 0:
        return 1.0, 1.0
    if min(C.shape) <= _DENSE:
        # C^T C has the same eigenvalues.
        gram = C @ C.T if C.shape[0] <= C.shape[1] else C.T @ C
        values = np.linalg.eigvalsh(gram.toarray())
        values = values[values > _ZERO * values[-1]]
        return float(values[0]), float(values[-1])
    F, start = (C @ C.T).tocsc(), np.ones(C.shape[0])
    high = scipy.sparse.linalg.eigsh(F, k=1, v0=start, return_eigenvectors=False)
    # The shift keeps the matrix definite.
    low = scipy.sparse.linalg.eigsh(F, k=1, sigma=-1e-6, v0=start, return_eigenvectors=False)
    if low[0] <= _ZERO * high[0]:
        raise ValueError(
            f"at most {_DENSE} cycles may be linearly dependent, got {C.shape[0]}: use "
            "cycles='bfs', which are independent"
        )
    return float(low[0]), float(high[0])


def largest_eigenvalue(C: scipy.sparse.csr_matrix) -> float:
    """Return the largest eigenvalue of ``C C^T``."""
    if min(C.shape) <= max(_DENSE, 2):
        return eigenvalues(C)[1]
    start = np.ones(C.shape[0])
    return float(scipy.sparse.linalg.eigsh(C @ C.T, k=1, v0=start, return_eigenvectors=False)[0])


def step_size(C: scipy.sparse.csr_matrix, rule: str = "theorem") -> float:
    """Return the step kappa of the cycle iteration by a rule; every rule converges.

    Parameters
    ----------
    C
        Cycle matrix (q, m); ``F = C C^T``.
    rule
        ``"theorem"``: ``2 / (1 + lambda_max(F))``, the bound of Theorem 19. ``"best"``: ``2 /
        (lambda_min + lambda_max)``, lambda_min the smallest nonzero eigenvalue: the fastest
        convergence. ``"trace"``: ``2 / (1 + sum of the cycles' lengths)``, Section IV-E; it needs
        only the lengths. ``"rows"`` (not in the paper): the largest row sum of ``|F|`` in place of
        lambda_max, so that cycles only need to know which edges they share.
    """
    check_one_of("kappa", rule, STEP_RULES)
    if C.shape[0] == 0:
        return 1.0
    if rule == "best":
        return 2.0 / sum(eigenvalues(C))
    if rule == "theorem":
        return 2.0 / (1.0 + largest_eigenvalue(C))
    return 2.0 / (1.0 + float(C.nnz if rule == "trace" else abs(C @ C.T).sum(axis=1).max()))


def convergence_factor(C: scipy.sparse.csr_matrix, kappa: float) -> float:
    """Return the error factor of a step: ``max |1 - kappa lambda_i|``, lambda_i nonzero of F."""
    low, high = eigenvalues(C)
    return max(abs(1 - kappa * low), abs(1 - kappa * high))


def printed_factor(kappa: float) -> float:
    """Return the factor ``(1 - kappa)^2`` of Theorem 19, of the SQUARED error.

    It holds if ``kappa <= 2 / (1 + lambda_max)`` and lambda_min is at least 1, as for the cycles of
    any spanning tree. Shorter cycles can have a smaller lambda_min, and converge more slowly than
    the theorem states. `convergence_factor` is the exact factor of the error itself.
    """
    return (1 - kappa) ** 2


def cycle_projection(
    C: scipy.sparse.csr_matrix, y: ArrayLike, branch: ArrayLike | None = None
) -> FloatArray:
    """Return least-squares edge angles (..., m) with ``C psi = 2 pi k`` exactly; (11) on a branch.

    Parameters
    ----------
    C, y
        Cycle matrix (q, m), of any cycles, and edge angles (..., m).
    branch
        Integers k (..., q); None: the nearest for each cycle.

    Raises
    ------
    ValueError
        If a shape is wrong, a branch is not an integer, or branches of dependent cycles are
        contradictory, so that no psi satisfies all of them.
    """
    C = scipy.sparse.csr_matrix(C)
    y = check_array("y", y, (C.shape[1],)) if C.shape[1] else np.zeros(0)
    if C.shape[0] == 0:
        return y.copy()
    target = None if branch is None else _TURN * _whole(branch, C.shape[0])
    sums = _times(C, y)
    off = _around(sums, target)
    shift = _least_norm(C, off)
    if not _solves(C, shift, off):
        wrong = np.abs(_times(C, shift) - off).max(axis=-1).argmax()
        raise ValueError(_contradiction(((sums - off) / _TURN).reshape(-1, C.shape[0])[wrong]))
    return y - shift


def _times(C: scipy.sparse.csr_matrix, x: FloatArray) -> FloatArray:
    """Return ``C x`` (..., q) of vectors (..., m)."""
    return (C @ x.reshape(-1, C.shape[1]).T).T.reshape(*x.shape[:-1], C.shape[0])


def _least_norm(C: scipy.sparse.csr_matrix, off: FloatArray) -> FloatArray:
    """Return the least-norm x (..., m) of ``C x = off``, in the least-squares sense."""
    right = off.reshape(-1, C.shape[0]).T
    return _least_norm_columns(C, right).T.reshape(*off.shape[:-1], C.shape[1])


def _least_norm_columns(C: scipy.sparse.csr_matrix, off: FloatArray) -> FloatArray:
    if C.shape[0] < C.shape[1]:
        try:
            factors = scipy.sparse.linalg.splu((C @ C.T).tocsc())
        except RuntimeError:  # exactly singular
            pass
        else:
            pivots = np.abs(factors.U.diagonal())
            if pivots.min() > _ZERO * pivots.max():
                return C.T @ factors.solve(off)
    if min(C.shape) > _DENSE:
        raise ValueError(
            f"at most {_DENSE} cycles may be linearly dependent, got {C.shape[0]}: use "
            "cycles='bfs', which are independent"
        )
    return np.linalg.lstsq(C.toarray(), off, rcond=_ZERO)[0]


def _solves(C: scipy.sparse.csr_matrix, x: FloatArray, off: FloatArray) -> bool:
    """Return whether ``C x = off`` up to rounding; without a solution the error is large."""
    return bool((np.abs(_times(C, x) - off) < 1e-6 * max(1.0, np.abs(off).max(initial=0.0))).all())


def _contradiction(branch: NDArray[Any]) -> str:
    named = np.rint(branch).astype(int).tolist()
    return (
        f"branch must be rint(C psi / 2 pi) for some angles psi, and no angles give {named!s:.80}, "
        "as the cycles are linearly dependent; independent cycles (cycles='bfs') take any branch"
    )


def cycle_consensus(
    edges: ArrayLike,
    y: ArrayLike,
    n_nodes: int,
    cycles: str | scipy.sparse.csr_matrix = "bfs",
    kappa: float | str | None = None,
    **options: object,
) -> FloatArray:
    """Return consistent edge angles psi (m,) by the cycle iteration (14).

    This is the `psi` of `cycle_iteration`. Arguments as `cycle_iteration`.

    Raises
    ------
    ValueError
        As in `cycle_iteration`.
    RuntimeError
        If it does not converge in `max_steps`, or the branches of dependent cycles are
        contradictory.
    """
    run = cycle_iteration(edges, y, n_nodes, cycles, kappa, **options)  # pyrefly: ignore[bad-argument-type]
    if not run.converged:
        why = "" if run.consistent else ": " + _contradiction(run.branch)
        raise RuntimeError(f"the cycle iteration did not converge in {run.steps} steps{why}")
    return run.psi


def cycle_iteration(
    edges: ArrayLike,
    y: ArrayLike,
    n_nodes: int,
    cycles: str | scipy.sparse.csr_matrix = "bfs",
    kappa: float | str | None = None,
    *,
    tol: float = 1e-12,
    max_steps: int = 100_000,
    history: bool = False,
    exchange: CycleExchange | None = None,
    branch: ArrayLike | None = None,
) -> CycleRun:
    """Run the cycle-distributed iteration (14), ``psi <- psi - kappa C^T proj(C psi)``, from y.

    Parameters
    ----------
    edges, y, n_nodes
        (m, 2) and (m,) of a connected graph; y estimates ``theta_j - theta_i``, radians.
    cycles
        A name of `graphs.cycle_matrix`, or a cycle matrix of any cycles.
    kappa
        Step, or a rule of `step_size`; None: "theorem". Asynchronous: a number, or None for one
        over the length of the cycle, which needs no exchange between cycles.
    tol, max_steps
        The iteration ends when the norm of the cycle errors ``proj(C psi)`` is at most `tol`, after
        `max_steps` steps, or when it stalls because no psi satisfies dependent cycles.
    history
        Whether to keep psi of all steps.
    exchange
        Order of the cycles, and losses; None: synchronous without losses.
    branch
        Integers k (q,) of ``C psi = 2 pi k`` if known, for instance from an earlier estimate; None:
        each cycle takes the nearest at every step.

    Raises
    ------
    ValueError
        If the graph is not connected, a row is not a cycle, kappa is not in ``(0, 2 /
        lambda_max)``, or the given branches are contradictory.

    Notes
    -----
    No step increases ``|proj(C psi)|``, so the iteration always settles.
    """
    edges = check_connected(edges, n_nodes)
    psi = check_edge_angles(y, edges).copy()
    C = (
        cycle_matrix(edges, n_nodes, check_one_of("cycles", cycles, CYCLES))
        if isinstance(cycles, str)
        else check_cycles(cycles, edges, n_nodes)
    )
    order, rng, loss = exchange or CycleExchange()
    check_one_of("order", order, ORDERS)
    loss = check_number("loss", loss, low=0.0, high=1.0)
    tol = check_number("tol", tol, low=0.0)
    max_steps = check_count("max_steps", max_steps, least=0)
    one_by_one = order == "asynchronous"
    if one_by_one or loss:
        check_generator("rng", rng)
    step = _step(C, kappa, one_by_one)
    target = None if branch is None else _TURN * _whole(branch, C.shape[0])
    if target is not None and target.ndim != 1:
        raise ValueError(f"branch must have shape ({C.shape[0]},), got {target.shape}")
    independent = isinstance(cycles, str) and cycles in BASES
    if target is not None and not independent and not _consistent(C, target / _TURN):
        raise ValueError(_contradiction(target / _TURN))
    lengths = np.maximum(np.diff(C.indptr), 1)
    gain = 1 / lengths if step is None else np.full(len(lengths), step)
    kept = [psi.copy()] if history else None
    transposed = C.T.tocsr()
    steps, since, consistent = 0, 0, independent
    seen: NDArray[np.intp] | None = None
    while True:
        sums = C @ psi
        off = _around(sums, target)
        reached = np.rint((sums - off) / _TURN).astype(np.intp)
        converged = bool(np.linalg.norm(off) <= tol)
        if converged or steps == max_steps:
            break
        if seen is None or (reached != seen).any():
            seen, since, consistent = reached, steps, independent
        pull = transposed @ (gain * off)
        rests = steps - since >= _PATIENCE if one_by_one or loss else np.linalg.norm(pull) <= tol
        if rests and not consistent:
            if not _consistent(C, reached):
                break
            consistent = True
        heard = np.ones(len(off), dtype=np.bool_) if not loss else rng.random(len(off)) >= loss  # pyrefly: ignore[missing-attribute]
        if one_by_one:
            turns = rng.permutation(len(off))  # pyrefly: ignore[missing-attribute]
            _one_by_one(C, psi, gain, target, turns[heard[turns]])
        else:
            psi -= pull if not loss else transposed @ (gain * off * heard)
        steps += 1
        if kept is not None:
            kept.append(psi.copy())
    consistent = converged or consistent or _consistent(C, reached)
    return CycleRun(
        psi, reached, steps, step, converged, consistent, None if kept is None else np.array(kept)
    )


def _consistent(C: scipy.sparse.csr_matrix, branch: NDArray[Any]) -> bool:
    """Return whether ``C psi = 2 pi k`` has a solution psi."""
    return _solves(C, _least_norm(C, branch.astype(float)), branch.astype(float))


def _step(C: scipy.sparse.csr_matrix, kappa: float | str | None, one_by_one: bool) -> float | None:
    """Return the step, checked against the exact condition; None: one over the cycle's length."""
    if one_by_one and kappa is None:
        return None
    if kappa is None or isinstance(kappa, str):
        return step_size(C, "theorem" if kappa is None else kappa)
    # For a single cycle the eigenvalue of C C^T is its length.
    limit = 2 / max(np.diff(C.indptr).max(initial=1) if one_by_one else largest_eigenvalue(C), 1.0)
    kappa = check_number("kappa", kappa)
    if not 0 < kappa < limit:
        raise ValueError(f"kappa must lie in (0, {limit:.6g}) to converge, got {kappa:g}")
    return kappa


def _whole(branch: ArrayLike, size: int) -> FloatArray:
    array = check_array("branch", branch, (size,)) if size else np.zeros(0)
    if (array != np.rint(array)).any():
        raise ValueError(
            f"branch must be {size} whole numbers, one for each cycle, got {branch!r:.80}"
        )
    return array


def _around(sums: FloatArray, target: FloatArray | None) -> FloatArray:
    """Return the cycle sums less the nearest multiple of 2 pi, or less the target."""
    return proj(sums) if target is None else sums - target


def _one_by_one(
    C: Any, psi: FloatArray, gain: FloatArray, target: FloatArray | None, turns: NDArray[np.intp]
) -> None:
    """Update each cycle of `turns` in order, with the current edges."""
    for row in turns:
        part = slice(C.indptr[row], C.indptr[row + 1])
        edges, signs = C.indices[part], C.data[part]
        left = _around(signs @ psi[edges], None if target is None else target[row])
        psi[edges] -= gain[row] * float(left) * signs
