"""State of a bank of filters: a leading hypothesis and its rivals."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.geometry.rotations import error as rotation_error

RIVALS = 3
# Squared Mahalanobis distance below which two hypotheses are the same.
SAME = 1.0
# Poses that fill empty slots of rivals.
EMPTY = PoseState(
    np.broadcast_to(np.eye(3), (RIVALS, 3, 3)),
    np.zeros((RIVALS, 3)),
    np.broadcast_to(np.eye(6), (RIVALS, 6, 6)),
)


class BankState(NamedTuple):
    """The leading hypothesis and K rivals, with leading batch axes.

    `log_odds` (..., K) compares each rival with the leader; minus infinity for an empty slot. `nis`
    (...) is the sum of the squared whitened innovations, and `links` (...) the number of links. In
    both sums earlier epochs have smaller weights.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    rival_rotation: FloatArray
    rival_translation: FloatArray
    rival_covariance: FloatArray
    log_odds: FloatArray
    nis: FloatArray
    links: FloatArray


# Trailing axes of the fields of a `BankState`.
_FIELDS = (2, 1, 2, 3, 2, 3, 1, 0, 0)


def alone(leader: PoseState) -> BankState:
    """Return the state of a leader without rivals."""
    batch = leader.translation.shape[:-1]
    rivals = (np.broadcast_to(a, (*batch, *a.shape)).copy() for a in EMPTY)
    odds = np.full((*batch, RIVALS), -np.inf)
    return BankState._make([*leader, *rivals, odds, np.zeros(batch), np.zeros(batch)])


def with_best(
    state: BankState,
    rows: np.ndarray,
    place: tuple[np.ndarray, ...],
    candidates: int,
    found: PoseState,
    odds: FloatArray,
) -> BankState:
    """Return the state with the most likely of old and new rivals.

    The new ones are `found` (K,), at `place` of (R, C).
    """
    new = np.full((len(rows), candidates), -np.inf)
    new[place] = odds
    everyone = np.concatenate([state.log_odds[rows], new], axis=1)
    fields = []
    for name, value in found._asdict().items():
        # Slots without a candidate keep the filler of an empty slot.
        added = np.repeat(getattr(EMPTY, name)[None, :1], len(rows), axis=0)
        added = np.repeat(added, candidates, axis=1)
        added[place] = value
        fields.append(np.concatenate([getattr(state, f"rival_{name}")[rows], added], axis=1))
    poses = PoseState(*fields)
    order = np.argsort(-everyone, axis=1)
    poses, everyone = _ordered(poses, everyone, order)
    gaps = distance(
        PoseState(*(a[:, :, None] for a in poses)), PoseState(*(a[:, None] for a in poses))
    )
    # Of equal hypotheses keep the most likely.
    likelier = np.tri(everyone.shape[1], k=-1, dtype=bool) & np.isfinite(everyone)[:, None]
    everyone[((gaps < SAME) & likelier).any(axis=-1)] = -np.inf
    order = np.argsort(-everyone, axis=1)[:, :RIVALS]
    poses, everyone = _ordered(poses, everyone, order)
    log_odds = state.log_odds.copy()
    log_odds[rows] = everyone
    where = tuple(index.ravel() for index in np.broadcast_arrays(rows[:, None], range(RIVALS)))
    best = PoseState(*(a.reshape((-1, *a.shape[2:])) for a in poses))
    return with_rivals(state._replace(log_odds=log_odds), where, best)


def _ordered(
    poses: PoseState, log_odds: FloatArray, order: np.ndarray
) -> tuple[PoseState, FloatArray]:
    """Return hypotheses (R, C, ...) and their odds in an order (R, C)."""
    row = np.arange(len(order))[:, None]
    return PoseState(*(a[row, order] for a in poses)), log_odds[row, order]


def distance(one: PoseState, other: PoseState) -> FloatArray:
    """Return the squared distance (...) of two poses in the wider covariance, to first order."""
    turn = rotation_error(one.rotation, other.rotation)
    gap = np.concatenate([turn, one.translation - other.translation], axis=-1)[..., None]
    return np.minimum(
        *((gap * np.linalg.solve(P, gap)).sum(axis=(-2, -1)) for P in (one[2], other[2]))
    )


def leader_of(state: BankState) -> PoseState:
    """Return the leading hypothesis."""
    return PoseState(*state[:3])


def rivals_of(state: BankState, where: tuple[np.ndarray, ...]) -> PoseState:
    """Return the rivals (L, ...) at an index into trials and slots."""
    return PoseState(*(array[where] for array in state[3:6]))


def with_rivals(state: BankState, where: tuple[np.ndarray, ...], rivals: PoseState) -> BankState:
    """Return the state with rivals (L, ...) stored at an index into trials and slots."""
    fields = {}
    for name, value in rivals._asdict().items():
        fields[f"rival_{name}"] = getattr(state, f"rival_{name}").copy()
        fields[f"rival_{name}"][where] = value
    return state._replace(**fields)


def flat(state: BankState, batch: tuple[int, ...]) -> BankState:
    """Return the state with one batch axis (B,), all fields broadcast to the batch."""
    size = math.prod(batch)
    fields = []
    for array, n in zip(state, _FIELDS, strict=True):
        shape = array.shape[array.ndim - n :]
        fields.append(np.broadcast_to(array, (*batch, *shape)).reshape((size, *shape)))
    return BankState(*fields)


def of_batch(state: BankState, batch: tuple[int, ...]) -> BankState:
    """Return a flat state reshaped to the axes of its batch."""
    return BankState(*(array.reshape((*batch, *array.shape[1:])) for array in state))


def rows_of(array: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    """Return an array (..., m, n) of one epoch as (B, m, n)."""
    shape = array.shape[-2:]
    return np.broadcast_to(array, (*batch, *shape)).reshape((math.prod(batch), *shape))
