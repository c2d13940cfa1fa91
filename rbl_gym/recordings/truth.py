"""Reference poses: read from a file, and between their times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import motion
from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number
from rbl_gym.geometry import rotations
from rbl_gym.recordings.tables import AnyPath, read_table

__all__ = ["Truth", "read_truth", "truth_at"]

MAX_YAW_DEG = 1e6


class Truth(NamedTuple):
    """Reference poses of the body, ``p_world = rotation @ p_body + translation``."""

    times: FloatArray  # (L,) seconds, strictly increasing
    rotation: FloatArray  # (L, 3, 3)
    translation: FloatArray  # (L, 3) metres


def truth_at(
    truth: Truth, times: ArrayLike, max_gap_s: float = 0.5
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Truth at other times: linear in position, along the geodesic in rotation.

    Parameters
    ----------
    truth, times
        Reference poses; the times they are wanted at, (..., K) seconds.
    max_gap_s
        Longest gap between two reference poses that is bridged, seconds.

    Returns
    -------
    rotation, translation
        (..., K, 3, 3) and (..., K, 3) metres; finite but meaningless where not `valid`.
    valid
        (..., K) False outside the truth's time span and inside a gap longer than `max_gap_s`.

    Raises
    ------
    ValueError
        If `times` is empty or not finite, or `max_gap_s` is negative.
    """
    times = check_array("times", times, ("K",))
    max_gap_s = check_number("max_gap_s", max_gap_s, low=0.0)
    last = len(truth.times) - 1
    left = np.clip(np.searchsorted(truth.times, times, side="right") - 1, 0, last)
    right = np.minimum(left + 1, last)
    elapsed, gap = times - truth.times[left], truth.times[right] - truth.times[left]
    path = motion.interpolate(*truth, times)
    inside = (times >= truth.times[0]) & (times <= truth.times[-1])
    return path.rotation, path.translation, inside & ((gap <= max_gap_s) | (elapsed == 0))


def read_truth(path: AnyPath) -> Truth:
    """The reference poses of a file.

    Raises
    ------
    ValueError
        If the file is not as `read_recording` describes it.
    """
    table = read_table(path)
    if "yaw_deg" in table.columns:
        table.check_columns(("t", "x", "y", "yaw_deg"), ("z",))
        yaw = table.numbers("yaw_deg")
        must = f"must be at most {MAX_YAW_DEG:g} in magnitude"
        table.check(np.abs(yaw) <= MAX_YAW_DEG, "yaw_deg", must)
        rotation = rotations.exp(np.radians(yaw)[:, None] * (0.0, 0.0, 1.0))
        translation = table.points(axis for axis in "xyz" if axis in table.columns)
        missing = 3 - translation.shape[1]
        return Truth(table.times(), rotation, np.pad(translation, ((0, 0), (0, missing))))

    names = ("qw", "qx", "qy", "qz")
    table.check_columns(("t", "x", "y", "z", *names))
    q = np.stack([table.numbers(name) for name in names], axis=-1)
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(q, axis=-1)
    table.check(np.abs(norm - 1) <= 1e-2, "qw", "quaternion norm must be 1 within 0.01", got=norm)
    return Truth(table.times(), rotations.from_quaternion(q), table.points("xyz"))
