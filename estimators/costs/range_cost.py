"""The cost of raw ranges at a pose, its gradient and Gauss-Newton Hessian; batched.

Everything an estimator on raw ranges minimises is built of this: maximum likelihood is this
cost alone, the iterated EKF adds a prior, robust estimation changes the loss.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.components import cross, first, last, trials_last
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization
from rbl_gym.measurements import ranging

# A loss takes squared whitened residuals to (their cost, the weight of each in least squares).
Loss = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
# Trials of a batch: a mask (...), or one array (K,) of positions for every axis of the batch.
Index = BoolArray | tuple[np.ndarray, ...]


def huber(threshold: float) -> Loss:
    """Huber's loss: squares up to `threshold` standard deviations, straight lines beyond."""

    def loss(squared: FloatArray) -> tuple[FloatArray, FloatArray]:
        weight = threshold / np.sqrt(np.maximum(squared, threshold**2))
        # x^2 / 2 inside, k x - k^2 / 2 outside, with weight = min(1, k / x).
        return weight * squared * (1 - 0.5 * weight), weight

    return loss


def cut_huber(threshold: float, cutoff: FloatArray | float) -> Loss:
    """Huber's loss up to `cutoff` standard deviations, constant beyond: what is farther is out."""
    inner, limit = huber(threshold), np.square(cutoff)

    def loss(squared: FloatArray) -> tuple[FloatArray, FloatArray]:
        cost, weight = inner(np.minimum(squared, limit))
        return cost, np.where(squared <= limit, weight, 0.0)

    return loss


def geman_mcclure(scale: FloatArray | float) -> Loss:
    """Geman and McClure's loss, bounded: what is many `scale` away hardly counts at all."""

    def loss(squared: FloatArray) -> tuple[FloatArray, FloatArray]:
        square = np.square(scale)
        share = square / (squared + square)
        return 0.5 * squared * share, share**2

    return loss


