"""Information fraction of links by range and angle; textbook form: `measurements.gain`."""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import helper


@helper
def _step(inside: float, edge: float) -> tuple[float, float]:
    if not edge > 0:
        return (1.0 if inside >= 0 else 0.0), 0.0
    x = min(max(inside / edge, 0.0), 1.0)
    return x * x * (3 - 2 * x), 6 * x * (1 - x) / edge


@helper
def share_and_slope(
    gain: Any, dx: float, dy: float, dz: float, nx: float, ny: float, nz: float
) -> tuple[float, float, float, float]:
    """Return the fraction of a link with offset d, and its derivative by d; n is the normal."""
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    share, along = 1.0, 0.0
    if gain[0] < math.inf:
        share, along = _step(gain[0] - distance, gain[1])
    x = y = z = 0.0
    if along != 0:
        x, y, z = -along * dx / distance, -along * dy / distance, -along * dz / distance
    if gain[2] > -2 and (nx != 0 or ny != 0 or nz != 0):
        cosine = (nx * dx + ny * dy + nz * dz) / distance
        seen, rise = _step(cosine - gain[2], gain[3] - gain[2])
        f = share * rise / distance
        c = cosine / distance
        x = x * seen + f * (nx - c * dx)
        y = y * seen + f * (ny - c * dy)
        z = z * seen + f * (nz - c * dz)
        share *= seen
    return share, x, y, z
