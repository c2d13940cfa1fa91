"""`rbl-gym replay` as a function: compute the track of a recording, its errors, its figures."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.recordings import TimeOffset
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.studies.replay.diagnosis import WIDE, WIDE_NOTE, diagnose
from rbl_gym.studies.replay.figures import smoothed_figures, track_figures, wide_note
from rbl_gym.studies.replay.judging import (
    TrackErrors,
    find_offset,
    in_clock,
    track_errors,
    with_offset,
)
from rbl_gym.studies.replay.overlap import check_overlap
from rbl_gym.studies.replay.place import height_offset
from rbl_gym.studies.replay.settings import Settings
from rbl_gym.studies.replay.smoothing import SmoothedRecording, smooth_recording
from rbl_gym.studies.replay.tracking import Track, recording_filter, robust_of, track_recording

__all__ = ["Replayed", "check_replay", "replay_recording"]

# Correlation of the motions below which an estimated time offset is reported as unreliable.
_RELIABLE = 0.9
# Standard deviation (s) above which it is.
_VAGUE_S = 0.25


class Replayed(NamedTuple):
    """The result of a replayed recording.

    Attributes
    ----------
    settings
        The settings used.
    track
        Beliefs after every epoch.
    errors
        Errors relative to the truth of the recording; None without truth.
    figures
        Plain numbers, as written by `rbl-gym replay --json`.
    smoothed, smoothed_errors
        The smoothed track and its errors, if `Smoothing.smooth` is True.
    """

    settings: Settings
    track: Track
    errors: TrackErrors | None
    figures: dict[str, Any]
    smoothed: SmoothedRecording | None = None
    smoothed_errors: TrackErrors | None = None


def check_replay(recording: Recording, settings: Settings) -> Settings:
    """Return settings completed from the recording, and check them before any work is done.

    Raises
    ------
    ValueError
        If a filter or option is unknown, a required height is not given, or the truth does not
        overlap the ranges.
    """
    offset = height_offset(recording, settings)
    settings = settings.changed(height_offset_m=offset, robust=robust_of(settings))
    recording_filter(recording, settings)
    comparison = settings.comparison
    if recording.truth is not None and comparison.time_offset != "auto":
        truth = in_clock(recording.truth, settings)
        told_s = float(comparison.time_offset)
        check_overlap(truth, recording.times, comparison.truth_gap_s, told_s)
    return settings


def replay_recording(
    recording: Recording, settings: Settings, advance: Advance = silent
) -> Replayed:
    """Track a recorded body causally, and compare the track with the truth if there is one.

    Parameters
    ----------
    recording
        From `rbl_gym.recordings.read_recording`, or constructed from arrays.
    settings
        Settings of the filter.
    advance
        Called with the number of epochs done.

    Raises
    ------
    ValueError
        As in `check_replay`.
    """
    settings = check_replay(recording, settings)
    clock = _Stopwatch(advance)
    track = track_recording(recording, settings, clock.tick)
    smoothed: SmoothedRecording | None = None
    if settings.smoothing.smooth:
        smoothed = smooth_recording(recording, settings, track)
    offset: TimeOffset | None = None
    if settings.comparison.time_offset == "auto":
        # A smoothed track has no lag.
        best = track if smoothed is None else smoothed.track
        offset = _offset_of(recording, best, settings, track)
        settings = with_offset(settings, offset)
    errors = track_errors(recording, track, settings)
    figures = track_figures(recording, track, errors, settings)
    figures["microseconds_per_epoch"] = clock.microseconds()
    if offset is not None:
        lags = smoothed is None
        figures["time_offset"] = {**offset._asdict(), "track": "causal" if lags else "smoothed"}
    figures["consistency"], notes = diagnose(recording, settings, track)
    smoothed_errors = None
    if smoothed is not None:
        smoothed_errors = track_errors(recording, smoothed.track, settings)
        figures["smoothed"] = smoothed_figures(smoothed, smoothed_errors)
        notes += wide_note(figures["smoothed"], figures["settings"])
    if max(each.get("anees", 0.0) for each in (figures, figures.get("smoothed", {}))) > WIDE:
        # The errors are as large as the covariance says: it is not too large.
        notes = [note for note in notes if not note.startswith(WIDE_NOTE)]
    figures["notes"] = figures["notes"] + ([] if offset is None else _offset_note(offset)) + notes
    return Replayed(settings, track, errors, figures, smoothed, smoothed_errors)


def _offset_of(
    recording: Recording, best: Track, settings: Settings, causal: Track
) -> TimeOffset | None:
    """Return the clock offset of the truth; a ValueError names a fault that prevents it."""
    try:
        return find_offset(recording, best, settings)
    except ValueError as error:
        hint = _axes_hint(recording, best, settings)
        if not hint:
            causes = diagnose(recording, settings, causal)[0]["causes"]
            hint = "".join(f"; {cause['text']}" for cause in causes)
        raise ValueError(f"{error}{hint}") from error


def _axes_hint(recording: Recording, track: Track, settings: Settings) -> str:
    """Return words if the motions agree with x and y of the track swapped."""
    swap = np.eye(3)[[1, 0, 2]]
    swapped = track._replace(
        rotation=swap @ track.rotation @ swap, translation=track.translation @ swap
    )
    try:
        found = find_offset(recording, swapped, settings)
    except ValueError:
        return ""
    if found is None or found.correlation < _RELIABLE:
        return ""
    return (
        "; x and y of the anchors (or of the truth) look swapped: with them exchanged the motions "
        f"agree (correlation {found.correlation:.2f})"
    )


def _offset_note(found: TimeOffset) -> list[str]:
    if found.correlation >= _RELIABLE and found.std_s <= _VAGUE_S:
        return []
    return [
        f"WARNING: the estimated time offset of the truth, {found.offset_s:.3f} s, is unreliable: "
        f"its standard deviation is {found.std_s:.2g} s and the correlation of the motions of "
        f"track and truth {found.correlation:.2f}. Check that both are of one run, and the "
        "positions of the anchors, or give the offset in seconds (--time-offset S)."
    ]


class _Stopwatch:
    """Measure the processor time from one report of progress to the next."""

    def __init__(self, advance: Advance) -> None:
        self._advance = advance
        self._ends, self._steps = [time.process_time()], []

    def tick(self, steps: int = 1, *, more: int = 0) -> None:
        """Note the end of some epochs."""
        self._ends.append(time.process_time())
        self._steps.append(steps)
        self._advance(steps, more=more)

    def microseconds(self) -> float:
        """Return the median time of an epoch; the first ones may include compilation."""
        each = np.repeat(np.diff(self._ends) / self._steps, self._steps)
        return 1e6 * float(np.median(each))
