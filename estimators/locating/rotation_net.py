"""A coarse net over SO(3) to start local searches from."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations


def _octahedral_group() -> FloatArray:
    """The 24 rotations of the cube: no rotation is farther than 62.8 degrees from one of them."""
    quarter = [rotations.exp(0.5 * np.pi * axis) for axis in np.eye(3)]
    group = [np.eye(3)]
    for element in group:
        for turn in quarter:
            candidate = np.round(turn @ element)
            if not any(np.array_equal(candidate, known) for known in group):
                group.append(candidate)
    return np.array(group)


ROTATION_NET = _octahedral_group()
