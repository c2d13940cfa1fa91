"""Compute steps of the posterior Cramer-Rao bound: prediction, and one epoch with its score."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds import information, pose
from rbl_gym.checks import BoolArray, FloatArray, kernel
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import bearing, ranging
from rbl_gym.motion.kinematics import ProcessNoise

__all__ = ["predict_covariance", "predict_information"]

# Internal functions without checks: their arguments were checked, or made here.
_EXP = kernel(rotations.exp)


def predict_information(
    J: FloatArray, twist: FloatArray, dt: ArrayLike, process: ProcessNoise
) -> FloatArray:
    """Return the information after a step, ``(F J^-1 F^T + Q)^-1``, also for a singular J.

    Arguments as in `predict_covariance`, with information J (..., n, n) instead of P. States beyond
    the six of the pose are constant.
    """
    # F is a rotation: with T = F J F^T this is (I + T Q)^-1 T.
    turned = _turn(J, twist, dt)
    crossed = turned[..., :6] @ process.covariance(twist, dt)
    A = np.broadcast_to(np.eye(J.shape[-1]), (*crossed.shape[:-2], *J.shape[-2:])).copy()
    A[..., :6] += crossed
    return pose.symmetric(np.linalg.solve(A, turned))


def predict_covariance(
    P: FloatArray, twist: FloatArray, dt: ArrayLike, process: ProcessNoise
) -> FloatArray:
    """Return the pose covariance after a step, ``F P F^T + Q``, ``F = blkdiag(exp(w dt), I)``.

    Parameters
    ----------
    P, twist
        (..., 6, 6) and (..., 6).
    dt, process
        Seconds, and the process noise.
    """
    return _turn(P, twist, dt) + process.covariance(twist, dt)


def _turn(matrix: FloatArray, twist: FloatArray, dt: ArrayLike) -> FloatArray:
    """Return ``F matrix F^T``, F rotates the rotation part of the error, which is global."""
    step = _EXP(twist[..., :3] * np.asarray(dt, float)[..., None])
    top = step @ matrix[..., :3, :]
    turned = np.empty((*top.shape[:-2], *matrix.shape[-2:]))
    turned[..., :3, :3] = top[..., :3] @ np.swapaxes(step, -1, -2)
    turned[..., :3, 3:] = top[..., 3:]
    turned[..., 3:, :3] = np.swapaxes(top[..., 3:], -1, -2)
    turned[..., 3:, 3:] = matrix[..., 3:, 3:]
    return turned


# --- a step and its score, for environments: nothing is checked --------------


@compiled("pose_bound:step_of_ranges")
def step_of_ranges(
    prior: FloatArray,
    twist: FloatArray,
    dt: ArrayLike,
    std: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    law: FloatArray,
    share: FloatArray | BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """Return information (..., 6, 6) after an epoch of ranges, and the score (...) of its inverse.

    `prior` (..., 6, 6) is the information after the previous epoch. The twist (..., 6) of the
    interval `dt` since then is known; 0 for no interval. `std` (6,) are the standard deviations of
    the process noise after 1 s, `law` the numbers of the noise law (`ranging.numbers_of`), `share`
    (..., M, N) the share of its information that each link has. The pose is the true one. The score
    is NaN if the information is not positive definite.
    """
    noise = ranging.law_of(law)
    told = information.information_at(anchors, tags, rotation, translation, noise, share)
    return _with_score(_predicted(prior, twist, dt, std) + told, rotation, tags)


@compiled("pose_bound:step_of_angles")
def step_of_angles(
    prior: FloatArray,
    twist: FloatArray,
    dt: ArrayLike,
    std: FloatArray,
    station: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    angle_std: float,
) -> tuple[FloatArray, FloatArray]:
    """Compute `step_of_ranges` for angles at a station (..., 3), standard deviation in radians."""
    noise = bearing.AngleNoise(angle_std)
    places = ranging.tag_positions(rotation, translation - station, tags)
    of_tags = bearing.information(places, noise)
    told = information.lift(information.tag_jacobian(rotation, tags), of_tags)
    return _with_score(_predicted(prior, twist, dt, std) + told, rotation, tags)


def _predicted(prior: FloatArray, twist: FloatArray, dt: ArrayLike, std: FloatArray) -> FloatArray:
    process = ProcessNoise(std[..., :3], std[..., 3:])  # pyrefly: ignore[bad-argument-type]
    return predict_information(prior, twist, dt, process)


def _with_score(
    J: FloatArray, rotation: FloatArray, tags: FloatArray
) -> tuple[FloatArray, FloatArray]:
    good = np.asarray(np.isfinite(J).all(axis=(-2, -1)))
    safe = np.where(good[..., None, None], J, 0.0)
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", safe), 1e-300))
    scaled = safe / (scale[..., :, None] * scale[..., None, :])
    good &= np.linalg.eigvalsh(scaled)[..., 0] > 1e-14
    covariance = np.linalg.inv(np.where(good[..., None, None], J, np.eye(6)))
    return J, np.where(good, pose.score(covariance, rotation, tags), np.nan)
