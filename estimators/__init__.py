"""Estimators: arrays in, beliefs out; they know no environment.

``make(name, tags=..., noise=..., process=...)`` gives a filter; swapping one for another is a
change of name.
"""

from functools import partial

from rbl_gym.estimators.asynchronous import Asynchronous, Stream
from rbl_gym.estimators.augmented import AugmentedEkf, AugmentedState, iekf_bias, iekf_cv
from rbl_gym.estimators.bank import IteratedEkfBank
from rbl_gym.estimators.belief import (
    ENTRY_POINT_GROUP,
    Filter,
    PoseBelief,
    make,
    names,
    register,
    with_noise,
)
from rbl_gym.estimators.consensus import (
    cycle_consensus,
    cycle_iteration,
    cycle_projection,
    ring_least_squares,
)
from rbl_gym.estimators.doa import locate_doa
from rbl_gym.estimators.doa_filter import DoaEkf, iterated_ekf
from rbl_gym.estimators.hypotheses import BankState
from rbl_gym.estimators.kalman import KalmanFamily, KalmanState
from rbl_gym.estimators.localization import PoseEstimate, locate, methods
from rbl_gym.estimators.manifold import IteratedEkf, PoseState
from rbl_gym.estimators.network_frames import FrameEstimate, frames
from rbl_gym.estimators.network_orientations import chordal_optimum, orientations

for _name, _constraint in {
    "kf": "none",
    "uc-kf": "newton",
    "et-kf": "threshold",
    "kf-ortho": "always",
}.items():
    register(_name, partial(KalmanFamily, constraint=_constraint))
register("iekf", iterated_ekf)
register("iekf-cv", iekf_cv)
register("iekf-bias", iekf_bias)
register("iekf-bank", IteratedEkfBank)

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
    "with_noise",
]
