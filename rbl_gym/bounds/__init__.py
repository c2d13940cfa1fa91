"""Cramer-Rao bounds: of the pose, along a track, with bad links, from angles."""

from rbl_gym.bounds.pose import (
    directions,
    information_at,
    information_rank,
    inverted,
    lift,
    pose_crb,
    range_information,
    range_jacobian,
    root_of_trace,
    score,
    symmetric,
    tag_jacobian,
)
from rbl_gym.bounds.posterior import (
    posterior_crb_step,
    predict_covariance,
    predict_information,
)

__all__ = [
    "directions",
    "information_at",
    "information_rank",
    "inverted",
    "lift",
    "pose_crb",
    "posterior_crb_step",
    "predict_covariance",
    "predict_information",
    "range_information",
    "range_jacobian",
    "root_of_trace",
    "score",
    "symmetric",
    "tag_jacobian",
]
