"""State of a log in the smoother, and the normal equations of one Gauss-Newton step.

The error of an epoch is ``(w, v, extra)``. The pose error is the usual one, ``Q_hat = exp(w) Q``
and ``t_hat = t + v``. The extra error is estimate less truth of the other states of the epoch.
Constants of the log occur once. A factor depends on one epoch, its neighbour and the constants.
The equations are therefore block-tridiagonal with a border.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from rbl_gym.bounds.tridiagonal import inverse_blocks, solve_blocks
from rbl_gym.checks import FloatArray, kernel
from rbl_gym.estimators.costs.map_problem import PoseState, pose_error
from rbl_gym.geometry import rotations

__all__ = ["Factor", "LogState", "Rows"]

_EXP, _ERROR, _HAT = kernel(rotations.exp), kernel(rotations.error), kernel(rotations.hat)


class LogState(NamedTuple):
    """States of the K epochs of a log and its constants, with leading batch axes.

    Attributes
    ----------
    rotation, translation
        (..., K, 3, 3) and (..., K, 3).
    extra
        (..., K, E): the extra states of the motion model, then the drifting biases.
    constants
        (..., C): the constants of the motion model, of the other factors, then the constant biases.
    """

    rotation: FloatArray
    translation: FloatArray
    extra: FloatArray
    constants: FloatArray


class Rows(NamedTuple):
    """Whitened residuals of a factor and their derivatives, for least squares.

    Attributes
    ----------
    residual
        (..., J, m) in standard deviations. J = K for rows of single epochs, K - 1 for rows between
        neighbours.
    before
        (..., J, m, n): derivative by the first n errors of the epoch, or of the earlier neighbour.
        The derivative by the other errors is zero.
    after
        The same for the later neighbour; None for rows of single epochs.
    constants
        (..., J, m, c): derivative by the factor's own constants; None without constants.
    """

    residual: FloatArray
    before: FloatArray
    after: FloatArray | None = None
    constants: FloatArray | None = None


class Factor(Protocol):
    """A cost term that relates epochs to measurements, to their neighbours and to constants.

    Attributes
    ----------
    constants_std
        Standard deviations (c,) of the factor's own constants about zero.
    """

    @property
    def constants_std(self) -> FloatArray:
        """Standard deviations (c,) of the factor's own constants about zero."""
        ...

    def linearize(self, state: LogState, times: FloatArray, constants: FloatArray) -> Rows:
        """Return residuals and derivatives at a state, times (..., K), own constants (..., c)."""
        ...


