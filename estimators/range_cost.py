"""The cost of raw ranges at a pose, its gradient and Gauss-Newton Hessian; batched.

Everything an estimator on raw ranges minimises is built of this: maximum likelihood is this
cost alone, the iterated EKF adds a prior, robust estimation changes the loss.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.levenberg_marquardt import Linearization

# A loss takes squared whitened residuals to (their cost, the weight of each in least squares).
Loss = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def huber(threshold: float) -> Loss:
    """Huber's loss: squares up to `threshold` standard deviations, straight lines beyond."""

    def loss(squared: FloatArray) -> tuple[FloatArray, FloatArray]:
        weight = threshold / np.sqrt(np.maximum(squared, threshold**2))
        # x^2 / 2 inside, k x - k^2 / 2 outside, with weight = min(1, k / x).
        return weight * squared * (1 - 0.5 * weight), weight

    return loss


def geman_mcclure(scale: FloatArray | float) -> Loss:
    """Geman and McClure's loss, bounded: what is many `scale` away hardly counts at all."""

    def loss(squared: FloatArray) -> tuple[FloatArray, FloatArray]:
        square = np.square(scale)
        share = square / (squared + square)
        return 0.5 * squared * share, share**2

    return loss


@dataclass(frozen=True, eq=False)
class RangeCost:
    """Cost of a pose given one epoch of ranges; arrays with leading batch axes.

    Parameters
    ----------
    ranges, weights
        (..., M, N): metres, inverse variances [1/m^2]; weight 0 where a link is missing.
    anchors, tags
        (..., M, 3) and (..., N, 3), metres.
    loss
        Of the squared whitened residuals; None: half of them (least squares).
    tag_variance, tag_unit
        Variance [m^2] of every tag's place on the body, per axis, marginalised to first order
        about unit vectors (..., M, N, 3) from anchors to tags: it ties the ranges of a tag to
        each other. Least squares only.
    """

    ranges: FloatArray
    weights: FloatArray
    anchors: FloatArray
    tags: FloatArray
    loss: Loss | None = None
    tag_variance: float = 0.0
    tag_unit: FloatArray | None = None

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Cost, gradient and Gauss-Newton Hessian by the pose error (w, v)."""
        distance, J = bounds.range_jacobian(self.anchors, self.tags, rotation, translation)
        residual = distance - self.ranges
        weights = self.weights
        squared = weights * residual**2
        if self.loss is None:
            cost = 0.5 * squared.sum(axis=(-2, -1))
        else:
            costs, factor = self.loss(squared)
            cost = costs.sum(axis=(-2, -1))
            weights = weights * factor
        pull = weights * residual
        hessian = (J * _row(weights)) @ np.swapaxes(J, -1, -2)
        if self.tag_unit is not None:
            # The covariance of a tag's ranges is diag(1/w) + s^2 U U^T; its inverse by Woodbury.
            base = weights[..., None] * self.tag_unit
            gram = np.einsum("...mni,...mnj->...nij", base, self.tag_unit)
            inner = self.tag_variance * np.linalg.inv(np.eye(3) + self.tag_variance * gram)
            projected = np.einsum("...mni,...mn->...ni", base, residual)
            eased = (inner @ projected[..., None])[..., 0]
            cost = cost - 0.5 * np.einsum("...ni,...ni->...", projected, eased)
            pull = pull - np.einsum("...mni,...ni->...mn", base, eased)
            per_link = J.reshape((*J.shape[:-1], *weights.shape[-2:]))
            cross = np.einsum("...amn,...mni->...nia", per_link, base)
            hessian = hessian - bounds.lift(cross, inner)
        gradient = (J @ np.swapaxes(_row(pull), -1, -2))[..., 0]
        return Linearization(cost, gradient, hessian)

    def take(self, where: BoolArray) -> RangeCost:
        """The trials of a mask (...) on one flat axis, with a further axis of 1 for starts."""
        return dataclasses.replace(
            self,
            ranges=pick(self.ranges, where, 2),
            weights=pick(self.weights, where, 2),
            anchors=pick(self.anchors, where, 2),
            tags=pick(self.tags, where, 2),
            tag_unit=None if self.tag_unit is None else pick(self.tag_unit, where, 3),
        )


def _row(per_link: FloatArray) -> FloatArray:
    """(..., M, N) as one row (..., 1, M N)."""
    return per_link.reshape((*per_link.shape[:-2], 1, -1))


def pick(array: FloatArray, where: BoolArray, trailing: int) -> FloatArray:
    """The entries of a mask (...), (K, 1, ...): flat, with an axis of 1 for starts."""
    shape = (*where.shape, *array.shape[array.ndim - trailing :])
    return np.broadcast_to(array, shape)[where][:, None]
