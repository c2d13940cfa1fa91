"""Gymnasium wrappers: observation to belief to reward."""

from rbl_gym.wrappers.estimate import EstimatePose
from rbl_gym.wrappers.vector_estimate import VectorEstimatePose

__all__ = ["EstimatePose", "VectorEstimatePose"]
