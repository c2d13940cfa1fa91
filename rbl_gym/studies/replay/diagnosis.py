"""Diagnose the consistency of a log without truth, in figures and in words."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.anchor_faults import anchor_note
from rbl_gym.studies.replay.causes import Cause, likely_causes
from rbl_gym.studies.replay.consistency import (
    MOST_NIS,
    MOST_REJECTED,
    consistency_figures,
    typical_square,
)
from rbl_gym.studies.replay.settings import DEFAULT_RANGE_STD_M, Settings
from rbl_gym.studies.replay.tracking import Track

# Below this NIS or NEES per degree of freedom the filter is pessimistic.
WIDE = 0.7
WIDE_NOTE = "Note: the assumed noise of the ranges looks too large"


def diagnose(
    recording: Recording, settings: Settings, track: Track
) -> tuple[dict[str, Any], list[str]]:
    """Return figures as in `consistency_figures`, ``causes`` of a contradiction, and notes."""
    found = track.innovations
    assert found is not None
    figures = consistency_figures(found, recording)
    ratio = figures["nis_per_dof"]
    if not figures["contradicts"]:
        notes = anchor_note(recording, settings, track)
        if ratio < WIDE:
            notes.append(
                f"{WIDE_NOTE} for this log (NIS per degree of freedom {ratio:.2f}, 1: consistent), "
                "unless the errors of a link are correlated in time. "
                "Try --tune or a smaller --range-std-m."
            )
        return {**figures, "causes": []}, notes
    if recording.offset is not None:
        # The tested faults concern ranges, not their differences.
        text = _subject(figures) + "Look at the residuals of anchors, tags and links; see --tune."
        return {**figures, "causes": []}, [text]
    if (usual := typical_square(found, recording)) < WIDE:
        # With the assumed noise no fault would be likely.
        recording, settings = _with_less_noise(recording, settings, math.sqrt(usual))
    causes = likely_causes(recording, settings, found, track[1:3])
    return {**figures, "causes": [cause._asdict() for cause in causes]}, [_warning(figures, causes)]


def _with_less_noise(
    recording: Recording, settings: Settings, share: float
) -> tuple[Recording, Settings]:
    """Return recording and settings with a share of the standard deviation of the ranges."""
    if recording.range_std is not None and settings.range_std_m is None:
        return recording._replace(range_std=share * recording.range_std), settings
    std = settings.range_std_m or DEFAULT_RANGE_STD_M
    return recording, settings.changed(range_std_m=share * std)


def _subject(figures: dict[str, Any]) -> str:
    ratio, refused = figures["nis_per_dof"], figures["rejected_share"]
    # With one bad link among many, neither NIS nor the rejected share is large.
    subject = "the filter does not fit its data"
    if ratio < MOST_NIS and refused < MOST_REJECTED:
        subject = "a part of the ranges does not fit the filter"
    return (
        f"WARNING: {subject}: NIS per degree of freedom {ratio:.2f} (1: consistent), "
        f"{100 * refused:.0f} % of the ranges rejected. "
    )


def _warning(figures: dict[str, Any], causes: list[Cause]) -> str:
    text = _subject(figures)
    if not causes:
        return text + (
            "No single fault explains it (tried: motion, deviation of the ranges, swaps, "
            "positions of anchors, biases, units). Look at the residuals of anchors, tags and "
            "links; see --tune."
        )
    named = "; and ".join(cause.text for cause in causes)
    return f"{text}Likely: {named} (NIS per degree of freedom {causes[-1].nis_per_dof:.2f} then)."
