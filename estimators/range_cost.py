"""The cost of raw ranges at a pose, its gradient and Gauss-Newton Hessian; batched.

Everything an estimator on raw ranges minimises is built of this: maximum likelihood is this
cost alone, the iterated EKF adds a prior, robust estimation changes the loss.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.components import cross, first, last, trials_last
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


class TagMaps(NamedTuple):
    """Linear maps (6, 3 N) and (36, 9 N) from all tags' forces and information to the pose's."""

    gradient: FloatArray
    hessian: FloatArray


def tag_maps(tags: FloatArray) -> TagMaps:
    """The maps of tags (N, 3): constant in the body frame, so that one product lifts a batch."""
    T = np.swapaxes(bounds.tag_jacobian(np.eye(3), tags), -1, -2)
    hessian = np.einsum("nai,nbj->abijn", T, T)
    return TagMaps(np.einsum("nai->ain", T).reshape(6, -1), hessian.reshape(36, -1))


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
    maps
        `tag_maps` of the tags where all trials share them: the same sums in less time.
    """

    ranges: FloatArray
    weights: FloatArray
    anchors: FloatArray
    tags: FloatArray
    loss: Loss | None = None
    tag_variance: float = 0.0
    tag_unit: FloatArray | None = None
    maps: TagMaps | None = None

    def __post_init__(self) -> None:
        for name in ("ranges", "weights", "anchors", "tags"):
            object.__setattr__(self, name, trials_last(getattr(self, name), 2))

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Cost, gradient and Gauss-Newton Hessian by the pose error (w, v).

        All in the body frame, where the tags rest: with u the unit vectors from anchors to tags,
        ``S_n = sum_m w u u^T`` is the information about the place of a tag, and
        ``T_n = [[c_n]x; I]`` takes it to the pose.
        """
        ndim = max(
            rotation.ndim - 2, translation.ndim - 1, self.ranges.ndim - 2,
            self.weights.ndim - 2, self.anchors.ndim - 2, self.tags.ndim - 2,
        )  # fmt: skip
        ranges, weights = first(self.ranges, 2, ndim), first(self.weights, 2, ndim)
        tags = first(self.tags, 2, ndim).swapaxes(0, 1)
        Q = first(rotation, 2, ndim)
        away = first(self.anchors, 2, ndim) - first(translation, 1, ndim)
        anchors = np.einsum("ji...,mj...->im...", Q, away)
        difference = tags[:, None] - anchors[:, :, None]
        distance = np.sqrt(np.einsum("imn...,imn...->mn...", difference, difference))
        # Where an anchor stands on a tag the difference is zero, and so is the direction.
        unit = np.divide(difference, np.maximum(distance, 1e-300), out=difference)
        residual = distance - ranges
        pull = weights * residual
        squared = pull * residual
        if self.loss is None:
            cost = 0.5 * squared.sum(axis=(0, 1))
        else:
            costs, factor = self.loss(last(squared, 2))
            cost, factor = costs.sum(axis=(-2, -1)), first(factor, 2)
            weights, pull = weights * factor, pull * factor
        S = np.einsum("imn...,jmn...->ijn...", weights * unit, unit)
        force = np.einsum("mn...,imn...->in...", pull, unit)
        gradient, hessian = self._lift(force, S)
        # Blocks of the rotation and of the translation turn alike: blkdiag(Q, Q).
        half = np.einsum("ij...,ajbk...->aibk...", Q, hessian)
        hessian = np.einsum("aibj...,kj...->aibk...", half, Q)
        gradient = np.einsum("ij...,aj...->ai...", Q, gradient)
        at = Linearization(
            cost,
            last(gradient.reshape((6, *cost.shape)), 1),
            last(hessian.reshape((6, 6, *cost.shape)), 2),
        )
        if self.tag_unit is None:
            return at
        _, J = bounds.range_jacobian(self.anchors, self.tags, rotation, translation)
        return self._with_tag_noise(at, J, last(residual, 2), self.tag_unit)

    def _lift(self, force: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sums of ``T_n f_n`` (2, 3, ...) and ``T_n S_n T_n^T`` (2, 3, 2, 3, ...) over the tags."""
        batch = S.shape[3:]
        if self.maps is not None:
            gradient = self.maps.gradient @ force.reshape((self.maps.gradient.shape[-1], -1))
            hessian = self.maps.hessian @ S.reshape((self.maps.hessian.shape[-1], -1))
            return gradient.reshape((2, 3, *batch)), hessian.reshape((2, 3, 2, 3, *batch))
        tags = first(self.tags, 2, len(batch)).swapaxes(0, 1)
        gradient, hessian = np.empty((2, 3, *batch)), np.empty((2, 3, 2, 3, *batch))
        lifted = cross(tags, S)
        gradient[0] = cross(tags, force[:, None])[:, 0].sum(axis=1)
        gradient[1] = force.sum(axis=1)
        hessian[0, :, 0] = cross(tags, lifted.swapaxes(0, 1)).sum(axis=2)
        hessian[0, :, 1] = lifted.sum(axis=2)
        hessian[1, :, 0] = hessian[0, :, 1].swapaxes(0, 1)
        hessian[1, :, 1] = S.sum(axis=2)
        return gradient, hessian

    def _with_tag_noise(
        self, at: Linearization, J: FloatArray, residual: FloatArray, unit: FloatArray
    ) -> Linearization:
        """The linearization with the tags' places marginalised, J (..., 6, M N) of the ranges.

        The covariance of a tag's ranges is ``diag(1 / w) + s^2 U U^T``; its inverse by Woodbury.
        """
        J = J.reshape((*J.shape[:-1], *residual.shape[-2:]))
        base = self.weights[..., None] * unit
        gram = np.einsum("...mni,...mnj->...nij", base, unit)
        inner = self.tag_variance * np.linalg.inv(np.eye(3) + self.tag_variance * gram)
        projected = np.einsum("...mni,...mn->...ni", base, residual)
        eased = (inner @ projected[..., None])[..., 0]
        cross_terms = np.einsum("...amn,...mni->...nia", J, base)
        return Linearization(
            at.cost - 0.5 * np.einsum("...ni,...ni->...", projected, eased),
            at.gradient - np.einsum("...nia,...ni->...a", cross_terms, eased),
            at.hessian - bounds.lift(cross_terms, inner),
        )

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


def pick(array: FloatArray, where: BoolArray, trailing: int) -> FloatArray:
    """The entries of a mask (...), (K, 1, ...): flat, with an axis of 1 for starts."""
    shape = (*where.shape, *array.shape[array.ndim - trailing :])
    return np.broadcast_to(array, shape)[where][:, None]
