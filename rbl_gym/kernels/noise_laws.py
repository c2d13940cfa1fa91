"""The laws of ranges as four numbers: their kind, two parameters, the index of the reference tag.

`numbers` of a law of `rbl_gym.ranging` gives them: 0, floor, proportional, reference (-1: every
link its own); or 1, sigma, 0, 0 for noise on the squared range. Everything is told by squares of
distances, r^2 of the link and that of the reference tag to the same anchor.
"""

from __future__ import annotations

import math
from typing import Any

from rbl_gym.kernels.jit import helper


@helper
def reference_of(law: Any, tag: int) -> int:
    """Index of the tag whose distance tells the noise of the links of a tag."""
    reference = int(law[3])
    return tag if reference < 0 else reference


@helper
def weight(law: Any, square: float, reference: float) -> float:
    """``1 / (var r^2)``: what a range tells along (s - a), which is not of unit length.

    Zero where an anchor stands on a tag: there the range has no gradient.
    """
    if not square > 0:
        return 0.0
    if law[0] == 1:
        return 4 / (law[1] * law[1] * reference)
    return 1 / ((law[1] * law[1] + law[2] * law[2] * reference) * square)


@helper
def weight_slopes(law: Any, square: float, reference: float) -> tuple[float, float]:
    """Minus the derivatives of log `weight` by the squares of the link and of the reference.

    Where every link is its own reference, the first of the two is the whole.
    """
    if law[0] == 1:
        return 0.0, 1 / reference
    growth = law[2] * law[2]
    slope = growth / (law[1] * law[1] + growth * reference)
    return (1 / square + slope, 0.0) if law[3] < 0 else (1 / square, slope)


@helper
def sample(law: Any, square: float, reference: float, normal: float) -> float:
    """A noisy range, never below zero."""
    if law[0] == 1:
        return math.sqrt(max(law[1] * math.sqrt(reference) * normal + square, 0.0))
    std = math.sqrt(law[1] * law[1] + law[2] * law[2] * reference)
    return max(math.sqrt(square) + std * normal, 0.0)
