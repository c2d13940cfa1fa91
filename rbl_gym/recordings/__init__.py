"""Recordings: real measurement logs as arrays."""

from rbl_gym.recordings.reading import Recording, read_recording
from rbl_gym.recordings.truth import Truth, truth_at

__all__ = [
    "Recording",
    "Truth",
    "read_recording",
    "truth_at",
]
