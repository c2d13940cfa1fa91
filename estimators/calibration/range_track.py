"""The path of a point by ranges alone: a spline of the whole log, for what needs no rotation."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse.linalg import spsolve

from rbl_gym.checks import check_array, check_number
from rbl_gym.estimators.costs.losses import LATE, huber, loss_of

__all__ = ["range_track"]

_KNOT_S, _ACCELERATION = 0.2, 2.0
# Deviations of the biases of a link, and of what all have in common (m).
_LINK_M, _COMMON_M = 0.1, 0.2
_ITERATIONS, _CONVERGED_M = 25, 2e-3
_HUBER = 1.5


def range_track(
    times: ArrayLike,
    ranges: ArrayLike,
    anchors: ArrayLike,
    std: ArrayLike,
    start: ArrayLike | scipy.interpolate.BSpline,
    links: ArrayLike | None = None,
) -> scipy.interpolate.BSpline:
    """A cubic spline of positions that ranges fit best, robustly, with biases that stay.

    Between knots 0.2 s apart the acceleration is held to zero by 2 m/s^2.

    Parameters
    ----------
    times, ranges, std
        (K,) of each range: seconds that do not decrease, metres, standard deviation.
    anchors
        (K, 3): where each was measured from.
    start
        Where the search begins (3,); or what it found with other anchors.
    links
        Which link each is of, (K,) integers from 0; None: all of one.

    Returns
    -------
    BSpline
        Of seconds, with values (..., 3).

    Raises
    ------
    ValueError
        On arrays that do not fit together.
    """
    times, ranges, std = (
        check_array(name, value, ("K",))
        for name, value in (("times", times), ("ranges", ranges), ("std", std))
    )
    anchors = check_array("anchors", anchors, ("K", 3))
    if not len(times) == len(ranges) == len(std) == len(anchors) or (np.diff(times) < 0).any():
        raise ValueError("times must not decrease, and ranges, std and anchors be as many")
    length = check_number("length of times", float(times[-1] - times[0]), low=2 * _KNOT_S)
    count = int(np.ceil(length / _KNOT_S))
    knots = times[0] + length / count * np.arange(-3, count + 4)
    inside = np.clip(times, knots[3], np.nextafter(knots[-4], -np.inf))
    # Their types are not told by scipy's stubs.
    basis: Any = scipy.interpolate.BSpline.design_matrix(inside, knots, 3).tocsr()
    m = basis.shape[1]
    bend = sparse.eye(m - 2, m) - 2 * sparse.eye(m - 2, m, k=1) + sparse.eye(m - 2, m, k=2)
    bend = bend / ((length / count) ** 2 * _ACCELERATION)
    link = np.zeros(len(times), dtype=int) if links is None else np.asarray(links, dtype=int)
    count = int(link.max()) + 1
    of_link = sparse.csr_matrix((np.ones(len(link)), (np.arange(len(link)), link)))
    biases = np.linalg.inv(_LINK_M**2 * np.eye(count) + _COMMON_M**2)
    held: Any = sparse.block_diag([bend.T @ bend] * 3 + [biases]) + 1e-9 * sparse.eye(3 * m + count)
    losses = [LATE]
    if isinstance(start, scipy.interpolate.BSpline):
        first = start.c
    else:
        first, losses = check_array("start", start, (3,)) + np.zeros((m, 3)), [huber(_HUBER), LATE]
    x = np.append(first.T, np.zeros(count))
    for loss in losses:
        for _ in range(_ITERATIONS):
            away = basis @ x[: 3 * m].reshape(3, m).T - anchors
            distance = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
            error = (ranges - distance - x[3 * m :][link]) / std
            # As epochs of one range each.
            share = loss_of(error[:, None, None] ** 2, loss, error[:, None, None] > 0)[1]
            weight = share[:, 0, 0] / std
            columns = [basis.multiply(a[:, None]) for a in (away / distance[:, None]).T]
            A: Any = sparse.hstack([*columns, of_link]).tocsr()
            H = A.T @ A.multiply((weight / std)[:, None]) + held
            step = spsolve(H.tocsc(), A.T @ (weight * error) - held @ x)
            x = x + step
            if np.abs(step).max() < _CONVERGED_M:
                break
    return scipy.interpolate.BSpline(knots, x[: 3 * m].reshape(3, m).T, 3)
