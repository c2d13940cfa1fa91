"""Posterior Cramer-Rao bound of pose and twist (12 states) under `motion.unknown_twist`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.pose import range_information, symmetric
from rbl_gym.checks import FloatArray, check_array, check_number, kernel
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import TwistSensor, WanderingTwist, check_laws

__all__ = ["posterior_crb_step", "predict_covariance"]

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


def posterior_crb_step(
    J: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: ranging.NoiseLaw,
    twist: ArrayLike,
    dt: float,
    process: ProcessNoise,
    law: WanderingTwist,
    links: ArrayLike | None = None,
    sensor: TwistSensor | None = None,
    offset: str | None = None,
) -> FloatArray:
    """One step of the posterior Cramer-Rao recursion of pose and twist, at the truth.

    Parameters
    ----------
    J
        Posterior information (..., 12, 12) of the epoch before; that of a start is the inverse of
        ``blkdiag(pose prior, diag(law.prior_std()^2))``, plus that of its ranges.
    anchors, tags, rotation, translation, noise, links
        At the new epoch, as `bounds.posterior_crb_step`.
    twist
        True twist (..., 6) of the interval that ends there.
    dt, process, law
        Seconds, and the laws of pose and twist.
    sensor
        Reads the twist of that interval; None: nobody does.
    offset
        Whose ranges have an unknown offset in common, as of `bounds.range_information`.

    Returns
    -------
    Information (..., 12, 12); the first six rows of its inverse bound the pose.

    Raises
    ------
    ValueError
        On wrong shapes or values, and where J is singular.
    """
    J = check_array("J", J, (12, 12))
    twist = check_array("twist", twist, (6,))
    dt = check_number("dt", dt, low=0.0)
    check_laws(law, process)
    if not isinstance(sensor, TwistSensor | None):
        raise ValueError(f"sensor must be a TwistSensor or None, got {sensor!r:.80}")
    if sensor is not None:
        J = J + sensor.information(twist)
    try:
        P = symmetric(np.linalg.inv(J))
        predicted = np.linalg.inv(predict_covariance(P, twist, dt, process, law))
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"J must be information about all 12 states, got a singular one {J!r:.80}"
        ) from error
    seen = range_information(anchors, tags, rotation, translation, noise, links, offset=offset)
    batch = np.broadcast_shapes(predicted.shape[:-2], seen.shape[:-2])
    result = np.broadcast_to(symmetric(predicted), (*batch, 12, 12)).copy()
    result[..., :6, :6] += seen
    return result
