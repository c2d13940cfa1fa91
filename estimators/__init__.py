"""Estimators of poses: functions from arrays to beliefs, independent of the environments.

``make(name, tags=..., noise=..., process=...)`` returns a filter. Another name gives
another filter with the same interface.
"""

from importlib import import_module
from pkgutil import walk_packages

from rbl_gym.estimators.asynchronous import Asynchronous, Stream
from rbl_gym.estimators.bank.bank import IteratedEkfBank
from rbl_gym.estimators.bank.hypotheses import BankState
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.estimators.filter import (
    ENTRY_POINT_GROUP,
    Filter,
    PoseBelief,
    make,
    names,
    parse_filter,
    register,
)
from rbl_gym.estimators.iekf.augmented import AugmentedEkf, AugmentedState
from rbl_gym.estimators.iekf.doa_filter import DoaEkf
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.innovation import Innovations, innovations
from rbl_gym.estimators.level import hold_level
from rbl_gym.estimators.linear.kalman import KalmanFamily, KalmanState
from rbl_gym.estimators.locating.doa import locate_doa
from rbl_gym.estimators.locating.localization import PoseEstimate, locate, methods
from rbl_gym.estimators.looped import one_by_one
from rbl_gym.estimators.networks.consensus import (
    CycleExchange,
    cycle_consensus,
    cycle_iteration,
    cycle_projection,
    ring_least_squares,
)
from rbl_gym.estimators.networks.frames import FrameEstimate, frames
from rbl_gym.estimators.networks.orientations import chordal_optimum, orientations
from rbl_gym.estimators.networks.triangle import TriangleFrames, triangle_frames
from rbl_gym.estimators.smoothing.smoother import smooth

# Every module registers its filters by `register` at its end; there is no central list.
for _module in walk_packages(__path__, f"{__name__}."):
    import_module(_module.name)

__all__ = [
    "ENTRY_POINT_GROUP",
    "Asynchronous",
    "AugmentedEkf",
    "AugmentedState",
    "BankState",
    "CycleExchange",
    "DoaEkf",
    "Filter",
    "FrameEstimate",
    "Innovations",
    "IteratedEkf",
    "IteratedEkfBank",
    "KalmanFamily",
    "KalmanState",
    "PoseBelief",
    "PoseEstimate",
    "PoseState",
    "Stream",
    "TriangleFrames",
    "chordal_optimum",
    "cycle_consensus",
    "cycle_iteration",
    "cycle_projection",
    "frames",
    "hold_level",
    "innovations",
    "locate",
    "locate_doa",
    "make",
    "methods",
    "names",
    "one_by_one",
    "orientations",
    "parse_filter",
    "register",
    "ring_least_squares",
    "smooth",
    "triangle_frames",
]
