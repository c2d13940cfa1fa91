"""Remove the biases and slopes of links from the ranges."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import MAX_RANGE_M, TOO_LONG, Ids, Table

# Columns with the uncertainty of the other columns.
_STDS = ("bias_std_m", "slope_std")


def calibrated(
    ranges: FloatArray, std: FloatArray | None, table: Table, ids: Ids, said: Said
) -> tuple[FloatArray, FloatArray | None]:
    """Return ranges (K, M, N) and standard deviations corrected for bias and slope of each link."""
    table.require("anchor", "tag", "bias_m")
    said.read(table, ("anchor", "tag", "bias_m", "slope", "sigma_m", *_STDS))
    link = table.links(ids)
    slope = table.numbers("slope") if "slope" in table.columns else np.zeros(len(table.lines))
    table.check(slope > -1, "slope", "must be above -1")
    bias, scale = np.zeros(ranges.shape[1:]), np.ones(ranges.shape[1:])
    bias[link], scale[link] = table.numbers("bias_m"), 1 + slope
    with np.errstate(over="ignore"):
        corrected = (ranges - bias) / scale
    too_long = f"corrected ranges {TOO_LONG}"
    table.check(corrected.max(axis=0)[link] <= MAX_RANGE_M, "bias_m", too_long)
    links = (ranges > 0) & (corrected > 0)
    if lost := int((ranges > 0).sum() - links.sum()):
        said.drop("not positive after calibration", lost)
        said.note(table.path, f"{lost} ranges are not positive after calibration and are left out")
    std = None if std is None else np.where(links, std / scale, 0.0)
    return np.where(links, corrected, 0.0), std
