"""Posterior Cramer-Rao bound of pose and twist (12 states) under `motion.unknown_twist`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.pose import range_information, symmetric
from rbl_gym.checks import FloatArray, check_array, check_number
from rbl_gym.components import exp_and_left_jacobian, first, last, product
from rbl_gym.measurements import ranging
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import TwistSensor, WanderingTwist, check_laws

__all__ = ["posterior_crb_step", "predict_covariance"]


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
    batch = np.broadcast_shapes(P.shape[:-2], twist.shape[:-1])
    ndim = len(batch)
    turn, jacobian = exp_and_left_jacobian(np.ascontiguousarray(first(twist, 1, ndim)[:3]) * dt)
    P = first(P, 2, ndim)
    half = np.empty((*P.shape[:2], *batch))
    half[...] = P
    drift = None if law is None else dt * jacobian
    _advance(half, P, turn, drift, dt)
    moved = half.copy()
    _advance(moved.swapaxes(0, 1), half.swapaxes(0, 1), turn, drift, dt)
    wander = np.zeros(6) if law is None else law.std() ** 2
    pose = dt * process.std() ** 2 + dt**3 / 3 * wander
    both = dt**2 / 2 * wander
    spread = jacobian * pose[:3].reshape((3, *[1] * ndim))
    moved[:3, :3] += product(spread, jacobian.swapaxes(0, 1))
    for i in range(3, 6):
        moved[i, i] += pose[i]
    if law is None:
        return last(moved, 2)
    crossed = jacobian * both[:3].reshape((3, *[1] * ndim))
    moved[:3, 6:9] += crossed
    moved[6:9, :3] += crossed.swapaxes(0, 1)
    for i in range(3, 6):
        moved[i, i + 6] += both[i]
        moved[i + 6, i] += both[i]
    for i in range(6):
        moved[i + 6, i + 6] += dt * wander[i]
    return last(moved, 2)


def _advance(
    out: FloatArray, P: FloatArray, turn: FloatArray, drift: FloatArray | None, dt: float
) -> None:
    """The pose's rows of ``F P`` (n, n, ...), where the turn rate moves it by `drift`."""
    out[:3] = product(turn, P[:3])
    if drift is not None:
        out[:3] += product(drift, P[6:9])
        out[3:6] = P[3:6] + dt * P[9:12]


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
    seen = range_information(anchors, tags, rotation, translation, noise, links)
    batch = np.broadcast_shapes(predicted.shape[:-2], seen.shape[:-2])
    result = np.broadcast_to(symmetric(predicted), (*batch, 12, 12)).copy()
    result[..., :6, :6] += seen
    return result
