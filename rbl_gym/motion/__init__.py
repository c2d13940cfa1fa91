"""Model motion: kinematics, process noise, trajectories, and unknown twists."""

from rbl_gym.motion.kinematics import (
    Path,
    ProcessNoise,
    Trajectory,
    constant_twist,
    held_twists,
    interpolate,
    lawn_mower_points,
    orbit,
    propagate,
    random_twist,
    recorded,
    simulate,
    twists_between,
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
    "random_twist",
    "recorded",
    "simulate",
    "twists_between",
    "waypoints",
]
