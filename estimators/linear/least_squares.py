"""Estimators on squared ranges: LS, LS-projected, CLS (CTLS), weighted Procrustes (UC-LS).

LS and CLS are from the static paper (ICASSP 2013), LS with projection and UC-LS from the slides.

All use the statistic of an epoch (`squared_range`) and broadcast over leading axes. If the links
of a trial do not determine a solution, its entries are NaN, which the caller must check.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.bounds.pose import information_rank
from rbl_gym.checks import FloatArray, kernel
from rbl_gym.estimators.linear.squared_range import Statistic, information
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled

# Internal functions without checks: undetermined entries are NaN.
_NEAREST = kernel(rotations.nearest)
# From a step on the tangent space to a rotation, equal to second order.
RETRACTIONS = {"exponential": kernel(rotations.exp), "cayley": kernel(rotations.cayley)}

_ITERATIONS = 30
# The generators of SO(3): E[i] = [e_i]x.
_E = rotations.hat(np.eye(3))
# Symmetrised products (E_i E_j + E_j E_i) / 2, the second-order term of exp.
_EE = 0.5 * (np.einsum("iab,jbc->ijac", _E, _E) + np.einsum("jab,ibc->ijac", _E, _E))


def vec(matrix: FloatArray) -> FloatArray:
    """Return the columns of (..., 3, k), stacked to (..., 3 k)."""
    columns = np.swapaxes(matrix, -1, -2)
    return columns.reshape(*columns.shape[:-2], -1)


def unvec(vector: FloatArray) -> FloatArray:
    """Return the 3 x 3 matrix of a vector; inverse of `vec`."""
    return np.swapaxes(vector.reshape(*vector.shape[:-1], 3, 3), -1, -2)


def procrustes(
    weight: FloatArray, target: FloatArray, start: FloatArray, retraction: str = "exponential"
) -> tuple[FloatArray, FloatArray]:
    """Minimise ``(vec Q - q)^T W (vec Q - q) / 2`` over rotations by Newton's method on SO(3).

    The Hessian is exact, and damped if it is not positive or the cost would increase. The update is
    ``Q <- R(w) Q`` with the retraction R. The search is local: the caller chooses the starts, on a
    batch axis.

    Parameters
    ----------
    weight, target
        W (..., 9, 9), positive semidefinite, and q (..., 9).
    start
        Rotation (..., 3, 3) to start from.
    retraction
        One of `RETRACTIONS`.

    Returns
    -------
    The rotation (..., 3, 3) and its cost (...).
    """
    if retraction == "exponential":
        return _newton(weight, target, start)
    return _newton_by(weight, target, start, retraction)


@compiled("rotation_fits:procrustes")
def _newton(
    weight: FloatArray, target: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compute `procrustes` with the exponential as retraction."""
    return _newton_by(weight, target, start, "exponential")


def _newton_by(
    weight: FloatArray, target: FloatArray, start: FloatArray, retraction: str
) -> tuple[FloatArray, FloatArray]:
    batch = np.broadcast_shapes(weight.shape[:-2], target.shape[:-1], start.shape[:-2])
    Q = np.broadcast_to(start, (*batch, 3, 3))
    at = _Iterate(Q, *_pull(weight, target, Q), np.zeros(batch))
    for _ in range(_ITERATIONS):
        step, length = _newton_step(weight, at)
        Q = RETRACTIONS[retraction](step) @ at.rotation
        at = _better(at, Q, *_pull(weight, target, Q))
        if (length < 1e-13).all():
            break
    return at.rotation, at.cost


class _Iterate(NamedTuple):
    """Rotation Q (..., 3, 3), W (vec Q - q) (..., 9), cost (...) and damping (...)."""

    rotation: FloatArray
    pull: FloatArray
    cost: FloatArray
    damping: FloatArray


