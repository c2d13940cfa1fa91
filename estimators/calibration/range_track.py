"""Path of a point from ranges alone, as a spline over the whole log, without rotation."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rbl_gym.checks import check_array, check_number
from rbl_gym.estimators.costs.losses import LATE, huber, loss_of
from rbl_gym.kernels.constants import HUBER

__all__ = ["range_track"]

_KNOT_S, _ACCELERATION = 0.2, 2.0
# Standard deviations of the bias of a link, and of the common bias (m).
_LINK_M, _COMMON_M = 0.1, 0.2
_ITERATIONS, _CONVERGED_M = 25, 2e-3


def range_track(
    times: ArrayLike,
    ranges: ArrayLike,
    anchors: ArrayLike,
    std: ArrayLike,
    start: ArrayLike | scipy.interpolate.BSpline,
    links: ArrayLike | None = None,
) -> scipy.interpolate.BSpline:
    """Estimate a cubic spline of positions robustly from ranges with constant biases.

    Knots are 0.2 s apart. The acceleration between them has a zero-mean prior with standard
    deviation 2 m/s^2.

    Parameters
    ----------
    times, ranges, std
        (K,) of each range: seconds, not decreasing; metres; standard deviation, metres.
    anchors
        (K, 3): anchor of each range.
    start
        Start of the search (3,), or the spline found with other anchors.
    links
        Index of the link of each range, (K,) integers from 0; None: one link.

    Returns
    -------
    BSpline
        Function of time (s), with values (..., 3), metres.

    Raises
    ------
    ValueError
        If shapes do not match.
    """
    times, ranges, std = (
        check_array(name, value, ("K",))
        for name, value in (("times", times), ("ranges", ranges), ("std", std))
    )
    anchors = check_array("anchors", anchors, ("K", 3))
    lengths = {len(times), len(ranges), len(std), len(anchors)}
    if len(lengths) > 1:
        raise ValueError(
            "times, ranges, std and anchors must have the same length, got "
            f"{len(times)}, {len(ranges)}, {len(std)} and {len(anchors)}"
        )
    if (np.diff(times) < 0).any():
        raise ValueError(f"times must not decrease, got a step of {np.diff(times).min():g} s")
    length = check_number("length of times", float(times[-1] - times[0]), low=2 * _KNOT_S)
    count = int(np.ceil(length / _KNOT_S))
    knots = times[0] + length / count * np.arange(-3, count + 4)
    inside = np.clip(times, knots[3], np.nextafter(knots[-4], -np.inf))
    # scipy's stubs lack these types.
    basis: Any = scipy.interpolate.BSpline.design_matrix(inside, knots, 3).tocsr()
    m = basis.shape[1]
    bend = (
        scipy.sparse.eye(m - 2, m)
        - 2 * scipy.sparse.eye(m - 2, m, k=1)
        + scipy.sparse.eye(m - 2, m, k=2)
    )
    bend = bend / ((length / count) ** 2 * _ACCELERATION)
    link = np.zeros(len(times), dtype=int) if links is None else np.asarray(links, dtype=int)
    count = int(link.max()) + 1
    of_link = scipy.sparse.csr_matrix((np.ones(len(link)), (np.arange(len(link)), link)))
    biases = np.linalg.inv(_LINK_M**2 * np.eye(count) + _COMMON_M**2)
    held: Any = scipy.sparse.block_diag([bend.T @ bend] * 3 + [biases]) + 1e-9 * scipy.sparse.eye(
        3 * m + count
    )
    losses = [LATE]
    if isinstance(start, scipy.interpolate.BSpline):
        first = start.c
    else:
        first, losses = check_array("start", start, (3,)) + np.zeros((m, 3)), [huber(HUBER), LATE]
    x = np.append(first.T, np.zeros(count))
    for loss in losses:
        for _ in range(_ITERATIONS):
            away = basis @ x[: 3 * m].reshape(3, m).T - anchors
            distance = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
            error = (ranges - distance - x[3 * m :][link]) / std
            # Epochs of one range each.
            share = loss_of(error[:, None, None] ** 2, loss, error[:, None, None] > 0)[1]
            weight = share[:, 0, 0] / std
            columns = [basis.multiply(a[:, None]) for a in (away / distance[:, None]).T]
            A: Any = scipy.sparse.hstack([*columns, of_link]).tocsr()
            H = A.T @ A.multiply((weight / std)[:, None]) + held
            step = scipy.sparse.linalg.spsolve(H.tocsc(), A.T @ (weight * error) - held @ x)
            x = x + step
            if np.abs(step).max() < _CONVERGED_M:
                break
    return scipy.interpolate.BSpline(knots, x[: 3 * m].reshape(3, m).T, 3)
