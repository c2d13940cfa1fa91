"""Model motion: kinematics, process noise, trajectories, and unknown twists."""

from rbl_gym.motion.kinematics import (
    Path,
    ProcessNoise,
    Trajectory,
    propagate,
    simulate,
    twists_between,
)
from rbl_gym.motion.trajectories import (
    constant_twist,
    held_twists,
    interpolate,
    lawn_mower_points,
    orbit,
    recorded,
    waypoints,
)

__all__ = [
    "Path",
    "ProcessNoise",
    "Trajectory",
    "constant_twist",
    "held_twists",
    "interpolate",
    "lawn_mower_points",
    "orbit",
    "propagate",
    "recorded",
    "simulate",
    "twists_between",
    "waypoints",
]
