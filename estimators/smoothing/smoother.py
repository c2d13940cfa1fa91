"""Smoother: estimate all poses of a log together, each from all ranges before and after it.

The estimate is the maximum a posteriori of the whole log, found by Gauss-Newton. Steps are damped
if the cost would rise. The models are the same as in the filters: `KnownTwist` as in ``"iekf"``,
`UnknownTwist` as in ``"iekf-cv"``, and link biases. For a linear model the result equals the
Rauch-Tung-Striebel smoother.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_count
from rbl_gym.estimators.costs.losses import SQUARES, huber
from rbl_gym.estimators.costs.map_problem import PoseState, positive_inverse
from rbl_gym.estimators.inputs import (
    check_covariance,
    check_epoch,
    check_offset_epoch,
    epoch_variance,
)
from rbl_gym.estimators.smoothing.clocks import add_clocks, clock_block, first_offsets
from rbl_gym.estimators.smoothing.equations import (
    Equations,
    Factor,
    LogState,
    Rows,
    moved,
    with_turning,
)
from rbl_gym.estimators.smoothing.motion import Motion
from rbl_gym.estimators.smoothing.ranges import (
    BiasBlock,
    Layout,
    LogRanges,
    add_biases,
    bias_blocks,
    bias_of,
)
from rbl_gym.geometry import rotations
from rbl_gym.kernels.constants import HUBER
from rbl_gym.measurements import offsets, ranging
from rbl_gym.measurements.direction_bias import DirectionLaw, direction_bias
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.measurements.noise_laws import NoiseLaw
from rbl_gym.measurements.offsets import Clock

__all__ = ["LogModel", "RangeLog", "Smoothed", "smooth"]

# Iteration stops if the predicted decrease of the cost per epoch is below this.
_TOLERANCE, _COARSE = 1e-6, 1e-3
# Damping: information (1/rad^2, 1/m^2) added to a pose if a step goes too far, small and large.
_SMALL, _MOST_DAMPING = 0.1, 1e12


class RangeLog(NamedTuple):
    """Ranges of a log of K epochs, at any spacing; arrays with leading batch axes.

    Asynchronous ranges are epochs of one link each.

    Attributes
    ----------
    times
        (..., K), seconds, not decreasing.
    ranges
        (..., K, M, N), metres.
    anchors
        (M, 3), or (..., K, M, 3) if they move or differ between logs, metres.
    links
        (..., K, M, N), True where a range was measured; None: all.
    noise
        Noise model of these ranges, such as `rbl_gym.ranging.LinkNoise` with standard deviations
        (..., K, M, N); None: the noise model of the `LogModel`.
    """

    times: ArrayLike
    ranges: ArrayLike
    anchors: ArrayLike
    links: ArrayLike | None = None
    noise: NoiseLaw | None = None


@dataclass(frozen=True, eq=False)
class LogModel:
    """Model that a smoother assumes for a log.

    Parameters
    ----------
    tags
        (N, 3), metres, body frame.
    noise
        Noise model of the ranges; variances are evaluated at the measured ranges.
    motion
        `KnownTwist`, `UnknownTwist`, or any other `Motion`.
    biases
        Models of the link biases, which add up. Constant biases are estimated from the whole log.
    factors
        Other measurements or prior knowledge, for instance `Level`.
    loss
        Loss of the range residuals, from `rbl_gym.estimators.costs.range_cost`: squares, or
        `huber`. The search with a non-convex loss starts with the Huber loss.
    offset
        Which ranges share an unknown offset that is new at every epoch, as in `IteratedEkf`.
        Variances are then evaluated at the distances of the start.
    clock
        Model of clock offsets that persist, in place of `offset`. Their states are eliminated with
        the others.
    directions
        Range bias as a function of the direction of the ray, at the estimated poses. Its standard
        deviations are evaluated at the start.
    """

    tags: FloatArray
    noise: NoiseLaw
    motion: Motion
    biases: tuple[LinkBias, ...] = ()
    factors: tuple[Factor, ...] = ()
    loss: FloatArray = dataclasses.field(default_factory=lambda: SQUARES)
    offset: str | None = None
    clock: Clock | None = None
    directions: DirectionLaw | None = None

    def __post_init__(self) -> None:
        tags = check_array("tags", self.tags, ("N", 3))
        if tags.ndim != 2:
            raise ValueError(f"tags must be (N, 3), got shape {tags.shape}")
        object.__setattr__(self, "tags", tags)
        offsets.check_offset(self.offset)
        if not isinstance(self.clock, Clock | None):
            raise ValueError(f"clock must be a Clock or None, got {self.clock!r:.80}")
        if self.clock is not None and self.offset is not None:
            raise ValueError(f"offset must be None with a clock, got {self.offset!r}")
        for law in self.biases:
            if not isinstance(law, LinkBias):
                raise ValueError(f"biases must be a tuple of LinkBias, got {law!r:.80}")


class Smoothed(NamedTuple):
    """Most likely track of a log; arrays with leading batch axes.

    Attributes
    ----------
    rotation, translation, covariance
        Poses of the K epochs: (..., K, 3, 3), (..., K, 3), and (..., K, 6, 6) of the error (w, v).
    extra, extra_covariance
        (..., K, e) and (..., K, e, e): the extra states of the motion model, such as the twist of
        `UnknownTwist`.
    biases
        (..., K, M, N), metres: the sum of constant and drifting biases of each link.
    constants, constants_covariance
        (..., c) and (..., c, c): constants of the motion, of the factors, then constant biases.
    residuals
        (..., K, M, N), range less its prediction, metres; 0 where no range was measured.
    squares, freedom
        (..., K): squared whitened residuals of an epoch, weighted by the loss, and their
        expectation. The ratio of their sums over many epochs is 1 if the model is correct.
    cost
        (...), negative logarithm of the posterior density, up to a constant.
    converged
        (...), whether the last step was negligible.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    extra: FloatArray
    extra_covariance: FloatArray
    biases: FloatArray
    constants: FloatArray
    constants_covariance: FloatArray
    residuals: FloatArray
    squares: FloatArray
    freedom: FloatArray
    cost: FloatArray
    converged: BoolArray


