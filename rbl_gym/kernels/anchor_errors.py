"""Information of ranges to anchors with uncertain positions, for one body.

The textbook form is in `rbl_gym.bounds.information`.
"""

from __future__ import annotations

from typing import Any

from rbl_gym.kernels.epoch import tag_position
from rbl_gym.kernels.jit import gufunc
from rbl_gym.kernels.linear_algebra import of_size
from rbl_gym.kernels.noise_laws import reference_of, weight
from rbl_gym.kernels.offsets import derivative
from rbl_gym.kernels.workspace import workspace

cholesky3, solve_factored3, _ = of_size(3)


@gufunc("(p,p),(m,d),(n,d),(d,d),(d),(l),(m,n),(m,d)->(p,p)")
def information(
    prior: Any, anchors: Any, tags: Any, rotation: Any, translation: Any, law: Any, share: Any,
    anchor_std: Any, told: Any,
) -> None:  # fmt: skip
    """Add the information of ranges to a prior's, marginalizing each anchor's position.

    Let J be the derivative by the pose and ``p = -std u`` that by the anchor's position in standard
    deviations. An anchor contributes ``H - C^T (I + U)^-1 C``, where H, U and C are the weighted
    sums of J J^T, p p^T and p J^T.
    """
    J, p, solved = workspace((6,)), workspace((3,)), workspace((3,))
    U, L, C = workspace((3, 3)), workspace((3, 3)), workspace((6, 3))
    for i in range(6):
        for j in range(6):
            told[i, j] = prior[i, j]
    for m in range(anchors.shape[0]):
        for i in range(3):
            for j in range(3):
                U[i, j] = 1.0 if i == j else 0.0
        for i in range(6):
            for j in range(3):
                C[i, j] = 0.0
        for n in range(tags.shape[0]):
            x, y, z = tag_position(rotation, translation, tags, n)
            square = derivative(translation, x, y, z, anchors[m], J) ** 2
            of_reference, reference = square, reference_of(law, n)
            if reference != n:
                a, b, c = tag_position(rotation, translation, tags, reference)
                a, b, c = a - anchors[m, 0], b - anchors[m, 1], c - anchors[m, 2]
                of_reference = a * a + b * b + c * c
            w = share[m, n] * weight(law, square, of_reference) * square
            for i in range(3):
                p[i] = -anchor_std[m, i] * J[3 + i]
            for i in range(6):
                for j in range(i + 1):
                    told[i, j] += w * J[i] * J[j]
                for j in range(3):
                    C[i, j] += w * J[i] * p[j]
            for i in range(3):
                for j in range(i + 1):
                    U[i, j] += w * p[i] * p[j]
        cholesky3(U, L)
        for i in range(6):
            solve_factored3(L, C[i], solved)
            for j in range(i + 1):
                told[i, j] -= C[j, 0] * solved[0] + C[j, 1] * solved[1] + C[j, 2] * solved[2]
    for i in range(6):
        for j in range(i + 1):
            told[j, i] = told[i, j]
