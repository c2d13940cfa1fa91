"""Most likely pose of one body near a start: damped Gauss-Newton on SO(3) x R^3.

The textbook forms are `levenberg_marquardt.py` and `map_problem.py` in `estimators/costs/`.
"""

from __future__ import annotations

from typing import Any

from rbl_gym.kernels.jit import gufunc, helper, inlined
from rbl_gym.kernels.linear_algebra import cholesky6, solve_factored6
from rbl_gym.kernels.offsets import linearize_shifted
from rbl_gym.kernels.range_cost import linearize
from rbl_gym.kernels.rotations import compose, exp, left_jacobian_inverse, log
from rbl_gym.kernels.workspace import workspace

# Largest step (rad, m) on any axis.
_LONGEST = 1e12


@inlined
def add_prior(
    Q: Any, t: Any, Q0: Any, t0: Any, information: Any, D: Any, e: Any, g: Any, H: Any
) -> float:
    """Add a prior's gradient and Hessian; return its cost, half of ``e^T I e``.

    ``e = (log(Q Q0^T), t - t0)``, and its derivative is ``blkdiag(Jl^-1, I)``. D (3, 3) and e (6,)
    are workspace.
    """
    at_prior = True
    for i in range(3):
        at_prior = at_prior and t[i] == t0[i]
        for j in range(3):
            at_prior = at_prior and Q[i, j] == Q0[i, j]
    if at_prior:
        for i in range(6):
            for j in range(i + 1):
                H[i, j] += information[i, j]
        return 0.0
    for i in range(3):
        e[3 + i] = t[i] - t0[i]
        for j in range(3):
            D[i, j] = Q[i, 0] * Q0[j, 0] + Q[i, 1] * Q0[j, 1] + Q[i, 2] * Q0[j, 2]
    e[0], e[1], e[2] = log(D)
    left_jacobian_inverse(e[0], e[1], e[2], D)
    cost = 0.0
    for i in range(6):
        pull = 0.0
        for j in range(6):
            pull += information[i, j] * e[j]
        cost += 0.5 * e[i] * pull
        if i >= 3:
            g[i] += pull
        else:
            for j in range(3):
                g[j] += D[i, j] * pull
    for j in range(3):
        # Column j of I blkdiag(D, I), its rows of the rotation and of the translation.
        x = information[0, 0] * D[0, j] + information[0, 1] * D[1, j] + information[0, 2] * D[2, j]
        y = information[1, 0] * D[0, j] + information[1, 1] * D[1, j] + information[1, 2] * D[2, j]
        z = information[2, 0] * D[0, j] + information[2, 1] * D[1, j] + information[2, 2] * D[2, j]
        for i in range(j, 3):
            H[i, j] += D[0, i] * x + D[1, i] * y + D[2, i] * z
            H[3 + i, 3 + j] += information[3 + i, 3 + j]
        for i in range(3, 6):
            H[i, j] += (
                information[i, 0] * D[0, j]
                + information[i, 1] * D[1, j]
                + information[i, 2] * D[2, j]
            )
    return cost


@inlined
def solve(
    Q: Any, t: Any, has_prior: bool, Q0: Any, t0: Any, information: Any,
    ranges: Any, weights: Any, anchors: Any, tags: Any, loss: Any, offset: int,
    iterations: int, tolerance: float, g: Any, H: Any,
) -> tuple[float, bool]:  # fmt: skip
    """Move the pose (Q, t) to the nearest minimum; return its cost and whether it converged.

    `offset` is the kind of the ranges' offsets, as in `kernels.offsets`, 0 for none. g and H become
    the gradient and the lower half of the Hessian at the minimum. Without a prior, `information` is
    not read.
    """
    L, new_H = workspace((6, 6)), workspace((6, 6))
    new_g, step, e = workspace((6,)), workspace((6,)), workspace((6,))
    new_Q, turn, D, new_t = workspace((3, 3)), workspace((3, 3)), workspace((3, 3)), workspace((3,))
    copy_pose(Q, t, new_Q, new_t)
    cost, decrease, damping, converged = 0.0, 0.0, 0.0, False
    for k in range(iterations + 1):
        if offset == 0:
            new = linearize(new_Q, new_t, ranges, weights, anchors, tags, loss, new_g, new_H)
        else:
            new = linearize_shifted(
                new_Q, new_t, ranges, weights, anchors, tags, loss, offset, new_g, new_H
            )
        if has_prior:
            new += add_prior(new_Q, new_t, Q0, t0, information, D, e, new_g, new_H)
        # A step of 1e-4 standard deviations changes the cost by less than rounding errors.
        if k == 0 or new <= cost * (1 + 1e-12) or decrease < 1e-8:
            cost = new
            damping = 0.1 * damping if damping > 1e-5 else 0.0
            copy_pose(new_Q, new_t, Q, t)
            for i in range(6):
                g[i] = new_g[i]
                for j in range(i + 1):
                    H[i, j] = new_H[i, j]
        else:
            damping = max(10 * damping, 1e-3)
        # Damping shortens the step by about 1 + damping: a short step alone does not prove
        # convergence.
        converged = k > 0 and decrease < tolerance * tolerance
        if converged or k == iterations:
            break
        for i in range(6):
            for j in range(i):
                new_H[i, j] = H[i, j]
            new_H[i, i] = H[i, i] * (1 + damping + 1e-14) + 1e-300
        cholesky6(new_H, L)
        solve_factored6(L, g, step)
        decrease = 0.0
        for i in range(6):
            step[i] = min(max(-step[i], -_LONGEST), _LONGEST)
            decrease -= g[i] * step[i]
        decrease *= 1 + damping
        exp(step[0], step[1], step[2], turn)
        compose(turn, Q, new_Q)
        for i in range(3):
            new_t[i] = t[i] + step[3 + i]
    return cost, converged


@inlined
def copy_pose(Q0: Any, t0: Any, Q: Any, t: Any) -> None:
    """``Q[:], t[:] = Q0, t0``."""
    for i in range(3):
        t[i] = t0[i]
        for j in range(3):
            Q[i, j] = Q0[i, j]


@helper
def mirror(H: Any) -> None:
    """Copy the lower half of a symmetric matrix to its upper half."""
    for i in range(H.shape[0]):
        for j in range(i):
            H[j, i] = H[i, j]


@gufunc(
    "(d,d),(d),(d,d),(d),(p,p),(m,n),(m,n),(m,d),(n,d),(l),(),(),()->(d,d),(d),(),(p),(p,p),()",
    "ffffffffffiiffffffb",
)
def minimize(
    start_Q, start_t, Q0, t0, information, ranges, weights, anchors, tags, loss, offset,
    iterations, tolerance, Q, t, cost, g, H, converged,
):  # fmt: skip
    """Run `solve` from a start; without a prior if its information is zero."""
    copy_pose(start_Q, start_t, Q, t)
    has_prior = False
    for i in range(6):
        has_prior = has_prior or information[i, i] != 0.0
    cost[0], converged[0] = solve(
        Q, t, has_prior, Q0, t0, information, ranges, weights, anchors, tags, loss, offset,
        iterations, tolerance, g, H,
    )  # fmt: skip
    mirror(H)
