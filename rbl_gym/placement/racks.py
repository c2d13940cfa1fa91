"""Racks of a placement task: boxes on the floor that block sight, drawn for each problem."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray

# Number of uniforms of a rack.
RACK_UNIFORMS = 6
# Indices of a rack's centre and half sizes in its drawn values.
_LONG_X, _LONG_Y = np.array([0, 1, 5, 3, 2, 5]), np.array([0, 1, 5, 2, 3, 5])


def limits_of_racks(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return minimum and span (6,) of the values of a rack, in a room with these corners.

    The values are x, y, half width, half length, 0, and half height. Racks are in the central 70 %
    of the room.
    """
    x, y, _ = high - low
    least = np.array([low[0] + 0.15 * x, low[1] + 0.15 * y, 0.2, 1.0, 0.0, 0.6])
    return least, np.array([0.7 * x, 0.7 * y, 0.2, 1.0, 0.0, 0.6])


def drawn_racks(limits: tuple[FloatArray, FloatArray], uniforms: FloatArray) -> FloatArray:
    """Return racks (..., 6), centre and half size, from uniforms (..., 6); long in x or in y."""
    values = limits[0] + limits[1] * uniforms
    return np.where(uniforms[..., 4:5] < 0.5, values[..., _LONG_X], values[..., _LONG_Y])
