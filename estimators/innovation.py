"""Innovations of a filter at an epoch, with their covariance, NIS and likelihood.

Let x be the other states that bias the ranges. Let e and dx be the changes of the pose and of x by
the update, and H, S the derivatives of the ranges by them at the pose after it. The innovation is

    v = r - h(after) + H e + S dx,   cov(v) = [H S] P [H S]^T + R,

with P the covariance before the update. To first order v is the range less its prediction.
Linearization at the pose after the update also works for a filter with an unknown initial pose. The
normalised square of v is twice the cost that an iterated EKF has minimised.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.filter import Filter
from rbl_gym.estimators.inputs import check_epoch, check_offset_epoch, check_variance
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import offsets
from rbl_gym.measurements.direction_bias import direction_bias
from rbl_gym.measurements.ranging import NoiseLaw

# Ranges with residuals beyond this many standard deviations, at the pose after the update, are
# rejected, as in the robust filters.
GATE = 4.0
# Density (1/m) of rejected ranges in the likelihood: this fraction of all, uniform over 10 m.
# Without it, the most likely standard deviation would be one that rejects everything.
OUTLIER_SHARE, OUTLIER_DENSITY = 0.05, 0.1
LOG_USED = np.log((1 - OUTLIER_SHARE) / np.sqrt(2 * np.pi))
LOG_REJECTED = np.log(OUTLIER_SHARE * OUTLIER_DENSITY)


class Innovations(NamedTuple):
    """Innovations of an epoch's ranges, with leading axes.

    Attributes
    ----------
    innovation, std
        (..., M, N), metres: the range minus its prediction, and the standard deviation that the
        filter predicts for it; 0 without a link.
    residual
        (..., M, N), metres: the range minus that of the state after the update; 0 without a link.
    used
        (..., M, N): the measured links, without the rejected ones. A link is rejected if its
        residual is larger than `GATE` standard deviations of a range.
    nis
        Normalised innovation squared (...) of the ranges used. Its mean is `dof` if the filter is
        consistent. It is inf if a state is not finite.
    dof
        Number (...) of ranges used.
    log_likelihood
        Natural logarithm (...) of the density of the ranges: Gaussian for those used, constant for
        those rejected.
    """

    innovation: FloatArray
    std: FloatArray
    residual: FloatArray
    used: BoolArray
    nis: FloatArray
    dof: FloatArray
    log_likelihood: FloatArray


def innovations(
    filter: Filter,
    before: Any,
    after: Any,
    ranges: ArrayLike,
    anchors: ArrayLike,
    tags: FloatArray,
    noise: NoiseLaw,
    links: ArrayLike | None = None,
) -> Innovations:
    """Return the innovations of an update, linearized at the pose after it.

    Parameters
    ----------
    filter
        Any filter. A filter whose states bias the ranges has a method
        ``biases_of(state, anchors)``. It returns the states besides the pose (..., K), the
        covariance (..., 6 + K, 6 + K) of the errors of pose and states, and the derivative (M N, K)
        of the ranges with respect to these states. A filter whose ranges share an unknown offset
        has an attribute ``offset``. Then the offsets are removed from NIS, likelihood and
        residuals.
    before, after
        Its states, as returned by `predict` and by `update`.
    ranges, anchors, links
        As passed to `update`.
    tags
        Positions (N, 3) in the body frame.
    noise
        Noise model of the epoch.

    Raises
    ------
    ValueError
        As in `update`.
    """
    offset = getattr(filter, "offset", None)
    if offset is None:
        ranges, anchors, mask = check_epoch(ranges, anchors, links, tags)
    else:
        ranges, anchors, mask = check_offset_epoch(ranges, anchors, links, tags, offset)
    pose, x, P, S = _states(filter, before, anchors, tags)
    new, y, _, _ = _states(filter, after, anchors, tags)
    distance, H = bounds.range_jacobian(anchors, tags, *new)
    variance = check_variance(noise.variance(ranges if offset is None else distance, mask), mask)
    shape = np.broadcast_shapes(distance.shape, ranges.shape, (*P.shape[:-2], 1, 1))
    flat = (*shape[:-2], shape[-2] * shape[-1])
    links = np.broadcast_to(True if mask is None else mask, shape).reshape(flat)
    law = getattr(getattr(filter, "filter", filter), "directions", None)
    if law is not None:
        variance = variance * np.exp(2 * direction_bias(law, *new, anchors, tags).log_std)
    variance = np.broadcast_to(variance, shape).reshape(flat)
    residual = np.broadcast_to(ranges - distance, shape).reshape(flat) - y @ S.T
    if offset is not None:
        grid = residual.reshape(shape)
        common = offsets.median(grid, links.reshape(shape), offset)
        residual = (grid - common).reshape(flat)
    moved = np.concatenate([rotations.error(new[0], pose[0]), new[1] - pose[1], y - x], axis=-1)
    used: BoolArray = np.asarray(links & (residual**2 <= GATE**2 * variance))
    H = np.swapaxes(H, -1, -2)
    v, own, nis, log_det, sound = whitened(H, S, P, moved, residual, variance, links, used)
    log_det = log_det + np.where(used, np.log(variance), 0.0).sum(axis=-1)
    dof = used.sum(axis=-1)
    refused = links.sum(axis=-1) - dof
    if offset is not None:
        counts = (used & sound[..., None])[..., None]
        scale = np.where(counts, 1 / np.sqrt(variance)[..., None], 0.0)
        A, P = np.where(counts, _joint(H, S) * scale, 0.0), np.where(sound[..., None, None], P, 0.0)
        U = offsets.columns(offset, *shape[-2:]) * scale
        white = _divided(np.where(counts, v[..., None] * scale, 0.0), A, P)[0]
        total = np.swapaxes(U, -1, -2) @ _divided(U, A, P)[0]
        empty = np.diagonal(total, axis1=-2, axis2=-1) == 0
        total = total + empty[..., None] * np.eye(U.shape[-1])
        found = np.linalg.solve(total, np.swapaxes(U, -1, -2) @ white)
        nis = nis - (found * (total @ found)).sum(axis=(-2, -1))
        log_det = log_det + np.linalg.slogdet(total)[1]
        dof = dof - (~empty).sum(axis=-1)
    likelihood = dof * LOG_USED - 0.5 * (nis + log_det) + refused * LOG_REJECTED
    if hasattr(after, "log_evidence") and after.log_weights.shape[-1] > 1:
        likelihood = after.log_evidence - before.log_evidence
    std = np.sqrt(variance * (1 + own))
    v, std, residual = (np.where(links, a, 0.0).reshape(shape) for a in (v, std, residual))
    return Innovations(
        v,
        std,
        residual,
        used.reshape(shape),
        np.where(sound, nis, np.inf),
        dof,
        np.where(sound, likelihood, -np.inf),
    )


@compiled("innovation:whiten")
def whitened(
    jacobian: FloatArray,
    slope: FloatArray,
    covariance: FloatArray,
    moved: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
    links: BoolArray,
    used: BoolArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return the innovations of L ranges and the statistic of those used.

    Parameters
    ----------
    jacobian, slope
        Derivatives H (..., L, 6) and S (L, K) by pose and other states.
    covariance, moved
        P (..., 6 + K, 6 + K) before the update, and the changes (..., 6 + K) by it.
    residual, variance
        (..., L) after the update, and of the ranges.
    links, used
        (..., L).

    Returns
    -------
    v (..., L); the diagonal (..., L) of ``A P A^T`` with ``A = R^-1/2 [H S]``; the NIS (...) and
    ``log det(I + A P A^T)`` (...) of the used ranges; whether (...) they are finite.
    """
    H, P = _joint(jacobian, slope), covariance
    v = residual + (H @ moved[..., None])[..., 0]
    scale = np.where(links, 1 / np.sqrt(variance), 0.0)
    A = H * scale[..., None]
    own = ((A @ P) * A).sum(axis=-1)
    sound = np.isfinite(own).all(axis=-1) & np.isfinite(residual).all(axis=-1)
    A = np.where((used & sound[..., None])[..., None], A, 0.0)
    P = np.where(sound[..., None, None], P, 0.0)
    u = np.where(used & sound[..., None], v * scale, 0.0)[..., None]
    white, sign, log_det = _divided(u, A, P)
    return v, own, (u * white).sum(axis=(-2, -1)), log_det, sound & (sign > 0)


