"""The posterior Cramer-Rao bound: one step, and the recursion over an episode with its scores."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds import pose
from rbl_gym.checks import BoolArray, FloatArray, check_array, kernel
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import bearing, ranging
from rbl_gym.motion.kinematics import ProcessNoise, check_process

__all__ = ["posterior_crb_step", "predict_covariance", "predict_information"]

# Behind the door: what comes to it was checked, or made here.
_EXP = kernel(rotations.exp)


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
    links: ArrayLike | None = None,
) -> FloatArray:
    """One step of the posterior Cramer-Rao recursion (Tichavsky et al. 1998) at the true pose.

    Parameters
    ----------
    J
        Posterior information (..., 6, 6) of the epoch before.
    anchors, tags, rotation, translation, links
        At the new epoch; the pose is the true one.
    noise
        Law of the ranges.
    twist, dt, process
        Motion of the interval that ends at the new epoch, and its noise.

    Returns
    -------
    Information (..., 6, 6) after the new epoch; its inverse is the bound.
    """
    J = check_array("J", J, (6, 6))
    twist = check_array("twist", twist, (6,))
    if (check_array("dt", dt, ()) < 0).any():
        raise ValueError(f"dt must not be negative, got {dt}")
    check_process(process)
    predicted = predict_information(J, twist, dt, process)
    return predicted + pose.range_information(anchors, tags, rotation, translation, noise, links)


def predict_information(
    J: FloatArray, twist: FloatArray, dt: ArrayLike, process: ProcessNoise
) -> FloatArray:
    """Information after a step of motion, ``(F J^-1 F^T + Q)^-1``, also for a singular J.

    Arguments as `predict_covariance`, with information J (..., 6, 6) for P.
    """
    turned = _turn(J, twist, dt)
    Q = process.covariance(twist, dt)
    return pose.symmetric(np.linalg.solve(np.eye(6) + turned @ Q, turned))


def predict_covariance(
    P: FloatArray, twist: FloatArray, dt: ArrayLike, process: ProcessNoise
) -> FloatArray:
    """Pose covariance after a step of motion, ``F P F^T + Q``, ``F = blkdiag(exp(w dt), I)``.

    Parameters
    ----------
    P, twist
        (..., 6, 6) and (..., 6).
    dt, process
        Seconds, and the noise of the motion.
    """
    return _turn(P, twist, dt) + process.covariance(twist, dt)


def _turn(matrix: FloatArray, twist: FloatArray, dt: ArrayLike) -> FloatArray:
    """``F matrix F^T`` of a symmetric matrix: the error is global, so its rotation part turns."""
    step = _EXP(twist[..., :3] * np.asarray(dt, float)[..., None])
    top = step @ matrix[..., :3, :]
    turned = np.empty((*top.shape[:-2], 6, 6))
    turned[..., :3, :3] = top[..., :3] @ np.swapaxes(step, -1, -2)
    turned[..., :3, 3:] = top[..., 3:]
    turned[..., 3:, :3] = np.swapaxes(top[..., 3:], -1, -2)
    turned[..., 3:, 3:] = matrix[..., 3:, 3:]
    return turned


# --- whole episodes, behind the doors of environments: nothing is checked ---------------------


@compiled("pose_bound:posterior_of_ranges")
def of_ranges(
    prior: FloatArray,
    twists: FloatArray,
    dt: FloatArray,
    std: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    law: FloatArray,
    share: FloatArray | BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """Information (..., T, 6, 6) after each of T epochs of ranges, and its score (..., T).

    Parameters
    ----------
    prior
        Information (..., 6, 6) before the first interval.
    twists, dt, std
        Known twists (..., T, 6) and lengths (T,) of the intervals that end at the epochs, 0 where
        there is none; standard deviations (6,) of the motion after 1 s.
    anchors, tags, rotation, translation
        (..., T, M, 3), (..., N, 3), (..., T, 3, 3), (..., T, 3); the poses are the true ones.
    law
        Numbers of the noise law (`ranging.numbers_of`).
    share
        (..., T, M, N), of its information that each link has.

    Returns
    -------
    NaN is the score of information that is not positive definite.
    """
    noise = ranging.law_of(law)
    told = pose.information_at(anchors, tags[..., None, :, :], rotation, translation, noise, share)
    return _recursion(prior, twists, dt, std, told, rotation, tags)


@compiled("pose_bound:posterior_of_angles")
def of_angles(
    prior: FloatArray,
    twists: FloatArray,
    dt: FloatArray,
    std: FloatArray,
    stations: FloatArray,
    tags: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    angle_std: float,
) -> tuple[FloatArray, FloatArray]:
    """As `of_ranges`, of angles at stations (..., T, 3) with this standard deviation in radians."""
    body, noise = tags[..., None, :, :], bearing.AngleNoise(angle_std)
    places = ranging.tag_positions(rotation, translation - stations, body)
    told = pose.lift(pose.tag_jacobian(rotation, body), bearing.information(places, noise))
    return _recursion(prior, twists, dt, std, told, rotation, tags)


def _recursion(
    prior: FloatArray,
    twists: FloatArray,
    dt: FloatArray,
    std: FloatArray,
    told: FloatArray,
    rotation: FloatArray,
    tags: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    process = ProcessNoise(tuple(std[:3].tolist()), tuple(std[3:].tolist()))
    information, steps = prior, []
    for k in range(twists.shape[-2]):
        predicted = predict_information(information, twists[..., k, :], dt[k], process)
        information = predicted + told[..., k, :, :]
        steps.append(information)
    after = np.stack(steps, axis=-3)
    return after, _score(after, rotation, tags[..., None, :, :])


def _score(information: FloatArray, rotation: FloatArray, tags: FloatArray) -> FloatArray:
    """Score (...) of information (..., 6, 6), NaN where that is not positive definite."""
    good = np.isfinite(information).all(axis=(-2, -1))
    safe = np.where(good[..., None, None], information, 0.0)
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", safe), 1e-300))
    scaled = safe / (scale[..., :, None] * scale[..., None, :])
    good &= np.linalg.eigvalsh(scaled)[..., 0] > 1e-14
    covariance = np.linalg.inv(np.where(good[..., None, None], information, np.eye(6)))
    return np.where(good, pose.score(covariance, rotation, tags), np.nan)