def smooth(
    log: RangeLog,
    model: LogModel,
    prior: PoseState | Sequence[ArrayLike],
    start: Sequence[ArrayLike],
    iterations: int = 50,
) -> Smoothed:
    """Estimate the most likely track of a log of ranges, and the covariances of its poses.

    Parameters
    ----------
    log
        The measurements.
    model
        The assumed model.
    prior
        Rotation (..., 3, 3), translation (..., 3) and covariance (..., 6, 6) at the first epoch,
        before its ranges.
    start
        Rotations (..., K, 3, 3) and translations (..., K, 3) from which Gauss-Newton starts, for
        instance the track of a filter (`causal_track`). The result is a local optimum near them.
    iterations
        Maximum number of iterations.

    Raises
    ------
    ValueError
        If shapes do not match, values are NaN, ranges are not positive, times decrease, or log and
        prior together do not determine a state.
    """
    iterations = check_count("iterations", iterations)
    problem, state = _checked(log, model, prior, start)
    if not _is_convex(model.loss):
        state, _, _ = problem.minimize(state, huber(HUBER), iterations, _COARSE)
    state, equations, converged = problem.minimize(state, model.loss, iterations, _TOLERANCE)
    covariances = equations.covariances()
    P, _, constants = covariances
    if not np.isfinite(P).all():
        raise ValueError(
            "log and prior must determine every state, but some have no information: give a "
            "finite prior covariance, or more ranges"
        )
    squares, freedom = problem.ranges.consistency(state, model.loss, covariances)
    if model.motion.turning:
        P = _of_errors(P, state)
    e = 6 + len(model.motion.extra_std)
    shape = problem.ranges.shape
    residuals = problem.ranges.spread(-problem.ranges.residual(state, model.loss)[0])
    biases = bias_of(problem.ranges.blocks, state, shape[0] * shape[1])
    return Smoothed(
        state.rotation, state.translation, P[..., :6, :6],
        state.extra[..., : e - 6], P[..., 6:e, 6:e],
        biases.reshape((*biases.shape[:-1], *shape)), state.constants, constants,
        residuals, squares, freedom, equations.cost, converged,
    )  # fmt: skip


