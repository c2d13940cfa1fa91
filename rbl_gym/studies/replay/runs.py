"""Replay several runs of one log, each from its own start; figures of each and together."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.studies.replay.figures import error_figures
from rbl_gym.studies.replay.judging import TrackErrors
from rbl_gym.studies.replay.settings import Settings
from rbl_gym.studies.replay.study import Replayed, check_replay, replay_recording

__all__ = ["ReplayedRuns", "replay_runs"]


class ReplayedRuns(NamedTuple):
    """The results of replayed runs.

    Attributes
    ----------
    runs
        Result of each run, by its name.
    figures
        Plain numbers: ``"runs"``, the figures of each run by its name, and ``"together"``, the
        errors of all epochs with truth.
    """

    runs: dict[str, Replayed]
    figures: dict[str, Any]


def replay_runs(
    recordings: Mapping[str, Recording],
    settings: Settings,
    advance: Advance = silent,
) -> ReplayedRuns:
    """Replay the runs of a log, each from its own start.

    Parameters
    ----------
    recordings
        Runs from `rbl_gym.recordings.read_runs`.
    settings
        Settings of the filter.
    advance
        Called with the number of epochs done.

    Raises
    ------
    ValueError
        As in `replay_recording`, with the name of the run; before any work if possible.
    """
    if not recordings:
        raise ValueError("recordings must hold a run, got none")
    for run, recording in recordings.items():
        with _errors_of(run):
            check_replay(recording, settings)
    replayed: dict[str, Replayed] = {}
    for run, recording in recordings.items():
        with _errors_of(run):
            replayed[run] = replay_recording(recording, settings, advance)
    every = [one.figures for one in replayed.values()]
    together: dict[str, Any] = {
        name: sum(one[name] for one in every) for name in ("epochs", "links", "duration_s")
    }
    found = [one.errors for one in replayed.values() if one.errors is not None]
    if found:
        errors = _joined(found)
        together["epochs_with_truth"] = int(errors.known.sum())
        axes = {one["position_axes"] for one in every if "position_axes" in one}
        together["position_axes"] = "xyz" if axes == {"xyz"} else "xy"
        together |= error_figures(errors)
    smoothed = [one.smoothed_errors for one in replayed.values() if one.smoothed_errors is not None]
    if smoothed:
        together["smoothed"] = error_figures(_joined(smoothed))
    figures = {run: one.figures for run, one in replayed.items()}
    return ReplayedRuns(replayed, {"runs": figures, "together": together})


@contextlib.contextmanager
def _errors_of(run: str) -> Iterator[None]:
    """Put the name of the run before the message of a ValueError."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"run {run!r}: {error}") from error


def _joined(found: list[TrackErrors]) -> TrackErrors:
    """Join the errors of several runs; figures missing in one run are left out."""

    def told(arrays: list[FloatArray | None]) -> FloatArray | None:
        known = [a for a in arrays if a is not None]
        return np.concatenate(known) if len(known) == len(arrays) else None

    freedom = np.concatenate([np.full(len(e.known), e.freedom) for e in found])
    # NEES of fewer compared components are scaled to the mean of the most. They are no longer
    # chi-square: only their mean (ANEES) is used.
    most = int(freedom.max())
    return TrackErrors(
        np.concatenate([e.known for e in found]),
        np.concatenate([e.position for e in found]),
        told([e.yaw for e in found]),
        told([e.rotation for e in found]),
        np.concatenate([e.nees for e in found]) * most / freedom,
        told([e.tags for e in found]),
        most,
    )
