"""Choose layouts from a list of candidates, by their information at the poses of the zones.

Information is a sum over the anchors. The information of each candidate is therefore computed once,
and a layout is a choice of candidates, ``list[int]``; the fixed ones come first. The objective is
first to meet the requirements of the zones, or to miss as little of them as possible; among layouts
that meet them, it is b. For layouts that must survive the loss of any one anchor, it is the worst
remaining case.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.studies.placing.requirements import (
    Limits,
    asked_of,
    errors_of,
    relative_errors,
    shortfall,
)

__all__ = ["Stock", "ZonePoses", "all_choices", "cheaper", "grown", "swapped", "value"]

# An exchange must reduce the value by at least this much.
_GAIN = 1e-3
# The search leaves this factor between errors and limits: it sees fewer positions than the verdict.
_SPARE = 1.03
# Offset of the value if the requirements are met: log b is always smaller.
_MET = 100.0
# Maximum number of passes over all anchors.
_SWEEPS = 20
# For a long list: step between the positions at which all candidates are compared, number of
# candidates that are then tried exactly, and number of worst losses that are compared.
_EVERY, _TRIED, _WORST_LOSSES = 4, 24, 3
# Number of layouts that are evaluated at a time.
_CHUNK = 64


class ZonePoses(NamedTuple):
    """Poses of a zone, and its requirements.

    Attributes
    ----------
    places, rotation
        Positions (L, 3), and rotations (T, 3, 3) at each of them.
    prior
        Information (6, 6) before any range.
    tags
        Tag positions (N, 3) on the body.
    limits, share
        Limits of the errors at a position, and the required share of the zone within them.
    weight
        Weight of the zone in the mean of b^2.
    """

    places: FloatArray
    rotation: FloatArray
    prior: FloatArray
    tags: FloatArray
    limits: Limits
    share: float
    weight: float


class Stock(NamedTuple):
    """Candidates for anchors at the poses of the zones.

    Attributes
    ----------
    zones
        Poses of each zone.
    parts
        Information (K, L, T, 6, 6) of every candidate at every pose, for each zone.
    cost
        Cost (K,) of every candidate.
    """

    zones: tuple[ZonePoses, ...]
    parts: tuple[FloatArray, ...]
    cost: FloatArray

    @property
    def asks(self) -> bool:
        """Return whether any zone has a requirement."""
        return any(zone.limits.any() for zone in self.zones)


Base = Sequence[FloatArray]  # information (L, T, 6, 6) of each zone


def value(stock: Stock, chosen: Sequence[int], survive: int = 0) -> float:
    """Return the objective of the search; requirements are met if it is negative.

    If they are missed, it is the mean of the `shortfall` of the zones, with their weights. If they
    are met, or there are none, it is log b - 100: any such layout is better than one that misses a
    requirement. Errors count as 3 % larger than they are, so that layouts that are just within on
    these positions are not preferred.

    Parameters
    ----------
    stock, chosen
        Candidates, and the indices of the chosen ones.
    survive
        1: use the worst case over the loss of any one chosen candidate.
    """
    total = _total(stock, chosen)
    if not survive:
        return float(_values(stock, total)[0])
    return max(float(_values(stock, _less(stock, total, k))[0]) for k in chosen)


def grown(
    stock: Stock, chosen: Sequence[int], count: int, survive: int = 0
) -> Iterator[tuple[list[int], float]]:
    """Return greedy layouts: each is the previous one plus the candidate that helps most.

    The last layout has `count` anchors, or all candidates if there are fewer.

    Parameters
    ----------
    stock, chosen
        Candidates, and the indices to begin with.
    count
        The largest number of anchors.
    survive
        As in `value`. It applies to the returned values, and to the choice from the third anchor
        on.
    """
    found, coarse = list(chosen), _coarse(stock)
    while len(found) < min(count, len(stock.cost)):
        spare = survive if len(found) > 2 else 0
        best, _ = _best_added(stock, coarse, found, spare, math.inf)
        found = [*found, best]
        yield found, value(stock, found, survive)


def swapped(
    stock: Stock, chosen: Sequence[int], keep: int = 0, survive: int = 0
) -> tuple[list[int], float]:
    """Exchange single anchors for candidates while it helps; return the layout and its value.

    Parameters
    ----------
    stock, chosen
        Candidates, and the indices to begin with.
    keep
        Number of first anchors that are not exchanged.
    survive
        As in `value`.
    """
    found, best, coarse = list(chosen), value(stock, chosen, survive), _coarse(stock)
    for _ in range(_SWEEPS):
        before = best
        for k in range(keep, len(found)):
            others = found[:k] + found[k + 1 :]
            limit = best - _GAIN
            new, reached = _best_added(stock, coarse, others, survive, limit)
            if reached < limit and new != found[k]:
                found[k], best = new, reached
        if best == before:
            break
    return found, best


def dropped(
    stock: Stock, chosen: Sequence[int], keep: int = 0, survive: int = 0
) -> tuple[list[int], float]:
    """Return the layout without the least important anchor; the first `keep` are kept.

    Arguments as in `swapped`.
    """
    tried = [[*chosen[:k], *chosen[k + 1 :]] for k in range(keep, len(chosen))]
    values = [value(stock, one, survive) for one in tried]
    best = int(np.argmin(values))
    return tried[best], values[best]


def cheaper(stock: Stock, chosen: Sequence[int], keep: int = 0, survive: int = 0) -> list[int]:
    """Return a layout that still meets the requirements, after exchanges that save most cost.

    Arguments as in `swapped`.
    """
    found = list(chosen)
    if value(stock, found, survive) >= 0:
        return found
    saved = True
    while saved:
        saved = False
        for k in sorted(range(keep, len(found)), key=lambda k: -stock.cost[found[k]]):
            others = found[:k] + found[k + 1 :]
            less = stock.cost < stock.cost[found[k]] - 1e-12
            which = np.setdiff1d(np.flatnonzero(less), found)
            scores = with_candidates(stock, others, which, survive, 0.0)
            good = np.flatnonzero(scores < 0)
            if len(good):
                order = np.lexsort((scores[good], stock.cost[which[good]]))
                found[k], saved = int(which[good[order[0]]]), True
    return found


def all_choices(
    stock: Stock, count: int, keep: int = 0, survive: int = 0
) -> tuple[list[int], float]:
    """Return the best of all layouts of `count` candidates; the first `keep` are kept.

    Arguments as in `swapped`.
    """
    kept = list(range(keep))
    best, least = kept, math.inf
    rest = itertools.combinations(range(keep, len(stock.cost)), count - keep)
    while some := list(itertools.islice(rest, _CHUNK)):
        chosen = np.array([[*kept, *one] for one in some], dtype=int)
        totals = [
            zone.prior + np.stack([part[one].sum(axis=0) for one in chosen])
            for zone, part in zip(stock.zones, stock.parts, strict=True)
        ]
        values = _values(stock, totals)
        if survive:
            for k in range(count):
                less = [
                    total - part[chosen[:, k]]
                    for total, part in zip(totals, stock.parts, strict=True)
                ]
                left = _values(stock, less)
                values = left if k == 0 else np.maximum(values, left)
        if values.min() < least:
            best, least = chosen[values.argmin()].tolist(), float(values.min())
    return best, least


# --- values --------------------------------------------------------------------------------------


def _total(stock: Stock, chosen: Sequence[int]) -> Base:
    index = list(chosen)
    return [
        zone.prior + part[index].sum(axis=0)
        for zone, part in zip(stock.zones, stock.parts, strict=True)
    ]


def _less(stock: Stock, total: Base, k: int) -> Base:
    return [a - part[k] for a, part in zip(total, stock.parts, strict=True)]


def _coarse(stock: Stock) -> Stock:
    """Return the stock at every fourth position, to exclude most candidates of a long list."""
    zones = tuple(zone._replace(places=zone.places[::_EVERY]) for zone in stock.zones)
    parts = tuple(np.ascontiguousarray(part[:, ::_EVERY]) for part in stock.parts)
    return Stock(zones, parts, stock.cost)


def _best_added(
    stock: Stock, coarse: Stock, others: list[int], survive: int, limit: float
) -> tuple[int, float]:
    """Return the candidate that improves the layout `others` most, and the value with it."""
    which = np.setdiff1d(np.arange(len(stock.cost)), others)
    if len(which) > _TRIED:
        rough = with_candidates(coarse, others, None, survive, math.inf, _WORST_LOSSES)
        rough[others] = math.inf
        which = np.argpartition(rough, _TRIED)[:_TRIED]
    scores = with_candidates(stock, others, which, survive, limit)
    best = int(scores.argmin())
    return int(which[best]), float(scores[best])


def with_candidates(
    stock: Stock,
    others: list[int],
    which: np.ndarray | None,
    survive: int,
    limit: float,
    losses: int | None = None,
) -> FloatArray:
    """Return the value (J,) of the layout `others` with each of the candidates `which`.

    None: all candidates. With `survive`, the value is infinite for a candidate that is no better
    than `limit`. `losses` is the number of losses to test, the worst first; None: all.
    """
    base = _total(stock, others)
    # A slice selects all of them without a copy.
    every = slice(None) if which is None else which
    if not survive:
        return _values(stock, base, every)
    # The candidate itself may fail, or any of the others. The worst loss comes first, so that most
    # candidates are excluded early.
    count = len(stock.cost) if which is None else len(which)
    worst = np.full(count, float(_values(stock, base)[0]))
    left = [(float(_values(stock, _less(stock, base, k))[0]), k) for k in others]
    for _, k in sorted(left, reverse=True)[:losses]:
        open_ = np.flatnonzero(worst < limit)
        if not len(open_):
            break
        if len(open_) == count:
            worst = np.maximum(worst, _values(stock, _less(stock, base, k), every))
            continue
        some = open_ if which is None else which[open_]
        worst[open_] = np.maximum(worst[open_], _values(stock, _less(stock, base, k), some))
    return np.where(worst < limit, worst, math.inf)


def _values(stock: Stock, base: Base, added: np.ndarray | slice | None = None) -> FloatArray:
    """Return the value (J,) of information (..., L, T, 6, 6) plus each of the added candidates."""
    more = [None if added is None else part[added] for part in stock.parts]
    missing = np.atleast_1d(_missing(stock, base, more))
    met = np.flatnonzero(missing == 0)
    if len(met):
        missing[met] = np.log(_scores(stock, base, more, met)) - _MET
    return missing


def _missing(stock: Stock, base: Base, more: list[FloatArray | None]) -> FloatArray:
    """Return the weighted mean (J,) of the shortfalls of the zones."""
    weights = [zone.weight for zone in stock.zones if zone.limits.any()]
    found = [
        shortfall(_SPARE * relative_errors(asked_of(total, part), zone.limits), zone.share)
        for zone, total, part in zip(stock.zones, base, more, strict=True)
        if zone.limits.any()
    ]
    if found:
        return np.tensordot(np.array(weights) / sum(weights), found, axes=1)
    part, total = more[0], base[0]
    return np.zeros(len(part) if part is not None else total.shape[:-4])


def _scores(
    stock: Stock, base: Base, more: list[FloatArray | None], which: np.ndarray
) -> FloatArray:
    """Return b (K,) over all zones, for the layouts `which` (K) of `_values`."""
    weights = np.array([zone.weight for zone in stock.zones])
    squares = []
    for zone, total, part in zip(stock.zones, base, more, strict=True):
        some = None if part is None else part[which]
        total = total[which] if total.ndim == 5 else total
        squares.append(errors_of(total, zone.rotation, zone.tags, some).score ** 2)
    means = [np.atleast_1d(square.mean(axis=-1)) for square in squares]
    return np.sqrt(np.tensordot(weights / weights.sum(), means, axes=1))