def _of_errors(P: FloatArray, state: LogState) -> FloatArray:
    """Return the covariance (..., K, n, n) of errors from that of steps; see `with_turning`."""
    T = np.broadcast_to(np.eye(P.shape[-1]), P.shape).copy()
    T[..., 6:9, :3] = -rotations.hat(state.extra[..., :3])
    return T @ P @ np.swapaxes(T, -1, -2)


def _is_convex(loss: FloatArray) -> bool:
    """Return whether a loss is convex: squares, or Huber's."""
    return bool(np.isinf(loss[..., 1:3]).all() and (loss[..., 3:4] == 1).all())


@dataclass(frozen=True, eq=False)
class _Problem:
    """All terms of the cost of a log; see `smooth`."""

    times: FloatArray
    ranges: LogRanges
    motion: Motion
    factors: tuple[Factor, ...]
    prior: PoseState
    information: FloatArray
    clocks: tuple[BiasBlock, Clock, FloatArray] | None = None

    def linearize(self, state: LogState, loss: FloatArray) -> Equations:
        batch, K = state.translation.shape[:-2], state.translation.shape[-2]
        n = 6 + state.extra.shape[-1]
        equations = Equations.empty(batch, K, n, state.constants.shape[-1])
        equations.add_pose_prior(state, self.prior, self.information)
        equations.add(self._turned(self._extra_prior(state), state))
        first = 0
        for factor in (self.motion, *self.factors):
            where = slice(first, first + len(factor.constants_std))
            own = state.constants[..., where]
            rows = factor.linearize(state, self.times, own)
            equations.add(self._turned(rows, state), first)
            if where.stop > first:
                equations.add_constants_prior(where, own, factor.constants_std)
            first = where.stop
        add_biases(equations, self.ranges.blocks, state, self.times)
        if self.clocks is not None:
            add_clocks(equations, *self.clocks, state, self.times)
        self.ranges.add(equations, state, loss)
        return equations

    def _extra_prior(self, state: LogState) -> Rows:
        """Add the prior of the extra states of the first epoch."""
        std = self.motion.extra_std
        A = np.zeros((*state.extra.shape[:-2], 1, len(std), 6 + len(std)))
        A[..., range(len(std)), range(6, 6 + len(std))] = 1 / std
        return Rows(state.extra[..., :1, : len(std)] / std, A)

    def _turned(self, rows: Rows, state: LogState) -> Rows:
        return with_turning(rows, state) if self.motion.turning else rows

    def minimize(
        self, state: LogState, loss: FloatArray, iterations: int, tolerance: float
    ) -> tuple[LogState, Equations, BoolArray]:
        """Return the state, its equations, and whether it converged (...), from a start."""
        equations = self.linearize(state, loss)
        damping = np.zeros(equations.cost.shape)
        converged = np.zeros(equations.cost.shape, np.bool_)
        for _ in range(iterations):
            x, y, decrease = equations.step(damping)
            new = moved(state, x, y, self.motion.turning)
            cost, equations = equations.cost, self.linearize(new, loss)
            # A difference within rounding counts as equal.
            better = (equations.cost <= cost * (1 + 1e-12)) | (np.abs(decrease) < 1e-8)
            taken = better & ~converged
            if not taken.all():
                kept = zip(new, state, (3, 2, 2, 1), strict=True)
                new = LogState(*(_where(taken, a, b, axes) for a, b, axes in kept))
                equations = self.linearize(new, loss)
            state = new
            # With strong damping, a short step does not show convergence.
            short = (decrease < tolerance * state.translation.shape[-2]) & (damping <= _SMALL)
            converged = converged | (better & short)
            eased = np.where(damping > 0.1 * _SMALL, 0.3 * damping, 0.0)
            damping = np.where(better, eased, np.clip(10 * damping, _SMALL, _MOST_DAMPING))
            if converged.all():
                break
        return state, equations, converged


