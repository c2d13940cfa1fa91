"""Compare a track with the truth, converted to the clock and frame of the ranges."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rbl_gym import metrics
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.recordings import TimeOffset, motion_offset
from rbl_gym.recordings.align import Alignment, align_positions, apply_alignment
from rbl_gym.recordings.recording import Recording
from rbl_gym.recordings.truth import Truth
from rbl_gym.studies.replay.centre import is_line
from rbl_gym.studies.replay.overlap import check_overlap
from rbl_gym.studies.replay.settings import Settings
from rbl_gym.studies.replay.tracking import Track
from rbl_gym.studies.replay.truth import matched

__all__ = ["Reference", "TrackErrors", "find_offset", "track_errors", "truth_of", "truth_path"]

# Clock offsets to try if ranges and truth already overlap in time (s).
_SEARCH_S = 10.0
# Beliefs with a standard deviation above this multiple of the median are not used.
_WIDE = 5.0


class Reference(NamedTuple):
    """The reference for the estimates of K epochs.

    Attributes
    ----------
    rotation
        (K, 3, 3); None: only positions are known.
    translation
        (K, 3).
    known
        Epochs (K,) with a reference.
    planar
        Height, roll and pitch are not compared.
    alignment
        The transform from the world frame of the truth to that of the anchors.
    excluded
        Number of epochs with truth that were excluded by the settings.
    """

    rotation: FloatArray | None
    translation: FloatArray
    known: BoolArray
    planar: bool
    alignment: Alignment
    excluded: int

    @property
    def turn_axes(self) -> list[int]:
        """Return the compared rotation components of the pose error (w, v)."""
        return [] if self.rotation is None else [2] if self.planar else [0, 1, 2]

    @property
    def place_axes(self) -> list[int]:
        """Return the compared position components."""
        return [3, 4] if self.planar else [3, 4, 5]

    def rotation_or(self, rotation: FloatArray) -> FloatArray:
        """Return the rotation (K, 3, 3), or this one if it is unknown."""
        return rotation if self.rotation is None else self.rotation


class TrackErrors(NamedTuple):
    """Errors of K epochs with truth.

    Attributes
    ----------
    known
        Epochs (K,) with truth.
    position
        Distance (K,), metres.
    yaw, rotation
        Radians (K,); None if unknown.
    nees
        (K,), of the `freedom` compared components.
    tags
        Root mean square (K,) over the tags, metres; None if unknown.
    freedom
        Number of compared components of the pose, at most six.
    centre, axis
        Distance (K,) of the tag centre, metres, and angle (K,) of the tag line, radians, for
        collinear tags, for which ranges determine no more. None for other bodies; the angle is
        also None for a single tag.
    reference
        The truth at the epochs of the track; None for several runs together.
    """

    known: BoolArray
    position: FloatArray
    yaw: FloatArray | None
    rotation: FloatArray | None
    nees: FloatArray
    tags: FloatArray | None
    freedom: int
    centre: FloatArray | None = None
    axis: FloatArray | None = None
    reference: Reference | None = None


def find_offset(recording: Recording, track: Track, settings: Settings) -> TimeOffset | None:
    """Estimate from the motion how far the clock of the truth is ahead; None: no truth.

    It is relative to the clock of the ranges. Excluded windows and uncertain beliefs are not used.

    Raises
    ------
    ValueError
        If the motion does not determine it.
    """
    truth = recording.truth
    if truth is None:
        return None
    size = np.trace(track.covariance[:, 3:, 3:], axis1=1, axis2=2)
    used = ~excluded_epochs(track.times, settings) & (size <= _WIDE**2 * np.median(size))
    share = truth.times[0] < track.times[-1] and track.times[0] < truth.times[-1]
    try:
        return motion_offset(
            (track.times[used], track.rotation[used], track.translation[used]),
            truth[:3],
            _SEARCH_S if share else None,
            planar=_is_planar(truth, settings),
            one_frame=settings.comparison.align in ("none", "position"),
        )
    except ValueError as error:
        raise ValueError(
            f"time_offset 'auto': {error}; give it in seconds (--time-offset S)"
        ) from error


def in_clock(truth: Truth, settings: Settings) -> Truth:
    """Return the truth in the clock of the ranges; the settings give the offset in seconds."""
    offset = settings.comparison.time_offset
    return truth._replace(times=truth.times - float(offset)) if offset else truth


def truth_of(recording: Recording, track: Track, settings: Settings) -> Reference | None:
    """Return the reference for the estimates; None without truth.

    It is the truth of the recording in the clock of the ranges (`comparison.time_offset`), at the
    epochs of the track (`truth.matched`) without excluded ones, aligned, and rotated by the yaw
    offset. Planar: only its heading.

    Raises
    ------
    ValueError
        If no epoch has truth, or the matched positions do not determine the alignment.
    """
    if recording.truth is None:
        return None
    if settings.comparison.time_offset == "auto":
        settings = with_offset(settings, find_offset(recording, track, settings))
    truth, gap_s = in_clock(recording.truth, settings), settings.comparison.truth_gap_s
    check_overlap(truth, track.times, gap_s, float(settings.comparison.time_offset))
    rotation, translation, known = matched(truth, *track[:3], gap_s)
    planar = _is_planar(truth, settings)
    out = known & excluded_epochs(track.times, settings)
    known = known & ~out
    if not known.any():
        raise ValueError(
            f"truth_exclude must leave an epoch with truth, but excludes all {out.sum()} of them"
        )
    place = translation.copy()
    if planar:
        place[:, 2] = track.translation[:, 2]
    try:
        alignment = align_positions(place[known], track.translation[known], _mode(settings, planar))
    except ValueError as error:
        raise ValueError(f"align {settings.comparison.align!r}: {error}") from error
    turned = None if rotation is None else as_judged(rotation, settings, planar)
    turned, place = apply_alignment(alignment, turned, place)
    return Reference(turned, place, known, planar, alignment, int(out.sum()))


def truth_path(recording: Recording, track: Track, settings: Settings) -> FloatArray:
    """Return aligned positions (L, 3) of the truth at its own times during the track.

    Parameters
    ----------
    recording, track, settings
        As in `truth_of`; a recording without truth gives no positions.
    """
    found = truth_of(recording, track, settings)
    if recording.truth is None or found is None:
        return np.empty((0, 3))
    truth = in_clock(recording.truth, settings)
    during = (truth.times >= track.times[0]) & (truth.times <= track.times[-1])
    return apply_alignment(found.alignment, None, truth.translation[during])[1]


def with_offset(settings: Settings, found: TimeOffset | None) -> Settings:
    """Return the settings with an estimated offset."""
    return settings if found is None else settings.changed(time_offset=found.offset_s)


def _mode(settings: Settings, planar: bool) -> str:
    mode = settings.comparison.align
    if mode == "se3" and planar:
        raise ValueError("planar motion has no heights to align: use 'yaw'")
    return mode


def _is_planar(truth: Truth, settings: Settings) -> bool:
    return settings.knowledge.planar or truth.planar


def excluded_epochs(times: FloatArray, settings: Settings) -> BoolArray:
    """Return which epochs (K,) are in the excluded windows."""
    out = np.zeros(len(times), dtype=np.bool_)
    for start, end in settings.comparison.truth_exclude:
        out |= (times >= start) & (times <= end)
    return out


def as_judged(rotation: FloatArray, settings: Settings, planar: bool) -> FloatArray:
    """Return rotations (K, 3, 3) of the truth, rotated by the offset; planar: their headings."""
    offset = rotations.exp([0.0, 0.0, math.radians(settings.comparison.yaw_offset_deg)])
    if planar:
        heading = np.zeros((len(rotation), 3))
        heading[:, 2] = rotations.yaw(rotation)
        rotation = rotations.exp(heading)
    return offset @ rotation


def track_errors(recording: Recording, track: Track, settings: Settings) -> TrackErrors | None:
    """Return errors relative to the interpolated truth of the recording; None without truth.

    Planar, or if the truth has no height: position in x and y, NEES of (yaw, x, y); roll and pitch
    of the truth are not used. Truth without rotations: position only.
    """
    truth = truth_of(recording, track, settings)
    if truth is None:
        return None
    expected = truth.rotation_or(track.rotation)
    error = metrics.pose_error(track.rotation, track.translation, expected, truth.translation)
    axes = truth.turn_axes + truth.place_axes
    block = track.covariance[:, axes][:, :, axes]
    yaw = rotation = tags = centre = axis = None
    if truth.rotation is not None:
        turn = rotations.yaw(track.rotation) - rotations.yaw(expected)
        yaw = (turn + np.pi) % (2 * np.pi) - np.pi
        # A truth with only a heading has no roll and pitch.
        if settings.knowledge.planar or not truth.planar:
            rotation = np.linalg.norm(error[:, :3], axis=-1)
            tags = metrics.tag_error(
                track.rotation, track.translation, expected, truth.translation, recording.tags
            )
        if is_line(recording.tags):
            centre, axis = _line_errors(track, expected, truth, recording.tags)
    return TrackErrors(
        truth.known,
        np.linalg.norm(error[:, truth.place_axes], axis=-1),
        yaw,
        rotation,
        metrics.nees(error[:, axes], block),
        tags,
        len(axes),
        centre,
        axis,
        truth,
    )


def _line_errors(
    track: Track, expected: FloatArray, truth: Reference, tags: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """Return distance (K,) of the tag centre, and angle (K,) of the tag line; None for one tag."""
    middle = tags.mean(axis=0)
    off = track.translation + track.rotation @ middle - truth.translation - expected @ middle
    centre = np.linalg.norm(off[:, [axis - 3 for axis in truth.place_axes]], axis=-1)
    along = np.linalg.svd(tags - middle)[2][0]
    if len(tags) < 2:
        return centre, None
    lines = track.rotation @ along, expected @ along
    across = np.linalg.norm(np.cross(*lines), axis=-1)
    return centre, np.arctan2(across, np.einsum("ki,ki->k", *lines))
