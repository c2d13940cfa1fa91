"""Predict and update a pose as arrays: textbook forms of the kernels of `pose_filter`."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from rbl_gym.checks import HUGE, FloatArray, kernel
from rbl_gym.estimators.costs.levenberg_marquardt import minimize_pose
from rbl_gym.estimators.costs.losses import SQUARES, cut_huber
from rbl_gym.estimators.costs.map_problem import PoseState, map_problem, positive_inverse
from rbl_gym.estimators.costs.range_cost import RangeCost
from rbl_gym.estimators.costs.unseen_directions import kept_wide
from rbl_gym.estimators.iekf.robust_update import late_solution, robust_solution
from rbl_gym.estimators.inputs import plain
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.kernels.constants import GATE, HUBER, VAGUE
from rbl_gym.measurements import offsets
from rbl_gym.measurements.noise_laws import law_of

# The law of `update_pose` if its shares are weights.
WEIGHTS = np.array([2.0, 0.0, 0.0, -1.0])
# Internal functions without checks: their arguments were checked, or made here.
_EXP, _LEFT_JACOBIAN = kernel(rotations.exp), kernel(rotations.left_jacobian)


@compiled("pose_filter:predict")
def predict_pose(
    rotation: FloatArray,
    translation: FloatArray,
    covariance: FloatArray,
    twist: FloatArray,
    dt: float,
    variance: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pose and covariance after `dt` seconds of a twist, ``P <- F P F^T + dt G S G^T``.

    ``F = blkdiag(exp(w dt), I)`` and ``G = blkdiag(Jl(w dt), I)``: the error is global, and the
    noise, with `variance` (6,) after 1 s, acts on the angular velocity.
    """
    rotation, translation, covariance = plain(PoseState(rotation, translation, covariance))
    seconds = np.asarray(dt)[..., None]
    turn = twist[..., :3] * seconds
    F, G = (np.broadcast_to(np.eye(6), (*turn.shape[:-1], 6, 6)).copy() for _ in range(2))
    F[..., :3, :3], G[..., :3, :3] = _EXP(turn), _LEFT_JACOBIAN(turn)
    spread = (G * (seconds * variance)[..., None, :]) @ np.swapaxes(G, -1, -2)
    return (
        F[..., :3, :3] @ rotation,
        translation + twist[..., 3:] * seconds,
        F @ covariance @ np.swapaxes(F, -1, -2) + spread,
    )


@compiled("pose_filter:update")
def update_pose(
    rotation: FloatArray,
    translation: FloatArray,
    covariance: FloatArray,
    ranges: FloatArray,
    shares: FloatArray,
    law: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    start_rotation: FloatArray,
    start_translation: FloatArray,
    options: np.ndarray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the most likely pose of an epoch near a start, its covariance, and its cost.

    Parameters
    ----------
    rotation, translation, covariance
        The prior.
    ranges, anchors, tags
        As in `RangeCost`.
    shares, law
        The weights (..., M, N) and `WEIGHTS`; or ones and the numbers (4,) of a noise law
        (`noise_laws.numbers_of`), if all links were measured.
    start_rotation, start_translation
        Start of Gauss-Newton.
    options
        (3,) ints: the kind of range offsets (`offsets.code_of`), the maximum number of Gauss-Newton
        iterations, and a value of `robust_update.ROBUST`. 1: the cost is Huber's loss of all links,
        constant beyond `GATE`. 2: it is the redescending loss.

    Returns
    -------
    Rotation, translation, covariance, cost (...). The last two are NaN if a matrix is not
    positive definite, a used range is not positive, or a value is not finite.
    """
    offset, iterations, robust = map(int, options)
    # The range of a lost link may have any value.
    ranges = np.where(shares == 0, 0.0, ranges)
    weights = shares if law[0] == WEIGHTS[0] else shares / law_of(law).variance(ranges)
    prior = plain(PoseState(rotation, translation, covariance))
    data = RangeCost(ranges, weights, anchors, tags, SQUARES, offset=offsets.name_of(offset))
    problem = map_problem(prior, data)
    if robust == 2:
        found = late_solution(problem, start_rotation, start_translation, iterations)
        cost = found.at.cost
    elif robust:
        found = robust_solution(problem, start_rotation, start_translation, iterations)
        data = dataclasses.replace(data, loss=cut_huber(HUBER, GATE))
        cost = dataclasses.replace(problem, data=data)(found.rotation, found.translation).cost
    else:
        found = minimize_pose(problem, start_rotation, start_translation, iterations)
        cost = found.at.cost
    low = -HUGE if offset else 0.0
    sound = (shares == 0) | (
        (ranges > low) & (ranges < HUGE) & (weights > 0) & np.isfinite(weights)
    )
    sound = sound.all(axis=(-2, -1)) & (np.abs(anchors) < HUGE).all(axis=(-2, -1))
    covariance = np.where(sound[..., None, None], positive_inverse(found.at.hessian), np.nan)
    pose = PoseState(found.rotation, found.translation, covariance)
    pose = kept_wide(prior, pose, (weights > 0).any(axis=-2), tags)
    known = np.isfinite(pose.covariance).all(axis=(-2, -1))
    return *pose, np.where(known, cost, np.nan)


@compiled("pose_filter:update_near")
def update_pose_near(
    rotation: FloatArray,
    translation: FloatArray,
    covariance: FloatArray,
    ranges: FloatArray,
    shares: FloatArray,
    law: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    options: np.ndarray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return `update_pose` from the prior pose, without the cost.

    The covariance is also NaN if the prior's rotation is vague (trace above `VAGUE`).
    """
    prior, epoch = (rotation, translation, covariance), (ranges, shares, law, anchors, tags)
    rotation, translation, P, _ = update_pose.textbook(*prior, *epoch, *prior[:2], options)
    firm = covariance[..., :3, :3].trace(axis1=-2, axis2=-1) <= VAGUE
    return rotation, translation, np.where(firm[..., None, None], P, np.nan)


def as_state(rotation: FloatArray, translation: FloatArray, covariance: FloatArray) -> PoseState:
    """Return the state of an update, or raise LinAlgError if its covariance is invalid."""
    if not math.isfinite(np.vdot(covariance, covariance)):
        raise np.linalg.LinAlgError(
            "the information about the pose is not positive definite after the update: check the "
            "prior covariance, the noise and the ranges"
        )
    return PoseState(rotation, translation, covariance)