def _where(taken: BoolArray, a: FloatArray, b: FloatArray, axes: int) -> FloatArray:
    return np.where(taken.reshape(taken.shape + (1,) * axes), a, b)


def _checked(
    log: RangeLog, model: LogModel, prior: Any, start: Sequence[ArrayLike]
) -> tuple[_Problem, LogState]:
    """Check the arguments; return the problem and its initial state."""
    times = check_array("times", log.times, ("K",))
    if (np.diff(times) < 0).any():
        raise ValueError(f"times must not decrease, got a step of {np.diff(times).min():g} s")
    if model.offset is None:
        signed = model.clock is not None
        epoch = log.ranges, log.anchors, log.links, model.tags
        ranges, anchors, mask = check_epoch(*epoch, signed=signed)
    else:
        epoch = log.ranges, log.anchors, log.links, model.tags
        ranges, anchors, mask = check_offset_epoch(*epoch, model.offset)
    rotation, translation, covariance = prior
    rotation = rotations.check_rotation("prior rotation", rotation)
    translation = check_array("prior translation", translation, (3,))
    covariance = check_covariance(covariance, (6,))
    Q = rotations.check_rotation("start rotation", start[0])
    t = check_array("start translation", start[1], ("K", 3))
    K = times.shape[-1]
    try:
        batch = np.broadcast_shapes(
            times.shape[:-1], ranges.shape[:-3], anchors.shape[:-3], rotation.shape[:-2],
            translation.shape[:-1], covariance.shape[:-2], Q.shape[:-3], t.shape[:-2],
        )  # fmt: skip
        ranges = np.broadcast_to(ranges, (*batch, K, *ranges.shape[-2:]))
        anchors = np.broadcast_to(anchors, (*batch, K, *anchors.shape[-2:]))
        Q, t = np.broadcast_to(Q, (*batch, K, 3, 3)), np.broadcast_to(t, (*batch, K, 3))
    except ValueError as error:
        raise ValueError(
            f"log and start must have {K} epochs, as times has, and their leading axes must "
            f"broadcast; got ranges {ranges.shape}, anchors {anchors.shape}, start {Q.shape} and "
            f"{t.shape}, prior covariance {covariance.shape}"
        ) from error
    told = ranges
    if model.offset is not None or model.clock is not None:
        told = ranging.distances(anchors, ranging.tag_positions(Q, t, model.tags))
    variance = epoch_variance(log.noise, model.noise, told, mask)
    if model.directions is not None:
        factor = direction_bias(model.directions, Q, t, anchors, model.tags).log_std
        variance = variance * np.exp(2 * factor)
    motion, factors = model.motion, model.factors
    M, N = ranges.shape[-2:]
    constants = sum(len(factor.constants_std) for factor in (motion, *factors))
    blocks, extra, constants = bias_blocks(model.biases, M * N, len(motion.extra_std), constants)
    clocks, found, first = None, None, extra
    if model.clock is not None:
        block = clock_block(model.clock, (M, N), extra)
        there = np.broadcast_to(True if mask is None else mask, ranges.shape)
        found, mean = first_offsets(ranges - told, there, model.clock.offset)
        blocks, extra = [*blocks, block], extra + 2 * mean.shape[-1]
        clocks = block, model.clock, mean
    gathered = LogRanges.gathered(ranges, variance, mask, anchors, model.tags, blocks, model.offset)
    if model.directions is not None:
        layout = Layout(model.directions, anchors, model.tags)
        gathered = dataclasses.replace(gathered, layout=layout)
    state = LogState(Q, t, np.zeros((*batch, K, extra)), np.zeros((*batch, constants)))
    if found is not None:
        state.extra[..., first : first + found.shape[-1]] = found
    pose = PoseState(rotation, translation, covariance)
    information = positive_inverse(covariance)
    return _Problem(times, gathered, motion, factors, pose, information, clocks), state
