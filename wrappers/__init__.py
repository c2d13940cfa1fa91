"""Gymnasium wrappers: from observations to beliefs to rewards."""

from rbl_gym.wrappers.estimate import EstimatePose
from rbl_gym.wrappers.estimate_network import EstimateNetwork, VectorEstimateNetwork
from rbl_gym.wrappers.filter_reward import FilterReward, VectorFilterReward
from rbl_gym.wrappers.select_anchors import SelectAnchors, VectorSelectAnchors
from rbl_gym.wrappers.vector_estimate import VectorEstimatePose

__all__ = [
    "EstimateNetwork",
    "EstimatePose",
    "FilterReward",
    "SelectAnchors",
    "VectorEstimateNetwork",
    "VectorEstimatePose",
    "VectorFilterReward",
    "VectorSelectAnchors",
]
