"""The iterated extended Kalman filter on SO(3) x R^3 with raw ranges.

Every update is the maximum a posteriori pose of the epoch by Gauss-Newton, with the prior
residual ``log(Q Q_pred^T)``; it reaches the posterior Cramer-Rao bound where the linear
filters of the tracking paper, which project ``|s|^2`` out, cannot.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray, check_array, check_count, check_number
from rbl_gym.components import (
    exp_and_left_jacobian,
    first,
    inverse,
    last,
    left_jacobian_inverse,
    log,
    product,
    trials_last,
    whole_rows,
)
from rbl_gym.estimators.costs.levenberg_marquardt import Linearization, Solution, minimize_pose
from rbl_gym.estimators.costs.range_cost import Index, RangeCost, huber, lift_map, pick
from rbl_gym.estimators.costs.unseen_directions import kept_wide
from rbl_gym.estimators.filter import PoseBelief
from rbl_gym.estimators.iekf.robust_update import HUBER, robust_solution
from rbl_gym.estimators.iekf.vague_start import best_of_net, global_start, is_vague, settles
from rbl_gym.estimators.inputs import (
    check_batches,
    check_covariance,
    check_epoch,
    epoch_variance,
    plain,
)
from rbl_gym.geometry import rotations
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise, propagate

# At most so many trials, and so many links, are updated at once: the temporaries of a block
# then stay in the cache.
_BLOCK, _BLOCK_LINKS = 1024, 32_000
# Trailing axes of rotation, translation, covariance, ranges, weights, anchors.
TRAILING = (2, 1, 2, 2, 2, 2)


class PoseState(NamedTuple):
    """Pose and covariance, (..., 3, 3), (..., 3), (..., 6, 6) of the error (w, v)."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class IteratedEkf:
    """Iterated extended Kalman filter of the pose on raw ranges.

    Parameters
    ----------
    tags
        (N, 3), metres, body frame, as given; with leading axes each trial has its own.
    noise
        Law of the ranges; variances are taken at the measured ranges.
    process
        Noise of the motion.
    iterations
        Gauss-Newton iterations of an update; one alone is overconfident at high turn noise.
    robust
        Huber's loss on the whitened innovations (threshold 1.5): for real radios.
    """

    tags: FloatArray
    noise: NoiseLaw
    process: ProcessNoise
    iterations: int = 4
    robust: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "tags", check_array("tags", self.tags, ("N", 3)))
        check_count("iterations", self.iterations)
        if not isinstance(self.robust, bool):
            raise ValueError(f"robust must be True or False, got {self.robust!r}")

    @functools.cached_property
    def _lift(self) -> FloatArray | None:
        return lift_map(self.tags) if self.tags.ndim == 2 else None

    def initial(
        self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike
    ) -> PoseState:
        """State of a prior, covariance (..., 6, 6).

        Raises
        ------
        ValueError
            On wrong shapes, a matrix that is no rotation, a covariance that is not positive.
        """
        rotation = rotations.check_rotation("rotation", rotation)
        translation = check_array("translation", translation, (3,))
        covariance = check_covariance(covariance, (6,))
        batch = np.broadcast_shapes(
            rotation.shape[:-2], translation.shape[:-1], covariance.shape[:-2]
        )
        return PoseState(
            np.broadcast_to(rotation, (*batch, 3, 3)).copy(),
            np.broadcast_to(translation, (*batch, 3)).copy(),
            np.broadcast_to(covariance, (*batch, 6, 6)).copy(),
        )

    def predict(self, state: PoseState, twist: ArrayLike, dt: float) -> PoseState:
        """State after `dt` seconds of the twist (..., 6), ``P <- F P F^T + Q``."""
        twist = check_array("twist", twist, (6,))
        dt = check_number("dt", dt, low=0.0)
        if state.translation.ndim > 1 or twist.ndim > 1:
            return _predict_many(state, twist, dt, self.process)
        state = plain(state)
        rotation, translation = propagate(state.rotation, state.translation, twist, dt)
        covariance = bounds.predict_covariance(state.covariance, twist, dt, self.process)
        return PoseState(rotation, translation, covariance)

    def update(
        self,
        state: PoseState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> PoseState:
        """State after one epoch of ranges (..., M, N); `noise` is its law, None: the filter's.

        Where the prior rotation is vague in a direction that the epoch determines (a first epoch,
        a lost track), the update starts from many poses and keeps the best. What the epoch does
        not see stays as wide as it was. Among coplanar anchors the mirror pose may explain the
        ranges as well: then only a prior that knows the side tells them apart (`locate` lists both,
        ``"iekf-bank"`` follows both).

        Raises
        ------
        ValueError
            On wrong shapes, NaN, ranges that are not positive.
        """
        ranges, weights, anchors = self.weighed(ranges, anchors, links, noise)
        check_batches(state=state.translation.shape[:-1], ranges=ranges.shape[:-2])
        epoch = (*plain(state), ranges, weights, anchors)
        size = block_size(ranges) if self.tags.ndim == 2 else math.inf
        return update_in_blocks(self._update, epoch, TRAILING, size)

    def weighed(
        self,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None,
        noise: NoiseLaw | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A checked epoch as (ranges, weights, anchors): inverse variances, 0 of lost links."""
        ranges, anchors, mask = check_epoch(ranges, anchors, links, self.tags)
        weights = 1 / epoch_variance(noise, self.noise, ranges, mask)
        weights = np.broadcast_to(weights, np.broadcast_shapes(weights.shape, ranges.shape))
        return ranges, weights if mask is None else weights * mask, anchors

    @whole_rows()
    def _update(
        self, state: PoseState, ranges: FloatArray, weights: FloatArray, anchors: FloatArray
    ) -> PoseState:
        """The update of one block of trials, links as weights (..., M, N)."""
        found = as_state(self.solve(state, ranges, weights, anchors)[1])
        return kept_wide(state, found, (weights > 0).any(axis=-2), self.tags)

    def solve(
        self,
        state: PoseState,
        ranges: FloatArray,
        weights: FloatArray,
        anchors: FloatArray,
        start: tuple[FloatArray, FloatArray] | None = None,
    ) -> tuple[MapProblem, Solution]:
        """The problem of an update and its solution near a start, None: near the prior."""
        loss = huber(HUBER) if self.robust else None
        data = RangeCost(ranges, weights, anchors, self.tags, loss, lift=self._lift)
        problem = map_problem(state, data)
        if start is None:
            start = problem.prior.rotation, problem.prior.translation
            sought = self.is_sought(state, ranges, weights, anchors)
            if sought.any():
                start = global_start(problem, sought, sought.shape, best_of_net)
        found = (robust_solution if self.robust else minimize_pose)(
            problem, *start, self.iterations
        )
        return problem, found

    def is_sought(
        self, state: PoseState, ranges: FloatArray, weights: FloatArray, anchors: FloatArray
    ) -> BoolArray:
        """Where (...) an update by a checked epoch starts from many poses (`vague_start`)."""
        vague = is_vague(state.covariance)
        if not vague.any():
            return vague
        others = (array.shape[:-2] for array in (ranges, weights, anchors, self.tags))
        batch = np.broadcast_shapes(vague.shape, state.translation.shape[:-1], *others)
        data = RangeCost(ranges, weights, anchors, self.tags, lift=self._lift)
        return settles(map_problem(state, data), vague, batch)

    def belief(self, state: PoseState) -> PoseBelief:
        """The state as a belief (copies)."""
        rotation = state.rotation.copy()
        return PoseBelief(rotation, state.translation.copy(), state.covariance.copy(), rotation)


@whole_rows()
def _predict_many(
    state: PoseState, twist: FloatArray, dt: float, process: ProcessNoise
) -> PoseState:
    """`IteratedEkf.predict` by components: exp(w) and its left Jacobian from one series."""
    batch = np.broadcast_shapes(state.translation.shape[:-1], twist.shape[:-1])
    ndim = len(batch)
    twist = first(trials_last(twist, 1), 1, ndim)
    turn, jacobian = exp_and_left_jacobian(twist[:3] * dt)
    P = first(trials_last(state.covariance, 2), 2, ndim)
    variance = dt * process.std() ** 2
    top = product(turn, P[:3])
    covariance = np.empty((6, 6, *batch))
    covariance[:3, :3] = product(top[:, :3], turn.swapaxes(0, 1))
    spread = jacobian * variance[:3].reshape((3, *[1] * ndim))
    covariance[:3, :3] += product(spread, jacobian.swapaxes(0, 1))
    covariance[:3, 3:] = top[:, 3:]
    covariance[3:, :3] = top[:, 3:].swapaxes(0, 1)
    covariance[3:, 3:] = P[3:, 3:]
    for i in range(3, 6):
        covariance[i, i] += variance[i]
    rotation = product(turn, first(trials_last(state.rotation, 2), 2, ndim))
    translation = first(state.translation, 1, ndim) + twist[3:] * dt
    return PoseState(last(rotation, 2), last(translation, 1), last(covariance, 2))


def update_in_blocks(
    update: Callable[..., Any],
    epoch: Sequence[FloatArray],
    trailing: Sequence[int],
    size: float,
) -> Any:
    """`update` (state, arrays ...) over at most `size` trials at once; returns what it returns.

    `epoch`: the state's arrays and those of the measurements, each with so many `trailing` axes.
    """
    batch = np.broadcast_shapes(
        *(a.shape[: a.ndim - n] for a, n in zip(epoch, trailing, strict=True))
    )
    if math.prod(batch) <= size:
        return update(PoseState(*epoch[:3]), *epoch[3:])
    flat = [_flatten(a, n, batch) for a, n in zip(epoch, trailing, strict=True)]
    parts = []
    for start in range(0, math.prod(batch), int(size)):
        block = [a if len(a) == 1 else a[start : start + int(size)] for a in flat]
        parts.append(update(PoseState(*block[:3]), *block[3:]))
    joined = (np.concatenate(fields) for fields in zip(*parts, strict=True))
    return type(parts[0])(*(a.reshape((*batch, *a.shape[1:])) for a in joined))


def block_size(ranges: FloatArray) -> int:
    """How many trials of ranges (..., M, N) to update at once."""
    return min(_BLOCK, 1 + _BLOCK_LINKS // math.prod(ranges.shape[-2:]))


def map_problem(state: PoseState, data: Any) -> MapProblem:
    """The problem of an update: a prior and the cost of what was measured."""
    prior = PoseState(*(trials_last(a, n) for a, n in zip(state, TRAILING[:3], strict=True)))
    return MapProblem(prior, last(inverse(first(prior.covariance, 2)), 2), data)


def posterior(
    problem: MapProblem, rotation: FloatArray, translation: FloatArray, iterations: int
) -> PoseState:
    """The most likely pose near a start, with the covariance there."""
    return as_state(minimize_pose(problem, rotation, translation, iterations=iterations))


def as_state(found: Solution) -> PoseState:
    """A solution with the covariance there."""
    covariance = last(inverse(first(found.at.hessian, 2)), 2)
    fields = found.rotation, found.translation, covariance
    return PoseState(*(np.array(field, order="C") for field in fields))


@dataclass(frozen=True, eq=False)
class MapProblem:
    """Maximum a posteriori pose of one epoch; arrays with leading batch axes.

    `data` is the cost of the measurements (`RangeCost`, `doa_cost.DoaCost`, or a sum of costs).
    Cost: that of the measurements plus half the prior's Mahalanobis distance, residual
    ``(log(Q Q_pred^T), t - t_pred)``.
    """

    prior: PoseState
    prior_information: FloatArray
    data: Any

    def __call__(self, rotation: FloatArray, translation: FloatArray) -> Linearization:
        """Cost, gradient and Gauss-Newton Hessian by the pose error (w, v)."""
        data = self.data(rotation, translation)
        if rotation is self.prior.rotation and translation is self.prior.translation:
            # Of the prior itself there is no error, and its Jacobian is the identity.
            return data._replace(hessian=data.hessian + self.prior_information)
        ndim = data.cost.ndim
        information = first(self.prior_information, 2, ndim)
        turned_back = first(self.prior.rotation, 2, ndim)
        turn = log(product(first(rotation, 2, ndim), turned_back.swapaxes(0, 1)))
        shift = first(translation, 1, ndim) - first(self.prior.translation, 1, ndim)
        error = np.empty((6, *data.cost.shape))
        error[:3], error[3:] = turn, shift
        pull = product(information, error[:, None])[:, 0]
        cost = data.cost + 0.5 * np.einsum("i...,i...->...", error, pull)
        # D^T P^-1 D with D = blkdiag(Jl^-1, I), and D^T P^-1 e, added where the data's stand.
        D = left_jacobian_inverse(turn)
        gradient, hessian = first(data.gradient, 1), first(data.hessian, 2)
        gradient[:3] += product(D.swapaxes(0, 1), pull[:3, None])[:, 0]
        gradient[3:] += pull[3:]
        pulled = product(D.swapaxes(0, 1), information[:3])
        hessian[:3, :3] += product(pulled[:, :3], D)
        hessian[:3, 3:] += pulled[:, 3:]
        hessian[3:, :3] += pulled[:, 3:].swapaxes(0, 1)
        hessian[3:, 3:] += information[3:, 3:]
        return data._replace(cost=cost)

    def take(self, batch: tuple[int, ...], where: Index) -> MapProblem:
        """The trials (K,) at an index into the batch."""
        prior = PoseState(
            pick(self.prior.rotation, batch, where, 2),
            pick(self.prior.translation, batch, where, 1),
            pick(self.prior.covariance, batch, where, 2),
        )
        prior = PoseState(*(trials_last(a, n) for a, n in zip(prior, TRAILING[:3], strict=True)))
        information = trials_last(pick(self.prior_information, batch, where, 2), 2)
        data = self.data.each(lambda array, trailing: pick(array, batch, where, trailing))
        return MapProblem(prior, information, data)


def _flatten(array: FloatArray, trailing: int, batch: tuple[int, ...]) -> FloatArray:
    """An array (..., n) with one batch axis (B, n), of length 1 where it has none."""
    shape = array.shape[array.ndim - trailing :]
    if array.ndim == trailing:
        return array[None]
    return np.broadcast_to(array, (*batch, *shape)).reshape((-1, *shape))
