"""Recordings with their tracks as frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import PoseBelief
from rbl_gym.recordings import Recording
from rbl_gym.studies import replay
from rbl_gym.studies.replay import Reference, Settings, Track, TrackErrors
from rbl_gym.studies.watching.frames import Frame, Links, Named, Pose, Tracked

__all__ = ["recorded_frames", "track_all"]


def track_all(
    recording: Recording, filters: tuple[Named, ...], settings: Settings
) -> dict[str, Track]:
    """Return tracks of a recording by several filters, by label.

    Parameters
    ----------
    recording, settings
        Arguments as in `replay.track_recording`.
    filters
        Filters of `filter_named`. Each replaces the filter of the settings.

    Raises
    ------
    ValueError
        As in `replay.check_replay`.
    """
    tracks = {}
    for one in filters:
        own = settings.changed(filter=one.name, filter_options=one.options)
        tracks[one.label] = replay.track_recording(recording, replay.check_replay(recording, own))
    return tracks


def recorded_frames(
    recording: Recording, tracks: Mapping[str, Track], settings: Settings | None = None
) -> Iterator[Frame]:
    """Yield one frame per epoch of a recording, with its tracks by label.

    Parameters
    ----------
    recording
        A recording of `rbl_gym.recordings`.
    tracks
        Tracks of `track_all` or `replay.track_recording`, at the recording's epochs.
    settings
        Settings of the comparison with the truth; None: the defaults.

    Raises
    ------
    ValueError
        If there is no track, or the epochs of one differ from the recording's; before the first
        frame.
    """
    if not tracks:
        raise ValueError("tracks must hold a track, got none")
    for label, track in tracks.items():
        if len(track.times) != len(recording.times):
            raise ValueError(
                f"track {label!r} must have the {len(recording.times)} epochs of the recording, "
                f"got {len(track.times)}"
            )
    settings = Settings() if settings is None else settings
    first = next(iter(tracks.values()))
    truth = replay.truth_of(recording, first, settings)
    errors = {
        label: replay.track_errors(recording, track, settings) for label, track in tracks.items()
    }
    return _frames(recording, tracks, truth, errors)


def _frames(
    recording: Recording,
    tracks: Mapping[str, Track],
    truth: Reference | None,
    errors: Mapping[str, TrackErrors | None],
) -> Iterator[Frame]:
    anchors = recording.anchors_by_epoch
    nowhere = np.zeros(recording.links.shape[1:], np.bool_)
    for k, time in enumerate(recording.times - recording.times[0]):
        links = Links(recording.links[k], nowhere, nowhere)
        found = tuple(
            _tracked(label, track, errors[label], k, recording.links[k])
            for label, track in tracks.items()
        )
        yield Frame(float(time), _pose(truth, k), anchors[k], anchors[k], links, found)


def _pose(truth: Reference | None, k: int) -> Pose | None:
    if truth is None or not truth.known[k]:
        return None
    rotation: FloatArray | None = None if truth.rotation is None else truth.rotation[k]
    return Pose(rotation, truth.translation[k])


def _tracked(
    label: str, track: Track, errors: TrackErrors | None, k: int, links: BoolArray
) -> Tracked:
    pose = track.rotation[k], track.translation[k]
    position, turn, nees = np.nan, np.nan, np.nan
    if errors is not None and errors.known[k]:
        position, nees = errors.position[k], errors.nees[k]
        angle = errors.yaw if errors.rotation is None else errors.rotation
        turn = np.nan if angle is None else np.rad2deg(abs(angle[k]))
    rejected, nis, dof = np.zeros(links.shape, np.bool_), np.nan, 0
    if track.innovations is not None:
        told = track.innovations
        rejected, nis, dof = links & ~told.used[k], told.nis[k], int(told.dof[k])
    belief = PoseBelief(*pose, track.covariance[k], pose[0])
    return Tracked(label, belief, rejected, float(position), float(turn), float(nees), nis, dof)
