"""Choose anchors among candidates: greedily, by swaps, and by fresh candidates.

Information is a sum over the anchors, so that of each candidate is computed once. `choose`, `swap`
and `refresh` are for one problem: they evaluate the best candidates of each anchor.

The other functions are for swaps of many problems at once, with leading axes, and with one
evaluation of the score for each swap. The evaluation gives, for each anchor left out, the
derivative of the score by the information of each candidate. The pair of anchor and candidate with
the best estimate from it is tried next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.placement.setting import Setting

__all__ = [
    "State", "better", "bound_of", "choose", "evaluated", "occupied", "refresh", "swap", "swapped",
]  # fmt: skip

# Candidates that are evaluated at a time, and for a swap.
_AT_ONCE, _FOR_SWAP = 8, 24
# Below this number anchors support each other: the benefit of a candidate may increase.
_TOGETHER = 6
# Number of poses for a first comparison of fresh candidates, and of those compared over all.
_SCREEN, _SCREENED = 512, 6
# Standard deviations of fresh candidates around an anchor: fractions of the largest extent.
_SPREADS = np.array([0.005, 0.02, 0.05, 0.15])
# Number of fresh candidates with each of these deviations, and of those from the whole region.
_EACH = 8
# Anchors closer to each other than this coincide, metres.
_APART_M = 1e-3
# Upper half of a 6 x 6 matrix, and the multiplicity of its entries in a product.
_ROWS, _COLUMNS = np.triu_indices(6)
MULTIPLICITY = np.where(_ROWS == _COLUMNS, 1.0, 2.0)


def packed(matrices: FloatArray) -> FloatArray:
    """Return the upper halves (..., 21) of symmetric matrices (..., 6, 6)."""
    return matrices[..., _ROWS, _COLUMNS]


def choose(setting: Setting, parts: FloatArray, count: int) -> list[int]:
    """Return indices of `count` candidates, chosen greedily.

    The benefit of a candidate nearly always decreases as anchors are added. Therefore only
    candidates whose last benefit was above the present best are evaluated again (lazy greedy).

    Parameters
    ----------
    setting
        The setting of the score.
    parts
        Information (C, P, 6, 6) of the candidates, C at least `count`.
    count
        How many to choose.
    """
    found: list[int] = []
    base = setting.sample.prior
    now, worth = float(setting.squares(base)), np.full(len(parts), np.inf)
    for number in range(count):
        if number < _TOGETHER:
            worth[:] = np.inf
        worth[found] = -np.inf
        order, best, least = np.argsort(-worth, kind="stable")[: len(parts) - number], -1, np.inf
        for begin in range(0, len(order), _AT_ONCE):
            some = order[begin : begin + _AT_ONCE]
            if worth[some[0]] < now - least:
                break
            squares = setting.squares(base + parts[some])
            worth[some] = now - squares
            if squares.min() < least:
                best, least = int(some[squares.argmin()]), float(squares.min())
        found.append(best)
        base, now = base + parts[best], least
    return found


def swap(setting: Setting, parts: FloatArray, indices: list[int], rounds: int = 3) -> list[int]:
    """Return the chosen candidates after swaps of one for another, as long as they help.

    Only the candidates with the best derivative of the mean square are evaluated. Arguments as in
    `choose`.
    """
    found = list(indices)
    halves = np.ascontiguousarray(packed(parts), dtype=np.float32).reshape(len(parts), -1)
    total = setting.sample.prior + parts[found].sum(axis=0)
    least = float(setting.squares(total))
    for _ in range(rounds):
        before = least
        for place, old in enumerate(found):
            without = total - parts[old]
            promise = halves @ _promise(setting, without)
            promise[found] = -np.inf
            some = np.argsort(-promise, kind="stable")[: min(_FOR_SWAP, len(parts) - len(found))]
            if not len(some):
                return found
            squares = setting.squares(without + parts[some])
            if squares.min() < least * (1 - 1e-9):
                found[place], least = int(some[squares.argmin()]), float(squares.min())
                total = without + parts[found[place]]
        if least > before * (1 - 1e-4):
            break
    return found


def _promise(setting: Setting, information: FloatArray) -> FloatArray:
    """Return minus the derivative of the mean square by the information's upper halves (P x 21)."""
    _, slope = _square_and_slope(_spread(setting), information)
    return (setting.sample.weight[:, None] * slope).astype(np.float32).ravel()


