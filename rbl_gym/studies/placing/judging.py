"""Evaluate a layout against the requirements: shares, intervals, verdicts, worst positions."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.placement.building import Problem, Zone
from rbl_gym.studies.monte_carlo import rms
from rbl_gym.studies.placing.accuracy import (
    accuracy,
    accuracy_without_each,
    free_grid,
    spread_places,
)
from rbl_gym.studies.placing.requirements import (
    Errors,
    Limits,
    relative_errors,
    set_interval,
    share_within,
    value_at_share,
    wilson_interval,
)

__all__ = [
    "Judged",
    "at_edges",
    "judge",
    "judge_beside",
    "judge_zone",
    "limits_of",
    "overview",
    "short_row",
    "verdict",
    "zone_row",
]

# Number of positions drawn in a zone at first, and the maximum if the verdict is undecided. They
# are drawn in sets of the first number. The interval is from the sets if there are at least 8.
PLACES, MOST_PLACES = 600, 9600
_SETS = 8
# Limits by the names of a zone's requirement.
_KEYS = {"horizontal": "position_m", "height": "height_m", "heading": "heading_deg"}
# Number of worst positions to report, and their minimum distance as a share of the zone's extent.
_WORST, _APART = 3, 0.1


class Judged(NamedTuple):
    """The predicted accuracy of a layout in a zone.

    Attributes
    ----------
    zone
        The evaluated zone.
    places
        Positions (L, 3), uniform over the free part of the zone.
    errors
        Errors (L) at the positions.
    without
        Errors (M, L) without each of the anchors; None if no anchor may fail.
    """

    zone: Zone
    places: FloatArray
    errors: Errors
    without: Errors | None = None

    @property
    def asks(self) -> bool:
        """Return whether the zone has a requirement."""
        return limits_of(self.zone).any()

    @property
    def failing(self) -> int | None:
        """Return the critical anchor: without it the fewest positions are within the limits."""
        if self.without is None:
            return None
        if not self.asks:
            return int(self.without.score.max(axis=-1).argmax())
        relative = relative_errors(self.without, limits_of(self.zone))
        reached = value_at_share(relative, self.zone.share)
        return int(np.lexsort((-reached, share_within(relative)))[0])

    @property
    def judged(self) -> Errors:
        """Return the errors (L) of the verdict: with all anchors, or without the critical one."""
        if self.without is None:
            return self.errors
        return Errors(*(values[self.failing] for values in self.without))

    @property
    def relative(self) -> FloatArray:
        """Return the errors (L) over their limits, the largest at each position."""
        return relative_errors(self.judged, limits_of(self.zone))

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the share within.

        It is `wilson_interval`, or from many sets of positions `set_interval`, which is narrower.
        """
        within = self.relative <= 1
        count = len(within) // PLACES
        if count >= _SETS and len(within) == count * PLACES:
            shares = within.reshape(count, PLACES).mean(axis=-1)
            if np.ptp(shares) > 0:
                return set_interval(shares)
        return wilson_interval(int(within.sum()), len(within))

    @property
    def verdict(self) -> str:
        """``"pass"``, ``"fail"`` or ``"undecided"`` by the interval; or ``"no requirement"``."""
        if not self.asks:
            return "no requirement"
        low, high = self.interval
        if low >= self.zone.share:
            return "pass"
        return "fail" if high < self.zone.share else "undecided"


def limits_of(zone: Zone) -> Limits:
    """Return the limits of a position of the zone."""
    given = (zone.position_m, zone.height_m, zone.heading_deg)
    horizontal, height, heading = (math.inf if limit is None else limit for limit in given)
    return Limits(horizontal, height, math.radians(heading))


def judge_zone(
    problem: Problem,
    zone: Zone,
    anchors: FloatArray,
    seed: int,
    survive: int = 0,
    most: int | None = None,
) -> Judged:
    """Evaluate a layout (M, 3) in a zone, with more positions until the verdict is decided.

    Parameters
    ----------
    problem, zone, anchors
        The problem, the zone, and the anchors.
    seed
        Seed of the positions. The same seed draws the same ones for any layout.
    survive
        1: any one of the anchors may be missing.
    most
        Maximum number of positions; None: `MOST_PLACES`.
    """
    rng = np.random.default_rng([seed, 3])
    judged = None
    while True:
        sets = 1 if judged is None else len(judged.places) // PLACES
        drawn = [spread_places(problem, zone, rng, PLACES) for _ in range(sets)]
        places = np.concatenate(drawn)
        fresh = _judged(problem, zone, anchors, places, survive)
        judged = fresh if judged is None else _joined(judged, fresh)
        if judged.verdict != "undecided" or len(judged.places) >= (most or MOST_PLACES):
            return judged


