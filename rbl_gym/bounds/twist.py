"""Predict pose and twist (12 states) under `motion.unknown_twist`."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray, kernel
from rbl_gym.geometry import rotations
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import WanderingTwist

__all__ = ["predict_covariance"]

# Internal functions without checks: their arguments were checked, or made here.
_EXP, _LEFT_JACOBIAN = kernel(rotations.exp), kernel(rotations.left_jacobian)


def predict_covariance(
    P: FloatArray, twist: FloatArray, dt: float, process: ProcessNoise, law: WanderingTwist | None
) -> FloatArray:
    """Return the covariance (..., n, n) of n >= 12 states after `dt` s of a twist (..., 6).

    The twist is estimated. The covariance is ``F P F^T + Q``, where F maps ``(w, v)`` to ``(exp(W
    dt) w + dt Jl dW, v + dt dV)``. States beyond the twelve are constant. Without a law the twist
    is known, and all states beyond six are constant. `process` adds its noise to the pose.
    """
    wander = None if law is None else law.std() ** 2
    return covariance_after(P, twist, dt, process.std() ** 2, wander)


def covariance_after(
    P: FloatArray, twist: FloatArray, dt: float, process: FloatArray, wander: FloatArray | None
) -> FloatArray:
    """Compute `predict_covariance` from variances (6,) after 1 s; `wander` None: known twist."""
    turn = twist[..., :3] * dt
    step, jacobian = _EXP(turn), _LEFT_JACOBIAN(turn)
    n = P.shape[-1]
    F = np.broadcast_to(np.eye(n), (*turn.shape[:-1], n, n)).copy()
    F[..., :3, :3] = step
    if wander is not None:
        F[..., :3, 6:9] = dt * jacobian
        F[..., 3:6, 9:12] = dt * np.eye(3)
    # The noise in the rotated frame. For an acceleration of density q, the change of velocity has
    # the variance q dt, the displacement q dt^3 / 3, and their covariance is q dt^2 / 2.
    of_twist = np.zeros(6) if wander is None else wander
    Q = np.zeros((n, n))
    Q[range(6), range(6)] = dt * process + dt**3 / 3 * of_twist
    if wander is not None:
        Q[range(6), range(6, 12)] = Q[range(6, 12), range(6)] = dt**2 / 2 * wander
        Q[range(6, 12), range(6, 12)] = dt * wander
    G = np.broadcast_to(np.eye(n), F.shape).copy()
    G[..., :3, :3] = jacobian
    return F @ P @ np.swapaxes(F, -1, -2) + G @ Q @ np.swapaxes(G, -1, -2)
