"""The linear algebra of a Kalman filter with 12 states: batched, or by filterpy for one body.

Both read the statistic of an epoch; a test holds them to each other on the same trials.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbl_gym.bounds.pose import symmetric
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.linear.squared_range import Statistic, compressed, information


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


class Batched:
    """Any leading axes, by broadcasting: a covariance (12, 12) belongs to all trials."""

    @staticmethod
    def predict(
        mean: FloatArray, P: FloatArray, motion: Prediction
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance after ``x <- F x + [0; shift]``, ``P <- F P F^T + Q``."""
        F = transition(motion.step)
        mean = (F @ mean[..., None])[..., 0]
        mean[..., 9:] += motion.shift
        P = symmetric(F @ P @ np.swapaxes(F, -1, -2))
        np.einsum("...ii->...i", P)[...] += motion.noise
        return mean, P

    @staticmethod
    def update(mean: FloatArray, P: FloatArray, stat: Statistic) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance after an epoch, ``P <- (I + P G)^-1 P``: exact for vague priors."""
        matrix, vector = information(stat)
        P = symmetric(np.linalg.solve(np.eye(12) + P @ matrix, P))
        innovation = vector[..., None] - matrix @ mean[..., None]
        return mean + (P @ innovation)[..., 0], P


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
        cls, mean: FloatArray, P: FloatArray, motion: Prediction
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
        cls, mean: FloatArray, P: FloatArray, stat: Statistic
    ) -> tuple[FloatArray, FloatArray]:
        """As `Batched.update`, by filterpy's own gain and Joseph form."""
        kf = cls._filter(mean, P)
        z, H = compressed(stat)
        kf.R = np.eye(12)
        # A one-dimensional z would silently broadcast the state to a matrix.
        kf.update(z[:, None], H=H)
        return cls._result(kf)

    @staticmethod
    def _filter(mean: FloatArray, P: FloatArray) -> Any:
        from filterpy.kalman import KalmanFilter  # slow to import, and not always needed

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


ENGINES = ("auto", "batched", "filterpy")


def engine_for(name: str, **arrays: tuple[int, ...]) -> type[Batched] | type[FilterPy]:
    """The engine of a step, from its name and the leading axes of all that comes in.

    ``"auto"``: filterpy where nothing has leading axes, batched otherwise.

    Raises
    ------
    ValueError
        For filterpy, where an argument has leading axes.
    """
    many = {key: batch for key, batch in arrays.items() if batch}
    if name == "batched" or (name == "auto" and many):
        return Batched
    if many:
        key, batch = next(iter(many.items()))
        raise ValueError(
            f"engine 'filterpy' tracks one body, got a {key} with leading axes {batch}; "
            "use engine='batched'"
        )
    return FilterPy
