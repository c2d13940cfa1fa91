"""Compare layouts: by what they lack of the requirements, then by b."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.building import Problem, Zone
from rbl_gym.studies.placing.judging import PLACES, Judged, judge, verdict
from rbl_gym.studies.placing.requirements import shortfall

__all__ = ["rank"]


def rank(judged: list[Judged]) -> tuple[bool, float, float]:
    """Return what layouts are compared by, the smaller the better.

    First whether any zone does not pass, then the weighted mean of the `shortfall` of the zones,
    then b. The last two are over equally many positions of each zone.
    """
    asked = [one for one in judged if one.asks]
    weights = [one.zone.weight for one in asked]
    lacks = [float(shortfall(one.relative[:PLACES], one.zone.share)) for one in asked]
    scores = [one.judged.score[:PLACES] for one in judged]
    return (
        verdict(judged) in ("fail", "undecided"),
        float(np.average(lacks, weights=weights)) if asked else 0.0,
        float(overall_score([one.zone for one in judged], scores)),
    )


def score_of(problem: Problem, anchors: FloatArray, seed: int) -> float:
    """Return b of a layout over all zones, at positions that no search has used."""
    judged = judge(problem, anchors, seed, most=PLACES)
    return float(overall_score(list(problem.zones), [one.errors.score for one in judged]))


def overall_score(zones: list[Zone], scores: list[FloatArray]) -> FloatArray:
    """Return b (...) over all zones: the root of the mean of b^2 (..., L), weighted by zone."""
    weights = np.array([zone.weight for zone in zones])
    squares = [(score**2).mean(axis=-1) for score in scores]
    return np.sqrt(np.tensordot(weights / weights.sum(), squares, axes=1))
