"""Predict the accuracy with survey errors of anchors, or uncalibrated links."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym import bounds
from rbl_gym.bounds.information import marginal
from rbl_gym.bounds.nuisances import information_of
from rbl_gym.checks import FloatArray
from rbl_gym.measurements import ranging
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.placement.building import Problem, Zone
from rbl_gym.placement.sample import prior_of
from rbl_gym.studies.monte_carlo import rms
from rbl_gym.studies.placing.accuracy import TURNS
from rbl_gym.studies.placing.judging import Judged, limits_of, share_within
from rbl_gym.studies.placing.links import link_shares
from rbl_gym.studies.placing.requirements import Errors, errors_of, relative_errors, turns
from rbl_gym.studies.what_if import SURVEYS_M, UNCALIBRATED

__all__ = ["survey_rows", "surveyed_accuracy"]


def survey_rows(
    problem: Problem, anchors: FloatArray, judged: list[Judged]
) -> list[dict[str, Any]]:
    """Return figures of one epoch for several survey and calibration errors, over all zones.

    Parameters
    ----------
    problem, anchors
        The placement problem, and the anchor positions (M, 3).
    judged
        Results of its zones, with the evaluated positions.

    Returns
    -------
    Rows of plain numbers: `unknown` (a name), `anchor_std_m`, `bias_std_m` and `bias_common_m`,
    root mean squares `position_m`, `rotation_deg` and `score_m`, and for every zone with
    requirements the share of its positions `within`, by name.
    """
    cases: list[tuple[str, float, LinkBias | None]] = [("only the pose", 0.0, None)]
    cases += [(f"anchors to {100 * std:g} cm", std, None) for std in SURVEYS_M]
    cases += [("links not calibrated", 0.0, UNCALIBRATED)]
    rows = []
    for name, std, bias in cases:
        found = [
            surveyed_accuracy(problem, anchors, one.places, one.zone, std, bias) for one in judged
        ]
        position, rotation, score = (
            float(rms(np.concatenate([errors[k] for errors in found]))) for k in range(3)
        )
        within = {
            one.zone.name: float(share_within(relative_errors(errors, limits_of(one.zone))))
            for one, errors in zip(judged, found, strict=True)
            if one.asks
        }
        rows.append(
            {
                "unknown": name,
                "anchor_std_m": std,
                "bias_std_m": 0.0 if bias is None else bias.std_m,
                "bias_common_m": 0.0 if bias is None else bias.common_std_m,
                "position_m": position,
                "rotation_deg": float(np.rad2deg(rotation)),
                "score_m": score,
                "within": within,
            }
        )
    return rows


def surveyed_accuracy(
    problem: Problem,
    anchors: FloatArray,
    places: FloatArray,
    zone: Zone,
    anchor_std_m: float = 0.0,
    bias: LinkBias | None = None,
) -> Errors:
    """Return `accuracy` (L) at positions (L, 3) of a zone, with survey errors and link biases.

    Parameters
    ----------
    problem, anchors, places, zone
        As in `accuracy`.
    anchor_std_m
        Standard deviation of the anchor positions, per axis.
    bias
        Law of the link biases; None: no biases.
    """
    rotation, prior = turns(zone.attitude, TURNS), prior_of(problem, zone)
    share = link_shares(problem, anchors, places, rotation)
    common = None
    if bias is not None:
        # Within one epoch, the bias of a single link acts as noise; the common bias does not.
        spots = ranging.tag_positions(rotation, places[:, None], problem.tags)
        variance = problem.noise.variance(ranging.distances(anchors, spots))
        share = share / (1 + share * bias.std_m**2 / variance)
        common = LinkBias(bias.common_std_m)
    epoch = bounds.RangeEpoch(anchors, problem.tags, rotation, places[:, None], problem.noise)
    if common is None:
        std = np.full((len(anchors), 3), anchor_std_m) if anchor_std_m > 0 else None
        told = bounds.information_at(*epoch[:5], share, anchor_std=std)  # pyrefly: ignore[bad-argument-type]
    else:
        unknown = bounds.Nuisances(None, anchor_std_m, common, "common")
        joint = information_of(epoch, unknown, share)
        own = np.arange(6, joint.shape[-1])
        joint[..., own, own] += 1.0
        told = marginal(joint, 6)
    return errors_of(told + prior, rotation, problem.tags)
