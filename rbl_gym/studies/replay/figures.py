"""Compute the figures of a replayed recording, its errors against the truth, and its notes."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.recordings import apply_alignment
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.frozen_truth import frozen_notes
from rbl_gym.studies.replay.centre import is_line
from rbl_gym.studies.replay.diagnosis import WIDE
from rbl_gym.studies.replay.judging import (
    TrackErrors,
    as_judged,
    excluded_epochs,
    in_clock,
    track_errors,
)
from rbl_gym.studies.replay.mirror import DECIDED, is_outside
from rbl_gym.studies.replay.observed import known_figures
from rbl_gym.studies.replay.overlap import stamp_hints
from rbl_gym.studies.replay.place import volume_of
from rbl_gym.studies.replay.settings import Settings
from rbl_gym.studies.replay.smoothing import SmoothedRecording
from rbl_gym.studies.replay.tracking import Track, range_std_of
from rbl_gym.studies.replay.truth import (
    MIRROR_IMAGE,
    Judged,
    fault_hints,
    judged_of,
    matched,
)

__all__ = ["track_figures"]

# The truth is at the mirror pose if its mean square error is below this share of the track's.
_NEARER = 0.25
# Epochs further apart than this (s), and than this multiple of the median, leave a gap.
_GAP_S, _GAP_STEPS = 1.0, 5.0
# A mirror pose that was possible for less than this (s) is not reported.
_WHILE_S = 1.0
# A smoothed track with a NIS or a NEES per degree of freedom below these has a large covariance.
_WIDE_NIS, _WIDE_NEES = 0.5, 0.4
# Above this NEES per degree of freedom its covariance is too small, whatever its NIS.
_NARROW_NEES = 1.5
# Number of epochs that is sufficient to find a fault of the truth.
_ENOUGH = 1000


def track_figures(
    recording: Recording, track: Track, found: TrackErrors | None, settings: Settings
) -> dict[str, Any]:
    """Return the figures of a run as plain numbers.

    Parameters
    ----------
    recording, track, settings
        The recording, its track, and the settings.
    found
        Result of `track_errors`; None: without figures of errors.
    """
    result: dict[str, Any] = {
        "settings": {**settings.flat(), "range_std_m": range_std_of(recording, settings)},
        "epochs": len(track.times),
        "duration_s": float(track.times[-1] - track.times[0]),
        "links": int(recording.links.sum()),
        "gaps": _gaps(track.times),
    }
    result |= _notes(recording, track, found, settings)
    result |= _with_reading(recording, result["notes"])
    if found is None:
        return result
    result["epochs_with_truth"] = int(found.known.sum())
    return {**result, **_comparison(recording, found, settings), **error_figures(found)}


def smoothed_figures(smoothed: SmoothedRecording, found: TrackErrors | None) -> dict[str, Any]:
    """Return the figures of a smoothed track, and of its errors if there are any."""
    fit = smoothed.found
    return {
        "seconds": smoothed.seconds,
        "converged": bool(fit.converged),
        "nis": float(fit.squares.sum() / fit.freedom.sum()),
        "mean_bias_m": fit.biases.mean(axis=0).tolist(),
    } | ({} if found is None else error_figures(found))


def wide_note(smoothed: dict[str, Any], settings: dict[str, Any]) -> list[str]:
    """Return a note if the smoothed covariance is clearly larger than the errors of the log.

    If its NIS says so but its NEES says the opposite, the note is on the error that biases absorb.
    """
    nis, nees = smoothed["nis"], smoothed.get("anees", 1.0)
    if nis > _WIDE_NIS and nees > _WIDE_NEES:
        return []
    if "anees" in smoothed and WIDE < nees <= _NARROW_NEES:
        return []
    if nees > _NARROW_NEES:
        return [
            f"Note: the covariance of the smoothed track is too small (NEES per degree of freedom "
            f"{nees:.2f}, 1: consistent), although its NIS is small ({nis:.2f}): the estimated "
            "biases absorb an error that is not noise. Likely: an anchor or a tag at a wrong "
            "position, or an error of the truth. rbl-gym calibrate with the truth looks for it."
        ]
    of, names = "smooth", ("smooth_constant_m", "smooth_common_m", "smooth_bias_std_m")
    if settings["filter"] == "iekf-imu":
        of, names = "constant", ("constant_std_m", "constant_common_m", "drift_std_m")
    each, common, drift = (settings[name] for name in names)
    std = settings["range_std_m"]
    noise = "the recorded noise" if std == "recorded" else f"a noise of {std:g} m"
    seen = f"NEES per degree of freedom {nees:.2f}" if nees <= _WIDE_NEES else f"NIS {nis:.2f}"
    return [
        f"Note: the covariance of the smoothed track is too large for this log ({seen}, 1: "
        f"consistent). It is right for the assumed errors of the ranges: {noise}, and biases of "
        f"{each:g} m (each link), {common:g} m (common) and {drift:g} m (drifting). If your radios "
        f"are better, give --range-std-m and --{of}-..."
    ]


def error_figures(found: TrackErrors) -> dict[str, float]:
    """Return root mean squares, medians and 95 % quantiles of the errors, and the mean NEES."""
    known, result = found.known, {}
    for name, values in (
        ("position_{}_m", found.position),
        ("yaw_{}_deg", found.yaw),
        ("rotation_{}_deg", found.rotation),
        ("centre_{}_m", found.centre),
        ("axis_{}_deg", found.axis),
    ):
        if values is None:
            continue
        values = values[known] if name.endswith("m") else np.rad2deg(values[known])
        result[name.format("rmse")] = float(np.sqrt(np.mean(values**2)))
        result[name.format("median")] = float(np.median(np.abs(values)))
        result[name.format("p95")] = float(np.quantile(np.abs(values), 0.95))
    if found.yaw is not None:
        result["yaw_mean_deg"] = float(np.rad2deg(found.yaw[known]).mean())
    result["anees"] = float(found.nees[known].mean() / found.freedom)
    return result


def _comparison(recording: Recording, found: TrackErrors, settings: Settings) -> dict[str, Any]:
    """Return how track and truth were matched."""
    truth = found.reference
    assert truth is not None
    assert recording.truth is not None
    result: dict[str, Any] = {
        "position_axes": "xy" if truth.planar else "xyz",
        "truth_format": recording.truth.form,
    }
    if settings.comparison.truth_exclude:
        result["epochs_excluded"] = truth.excluded
    if settings.comparison.align != "none":
        result["alignment"] = {
            "mode": settings.comparison.align,
            "rotation_vector_deg": np.rad2deg(rotations.log(truth.alignment.rotation)).tolist(),
            "translation_m": truth.alignment.translation.tolist(),
            "turn_deg": float(np.rad2deg(truth.alignment.turn_rad)),
            "shift_m": truth.alignment.shift_m,
        }
    return result


def gaps_of(times: FloatArray) -> np.ndarray:
    """Return the indices of the last epochs before gaps without ranges."""
    steps = np.diff(times)
    shortest = max(_GAP_S, _GAP_STEPS * float(np.median(steps))) if len(steps) else _GAP_S
    return np.flatnonzero(steps > shortest)


def _gaps(times: FloatArray) -> dict[str, Any]:
    """Return the number of gaps without ranges, and length and start of the longest."""
    steps, gaps = np.diff(times), gaps_of(times)
    if not len(gaps):
        return {"count": 0, "longest_s": None, "longest_at_s": None}
    longest = gaps[steps[gaps].argmax()]
    return {
        "count": len(gaps),
        "longest_s": float(steps[longest]),
        "longest_at_s": float(times[longest]),
    }


def _gap_note(times: FloatArray) -> list[str]:
    gaps = _gaps(times)
    count = gaps["count"]
    if not count:
        return []
    what = "a gap without ranges; it" if count == 1 else f"{count} gaps without ranges; the longest"
    return [
        f"Note: the log has {what} lasts {gaps['longest_s']:.1f} s from "
        f"{gaps['longest_at_s'] - times[0]:.1f} s after the start."
    ]


def _with_reading(recording: Recording, notes: list[str]) -> dict[str, Any]:
    """Return the figures of reading the log; its notes come first."""
    report = recording.report
    return {
        "reading": {
            "ranges": report.ranges,
            "dropped": report.dropped,
            "sorted_rows": report.sorted_rows,
        },
        "notes": [
            *(note if note.startswith("WARNING") else f"Note: {note}" for note in report.notes),
            *notes,
        ],
    }


def _notes(
    recording: Recording, track: Track, found: TrackErrors | None, settings: Settings
) -> dict[str, Any]:
    """Return the figures of the mirror pose and of known directions, and notes for the reader."""
    result: dict[str, Any] = {}
    notes = [f"Note: {hint}." for hint in _stamp_hints(recording, track, settings)]
    notes += _gap_note(track.times)
    count = len(track.times)
    if track.other is not None and np.isfinite(track.other.log_odds[-1]):
        alive = track.other.alive
        apart = np.linalg.norm(track.other.translation - track.translation, axis=-1)
        result["mirror"] = {
            "epochs": int(alive.sum()),
            "distance_m": float(np.median(apart[alive])),
            "log_odds": float(track.other.log_odds[alive][-1]),
        }
        told = settings.knowledge.volume is not None or settings.knowledge.below_anchors
        notes.append(_mirror_note(result["mirror"], count, track, told))
    elif track.other is not None:
        notes += _past_mirror_note(track)
    known, unknown = known_figures(recording, track)
    result |= known
    # If there is a mirror pose, its own note is sufficient, except for an open turn.
    notes += unknown if "mirror" not in result or is_line(recording.tags) else []
    volume = volume_of(recording, settings)
    if volume is not None:
        outside = int(is_outside(volume, track.translation, track.covariance).sum())
        result["epochs_outside_volume"] = outside
        if outside:
            notes.append(f"Note: the track is outside the volume in {outside} of {count} epochs.")
    if found is not None:
        told = settings.comparison
        frozen = frozen_notes(recording, float(told.time_offset), told.truth_exclude)
        notes += [f"Note: {note}." for note in frozen]
        notes += _floor_note(recording, settings)
        if _truth_at_mirror(recording, track, found, settings):
            notes.append("Note: the truth is at the mirror pose.")
        else:
            for hint in _fault_hints(recording, track, found, settings):
                notes.append(f"{'WARNING' if hint.startswith(MIRROR_IMAGE) else 'Note'}: {hint}.")
    return {**result, "notes": notes}


def _floor_note(recording: Recording, settings: Settings) -> list[str]:
    """Return a hint at --planar if the truth is x, y and yaw, and no height or tilt is told."""
    known = settings.knowledge
    told = known.planar or known.height_std_m is not None or known.tilt_std_deg is not None
    truth = recording.truth
    if truth is None or truth.rotation is None or not truth.planar or told:
        return []
    return [
        "Note: the truth has no height. If the body drives on a floor, give --planar --height-m H, "
        "the height of its origin: positions become more accurate."
    ]


def _stamp_hints(recording: Recording, track: Track, settings: Settings) -> list[str]:
    # With a given or estimated time offset, the unit of the clock is right.
    truth = None if settings.comparison.time_offset else recording.truth
    return [*stamp_hints(track.times, truth)]


def _truth_at_mirror(
    recording: Recording, track: Track, found: TrackErrors, settings: Settings
) -> bool:
    """Return whether the mirror pose is possible, and much nearer to the truth than the track."""
    if track.other is None:
        return False
    image = Track(track.times, *track.other[:3])
    off = track_errors(recording, image, settings)
    assert off is not None
    where = found.known & track.other.alive
    far, near = (np.square(e.position[where]).sum() for e in (found, off))
    return bool(near < _NEARER * far)


def _mirror_note(found: dict[str, Any], count: int, track: Track, told: bool) -> str:
    assert track.other is not None
    as_well = "better" if found["log_odds"] > DECIDED else "as well"
    alive = track.other.alive
    here, there = (
        np.median(a[alive], axis=0) for a in (track.translation, track.other.translation)
    )
    axis = int(np.abs(there - here).argmax())
    name, limit = "xyz"[axis], f"{0.5 * (here[axis] + there[axis]):.2g}"
    either = " or ".join(
        f"at {name} = {place:.1f} m (--volume {name}={ends})"
        for place, ends in zip(
            sorted((here[axis], there[axis])), (f":{limit}", f"{limit}:"), strict=True
        )
    )
    given = "Both are inside what --volume or --below-anchors allows. " if told else ""
    return (
        f"WARNING: a mirror pose behind the anchors' plane, {found['distance_m']:.2f} m away, "
        f"explains the ranges {as_well} in {found['epochs']} of {count} epochs. The belief covers "
        f"both. {given}State where the body is: {either}."
    )


def _past_mirror_note(track: Track) -> list[str]:
    """Return a note if a mirror pose, excluded by now, was possible for a while."""
    assert track.other is not None
    alive = track.other.alive
    times = track.times - track.times[0]
    if np.diff(times, prepend=0.0)[alive].sum() < _WHILE_S:
        return []
    spread = np.sqrt(np.einsum("kii->ki", track.covariance[alive]))
    turn, place = np.rad2deg(spread[:, :3]).max(), spread[:, 3:].max()
    first, last = times[alive][[0, -1]]
    return [
        f"Note: from {first:.1f} to {last:.1f} s after the start, in {alive.sum()} epochs, a "
        "mirror pose explained the ranges as well. There the covariance covers both: its standard "
        f"deviations are up to {turn:.0f} deg and {place:.2f} m."
    ]


def _fault_hints(
    recording: Recording, track: Track, found: TrackErrors, settings: Settings
) -> list[str]:
    reference = found.reference
    assert reference is not None
    assert recording.truth is not None
    truth = in_clock(recording.truth, settings)
    aligned = truth._replace(
        translation=apply_alignment(reference.alignment, None, truth.translation)[1]
    )

    gap_s, counts = settings.comparison.truth_gap_s, ~excluded_epochs(track.times, settings)
    step = slice(None, None, _stride(track.times, gap_s))
    times, rotation, translation, covariance = (values[step].copy() for values in track[:4])
    some = Track(times, rotation, translation, covariance)

    def at(late_s: float, turned: bool) -> Judged:
        rotation = truth.rotation if turned else None
        moved = aligned._replace(times=truth.times - late_s, rotation=rotation)
        return judged_of(matched(moved, *some[:3], gap_s), some, reference.planar, counts[step])

    def seen(rotation: FloatArray) -> FloatArray:
        return reference.alignment.rotation @ as_judged(rotation, settings, reference.planar)

    told_s = float(settings.comparison.time_offset)
    return fault_hints(at, seen, reference.planar, told_s)


def _stride(times: FloatArray, gap_s: float) -> int:
    """Return the step between epochs that keeps enough of them, with gaps of at most `gap_s`."""
    near = gap_s / float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    return max(int(min(len(times) / _ENOUGH, near)), 1)
