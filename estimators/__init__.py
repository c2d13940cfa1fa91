"""Estimators: arrays in, beliefs out; they know no environment.

``make(name, tags=..., noise=..., process=...)`` gives a filter; swapping one for another is a
change of name.
"""

from functools import partial

from rbl_gym.estimators.belief import Filter, PoseBelief, make, names, register
from rbl_gym.estimators.doa import locate_doa
from rbl_gym.estimators.doa_filter import DoaEkf, iterated_ekf
from rbl_gym.estimators.kalman import KalmanFamily, KalmanState
from rbl_gym.estimators.localization import PoseEstimate, locate, methods
from rbl_gym.estimators.manifold import IteratedEkf, PoseState

for _name, _constraint in {
    "kf": "none",
    "uc-kf": "newton",
    "et-kf": "threshold",
    "kf-ortho": "always",
}.items():
    register(_name, partial(KalmanFamily, constraint=_constraint))
register("iekf", iterated_ekf)

__all__ = [
    "DoaEkf",
    "Filter",
    "IteratedEkf",
    "KalmanFamily",
    "KalmanState",
    "PoseBelief",
    "PoseEstimate",
    "PoseState",
    "locate",
    "locate_doa",
    "make",
    "methods",
    "names",
    "register",
]
