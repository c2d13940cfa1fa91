"""Global maximum-likelihood pose from directions of arrival.

Three tags and their directions determine a pose up to the roots of a quartic (the
perspective-three-point problem, Grunert 1841; coefficients as in Haralick et al., IJCV 13, 1994).
The roots of several triples, with every possible sign of y, are the starts. Levenberg-Marquardt on
SO(3) x R^3 finds the local optima near them.
"""

from __future__ import annotations

import itertools

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.costs.doa_cost import DoaCost
from rbl_gym.estimators.costs.levenberg_marquardt import Solution
from rbl_gym.estimators.costs.map_problem import minimize
from rbl_gym.estimators.locating.maximum_likelihood import Alternatives, cheapest, merge, rivals
from rbl_gym.measurements import bearing

# Number of triples of tags, those of largest area, that give starts.
_TRIPLES = 6
# Starts on each side of y = 0 that are refined, and those refined to convergence: many starts lead
# to one optimum.
_REFINED, _FINALISTS = 6, 5
# Starts with a cost this far above the best are dropped.
_HOPEFUL = 50.0


def global_search(
    angles: FloatArray, weights: FloatArray, tags: FloatArray, side: float | None
) -> tuple[Solution, Alternatives]:
    """Return the most likely pose of every trial and others about as likely.

    Parameters
    ----------
    angles, weights, tags
        (B, 2, K), (B, 2, K), (B, K, 3), K >= 3.
    side
        Sign of y of the body; None: unknown.
    """
    sides = (1.0, -1.0) if side is None else (side,)
    rotation, translation = starts(angles, tags, side)
    part = DoaCost(angles[:, None], weights[:, None], tags[:, None], np.zeros((1, 1, 3)))
    cost = _cost_of_angles(part, rotation, translation)
    chosen = _cheapest_of_sides(rotation, translation, cost, tags, sides, _REFINED)
    coarse = minimize(part, *chosen, iterations=6, tolerance=1e-2)
    finalists = _cheapest_of_sides(*coarse[:2], coarse.at.cost, tags, sides, _FINALISTS)
    refined = minimize(part, *finalists, iterations=8)
    cost = refined.at.cost
    hopeful = cost < cost.min(axis=1, keepdims=True) + _HOPEFUL
    slow = (hopeful & ~refined.converged).any(axis=1)
    if slow.any():
        rest = part.each(lambda array, _: array[slow] if len(array) == len(slow) else array)
        more = minimize(rest, refined.rotation[slow], refined.translation[slow], 60)
        refined = merge(refined, more, slow)
    if side is not None:
        beyond = side * _height(refined.rotation, refined.translation, tags) <= 0
        cost = np.where(beyond, np.inf, refined.at.cost)
        refined = refined._replace(at=refined.at._replace(cost=cost))
    return cheapest(refined), rivals(part.tags, refined)


