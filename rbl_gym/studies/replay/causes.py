"""Find causes of a contradiction between filter and data: test faults one by one by likelihood.

Every hypothesis is a changed log or changed settings (`suppositions`). All of them run over the
part of the log with the largest contradiction, and the most likely one is selected. The excess of a
run is its log-likelihood below the expectation of its filter. A fault is reported if its correction
removes most of the excess.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators import Innovations
from rbl_gym.estimators.innovation import LOG_REJECTED, LOG_USED
from rbl_gym.geometry import rotations
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.evidence import Evidence, Trial, evidence, std_of
from rbl_gym.studies.replay.settings import Settings
from rbl_gym.studies.replay.suppositions import first_suppositions, left_out, second_suppositions
from rbl_gym.studies.replay.tracking import origin_of

__all__ = ["Cause", "likely_causes"]

# Number of ranges to use, and minimum and maximum number of epochs.
_RANGES, _FEWEST, _MOST = 6_000, 100, 1_500
# Shares of the excess that the causes together, and each of them, must remove to be reported.
_ENOUGH, _WORTH = 0.5, 0.1
# Two swapped tags of a symmetric body are a reflection, as a mirrored layout is. Both are reported
# if their log-likelihoods differ by less.
_REFLECTIONS, _AS_LIKELY = ("mirrored", "anchors-swapped", "tags-swapped"), 5.0


class Cause(NamedTuple):
    """A fault that would explain why the data contradict a filter.

    Attributes
    ----------
    kind
        ``"walk"``, ``"acceleration"``, ``"range-std"``, ``"mirrored"``, ``"anchors-swapped"``,
        ``"tags-swapped"``, ``"anchor-moved"``, ``"anchor-bias"``, ``"tag-bias"``, ``"link-bias"``,
        ``"common-bias"``, ``"units"``, ``"height"`` or ``"outliers"``.
    text
        Description.
    nis_per_dof
        The remaining NIS per degree of freedom, over the tested part of the log.
    mended
        The share of the excess that its correction removes.
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
    """Return at most two faults that explain most of the contradiction; empty: none does.

    Parameters
    ----------
    recording, settings
        The log and its settings; the truth is not used.
    found
        Innovations of the run.
    poses
        Rotations (K, 3, 3) and positions (K, 3) of the run. With an inertial sensor, where headings
        take long to converge, the tested part starts at these poses.
    """
    part = _strained_part(recording, found)
    if poses is not None and settings.filter == "iekf-imu":
        yaw = math.degrees(float(rotations.yaw(poses[0][part.start])))
        settings = settings.changed(start=(*poses[1][part.start].tolist(), yaw))
    trial = local_trial(recording.part(part), settings)
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
        # Schwarz's criterion: fitted parameters are penalised.
        price = 0.5 * np.log(trial.recording.links.sum())
        fitted = np.array([supposition.parameters for supposition in suppositions])
        density = np.log([supposition.scale for supposition in suppositions])
        likelihood = tried.log_likelihood.sum(axis=1) - price * fitted
        likelihood += density * tried.dof.sum(axis=1)
        best = int(np.argmax(likelihood))
        kind, text, mended, *_ = suppositions[best]
        if kind in _REFLECTIONS:
            near = likelihood > likelihood[best] - _AS_LIKELY
            equal = [x for x, y in zip(suppositions, near, strict=True) if y]
            text = "; or ".join(x.text for x in equal if x.kind in _REFLECTIONS)
        chosen = tried.part(slice(best, best + 1))
        after = max(_excess(mended, chosen), 0.0) / excess
        if left - after < _WORTH or not likelihood[best] > here.log_likelihood[0].sum():
            break
        ratio = float(chosen.nis.sum() / max(chosen.dof.sum(), 1))
        share = left - after
        if causes and causes[-1].kind == kind:
            # The same fault was found again.
            share += causes.pop().mended
        causes.append(Cause(kind, text, ratio, share))
        left, trial = after, mended
    return causes if left <= 1 - _ENOUGH else []


def _excess(trial: Trial, seen: Evidence) -> float:
    """Return how far the log-likelihood of a trial lies below the expectation of its filter."""
    links = trial.recording.links
    usual = LOG_USED - 0.5 - np.log(std_of(*trial)[links]).mean()
    nis, dof = seen.nis.sum(), seen.dof.sum()
    return float(0.5 * (nis - dof) + (links.sum() - dof) * (usual - LOG_REJECTED))


def _strained_part(recording: Recording, found: Innovations) -> slice:
    """Return the epochs of the part of a log with the largest contradiction."""
    links = recording.links.sum(axis=(1, 2))
    size = int(np.clip(_RANGES / max(links.mean(), 1), _FEWEST, _MOST))
    if size >= len(links):
        return slice(0, len(links))
    refused = -LOG_REJECTED * (links - found.dof)
    strain = np.concatenate([[0.0], np.cumsum(0.5 * (found.nis - found.dof) + refused)])
    first = int(np.argmax(strain[size:] - strain[:-size]))
    return slice(first, first + size)


def local_trial(recording: Recording, settings: Settings) -> Trial:
    """Return a recording without its truth, relative to its anchors if it has map coordinates."""
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
    local = recording._replace(anchors=recording.anchors - origin, truth=None)
    return Trial(local, settings)
