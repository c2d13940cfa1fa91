"""Swaps of one anchor of a layout for a candidate, one evaluation of the score each.

`exchange.swap` is for one problem and evaluates the best candidates of each anchor. Here the number
of evaluations is limited, and many problems are solved at once.

The evaluation gives, for each anchor left out, the derivative of the score by the information of
each candidate. The pair of anchor and candidate with the best estimate from it is tried next.
Problems may have leading axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.placement.exchange import MULTIPLICITY, packed
from rbl_gym.placement.setting import Setting

__all__ = ["State", "better", "bound_of", "evaluated", "occupied", "swapped"]


class Bound(NamedTuple):
    """What gives the score of a layout.

    Attributes
    ----------
    setting
        The problem.
    spread
        Mean of ``J_n^T J_n`` (P, 6, 6).
    candidates
        Upper halves of the information of each candidate alone, (..., P, 21, C).
    """

    setting: Setting
    spread: FloatArray
    candidates: FloatArray


class State(NamedTuple):
    """Layouts with their scores.

    Attributes
    ----------
    points
        Anchors (..., M, 3).
    score
        Scores (...).
    decrease
        Estimates (..., M, C) of the decrease of the log of the squared score, if an anchor moves
        to a candidate.
    """

    points: FloatArray
    score: FloatArray
    decrease: FloatArray


def bound_of(setting: Setting, candidates: FloatArray) -> Bound:
    """Return what gives the score of a problem with candidates (..., C, 3)."""
    J = bounds.tag_jacobian(setting.sample.rotation, setting.scene.body)
    spread = np.einsum("pnia,pnib->pab", J, J) / J.shape[-3]
    told = packed(setting.parts(candidates)).astype(np.float32)
    return Bound(setting, spread, np.moveaxis(told, -3, -1).copy())


def evaluated(bound: Bound, points: FloatArray) -> State:
    """Return the state of layouts (..., M, 3)."""
    told = bound.setting.parts(points)
    total = told.sum(axis=-4) + bound.setting.sample.prior
    score = np.sqrt(bound.setting.squares(total))
    if not bound.candidates.shape[-1]:
        return State(points, score, np.zeros((*points.shape[:-1], 0)))
    P = np.linalg.inv(total[..., None, :, :, :] - told)
    K = P @ bound.spread @ P
    squares = np.einsum("...ab,...ba->...", P, bound.spread)
    # Of each pose, b^2 falls from s to s / (1 + g) with the information, where g s is the
    # derivative: exactly so if one direction dominates. The estimate for the anchor itself is of
    # the same kind.
    by = (MULTIPLICITY * packed(K) / squares[..., None]).astype(np.float32)
    gain = np.maximum(np.swapaxes(by, -2, -3) @ bound.candidates, 0.0)
    weighted = bound.setting.sample.weight * squares
    left = np.einsum("...mp,...pmc->...mc", weighted, 1 / (1 + gain))
    gain = np.maximum(np.einsum("...a,...a->...", by, packed(told)), 0.0)
    own = (weighted / (1 + gain)).sum(axis=-1, keepdims=True)
    return State(points, score, np.log(own / left))


def occupied(points: FloatArray, candidates: FloatArray) -> BoolArray:
    """Return the pairs (..., M, C) of which the candidate has an anchor already."""
    there = (points[..., :, None, :] == candidates[..., None, :, :]).all(axis=-1)
    return np.broadcast_to(there.any(axis=-2, keepdims=True), there.shape)


def swapped(state: State, candidates: FloatArray, tried: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return layouts after the best swap by the estimate, and which pair (..., M, C) it is.

    Parameters
    ----------
    state
        The layouts before.
    candidates
        (..., C, 3).
    tried
        Pairs (..., M, C) that are not tried.
    """
    decrease = np.where(tried, -np.inf, state.decrease)
    flat = decrease.reshape(*decrease.shape[:-2], -1)
    pair = (np.arange(flat.shape[-1]) == flat.argmax(axis=-1)[..., None]).reshape(decrease.shape)
    moved = pair.any(axis=-1)[..., None]
    return np.where(moved, pair.astype(float) @ candidates, state.points), pair


def better(old: State, new: State) -> tuple[State, BoolArray]:
    """Return the better of two states for each problem, and where it is the new one."""
    is_new = np.asarray(new.score < old.score)
    fields = (
        np.where(np.expand_dims(is_new, tuple(range(is_new.ndim, x.ndim))), x, y)
        for x, y in zip(map(np.asarray, new), map(np.asarray, old), strict=True)
    )
    return State(*fields), is_new