def _cheapest_of_sides(
    rotation: FloatArray,
    translation: FloatArray,
    cost: FloatArray,
    tags: FloatArray,
    sides: tuple[float, ...],
    count: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the `count` poses of least cost of every trial on each side of y = 0."""
    height = _height(rotation, translation, tags)
    count = min(count, cost.shape[1])
    keep = np.concatenate(
        [
            np.argpartition(np.where(side * height > 0, cost, np.inf), count - 1)[:, :count]
            for side in sides
        ],
        axis=1,
    )
    return (
        np.take_along_axis(rotation, keep[..., None, None], axis=1),
        np.take_along_axis(translation, keep[..., None], axis=1),
    )


def starts(
    angles: FloatArray, tags: FloatArray, side: float | None
) -> tuple[FloatArray, FloatArray]:
    """Return the poses (B, S, 3, 3), (B, S, 3) that agree with three tags at a time."""
    triples = _triples(tags)
    signs = np.full((1, 3), side or 1.0)
    if side is None:
        signs = np.array([(1.0, *pair) for pair in itertools.product((1.0, -1.0), repeat=2)])
    # (B, triple, sign pattern, tag, 3), then components first.
    rays = bearing.directions(angles)[:, triples]
    rays = np.where(np.arange(3) == 1, rays[:, :, None] * signs[..., None], rays[:, :, None])
    body = tags[:, triples][:, :, None]
    batch = rays.shape[:3]
    body = np.broadcast_to(body, rays.shape)
    flat = [np.ascontiguousarray(a.reshape(-1, 3, 3).transpose(1, 2, 0)) for a in (rays, body)]
    depths = three_point_depths(*flat)
    places = depths[:, None] * flat[0][..., None]
    poses = [_align(places, flat[1][..., None])]
    if side is None:
        # The mirror image across y = 0 has the same depths and an inverted triangle.
        places[:, 1] *= -1
        poses.append(_align(places, flat[1][..., None]))
    rotation = [np.moveaxis(Q, (0, 1), (-2, -1)).reshape((batch[0], -1, 3, 3)) for Q, _ in poses]
    translation = [np.moveaxis(t, 0, -1).reshape((batch[0], -1, 3)) for _, t in poses]
    return np.concatenate(rotation, axis=1), np.concatenate(translation, axis=1)


def _triples(tags: FloatArray) -> np.ndarray:
    """Return the triples (T, 3) of tags with the largest triangles, on average over the trials."""
    triples = np.array(list(itertools.combinations(range(tags.shape[1]), 3)))
    some = tags[:: max(1, len(tags) // 16)]
    corner = some[:, triples]
    sides = corner[:, :, 1:] - corner[:, :, :1]
    area = np.linalg.norm(np.cross(sides[:, :, 0], sides[:, :, 1]), axis=-1).mean(axis=0)
    return triples[np.argsort(-area, kind="stable")[:_TRIPLES]]


def three_point_depths(rays: FloatArray, body: FloatArray) -> FloatArray:
    """Return distances (3, n, 4) of three tags along unit rays (3, 3, n), body triangles (3, 3, n).

    Axes are tag, then component. There is one distance for each of the four roots of Grunert's
    quartic in v = d3 / d1. If noise makes a pair of roots complex, its real part replaces both.
    """
    a, b, c = (_square(body[i] - body[j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    cos_a, cos_b, cos_c = (
        np.einsum("i...,i...->...", rays[i], rays[j]) for i, j in ((1, 2), (0, 2), (0, 1))
    )
    b = np.maximum(b, 1e-300)
    p, q, r = (a - c) / b, (a + c) / b, c / b
    s = a / b
    coefficients = [
        (p - 1) ** 2 - 4 * r * cos_a**2,
        4 * (p * (1 - p) * cos_b - (1 - q) * cos_a * cos_c + 2 * r * cos_a**2 * cos_b),
        2 * (p**2 - 1 + 2 * p**2 * cos_b**2 + 2 * (1 - r) * cos_a**2
             - 4 * q * cos_a * cos_b * cos_c + 2 * (1 - s) * cos_c**2),
        4 * (-p * (1 + p) * cos_b + 2 * s * cos_c**2 * cos_b - (1 - q) * cos_a * cos_c),
        (1 + p) ** 2 - 4 * s * cos_c**2,
    ]  # fmt: skip
    v = np.maximum(_quartic_roots(np.array(coefficients)), 1e-3)
    p, cos_a, cos_b, cos_c, b = (x[:, None] for x in (p, cos_a, cos_b, cos_c, b))
    lower = 2 * (cos_c - v * cos_a)
    lower = np.where(np.abs(lower) > 1e-9, lower, 1e-9)
    u = np.maximum(((p - 1) * v**2 - 2 * p * cos_b * v + 1 + p) / lower, 1e-3)
    d = np.sqrt(b / np.maximum(1 + v * v - 2 * v * cos_b, 1e-12))
    return np.stack([d, d * np.minimum(u, 1e3), d * np.minimum(v, 1e3)])


def _quartic_roots(coefficients: FloatArray) -> FloatArray:
    """Return real parts (n, 4) of the roots of quartics (5, n), highest power first."""
    leading = coefficients[0]
    floor = 1e-12 * np.abs(coefficients).max(axis=0) + 1e-300
    leading = np.where(np.abs(leading) > floor, leading, floor)
    companion = np.zeros((coefficients.shape[1], 4, 4))
    companion[:, 0] = -(coefficients[1:] / leading).T
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    return np.linalg.eigvals(companion).real


def _align(places: FloatArray, body: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pose (3, 3, ...), (3, ...) from triangles (3, 3, ...) of body and positions."""
    rotation = np.einsum("ik...,jk...->ij...", _frame(places), _frame(body))
    middle = body.mean(axis=0)
    turned = np.einsum("ij...,j...->i...", rotation, np.broadcast_to(middle, places.shape[1:]))
    return rotation, places.mean(axis=0) - turned


def _frame(triangle: FloatArray) -> FloatArray:
    """Return orthonormal axes (3, 3, ...), as columns, of triangles (3, 3, ...), tag first."""
    x = _unit(triangle[1] - triangle[0])
    z = _unit(np.cross(x, triangle[2] - triangle[0], axis=0))
    return np.stack([x, np.cross(z, x, axis=0), z], axis=1)


def _unit(vector: FloatArray) -> FloatArray:
    return vector / np.sqrt(np.maximum(_square(vector), 1e-300))


def _square(vector: FloatArray) -> FloatArray:
    return np.einsum("i...,i...->...", vector, vector)


def _cost_of_angles(part: DoaCost, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return half the squared whitened residuals (B, S), without derivatives."""
    places = part.tags @ np.swapaxes(rotation, -1, -2) + translation[..., None, :]
    residual = bearing.angles(places) - part.angles
    return 0.5 * (part.weights * residual**2).sum(axis=(-2, -1))


def _height(rotation: FloatArray, translation: FloatArray, tags: FloatArray) -> FloatArray:
    """Return y of the tags' centre at poses (B, S)."""
    return translation[..., 1] + np.einsum("bsj,bj->bs", rotation[..., 1, :], tags.mean(axis=1))
