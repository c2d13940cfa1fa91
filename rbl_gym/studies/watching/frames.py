"""Frames: a body, its links and its filters at an epoch, as plain data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import Filter, Innovations, PoseBelief, parse_filter
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.studies.epochs import Step, pose_errors
from rbl_gym.studies.groups import innovations_of

__all__ = ["LINKS", "Frame", "Links", "Named", "Pose", "Tracked", "filter_named", "link_kinds"]

# Kinds of links; a link's number is an index of this tuple.
LINKS = ("lost", "used", "reflected", "rejected", "behind an obstacle")
LOST, USED, REFLECTED, REJECTED, WEAK = range(5)


class Pose(NamedTuple):
    """A pose: rotation (3, 3), None if unknown, and translation (3,), metres."""

    rotation: FloatArray | None
    translation: FloatArray


class Links(NamedTuple):
    """State of the links at an epoch.

    Attributes
    ----------
    measured
        (M, N): links that gave a range.
    reflected
        (M, N): measured links over a reflected path; known in simulations only.
    weak
        (M, 1) or (M, N): links that lose more than half of their information to obstacles;
        filters know this.
    """

    measured: BoolArray
    reflected: BoolArray
    weak: BoolArray


class Tracked(NamedTuple):
    """Result of a filter at an epoch.

    Attributes
    ----------
    label
        Label of the filter.
    belief
        Belief after the ranges of the epoch.
    rejected
        (M, N): ranges that a robust filter rejects.
    position_m, rotation_deg, nees
        Errors against the truth, and the normalised estimation error squared, of mean 6 for a
        consistent filter; NaN if there is no truth.
    nis, dof
        Normalised innovation squared of the accepted ranges, and their number. The ratio has mean
        1 for a consistent filter.
    """

    label: str
    belief: PoseBelief
    rejected: BoolArray
    position_m: float
    rotation_deg: float
    nees: float
    nis: float
    dof: int

    @property
    def nis_ratio(self) -> float:
        """Return NIS per degree of freedom; NaN without a range."""
        return self.nis / self.dof if self.dof else np.nan


class Frame(NamedTuple):
    """The complete picture of an epoch.

    Attributes
    ----------
    time_s
        Time since the start.
    truth
        The true pose; None if unknown.
    anchors, told
        True anchor positions, and the positions that the filters assume, (M, 3), metres.
    links
        State of the links.
    tracks
        Results of the filters.
    score_m
        The environment's score b in metres; NaN if there is none.
    ghosts
        Other layouts (M, 3) by name, for comparison.
    scores
        Scores of the ghosts, metres.
    picture
        Picture that an environment renders, (height, width, 3); None if the frame is drawn in 3-D.
    """

    time_s: float
    truth: Pose | None
    anchors: FloatArray
    told: FloatArray
    links: Links
    tracks: tuple[Tracked, ...] = ()
    score_m: float = np.nan
    ghosts: Mapping[str, FloatArray] = {}
    scores: Mapping[str, float] = {}
    picture: np.ndarray | None = None


class Named(NamedTuple):
    """A filter by its name in `rbl_gym.estimators`, with its options, and a label."""

    label: str
    name: str | Callable[..., Filter]
    options: dict[str, Any]


def filter_named(label: str) -> Named:
    """Return a filter by a label that `rbl_gym.estimators.parse_filter` reads."""
    return Named(label.strip(), *parse_filter(label))


def link_kinds(links: Links, rejected: BoolArray | None = None) -> np.ndarray:
    """Return the kinds (M, N) of links as indices of `LINKS`.

    Parameters
    ----------
    links
        Links of a frame.
    rejected
        (M, N), rejected ranges of a filter. A rejected reflected range counts as rejected.
    """
    kinds = np.where(links.measured, np.where(links.weak, WEAK, USED), LOST)
    kinds = np.where(links.measured & links.reflected, REFLECTED, kinds)
    if rejected is not None:
        kinds = np.where(links.measured & rejected, REJECTED, kinds)
    return kinds


def tracked(
    label: str, filter: Filter, step: Step, tags: FloatArray, noise: NoiseLaw, truth: Pose | None
) -> Tracked:
    """Return the result of a filter at a step of `studies.epochs.track_epochs`.

    `noise` is the noise law of the ranges if the epoch has none; `truth` the true pose, if known.
    """
    ((_, found),) = innovations_of(filter, [step], tags, noise)
    found = Innovations(*(field[0] for field in found))
    links = step.reading.links
    measured = np.ones(found.used.shape, np.bool_) if links is None else links
    # A filter that is not robust accepts all ranges.
    rejected = measured & ~found.used & bool(is_robust(filter))
    errors = np.full(3, np.nan)
    if truth is not None and truth.rotation is not None:
        judged = pose_errors(step.belief, truth.rotation, truth.translation, tags)
        turn, move = judged.pose[:3], judged.pose[3:]
        errors = [np.linalg.norm(move), np.rad2deg(np.linalg.norm(turn)), judged.nees]
    position, turned, nees = map(float, errors)
    nis, dof = float(found.nis), int(found.dof)
    return Tracked(label, step.belief, rejected, position, turned, nees, nis, dof)


def is_robust(filter: Any) -> bool:
    """Return whether a filter rejects ranges that contradict the others."""
    while filter is not None:
        robust = getattr(filter, "robust", None)
        if robust is not None:
            return bool(robust)
        filter = getattr(filter, "pose", None) or getattr(filter, "filter", None)
    return False
