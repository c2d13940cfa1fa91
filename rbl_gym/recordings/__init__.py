"""Recordings: real measurement logs as arrays."""

from rbl_gym.recordings.align import ALIGNMENTS, Alignment, align_positions, apply_alignment
from rbl_gym.recordings.bags import convert_bag, list_topics, show_message
from rbl_gym.recordings.directions import read_directions
from rbl_gym.recordings.format import Files, Format
from rbl_gym.recordings.inertial import InertialLog, read_frame, read_inertial, samples_between
from rbl_gym.recordings.motion_offset import motion_offset
from rbl_gym.recordings.odometry import OdometryLog, odometry_between, read_odometry
from rbl_gym.recordings.reading import read_recording, read_runs
from rbl_gym.recordings.recording import Recording
from rbl_gym.recordings.report import Report
from rbl_gym.recordings.time_offset import TimeOffset, time_offset
from rbl_gym.recordings.truth import Truth, read_truth, truth_at
from rbl_gym.recordings.writing import TrackFile, check_track_path, read_track, write_track

__all__ = [
    "ALIGNMENTS",
    "Alignment",
    "Files",
    "Format",
    "InertialLog",
    "OdometryLog",
    "Recording",
    "Report",
    "TimeOffset",
    "TrackFile",
    "Truth",
    "align_positions",
    "apply_alignment",
    "check_track_path",
    "convert_bag",
    "list_topics",
    "motion_offset",
    "odometry_between",
    "read_directions",
    "read_frame",
    "read_inertial",
    "read_odometry",
    "read_recording",
    "read_runs",
    "read_track",
    "read_truth",
    "samples_between",
    "show_message",
    "time_offset",
    "truth_at",
    "write_track",
]
