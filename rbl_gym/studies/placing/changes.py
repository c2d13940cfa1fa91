"""Figures of a layout after one change: with one more anchor, or one moved out of the plane."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.building import Problem
from rbl_gym.studies.placing.choosing import next_anchor
from rbl_gym.studies.placing.judging import Judged, judge_beside, short_row, verdict
from rbl_gym.studies.placing.out_of_plane import exchange_out_of_plane
from rbl_gym.studies.placing.ranking import overall_score


def with_next(
    problem: Problem, anchors: FloatArray, judged: list[Judged], seed: int, survive: int
) -> dict[str, Any] | None:
    """Return the best position of one more anchor, and the accuracy with it.

    With `survive` 1, any one of the anchors may be missing.
    """
    place = next_anchor(problem, anchors, seed, survive)
    if place is None:
        return None
    after = judge_beside(problem, np.vstack([anchors, place]), judged, survive)
    return _with_anchor(problem, place, after, judged)


def out_of_plane(
    problem: Problem,
    anchors: FloatArray,
    names: list[str],
    judged: list[Judged],
    seed: int,
    survive: int,
) -> dict[str, Any] | None:
    """Return the best exchange of one anchor after which the anchors are not coplanar."""
    found = exchange_out_of_plane(problem, anchors, seed, survive) if is_flat(anchors) else None
    if found is None:
        return None
    index, place = found
    moved = np.where(np.arange(len(anchors))[:, None] == index, place, anchors)
    after = judge_beside(problem, moved, judged, survive)
    return {"anchor": names[index], **_with_anchor(problem, place, after, judged)}


def _with_anchor(
    problem: Problem, place: FloatArray, after: list[Judged], judged: list[Judged]
) -> dict[str, Any]:
    """Return a new position of an anchor, and the accuracy with it and without it."""
    return {
        **dict(zip(("x_m", "y_m", "z_m"), place.tolist(), strict=True)),
        "mount": problem.mounts.names(place[None])[0],
        "cost": float(problem.mounts.cost(place[None])[0]),
        "verdict": verdict(after),
        "score_m": _overall(after),
        "ratio": _overall(after) / _overall(judged),
        "zones": [short_row(one) for one in after],
        "zones_now": [short_row(one) for one in judged],
    }


def _overall(zones: list[Judged]) -> float:
    return float(overall_score([one.zone for one in zones], [one.judged.score for one in zones]))


def is_flat(anchors: FloatArray) -> bool:
    """Return whether the anchors lie in one plane, as three always do."""
    spread = np.linalg.svd(anchors - anchors.mean(axis=0), compute_uv=False)
    return bool(len(anchors) < 4 or spread[2] < 1e-6 * spread[0])
