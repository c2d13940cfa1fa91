"""The linear algebra of a Kalman filter with 12 states: batched, or by filterpy for one body.

Both read the statistic of an epoch; a test holds them to each other on the same trials.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.bounds import symmetric
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.four_filters import (
    Frame,
    join,
    join_mean,
    predict_blocks,
    predict_mean,
    split,
    split_mean,
)
from rbl_gym.estimators.four_filters import update as filter_update
from rbl_gym.estimators.shared_covariance import shared, spread_out
from rbl_gym.estimators.shared_covariance import update as shared_update
from rbl_gym.estimators.squared_range import (
    Statistic,
    compressed,
    extended,
    information,
    information_of_moments,
    moments,
    statistic,
)

# Below this many trials the calls of numpy cost more than the arithmetic that they save.
FEW_TRIALS = 64


class Prediction(NamedTuple):
    """What a step of time does: ``Q <- step Q + noise``, ``t <- t + shift + noise``.

    Attributes
    ----------
    step
        Rotation (..., 3, 3).
    shift
        (..., 3), metres.
    noise
        Variances (12,) that are added.
    """

    step: FloatArray
    shift: FloatArray
    noise: FloatArray


class Epoch(NamedTuple):
    """One epoch of checked ranges (..., M, N), anchors, tags, weights and links (None: all)."""

    ranges: FloatArray
    anchors: FloatArray
    tags: FloatArray
    weights: FloatArray
    links: BoolArray | None

    def statistic(self) -> Statistic:
        """The statistic of `squared_range`."""
        return statistic(*self)


class Batched:
    """Any leading axes: one covariance for all, four small filters, or the 12 x 12 form."""

    @staticmethod
    def predict(
        mean: FloatArray, P: FloatArray, motion: Prediction, frame: Frame | None
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance after ``x <- F x + [0; shift]``, ``P <- F P F^T + Q``."""
        step, shift, noise = motion
        if mean.ndim == 1 and P.ndim == 2 and step.ndim == 2:
            return plain_predict(mean, P, motion)
        common = shared(P)
        if common is not None and step.ndim == 2:
            mean, common = plain_predict(mean, common, motion)
            return mean, spread_out(common, mean.shape[:-1])
        batch = np.broadcast_shapes(mean.shape[:-1], step.shape[:-2])
        if frame is not None and math.prod(batch) >= FEW_TRIALS:
            blocks = split(frame, _as_batch(P, 2, batch) if common is None else common)
            if blocks is not None:
                turn = np.ascontiguousarray(np.moveaxis(step, (-2, -1), (0, 1)))
                blocks = predict_blocks(blocks, turn, noise, batch)
                return predict_mean(mean, turn, shift), join(frame, blocks, batch)
        return plain_predict(mean, P, motion)

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
        if math.prod(batch) >= FEW_TRIALS and epoch.links is None:
            common = shared(P)
            if common is not None and epoch.anchors.ndim == 2 and epoch.weights.ndim == 2:
                mean, common = shared_update(mean, common, *epoch[:4])
                return mean, spread_out(common, mean.shape[:-1])
            if frame is not None and epoch.weights.shape[-1] == 1:
                posterior = four_filters_update(frame, mean, P, epoch, batch)
                if posterior is not None:
                    return posterior
        if math.prod(batch) >= FEW_TRIALS:
            return batched_update(mean, P, epoch, batch)
        return plain_update(mean, P, epoch.statistic())


def plain_predict(
    mean: FloatArray, P: FloatArray, motion: Prediction
) -> tuple[FloatArray, FloatArray]:
    """The prediction with 12 x 12 matrices."""
    F = transition(motion.step)
    mean = mean @ F.T if F.ndim == 2 else (F @ mean[..., None])[..., 0]
    mean[..., 9:] += motion.shift
    return mean, symmetric(F @ P @ np.swapaxes(F, -1, -2)) + np.diag(motion.noise)


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


def batched_update(
    mean: FloatArray, P: FloatArray, epoch: Epoch, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """`plain_update` of many trials: of common weights, no solver of general matrices."""
    if epoch.links is not None or epoch.weights.shape[-1] != 1 or epoch.tags.ndim != 2:
        matrix, vector = information(epoch.statistic())
    else:
        tags = extended(epoch.tags)
        matrix, vector = information_of_moments(*epoch_moments(epoch, tags, batch), tags)
        matrix = matrix[0] if len(matrix) == 1 else matrix.reshape(*batch, 12, 12)
        vector = vector.reshape(*batch, 12)
    try:
        lower = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return plain_update(mean, P, epoch.statistic())
    transposed = lower.swapaxes(-1, -2)
    damped = transposed @ matrix @ lower + np.eye(12)
    root = lower_inverse(np.linalg.cholesky(damped)) @ transposed
    P = root.swapaxes(-1, -2) @ root
    return correct(mean, P, matrix, vector), P


def lower_inverse(lower: FloatArray) -> FloatArray:
    """Inverses of lower triangular matrices (..., n, n), n = 3, 6, 12, by halves."""
    result = np.zeros(lower.shape)
    n = lower.shape[-1]
    if n == 3:
        r = [1 / lower[..., i, i] for i in range(3)]
        l10, l20, l21 = (lower[..., i, j] for i, j in ((1, 0), (2, 0), (2, 1)))
        for i in range(3):
            result[..., i, i] = r[i]
        result[..., 1, 0] = -l10 * r[0] * r[1]
        result[..., 2, 1] = -l21 * r[1] * r[2]
        result[..., 2, 0] = (l10 * l21 * r[1] - l20) * r[0] * r[2]
        return result
    half = n // 2
    result[..., :half, :half] = first = lower_inverse(lower[..., :half, :half])
    result[..., half:, half:] = second = lower_inverse(lower[..., half:, half:])
    result[..., half:, :half] = -second @ lower[..., half:, :half] @ first
    return result


def epoch_moments(
    epoch: Epoch, tags: FloatArray, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """`moments` of a batch, flat: G (B or 1, 3, 3) and B (B, 3, 4) for extended tags (N, 4)."""
    ranges = _as_batch(epoch.ranges, 2, batch)
    anchors, weights = (
        array if array.ndim == 2 else _as_batch(array, 2, batch)
        for array in (epoch.anchors, epoch.weights)
    )
    ranges, anchors, weights = (
        array.reshape(-1, *array.shape[-2:]) for array in (ranges, anchors, weights)
    )
    return moments(ranges, anchors, tags, weights)


def four_filters_update(
    frame: Frame, mean: FloatArray, P: FloatArray, epoch: Epoch, batch: tuple[int, ...]
) -> tuple[FloatArray, FloatArray] | None:
    """Mean and covariance by `four_filters`, None where the state has not that structure."""
    common = shared(P)
    blocks = split(frame, _as_batch(P, 2, batch) if common is None else common)
    if blocks is None:
        return None
    # Contiguous copies, so that every step of the filters runs along memory.
    G, B = (
        np.ascontiguousarray(np.moveaxis(array, 0, -1))
        for array in epoch_moments(epoch, frame.tags, batch)
    )
    posterior = filter_update(frame, split_mean(frame, _as_batch(mean, 1, batch)), blocks, G, B)
    if posterior is None:
        return None
    return join_mean(frame, posterior[0], batch), join(frame, posterior[1], batch)


def _as_batch(array: FloatArray, core: int, batch: tuple[int, ...]) -> FloatArray:
    return np.broadcast_to(array, (*batch, *array.shape[array.ndim - core :]))


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
