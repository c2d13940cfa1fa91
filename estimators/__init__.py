"""Estimators: arrays in, beliefs out; they know no environment.

``make(name, tags=..., noise=..., process=...)`` gives a filter; swapping one for another is a
change of name.
"""

from importlib import import_module
from pkgutil import iter_modules

from rbl_gym.estimators.asynchronous import Asynchronous, Stream
from rbl_gym.estimators.augmented import AugmentedEkf, AugmentedState
from rbl_gym.estimators.bank import IteratedEkfBank
from rbl_gym.estimators.belief import (
    ENTRY_POINT_GROUP,
    Filter,
    PoseBelief,
    make,
    names,
    register,
)
from rbl_gym.estimators.consensus import (
    cycle_consensus,
    cycle_iteration,
    cycle_projection,
    ring_least_squares,
)
from rbl_gym.estimators.doa import locate_doa
from rbl_gym.estimators.doa_filter import DoaEkf
from rbl_gym.estimators.hypotheses import BankState
from rbl_gym.estimators.kalman import KalmanFamily, KalmanState
from rbl_gym.estimators.localization import PoseEstimate, locate, methods
from rbl_gym.estimators.manifold import IteratedEkf, PoseState
from rbl_gym.estimators.network_frames import FrameEstimate, frames
from rbl_gym.estimators.network_orientations import chordal_optimum, orientations
from rbl_gym.estimators.network_triangle import TriangleFrames, triangle_frames

# A filter is known by the `register` at the end of its own module; no list names the modules.
for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = [
    "ENTRY_POINT_GROUP",
    "Asynchronous",
    "AugmentedEkf",
    "AugmentedState",
    "BankState",
    "DoaEkf",
    "Filter",
    "FrameEstimate",
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
    "locate",
    "locate_doa",
    "make",
    "methods",
    "names",
    "orientations",
    "register",
    "ring_least_squares",
    "triangle_frames",
]
