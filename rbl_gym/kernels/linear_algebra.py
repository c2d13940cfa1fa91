"""Small symmetric positive definite matrices: Cholesky factor, solution, inverse.

The diagonal of a factor stores its inverse, so that solving only multiplies.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

from rbl_gym.kernels.jit import helper, inlined

# A smaller pivot, as a fraction of its diagonal entry, is due to rounding and raised to this.
PIVOT_FLOOR = 1e-14


@functools.cache
def of_size(size: int) -> tuple[Callable[..., Any], ...]:
    """Return `cholesky`, `solve_factored` and `invert_factored` for matrices of `size` rows.

    If the size is known at compilation they take little more than half the time. None of them reads
    above a diagonal. 0 means any size.
    """
    in_place = functools.partial(inlined, unrolled=True)

    @in_place
    def cholesky(A: Any, L: Any) -> bool:
        """Write the lower factor of A to L; return whether all pivots were positive.

        A pivot that is not positive is raised to a floor, so that a singular matrix has a very
        large inverse. NaN stays NaN.
        """
        n = size if size > 0 else A.shape[0]
        good = True
        for j in range(n):
            pivot = A[j, j]
            floor = PIVOT_FLOOR * pivot + 1e-300
            for k in range(j):
                pivot -= L[j, k] * L[j, k]
            if not pivot > floor:
                good = False
                if pivot == pivot:
                    pivot = max(floor, 1e-300)
            inverse = 1 / math.sqrt(pivot)
            L[j, j] = inverse
            for i in range(j + 1, n):
                total = A[i, j]
                for k in range(j):
                    total -= L[i, k] * L[j, k]
                L[i, j] = total * inverse
        return good

    @in_place
    def solve_factored(L: Any, b: Any, x: Any) -> None:
        """Compute the solution x of ``L L^T x = b``; x may be b."""
        n = size if size > 0 else L.shape[0]
        for i in range(n):
            total = b[i]
            for k in range(i):
                total -= L[i, k] * x[k]
            x[i] = total * L[i, i]
        for i in range(n - 1, -1, -1):
            total = x[i]
            for k in range(i + 1, n):
                total -= L[k, i] * x[k]
            x[i] = total * L[i, i]

    @in_place
    def invert_factored(L: Any, P: Any) -> None:
        """Compute ``P = (L L^T)^-1``, both halves; L is replaced by its inverse.

        This inverts the factor. Block inversion would lose the digits of a vague prior.
        """
        n = size if size > 0 else L.shape[0]
        for i in range(n):
            for j in range(i):
                total = 0.0
                for k in range(j, i):
                    total -= L[i, k] * L[k, j]
                L[i, j] = total * L[i, i]
        for i in range(n):
            for j in range(i + 1):
                total = 0.0
                for k in range(i, n):
                    total += L[k, i] * L[k, j]
                P[i, j] = total
                P[j, i] = total

    return cholesky, solve_factored, invert_factored


cholesky, solve_factored, invert_factored = of_size(0)
cholesky6, solve_factored6, invert_factored6 = of_size(6)


@helper
def factor_semidefinite(A: Any, L: Any) -> None:
    """Compute a lower factor ``L L^T = A`` of any rank; its diagonal is stored, zeros above.

    A column without a pivot is zero, because in a semidefinite matrix the rest of it is zero.
    """
    n = A.shape[0]
    for j in range(n):
        pivot = A[j, j]
        floor = 10 * PIVOT_FLOOR * pivot
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
            L[k, j] = 0.0
        root = math.sqrt(pivot) if pivot > floor or pivot != pivot else 0.0
        inverse = 0.0 if root == 0.0 else 1 / root
        L[j, j] = root
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total * inverse


@helper
def multiply(A: Any, B: Any, out: Any) -> None:
    """Compute ``out = A B`` of matrices; `out` is neither of them."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[k, j]
            out[i, j] = total


@helper
def fill(value: float, out: Any) -> None:
    """Set ``out[:] = value`` of a matrix; numba takes a second to compile the slice."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = value
