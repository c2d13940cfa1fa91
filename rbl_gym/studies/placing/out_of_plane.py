"""Find an anchor outside the plane of a coplanar layout, so that no mirror image remains.

At the mirror image of a pose the ranges to anchors in the plane are the same. The range to an
anchor outside the plane differs; a pose fitted to all ranges hides a part of the difference, the
leverage of this anchor.
"""

from __future__ import annotations

import math

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.mirror import plane_of
from rbl_gym.measurements.ranging import distances
from rbl_gym.placement.building import Problem
from rbl_gym.studies.placing.choosing import candidates, first_then_others, stock_of
from rbl_gym.studies.placing.stock_search import with_candidates

__all__ = ["exchange_out_of_plane"]

# The mirror image must differ by this many standard deviations, at this share of the positions.
_SIGMA, _SHARE = 5.0, 0.95
# Number of positions of the body, in all zones together.
_PLACES = 128


def exchange_out_of_plane(
    problem: Problem, anchors: FloatArray, seed: int, survive: int = 0
) -> tuple[int, FloatArray] | None:
    """Return which anchor to exchange, and its new position (3,), to remove the mirror image.

    It is the best such exchange by the objective of the search. None if no mount is far enough
    from the plane, all anchors are fixed, or there are only three, which always lie in a plane.

    Parameters
    ----------
    problem, anchors
        The problem, and the coplanar layout (M, 3), the fixed anchors first.
    seed, survive
        As in `rbl_gym.studies.placing.choosing.next_anchor`.
    """
    count = len(anchors)
    points = first_then_others(anchors, candidates(problem, np.random.default_rng([seed, 9])))
    if count < 4 or len(points) == count:
        return None
    stock = stock_of(problem, points, seed, _PLACES)
    miss, lines, weight = _at_mirror_image(
        problem, anchors, points, np.concatenate([zone.places for zone in stock.zones])
    )
    parts = weight[..., None, None] * lines[..., None] * lines[..., None, :]
    best, least = None, math.inf
    for k in range(len(problem.fixed), count):
        others = [j for j in range(count) if j != k]
        total = parts[:, others].sum(axis=1)[:, None] + parts[:, count:]
        line = lines[:, count:, :, None]
        leverage = (
            weight[:, count:]
            * (np.swapaxes(line, -1, -2) @ np.linalg.pinv(total, hermitian=True) @ line)[..., 0, 0]
        )
        square = weight[:, count:] * miss[:, count:] ** 2 * (1 - leverage)
        far = np.quantile(square, 1 - _SHARE, axis=0) >= _SIGMA**2
        which = count + np.flatnonzero(far)
        if len(which):
            values = with_candidates(stock, others, which, survive, math.inf)
            if values.min() < least:
                best, least = (k, points[which[values.argmin()]]), float(values.min())
    return best


def _at_mirror_image(
    problem: Problem, anchors: FloatArray, points: FloatArray, places: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return differences of the ranges, their directions and weights, at mirrored positions (L, 3).

    Differences and weights (L, K), directions (L, K, 3), for anchors at the points (K, 3). The
    weight is that of the ranges to all tags together.
    """
    plane = plane_of(anchors)
    away = (places - plane.point) @ plane.normal
    image = places - 2 * away[:, None] * plane.normal
    r, mirrored = (distances(points, x[:, None])[..., 0] for x in (places, image))
    ranges = np.repeat(r[..., None], len(problem.tags), axis=-1)
    variance = np.broadcast_to(problem.noise.variance(ranges), ranges.shape)
    weight = problem.share(points, places) * (1 / variance).sum(axis=-1)
    return mirrored - r, (image[:, None] - points) / mirrored[..., None], weight