def _judged(
    problem: Problem, zone: Zone, anchors: FloatArray, places: FloatArray, survive: int
) -> Judged:
    errors = accuracy(problem, anchors, places, zone)
    without = accuracy_without_each(problem, anchors, places, zone) if survive else None
    return Judged(zone, places, errors, without)


def _joined(one: Judged, other: Judged) -> Judged:
    places = np.concatenate([one.places, other.places])
    without = None
    if one.without is not None and other.without is not None:
        without = _side_by_side(one.without, other.without)
    return Judged(one.zone, places, _side_by_side(one.errors, other.errors), without)


def _side_by_side(one: Errors, other: Errors) -> Errors:
    pairs = zip(one, other, strict=True)
    return Errors(*(np.concatenate(pair, axis=-1) for pair in pairs))


def short_row(judged: Judged) -> dict[str, Any]:
    """Return the verdict of a zone and its main figures.

    - ``name``, ``verdict``, ``pass`` (None if undecided or without a requirement), ``places``.
    - ``without_anchor``: if any one anchor may fail, the number of the critical one, from 1.
    - With a requirement: ``share``, ``share_low``, ``share_high``, ``required``.
    - ``margin``: the requirement over the value reached at the required share; 1.2 leaves 20 %.
    - ``would_pass``: the value of each limit that would pass with the others unchanged, and the
      ``factor`` on all limits that would pass; None if no value would.
    - ``decides``: the requirement with the largest value at the required share, relative to its
      limit; this ``value`` (None if infinite) and the ``limit``.
    - ``rms_position_m`` (horizontal), ``rms_height_m``, ``rms_heading_deg``, ``rms_score_m``.
    """
    zone = judged.zone
    row: dict[str, Any] = {
        "name": zone.name,
        "verdict": judged.verdict,
        "pass": {"pass": True, "fail": False}.get(judged.verdict),
        "places": len(judged.places),
    }
    if judged.failing is not None:
        row["without_anchor"] = judged.failing + 1
    if judged.asks:
        low, high = judged.interval
        relative = judged.relative
        row |= {
            "share": float(share_within(relative)),
            "share_low": low,
            "share_high": high,
            "required": {
                "share": zone.share,
                "position_m": zone.position_m,
                "height_m": zone.height_m,
                "heading_deg": zone.heading_deg,
            },
            "margin": float(1 / value_at_share(relative, zone.share)),
            "would_pass": would_pass(judged),
            "decides": _decides(judged),
        }
    return row | {f"rms_{name}": float(rms(v)) for name, v in told(judged.judged).items()}


def zone_row(judged: Judged, edges: Judged) -> dict[str, Any]:
    """Return `short_row` with the distribution of the errors, and the worst positions.

    ``position_m`` (horizontal), ``height_m``, ``heading_deg`` and ``score_m`` have ``rms``,
    ``median``, ``p95``, ``worst`` and ``at_share``: the error that is not exceeded in the required
    share of the zone, 0.95 without a requirement. The worst value and ``worst_places``, which are
    apart from each other, include the edges of the zone. If any one anchor may fail, ``any_loss``
    has the figures of the errors after the loss of the anchor that hurts most at each position, and
    with a requirement the ``share`` of the positions that meet it after the loss of any one anchor.

    Parameters
    ----------
    judged, edges
        Result of the zone, and its `at_edges`.
    """
    row = short_row(judged)
    for name, values in told(judged.judged).items():
        del row[f"rms_{name}"]
        worst = max(values.max(), told(edges.errors)[name].max(initial=0.0))
        at_share = float(value_at_share(values, judged.zone.share))
        row[name] = {**_spread(values), "worst": float(worst), "at_share": at_share}
    if judged.without is not None:
        row["any_loss"] = _any_loss(judged, judged.without)
    inner = Judged(judged.zone, judged.places, judged.judged)
    return row | {"worst_places": worst_places(_joined(inner, edges))}


def _any_loss(judged: Judged, without: Errors) -> dict[str, Any]:
    """Return errors after the loss, at each position, of the anchor that hurts most there."""
    largest = Errors(*(values.max(axis=0) for values in without))
    row: dict[str, Any] = {
        name: {**_spread(values), "worst": float(values.max())}
        for name, values in told(largest).items()
    }
    if judged.asks:
        row["share"] = float(share_within(relative_errors(largest, limits_of(judged.zone))))
    return row


