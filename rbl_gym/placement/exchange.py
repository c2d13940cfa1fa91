"""Choose anchors among candidates: greedily, by swaps, and by fresh candidates.

Information is a sum over the anchors, so that of each candidate is computed once.
"""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray
from rbl_gym.placement.setting import Setting

__all__ = ["choose", "refresh", "swap"]

# Candidates that are evaluated at a time, and for a swap.
_AT_ONCE, _FOR_SWAP = 8, 24
# Below this number anchors support each other: the benefit of a candidate may increase.
_TOGETHER = 6
# Number of poses for a first comparison of fresh candidates, and of those compared over all.
_SCREEN, _SCREENED = 512, 6
# Standard deviations of fresh candidates around an anchor: fractions of the largest extent.
_SPREADS = np.array([0.005, 0.02, 0.05, 0.15])
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
    sample = setting.sample
    P = np.linalg.inv(information)
    J = bounds.tag_jacobian(sample.rotation, setting.scene.body)
    S = np.einsum("pnia,pnib->pab", J, J) / J.shape[-3]
    K = sample.weight[:, None, None] * (P @ S @ P)
    return (MULTIPLICITY * packed(K)).astype(np.float32).ravel()


def refresh(
    setting: Setting,
    anchors: FloatArray,
    rng: np.random.Generator,
    each: int = 8,
) -> tuple[FloatArray, float]:
    """Do one round of fresh candidates: each anchor moves to its best one if that helps.

    Parameters
    ----------
    setting
        The setting of the score.
    anchors
        (M, 3), metres.
    rng
        Draws the candidates.
    each
        Number of candidates at each of some distances around the anchor, and of candidates from
        anywhere. They are projected onto the region, so that those near an edge may lie on the
        adjacent face.

    Returns
    -------
    The layout and its score.
    """
    anchors, region, sample = anchors.copy(), setting.region, setting.sample
    spreads = np.repeat(_SPREADS * float(np.ptp(region.bounds(), axis=0).max()), each)
    parts = setting.parts(anchors)
    total = sample.prior + parts.sum(axis=0)
    least = float(setting.squares(total))
    step = max(1, len(sample.places) // _SCREEN)
    indices = [sample.every(step, first) for first in range(step)] if step > 1 else []
    parts_of_sample = [(index, setting.part(index)) for index in indices]
    for m in rng.permutation(len(anchors)):
        near = anchors[m] + spreads[:, None] * rng.standard_normal((len(spreads), 3))
        fresh = np.concatenate([region.project(near), region.draw(rng.random((each, 3)))])
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
