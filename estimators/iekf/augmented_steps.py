"""Prediction, updates and tracks of states besides the pose: textbook forms of kernels."""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.bounds.twist import covariance_after
from rbl_gym.checks import FloatArray
from rbl_gym.estimators.costs.bias_cost import AugmentedState, update_augmented
from rbl_gym.estimators.costs.map_problem import PoseState, pose_error, positive_inverse
from rbl_gym.estimators.level import held
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.kernels.constants import VAGUE
from rbl_gym.motion.kinematics import propagate


@compiled("augmented_filter:predict")
def predict_augmented(
    rotation: FloatArray,
    translation: FloatArray,
    extra: FloatArray,
    covariance: FloatArray,
    twist: FloatArray,
    dt: float,
    process: FloatArray,
    wander: FloatArray,
    laws: FloatArray,
    n_twist: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the fields of a state after `dt` seconds.

    Parameters
    ----------
    rotation, translation, extra, covariance
        As in `AugmentedState`.
    twist
        (..., 6), if it is known and not in the state (`n_twist` 0).
    process, wander
        Variances (6,) after 1 s: of the pose besides its twist, and of the twist.
    laws
        (n, 3) of the biases: standard deviation, time (infinite: constant), common standard
        deviation. Biases are Gauss-Markov processes.
    """
    moving = extra[..., :6] if n_twist else twist
    moved = propagate(rotation, translation, moving, dt)
    P = covariance_after(covariance, moving, dt, process, wander if n_twist else None)
    links = (extra.shape[-1] - n_twist) // max(1, len(laws))
    kept = np.ones(P.shape[-1])
    blocks = [
        slice(6 + n_twist + k * links, 6 + n_twist + (k + 1) * links) for k in range(len(laws))
    ]
    for block, (_, time, _) in zip(blocks, laws, strict=True):
        kept[block] = np.exp(-dt / time)
    P = P * kept[:, None] * kept
    for block, (std, time, common) in zip(blocks, laws, strict=True):
        fresh = std**2 * np.eye(links) + common**2
        P[..., block, block] += (1 - np.exp(-dt / time) ** 2) * fresh
    extra = np.broadcast_to(extra * kept[6:], (*moved[1].shape[:-1], extra.shape[-1]))
    return *moved, extra, P


def carried(state: AugmentedState, pose: PoseState) -> AugmentedState:
    """Return the state after an update of its pose; other states change by their correlation."""
    return AugmentedState(pose.rotation, pose.translation, *carry_states(*state, *pose))


@compiled("carried_states:carry")
def carry_states(
    rotation: FloatArray,
    translation: FloatArray,
    extra: FloatArray,
    covariance: FloatArray,
    new_rotation: FloatArray,
    new_translation: FloatArray,
    new_covariance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return extra states (..., K) and covariance (..., 6 + K, 6 + K) for a new pose.

    The first four arguments are the previous state, the others the pose found by an update.
    """
    P, new = covariance, new_covariance
    turn = rotations.error(new_rotation, rotation)
    error, D = pose_error(turn, new_translation - translation)
    gain = P[..., 6:, :6] @ positive_inverse(P[..., :6, :6])
    # The error about the new pose is that about the old one times blkdiag(Jl^-1, I).
    slope = gain @ D
    across = slope @ new
    kept = P[..., 6:, 6:] - gain @ P[..., :6, 6:] + across @ np.swapaxes(slope, -1, -2)
    covariance = np.empty((*new.shape[:-2], *P.shape[-2:]))
    covariance[..., :6, :6] = new
    covariance[..., 6:, :6], covariance[..., :6, 6:] = across, np.swapaxes(across, -1, -2)
    covariance[..., 6:, 6:] = bounds.symmetric(kept)
    return extra + (gain @ error[..., None])[..., 0], covariance


@compiled("tracks:track")
def track_augmented(
    rotation: FloatArray,
    translation: FloatArray,
    extra: FloatArray,
    covariance: FloatArray,
    twist: FloatArray,
    dt: FloatArray,
    process: FloatArray,
    wander: FloatArray,
    laws: FloatArray,
    n_twist: int,
    level: FloatArray,
    ranges: FloatArray,
    weights: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
    iterations: int,
    loss: FloatArray,
) -> tuple[FloatArray, ...]:
    """Predict and update a state with biases over E epochs.

    Parameters
    ----------
    rotation, translation, extra, covariance
        The state before the first prediction, as in `AugmentedState`.
    twist, dt
        (..., E, 6) and (E,), of the intervals before the epochs; 0 s: no prediction.
    process, wander, laws, n_twist
        As in `predict_augmented`.
    level
        Known height and tilt (3,), as in `held`.
    ranges, weights, anchors, tags, iterations, loss
        As in `update_augmented`, with an axis of epochs: (..., E, M, N), (..., E, M, 3).

    Returns
    -------
    The fields of the states before the updates, and of those after, with the axis of epochs in
    front of their own; and the number of epochs (...). The track ends before an epoch at which the
    prior may be so vague that its update needs a search, or whose result is not finite. The fields
    of later epochs have arbitrary values.
    """
    state = AugmentedState(rotation, translation, extra, covariance)
    batch = np.broadcast_shapes(extra.shape[:-1], ranges.shape[:-3], twist.shape[:-2])
    cores = (3, 3), (3,), extra.shape[-1:], covariance.shape[-2:]
    fields = tuple(np.full((*batch, len(dt), *core), np.nan) for core in 2 * cores)
    count = np.zeros(batch, np.int64)
    for e, seconds in enumerate(dt.tolist()):
        moved = AugmentedState(
            *predict_augmented.textbook(
                *state, twist[..., e, :], seconds, process, wander, laws, n_twist
            )
        )
        moved, P = held(state, moved, level), moved.covariance
        if not (P[..., 0, 0] + P[..., 1, 1] + P[..., 2, 2] <= VAGUE).all():
            break
        epoch = ranges[..., e, :, :], weights[..., e, :, :], anchors[..., e, :, :], tags
        own = *moved[:2], moved.covariance[..., :6, :6]
        state = AugmentedState(
            *update_augmented.textbook(*moved, *epoch, *own, iterations, loss, n_twist)
        )
        if not np.isfinite(state.covariance[..., 0, 0]).all():
            break
        for field, value, core in zip(fields, (*moved, *state), 2 * cores, strict=True):
            field[(..., e, *(slice(None),) * len(core))] = value
        count += 1
    return *fields, count
