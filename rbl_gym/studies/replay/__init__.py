"""Replay a recording through a filter: track, mirror pose, errors relative to the truth, hints."""

from rbl_gym.studies.replay.causes import Cause, likely_causes
from rbl_gym.studies.replay.clocks import CLOCK_TRIALS, SensorClock, sensor_clock
from rbl_gym.studies.replay.consistency import contradicts, nis_curve, residual_tables
from rbl_gym.studies.replay.figures import track_figures
from rbl_gym.studies.replay.inertial import covered
from rbl_gym.studies.replay.judging import (
    Reference,
    TrackErrors,
    find_offset,
    track_errors,
    truth_of,
    truth_path,
)
from rbl_gym.studies.replay.mirror import Mirror, covering, other_pose
from rbl_gym.studies.replay.overlap import check_overlap
from rbl_gym.studies.replay.place import height_offset, origin_of, volume_of
from rbl_gym.studies.replay.runs import ReplayedRuns, replay_runs
from rbl_gym.studies.replay.sensors import Inertial, Odometry
from rbl_gym.studies.replay.settings import (
    DEFAULT_RANGE_STD_M,
    Biases,
    Comparison,
    Knowledge,
    Loss,
    Motion,
    Settings,
    Smoothing,
)
from rbl_gym.studies.replay.smoothing import SmoothedRecording, smooth_recording
from rbl_gym.studies.replay.study import Replayed, check_replay, replay_recording
from rbl_gym.studies.replay.track_file import epoch_ranks, track_file
from rbl_gym.studies.replay.tracking import (
    Track,
    named_filter,
    range_std_of,
    recording_filter,
    recording_steps,
    track_recording,
)
from rbl_gym.studies.replay.tuning import TUNING_ROUNDS, Tuned, tune

__all__ = [
    "CLOCK_TRIALS",
    "DEFAULT_RANGE_STD_M",
    "TUNING_ROUNDS",
    "Biases",
    "Cause",
    "Comparison",
    "Inertial",
    "Knowledge",
    "Loss",
    "Mirror",
    "Motion",
    "Odometry",
    "Reference",
    "Replayed",
    "ReplayedRuns",
    "SensorClock",
    "Settings",
    "SmoothedRecording",
    "Smoothing",
    "Track",
    "TrackErrors",
    "Tuned",
    "check_overlap",
    "check_replay",
    "contradicts",
    "covered",
    "covering",
    "epoch_ranks",
    "find_offset",
    "height_offset",
    "likely_causes",
    "named_filter",
    "nis_curve",
    "origin_of",
    "other_pose",
    "range_std_of",
    "recording_filter",
    "recording_steps",
    "replay_recording",
    "replay_runs",
    "residual_tables",
    "sensor_clock",
    "smooth_recording",
    "track_errors",
    "track_figures",
    "track_file",
    "track_recording",
    "truth_of",
    "truth_path",
    "tune",
    "volume_of",
]