def weighed(
    loss: Loss | None, root: FloatArray, whitened: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The cost (...) of whitened residuals (m, n, ...), and roots of weights and residuals in it.

    None: squares, which leave both as they are.
    """
    if loss is None:
        return 0.5 * np.einsum("mn...,mn...->...", whitened, whitened), root, whitened
    costs, factor = loss(last(np.square(whitened), 2))
    share = np.sqrt(first(factor, 2))
    return costs.sum(axis=(-2, -1)), root * share, whitened * share


# Rows (i, j) of the sums over anchors that a pose needs of every tag: the information
# S[i, j] = S[j, i] about its place, and the force on it as S[3, j].
_SUMS = [(i, j) for j in range(3) for i in range(j, 4)]
_INFORMATION = [[_SUMS.index((max(i, j), min(i, j))) for j in range(3)] for i in range(3)]
_FORCE = [_SUMS.index((3, j)) for j in range(3)]


def lift_map(tags: FloatArray) -> FloatArray:
    """The matrix (42, 9 N) from all tags' sums to the pose's Hessian beside its gradient (6, 7).

    It is constant in the body frame, so that one product lifts a whole batch.
    """
    T = np.swapaxes(bounds.tag_jacobian(np.eye(3), tags), -1, -2)
    hessian = np.einsum("nai,nbj->ijabn", T, T)
    lift = np.zeros((6, 7, len(_SUMS), len(tags)))
    for row, (i, j) in enumerate(_SUMS):
        if i == 3:
            lift[:, 6, row] = T[..., j].T
        else:
            lift[:, :6, row] = hessian[i, j] if i == j else hessian[i, j] + hessian[j, i]
    return lift.reshape(42, -1)


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
    lift
        `lift_map` of the tags where all trials share them: the same sums in less time.
    """

    ranges: FloatArray
    weights: FloatArray
    anchors: FloatArray
    tags: FloatArray
    loss: Loss | None = None
    tag_variance: float = 0.0
    tag_unit: FloatArray | None = None
    lift: FloatArray | None = None

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
        ranges, root = first(self.ranges, 2, ndim), first(self._root, 2, ndim)
        tags = first(self.tags, 2, ndim).swapaxes(0, 1)
        Q = first(rotation, 2, ndim)
        away = first(self.anchors, 2, ndim) - first(translation, 1, ndim)
        anchors = np.einsum("ji...,mj...->im...", Q, away)
        difference = tags[:, None] - anchors[:, :, None]
        square = np.einsum("imn...,imn...->mn...", difference, difference)
        # Where an anchor stands on a tag the difference is zero, and so is the direction.
        distance = np.sqrt(np.maximum(square, 1e-200, out=square), out=square)
        residual = distance - ranges
        whitened = root * residual
        cost, root, whitened = weighed(self.loss, root, whitened)
        # Every link's row of the whitened problem: direction and residual.
        rows = np.empty((4, *whitened.shape))
        np.multiply(difference, root / distance, out=rows[:3])
        rows[3] = whitened
        sums = np.empty((len(_SUMS), *rows.shape[2:]))
        for j, out in enumerate((sums[:4], sums[4:7], sums[7:])):
            np.einsum("imn...,mn...->in...", rows[j:], rows[j], out=out)
        # Blocks of the rotation and of the translation turn alike: blkdiag(Q, Q).
        half = np.einsum("ij...,ajk...->aik...", Q, self._lift(sums))
        hessian = half[:, :, :6].reshape((2, 3, 2, 3, *cost.shape))
        hessian = np.einsum("aibj...,kj...->aibk...", hessian, Q)
        at = Linearization(
            cost,
            last(half[:, :, 6].reshape((6, *cost.shape)), 1),
            last(hessian.reshape((6, 6, *cost.shape)), 2),
        )
        if self.tag_unit is None:
            return at
        _, J = bounds.range_jacobian(self.anchors, self.tags, rotation, translation)
        return self._with_tag_noise(at, J, last(residual, 2), self.tag_unit)

    @functools.cached_property
    def _root(self) -> FloatArray:
        return np.sqrt(self.weights)

    def _lift(self, sums: FloatArray) -> FloatArray:
        """``sum_n T_n S_n T_n^T`` beside ``sum_n T_n f_n``, (2, 3, 7, ...), of the tags' sums."""
        batch = sums.shape[2:]
        if self.lift is not None:
            lifted = self.lift @ sums.reshape((self.lift.shape[1], -1))
            return lifted.reshape((2, 3, 7, *batch))
        tags = first(self.tags, 2, len(batch)).swapaxes(0, 1)
        S, force = sums[_INFORMATION], sums[_FORCE]
        lifted = np.empty((2, 3, 7, *batch))
        moved = cross(tags, S)
        lifted[0, :, :3] = cross(tags, moved.swapaxes(0, 1)).sum(axis=2)
        lifted[0, :, 3:6] = moved.sum(axis=2)
        lifted[1, :, :3] = lifted[0, :, 3:6].swapaxes(0, 1)
        lifted[1, :, 3:6] = S.sum(axis=2)
        lifted[0, :, 6] = cross(tags, force[:, None])[:, 0].sum(axis=1)
        lifted[1, :, 6] = force.sum(axis=1)
        return lifted

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
        return self.each(lambda array, n: pick(array, where.shape, where, n)[:, None])

    def each(self, function: Callable[[FloatArray, int], FloatArray]) -> RangeCost:
        """The cost with a function of (array, number of trailing axes) applied to its arrays."""
        return dataclasses.replace(
            self,
            ranges=function(self.ranges, 2),
            weights=function(self.weights, 2),
            anchors=function(self.anchors, 2),
            tags=function(self.tags, 2) if self.lift is None else self.tags,
            tag_unit=None if self.tag_unit is None else function(self.tag_unit, 3),
        )


def squared_residuals(cost: RangeCost, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Squared whitened residuals (..., M, N) of a cost's ranges at a pose."""
    positions = ranging.tag_positions(rotation, translation, cost.tags)
    return cost.weights * (ranging.distances(cost.anchors, positions) - cost.ranges) ** 2


def pick(array: FloatArray, batch: tuple[int, ...], where: Index, trailing: int) -> FloatArray:
    """The entries (K, ...) at an index, or of a mask, into an array that broadcasts to a batch."""
    return np.broadcast_to(array, (*batch, *array.shape[array.ndim - trailing :]))[where]
