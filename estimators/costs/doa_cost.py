"""Cost of directions of arrival at a pose, and sums of costs; batched.

`DoaCost` is the counterpart of `range_cost.RangeCost`. The cost of an epoch with angles and ranges
is the sum of the two.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization
from rbl_gym.estimators.costs.losses import SQUARES, loss_of
from rbl_gym.estimators.costs.range_cost import RangeCost
from rbl_gym.measurements import bearing


@dataclass(frozen=True, eq=False)
class DoaCost:
    """Cost of a pose given one epoch of directions of arrival; arrays with leading batch axes.

    `angles` and `weights` (..., 2, N) are radians and inverse variances [1/rad^2], 0 without a
    measurement. Tags (..., N, 3) and the base station (..., 3) are in metres. `loss` (..., 5) is
    that of the squared whitened residuals, as in `losses.loss_of`.
    """

    angles: FloatArray
    weights: FloatArray
    tags: FloatArray
    station: FloatArray
    loss: FloatArray = dataclasses.field(default_factory=lambda: SQUARES)

    @property
    def batch(self) -> tuple[int, ...]:
        """The shape of the leading axes."""
        arrays = (self.angles.shape[:-2], self.weights.shape[:-2], self.tags.shape[:-2])
        return np.broadcast_shapes(*arrays, self.station.shape[:-1], self.loss.shape[:-1])

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian by the pose error (w, v)."""
        turned = self.tags @ np.swapaxes(rotation, -1, -2)
        places = turned + (translation - self.station)[..., None, :]
        residual = np.where(self.weights > 0, bearing.angles(places) - self.angles, 0.0)
        cost, share = loss_of(self.weights * residual**2, self.loss)
        # Chain rule: derivative of angles by positions, times derivative of positions by the pose.
        J = (
            bearing.jacobian(places)[..., None, :]
            @ bounds.tag_jacobian(rotation, self.tags)[..., None, :, :, :]
        )
        rows = J[..., 0, :].reshape((*residual.shape[:-2], -1, 6))
        weighted = rows * (self.weights * share).reshape((*residual.shape[:-2], -1, 1))
        flat = residual.reshape((*residual.shape[:-2], -1, 1))
        return Linearization(
            cost.sum(axis=(-2, -1)),
            (np.swapaxes(weighted, -1, -2) @ flat)[..., 0],
            np.swapaxes(weighted, -1, -2) @ rows,
        )

    def with_loss(self, loss: FloatArray) -> DoaCost:
        """Return the cost with another loss."""
        return dataclasses.replace(self, loss=loss)

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> DoaCost:
        """Apply a function of (array, number of trailing axes) to the arrays of the cost."""
        return dataclasses.replace(
            self,
            angles=function(self.angles, 2),
            weights=function(self.weights, 2),
            tags=function(self.tags, 2),
            station=function(self.station, 1),
            loss=function(self.loss, 1),
        )


@dataclass(frozen=True, eq=False)
class SumCost:
    """Sum of costs of one pose, such as angles and ranges of one epoch."""

    parts: tuple[DoaCost | RangeCost, ...]

    @property
    def batch(self) -> tuple[int, ...]:
        """The shape of the leading axes."""
        return np.broadcast_shapes(*(part.batch for part in self.parts))

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Return the sum of the parts."""
        at = [part(rotation, translation) for part in self.parts]
        return Linearization._make(sum(fields[1:], fields[0]) for fields in zip(*at, strict=True))

    def with_loss(self, loss: FloatArray) -> SumCost:
        """Return the sum of the parts with another loss."""
        return SumCost(tuple(dataclasses.replace(part, loss=loss) for part in self.parts))

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> SumCost:
        """Return the sum of the parts with a function applied to their arrays."""
        return SumCost(tuple(part.each(function) for part in self.parts))
