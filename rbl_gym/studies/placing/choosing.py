"""Choose anchors for the requirements of zones: exchanges, and the smallest sufficient number."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.building import Problem
from rbl_gym.placement.sample import prior_of
from rbl_gym.studies.placing.accuracy import spread_places
from rbl_gym.studies.placing.judging import PLACES, Judged, judge, limits_of, short_row
from rbl_gym.studies.placing.links import anchor_information
from rbl_gym.studies.placing.ranking import rank
from rbl_gym.studies.placing.requirements import Limits, turns, value_at_share
from rbl_gym.studies.placing.stock_search import (
    Stock,
    ZonePoses,
    all_choices,
    cheaper,
    dropped,
    grown,
    swapped,
    value,
)
from rbl_gym.studies.progress import Advance, silent

__all__ = ["Fewest", "fewest_anchors", "meeting", "next_anchor"]

# Poses of a search: positions in all zones together, minimum in each zone, and rotations.
_PLACES, _LEAST_PLACES, _TURNS = 400, 128, 3
# Number of candidates to draw, and the share of them near the anchors in later rounds.
_CANDIDATES, _NEAR = 200, 0.6
# Distance of near candidates in the later rounds, as shares of the extent of the mounts.
_REACHES = (0.05, 0.015)
# Searches for a layout of one number of anchors: from different starts, then finer ones from the
# best layouts. A finer search has this many positions and candidates.
_COARSE, _FINE = 6, 4
_FINE_PLACES, _FINE_CANDIDATES = 1600, 100
# The finer searches end if the error at the required share is this many times the limit: at the
# first two, and at the others.
_HOPELESS = 1.15, 1.06
# All choices are tried if there are at most this many.
_MOST_CHOICES = 3000


class Fewest(NamedTuple):
    """The smallest number of anchors that meets the requirements of all zones.

    Attributes
    ----------
    anchors
        Positions (M, 3). If no allowed number suffices, those of the largest number.
    judged
        Results of every zone; all pass if `met`.
    met
        Whether the requirements are met.
    one_less, judged_less
        The best layout found with one anchor less, which does not suffice; None if not allowed.
    proved
        Whether all choices with one anchor less were tried, which is done for a short list of
        mounts.
    searches
        Number of searches for a layout with one anchor less.
    """

    anchors: FloatArray
    judged: list[Judged]
    met: bool
    one_less: FloatArray | None
    judged_less: list[Judged]
    proved: bool
    searches: int


# --- candidates ----------------------------------------------------------------------------------


def candidates(problem: Problem, rng: np.random.Generator, count: int = _CANDIDATES) -> FloatArray:
    """Return up to `count` distinct legal mounts (K, 3); all of them if the mounts are a list."""
    listed = problem.mounts.listed()
    if listed is not None:
        return listed
    return _legal(problem, problem.mounts.draw(rng.random((4 * count, 3))))[:count]


def _legal(problem: Problem, points: FloatArray) -> FloatArray:
    """Return the distinct legal mounts among the points (K, 3), rounded to the millimetre."""
    points = problem.mounts.project(np.round(points, 3))
    off = np.abs(problem.mounts.project(points) - points).max(axis=-1)
    points = points[(off <= 1e-6) & ~problem.obstacles.contain(points)]
    _, first = np.unique(points, axis=0, return_index=True)
    return points[np.sort(first)]


def stock_of(problem: Problem, points: FloatArray, seed: int, n_places: int | None = None) -> Stock:
    """Return candidates (K, 3) with the information of each at random poses of the zones.

    The poses of `seed` differ from those of `judge_zone`. `n_places` is the number of positions in
    all zones, with a minimum in each; None: the default.
    """
    rng = np.random.default_rng([seed, 4])
    zones, parts = [], []
    for zone in problem.zones:
        count = (n_places or _PLACES) // len(problem.zones)
        places = spread_places(problem, zone, rng, max(_LEAST_PLACES, count))
        rotation = turns(zone.attitude, _TURNS)
        zones.append(
            ZonePoses(
                places, rotation, prior_of(problem, zone), problem.tags, limits_of(zone),
                zone.share, zone.weight,
            )
        )  # fmt: skip
        parts.append(anchor_information(problem, points, places, rotation))
    return Stock(tuple(zones), tuple(parts), problem.mounts.cost(points))


def is_met(judged: list[Judged]) -> bool:
    """Return whether every zone with a requirement passes."""
    return all(zone.verdict in ("pass", "no requirement") for zone in judged)


# --- exchanges -----------------------------------------------------------------------------------


def improved(
    problem: Problem, anchors: FloatArray, seed: int, survive: int = 0, fine: bool = False
) -> tuple[FloatArray, float]:
    """Improve a layout (M, 3) by exchanges; return it and its value (`stock_search.value`).

    One anchor at a time is exchanged for candidates everywhere, then near and far. The fixed
    anchors of the problem, the first ones, are kept. With `survive` 1 the worst case over the loss
    of any one anchor counts. A `fine` search uses more positions, on which its value depends less,
    and fewer candidates.
    """
    rng = np.random.default_rng([seed, len(anchors), 5])
    reached = math.inf
    listed = problem.mounts.listed() is not None
    count, n_places = (_FINE_CANDIDATES, _FINE_PLACES) if fine else (_CANDIDATES, None)
    for reach in (None,) if listed else (None, *_REACHES):
        points = first_then_others(anchors, _around(problem, rng, anchors, reach, count))
        stock = stock_of(problem, points, seed, n_places)
        chosen, reached = swapped(stock, range(len(anchors)), len(problem.fixed), survive)
        anchors = points[chosen]
    return anchors, reached


def _around(
    problem: Problem, rng: np.random.Generator, anchors: FloatArray, reach: float | None, count: int
) -> FloatArray:
    """Return candidates everywhere, or mostly within a distance of the anchors."""
    if reach is None:
        return candidates(problem, rng, count)
    extent = float(np.ptp(problem.mounts.bounds(), axis=0).max())
    near = np.repeat(anchors, max(1, round(_NEAR * count / len(anchors))), axis=0)
    near = near + reach * extent * rng.standard_normal(near.shape)
    far = candidates(problem, rng, round((1 - _NEAR) * count))
    return np.concatenate([_legal(problem, near), far])


def first_then_others(anchors: FloatArray, points: FloatArray) -> FloatArray:
    """Return the anchors, then the points that are not among them."""
    known = (np.abs(points[:, None] - anchors).max(axis=-1) < 1e-9).any(axis=1)
    return np.concatenate([anchors, points[~known]])


def meeting(problem: Problem, starts: list[FloatArray], seed: int, survive: int = 0) -> FloatArray:
    """Return a layout (M, 3) by exchanges from the best of the starts, by its `rank`.

    If it does not pass, it is improved once more over more positions. It is never worse than the
    starts. Arguments as in `improved`.
    """

    def ranked(anchors: FloatArray, most: int | None = None) -> tuple[bool, float, float]:
        return rank(judge(problem, anchors, seed, survive, most))

    best = min(starts, key=lambda one: ranked(one, PLACES))
    least = ranked(best)
    for fine in (False, True):
        if fine and not least[0]:
            break
        found, _ = improved(problem, best, seed + 1000 * fine, survive, fine)
        if (reached := ranked(found)) < least:
            best, least = found, reached
    return best


# --- the smallest number -------------------------------------------------------------------------


def fewest_anchors(
    problem: Problem, numbers: range, seed: int, survive: int = 0, advance: Advance = silent
) -> Fewest:
    """Find the smallest number of anchors that meets the requirements of all zones.

    Anchors are added greedily up to a sufficient number. Then the number is reduced by one at a
    time until no search finds a sufficient layout. The searches for a number have different starts,
    one of them the layout with one anchor more, without its least important anchor. The last
    searches refine the best layout found, over more positions. For a short list of mounts, all
    choices are tried.

    Parameters
    ----------
    problem
        The problem; its fixed anchors are included in the number.
    numbers
        Allowed numbers.
    seed
        Seed of candidates, poses and evaluated positions.
    survive
        1: the requirements must be met without any one of the anchors.
    advance
        Called after every search.

    Raises
    ------
    ValueError
        If no zone has a requirement, or a zone fails even with an anchor at every candidate.
    """
    if not any(limits_of(zone).any() for zone in problem.zones):
        raise ValueError(
            "fewest needs a requirement: a building file with [[zones]] that have position_m, "
            "height_m or heading_deg"
        )
    keep = len(problem.fixed)
    rng = np.random.default_rng([seed, 6])
    points = first_then_others(problem.fixed, candidates(problem, rng))
    stock = stock_of(problem, points, seed)
    if value(stock, range(len(points))) >= 0:
        _check_reachable(problem, points, seed)
    plain = stock._replace(zones=tuple(z._replace(limits=Limits()) for z in stock.zones))
    path = _growth(stock, keep, numbers[-1], survive)
    paths = path, _growth(plain, keep, max(path), survive)

    def starts_of(count: int) -> list[FloatArray]:
        """Return layouts of a number of anchors, the best first."""
        chosen = [path[count] for path in paths if count in path]
        for _ in range(_COARSE - len(chosen)):
            some = rng.permutation(np.arange(keep, len(points)))[: count - keep]
            chosen.append([*range(keep), *some.tolist()])
        found = [swapped(stock, one, keep, survive) for one in chosen]
        if 0 < math.comb(len(points) - keep, count - keep) <= _MOST_CHOICES:
            found.append(all_choices(stock, count, keep, survive))
        return [points[one] for one, _ in sorted(found, key=lambda pair: pair[1])]

    def attempt(count: int, more: list[FloatArray]) -> _Found:
        return _searched(problem, [*more, *starts_of(count)], seed, survive, advance)

    count = _first_count(stock, paths, numbers, survive)
    best = attempt(count, [])
    while not best.met and count < min(numbers[-1], len(points)):
        count += 1
        best = attempt(count, [])
    less = None
    while best.met and count > max(numbers[0], keep, 1):
        less = attempt(count - 1, _one_dropped(problem, best.anchors, seed, survive))
        if not less.met:
            break
        count, best, less = count - 1, less, None
    choices = math.comb(len(points) - keep, count - 1 - keep) if count - 1 >= keep else 0
    proved = problem.mounts.listed() is not None and choices <= _MOST_CHOICES
    anchors, judged = best.anchors, best.judged
    if best.met:
        anchors, judged = _cheapened(problem, anchors, judged, seed, survive)
    if less is None:
        return Fewest(anchors, judged, best.met, None, [], proved, 0)
    return Fewest(anchors, judged, best.met, less.anchors, less.judged, proved, less.searches)


def _check_reachable(problem: Problem, points: FloatArray, seed: int) -> None:
    """Raise ValueError if a zone fails even with an anchor at every candidate (K, 3)."""
    found = [
        f"zone {row['name']!r} would pass only with limits {row['would_pass']['factor']:.3g} times "
        f"as large (hardest to meet: {row['decides']['requirement']} = "
        f"{row['decides']['limit']:g})"
        for row in map(short_row, judge(problem, points, seed, most=PLACES))
        if row["verdict"] == "fail"
    ]
    if found:
        raise ValueError(
            "fewest: no number of anchors meets the requirements. With an anchor at each of "
            f"{len(points)} positions on the mounts, {'; '.join(found)}"
        )


class _Found(NamedTuple):
    """Best layout of some searches, its results, and the number of searches."""

    anchors: FloatArray
    judged: list[Judged]
    met: bool
    searches: int


def _searched(
    problem: Problem, starts: list[FloatArray], seed: int, survive: int, advance: Advance
) -> _Found:
    """Search from the first starts, then refine the best layout, until the requirements are met.

    Layouts are compared by their `rank`.
    """
    found: list[tuple[FloatArray, list[Judged]]] = []

    def search(start: FloatArray, fine: bool) -> bool:
        advance(0, more=1)
        # Other seeds than those near that of the user.
        anchors, _ = improved(problem, start, seed + 1000 * len(found), survive, fine)
        judged = judge(problem, anchors, seed, survive)
        found.append((anchors, judged))
        advance()
        return is_met(judged)

    met = any(search(start, False) for start in starts[:_COARSE])
    for k in range(_FINE):
        if met:
            break
        found.sort(key=lambda row: rank(row[1]))
        if min(_reached(judged) for _, judged in found) > _HOPELESS[k > 1]:
            break
        # First the two best layouts, then the best one.
        met = search(found[min(k, len(found) - 1) if k < 2 else 0][0], True)
    anchors, judged = found[-1] if met else min(found, key=lambda row: rank(row[1]))
    return _Found(anchors, judged, met, len(found))


def _reached(judged: list[Judged]) -> float:
    """Return the relative error at the required share, of the zone where it is largest."""
    asked = [one for one in judged if one.asks]
    return max(float(value_at_share(one.relative[:PLACES], one.zone.share)) for one in asked)


def _growth(stock: Stock, keep: int, most: int, survive: int) -> dict[int, list[int]]:
    """Return the greedy choice by number of anchors, with the first `keep` among them."""
    path = {keep: list(range(keep))}
    for chosen, reached in grown(stock, range(keep), most, survive):
        path[len(chosen)] = chosen
        # The greedy choice has passed the first number to try.
        if stock.asks and reached < 0:
            break
    return path


def _first_count(
    stock: Stock, starts: tuple[dict[int, list[int]], ...], numbers: range, survive: int
) -> int:
    """Return the number at which the greedy choice meets the requirements, or the largest one."""
    path = starts[0]
    for count in sorted(path):
        if count >= max(numbers[0], 1) and value(stock, path[count], survive) < 0:
            return count
    return max(min(numbers[-1], max(path)), numbers[0])


def _one_dropped(
    problem: Problem, anchors: FloatArray, seed: int, survive: int
) -> list[FloatArray]:
    keep = len(problem.fixed)
    chosen, _ = dropped(stock_of(problem, anchors, seed), range(len(anchors)), keep, survive)
    return [anchors[chosen]]


def _cheapened(
    problem: Problem, anchors: FloatArray, judged: list[Judged], seed: int, survive: int
) -> tuple[FloatArray, list[Judged]]:
    """Return the layout after exchanges that save cost and still meet the requirements."""
    rng = np.random.default_rng([seed, 7])
    points = first_then_others(anchors, candidates(problem, rng))
    stock = stock_of(problem, points, seed)
    if np.ptp(stock.cost) == 0:
        return anchors, judged
    saved = points[cheaper(stock, range(len(anchors)), len(problem.fixed), survive)]
    told = judge(problem, saved, seed, survive)
    return (saved, told) if is_met(told) else (anchors, judged)


# --- one more ------------------------------------------------------------------------------------


def next_anchor(
    problem: Problem, anchors: FloatArray, seed: int, survive: int = 0
) -> FloatArray | None:
    """Return the best position (3,) of one more anchor; None if no mount is left.

    Parameters
    ----------
    problem, anchors
        The problem, and the layout (M, 3).
    seed, survive
        As in `improved`.
    """
    rng = np.random.default_rng([seed, 8])
    points = first_then_others(anchors, candidates(problem, rng))
    if len(points) == len(anchors):
        return None
    stock = stock_of(problem, points, seed, _LEAST_PLACES)
    chosen, _ = next(grown(stock, range(len(anchors)), len(anchors) + 1, survive))
    return points[chosen[-1]]
