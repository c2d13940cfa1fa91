"""The cost of directions of arrival at a pose, and sums of costs; batched.

What `range_cost.RangeCost` is to ranges. Angles and ranges of one epoch are a sum of the two.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.components import cross, first, last, trials_last
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization
from rbl_gym.estimators.costs.range_cost import Loss, weighed
from rbl_gym.measurements import bearing


class Cost(Protocol):
    """What a pose problem is made of: callable on poses, and its arrays can be picked from."""

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Cost, gradient and Gauss-Newton Hessian at poses."""
        ...

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> Cost:
        """The cost with a function of (array, number of trailing axes) applied to its arrays."""
        ...


@dataclass(frozen=True, eq=False)
class DoaCost:
    """Cost of a pose given one epoch of directions of arrival; arrays with leading batch axes.

    Parameters
    ----------
    angles, weights
        (..., 2, N): radians, inverse variances [1/rad^2]; weight 0 where nothing was measured.
    tags
        (..., N, 3), metres.
    station
        (..., 3), the base station, metres.
    loss
        Of the squared whitened residuals; None: half of them (least squares).
    """

    angles: FloatArray
    weights: FloatArray
    tags: FloatArray
    station: FloatArray
    loss: Loss | None = None

    def __post_init__(self) -> None:
        for name, trailing in (("angles", 2), ("weights", 2), ("tags", 2), ("station", 1)):
            object.__setattr__(self, name, trials_last(getattr(self, name), trailing))

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Cost, gradient and Gauss-Newton Hessian by the pose error (w, v)."""
        ndim = max(
            rotation.ndim - 2, translation.ndim - 1, self.angles.ndim - 2,
            self.weights.ndim - 2, self.tags.ndim - 2, self.station.ndim - 1,
        )  # fmt: skip
        tags = first(self.tags, 2, ndim).swapaxes(0, 1)
        turned = np.einsum("ij...,jn...->in...", first(rotation, 2, ndim), tags)
        away = first(translation, 1, ndim) - first(self.station, 1, ndim)
        found, gradient = bearing.linearize(turned + away[:, None])
        root = np.sqrt(first(self.weights, 2, ndim))
        whitened = root * (found - first(self.angles, 2, ndim))
        cost, root, whitened = weighed(self.loss, root, whitened)
        # A place moves by w x Q c + v: the derivative of an angle is (Q c x g, g).
        rows = np.empty((6, *whitened.shape))
        np.multiply(gradient.swapaxes(0, 1), root, out=rows[3:])
        for angle in (0, 1):
            rows[:3, angle] = cross(turned, rows[3:, angle][:, None])[:, 0]
        return Linearization(
            cost,
            last(np.einsum("ian...,an...->i...", rows, whitened), 1),
            last(np.einsum("ian...,jan...->ij...", rows, rows), 2),
        )

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> DoaCost:
        """The cost with a function of (array, number of trailing axes) applied to its arrays."""
        return dataclasses.replace(
            self,
            angles=function(self.angles, 2),
            weights=function(self.weights, 2),
            tags=function(self.tags, 2),
            station=function(self.station, 1),
        )


@dataclass(frozen=True, eq=False)
class SumCost:
    """Several costs of one pose together, such as angles and ranges of one epoch."""

    parts: tuple[Cost, ...]

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """The sum of the parts."""
        at = [part(rotation, translation) for part in self.parts]
        return Linearization._make(sum(fields[1:], fields[0]) for fields in zip(*at, strict=True))

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> SumCost:
        """The sum of the parts with a function applied to their arrays."""
        return SumCost(tuple(part.each(function) for part in self.parts))
