"""Tell a wrong position of an anchor from a bias of its ranges, along a path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.calibration import robust

# Cables, antennas and reflections shift the ranges of UWB links by about 0.05 m relative to each
# other. Six times this is the largest offset of a link, and the smallest move, that are taken for a
# fault; four times this the offset of an anchor.
LINK_STD_M = 0.05
MOST_OFF_M, ANCHOR_M = 6 * LINK_STD_M, 4 * LINK_STD_M
# A move that leaves less than this share of the variance of the ranges is a fault, too: errors that
# turn with the direction are no bias.
LEFT = 0.6
# Prior standard deviations (m) of the move of an anchor, and of the bias of its ranges beside it.
_MOVE_M, _BESIDE_M = 1.0, 2 * LINK_STD_M
# Fewest ranges, and most that are used.
_FEWEST, _MOST = 30, 1000
_LEAST_M = 1e-3


class Misplaced(NamedTuple):
    """A move (3,) of an anchor with which its ranges fit a path, metres, and the share of their
    variance that it leaves."""

    move_m: FloatArray
    left: float

    @property
    def size_m(self) -> float:
        """Return the length of the move."""
        return float(np.linalg.norm(self.move_m))


def misplaced(
    off_m: FloatArray, away_m: FloatArray, links: BoolArray, planar: bool = False
) -> Misplaced:
    """Return the move of an anchor with which its ranges fit a path.

    The error of a wrong position turns with the direction from which the anchor is seen, a bias
    does not: then the move leaves a small share of the variance.

    Parameters
    ----------
    off_m
        (K, N) ranges minus distances, metres.
    away_m
        Vectors (K, N, 3) from the tags to the anchor.
    links
        (K, N) the measured ranges.
    planar
        The body moves in a level plane: anchors keep their heights.

    Returns
    -------
    No move, with a share of 1, if there are too few ranges.
    """
    off, away = off_m[links], away_m[links]
    if len(off) < _FEWEST:
        return Misplaced(np.zeros(3), 1.0)
    step = -(-len(off) // _MOST)
    off, away = off[::step], away[::step]
    far = np.linalg.norm(away, axis=-1)
    prior = np.array([_MOVE_M, _MOVE_M, _LEAST_M if planar else _MOVE_M, _BESIDE_M])
    everything = np.ones(len(off), np.bool_)
    std = float(robust.spread(off - np.median(off), everything, _LEAST_M))

    def left(x: FloatArray) -> FloatArray:
        return off - (np.linalg.norm(away + x[:3], axis=-1) - far) - x[3]

    found = scipy.optimize.least_squares(
        lambda x: np.concatenate([left(x) / std, x / prior]), np.zeros(4), loss="soft_l1"
    ).x
    share = (float(robust.spread(left(found), everything, _LEAST_M)) / std) ** 2
    return Misplaced(found[:3], share)
