"""The cost of raw ranges at a pose, its gradient and Gauss-Newton Hessian; batched.

Everything an estimator on raw ranges minimises is built of this: maximum likelihood is this
cost alone, the iterated EKF adds a prior, robust estimation changes the loss.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization
from rbl_gym.measurements import offsets, ranging

# Behind the doors: what comes to these was checked, or made here.
_TAG_POSITIONS, _DISTANCES = kernel(ranging.tag_positions), kernel(ranging.distances)

# Trials of a batch: a mask (...), or one array (K,) of positions for every axis of the batch.
Index = BoolArray | tuple[np.ndarray, ...]

# A loss is five numbers (..., 5): threshold, cutoff and scale, infinite where they are not used,
# the power by which weights fall beyond the threshold, and what is left of the weight of a range
# that is late.
SQUARES = np.array([np.inf, np.inf, np.inf, 1.0, 1.0])
# Steps to the offset that a loss other than squares likes best.
_STEPS = 20


def huber(threshold: float) -> FloatArray:
    """Huber's loss: squares up to `threshold` standard deviations, straight lines beyond."""
    return np.array([threshold, np.inf, np.inf, 1.0, 1.0])


def redescending(threshold: float, late: float = 0.5) -> FloatArray:
    """Weights ``min(1, (h / |x|)^2)``, h the threshold, and of late ranges `late` times as much.

    Radio ranges err late, by reflections and obstacles, far more than early. The pull of a range
    falls with its residual x: the cost is ``x^2 / 2`` up to h, ``h^2 (1/2 + log(|x| / h))``
    beyond.
    """
    return np.array([threshold, np.inf, np.inf, 2.0, late])


def cut_huber(threshold: float, cutoff: ArrayLike) -> FloatArray:
    """Huber's loss up to `cutoff` (...) standard deviations, constant beyond: that is out."""
    return _stacked(huber(threshold), 1, cutoff)


def geman_mcclure(scale: ArrayLike) -> FloatArray:
    """Geman and McClure's loss, bounded: what is many `scale` (...) away hardly counts at all."""
    return _stacked(SQUARES, 2, scale)


# Of radio ranges: chosen on several public logs, whose figures hardly change from 0.8 to 1.
LATE = redescending(1.0, late=0.5)


def _stacked(loss: FloatArray, place: int, values: ArrayLike) -> FloatArray:
    """A loss (..., 5) with values (...) at a place."""
    values = np.asarray(values, dtype=np.float64)
    result = np.broadcast_to(loss, (*values.shape, len(loss))).copy()
    result[..., place] = values
    return result


def loss_of(
    squared: FloatArray, loss: FloatArray, late: BoolArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Cost of squared whitened residuals (..., M, N), and the share of their weight that is left.

    Parameters
    ----------
    squared
        ``x^2`` (..., M, N).
    loss
        (..., 5), from `huber`, `cut_huber`, `geman_mcclure`, `redescending`, or `SQUARES`.
        Huber's is ``x^2 / 2`` up to its threshold k, and ``k |x| - k^2 / 2`` beyond.
    late
        (..., M, N), which ranges are longer than expected; None: the loss does not ask.
    """
    threshold, cutoff, scale, power, of_late = (loss[..., i, None, None] for i in range(5))
    held = np.minimum(squared, cutoff**2)
    share = np.minimum(1.0, threshold / np.sqrt(np.maximum(held, 1e-300)))
    cost = share * held * (1 - 0.5 * share)
    if late is not None and (power == 2).any():
        beyond = (power == 2) & (share < 1)
        square = np.where(beyond, threshold, 0.0) ** 2
        cost = np.where(beyond, square * (0.5 - np.log(share)), cost)
        kept = np.where((power == 2) & late, of_late, 1.0)
        cost, share = kept * cost, kept * share**power
    bounded = np.isfinite(scale)
    square = np.where(bounded, scale, 1.0) ** 2
    left = square / (squared + square)
    return (
        np.where(bounded, 0.5 * squared * left, cost),
        np.where(bounded, left**2, np.where(squared <= cutoff**2, share, 0.0)),
    )


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
        Of the squared whitened residuals, (..., 5), as of `loss_of`.
    tag_variance, tag_unit
        Variance [m^2] of every tag's place on the body, per axis, marginalised to first order
        about unit vectors (..., M, N, 3) from anchors to tags: it ties the ranges of a tag to
        each other. Least squares only.
    offset
        Whose ranges have an unknown offset in common (`measurements.offsets`); it takes the value
        of least cost at every pose. Ranges may then have any sign.
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
        """Cost, gradient ``J W (d - r)`` and Gauss-Newton Hessian ``J W J^T`` by the pose error."""
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
        """Distances (..., M, N) less ranges, the likeliest offsets taken out; 0 without a link."""
        residual = np.where(self.weights > 0, distance - self.ranges, 0.0)
        if self.offset is None:
            return residual
        found = offset_of(residual, self.weights, self.loss, self.offset)
        return np.where(self.weights > 0, residual - found, 0.0)

    def offsets(self) -> np.ndarray | int:
        """How many unknown offsets (...) the ranges have."""
        if self.offset is None:
            return 0
        groups = (self.weights > 0).any(axis=offsets.axes_of(self.offset), keepdims=True)
        return groups.sum(axis=(-2, -1))

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

    def rows(self, where: np.ndarray) -> RangeCost:
        """The trials (K, 1) at an index (K,) into one batch axis, with an axis of 1 for starts."""
        size = self.ranges.shape[:1]
        return self.each(lambda array, n: pick(array, size, (where,), n)[:, None])

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> RangeCost:
        """The cost with a function of (array, number of trailing axes) applied to its arrays."""
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
    """Squared whitened residuals (..., M, N) of a cost's ranges at a pose."""
    distance = _DISTANCES(cost.anchors, _TAG_POSITIONS(rotation, translation, cost.tags))
    return cost.weights * cost.residuals(distance) ** 2


def offset_of(
    residual: FloatArray, weights: FloatArray, loss: FloatArray, offset: str
) -> FloatArray:
    """The offsets of least cost: weighted means, of another loss than squares from the median on.

    Of a bounded loss that is the minimum nearest to the median.
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
    """The entries (K, ...) at an index, or of a mask, into an array that broadcasts to a batch."""
    return np.broadcast_to(array, (*batch, *array.shape[array.ndim - trailing :]))[where]
