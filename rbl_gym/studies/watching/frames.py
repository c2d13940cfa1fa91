"""Frames: what is seen of a body, its links and its filters at an epoch, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import Filter, Innovations, PoseBelief
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.studies.epochs import Step, innovations_of, pose_errors

__all__ = ["LINKS", "Frame", "Links", "Named", "Pose", "Tracked", "filter_named", "link_kinds"]

# Kinds of links, in the order of their numbers.
LINKS = ("lost", "used", "reflected", "refused", "behind an obstacle")
LOST, USED, REFLECTED, REFUSED, WEAK = range(5)


class Pose(NamedTuple):
    """A pose: rotation (3, 3), None where it is not known, and translation (3,), metres."""

    rotation: FloatArray | None
    translation: FloatArray


class Links(NamedTuple):
    """What became of the links of an epoch.

    Attributes
    ----------
    measured
        (M, N): which gave a range.
    reflected
        (M, N): which of these came over a reflected path; only a simulation knows.
    weak
        (M, 1) or (M, N): which have less than half of their information, for what stands in the
        way; filters are told.
    """

    measured: BoolArray
    reflected: BoolArray
    weak: BoolArray


class Tracked(NamedTuple):
    """What a filter makes of an epoch.

    Attributes
    ----------
    label
        Of the filter.
    belief
        After the ranges of the epoch.
    refused
        (M, N): ranges that a robust filter leaves out.
    position_m, rotation_deg, nees
        Errors against the truth and their normalised square, of mean 6 where the belief is honest;
        NaN where there is no truth.
    nis, dof
        Normalised innovation squared of the ranges that fit, and their number. The ratio has mean
        1 where the filter is honest.
    """

    label: str
    belief: PoseBelief
    refused: BoolArray
    position_m: float
    rotation_deg: float
    nees: float
    nis: float
    dof: int

    @property
    def nis_ratio(self) -> float:
        """NIS per degree of freedom; NaN without a range."""
        return self.nis / self.dof if self.dof else np.nan


class Frame(NamedTuple):
    """All that is seen at an epoch.

    Attributes
    ----------
    time_s
        Since the start.
    truth
        The true pose; None where nobody knows it.
    anchors, told
        Where the anchors stand and where filters are told that they do, (M, 3), metres.
    links
        What became of the links.
    tracks
        The filters.
    score_m
        What an environment scores, b in metres; NaN where there is no score.
    ghosts
        Anchors (M, 3) of others by their names, to compare with.
    scores
        Their scores, metres.
    picture
        What an environment renders, (height, width, 3); None where the frame is drawn in 3-D.
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
    name: str
    options: dict[str, Any]


# What a name may end with.
_LOSSES: dict[str, dict[str, Any]] = {
    "-robust": {"robust": True},
    "-late": {"robust": "late"},
}


def filter_named(label: str) -> Named:
    """A filter by a label: its name, which may end in ``-robust`` or ``-late``.

    ``iekf-robust`` is the filter ``iekf`` with the option ``robust=True``.
    """
    label = label.strip()
    for end, options in _LOSSES.items():
        if label.endswith(end):
            return Named(label, label.removesuffix(end), dict(options))
    return Named(label, label, {})


def link_kinds(links: Links, refused: BoolArray | None = None) -> np.ndarray:
    """Numbers (M, N) of what became of links, indices of `LINKS`.

    Parameters
    ----------
    links
        Of a frame.
    refused
        (M, N), of a filter; a reflected range that it refuses counts as refused.
    """
    kinds = np.where(links.measured, np.where(links.weak, WEAK, USED), LOST)
    kinds = np.where(links.measured & links.reflected, REFLECTED, kinds)
    if refused is not None:
        kinds = np.where(links.measured & refused, REFUSED, kinds)
    return kinds


def tracked(
    label: str, filter: Filter, step: Step, tags: FloatArray, noise: NoiseLaw, truth: Pose | None
) -> Tracked:
    """What a filter makes of an epoch.

    Parameters
    ----------
    label, filter
        The filter.
    step
        Of `studies.epochs.track_epochs`.
    tags, noise
        The body (N, 3), and the law of the ranges where the epoch has none.
    truth
        The true pose, if it is known.
    """
    ((_, found),) = innovations_of(filter, [step], tags, noise)
    found = Innovations(*(field[0] for field in found))
    links = step.reading.links
    measured = np.ones(found.used.shape, np.bool_) if links is None else links
    # A filter that is not robust takes whatever comes.
    refused = measured & ~found.used & bool(is_robust(filter))
    errors = np.full(3, np.nan)
    if truth is not None and truth.rotation is not None:
        judged = pose_errors(step.belief, truth.rotation, truth.translation, tags)
        turn, move = judged.pose[:3], judged.pose[3:]
        errors = [np.linalg.norm(move), np.rad2deg(np.linalg.norm(turn)), judged.nees]
    position, turned, nees = map(float, errors)
    nis, dof = float(found.nis), int(found.dof)
    return Tracked(label, step.belief, refused, position, turned, nees, nis, dof)


def is_robust(filter: Any) -> bool:
    """Whether a filter leaves out ranges that contradict the others."""
    while filter is not None:
        robust = getattr(filter, "robust", None)
        if robust is not None:
            return bool(robust)
        filter = getattr(filter, "pose", None) or getattr(filter, "filter", None)
    return False