def _spread(setting: Setting) -> FloatArray:
    """Return the mean of ``J_n^T J_n`` (P, 6, 6)."""
    J = bounds.tag_jacobian(setting.sample.rotation, setting.scene.body)
    return np.einsum("pnia,pnib->pab", J, J) / J.shape[-3]


def _square_and_slope(spread: FloatArray, information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return b^2 (..., P), and minus its derivative by the upper halves of information."""
    P = np.linalg.inv(information)
    square = np.einsum("...ab,...ba->...", P, spread)
    return square, MULTIPLICITY * packed(P @ spread @ P)


def refresh(
    setting: Setting, anchors: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, float]:
    """Do one round of fresh candidates: each anchor moves to its best one if that helps.

    Parameters
    ----------
    setting
        The setting of the score.
    anchors
        (M, 3), metres.
    rng
        Draws the candidates. They are projected onto the region, so that those near an edge may
        lie on the adjacent face.

    Returns
    -------
    The layout and its score.
    """
    anchors, region, sample = anchors.copy(), setting.region, setting.sample
    spreads = np.repeat(_SPREADS * float(np.ptp(region.bounds(), axis=0).max()), _EACH)
    parts = setting.parts(anchors)
    total = sample.prior + parts.sum(axis=0)
    least = float(setting.squares(total))
    step = max(1, len(sample.places) // _SCREEN)
    indices = [sample.every(step, first) for first in range(step)] if step > 1 else []
    parts_of_sample = [(index, setting.part(index)) for index in indices]
    for m in rng.permutation(len(anchors)):
        near = anchors[m] + spreads[:, None] * rng.standard_normal((len(spreads), 3))
        fresh = np.concatenate([region.project(near), region.draw(rng.random((_EACH, 3)))])
        fresh = fresh[~setting.obstacles.contain(fresh)]
        apart = np.abs(fresh[:, None] - np.delete(anchors, m, axis=0)).max(axis=-1)
        fresh = fresh[(apart > _APART_M).all(axis=-1)]
        without = total - parts[m]
        if step > 1 and len(fresh) > _SCREENED:
            index, few = parts_of_sample[int(rng.integers(step))]
            squares = few.squares(without[index] + few.parts(fresh))
            fresh = fresh[np.argsort(squares, kind="stable")[:_SCREENED]]
        if not len(fresh):
            continue
        told = setting.parts(fresh)
        squares = setting.squares(without + told)
        best = int(squares.argmin())
        if squares[best] < least:
            anchors[m], parts[m], least = fresh[best], told[best], float(squares[best])
            total = without + told[best]
    return anchors, least**0.5


# --- swaps of many problems ------------------------------------------------------------------


class Bound(NamedTuple):
    """What gives the score of a layout.

    `spread` is the mean of ``J_n^T J_n`` (P, 6, 6); `candidates` (..., P, 21, C) are upper halves
    of the information of each candidate alone.
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
    told = packed(setting.parts(candidates)).astype(np.float32)
    return Bound(setting, _spread(setting), np.moveaxis(told, -3, -1).copy())


def evaluated(bound: Bound, points: FloatArray) -> State:
    """Return the state of layouts (..., M, 3)."""
    told = bound.setting.parts(points)
    total = told.sum(axis=-4) + bound.setting.sample.prior
    score = np.sqrt(bound.setting.squares(total))
    if not bound.candidates.shape[-1]:
        return State(points, score, np.zeros((*points.shape[:-1], 0)))
    squares, slope = _square_and_slope(bound.spread, total[..., None, :, :, :] - told)
    # Of each pose, b^2 falls from s to s / (1 + g) with the information, where g s is the
    # derivative: exactly so if one direction dominates. The estimate for the anchor itself is of
    # the same kind.
    by = (slope / squares[..., None]).astype(np.float32)
    gain = np.maximum(np.swapaxes(by, -2, -3) @ bound.candidates, 0.0)
    weighted = bound.setting.sample.weight * squares
    left = np.einsum("...mp,...pmc->...mc", weighted, 1 / (1 + gain))
    gain = np.maximum(np.einsum("...a,...a->...", by, packed(told)), 0.0)
    own = (weighted / (1 + gain)).sum(axis=-1, keepdims=True)
    return State(points, score, np.log(own / left))


def occupied(points: FloatArray, candidates: FloatArray) -> BoolArray:
    """Return which pairs (..., M, C) have a candidate that is already used by an anchor."""
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
