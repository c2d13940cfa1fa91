"""Biases and slopes of links, taken off the ranges."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.recordings.tables import MAX_RANGE_M, TOO_LONG, Ids, Table


def calibrated(
    ranges: FloatArray, std: FloatArray | None, table: Table, ids: Ids
) -> tuple[FloatArray, FloatArray | None]:
    """Ranges (K, M, N) and their deviations with bias and slope of each link taken off."""
    table.check_columns(("anchor", "tag", "bias_m", "slope"), ("sigma_m",))
    link = table.links(ids)
    slope = table.numbers("slope")
    table.check(slope > -1, "slope", "must be above -1")
    bias, scale = np.zeros(ranges.shape[1:]), np.ones(ranges.shape[1:])
    bias[link], scale[link] = table.numbers("bias_m"), 1 + slope
    with np.errstate(over="ignore"):
        corrected = (ranges - bias) / scale
    too_long = f"corrected ranges {TOO_LONG}"
    table.check(corrected.max(axis=0)[link] <= MAX_RANGE_M, "bias_m", too_long)
    links = (ranges > 0) & (corrected > 0)
    std = None if std is None else np.where(links, std / scale, 0.0)
    return np.where(links, corrected, 0.0), std