def _joint(jacobian: FloatArray, slope: FloatArray) -> FloatArray:
    """Return the derivatives (..., L, 6 + K) by pose and other states."""
    slope = np.broadcast_to(slope, (*jacobian.shape[:-1], slope.shape[-1]))
    return np.concatenate([jacobian, slope], axis=-1)


def _divided(
    B: FloatArray, A: FloatArray, P: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``(I + A P A^T)^-1 B``, sign and logarithm of the determinant, in the smaller size."""
    rows, states = A.shape[-2:]
    transposed = np.swapaxes(A, -1, -2)
    if rows <= states:
        S = np.eye(rows) + A @ P @ transposed
        return np.linalg.solve(S, B), *np.linalg.slogdet(S)
    # Woodbury's identity.
    S = np.eye(states) + P @ (transposed @ A)
    return B - A @ np.linalg.solve(S, P @ (transposed @ B)), *np.linalg.slogdet(S)


def _states(
    filter: Filter, state: Any, anchors: FloatArray, tags: FloatArray
) -> tuple[tuple[FloatArray, FloatArray], FloatArray, FloatArray, FloatArray]:
    """Return pose, other states x, covariance P of both, derivative (M N, K) of ranges by x."""
    if hasattr(filter, "leader"):
        # Of several hypotheses, use the prediction of the most likely.
        filter, state = filter.filter, filter.leader(state)  # pyrefly: ignore[missing-attribute]
    own = getattr(filter, "biases_of", None)
    if own is not None:
        return (state.rotation, state.translation), *own(state, anchors)
    belief = filter.belief(state)
    x = np.zeros((*belief.translation.shape[:-1], 0))
    return belief[:2], x, belief.covariance, np.zeros((anchors.shape[-2] * tags.shape[-2], 0))
