"""Coarse net over SO(3) from which local searches start."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations


def _octahedral_group() -> FloatArray:
    """Return the 24 rotations of the cube; every rotation is within 62.8 degrees of one."""
    quarter = [rotations.exp(0.5 * np.pi * axis) for axis in np.eye(3)]
    group = [np.eye(3)]
    for element in group:
        for turn in quarter:
            candidate = np.round(turn @ element)
            if not any(np.array_equal(candidate, known) for known in group):
                group.append(candidate)
    return np.array(group)


ROTATION_NET = _octahedral_group()
