"""Compute the likelihood of ranges under many hypotheses at once, for logs of one length."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import estimators, motion
from rbl_gym.checks import FloatArray
from rbl_gym.estimators import IteratedEkf
from rbl_gym.measurements.ranging import LinkNoise, RangeNoise
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.epochs import Reading, track_epochs
from rbl_gym.studies.groups import innovations_of
from rbl_gym.studies.replay.place import level_of, own_std
from rbl_gym.studies.replay.settings import DEFAULT_RANGE_STD_M, Settings
from rbl_gym.studies.replay.tracking import prior_of, recording_filter, sensed

# Number of trials that run at once; with more, the data no longer fit into the processor caches.
_TOGETHER = 64


class Trial(NamedTuple):
    """A recording under a hypothesis, and its settings."""

    recording: Recording
    settings: Settings


class Evidence(NamedTuple):
    """Results of B trials over K epochs.

    Attributes
    ----------
    log_likelihood, nis, dof
        As in `estimators.Innovations`, (B, K).
    rotation, translation
        Poses after every epoch, (B, K, 3, 3) and (B, K, 3).
    residual
        Residuals (B, K, M, N), metres.
    """

    log_likelihood: FloatArray
    nis: FloatArray
    dof: FloatArray
    rotation: FloatArray
    translation: FloatArray
    residual: FloatArray

    def part(self, trials: slice) -> Evidence:
        """Return the results of some of the trials."""
        return Evidence(*(field[trials] for field in self))

    def with_more(self, other: Evidence) -> Evidence:
        """Return these results followed by those of other trials over the same epochs."""
        return Evidence(*map(np.concatenate, zip(self, other, strict=True)))


def evidence(trials: Sequence[Trial]) -> Evidence:
    """Return the likelihood of recordings with the same epochs and links, one per hypothesis.

    It is minus infinity for a trial that cannot be filtered. Recordings may differ in ranges, their
    standard deviations, anchors, tags, and used links; settings in any field.
    """
    found: list[tuple[FloatArray, ...] | None] = [None] * len(trials)
    groups: dict[Any, list[int]] = {}
    for k, trial in enumerate(trials):
        groups.setdefault(_same_filter(*trial), []).append(k)
    for members in groups.values():
        for first in range(0, len(members), _TOGETHER):
            chosen = members[first : first + _TOGETHER]
            for k, result in zip(chosen, _tried([trials[k] for k in chosen]), strict=True):
                found[k] = result
    return Evidence(*map(np.array, zip(*found, strict=True)))


def _same_filter(recording: Recording, settings: Settings) -> tuple[Settings, bytes]:
    """Return the settings that trials run together must share; motion may differ for `iekf`."""
    tags = recording.tags.tobytes()
    if settings.filter == "iekf":
        settings, tags = settings.changed(walk_m=0.0, walk_deg=0.0), b""
    return settings.changed(range_std_m=None, height_offset_m=None), tags


def _tried(trials: list[Trial]) -> Iterator[tuple[FloatArray, ...]]:
    """Yield results of trials that run together, or one by one if one of them raises an error."""
    try:
        yield from _together(trials)
    except (TypeError, ValueError, np.linalg.LinAlgError):
        if len(trials) > 1:
            for trial in trials:
                yield from _tried([trial])
            return
        K, shape = len(trials[0].recording.times), trials[0].recording.ranges.shape
        nothing = np.full((K, 3, 3), np.nan), np.full((K, 3), np.nan), np.full(shape, np.nan)
        yield np.full(K, -np.inf), np.full(K, np.inf), np.ones(K), *nothing


def _together(trials: list[Trial]) -> list[tuple[FloatArray, ...]]:
    filter = _stacked([recording_filter(*trial) for trial in trials])
    prior = tuple(map(np.array, zip(*(prior_of(*trial) for trial in trials), strict=True)))
    tags = np.stack([trial.recording.tags for trial in trials])
    level = level_of(trials[0].settings, np.zeros(3))
    told = _readings(trials)
    steps = track_epochs(filter, prior, told, level=level)  # pyrefly: ignore[bad-argument-type]
    columns: list[tuple[FloatArray, ...]] = []
    for group, i in innovations_of(filter, steps, tags, RangeNoise()):
        rotation, translation, *_ = group.belief
        columns.append((i.log_likelihood, i.nis, i.dof, rotation, translation, i.residual))
    stacked = [np.concatenate(column).swapaxes(0, 1) for column in zip(*columns, strict=True)]
    return list(zip(*stacked, strict=True))


def _stacked(filters: list[Any]) -> estimators.Filter:
    """Return one filter for a group; tags and motion get a leading axis if they differ."""
    first = filters[0]
    if len(filters) == 1 or not isinstance(first, IteratedEkf):
        return first
    std = np.stack([filter.process.std() for filter in filters])
    process = motion.ProcessNoise(std[:, :3], std[:, 3:])  # pyrefly: ignore[bad-argument-type]
    tags = np.stack([filter.tags for filter in filters])
    return dataclasses.replace(first, process=process, tags=tags)


def _readings(trials: list[Trial]) -> Iterator[Reading]:
    """Yield the epochs of all trials, arrays (B, ...)."""
    logs = [trial.recording for trial in trials]
    times = logs[0].times
    ranges, links = np.stack([log.ranges for log in logs]), np.stack([log.links for log in logs])
    anchors = np.stack([log.anchors_by_epoch for log in logs])
    std = np.stack([std_of(*trial) for trial in trials])
    for k, dt in enumerate(np.diff(times, prepend=times[0])):
        yield Reading(
            np.ascontiguousarray(ranges[:, k]),
            np.ascontiguousarray(anchors[:, k]),
            np.ascontiguousarray(links[:, k]),
            LinkNoise(np.where(links[:, k], std[:, k], 1.0)),
            np.zeros(6) if dt > 0 else None,
            dt,
            **sensed(logs[0], trials[0].settings, times[k] - dt, times[k]),
        )


def std_of(recording: Recording, settings: Settings) -> FloatArray:
    """Return the standard deviations (K, M, N) of the ranges."""
    own = own_std(recording, settings)
    if own is not None:
        return own
    std = settings.range_std_m or DEFAULT_RANGE_STD_M
    return np.broadcast_to(np.float64(std), recording.ranges.shape)