def _pull(weight: FloatArray, target: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    residual = vec(Q) - target
    pull = (weight @ residual[..., None])[..., 0]
    return pull, 0.5 * np.einsum("...i,...i->...", residual, pull)


def _newton_step(weight: FloatArray, at: _Iterate) -> tuple[FloatArray, FloatArray]:
    """Return the step (..., 3) on the tangent space and its length (...) before it was cut."""
    tangent = vec(_E @ at.rotation[..., None, :, :])  # (..., 3, 9): derivative of vec Q
    gradient = (tangent @ at.pull[..., None])[..., 0]
    gauss = tangent @ weight @ np.swapaxes(tangent, -1, -2)
    turned = vec(_EE @ at.rotation[..., None, None, :, :])
    hessian = gauss + np.einsum("...k,...ijk->...ij", at.pull, turned)
    smallest = np.linalg.eigvalsh(hessian)[..., 0]
    scale = np.trace(gauss, axis1=-2, axis2=-1)
    shift = np.maximum(0.0, 1e-9 * scale - smallest) * 1.5 + at.damping * scale + 1e-300
    # If a weight is only rounding noise, as for tags at one point, nothing else is certain.
    shift += 1e-15 * np.abs(hessian).max(axis=(-2, -1))
    step = -np.linalg.solve(hessian + shift[..., None, None] * np.eye(3), gradient[..., None])
    step = step[..., 0]
    # A step of more than 90 degrees leaves the region where the quadratic model is valid.
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    return step * np.minimum(1.0, 1.5 / np.maximum(length, 1e-300)), length[..., 0]


def _better(at: _Iterate, Q: FloatArray, pull: FloatArray, cost: FloatArray) -> _Iterate:
    """Take a candidate where its cost is not larger; damp less there, and more elsewhere."""
    better = cost <= at.cost * (1 + 1e-12)
    return _Iterate(
        np.where(better[..., None, None], Q, at.rotation),
        np.where(better[..., None], pull, at.pull),
        np.where(better, cost, at.cost),
        np.where(better, 0.1 * at.damping, np.maximum(10 * at.damping, 1e-3)),
    )


def linear_fit(stat: Statistic) -> tuple[FloatArray, FloatArray]:
    """Return LS: the unconstrained 3 x 3 matrix and translation, eq. (14) of the static paper."""
    matrix, vector = information(stat)
    x = _solve(matrix, vector)
    return unvec(x[..., :9]), x[..., 9:]


def translation_fit(stat: Statistic, rotation: FloatArray) -> FloatArray:
    """Return the least-squares translation for a given rotation."""
    per_tag = stat.b - (stat.G @ (stat.tags @ np.swapaxes(rotation, -1, -2))[..., None])[..., 0]
    return _solve(_total(stat), per_tag.sum(axis=-2))


def points_fit(stat: Statistic) -> tuple[FloatArray, FloatArray]:
    """Return CLS, also CTLS: locate every tag separately, then fit by orthogonal Procrustes.

    Static paper: (17)-(19) and Lemma 1, (20)-(21) and Lemma 2, Algorithm 1.

    Tags whose links do not determine their position are left out; three non-collinear tags must
    remain.
    """
    places = _solve(stat.G, stat.b)
    known = np.broadcast_to(np.isfinite(places).all(axis=-1), places.shape[:-1])
    share = known / np.maximum(known.sum(axis=-1, keepdims=True), 1)
    places = np.where(known[..., None], places, 0.0)
    centre = (share[..., None] * places).sum(axis=-2)
    middle = (share[..., None] * stat.tags).sum(axis=-2)
    weighted = share[..., None] * (stat.tags - middle[..., None, :])
    cross = np.swapaxes(places - centre[..., None, :], -1, -2) @ weighted
    rotation = _NEAREST(cross)
    translation = centre - (rotation @ middle[..., None])[..., 0]
    few = known.sum(axis=-1) < 3
    return np.where(few[..., None, None], np.nan, rotation), np.where(
        few[..., None], np.nan, translation
    )


def procrustes_fit(
    stat: Statistic, starts: FloatArray, retraction: str = "exponential"
) -> tuple[FloatArray, FloatArray]:
    """Return the global solution of the weighted orthogonal Procrustes problem.

    Remark 2 of the static paper; UC-LS in the appendix of the slides.

    Parameters
    ----------
    starts
        Rotations (..., S, 3, 3); Newton's method starts from the first of every trial and from the
        two with the least cost among the others.
    retraction
        One of `RETRACTIONS`.

    Returns
    -------
    Rotation (..., 3, 3) and the translation (..., 3) that belongs to it.
    """
    matrix, vector = information(stat)
    lower = np.linalg.solve(loaded(matrix[..., 9:, 9:]), matrix[..., 9:, :9])
    weight = matrix[..., :9, :9] - np.swapaxes(matrix[..., 9:, :9], -1, -2) @ lower
    pull = vector[..., :9] - (np.swapaxes(lower, -1, -2) @ vector[..., 9:, None])[..., 0]
    # For coplanar tags the weight is singular; the loading acts in its null space.
    target = np.linalg.solve(loaded(weight), pull[..., None])[..., 0]
    weight, target = weight[..., None, :, :], target[..., None, :]
    residual = vec(starts) - target
    cost = np.einsum(
        "...i,...i->...", residual @ np.swapaxes(weight[..., 0, :, :], -1, -2), residual
    )
    order = np.argsort(cost[..., 1:], axis=-1)[..., :2] + 1
    chosen = np.concatenate([np.zeros_like(order[..., :1]), order], axis=-1)
    starts = np.take_along_axis(starts, chosen[..., None, None], axis=-3)
    Q, cost = procrustes(weight, target, starts, retraction=retraction)
    best = np.argmin(cost, axis=-1)
    rotation = np.take_along_axis(Q, best[..., None, None, None], axis=-3)[..., 0, :, :]
    return rotation, translation_fit(stat, rotation)


def _total(stat: Statistic) -> FloatArray:
    n_tags = stat.b.shape[-2]
    return stat.G[..., 0, :, :] * n_tags if stat.is_common else stat.G.sum(axis=-3)


def loaded(matrix: FloatArray) -> FloatArray:
    """Return symmetric matrices (..., n, n) with 1e-13 of the trace added to the diagonal."""
    size = matrix.shape[-1]
    trace = np.trace(matrix, axis1=-2, axis2=-1)[..., None, None]
    return matrix + (1e-13 * trace + 1e-300) * np.eye(size)


def _solve(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the solution of symmetric positive systems, NaN if one is singular."""
    singular = information_rank(matrix) < matrix.shape[-1]
    safe = np.where(singular[..., None, None], np.eye(matrix.shape[-1]), matrix)
    solved = np.linalg.solve(safe, vector[..., None])[..., 0]
    return np.where(singular[..., None], np.nan, solved)
