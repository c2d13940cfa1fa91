"""Motion models between neighbouring epochs, as factors of the smoother."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.smoothing import LEAST_STD
from rbl_gym.checks import FloatArray, check_array, kernel
from rbl_gym.estimators.inputs import check_one_process
from rbl_gym.estimators.smoothing.equations import Factor, LogState, Rows
from rbl_gym.geometry import rotations
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import WanderingTwist

__all__ = ["KnownTwist", "Motion", "UnknownTwist"]

# Called without input checks: the inputs were checked before, or made here.
_EXP, _LOG = kernel(rotations.exp), kernel(rotations.log)
_LEFT_JACOBIAN_INVERSE = kernel(rotations.left_jacobian_inverse)


class Motion(Factor, Protocol):
    """A factor between neighbours that also defines the extra states of an epoch.

    Attributes
    ----------
    extra_std
        Standard deviations (e,) about zero of the e extra states at the first epoch.
    turning
        Whether the first three extra states are a vector that rotates with the body, such as a
        turn rate. The rows ignore this: their derivatives are by errors, estimate less truth.
    """

    @property
    def turning(self) -> bool:
        """Whether the first three extra states are a vector that rotates with the body."""
        ...

    @property
    def extra_std(self) -> FloatArray:
        """Standard deviations (e,) about zero of the extra states at the first epoch."""
        ...


@dataclass(frozen=True, eq=False)
class KnownTwist:
    """Motion by a known twist plus process noise, or a random walk.

    Parameters
    ----------
    process
        Process noise, as in a filter.
    twists
        (..., K - 1, 6), rad/s and m/s, of the intervals between epochs; None: zero, so that the
        motion is a random walk.
    """

    process: ProcessNoise
    twists: ArrayLike | None = None

    def __post_init__(self) -> None:
        check_one_process(self.process)
        if self.twists is not None:
            object.__setattr__(self, "twists", check_array("twists", self.twists, ("K", 6)))

    extra_std = constants_std = np.zeros(0)
    turning = False

    def linearize(self, state: LogState, times: FloatArray, constants: FloatArray) -> Rows:
        """Return whitened rows of ``Jl(W dt)^-1 log(Q' (exp(W dt) Q)^T)`` and ``t' - t - V dt``."""
        dt = np.diff(times)[..., None]
        std = np.sqrt(dt * self.process.std() ** 2 + LEAST_STD**2)
        before, after = _neighbours(state)
        moved: FloatArray = np.zeros(6) if self.twists is None else self.twists * dt  # pyrefly: ignore[bad-assignment, unsupported-operation]
        turn = _EXP(moved[..., :3])
        turned = turn @ before[0]
        error = _LOG(after[0] @ np.swapaxes(turned, -1, -2))
        frame = _LEFT_JACOBIAN_INVERSE(moved[..., :3])
        inner = _LEFT_JACOBIAN_INVERSE(error)
        residual = np.concatenate(
            [(frame @ error[..., None])[..., 0], after[1] - before[1] - moved[..., 3:]], axis=-1
        )
        A, B = (np.zeros((*residual.shape, 6)) for _ in range(2))
        A[..., :3, :3] = -frame @ np.swapaxes(inner, -1, -2) @ turn
        B[..., :3, :3] = frame @ inner
        A[..., 3:, 3:], B[..., 3:, 3:] = -np.eye(3), np.eye(3)
        return Rows(residual / std, A / std[..., None], B / std[..., None])


@dataclass(frozen=True, eq=False)
class UnknownTwist:
    """Motion by an unknown twist with white acceleration; the twist is estimated too.

    Parameters
    ----------
    law
        Model of the twist.
    process
        Process noise of the pose in addition to the twist.
    """

    law: WanderingTwist
    process: ProcessNoise = dataclasses.field(default_factory=ProcessNoise)

    def __post_init__(self) -> None:
        check_one_process(self.process)

    constants_std = np.zeros(0)
    turning = True

    @property
    def extra_std(self) -> FloatArray:
        """Standard deviations (6,) of the twist at the first epoch."""
        return np.maximum(self.law.prior_std(), LEAST_STD)

    def linearize(self, state: LogState, times: FloatArray, constants: FloatArray) -> Rows:
        """Return rows of the pose, ``log(Q' Q^T) - W dt`` and ``t' - t - V dt``, and of the twist.

        They are whitened together, because white acceleration over the interval changes both.
        """
        dt = np.diff(times)[..., None]
        before, after = _neighbours(state)
        twist, new = before[2][..., :6], after[2][..., :6]
        turn = _LOG(after[0] @ np.swapaxes(before[0], -1, -2))
        inner = _LEFT_JACOBIAN_INVERSE(turn)
        pose = np.concatenate([turn, after[1] - before[1]], axis=-1) - twist * dt
        A, B = (np.zeros((*pose.shape[:-1], 12, 12)) for _ in range(2))
        A[..., :3, :3] = -np.swapaxes(inner, -1, -2)
        B[..., :3, :3] = inner
        A[..., 3:6, 3:6], B[..., 3:6, 3:6] = -np.eye(3), np.eye(3)
        A[..., :6, 6:] = -dt[..., None] * np.eye(6)
        A[..., 6:, 6:], B[..., 6:, 6:] = -np.eye(6), np.eye(6)
        # Cholesky factor [[a, 0], [b, c]] of the covariance of pose and twist, per axis.
        wander = self.law.std() ** 2
        a = np.sqrt(dt * self.process.std() ** 2 + dt**3 / 3 * wander + LEAST_STD**2)
        b = dt**2 / 2 * wander / a
        c = np.sqrt(np.maximum(dt * wander - b**2, 0.0) + LEAST_STD**2)

        residual = np.concatenate([pose, new - twist], axis=-1)
        for rows, shape in ((residual, (...,)), (A, (..., None)), (B, (..., None))):
            axis = -1 if len(shape) == 1 else -2
            first, second = np.split(rows, 2, axis=axis)
            first /= a[shape]
            second -= b[shape] * first
            second /= c[shape]
        return Rows(residual, A, B)


def _neighbours(state: LogState) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
    """Return rotation, translation and extra states of the earlier and the later epochs."""
    Q, t, x = state.rotation, state.translation, state.extra
    return (
        (Q[..., :-1, :, :], t[..., :-1, :], x[..., :-1, :]),
        (Q[..., 1:, :, :], t[..., 1:, :], x[..., 1:, :]),
    )
