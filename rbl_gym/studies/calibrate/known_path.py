"""Use the truth of recordings as the known path of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.calibration import KnownPath, LinkModel, spread_of_residuals
from rbl_gym.estimators.calibration.clock import Clock, find_clock
from rbl_gym.estimators.calibration.link_equations import (
    ARM_M,
    TURN_RAD,
    axes_of,
    carried_tags,
    directions,
)
from rbl_gym.estimators.locating.rotation_net import ROTATION_NET
from rbl_gym.geometry import rotations
from rbl_gym.recordings import Truth, truth_at
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.calibrate.settings import LinkSettings
from rbl_gym.studies.frozen_truth import renewed

# Range of tested time shifts, seconds.
_SEARCH_S = 1.0
# Largest standard deviation of an accepted clock (s): if the tags are known, and if their moves are
# estimated with it.
_CLOCK_STD_S, _WITH_TAGS_STD_S = 0.05, 0.2
# Number of epochs for coarse starts.
_COARSE = 400
# Ratio of misfits below which a rotation is accepted.
_BETTER = 0.8


class Log(NamedTuple):
    """Concatenated runs with truth: K epochs of M anchors and N tags."""

    runs: tuple[Recording, ...]
    times: FloatArray  # (K,)
    ranges: FloatArray  # (K, M, N)
    links: BoolArray  # (K, M, N), False where there is no truth
    anchors: FloatArray  # (K, M, 3)
    tags: FloatArray  # (N, 3)


def log_of(recordings: Mapping[str, Recording], settings: LinkSettings) -> Log:
    """Check the runs and return them as one log.

    ValueError if runs differ in anchors or tags, or have no usable truth.
    """
    if not recordings:
        raise ValueError("recordings must hold a run, got none")
    first = next(iter(recordings.values()))
    for name, run in recordings.items():
        label = f"run {name!r}: " if name else ""
        if run.anchor_ids != first.anchor_ids or run.tag_ids != first.tag_ids:
            raise ValueError(
                f"{label}all runs must have the anchors and tags of the first, "
                f"{next(iter(recordings))!r}"
            )
        if run.truth is None:
            raise ValueError(f"{label}the recording must have truth to calibrate links, has none")
        if run.truth.rotation is None and (len(run.tags) > 1 or run.tags.any()):
            raise ValueError(
                f"{label}the truth must have rotations if tags are off the body's origin, got "
                "only positions"
            )
        if run.truth.planar and not settings.planar:
            raise ValueError(f"{label}the truth has no heights: set planar")
        if run.truth.planar and settings.height_offset_m is None and settings.height_m is None:
            heights = run.anchors[..., 2]
            if np.ptp(heights) > 0.1:
                raise ValueError(
                    f"{label}height_m or height_offset_m must be given: the truth has no "
                    f"heights, and the anchors are at heights of "
                    f"{heights.min():g} to {heights.max():g} m"
                )
    runs = tuple(
        run._replace(truth=_without_repeats(run.truth, settings.truth_gap_s))
        for run in recordings.values()
        if run.truth is not None
    )
    times = np.concatenate([run.times for run in runs])
    out = np.zeros(len(times), dtype=bool)
    for start, end in settings.truth_exclude:
        out |= (times >= start) & (times <= end)
    return Log(
        runs,
        times,
        np.concatenate([run.ranges for run in runs]),
        np.concatenate([run.links for run in runs]) & ~out[:, None, None],
        np.concatenate([run.anchors_by_epoch for run in runs]),
        first.tags,
    )


def _without_repeats(truth: Truth, longest_s: float) -> Truth:
    """Return the truth without the repeats of poses that stay the same for at most `longest_s`.

    A tracker that loses its markers may repeat its last pose. The body moves on, so the poses
    between are interpolated. If the body rests, this changes little.
    """
    new = renewed(truth)
    since = truth.times[new]
    lasts_s = np.append(np.diff(since), np.inf)[np.cumsum(new) - 1]
    kept = new | (lasts_s > longest_s)
    rotation = None if truth.rotation is None else truth.rotation[kept]
    return truth._replace(
        times=truth.times[kept], rotation=rotation, translation=truth.translation[kept]
    )


def path_at(log: Log, settings: LinkSettings, shift: float) -> tuple[KnownPath, BoolArray]:
    """Return the path at the times of the ranges, for a clock offset of the truth, and its mask."""
    runs = [_run_at(run, log.tags, settings, shift) for run in log.runs]
    rotation, translation, known = (np.concatenate(parts) for parts in zip(*runs, strict=True))
    return KnownPath(log.times, rotation, translation), known


def _run_at(
    run: Recording, tags: FloatArray, settings: LinkSettings, shift: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return rotation, translation and mask of one run, for `path_at`."""
    truth, times = run.truth, run.times + shift
    assert truth is not None
    rotation, translation, known = truth_at(truth, times, settings.truth_gap_s)
    if _rests(truth):
        # A body at rest is also at rest in gaps of its truth, and shortly before and after.
        known = (times >= truth.times[0] - _SEARCH_S) & (times <= truth.times[-1] + _SEARCH_S)
    if rotation is None:
        rotation = np.broadcast_to(np.eye(3), (len(times), 3, 3))
    if settings.planar:
        rotation = rotations.exp(rotations.yaw(rotation)[:, None] * np.array([0.0, 0.0, 1.0]))
    if truth.planar:
        height = settings.height_m
        if height is None:
            below = (settings.height_offset_m or 0.0) + tags[:, 2].mean()
            height = run.anchors_by_epoch[..., 2].mean(axis=-1) - below
        translation = translation.copy()
        translation[:, 2] = height
    return rotation, translation, known


