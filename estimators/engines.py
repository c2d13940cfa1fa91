"""The linear algebra of a Kalman filter with 12 states: batched, or by filterpy for one body.

Both read the statistic of an epoch; a test holds them to each other on the same trials.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.bounds import symmetric
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.dense_filter import centred_frame
from rbl_gym.estimators.dense_filter import predict as dense_predict
from rbl_gym.estimators.dense_filter import update as dense_update
from rbl_gym.estimators.four_filters import Frame, join, join_mean, split, split_mean
from rbl_gym.estimators.four_filters import predict as filter_predict
from rbl_gym.estimators.four_filters import update as filter_update
from rbl_gym.estimators.inputs import check_ranges
from rbl_gym.estimators.shared_covariance import shared, spread_out
from rbl_gym.estimators.shared_covariance import update as shared_update
from rbl_gym.estimators.squared_range import (
    Statistic,
    compressed,
    information,
    moments,
    statistic,
)

# Below this many trials the calls of numpy cost more than the arithmetic that they save.
FEW_TRIALS = 64
# Trials whose 12 x 12 matrices stay in the cache from one product to the next.
_BLOCK = 128


class Prediction(NamedTuple):
    """What a step of time does: ``Q <- step Q + noise``, ``t <- t + shift + noise``.

    Attributes
    ----------
    step
        Rotation (..., 3, 3).
    shift
        (..., 3), metres.
    noise
        Variances (12,) that are added, one for all entries of Q.
    """

    step: FloatArray
    shift: FloatArray
    noise: FloatArray


class Epoch(NamedTuple):
    """One epoch: ranges (..., M, N), anchors, tags, weights and links (None: all).

    Ranges of all links have yet to pass `check_ranges`: the engine looks at them where it
    reads them anyway.
    """

    ranges: FloatArray
    anchors: FloatArray
    tags: FloatArray
    weights: FloatArray
    links: BoolArray | None

    def statistic(self) -> Statistic:
        """The statistic of `squared_range`, of checked ranges."""
        if self.links is None:
            check_ranges(self.ranges)
        return statistic(*self)


class Batched:
    """Any leading axes: one covariance for all, four small filters, or the 12 x 12 form."""

    @staticmethod
    def predict(
        mean: FloatArray, P: FloatArray, motion: Prediction, frame: Frame | None
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance after ``x <- F x + [0; shift]``, ``P <- F P F^T + Q``."""
        step = motion.step
        if mean.ndim == 1 and P.ndim == 2 and step.ndim == 2:
            return plain_predict(mean, P, motion)
        common = shared(P)
        if common is not None and step.ndim == 2:
            mean, common = plain_predict(mean, common, motion)
            return mean, spread_out(common, mean.shape[:-1])
        batch = np.broadcast_shapes(mean.shape[:-1], step.shape[:-2])
        if math.prod(batch) < FEW_TRIALS:
            return plain_predict(mean, P, motion)
        old = _as_batch(P, 2, batch) if common is None else common
        blocks = None if frame is None else split(frame, old)
        if frame is None or blocks is None:
            return predict_trials_last(mean, old, motion, batch)
        return four_filters_predict(frame, mean, blocks, motion, batch)

    @staticmethod
    def update(
        mean: FloatArray, P: FloatArray, epoch: Epoch, frame: Frame | None
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance after an epoch."""
        if mean.ndim == 1 and P.ndim == 2 and epoch.ranges.ndim == epoch.anchors.ndim == 2:
            return plain_update(mean, P, epoch.statistic())
        batch = np.broadcast_shapes(
            mean.shape[:-1], epoch.ranges.shape[:-2], epoch.anchors.shape[:-2],
            epoch.weights.shape[:-2], () if epoch.links is None else epoch.links.shape[:-2],
        )  # fmt: skip
        if math.prod(batch) < FEW_TRIALS:
            return plain_update(mean, P, epoch.statistic())
        if epoch.links is None:
            common = shared(P)
            if common is not None and epoch.anchors.ndim == 2 and epoch.weights.ndim == 2:
                mean, common = shared_update(mean, common, *epoch[:4])
                return mean, spread_out(common, mean.shape[:-1])
            if epoch.weights.shape[-1] == 1 and epoch.tags.ndim == 2:
                posterior = None
                if frame is not None:
                    posterior = four_filters_update(frame, mean, P, epoch, batch)
                if posterior is None:
                    posterior = update_trials_last(mean, P, epoch, batch)
                if posterior is not None:
                    return posterior
        return batched_update(mean, P, epoch, batch)


def plain_predict(
    mean: FloatArray, P: FloatArray, motion: Prediction
) -> tuple[FloatArray, FloatArray]:
    """The prediction with 12 x 12 matrices."""
    F = transition(motion.step)
    mean = mean @ F.T if F.ndim == 2 else (F @ mean[..., None])[..., 0]
    mean[..., 9:] += motion.shift
    P = symmetric(F @ P @ np.swapaxes(F, -1, -2))
    np.einsum("...ii->...i", P)[...] += motion.noise
    return mean, P


def plain_update(mean: FloatArray, P: FloatArray, stat: Statistic) -> tuple[FloatArray, FloatArray]:
    """The information form ``(I + P G)^-1 P``: exact for vague priors."""
    return information_update(mean, P, *information(stat))


def information_update(
    mean: FloatArray, P: FloatArray, matrix: FloatArray, vector: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`plain_update` from the information matrix (..., 12, 12) and vector (..., 12) themselves."""
    P = symmetric(np.linalg.solve(np.eye(12) + P @ matrix, P))
    return correct(mean, P, matrix, vector), P


def correct(
    mean: FloatArray, posterior: FloatArray, matrix: FloatArray, vector: FloatArray
) -> FloatArray:
    """Mean after an epoch of that information, ``x + P (y - G x)``."""
    innovation = vector[..., None] - matrix @ mean[..., None]
    return mean + (posterior @ innovation)[..., 0]


def four_filters_predict(
    frame: Frame,
    mean: FloatArray,
    blocks: FloatArray,
    motion: Prediction,
    batch: tuple[int, ...],
) -> tuple[FloatArray, FloatArray]:
    """`plain_predict` of many trials by `four_filters`."""
    x, blocks = filter_predict(
        split_mean(frame, _as_batch(mean, 1, batch)),
        blocks,
        np.ascontiguousarray(_trials_last(motion.step, 2, batch)),
        _trials_last(motion.shift, 1, batch),
        motion.noise.reshape(4, 3).T[..., None],
    )
    return join_mean(frame, x, batch), join(frame, blocks, batch)


def four_filters_update(
    frame: Frame, mean: FloatArray, P: FloatArray, epoch: Epoch, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray] | None:
    """Mean and covariance by `four_filters`, None where the state has not that structure."""
    common = shared(P)
    blocks = split(frame, _as_batch(P, 2, batch) if common is None else common)
    if blocks is None:
        return None
    G, B = epoch_moments(epoch, frame.tags, batch)
    posterior = filter_update(frame, split_mean(frame, _as_batch(mean, 1, batch)), blocks, G, B)
    if posterior is None:
        return None
    return join_mean(frame, posterior[0], batch), join(frame, posterior[1], batch)


def predict_trials_last(
    mean: FloatArray, P: FloatArray, motion: Prediction, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """`plain_predict` of many trials by `dense_filter`."""
    step, shift, noise = motion
    mean, P = dense_predict(
        _trials_last(mean, 1, batch),
        _trials_last(P, 2, batch),
        np.ascontiguousarray(_trials_last(step, 2, batch)),
        _trials_last(shift, 1, batch),
        noise,
    )
    return _trials_first(mean, P, batch)


def update_trials_last(
    mean: FloatArray, P: FloatArray, epoch: Epoch, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray] | None:
    """`plain_update` of common weights by `dense_filter`, None where it finds P singular."""
    tags = centred_frame(epoch.tags)
    G, B = epoch_moments(epoch, tags.frame.tags, batch)
    posterior = dense_update(
        tags,
        _trials_last(_as_batch(mean, 1, batch), 1, batch),
        _trials_last(_as_batch(P, 2, batch), 2, batch),
        G,
        B,
    )
    return None if posterior is None else _trials_first(*posterior, batch)


def batched_update(
    mean: FloatArray, P: FloatArray, epoch: Epoch, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """`plain_update` of many trials, a block of them at a time."""
    told = information(epoch.statistic())
    matrices, vectors = _flat(told[0], 2, batch), _flat(told[1], 1, batch)
    means, covariances = np.empty((*batch, 12)), np.empty((*batch, 12, 12))
    new_mean, new_P = means.reshape(-1, 12), covariances.reshape(-1, 12, 12)
    mean, P = _flat(mean, 1, batch), _flat(P, 2, batch)
    for part in _blocks(len(mean)):
        new_P[part] = posterior = posterior_covariance(P[part], matrices[part])
        new_mean[part] = correct(mean[part], posterior, matrices[part], vectors[part])
    return means, covariances


def posterior_covariance(P: FloatArray, matrix: FloatArray) -> FloatArray:
    """``(I + P G)^-1 P`` (B, 12, 12), by two Cholesky factors where P has one."""
    try:
        lower = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return symmetric(np.linalg.solve(np.eye(12) + P @ matrix, P))
    transposed = lower.swapaxes(-1, -2)
    damped = transposed @ matrix @ lower
    np.einsum("bii->bi", damped)[...] += 1.0
    root = lower_solve(np.linalg.cholesky(damped), transposed)
    # Two copies: of a matrix and its own transpose, matmul makes a slower product.
    return np.ascontiguousarray(root.T) @ np.ascontiguousarray(root.transpose(2, 0, 1))


def lower_solve(lower: FloatArray, right: FloatArray) -> FloatArray:
    """``L^-1 R`` (n, k, B), trials last, of lower triangular L (B, n, n) and R (B, n, k)."""
    L = np.ascontiguousarray(lower.transpose(1, 2, 0))
    X = np.ascontiguousarray(right.transpose(1, 2, 0))
    for i in range(len(X)):
        if i > 0:
            X[i] -= np.einsum("jb,jkb->kb", L[i, :i], X[:i])
        X[i] /= L[i, i]
    return X


def epoch_moments(
    epoch: Epoch, tags: FloatArray, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """`moments` of a batch, trials last: G (3, 3, B) and B (3, 4, B) for extended tags (N, 4)."""
    anchors, weights = (
        array[None] if array.ndim == 2 else _flat(array, 2, batch)
        for array in (epoch.anchors, epoch.weights)
    )
    return moments(_flat(epoch.ranges, 2, batch), anchors, tags, weights, unchecked=epoch.ranges)


def _as_batch(array: FloatArray, core: int, batch: tuple[int, ...]) -> FloatArray:
    shape = (*batch, *array.shape[array.ndim - core :])
    # Only the array itself is known for what it was made of.
    return array if array.shape == shape else np.broadcast_to(array, shape)


def _flat(array: FloatArray, core: int, batch: tuple[int, ...]) -> FloatArray:
    """The array (B, ...) of a batch of any number of axes."""
    return _as_batch(array, core, batch).reshape(-1, *array.shape[array.ndim - core :])


def _trials_last(array: FloatArray, core: int, batch: tuple[int, ...]) -> FloatArray:
    """The array (..., B) of a batch, B = 1 where it has no leading axes."""
    if array.ndim == core:
        return array[..., None]
    view = _as_batch(array, core, batch)
    axes = tuple(range(len(batch)))
    view = np.moveaxis(view, axes, tuple(a + core for a in axes))
    return view.reshape(*view.shape[:core], -1)


def _trials_first(
    mean: FloatArray, P: FloatArray, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Mean (..., 12) and covariance (..., 12, 12) of (12, B) and (12, 12, B), not copied."""
    mean, P = mean.reshape(12, *batch), P.reshape(12, 12, *batch)
    return np.moveaxis(mean, 0, -1), np.moveaxis(P, (0, 1), (-2, -1))


def _blocks(n_trials: int) -> Iterator[slice]:
    for begin in range(0, n_trials, _BLOCK):
        yield slice(begin, begin + _BLOCK)


def transition(step: FloatArray) -> FloatArray:
    """F (..., 12, 12) of a rotation: ``blkdiag(step, step, step, I)``."""
    F = np.zeros((*step.shape[:-2], 12, 12))
    for k in range(3):
        F[..., 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = step
    F[..., 9:, 9:] = np.eye(3)
    return F


class FilterPy:
    """filterpy's KalmanFilter on the compressed measurement; one body."""

    @classmethod
    def predict(
        cls, mean: FloatArray, P: FloatArray, motion: Prediction, frame: Frame | None
    ) -> tuple[FloatArray, FloatArray]:
        """As `Batched.predict`."""
        kf = cls._filter(mean, P)
        kf.F, kf.Q = transition(motion.step), np.diag(motion.noise)
        # Without B filterpy ignores u in silence.
        kf.B = np.vstack([np.zeros((9, 3)), np.eye(3)])
        kf.predict(u=motion.shift[:, None])
        return cls._result(kf)

    @classmethod
    def update(
        cls, mean: FloatArray, P: FloatArray, epoch: Epoch, frame: Frame | None
    ) -> tuple[FloatArray, FloatArray]:
        """As `Batched.update`, by filterpy's own gain and Joseph form."""
        kf = cls._filter(mean, P)
        z, H = compressed(epoch.statistic())
        kf.R = np.eye(12)
        # A one-dimensional z would silently broadcast the state to a matrix.
        kf.update(z[:, None], H=H)
        return cls._result(kf)

    @staticmethod
    def _filter(mean: FloatArray, P: FloatArray) -> Any:
        from filterpy.kalman import KalmanFilter  # slow to import, and not always needed

        if mean.ndim != 1:
            raise ValueError(
                f"engine 'filterpy' tracks one body, got a state of shape {mean.shape}; "
                "use engine='batched'"
            )
        kf = KalmanFilter(dim_x=12, dim_z=12, dim_u=3)
        kf.x, kf.P = mean[:, None].copy(), P.copy()
        return kf

    @staticmethod
    def _result(kf: Any) -> tuple[FloatArray, FloatArray]:
        mean, P = np.asarray(kf.x), np.asarray(kf.P)
        if mean.shape != (12, 1) or P.shape != (12, 12):
            raise RuntimeError(f"filterpy returned shapes {mean.shape} and {P.shape}")
        if not (np.isfinite(mean).all() and np.isfinite(P).all()):
            raise ValueError("the filter's state is no longer finite")
        return mean[:, 0].copy(), symmetric(P)


ENGINES: dict[str, type[Batched] | type[FilterPy]] = {
    "batched": Batched,
    "filterpy": FilterPy,
}
