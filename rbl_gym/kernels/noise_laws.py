"""Noise laws of ranges as four numbers: kind, two parameters, index of the reference tag.

`numbers` of a law of `rbl_gym.ranging` returns them: 0, floor, proportional, reference (-1: each
link is its own reference); or 1, sigma, 0, 0 for noise on the squared range. All functions take
squared distances: r^2 of the link and that of the reference tag to the same anchor.
"""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import helper


@helper
def reference_of(law: Any, tag: int) -> int:
    """Return the index of the tag whose distance determines the noise of a tag's links."""
    reference = int(law[3])
    return tag if reference < 0 else reference


@helper
def weight(law: Any, square: float, reference: float) -> float:
    """Return ``1 / (var r^2)``: the information of a range along (s - a), not of unit length.

    Zero if an anchor coincides with a tag, because the range then has no gradient.
    """
    if not square > 0:
        return 0.0
    if law[0] == 1:
        return 4 / (law[1] * law[1] * reference)
    return 1 / ((law[1] * law[1] + law[2] * law[2] * reference) * square)


@helper
def weight_slopes(law: Any, square: float, reference: float) -> tuple[float, float]:
    """Return minus the derivatives of log `weight` by squared distances of link and reference.

    If each link is its own reference, the first one is the total derivative.
    """
    if law[0] == 1:
        return 0.0, 1 / reference
    growth = law[2] * law[2]
    slope = growth / (law[1] * law[1] + growth * reference)
    return (1 / square + slope, 0.0) if law[3] < 0 else (1 / square, slope)


@helper
def sample(law: Any, square: float, reference: float, normal: float) -> float:
    """Return a noisy range, never below zero."""
    if law[0] == 1:
        return math.sqrt(max(law[1] * math.sqrt(reference) * normal + square, 0.0))
    std = math.sqrt(law[1] * law[1] + law[2] * law[2] * reference)
    return max(math.sqrt(square) + std * normal, 0.0)
