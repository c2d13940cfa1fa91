"""Prior knowledge of height and tilt at every epoch, as a factor of the smoother."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rbl_gym.checks import FloatArray, check_number
from rbl_gym.estimators.smoothing.equations import LogState, Rows

__all__ = ["Level"]


@dataclass(frozen=True)
class Level:
    """Soft constraint on height and tilt, for a body that stays about level at about one height.

    Parameters
    ----------
    height_m, height_std_m
        Height of the body's origin and its standard deviation; None: unknown.
    tilt_std_rad
        Standard deviation of roll and pitch about level, on each of two axes; None: unknown.
    time_s
        Correlation time of the departure from level and height. Epochs closer together than this
        carry as much information as one.

    Raises
    ------
    ValueError
        If a standard deviation is not positive, or a height has none.
    """

    height_m: float | None = None
    height_std_m: float | None = None
    tilt_std_rad: float | None = None
    time_s: float = 10.0

    def __post_init__(self) -> None:
        if (self.height_m is None) != (self.height_std_m is None):
            raise ValueError(
                f"height_m and height_std_m must be given together, got {self.height_m!r} and "
                f"{self.height_std_m!r}"
            )
        for name in ("height_std_m", "tilt_std_rad"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), low=1e-9)
        check_number("time_s", self.time_s, low=1e-9)

    @property
    def numbers(self) -> FloatArray:
        """Return height, its standard deviation, and that of the tilt (3,); infinite: unknown."""
        known = self.height_std_m, self.tilt_std_rad
        return np.array([self.height_m or 0.0, *(math.inf if x is None else x for x in known)])

    constants_std = np.zeros(0)

    def linearize(self, state: LogState, times: FloatArray, constants: FloatArray) -> Rows:
        """Return rows of the height and of the horizontal components of the body's z axis."""
        upright = state.rotation[..., :, 2]
        residuals, rows = [], []
        if self.height_m is not None and self.height_std_m is not None:
            A = np.zeros((*upright.shape[:-1], 1, 6))
            A[..., 5] = 1 / self.height_std_m
            residuals.append((state.translation[..., 2:] - self.height_m) / self.height_std_m)
            rows.append(A)
        if self.tilt_std_rad is not None:
            # An error w rotates the axis u by w x u.
            A = np.zeros((*upright.shape[:-1], 2, 6))
            x, y, z = (upright[..., i] / self.tilt_std_rad for i in range(3))
            A[..., 0, 1], A[..., 0, 2] = z, -y
            A[..., 1, 0], A[..., 1, 2] = -z, x
            residuals.append(upright[..., :2] / self.tilt_std_rad)
            rows.append(A)
        shape = upright.shape[:-1]
        residuals = residuals or [np.zeros((*shape, 0))]
        rows = rows or [np.zeros((*shape, 0, 6))]
        # The first epoch has full weight; later ones are weighted by the time since the last.
        share = np.ones(times.shape)
        share[..., 1:] = np.minimum(np.diff(times) / self.time_s, 1.0)
        root = np.sqrt(share)[..., None]
        residual, A = np.concatenate(residuals, axis=-1), np.concatenate(rows, axis=-2)
        return Rows(root * residual, root[..., None] * A)
