"""Fixed-interval smoother: estimate the most likely track of a whole log."""

from rbl_gym.estimators.smoothing.equations import Factor, LogState, Rows
from rbl_gym.estimators.smoothing.knowledge import Level
from rbl_gym.estimators.smoothing.motion import KnownTwist, Motion, UnknownTwist
from rbl_gym.estimators.smoothing.odometry import OdometryMotion, padded
from rbl_gym.estimators.smoothing.smoother import LogModel, RangeLog, Smoothed, smooth
from rbl_gym.estimators.smoothing.starts import causal_track

__all__ = [
    "Factor",
    "KnownTwist",
    "Level",
    "LogModel",
    "LogState",
    "Motion",
    "OdometryMotion",
    "RangeLog",
    "Rows",
    "Smoothed",
    "UnknownTwist",
    "causal_track",
    "padded",
    "smooth",
]
