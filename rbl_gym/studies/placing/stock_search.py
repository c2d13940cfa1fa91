"""Choose layouts from a list of candidates, by their information at the poses of the zones.

Information is a sum over the anchors. The information of each candidate is therefore computed once,
and a layout is a choice of candidates, ``list[int]``; the fixed ones come first. The objective is
the distance of the zones from their requirements, or b without requirements. For layouts that must
survive the loss of any one anchor, it is the worst remaining case.
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
    value_at_share,
)

__all__ = ["Stock", "ZonePoses", "all_choices", "cheaper", "grown", "swapped", "value"]

# An exchange must reduce the value by at least this share.
_GAIN = 1e-3
# Maximum number of passes over all anchors.
_SWEEPS = 20
# Weight of the mean relative error beside the relative error at the required share. It decides
# between layouts that are equal at that share, and gives a slope far from the requirement.
_OF_MEAN = 1e-2
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
    """Return the objective of the search; requirements are met if it is at most 1.

    It is the relative error at the required share, of the zone where it is largest, plus a
    hundredth of the mean relative error. Without requirements, it is b.

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
            limit = best * (1 - _GAIN)
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
    if value(stock, found, survive) > 1:
        return found
    saved = True
    while saved:
        saved = False
        for k in sorted(range(keep, len(found)), key=lambda k: -stock.cost[found[k]]):
            others = found[:k] + found[k + 1 :]
            less = stock.cost < stock.cost[found[k]] - 1e-12
            which = np.setdiff1d(np.flatnonzero(less), found)
            scores = with_candidates(stock, others, which, survive, 1 + 1e-12)
            good = np.flatnonzero(scores <= 1)
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
    of_zones = list(zip(stock.zones, base, more, strict=True))
    if not stock.asks:
        weights = np.array([zone.weight for zone in stock.zones])
        scores = [
            errors_of(total, zone.rotation, zone.tags, part).score for zone, total, part in of_zones
        ]
        squares = [(score**2).mean(axis=-1) for score in scores]
        return np.atleast_1d(np.sqrt(np.tensordot(weights / weights.sum(), squares, axes=1)))
    worst, mean = [], []
    for zone, total, part in of_zones:
        if zone.limits.any():
            relative = relative_errors(asked_of(total, part), zone.limits)
            worst.append(value_at_share(relative, zone.share))
            mean.append(relative.mean(axis=-1))
    q, slope = np.max(worst, axis=0), _OF_MEAN * np.mean(mean, axis=0)
    # If the requirements are met, the value must not exceed 1.
    met = (1 - _OF_MEAN) * q + np.minimum(slope, _OF_MEAN)
    return np.atleast_1d(np.where(q <= 1, met, q + slope))
