"""Compute Cramer-Rao bounds: one pose, tracks, nuisances, unreliable links, angles."""

from rbl_gym.bounds.information import (
    information_at,
    lift,
    range_information,
    range_jacobian,
    tag_jacobian,
)
from rbl_gym.bounds.motions import InertialMotion, KnownTwist, UnknownTwist
from rbl_gym.bounds.nuisances import (
    Nuisances,
    RangeEpoch,
    epoch_crb,
    epoch_information,
    marginal_information,
    with_nuisances,
)
from rbl_gym.bounds.pose import (
    information_rank,
    inverted,
    pose_crb,
    root_of_trace,
    score,
    symmetric,
)
from rbl_gym.bounds.posterior import predict_covariance, predict_information
from rbl_gym.bounds.recursion import posterior_crb_step, posterior_step
from rbl_gym.bounds.tag_information import directions

__all__ = [
    "InertialMotion",
    "KnownTwist",
    "Nuisances",
    "RangeEpoch",
    "UnknownTwist",
    "directions",
    "epoch_crb",
    "epoch_information",
    "information_at",
    "information_rank",
    "inverted",
    "lift",
    "marginal_information",
    "pose_crb",
    "posterior_crb_step",
    "posterior_step",
    "predict_covariance",
    "predict_information",
    "range_information",
    "range_jacobian",
    "root_of_trace",
    "score",
    "symmetric",
    "tag_jacobian",
    "with_nuisances",
]