def _rests(truth: Truth) -> bool:
    """Return whether the pose of the truth never changes."""
    moved = np.ptp(truth.translation, axis=0).any()
    turned = truth.rotation is not None and np.ptp(truth.rotation, axis=0).any()
    return bool(truth.times[-1] > truth.times[0] and not moved and not turned)


def first_turn(log: Log, settings: LinkSettings, shift: float) -> FloatArray:
    """Return a coarse rotation (3, 3) of the tag table that fits the path.

    It is the identity unless another rotation fits clearly better.
    """
    if len(log.tags) == 1 and not log.tags.any():
        return np.eye(3)
    path, known = path_at(log, settings, shift)
    at = np.flatnonzero(known & log.links.any(axis=(1, 2)))
    if not len(at):
        return np.eye(3)
    at = at[:: max(1, len(at) // _COARSE)]
    few = KnownPath(*(a[at] for a in path))

    def misfit(turn: FloatArray) -> float:
        places = carried_tags(few, log.tags @ turn.T)
        return spread_of_residuals(log.ranges[at], log.links[at], log.anchors[at], places)

    if settings.planar:
        turns = rotations.exp(np.linspace(0, 2 * np.pi, 24, False)[:, None] * [0.0, 0.0, 1.0])
    else:
        turns = ROTATION_NET
    found = [misfit(turn) for turn in turns]
    best = int(np.argmin(found))
    return turns[best] if found[best] < _BETTER * found[0] else np.eye(3)


def clock_of(
    log: Log, settings: LinkSettings, tags: FloatArray, model: LinkModel | None = None
) -> Clock | None:
    """Estimate how far the clock of the truth is ahead, from ranges; None if undetermined.

    `tags` (N, 3) in the body frame of the truth. With a `model` whose tags are not held, their
    turn and shift are unknown, and the clock may be less certain.
    """

    def distances(shift: float) -> tuple[FloatArray, BoolArray]:
        path, known = path_at(log, settings, shift)
        return directions(log.anchors, carried_tags(path, tags))[1], known

    def moves(shift: float) -> FloatArray:
        path = path_at(log, settings, shift)[0]
        away = directions(log.anchors, carried_tags(path, tags))[0]
        away = np.einsum("kmni,kij->kmnj", away, path.rotation)
        turn_axes, move_axes = axes_of(model or LinkModel())
        turned = TURN_RAD * np.cross(tags, away)[..., turn_axes]
        return np.concatenate([turned, ARM_M * away[..., move_axes]], axis=-1)

    free = model is not None and model.tags != "held"
    search = log.times, log.ranges, log.links, distances, _SEARCH_S
    found = find_clock(*search, moves if free else None)
    most = _WITH_TAGS_STD_S if free else _CLOCK_STD_S
    return found if found is not None and found.std_s <= most else None
