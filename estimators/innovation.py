"""How well a filter foretold an epoch: innovations, their covariance, NIS and likelihood.

With x the pose and the further states that bias the ranges, e and dx by how much an update moved
them, and H, S the derivatives of the ranges by them at the pose after it, the innovation is

    v = r - h(after) + H e + S dx,   cov(v) = [H S] P [H S]^T + R,

P the covariance before the update. To first order v is the range less the one foretold. Taken
about the pose after the update, it holds for a filter that starts from nothing as well, and its
normalised square is twice the cost that an iterated EKF has minimised.
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
from rbl_gym.measurements import offsets
from rbl_gym.measurements.direction_bias import direction_bias
from rbl_gym.measurements.ranging import NoiseLaw

# Standard deviations of a range beyond which it contradicts the pose after the update: it is
# refused, as by the robust filters.
GATE = 4.0
# What the likelihood supposes of refused ranges: this share of all, at any of 10 m (1/m). Without
# such a constant the deviation that refuses everything would be the likeliest.
OUTLIER_SHARE, OUTLIER_DENSITY = 0.05, 0.1
LOG_USED = np.log((1 - OUTLIER_SHARE) / np.sqrt(2 * np.pi))
LOG_REFUSED = np.log(OUTLIER_SHARE * OUTLIER_DENSITY)


class Innovations(NamedTuple):
    """What an epoch's ranges say to a filter, with leading axes.

    Attributes
    ----------
    innovation, std
        (..., M, N), metres: the range less the one foretold, and the standard deviation that the
        filter expected of that; 0 where there is no link.
    residual
        (..., M, N), metres: the range less that of the state after the update; 0 without a link.
    used
        (..., M, N): the links measured, but for the refused, whose residual is beyond `GATE`
        standard deviations of a range.
    nis
        Normalised innovation squared (...) of the ranges used, of mean `dof` where the filter is
        honest; inf where a state is not finite.
    dof
        How many ranges (...) were used.
    log_likelihood
        Natural logarithm (...) of the density of the ranges: Gaussian of those used, constant of
        those refused.
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
    """Innovations of an update, seen from the pose after it.

    Parameters
    ----------
    filter
        Any filter. One whose states bias the ranges has a method ``biases_of(state, anchors)``: the
        states besides the pose (..., K), the covariance (..., 6 + K, 6 + K) of the pose's error
        and theirs, and by how much (M N, K) each of them lengthens every range. One whose ranges
        have an offset in common has an attribute ``offset``; NIS and likelihood are then those of
        what the offsets leave, and so are the residuals.
    before, after
        Its states, as `predict` and as `update` gave them.
    ranges, anchors, links
        As `update` was told.
    tags
        Places on the body (N, 3).
    noise
        Law of the epoch.

    Raises
    ------
    ValueError
        As `update`.
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
    H = np.swapaxes(H, -1, -2)
    H = np.concatenate([H, np.broadcast_to(S, (*H.shape[:-1], S.shape[-1]))], axis=-1)
    v = residual + (H @ moved[..., None])[..., 0]
    used: BoolArray = np.asarray(links & (residual**2 <= GATE**2 * variance))
    # A = R^-1/2 H of what was used: cov(v) = R^1/2 (I + A P A^T) R^1/2.
    scale = np.where(links, 1 / np.sqrt(variance), 0.0)
    A = H * scale[..., None]
    own = ((A @ P) * A).sum(axis=-1)
    sound: BoolArray = np.isfinite(own).all(axis=-1) & np.isfinite(residual).all(axis=-1)
    A = np.where((used & sound[..., None])[..., None], A, 0.0)
    P = np.where(sound[..., None, None], P, 0.0)
    u = np.where(used & sound[..., None], v * scale, 0.0)[..., None]
    white, sign, log_det = _divided(u, A, P)
    sound = sound & (sign > 0)
    nis = (u * white).sum(axis=(-2, -1))
    log_det = log_det + np.where(used, np.log(variance), 0.0).sum(axis=-1)
    dof = used.sum(axis=-1)
    refused = links.sum(axis=-1) - dof
    if offset is not None:
        U = offsets.columns(offset, *shape[-2:]) * np.where(used, scale, 0.0)[..., None]
        total = np.swapaxes(U, -1, -2) @ _divided(U, A, P)[0]
        empty = np.diagonal(total, axis1=-2, axis2=-1) == 0
        total = total + empty[..., None] * np.eye(U.shape[-1])
        found = np.linalg.solve(total, np.swapaxes(U, -1, -2) @ white)
        nis = nis - (found * (total @ found)).sum(axis=(-2, -1))
        log_det = log_det + np.linalg.slogdet(total)[1]
        dof = dof - (~empty).sum(axis=-1)
    likelihood = dof * LOG_USED - 0.5 * (nis + log_det) + refused * LOG_REFUSED
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


def _divided(
    B: FloatArray, A: FloatArray, P: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``(I + A P A^T)^-1 B``, sign and logarithm of the determinant, in the smaller size."""
    rows, states = A.shape[-2:]
    transposed = np.swapaxes(A, -1, -2)
    if rows <= states:
        S = np.eye(rows) + A @ P @ transposed
        return np.linalg.solve(S, B), *np.linalg.slogdet(S)
    # By Woodbury's identity.
    S = np.eye(states) + P @ (transposed @ A)
    return B - A @ np.linalg.solve(S, P @ (transposed @ B)), *np.linalg.slogdet(S)


def _states(
    filter: Filter, state: Any, anchors: FloatArray, tags: FloatArray
) -> tuple[tuple[FloatArray, FloatArray], FloatArray, FloatArray, FloatArray]:
    """Pose, further states x, covariance P of both, and what x adds to the ranges (M N, K)."""
    if hasattr(filter, "leader"):
        # Of several hypotheses, what the likeliest has foretold.
        filter, state = filter.filter, filter.leader(state)  # pyright: ignore[reportAttributeAccessIssue]
    own = getattr(filter, "biases_of", None)
    if own is not None:
        return (state.rotation, state.translation), *own(state, anchors)
    belief = filter.belief(state)
    x = np.zeros((*belief.translation.shape[:-1], 0))
    return belief[:2], x, belief.covariance, np.zeros((anchors.shape[-2] * tags.shape[-2], 0))
