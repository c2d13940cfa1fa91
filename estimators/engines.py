"""The linear algebra of a Kalman filter with 12 states: batched, or by filterpy for one body.

Both read the statistic of an epoch; a test holds them to each other on the same trials.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.bounds import symmetric
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.squared_range import Statistic, compressed, information


class Batched:
    """The information form ``(I + P G)^-1 P``: exact for vague priors, any leading axes."""

    @staticmethod
    def predict(
        mean: FloatArray, P: FloatArray, F: FloatArray, shift: FloatArray, Q: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance after ``x <- F x + [0; shift]``, ``P <- F P F^T + Q``."""
        mean = (F @ mean[..., None])[..., 0]
        mean[..., 9:] += shift
        return mean, symmetric(F @ P @ np.swapaxes(F, -1, -2)) + Q

    @staticmethod
    def update(mean: FloatArray, P: FloatArray, stat: Statistic) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance after an epoch."""
        matrix, vector = information(stat)
        P = symmetric(np.linalg.solve(np.eye(12) + P @ matrix, P))
        innovation = vector[..., None] - matrix @ mean[..., None]
        return mean + (P @ innovation)[..., 0], P


class FilterPy:
    """filterpy's KalmanFilter on the compressed measurement; one body."""

    @classmethod
    def predict(
        cls, mean: FloatArray, P: FloatArray, F: FloatArray, shift: FloatArray, Q: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As `Batched.predict`."""
        kf = cls._filter(mean, P)
        kf.F, kf.Q = F, Q
        # Without B filterpy ignores u in silence.
        kf.B = np.vstack([np.zeros((9, 3)), np.eye(3)])
        kf.predict(u=shift[:, None])
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
