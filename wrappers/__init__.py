"""Gymnasium wrappers: observation to belief to reward."""

from rbl_gym.wrappers.estimate import EstimatePose

__all__ = ["EstimatePose"]
