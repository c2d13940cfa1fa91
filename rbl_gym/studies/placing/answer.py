"""Design or evaluate a layout of anchors: verdicts, comparison, and check by filters."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, check_one_of
from rbl_gym.geometry.obstacles import box_bounds
from rbl_gym.placement import criteria, layouts, scene_files
from rbl_gym.placement.building import Problem
from rbl_gym.studies.placing import check, choosing, design
from rbl_gym.studies.placing.accuracy import accuracy_without_each
from rbl_gym.studies.placing.changes import is_flat, out_of_plane, with_next
from rbl_gym.studies.placing.choosing import Fewest
from rbl_gym.studies.placing.contributions import without_each
from rbl_gym.studies.placing.design import Design
from rbl_gym.studies.placing.given import given_notes, mount_names
from rbl_gym.studies.placing.judging import (
    PLACES,
    Judged,
    at_edges,
    judge,
    judge_beside,
    limits_of,
    overview,
    short_row,
    verdict,
    zone_row,
)
from rbl_gym.studies.placing.lever import lever_row
from rbl_gym.studies.placing.surveys import survey_rows
from rbl_gym.studies.placing.undetermined import has_heading, without_heading
from rbl_gym.studies.progress import Advance, silent

__all__ = ["Placed", "Question", "place_anchors"]

# Number of poses over which the criteria of the result are averaged.
_MANY_POSES = 1000
# A link counts as seen if it keeps at least this share of its information.
_SEEN = 0.5


@dataclass(frozen=True)
class Question:
    """Options for designing or evaluating a layout.

    Parameters
    ----------
    numbers
        Numbers of anchors. The result is for the last one; the others are only rows of the table
        by number. With `fewest`: the numbers to try.
    fewest
        Find the smallest number that meets the requirements of all zones.
    layout, names
        Anchor positions (M, 3) to evaluate, and their names; None: the anchors are designed.
    optimise
        Use the layout as the start of a design, instead of evaluating it.
    keep
        Indices of the anchors of the layout that are fixed.
    survive
        1: any one anchor may fail, in the evaluation and in the search.
    seed, trials
        Seed of all randomness, and number of bodies of the Monte-Carlo check.
    start
        One of `design.STARTS`: ``"search"``, or ``"amortised"``: the layout of the network and a
        few gradient steps instead of the search.
    """

    numbers: range
    fewest: bool = False
    layout: FloatArray | None = None
    names: tuple[str, ...] = ()
    optimise: bool = False
    keep: tuple[int, ...] = ()
    survive: int = 0
    seed: int = 0
    trials: int = 500
    start: str = "search"


class Placed(NamedTuple):
    """Result of a run: the problem with its last number of anchors, the design, the figures."""

    problem: Problem
    design: Design
    result: dict[str, Any]


def place_anchors(problem: Problem, question: Question, advance: Advance = silent) -> Placed:
    """Design or read a layout, then evaluate, compare and check it; figures are plain numbers.

    Parameters
    ----------
    problem
        The placement problem.
    question
        The options.
    advance
        Called after every step of the work.

    Raises
    ------
    ValueError
        If the layout does not match the problem or the numbers, `fewest` is set without
        requirements, or `start` is unknown or has no effect.
    """
    check_one_of("start", question.start, design.STARTS)
    if question.start != "search" and (question.fewest or question.layout is not None):
        raise ValueError(
            f"start must be 'search' if layout or fewest is given, got {question.start!r}"
        )
    problem, start = _with_kept(problem, question)
    seed, survive = question.seed, question.survive
    advance(0, more=2)
    rows: list[dict[str, Any]] = []
    least: Fewest | None = None
    if question.fewest:
        least = choosing.fewest_anchors(problem, question.numbers, seed, survive, advance)
        found = Design(least.anchors, "least number", {})
        problem = scene_files.with_anchors(problem, len(least.anchors))
    elif question.layout is not None and not question.optimise:
        found = Design(question.layout, "given", {})
        problem = scene_files.with_anchors(problem, len(question.layout))
    else:
        found = None
        for number in question.numbers:
            problem = scene_files.with_anchors(problem, number)
            found = _designed(problem, question, start, advance)
            start = found.anchors
            judged = judge(problem, start, seed, survive)
            row = {"n_anchors": number, **_summary(problem, start, judged)}
            rows.append(row if has_heading(problem) else without_heading(row))
        assert found is not None
    judged = judge(problem, found.anchors, seed, survive)
    advance()
    result = _result(problem, question, found, judged)
    if least is not None:
        result["fewest"] = _fewest_row(least)
    if len(rows) > 1:
        result["against_number"] = rows
    advance()
    return Placed(problem, found, result)


def _with_kept(problem: Problem, question: Question) -> tuple[Problem, FloatArray | None]:
    """Return the problem with the kept anchors as fixed ones, and the start layout."""
    layout = question.layout
    if layout is None:
        if question.keep or question.optimise:
            raise ValueError("keep and optimise need a layout, got None")
        return problem, None
    if not question.optimise:
        if question.keep:
            raise ValueError("keep needs optimise: without it no anchor of the layout moves")
        return problem, layout
    kept = [k for k in range(len(layout)) if k in question.keep or _is_in(layout[k], problem.fixed)]
    apart = [place for place in problem.fixed if not _is_in(place, layout)]
    fixed = np.array([*apart, *layout[kept]]).reshape(-1, 3)
    others = np.delete(layout, kept, axis=0)
    if len(fixed) + len(others) > question.numbers[0]:
        raise ValueError(
            f"the number of anchors must be at least {len(fixed) + len(others)}, as it includes "
            f"those of the layout and the fixed ones; got {question.numbers[0]}"
        )
    return dataclasses.replace(problem, fixed=fixed), np.concatenate([fixed, others])


def _is_in(place: FloatArray, places: FloatArray) -> bool:
    return bool(len(places) and np.abs(places - place).max(axis=-1).min() < 1e-9)


def _designed(
    problem: Problem, question: Question, start: FloatArray | None, advance: Advance
) -> Design:
    """Return the design with the smallest b.

    If it misses a requirement, or any one anchor may fail, it is improved by exchanges.
    """
    seed, survive = question.seed, question.survive
    advance(0, more=design.SEARCH_STEPS)
    found = design.design_layout(problem, seed, advance, start, question.start)
    asks = any(limits_of(zone).any() for zone in problem.zones)
    if not survive and (not asks or choosing.is_met(judge(problem, found.anchors, seed))):
        return found
    starts = [found.anchors]
    if question.optimise and start is not None and len(start) == problem.n_anchors:
        starts.append(start)
    starts += [
        anchors
        for name, anchors in found.searched.items()
        if name in layouts.LAYOUTS and not problem.obstacles.contain(anchors).any()
    ]
    better = choosing.meeting(problem, starts, seed, survive)
    why = "loss of one" if survive else "requirements"
    return found._replace(anchors=better, method=f"{found.method}, exchanges for {why}")


# --- results ---------------------------------------------------------------------------------


def _result(
    problem: Problem, question: Question, found: Design, judged: list[Judged]
) -> dict[str, Any]:
    """Return all figures of a layout."""
    seed, survive, anchors = question.seed, question.survive, found.anchors
    low, high = problem.corners()
    edges = [at_edges(problem, anchors, one) for one in judged]
    rows = _anchors(problem, question, anchors, judged)
    names = [row["name"] for row in rows]
    given = found.method == "given"
    result: dict[str, Any] = {
        "scene": problem.name,
        "seed": seed,
        "n_anchors": len(anchors),
        "verdict": verdict(judged),
        "survive": survive,
        "notes": [*problem.notes, *(given_notes(problem, anchors, names) if given else [])],
        "zones": [
            zone_row(*pair) | {"lever": lever_row(problem, anchors, pair[0])}
            for pair in zip(judged, edges, strict=True)
        ],
        "region": {"low_m": low.tolist(), "high_m": high.tolist()},
        "obstacles": _obstacles(problem),
        "tags_m": problem.tags.tolist(),
        "method": found.method,
        "anchors": rows,
        "cost": float(problem.mounts.cost(anchors).sum()),
        "coplanar": is_flat(anchors),
        "out_of_plane": out_of_plane(problem, anchors, names, judged, seed, survive),
        "next_anchor": with_next(problem, anchors, judged, seed, survive),
        "predicted": overview(judged, edges),
        "survey": survey_rows(problem, anchors, judged),
        "criteria": _criteria(problem, anchors),
        "layouts": _comparison(problem, found, judged, seed, survive),
        "check": check.check_layout(problem, anchors, question.trials, seed),
    }
    return result if has_heading(problem) else without_heading(result)


def _obstacles(problem: Problem) -> list[dict[str, Any]]:
    boxes, prisms = problem.obstacles.boxes, problem.obstacles.prisms
    rows: list[dict[str, Any]] = [
        {"low_m": low.tolist(), "high_m": high.tolist()}
        for low, high in zip(*box_bounds(boxes), strict=True)
    ]
    for corners, low, high, share in zip(
        prisms.corners, prisms.low_m, prisms.high_m, prisms.share, strict=True
    ):
        row = {"polygon_m": corners.tolist(), "low_m": float(low), "high_m": float(high)}
        rows.append(row | {"information": None if math.isnan(share) else float(share)})
    return rows


def _anchors(
    problem: Problem, question: Question, anchors: FloatArray, judged: list[Judged]
) -> list[dict[str, Any]]:
    """Return a row for each anchor: its position, the share it sees, the accuracy without it."""
    lost = [
        one.without or accuracy_without_each(problem, anchors, one.places, one.zone)
        for one in judged
    ]
    # Equally many positions of each zone.
    seen = np.concatenate([problem.share(anchors, one.places[:PLACES]) >= _SEEN for one in judged])
    known = {
        tuple(place): name
        for place, name in zip(
            [] if question.layout is None else question.layout.tolist(),
            question.names,
            strict=False,
        )
    }
    fixed = {tuple(place) for place in problem.fixed.tolist()}
    rows = []
    for k, (place, mount, cost, without) in enumerate(
        zip(
            anchors.tolist(),
            mount_names(problem, anchors),
            problem.mounts.cost(anchors).tolist(),
            without_each([one._replace(without=None) for one in judged], lost),
            strict=True,
        )
    ):
        rows.append(
            {
                "name": known.get(tuple(place), str(k + 1)),
                **dict(zip(("x_m", "y_m", "z_m"), place, strict=True)),
                "mount": mount,
                "cost": cost,
                "fixed": tuple(place) in fixed,
                "sees": float(seen[:, k].mean()),
                "without": without,
            }
        )
    return rows


def _fewest_row(least: Fewest) -> dict[str, Any]:
    """Return the row of the smallest number: met or not, the margin, the result with one less."""
    row: dict[str, Any] = {
        "met": least.met,
        "n_anchors": len(least.anchors),
        "margin": min(short_row(one)["margin"] for one in least.judged if one.asks),
        "proved": least.proved and least.met,
        "searches": least.searches,
        "one_less": None,
    }
    if least.one_less is not None:
        row["one_less"] = {
            "n_anchors": len(least.one_less),
            "anchors_m": least.one_less.tolist(),
            "zones": [short_row(one) for one in least.judged_less],
        }
    return row


def _summary(problem: Problem, anchors: FloatArray, judged: list[Judged]) -> dict[str, Any]:
    """Return the row of a layout in a table of layouts."""
    found = overview(judged, [at_edges(problem, anchors, one) for one in judged])
    row: dict[str, Any] = {"score_m": found["score_m"]["rms"]}
    for name in ("position_m", "rotation_deg"):
        row |= {
            f"{name.replace('_', f'_{what}_')}": found[name][what]
            for what in ("median", "p95", "worst")
        }
    return row | {"verdict": verdict(judged), "zones": [short_row(one) for one in judged]}


def _comparison(
    problem: Problem, found: Design, judged: list[Judged], seed: int, survive: int
) -> dict[str, dict[str, Any]]:
    """Return the figures of the design and of the usual layouts, one row each."""
    own = "given" if found.method == "given" else "designed"
    table = {own: _summary(problem, found.anchors, judged)} | {
        name: _summary(problem, anchors, judge_beside(problem, anchors, judged, survive))
        | {"anchors_m": anchors.tolist()}
        for name, anchors in design.usual_layouts(problem, seed).items()
    }
    least = next(iter(table.values()))["score_m"]
    return {
        name: {**row, "ratio": row["score_m"] / least}
        for name, row in sorted(table.items(), key=lambda item: item[1]["score_m"])
    }


def _criteria(problem: Problem, anchors: FloatArray) -> dict[str, Any]:
    """Return the criteria as numbers; None if undefined (conditioning of coplanar anchors)."""
    many = dataclasses.replace(problem, n_anchors=len(anchors), n_poses=_MANY_POSES)
    values = criteria.criteria(many, problem.context, anchors)._asdict()
    numbers = {name: float(value) for name, value in values.items()}
    if is_flat(anchors):
        numbers["conditioning"] = math.inf
    return {name: value if math.isfinite(value) else None for name, value in numbers.items()}
