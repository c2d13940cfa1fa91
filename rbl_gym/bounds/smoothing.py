"""Compute the smoothing Cramer-Rao bound: of every epoch of a log, from all ranges of the log.

The information about all epochs together is block-tridiagonal. With ``e' = F e + n``, n of
covariance Q, an interval adds ``F^T Q^-1 F``, ``-F^T Q^-1`` and ``Q^-1`` to the blocks of its two
ends; ranges and the prior add to the diagonal. The diagonal blocks of the inverse are the bounds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.information import range_information
from rbl_gym.bounds.motions import KnownTwist, UnknownTwist
from rbl_gym.bounds.nuisances import RangeEpoch
from rbl_gym.bounds.tridiagonal import inverse_blocks
from rbl_gym.checks import FloatArray, check_array, kernel
from rbl_gym.geometry import rotations
from rbl_gym.motion.kinematics import ProcessNoise, check_process
from rbl_gym.motion.unknown_twist import WanderingTwist, check_laws

__all__ = ["smoothing_crb"]

# Minimum standard deviation of an interval (rad, m, rad/s, m/s) on every axis. Without noise, the
# information would be infinite.
LEAST_STD = 1e-6
# Internal functions without checks: their arguments were checked, or made here.
_EXP, _LEFT_JACOBIAN = kernel(rotations.exp), kernel(rotations.left_jacobian)


def smoothing_crb(
    epochs: RangeEpoch,
    motion: KnownTwist | UnknownTwist,
    prior_covariance: ArrayLike,
    offset: str | None = None,
) -> FloatArray:
    """Return the Cramer-Rao bound of the poses of K epochs from all ranges, at the true poses.

    Parameters
    ----------
    epochs
        The ranges of all epochs: rotations (..., K, 3, 3), translations (..., K, 3), links
        (..., K, M, N), anchors (M, 3), or (..., K, M, 3) if they move.
    motion
        Motion in the intervals between epochs: true twists (..., K - 1, 6), and their lengths `dt`,
        a number or (..., K - 1) seconds.
    prior_covariance
        (..., 6, 6), prior of the pose at the first epoch.
    offset
        Which ranges share an unknown offset, independent at every epoch, as in
        `range_information`.

    Returns
    -------
    Covariances (..., K, 6, 6) of the pose error; with `UnknownTwist` (..., K, 12, 12) of pose and
    twist.

    Raises
    ------
    ValueError
        If a shape or value is wrong.
    """
    twists = check_array("twist", motion.twist, ("K", 6))
    dt = np.broadcast_to(check_array("dt", motion.dt, ()), twists.shape[:-1])
    if (dt < 0).any():
        raise ValueError(f"dt must not be negative, got {dt.min()}")
    check_process(motion.process)
    law, sensor, process = None, None, motion.process
    if isinstance(motion, UnknownTwist):
        law, sensor = motion.law, motion.sensor
        check_laws(law, process)
    P = check_array("prior_covariance", prior_covariance, (6, 6))
    seen = range_information(*epochs, offset=offset)
    n = 6 if law is None else 12
    F, Q = _transition(twists, dt, process, law)
    weight, Ft = np.linalg.inv(Q), np.swapaxes(F, -1, -2)
    batch = np.broadcast_shapes(seen.shape[:-3], F.shape[:-3], P.shape[:-2])
    K = seen.shape[-3]
    if F.shape[-3] != K - 1:
        raise ValueError(
            f"twist must have {K - 1} entries, one for each interval between the {K} epochs, got "
            f"{F.shape[-3]}"
        )
    diagonal, above = np.zeros((*batch, K, n, n)), np.zeros((*batch, K, n, n))
    diagonal[..., :6, :6] = seen
    diagonal[..., 0, :6, :6] += np.linalg.inv(P)
    if law is not None:
        std = np.maximum(law.prior_std(), LEAST_STD)
        diagonal[..., 0, range(6, 12), range(6, 12)] += std**-2.0
    if sensor is not None:
        diagonal[..., :-1, :, :] += sensor.information(twists)
    diagonal[..., :-1, :, :] += Ft @ weight @ F
    diagonal[..., 1:, :, :] += weight
    above[..., :-1, :, :] = -Ft @ weight
    return inverse_blocks(diagonal, above)


def _transition(
    twist: FloatArray, dt: FloatArray, process: ProcessNoise, law: WanderingTwist | None
) -> tuple[FloatArray, FloatArray]:
    """Return F and Q of intervals with lengths (...), as in `bounds.twist.predict_covariance`."""
    n, dt = 6 if law is None else 12, dt[..., None]
    F, G = (np.broadcast_to(np.eye(n), (*twist.shape[:-1], n, n)).copy() for _ in range(2))
    F[..., :3, :3] = _EXP(twist[..., :3] * dt)
    G[..., :3, :3] = _LEFT_JACOBIAN(twist[..., :3] * dt)
    Q = np.zeros(F.shape)
    Q[..., range(6), range(6)] = dt * process.std() ** 2
    if law is not None:
        F[..., :6, 6:] = dt[..., None] * G[..., :6, :6]
        wander, pose, rate = law.std() ** 2, range(6), range(6, 12)
        Q[..., pose, pose] += dt**3 / 3 * wander
        Q[..., pose, rate] = Q[..., rate, pose] = dt**2 / 2 * wander
        Q[..., rate, rate] = dt * wander
    return F, G @ (Q + LEAST_STD**2 * np.eye(n)) @ np.swapaxes(G, -1, -2)
