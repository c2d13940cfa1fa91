"""Choose layouts from a list of candidates, by their information at the poses of the zones.

Information is a sum over the anchors, so that of a candidate is computed once, and a layout is a
choice of candidates. The objective is the distance of the zones from their requirements, or b
without requirements. For layouts that must survive the loss of any one anchor, it is the worst
remaining case. The layouts are choices ``list[int]`` of candidates, those that stay come first.
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

# An exchange must better the value by this share, or it is not worth the time.
_GAIN = 1e-3
# Exchanges end after so many passes over all anchors.
_SWEEPS = 20
# Weight of the mean beside the place that fills the share: which of two layouts is better where
# that place does not tell, and a slope where no layout is near the requirement.
_OF_MEAN = 1e-2
# Of a long list of candidates, which are compared at every so many places, so many are tried at
# all; for the loss of one, by the so many that are worst.
_EVERY, _TRIED, _WORST_LOSSES = 4, 24, 3
# Layouts that are tried at a time.
_CHUNK = 64


class ZonePoses(NamedTuple):
    """Poses of a zone, and their requirements.

    Attributes
    ----------
    places, rotation
        (L, 3), and turns (T, 3, 3) at each of them.
    prior
        Information (6, 6) before any range.
    tags
        (N, 3) on the body.
    limits, share
        What a place may have, and in which share of the zone.
    weight
        Of the zone in the mean of b^2.
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
        Of each zone (K, L, T, 6, 6): information of every candidate at every pose.
    cost
        Of every candidate (K,).
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

    The relative error at the place that fills the share of its zone, of the zone where it is
    largest, with a hundredth of the mean relative error. Without requirements, b.

    Parameters
    ----------
    stock, chosen
        Candidates, and which of them.
    survive
        1: the worst over the loss of any one of the chosen.
    """
    total = _total(stock, chosen)
    if not survive:
        return float(_values(stock, total)[0])
    return max(float(_values(stock, _less(stock, total, k))[0]) for k in chosen)


def grown(
    stock: Stock, chosen: Sequence[int], count: int, survive: int = 0
) -> Iterator[tuple[list[int], float]]:
    """Return greedy layouts: each is the previous one plus the candidate that helps most.

    Ends with `count` anchors, or where no candidate is left.

    Parameters
    ----------
    stock, chosen
        Candidates, and with which of them to begin.
    count
        The largest number of anchors.
    survive
        As in `value`: of the values that are told, and of the choice where two anchors stand.
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
        Candidates, and with which of them to begin.
    keep
        So many of the first stay.
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

    Arguments as `swapped`.
    """
    tried = [[*chosen[:k], *chosen[k + 1 :]] for k in range(keep, len(chosen))]
    values = [value(stock, one, survive) for one in tried]
    best = int(np.argmin(values))
    return tried[best], values[best]


def cheaper(stock: Stock, chosen: Sequence[int], keep: int = 0, survive: int = 0) -> list[int]:
    """Return a layout that still meets the requirements, after exchanges that save most cost.

    Arguments as `swapped`.
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
            scores = _with_candidates(stock, others, which, survive, 1 + 1e-12)
            good = np.flatnonzero(scores <= 1)
            if len(good):
                order = np.lexsort((scores[good], stock.cost[which[good]]))
                found[k], saved = int(which[good[order[0]]]), True
    return found


def all_choices(
    stock: Stock, count: int, keep: int = 0, survive: int = 0
) -> tuple[list[int], float]:
    """Return the best of all layouts of `count` candidates; the first `keep` are kept.

    Arguments as `swapped`.
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
    """The stock at every fourth place, by which most candidates of a long list are left out."""
    zones = tuple(zone._replace(places=zone.places[::_EVERY]) for zone in stock.zones)
    parts = tuple(np.ascontiguousarray(part[:, ::_EVERY]) for part in stock.parts)
    return Stock(zones, parts, stock.cost)


def _best_added(
    stock: Stock, coarse: Stock, others: list[int], survive: int, limit: float
) -> tuple[int, float]:
    """Which candidate betters the layout `others` most, and the value with it."""
    which = np.setdiff1d(np.arange(len(stock.cost)), others)
    if len(which) > _TRIED:
        rough = _with_candidates(coarse, others, None, survive, math.inf, _WORST_LOSSES)
        rough[others] = math.inf
        which = np.argpartition(rough, _TRIED)[:_TRIED]
    scores = _with_candidates(stock, others, which, survive, limit)
    best = int(scores.argmin())
    return int(which[best]), float(scores[best])


def _with_candidates(
    stock: Stock,
    others: list[int],
    which: np.ndarray | None,
    survive: int,
    limit: float,
    losses: int | None = None,
) -> FloatArray:
    """Value (J,) of the layout `others` with each of the candidates `which`; None: of all.

    Where the loss of one matters, infinite for a candidate that is no better than `limit`; of so
    many `losses`, those that are worst without a candidate; None: of all.
    """
    base = _total(stock, others)
    # All of them without a copy.
    every = slice(None) if which is None else which
    if not survive:
        return _values(stock, base, every)
    # The candidate itself may fail; then each of the others, the worst first, so that most
    # candidates are left out early.
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
    """Value (J,) of information (..., L, T, 6, 6) with each of the added candidates, or none."""
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
    # On the side of 1 that the requirements say.
    met = (1 - _OF_MEAN) * q + np.minimum(slope, _OF_MEAN)
    return np.atleast_1d(np.where(q <= 1, met, q + slope))
