"""Compute the contribution of each anchor: the accuracy without it."""

from __future__ import annotations

from typing import Any

from rbl_gym.studies.monte_carlo import rms
from rbl_gym.studies.placing.judging import Judged, limits_of, told
from rbl_gym.studies.placing.ranking import overall_score
from rbl_gym.studies.placing.requirements import Errors, relative_errors, share_within

__all__ = ["without_each"]


def without_each(judged: list[Judged], lost: list[Errors]) -> list[dict[str, Any]]:
    """Return for each anchor the figures without it: b over all zones, and those of each zone.

    Parameters
    ----------
    judged, lost
        For every zone: the result with all anchors, and `accuracy_without_each`.
    """
    zones = [one.zone for one in judged]
    with_all = overall_score(zones, [one.errors.score for one in judged])
    scores = overall_score(zones, [one.score for one in lost])
    rows = []
    for k, score in enumerate(scores):
        of_zones = []
        for one, errors in zip(judged, lost, strict=True):
            left = Errors(*(values[k] for values in errors))
            row: dict[str, Any] = {"name": one.zone.name}
            row |= {name: float(rms(values)) for name, values in told(left).items()}
            limits = limits_of(one.zone)
            if limits.any():
                row["share"] = float(share_within(relative_errors(left, limits)))
            of_zones.append(row)
        rows.append({"score_m": float(score), "ratio": float(score / with_all), "zones": of_zones})
    return rows
