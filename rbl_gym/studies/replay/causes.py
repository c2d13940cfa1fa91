"""Why a filter contradicts its data: faults are supposed one by one, and the likelihood judges.

Every supposition is a changed log or changed settings (`suppositions`). All of them run over the
part of the log that is contradicted most, and the likeliest is taken. The excess of a run is by how
much its log-likelihood lies below what its filter claims; a fault is named if mending it takes away
most of that.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators import Innovations
from rbl_gym.estimators.innovation import LOG_REFUSED, LOG_USED
from rbl_gym.geometry import rotations
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.evidence import Evidence, Trial, evidence, std_of
from rbl_gym.studies.replay.settings import Settings
from rbl_gym.studies.replay.suppositions import first_suppositions, left_out, second_suppositions
from rbl_gym.studies.replay.tracking import origin_of

__all__ = ["Cause", "likely_causes"]

# So many ranges are looked at, and so many epochs at the least and at the most.
_RANGES, _FEWEST, _MOST = 6_000, 100, 1_500
# Causes together take away this share of the excess to be named, each of them this one.
_ENOUGH, _WORTH = 0.5, 0.1


class Cause(NamedTuple):
    """A fault that would explain why a filter contradicts its data.

    Attributes
    ----------
    kind
        ``"walk"``, ``"acceleration"``, ``"range-std"``, ``"anchors-swapped"``,
        ``"tags-swapped"``, ``"anchor-moved"``, ``"anchor-bias"``, ``"tag-bias"``, ``"link-bias"``,
        ``"common-bias"``, ``"units"``, ``"height"`` or ``"outliers"``.
    text
        In words.
    nis_per_dof
        The NIS per degree of freedom that would be left, over the part of the log looked at.
    mended
        The share of the excess that it takes away.
    """

    kind: str
    text: str
    nis_per_dof: float
    mended: float


def likely_causes(
    recording: Recording,
    settings: Settings,
    found: Innovations,
    poses: tuple[FloatArray, FloatArray] | None = None,
) -> list[Cause]:
    """Faults that explain most of what a filter did not foretell, at most two; empty: none does.

    Parameters
    ----------
    recording, settings
        What was filtered, and how; the truth is not looked at.
    found
        Innovations of that run.
    poses
        Rotations (K, 3, 3) and places (K, 3) of that run. With an inertial sensor, where headings
        take long to find, the part that is looked at starts there.
    """
    part = _strained_part(recording, found)
    if poses is not None and settings.filter == "iekf-imu":
        yaw = math.degrees(float(rotations.yaw(poses[0][part.start])))
        settings = settings.changed(start=(*poses[1][part.start].tolist(), yaw))
    trial = local_trial(cut(recording, part), settings)
    excess, left = 0.0, 1.0
    causes: list[Cause] = []
    while len(causes) < 2 and left > _WORTH:
        suppositions, without = list(first_suppositions(trial)), left_out(trial)
        seen = evidence([trial, *(s.trial for s in suppositions), *without])
        here, there = seen.part(slice(len(suppositions) + 1)), seen.part(slice(-len(without), None))
        if not causes:
            excess = _excess(trial, here.part(slice(1)))
            if not excess > 0:
                break
        more = list(second_suppositions(trial, suppositions, here, there))
        suppositions += more
        tried = here.part(slice(1, None)).with_more(evidence([s.trial for s in more]))
        # Schwarz's criterion: numbers that were fitted have their price.
        price = 0.5 * np.log(trial.recording.links.sum())
        fitted = np.array([supposition.parameters for supposition in suppositions])
        density = np.log([supposition.scale for supposition in suppositions])
        likelihood = tried.log_likelihood.sum(axis=1) - price * fitted
        likelihood += density * tried.dof.sum(axis=1)
        best = int(np.argmax(likelihood))
        kind, text, mended, *_ = suppositions[best]
        chosen = tried.part(slice(best, best + 1))
        after = max(_excess(mended, chosen), 0.0) / excess
        if left - after < _WORTH or not likelihood[best] > here.log_likelihood[0].sum():
            break
        ratio = float(chosen.nis.sum() / max(chosen.dof.sum(), 1))
        share = left - after
        if causes and causes[-1].kind == kind:
            # More of the same.
            share += causes.pop().mended
        causes.append(Cause(kind, text, ratio, share))
        left, trial = after, mended
    return causes if left <= 1 - _ENOUGH else []


def _excess(trial: Trial, seen: Evidence) -> float:
    """By how much the log-likelihood of a trial misses what its filter claims."""
    links = trial.recording.links
    usual = LOG_USED - 0.5 - np.log(std_of(*trial)[links]).mean()
    nis, dof = seen.nis.sum(), seen.dof.sum()
    return float(0.5 * (nis - dof) + (links.sum() - dof) * (usual - LOG_REFUSED))


def _strained_part(recording: Recording, found: Innovations) -> slice:
    """The epochs of the part of a log that is contradicted most."""
    links = recording.links.sum(axis=(1, 2))
    size = int(np.clip(_RANGES / max(links.mean(), 1), _FEWEST, _MOST))
    if size >= len(links):
        return slice(0, len(links))
    refused = -LOG_REFUSED * (links - found.dof)
    strain = np.concatenate([[0.0], np.cumsum(0.5 * (found.nis - found.dof) + refused)])
    first = int(np.argmax(strain[size:] - strain[:-size]))
    return slice(first, first + size)


def cut(recording: Recording, epochs: slice) -> Recording:
    """Some epochs of a recording, without the truth."""
    std, anchors = recording.range_std, recording.anchors
    return recording._replace(
        times=recording.times[epochs],
        ranges=recording.ranges[epochs],
        links=recording.links[epochs],
        range_std=None if std is None else std[epochs],
        anchors=anchors[epochs] if anchors.ndim == 3 else anchors,
        truth=None,
    )


def local_trial(recording: Recording, settings: Settings) -> Trial:
    """A recording relative to its anchors, where its coordinates are those of a map."""
    origin = origin_of(recording)
    known = settings.knowledge
    changed: dict[str, Any] = {}
    if known.volume is not None:
        pairs = zip(known.volume, np.repeat(origin, 2), strict=True)
        changed["volume"] = tuple(None if x is None else x - o for x, o in pairs)
    if known.start is not None:
        changed["start"] = (*(np.array(known.start[:3]) - origin), *known.start[3:])
    if known.height_m is not None:
        changed["height_m"] = known.height_m - float(origin[2])
    settings = settings.changed(**changed)
    return Trial(recording._replace(anchors=recording.anchors - origin), settings)
