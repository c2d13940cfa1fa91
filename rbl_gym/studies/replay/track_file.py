"""Prepare a replayed track for writing to a file."""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.measurements import ranging
from rbl_gym.recordings.recording import Recording
from rbl_gym.recordings.writing import TrackFile
from rbl_gym.studies.replay.tracking import Track

__all__ = ["epoch_ranks", "track_file"]

# Number of epochs whose Jacobians are in memory at a time.
_CHUNK = 2048


def track_file(recording: Recording, track: Track) -> TrackFile:
    """Return the track of a recording with covariance, NIS and rank, for `write_track`."""
    found = track.innovations
    nis, dof = (None, None) if found is None else (found.nis, found.dof.astype(np.int64))
    rank = epoch_ranks(recording, track)
    return TrackFile(*track[:4], nis, dof, rank)


def epoch_ranks(recording: Recording, track: Track) -> np.ndarray:
    """Return how many of the six pose directions the ranges of each epoch determine, (K,).

    It is the rank of their Fisher information at the estimated pose. For a rank below six, the
    belief in the other directions comes from other epochs, the motion or the prior.
    """
    anchors = recording.anchors_by_epoch
    noise = ranging.RangeNoise(1.0)
    ranks = []
    for start in range(0, len(track.times), _CHUNK):
        part = slice(start, start + _CHUNK)
        information = bounds.range_information(
            anchors[part], recording.tags, track.rotation[part], track.translation[part], noise,
            recording.links[part],
        )  # fmt: skip
        ranks.append(bounds.information_rank(information))
    return np.concatenate(ranks).astype(np.int64)
