"""Part of the horizontal error that is a rotation error times the distance of the tags."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.rotations import hat
from rbl_gym.placement.building import Problem
from rbl_gym.placement.sample import prior_of
from rbl_gym.studies.placing.accuracy import TURNS, accuracy
from rbl_gym.studies.placing.judging import PLACES, Judged
from rbl_gym.studies.placing.links import layout_information
from rbl_gym.studies.placing.requirements import turns


def lever_row(problem: Problem, anchors: FloatArray, judged: Judged) -> dict[str, Any] | None:
    """Return the horizontal error without the lever between the body origin and the tags.

    All errors are 95th percentiles in metres, over the first positions of the zone, of the case of
    the verdict (with all anchors, or without the critical one).

    - ``distance_m``: from the origin to the centroid of the tags.
    - ``position_m``: horizontal error of the origin.
    - ``at_tags_m``: horizontal error of the centroid of the tags, by the same covariances.
    - ``known_tilt_m``: horizontal error of the origin if only the heading is estimated.

    None if the tilt is known already.
    """
    zone, places = judged.zone, judged.places[:PLACES]
    if zone.attitude == "heading":
        return None
    left = anchors if judged.failing is None else np.delete(anchors, judged.failing, axis=0)
    centre = problem.tags.mean(axis=0)
    upright = dataclasses.replace(zone, attitude="heading")
    errors = {
        "position_m": judged.judged.horizontal[:PLACES],
        "at_tags_m": _horizontal(problem, left, judged, centre),
        "known_tilt_m": accuracy(problem, left, places, upright).horizontal,
    }
    return {"distance_m": float(np.linalg.norm(centre))} | {
        name: float(np.quantile(values, 0.95)) for name, values in errors.items()
    }


def _horizontal(
    problem: Problem, anchors: FloatArray, judged: Judged, point: FloatArray
) -> FloatArray:
    """Return the horizontal error (L) of a point (3,) of the body, root mean square of the turns.

    A pose error (w, v) moves the point by ``v + w x (R point)``.
    """
    zone = judged.zone
    rotation = turns(zone.attitude, TURNS)
    told = layout_information(problem, anchors, judged.places[:PLACES], rotation)
    P = np.linalg.inv(told + prior_of(problem, zone))
    still = np.broadcast_to(np.eye(3), rotation.shape)
    across = np.concatenate([-hat(rotation @ point), still], axis=-1)[:, :2]
    variance = np.einsum("tij,ltjk,tik->lt", across, P, across)
    return np.sqrt(variance.mean(axis=-1))
