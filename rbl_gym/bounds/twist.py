"""Prediction of pose and twist (12 states) under `motion.unknown_twist`."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray, kernel
from rbl_gym.geometry import rotations
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import WanderingTwist

__all__ = ["predict_covariance"]

# Behind the doors: what comes to these was checked, or made here.
_EXP, _LEFT_JACOBIAN = kernel(rotations.exp), kernel(rotations.left_jacobian)


def predict_covariance(
    P: FloatArray,
    twist: FloatArray,
    dt: float,
    process: ProcessNoise,
    law: WanderingTwist | None,
) -> FloatArray:
    """Covariance (..., n, n) of n >= 12 states after `dt` seconds of an estimated twist (..., 6).

    ``F P F^T + Q`` where F takes ``(w, v)`` to ``(exp(W dt) w + dt Jl dW, v + dt dV)``; states
    beyond the twelve stand still. Without a law the twist is known: all beyond six stand still.
    `process` adds its noise to the pose.
    """
    wander = None if law is None else law.std() ** 2
    return covariance_after(P, twist, dt, process.std() ** 2, wander)


def covariance_after(
    P: FloatArray, twist: FloatArray, dt: float, process: FloatArray, wander: FloatArray | None
) -> FloatArray:
    """`predict_covariance` by variances (6,) after 1 s; `wander` None: the twist is known."""
    turn = twist[..., :3] * dt
    step, jacobian = _EXP(turn), _LEFT_JACOBIAN(turn)
    n = P.shape[-1]
    F = np.broadcast_to(np.eye(n), (*turn.shape[:-1], n, n)).copy()
    F[..., :3, :3] = step
    if wander is not None:
        F[..., :3, 6:9] = dt * jacobian
        F[..., 3:6, 9:12] = dt * np.eye(3)
    # The noise in the frame of the turn: of an acceleration q the change of speed has variance
    # q dt, the way q dt^3 / 3, and their covariance is q dt^2 / 2.
    of_twist = np.zeros(6) if wander is None else wander
    Q = np.zeros((n, n))
    Q[range(6), range(6)] = dt * process + dt**3 / 3 * of_twist
    if wander is not None:
        Q[range(6), range(6, 12)] = Q[range(6, 12), range(6)] = dt**2 / 2 * wander
        Q[range(6, 12), range(6, 12)] = dt * wander
    G = np.broadcast_to(np.eye(n), F.shape).copy()
    G[..., :3, :3] = jacobian
    return F @ P @ np.swapaxes(F, -1, -2) + G @ Q @ np.swapaxes(G, -1, -2)
