"""Choose anchors for the requirements of zones: exchanges, and the smallest sufficient number."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.building import Problem
from rbl_gym.placement.sample import prior_of
from rbl_gym.studies.placing.accuracy import draw_places
from rbl_gym.studies.placing.judging import PLACES, Judged, judge, limits_of
from rbl_gym.studies.placing.links import anchor_information
from rbl_gym.studies.placing.requirements import Limits, turns
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

__all__ = ["Fewest", "fewest_anchors", "next_anchor"]

# Poses of a search: positions in all zones together, minimum in each zone, and rotations.
_PLACES, _LEAST_PLACES, _TURNS = 400, 128, 3
# Number of candidates to draw, and the share of them near the anchors in later rounds.
_CANDIDATES, _NEAR = 200, 0.6
# Distance of near candidates in the later rounds, as shares of the extent of the mounts.
_REACHES = (0.05, 0.015)
# A layout with a value above this is not refined in later rounds.
_NEAR_ENOUGH = 1.06
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
    """

    anchors: FloatArray
    judged: list[Judged]
    met: bool
    one_less: FloatArray | None
    judged_less: list[Judged]
    proved: bool


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
        places = draw_places(problem, zone, rng, max(_LEAST_PLACES, count))
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
    problem: Problem, anchors: FloatArray, seed: int, survive: int = 0
) -> tuple[FloatArray, float]:
    """Improve a layout (M, 3) by exchanges; return it and its value (`stock_search.value`).

    One anchor at a time is exchanged for candidates everywhere, then near and far. The fixed
    anchors of the problem, the first ones, are kept. With `survive` 1 the worst case over the loss
    of any one anchor counts.
    """
    rng = np.random.default_rng([seed, len(anchors), 5])
    reached = math.inf
    listed = problem.mounts.listed() is not None
    for reach in (None,) if listed else (None, *_REACHES):
        points = first_then_others(anchors, _around(problem, rng, anchors, reach))
        stock = stock_of(problem, points, seed)
        chosen, reached = swapped(stock, range(len(anchors)), len(problem.fixed), survive)
        anchors = points[chosen]
    return anchors, reached


def _around(
    problem: Problem, rng: np.random.Generator, anchors: FloatArray, reach: float | None
) -> FloatArray:
    """Return candidates everywhere, or mostly within a distance of the anchors."""
    if reach is None:
        return candidates(problem, rng)
    extent = float(np.ptp(problem.mounts.bounds(), axis=0).max())
    near = np.repeat(anchors, max(1, round(_NEAR * _CANDIDATES / len(anchors))), axis=0)
    near = near + reach * extent * rng.standard_normal(near.shape)
    far = candidates(problem, rng, round((1 - _NEAR) * _CANDIDATES))
    return np.concatenate([_legal(problem, near), far])


def first_then_others(anchors: FloatArray, points: FloatArray) -> FloatArray:
    """Return the anchors, then the points that are not among them."""
    known = (np.abs(points[:, None] - anchors).max(axis=-1) < 1e-9).any(axis=1)
    return np.concatenate([anchors, points[~known]])


# --- the smallest number -------------------------------------------------------------------------


def fewest_anchors(
    problem: Problem, numbers: range, seed: int, survive: int = 0, advance: Advance = silent
) -> Fewest:
    """Find the smallest number of anchors that meets the requirements of all zones.

    Anchors are added greedily up to a sufficient number. Then the number is reduced by one at a
    time, from several starts with exchanges, until it does not suffice. For a short list of mounts,
    all choices of one less are tried.

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
        Called after every tested number.

    Raises
    ------
    ValueError
        If no zone has a requirement.
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
    plain = stock._replace(zones=tuple(z._replace(limits=Limits()) for z in stock.zones))
    path = _growth(stock, keep, numbers[-1], survive)
    starts = path, _growth(plain, keep, max(path), survive)

    def attempt(count: int, more: list[FloatArray]) -> tuple[FloatArray, list[Judged], bool]:
        """Return the best layout of a number of anchors, from all starts, and its results."""
        some = rng.permutation(np.arange(keep, len(points)))[: count - keep].tolist()
        paths = [path[count] for path in starts if count in path]
        tried = [swapped(stock, path, keep, survive) for path in [*paths, [*range(keep), *some]]]
        if 0 < math.comb(len(points) - keep, count - keep) <= _MOST_CHOICES:
            tried.append(all_choices(stock, count, keep, survive))
        layouts = [(reached, points[chosen]) for chosen, reached in tried]
        layouts += [(_value(problem, one, seed, survive), one) for one in more]
        least, best = min(layouts, key=lambda pair: pair[0])
        judged = judge(problem, best, seed, survive)
        if not is_met(judged) and least < _NEAR_ENOUGH:
            other, reached = improved(problem, best, seed, survive)
            if reached < least:
                best, judged = other, judge(problem, other, seed, survive)
        advance()
        return best, judged, is_met(judged)

    count = _first_count(stock, starts, numbers, survive)
    advance(0, more=1)
    best, judged, met = attempt(count, [])
    while not met and count < min(numbers[-1], len(points)):
        count += 1
        advance(0, more=1)
        best, judged, met = attempt(count, [])
    less, judged_less = None, []
    while met and count > max(numbers[0], keep, 1):
        advance(0, more=1)
        less, judged_less, still = attempt(count - 1, _one_dropped(problem, best, seed, survive))
        if not still:
            break
        count, best, judged, less, judged_less = count - 1, less, judged_less, None, []
    choices = math.comb(len(points) - keep, count - 1 - keep) if count - 1 >= keep else 0
    proved = problem.mounts.listed() is not None and choices <= _MOST_CHOICES
    if met:
        best, judged = _cheapened(problem, best, judged, seed, survive)
    return Fewest(best, judged, met, less, judged_less, proved)


def _growth(stock: Stock, keep: int, most: int, survive: int) -> dict[int, list[int]]:
    """Return the greedy choice by number of anchors, with the first `keep` among them."""
    path = {keep: list(range(keep))}
    for chosen, reached in grown(stock, range(keep), most, survive):
        path[len(chosen)] = chosen
        # The greedy choice has passed the first number to try.
        if stock.asks and reached <= 0.8:
            break
    return path


def _first_count(
    stock: Stock, starts: tuple[dict[int, list[int]], ...], numbers: range, survive: int
) -> int:
    """Return the number at which the greedy choice meets the requirements, or the largest one."""
    path = starts[0]
    for count in sorted(path):
        if count >= max(numbers[0], 1) and value(stock, path[count], survive) <= 1:
            return count
    return max(min(numbers[-1], max(path)), numbers[0])


def _value(problem: Problem, anchors: FloatArray, seed: int, survive: int) -> float:
    return value(stock_of(problem, anchors, seed), range(len(anchors)), survive)


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
) -> tuple[FloatArray, list[Judged]] | None:
    """Return the best position (3,) of one more anchor, and the zones with it.

    The result is None if no mount is left.

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
    added = points[chosen]
    return added[-1], judge(problem, added, seed, survive, PLACES)
