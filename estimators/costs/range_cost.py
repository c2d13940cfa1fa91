"""Cost of raw ranges at a pose, with gradient and Gauss-Newton Hessian; batched.

All estimators on raw ranges minimise this cost. Maximum likelihood is the cost alone, the iterated
EKF adds a prior, and robust estimation changes the loss.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization
from rbl_gym.estimators.costs.losses import SQUARES, loss_of
from rbl_gym.measurements import offsets, ranging

# Called without input checks: the inputs were checked before, or made here.
_TAG_POSITIONS, _DISTANCES = kernel(ranging.tag_positions), kernel(ranging.distances)

# Trials of a batch: a mask (...), or one index array (K,) for every axis of the batch.
Index = BoolArray | tuple[np.ndarray, ...]

# Iterations to the offset of least cost, for losses other than squares.
_STEPS = 20


@dataclass(frozen=True, eq=False)
class RangeCost:
    """Cost of a pose given one epoch of ranges; arrays with leading batch axes.

    Parameters
    ----------
    ranges, weights
        (..., M, N): metres, inverse variances [1/m^2]; weight 0 for missing links.
    anchors, tags
        (..., M, 3) and (..., N, 3), metres.
    loss
        Loss of the squared whitened residuals, (..., 5), as in `losses.loss_of`.
    tag_variance, tag_unit
        Variance [m^2] of every tag position on the body, per axis, marginalised to first order
        about unit vectors (..., M, N, 3) from anchors to tags. It correlates the ranges of a tag.
        Least squares only.
    offset
        Which ranges share an unknown offset (`measurements.offsets`). At every pose the offset has
        the value of least cost. Ranges may then have any sign.
    """

    ranges: FloatArray
    weights: FloatArray
    anchors: FloatArray
    tags: FloatArray
    loss: FloatArray = dataclasses.field(default_factory=lambda: SQUARES)
    tag_variance: float = 0.0
    tag_unit: FloatArray | None = None
    offset: str | None = None

    @property
    def batch(self) -> tuple[int, ...]:
        """The shape of the leading axes."""
        arrays = (self.ranges, self.weights, self.anchors, self.tags)
        return np.broadcast_shapes(*(a.shape[:-2] for a in arrays), self.loss.shape[:-1])

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Return cost, gradient ``J W (d - r)``, Gauss-Newton Hessian ``J W J^T`` by (w, v)."""
        distance, J = bounds.range_jacobian(self.anchors, self.tags, rotation, translation)
        residual = self.residuals(distance)
        cost, share = loss_of(self.weights * residual**2, self.loss, residual < 0)
        share = self.weights * share
        flat = (*residual.shape[:-2], 1, residual.shape[-2] * residual.shape[-1])
        if self.offset is not None:
            J = J.reshape((*J.shape[:-1], *residual.shape[-2:]))
            J = offsets.centred(J, share[..., None, :, :], self.offset).reshape(
                (*J.shape[:-2], flat[-1])
            )
        weighted = J * np.reshape(share, flat)
        at = Linearization(
            cost.sum(axis=(-2, -1)),
            np.einsum("...al,...l->...a", weighted, residual.reshape((*flat[:-2], flat[-1]))),
            weighted @ np.swapaxes(J, -1, -2),
        )
        if self.tag_unit is None:
            return at
        return self._with_tag_noise(at, J, residual, self.tag_unit)

    def residuals(self, distance: FloatArray) -> FloatArray:
        """Return distances (..., M, N) less ranges and best offsets; 0 without a link."""
        residual = np.where(self.weights > 0, distance - self.ranges, 0.0)
        if self.offset is None:
            return residual
        found = offset_of(residual, self.weights, self.loss, self.offset)
        return np.where(self.weights > 0, residual - found, 0.0)

    def offsets(self) -> np.ndarray | int:
        """Return the number (...) of unknown offsets of the ranges."""
        if self.offset is None:
            return 0
        groups = (self.weights > 0).any(axis=offsets.axes_of(self.offset), keepdims=True)
        return groups.sum(axis=(-2, -1))

    def _with_tag_noise(
        self, at: Linearization, J: FloatArray, residual: FloatArray, unit: FloatArray
    ) -> Linearization:
        """Return the linearization with tag positions marginalised, J (..., 6, M N) of the ranges.

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

    def rows(self, where: np.ndarray) -> RangeCost:
        """Return trials (K, 1) at an index (K,) of one batch axis, with an axis of 1 for starts."""
        size = self.ranges.shape[:1]
        return self.each(lambda array, n: pick(array, size, (where,), n)[:, None])

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> RangeCost:
        """Apply a function of (array, number of trailing axes) to the arrays of the cost."""
        return dataclasses.replace(
            self,
            ranges=function(self.ranges, 2),
            weights=function(self.weights, 2),
            anchors=function(self.anchors, 2),
            tags=function(self.tags, 2),
            loss=function(self.loss, 1),
            tag_unit=None if self.tag_unit is None else function(self.tag_unit, 3),
        )


def squared_residuals(cost: RangeCost, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return squared whitened residuals (..., M, N) of a cost's ranges at a pose."""
    distance = _DISTANCES(cost.anchors, _TAG_POSITIONS(rotation, translation, cost.tags))
    return cost.weights * cost.residuals(distance) ** 2


def offset_of(
    residual: FloatArray, weights: FloatArray, loss: FloatArray, offset: str
) -> FloatArray:
    """Return the offsets of least cost.

    For squares they are weighted means. For other losses the iteration starts at the median; for a
    bounded loss it finds the minimum nearest to the median.
    """
    if np.isinf(loss[..., :3]).all() and (loss[..., 4] == 1).all():
        return offsets.common(residual, weights, offset)
    found = offsets.median(residual, weights > 0, offset)
    for _ in range(_STEPS):
        left = residual - found
        share = weights * loss_of(weights * left**2, loss, left < 0)[1]
        kept = share.sum(axis=offsets.axes_of(offset), keepdims=True) > 0
        found = np.where(kept, offsets.common(residual, share, offset), found)
    return found


def pick(array: FloatArray, batch: tuple[int, ...], where: Index, trailing: int) -> FloatArray:
    """Return entries (K, ...) at an index or mask of an array that broadcasts to a batch."""
    return np.broadcast_to(array, (*batch, *array.shape[array.ndim - trailing :]))[where]