@dataclass(eq=False)
class Equations:
    """Normal equations ``H x = -g`` of a log; `Rows` and priors are added in place.

    `diagonal` and `above` (..., K, n, n) are blocks of the epochs, and of each epoch with the next;
    the last is unused. `gradient` is (..., K, n). `border` (..., K, n, c), `corner` (..., c, c) and
    `corner_gradient` (..., c) are blocks of the constants.
    """

    diagonal: FloatArray
    above: FloatArray
    gradient: FloatArray
    border: FloatArray
    corner: FloatArray
    corner_gradient: FloatArray
    cost: FloatArray

    @classmethod
    def empty(cls, batch: tuple[int, ...], epochs: int, n: int, c: int) -> Equations:
        """Return equations without information, for n errors per epoch and c constants."""
        return cls(
            np.zeros((*batch, epochs, n, n)), np.zeros((*batch, epochs, n, n)),
            np.zeros((*batch, epochs, n)), np.zeros((*batch, epochs, n, c)),
            np.zeros((*batch, c, c)), np.zeros((*batch, c)), np.zeros(batch),
        )  # fmt: skip

    def add(self, rows: Rows, start: int = 0) -> None:
        """Add half the squares of rows whose own constants begin at `start`."""
        r, A, B, C = rows
        J, n = A.shape[-3], A.shape[-1]
        self.cost += 0.5 * np.einsum("...ij,...ij->...", r, r)
        At = np.swapaxes(A, -1, -2)
        self.diagonal[..., :J, :n, :n] += At @ A
        self.gradient[..., :J, :n] += times(At, r)
        if B is not None:
            Bt = np.swapaxes(B, -1, -2)
            self.diagonal[..., 1:, :n, :n] += Bt @ B
            self.above[..., :J, :n, :n] += At @ B
            self.gradient[..., 1:, :n] += times(Bt, r)
        if C is not None and C.shape[-1]:
            end = start + C.shape[-1]
            self.border[..., :J, :n, start:end] += At @ C
            if B is not None:
                self.border[..., 1:, :n, start:end] += np.swapaxes(B, -1, -2) @ C
            flat = C.reshape((*C.shape[:-3], -1, C.shape[-1]))
            Ct = np.swapaxes(flat, -1, -2)
            self.corner[..., start:end, start:end] += Ct @ flat
            self.corner_gradient[..., start:end] += times(Ct, r.reshape((*r.shape[:-2], -1)))

    def add_prior(self, where: slice, value: FloatArray, std: FloatArray) -> None:
        """Add independent zero-mean priors of some errors of the first epoch, given their value."""
        at = range(where.start, where.stop)
        self.cost += 0.5 * ((value / std) ** 2).sum(axis=-1)
        self.diagonal[..., 0, at, at] += std**-2.0
        self.gradient[..., 0, where] += value / std**2

    def add_constants_prior(self, where: slice, value: FloatArray, std: FloatArray) -> None:
        """Add independent zero-mean priors of constants."""
        at = range(where.start, where.stop)
        self.cost += 0.5 * ((value / std) ** 2).sum(axis=-1)
        self.corner[..., at, at] += std**-2.0
        self.corner_gradient[..., where] += value / std**2

    def add_pose_prior(self, state: LogState, prior: PoseState, information: FloatArray) -> None:
        """Add a prior (...) of the pose of the first epoch with information (..., 6, 6)."""
        turn = _ERROR(state.rotation[..., 0, :, :], prior.rotation)
        error, D = pose_error(turn, state.translation[..., 0, :] - prior.translation)
        pull, Dt = times(information, error), np.swapaxes(D, -1, -2)
        self.cost += 0.5 * np.einsum("...i,...i->...", error, pull)
        self.diagonal[..., 0, :6, :6] += Dt @ information @ D
        self.gradient[..., 0, :6] += times(Dt, pull)

    def step(self, damping: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the step (..., K, n) and (..., c), and the predicted decrease (...) of the cost.

        Damping (...) adds information to every pose, in 1/rad^2 and 1/m^2. Marquardt's damping
        by a fraction of the diagonal does not work here: stiff motion models make it far too large.
        """
        n, diagonal = self.gradient.shape[-1], self.diagonal.copy()
        diagonal[..., range(n), range(n)] *= 1 + 1e-14
        diagonal[..., range(6), range(6)] += damping[..., None, None]
        right = np.concatenate([-self.gradient[..., None], self.border], axis=-1)
        found = solve_blocks(diagonal, self.above, right)
        x, X = found[..., 0], found[..., 1:]
        y = np.zeros(self.corner_gradient.shape)
        if self.corner_gradient.shape[-1]:
            schur = self.corner - np.einsum("...kia,...kib->...ab", self.border, X)
            right = self.corner_gradient + np.einsum("...kia,...ki->...a", self.border, x)
            y = -np.linalg.solve(schur, right[..., None])[..., 0]
            x = x - np.einsum("...kia,...a->...ki", X, y)
        decrease = -np.einsum("...ki,...ki->...", self.gradient, x)
        return x, y, decrease - np.einsum("...a,...a->...", self.corner_gradient, y)

    def covariances(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return covariances (..., K, n, n), (..., K, n, c), (..., c, c) of epochs and constants.

        They are NaN if the equations are not positive definite.
        """
        P = inverse_blocks(self.diagonal, self.above)
        if not self.corner.shape[-1]:
            return P, self.border, self.corner
        X = solve_blocks(self.diagonal, self.above, self.border)
        schur = self.corner - np.einsum("...kia,...kib->...ab", self.border, X)
        constants = np.linalg.inv(schur)
        constants = 0.5 * (constants + np.swapaxes(constants, -1, -2))
        crossed = -X @ constants[..., None, :, :]
        return P - crossed @ np.swapaxes(X, -1, -2), crossed, constants


def moved(state: LogState, x: FloatArray, y: FloatArray, turning: bool = False) -> LogState:
    """Return the state after steps (..., K, n) of the epochs and (..., c) of the constants.

    With `turning`, the first three extra states are a vector that rotates with the body,
    ``W <- exp(w) W + dW``. One rotation of all epochs, however large, then leaves the rotations
    between them unchanged.
    """
    turn = _EXP(x[..., :3])
    extra = state.extra + x[..., 6:]
    if turning:
        extra[..., :3] = times(turn, state.extra[..., :3]) + x[..., 6:9]
    return LogState(
        turn @ state.rotation, state.translation + x[..., 3:6], extra, state.constants + y
    )


def with_turning(rows: Rows, state: LogState) -> Rows:
    """Convert derivatives by the error of a rotating vector to derivatives by the steps of `moved`.

    The error of the vector is ``dW + w x W``.
    """
    W = _HAT(state.extra[..., :3])
    ends: list[Any] = []
    for A, spin in (
        (rows.before, W[..., : rows.before.shape[-3], :, :]),
        (rows.after, W[..., 1:, :, :]),
    ):
        if A is not None and A.shape[-1] > 6:
            A = A.copy()
            A[..., :3] -= A[..., 6:9] @ spin
        ends.append(A)
    return rows._replace(before=ends[0], after=ends[1])


def times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return products (..., m) of matrices (..., m, n) and vectors (..., n)."""
    return (matrix @ vector[..., None])[..., 0]
