"""Linear algebra of a Kalman filter with 12 states: batched, or with filterpy for one body.

A test compares both on the same trials.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.bounds.pose import symmetric
from rbl_gym.checks import HUGE, BoolArray, FloatArray, kernel
from rbl_gym.estimators.filter import inverse
from rbl_gym.estimators.linear.squared_range import Statistic, compressed, information, statistic
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements.noise_laws import law_of

# Internal functions without checks: their arguments were checked.
_EXP = kernel(rotations.exp)
_EYE = np.eye(12)
# The angular velocity of a twist.
_TURN = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


class Motion(NamedTuple):
    """The motion over a time step: ``Q <- exp(w dt) Q + noise``, ``t <- t + v dt + noise``.

    The twist (w, v) (..., 6) is known. `rate` are variances (12,) added in 1 s, the same for all
    entries of Q.
    """

    twist: FloatArray
    dt: float
    rate: FloatArray


class LinearEpoch(NamedTuple):
    """One checked epoch, the input of the linear update; metres.

    `ranges` (..., M, N) are 0 without a link, as are `weights`, the inverse variances of the
    squared ranges [1/m^4]: (..., M, 1) if all tags share them, else (..., M, N).
    """

    ranges: FloatArray
    anchors: FloatArray
    tags: FloatArray
    weights: FloatArray

    def statistic(self) -> Statistic:
        """Return the statistic G, b of `squared_range`."""
        return statistic(*self)


class Batched:
    """Engine for any leading axes, by broadcasting: one covariance (12, 12) serves all trials."""

    @staticmethod
    def predict(mean: FloatArray, P: FloatArray, motion: Motion) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance after ``x <- F x + [0; v dt]``, ``P <- F P F^T + Q``."""
        twist, dt, rate = motion
        return predict_mean(mean, twist, dt), predict_covariance(P, twist, dt, rate)

    @staticmethod
    def update(
        mean: FloatArray, P: FloatArray, epoch: LinearEpoch
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance after an epoch."""
        P = update_covariance(P, *epoch[1:])
        return update_mean(mean, P, *epoch), P


@compiled("linear_filter:predict_mean")
def predict_mean(mean: FloatArray, twist: FloatArray, dt: float) -> FloatArray:
    """Return ``F x + [0; v dt]`` (..., 12), ``F = blkdiag(R, R, R, I)``, ``R = exp(w dt)``."""
    mean = (transition(_EXP(twist[..., :3] * dt)) @ mean[..., None])[..., 0]
    mean[..., 9:] += twist[..., 3:] * dt
    return mean


@compiled("linear_filter:predict_covariance")
def predict_covariance(P: FloatArray, twist: FloatArray, dt: float, rate: FloatArray) -> FloatArray:
    """Return ``F P F^T + dt diag(rate)`` (..., 12, 12), F as in `predict_mean`."""
    F = transition(_EXP(twist[..., :3] * dt))
    return symmetric(F @ P @ np.swapaxes(F, -1, -2)) + dt * rate[..., None] * _EYE


@compiled("linear_filter:update_covariance")
def update_covariance(
    P: FloatArray, anchors: FloatArray, tags: FloatArray, weights: FloatArray
) -> FloatArray:
    """Return the covariance (..., 12, 12) after an epoch, ``(I + P G)^-1 P``: exact if P is large.

    It depends on the weights, not on the ranges.
    """
    ranges = np.zeros((anchors.shape[-2], tags.shape[-2]))
    matrix, _ = information(statistic(ranges, anchors, tags, weights))
    return symmetric(np.linalg.solve(np.eye(12) + P @ matrix, P))


@compiled("linear_filter:update_mean")
def update_mean(
    mean: FloatArray,
    P: FloatArray,
    ranges: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """Return the mean (..., 12) after an epoch, ``x + P (y - G x)``, P being the new covariance."""
    matrix, vector = information(statistic(ranges, anchors, tags, weights))
    innovation = vector[..., None] - matrix @ mean[..., None]
    return mean + (P @ innovation)[..., 0]


@compiled("linear_filter:update_means")
def update_means(
    means: FloatArray,
    P: FloatArray,
    ranges: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    weights: FloatArray,
) -> FloatArray:
    """Return `update_mean` of trials (T, 12) that differ only in their means and ranges.

    NaN for trials with a range that is not positive or not finite.
    """
    sound = ((ranges > 0) & (ranges < HUGE)).all(axis=(-2, -1))
    found = update_mean.textbook(means, P, ranges, anchors, tags, weights)
    return np.where(np.expand_dims(sound, -1), found, np.nan)


@compiled("linear_filter:is_vague")
def is_vague(P: FloatArray, anchors: FloatArray, vague_entry: float) -> BoolArray:
    """Return whether a covariance is uninformative (...) on an entry of Q, or on the position."""
    variance = np.diagonal(P, axis1=-2, axis2=-1)
    extent = np.ptp(anchors, axis=-2).max(axis=-1)
    vague = variance[..., :9].max(axis=-1) > vague_entry
    return vague | (variance[..., 9:].max(axis=-1) > extent**2)


@compiled("linear_filter:update")
def update_plain(
    mean: FloatArray,
    P: FloatArray,
    ranges: FloatArray,
    law: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    vague_entry: float,
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance after an epoch without lost links, from the law's numbers.

    NaN if `weigh_plain` is.
    """
    weights = weigh_plain.textbook(P, ranges, law, anchors, vague_entry)
    sound = np.isfinite(weights).all(axis=(-2, -1))[..., None]
    weights = np.where(sound[..., None], weights, 1.0)
    new_P = update_covariance.textbook(P, anchors, tags, weights)
    new_mean = update_mean.textbook(mean, new_P, ranges, anchors, tags, weights)
    return np.where(sound, new_mean, np.nan), np.where(sound[..., None], new_P, np.nan)


@compiled("linear_filter:weigh")
def weigh_plain(
    P: FloatArray, ranges: FloatArray, law: FloatArray, anchors: FloatArray, vague_entry: float
) -> FloatArray:
    """Return weights (..., M, N) of the squared ranges of an epoch without lost links.

    NaN if a range is not positive or the prior is uninformative (`is_vague`).
    """
    variance = law_of(law).squared_range_variance(ranges)
    sound = ((ranges > 0) & (ranges < HUGE)).all(axis=(-2, -1))
    sound = sound & ~is_vague.textbook(P, anchors, vague_entry)
    weights = np.where(sound[..., None, None], 1 / variance, np.nan)
    return np.broadcast_to(weights, ranges.shape)


def transition(step: FloatArray) -> FloatArray:
    """Return F (..., 12, 12) of a rotation: ``blkdiag(step, step, step, I)``."""
    F = np.empty((*step.shape[:-2], 12, 12))
    F[...] = _EYE
    for k in (0, 3, 6):
        F[..., k : k + 3, k : k + 3] = step
    return F


@compiled("linear_filter:compress")
def compress(
    ranges: FloatArray, anchors: FloatArray, tags: FloatArray, weights: FloatArray, like: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return z (..., 12), H (..., 12, 12) as `squared_range.compressed`, with any factor H.

    `like` (12,) only gives a kernel the size of the results.
    """
    return compressed(statistic(ranges, anchors, tags, weights))


@compiled("linear_filter:inverse")
def inverse12(matrix: FloatArray) -> FloatArray:
    """Return the inverse of symmetric positive definite matrices (..., 12, 12)."""
    return inverse(matrix)


class FilterPy:
    """Engine with filterpy's KalmanFilter on the compressed measurement, for one body."""

    @classmethod
    def predict(
        cls, mean: FloatArray, P: FloatArray, motion: Motion
    ) -> tuple[FloatArray, FloatArray]:
        """See `Batched.predict`."""
        kf = cls._filter(mean, P)
        twist, dt, rate = motion
        # F is the effect of the rotation alone on the unit vectors.
        turn = twist * _TURN
        kf.F, kf.Q = predict_mean(_EYE, turn, dt).T, _EYE * (dt * rate)
        kf.predict(u=twist[3:, None] * dt)
        return cls._result(kf)

    @classmethod
    def update(
        cls, mean: FloatArray, P: FloatArray, epoch: LinearEpoch
    ) -> tuple[FloatArray, FloatArray]:
        """See `Batched.update`; filterpy computes the gain and the Joseph form."""
        kf = cls._filter(mean, P)
        z, H = compress(*epoch, mean)
        # A one-dimensional z would silently broadcast the state to a matrix.
        kf.update(z[:, None], H=H)
        return cls._result(kf)

    @staticmethod
    def _filter(mean: FloatArray, P: FloatArray) -> Any:
        ready = _kalman_filter()
        kf = object.__new__(type(ready))
        # It never writes into its arrays, so they can be shared.
        kf.__dict__.update(ready.__dict__)
        kf.x, kf.P = mean[:, None], P
        return kf

    @staticmethod
    def _result(kf: Any) -> tuple[FloatArray, FloatArray]:
        mean, P = np.asarray(kf.x), np.asarray(kf.P)
        if mean.shape != (12, 1) or P.shape != (12, 12):
            raise RuntimeError(
                f"filterpy must return mean (12, 1) and P (12, 12), got {mean.shape}, {P.shape}"
            )
        if not math.isfinite(np.vdot(mean, mean) + np.vdot(P, P)):
            raise ValueError(
                "the state of the filter is not finite: check the prior, noise and ranges"
            )
        return mean[:, 0], symmetric(P)


ENGINES = ("auto", "batched", "filterpy")


def engine_for(name: str, **arrays: tuple[int, ...]) -> type[Batched] | type[FilterPy]:
    """Return the engine of a step, from its name and the leading axes of all arguments.

    ``"auto"``: filterpy if no argument has leading axes, batched otherwise. ValueError for
    filterpy, if an argument has leading axes.
    """
    if name == "batched":
        return Batched
    many = {key: batch for key, batch in arrays.items() if batch}
    if name == "auto" and many:
        return Batched
    if many:
        key, batch = next(iter(many.items()))
        raise ValueError(
            f"engine 'filterpy' tracks only one body, got a {key} with leading axes {batch}; use "
            "engine='batched'"
        )
    return FilterPy


@functools.cache
def _kalman_filter() -> Any:
    """Return a KalmanFilter to copy, since creating one takes as long as two steps."""
    from filterpy.kalman import KalmanFilter  # slow to import, and often not needed

    kf = KalmanFilter(dim_x=12, dim_z=12, dim_u=3)
    kf.inv = inverse12  # pyrefly: ignore[bad-assignment]
    # Without B, filterpy silently ignores u.
    kf.B = np.vstack([np.zeros((9, 3)), np.eye(3)])
    return kf