def overview(judged: list[Judged], edges: list[Judged]) -> dict[str, Any]:
    """Return figures over all zones, with equally many positions of each.

    ``position_m``, ``rotation_deg`` and ``score_m``, over all three axes, have ``rms``, ``median``,
    ``p95``, ``worst`` and ``worst_at_m``. The worst value includes the edges.

    Parameters
    ----------
    judged, edges
        Results of all zones, and `at_edges` of each.
    """
    inner = [one.judged.of_places(slice(PLACES)) for one in judged]
    places = np.concatenate(
        [*(one.places[:PLACES] for one in judged), *(one.places for one in edges)]
    )
    result: dict[str, Any] = {"places": len(places)}
    for name, field, unit in (
        ("position_m", "position", 1.0),
        ("rotation_deg", "rotation", 180 / math.pi),
        ("score_m", "score", 1.0),
    ):
        values = unit * np.concatenate([getattr(errors, field) for errors in inner])
        outer = unit * np.concatenate([getattr(one.errors, field) for one in edges])
        every = np.concatenate([values, outer])
        worst = int(every.argmax())
        at = places[worst].tolist()
        result[name] = {**_spread(values), "worst": float(every[worst]), "worst_at_m": at}
    return result


def _spread(values: FloatArray) -> dict[str, float]:
    return {
        "rms": float(rms(values)),
        "median": float(np.median(values)),
        "p95": float(np.quantile(values, 0.95)),
    }


def at_edges(problem: Problem, anchors: FloatArray, judged: Judged) -> Judged:
    """Return the errors of the same zone on a grid with its edges and corners.

    Parameters
    ----------
    problem, anchors, judged
        The problem, the anchors, and the result of the zone. If its verdict is without an anchor,
        that anchor is missing here too.
    """
    places = free_grid(problem, judged.zone)
    left = anchors if judged.failing is None else np.delete(anchors, judged.failing, axis=0)
    if not len(places):
        return Judged(judged.zone, places, Errors(*np.empty((len(Errors._fields), 0))))
    return Judged(judged.zone, places, accuracy(problem, left, places, judged.zone))


def told(errors: Errors) -> dict[str, FloatArray]:
    """Return errors by the names and units of the requirements of a zone, and b."""
    return {
        "position_m": errors.horizontal,
        "height_m": errors.height,
        "heading_deg": np.rad2deg(errors.heading),
        "score_m": errors.score,
    }


def would_pass(judged: Judged) -> dict[str, float | None]:
    """Return the values that would pass: of each limit alone, and one ``factor`` on all limits."""
    zone, limits = judged.zone, limits_of(judged.zone)
    result: dict[str, float | None] = {"factor": float(value_at_share(judged.relative, zone.share))}
    for name, key in _KEYS.items():
        if not math.isfinite(getattr(limits, name)):
            continue
        others = limits._replace(**{name: math.inf})
        within = relative_errors(judged.judged, others) <= 1
        values = told(judged.judged)[key]
        needed = float(value_at_share(np.where(within, values, np.inf), zone.share))
        result[key] = needed if math.isfinite(needed) else None
    return result


def _decides(judged: Judged) -> dict[str, Any]:
    """Return the requirement that is missed most, or met with the least margin."""
    zone, values = judged.zone, told(judged.judged)
    asked = {key: limit for key in _KEYS.values() if (limit := getattr(zone, key)) is not None}
    reached = {key: float(value_at_share(values[key], zone.share)) for key in asked}
    key = max(asked, key=lambda one: reached[one] / asked[one])
    value = reached[key] if math.isfinite(reached[key]) else None
    return {"requirement": key, "value": value, "limit": asked[key]}


def worst_places(judged: Judged) -> list[dict[str, float]]:
    """Return the worst positions of a zone, apart from each other, with their errors."""
    order = judged.relative if judged.asks else judged.judged.score
    apart = _APART * float(np.linalg.norm(np.ptp(judged.places, axis=0)))
    open_ = np.ones(len(order), dtype=bool)
    values = told(judged.judged)
    rows: list[dict[str, float]] = []
    while open_.any() and len(rows) < _WORST:
        worst = int(np.where(open_, order, -np.inf).argmax())
        place = judged.places[worst]
        rows.append(
            dict(zip(("x_m", "y_m", "z_m"), place.tolist(), strict=True))
            | {name: float(value[worst]) for name, value in values.items()}
        )
        open_ &= np.linalg.norm(judged.places - place, axis=-1) > apart
    return rows


def judge(
    problem: Problem, anchors: FloatArray, seed: int, survive: int = 0, most: int | None = None
) -> list[Judged]:
    """Return `judge_zone` of every zone. Arguments as there."""
    return [judge_zone(problem, zone, anchors, seed, survive, most) for zone in problem.zones]


def verdict(judged: list[Judged]) -> str:
    """Return the worst verdict of the zones; zones without a requirement do not count."""
    found = {one.verdict for one in judged}
    for name in ("fail", "undecided", "pass"):
        if name in found:
            return name
    return "no requirement"


def judge_beside(
    problem: Problem, anchors: FloatArray, judged: list[Judged], survive: int = 0
) -> list[Judged]:
    """Evaluate a layout (M, 3) at the positions of the results of another one.

    The difference between the two is then due to the anchors, not to the positions. Arguments as in
    `judge_zone`; `judged` has the results of the other layout.
    """
    return [_judged(problem, one.zone, anchors, one.places, survive) for one in judged]
