"""Errors of a replayed recording against its truth, its figures, and what is to be said."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import metrics
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.mirror import DECIDED, is_outside
from rbl_gym.studies.replay.place import volume_of
from rbl_gym.studies.replay.settings import Settings
from rbl_gym.studies.replay.tracking import Track, range_std_of
from rbl_gym.studies.replay.truth import (
    Judged,
    check_overlap,
    fault_hints,
    judged_of,
    matched,
    stamp_hints,
)

__all__ = [
    "TrackErrors",
    "track_errors",
    "track_figures",
    "truth_of",
]

# The mirror pose is the one meant where its mean square error is below this share of the track's.
_NEARER = 0.25


class TrackErrors(NamedTuple):
    """Errors where truth exists: mask (K,), distance (m), yaw (rad), rotation angle (rad), NEES.

    `tags`: root mean square over the tags (m).
    """

    known: np.ndarray
    position: FloatArray
    yaw: FloatArray
    rotation: FloatArray
    nees: FloatArray
    tags: FloatArray


def truth_of(
    recording: Recording, track: Track, settings: Settings
) -> tuple[FloatArray, FloatArray, np.ndarray] | None:
    """What the estimates are judged by: rotation (K, 3, 3), translation (K, 3), known (K,).

    The recording's truth (`truth.matched`), turned by the offset; planar: its heading alone.
    """
    if recording.truth is None:
        return None
    gap_s = settings.comparison.truth_gap_s
    check_overlap(recording.truth, track.times, gap_s)
    rotation, translation, known = matched(recording.truth, *track[:3], gap_s)
    return _as_judged(rotation, settings), translation, known


def _as_judged(rotation: FloatArray, settings: Settings) -> FloatArray:
    """Rotations (K, 3, 3) of the truth, turned by the offset; planar: their headings."""
    offset = rotations.exp([0.0, 0.0, math.radians(settings.comparison.yaw_offset_deg)])
    if settings.knowledge.planar:
        heading = np.zeros((len(rotation), 3))
        heading[:, 2] = rotations.yaw(rotation)
        rotation = rotations.exp(heading)
    return offset @ rotation


def track_errors(recording: Recording, track: Track, settings: Settings) -> TrackErrors | None:
    """Errors against the recording's truth, interpolated; None without truth.

    Planar: position in x and y, NEES of (yaw, x, y); the truth's roll and pitch are not read.
    """
    truth = truth_of(recording, track, settings)
    if truth is None:
        return None
    expected, translation, known = truth
    error = metrics.pose_error(track.rotation, track.translation, expected, translation)
    axes = [2, 3, 4] if settings.knowledge.planar else list(range(6))
    block = track.covariance[:, axes][:, :, axes]
    turn = rotations.yaw(track.rotation) - rotations.yaw(expected)
    place = translation.copy()
    if settings.knowledge.planar:
        place[:, 2] = track.translation[:, 2]
    return TrackErrors(
        known,
        np.linalg.norm(error[:, 3 : 5 if settings.knowledge.planar else 6], axis=-1),
        (turn + np.pi) % (2 * np.pi) - np.pi,
        np.linalg.norm(error[:, :3], axis=-1),
        metrics.nees(error[:, axes], block),
        metrics.tag_error(track.rotation, track.translation, expected, place, recording.tags),
    )


def track_figures(
    recording: Recording, track: Track, found: TrackErrors | None, settings: Settings
) -> dict[str, Any]:
    """The figures of a run as plain numbers.

    Parameters
    ----------
    recording, track, settings
        What was filtered, what came out, and how.
    found
        Of `track_errors`; None: figures of errors are absent.
    """
    result: dict[str, Any] = {
        "settings": {
            **settings.flat(),
            "range_std_m": range_std_of(recording, settings),
        },
        "epochs": len(track.times),
        "duration_s": float(track.times[-1] - track.times[0]),
        "links": int(recording.links.sum()),
    }
    result |= _notes(recording, track, found, settings)
    if found is None:
        return result
    known = found.known
    result["epochs_with_truth"] = int(known.sum())
    result["position_axes"] = "xy" if settings.knowledge.planar else "xyz"
    yaw = np.rad2deg(found.yaw[known])
    rotation = np.rad2deg(found.rotation[known])
    for name, values in (
        ("position_{}_m", found.position[known]),
        ("yaw_{}_deg", yaw),
        ("rotation_{}_deg", rotation),
    ):
        result[name.format("rmse")] = float(np.sqrt(np.mean(values**2)))
        result[name.format("median")] = float(np.median(np.abs(values)))
        result[name.format("p95")] = float(np.quantile(np.abs(values), 0.95))
    result["yaw_mean_deg"] = float(yaw.mean())
    result["anees"] = float(found.nees[known].mean() / (3 if settings.knowledge.planar else 6))
    return result


def _notes(
    recording: Recording, track: Track, found: TrackErrors | None, settings: Settings
) -> dict[str, Any]:
    """The mirror pose, and what a reader is to be warned of, a sentence each."""
    result: dict[str, Any] = {}
    notes = [f"Note: {hint}." for hint in stamp_hints(track.times, recording.truth)]
    count = len(track.times)
    if track.other is not None and np.isfinite(track.other.log_odds[-1]):
        alive = track.other.alive
        apart = np.linalg.norm(track.other.translation - track.translation, axis=-1)
        result["mirror"] = {
            "epochs": int(alive.sum()),
            "distance_m": float(np.median(apart[alive])),
            "log_odds": float(track.other.log_odds[alive][-1]),
        }
        notes.append(_mirror_note(result["mirror"], count))
    volume = volume_of(recording, settings)
    if volume is not None:
        outside = int(is_outside(volume, track.translation, track.covariance).sum())
        result["epochs_outside_volume"] = outside
        if outside:
            notes.append(f"Note: the track is outside the volume in {outside} of {count} epochs.")
    if found is not None:
        nearer = _nearer(recording, track, found, settings)
        if nearer is not track:
            notes.append("Note: the truth is at the mirror pose.")
        notes += [f"Note: {hint}." for hint in _fault_hints(recording, nearer, settings)]
    return {**result, "notes": notes}


def _nearer(recording: Recording, track: Track, found: TrackErrors, settings: Settings) -> Track:
    """The track, or that of the mirror pose where both are alive and the truth is at that one."""
    if track.other is None:
        return track
    image = Track(track.times, *track.other[:3])
    off = track_errors(recording, image, settings)
    assert off is not None
    where = found.known & track.other.alive
    far, near = (np.square(e.position[where]).sum() for e in (found, off))
    return image if near < _NEARER * far else track


def _mirror_note(found: dict[str, Any], count: int) -> str:
    as_well = "better" if found["log_odds"] > DECIDED else "as well"
    return (
        f"WARNING: a mirror pose behind the anchors' plane, {found['distance_m']:.2f} m away, "
        f"explains the ranges {as_well} in {found['epochs']} of {count} epochs. The belief covers "
        "both. Say where the body is: --below-anchors or --volume."
    )


def _fault_hints(recording: Recording, track: Track, settings: Settings) -> list[str]:
    truth = recording.truth
    assert truth is not None

    def at(late_s: float) -> Judged:
        moved = truth._replace(times=truth.times - late_s)
        there = matched(moved, *track[:3], settings.comparison.truth_gap_s)
        return judged_of(there, track, settings.knowledge.planar)

    return fault_hints(
        at, lambda rotation: _as_judged(rotation, settings), settings.knowledge.planar
    )
