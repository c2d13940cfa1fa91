"""Data of the page of a track: beliefs, truth, and the enlargement of errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import PoseBelief
from rbl_gym.rendering.drawing import RADIUS_95, round_number
from rbl_gym.studies.epochs import AxisErrors, axis_errors, nees_interval


class Beliefs(NamedTuple):
    """Beliefs of K epochs: rotation (K, 3, 3), translation (K, 3), covariance (K, 6, 6); colour."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    colour: str


class Story(NamedTuple):
    """A track of K epochs: times (K,), anchors (M, 3), tags (N, 3), beliefs by filter name.

    `truth` is rotation (K, 3, 3), or None for positions only, translation (K, 3), and whether they
    are known (K,); None: no truth. `axes` is ``"xyz"``, or ``"xy"``: only yaw and the horizontal
    position are evaluated.
    """

    times: FloatArray
    anchors: FloatArray
    names: Sequence[str]
    tags: FloatArray
    truth: tuple[FloatArray | None, FloatArray, BoolArray] | None
    beliefs: dict[str, Beliefs]
    axes: str = "xyz"


def freedom_of(story: Story) -> int:
    """Return the number of evaluated pose components."""
    places, turns = len(story.axes), 1 if story.axes == "xy" else 3
    return places if story.truth is not None and story.truth[0] is None else places + turns


def errors_of(story: Story, belief: Beliefs) -> AxisErrors:
    """Return errors of a track, with the standard deviations of its beliefs."""
    assert story.truth is not None
    found = PoseBelief(belief.rotation, belief.translation, belief.covariance, belief.rotation)
    return axis_errors(found, *story.truth, planar=story.axes == "xy")


def chart_limits(story: Story) -> list[tuple[float, float]]:
    """Return limits of the three charts; large errors of the first epochs are cut."""
    found = [errors_of(story, belief) for belief in story.beliefs.values()]
    limits = []
    pairs = (
        [(errors.position_m, errors.position_std_m) for errors in found],
        [(errors.rotation_deg, errors.rotation_std_deg) for errors in found],
    )
    for pair in pairs:
        values = [np.maximum(np.nan_to_num(size), 3 * std) for size, std in pair]
        limits.append((0.0, 1.15 * float(np.quantile(np.concatenate(values), 0.98))))
    nees = np.concatenate([errors.nees[np.isfinite(errors.nees)] for errors in found])
    freedom = freedom_of(story)
    low, high = nees_interval(dof=freedom)
    low, high = min(low, np.quantile(nees, 0.01)), max(high, np.quantile(nees, 0.995))
    return [*limits, (0.7 * max(float(low), 1e-3), 1.5 * float(high))]


def enlargement(story: Story) -> float:
    """Return the enlargement of errors that makes typical ellipsoids as large as the body."""
    size = float(np.linalg.norm(story.tags, axis=-1).max())
    widest = [np.sqrt(np.linalg.eigvalsh(belief.covariance[:, 3:, 3:])[:, -1])
              for belief in story.beliefs.values()]  # fmt: skip
    usual = RADIUS_95 * float(np.median(np.concatenate(widest)))
    return round_number(max(1.0, 0.6 * size / max(usual, 1e-12)))
