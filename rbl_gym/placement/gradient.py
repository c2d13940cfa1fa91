"""The score of a layout with its derivative by the places of the anchors."""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray, check_array
from rbl_gym.kernels import compiled
from rbl_gym.measurements import ranging
from rbl_gym.placement.problem import (
    Context,
    PlacementTask,
    arguments,
    checked_context,
    root_of,
)

__all__ = ["score_and_gradient"]


def score_and_gradient(
    task: PlacementTask, context: Context, anchors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`problem.score` (...) and its derivative (..., M, 3) by the places of the anchors.

    What blocks sight is taken as it is: an anchor that is about to lose sight of a pose is not
    warned.
    """
    anchors, context = check_array("anchors", anchors, ("M", 3)), checked_context(context)
    square, gradient = _mean_square_and_gradient(*arguments(task, context, anchors))
    root = root_of(square)
    return root, gradient / (2 * root[..., None, None])


@compiled("layout_score:mean_square_and_gradient")
def _mean_square_and_gradient(
    anchors: FloatArray,
    rotation: FloatArray,
    places: FloatArray,
    tags: FloatArray,
    prior: FloatArray,
    law: FloatArray,
    share: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Mean (...) of b^2 over poses, and its derivative (..., M, 3) by the anchors.

    With ``K = P S P``, S the mean of ``J_n^T J_n``, b^2 falls by ``tr(K dF)``. A link tells
    ``F = w q q^T`` with ``q = J_n^T d`` and ``w = 1 / (var r^2)``, of the offset ``d = s_n - a_m``.
    """
    noise = ranging.law_of(law)
    J = bounds.tag_jacobian(rotation, tags[..., None, :, :])
    s = ranging.tag_positions(rotation, places, tags[..., None, :, :])
    d = s[..., None, :, :] - anchors[..., None, :, None, :]
    distance = np.sqrt((d**2).sum(axis=-1))
    w = share[..., None] / (noise.variance(distance) * distance**2)
    q = np.einsum("...nia,...mni->...mna", J, d)
    P = np.linalg.inv(np.einsum("...mn,...mna,...mnb->...ab", w, q, q) + prior[..., None, :, :])
    S = np.einsum("...nia,...nib->...ab", J, J) / tags.shape[-2]
    Kq = q @ (P @ S @ P)[..., None, :, :]
    told = w * (q * Kq).sum(axis=-1)
    by_link, by_reference, reference = _weight_slopes(noise, distance)
    slope = np.einsum("...mn,...nia,...mna->...mi", w, J, Kq)
    slope -= ((told * by_link)[..., None] * d).sum(axis=-2)
    slope -= (told * by_reference).sum(axis=-1, keepdims=True) * d[..., reference, :]
    square = np.einsum("...ab,...ba->...", S, P)
    return square.mean(axis=-1), 2 * slope.mean(axis=-3)


def _weight_slopes(
    noise: ranging.NoiseLaw, distance: FloatArray
) -> tuple[FloatArray, FloatArray, int]:
    """Minus the derivatives of ``log w`` by the squares of two distances (..., M, N).

    Those of the link, and of the reference tag to the same anchor, whose index is the third.
    """
    if isinstance(noise, ranging.SquaredRangeNoise):
        return np.zeros_like(distance), 1 / distance[..., :1] ** 2 + 0 * distance, 0
    assert isinstance(noise, ranging.RangeNoise)
    growth = noise.proportional**2 / noise.variance(distance) + 0 * distance
    if noise.reference_tag is None:
        return 1 / distance**2 + growth, np.zeros_like(distance), 0
    return 1 / distance**2, growth, noise.reference_tag
