"""A log of ranges as arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.measurements.direction_bias import DirectionLaw
from rbl_gym.recordings.inertial import InertialLog
from rbl_gym.recordings.odometry import OdometryLog
from rbl_gym.recordings.report import Report
from rbl_gym.recordings.truth import Truth

__all__ = ["Recording"]


class Recording(NamedTuple):
    """Ranges between M anchors and N tags over K epochs, and what is known beside them."""

    times: FloatArray  # (K,) seconds, strictly increasing, at any spacing
    ranges: FloatArray  # (K, M, N) metres, 0 where there is no link
    links: BoolArray  # (K, M, N) True where a range was measured
    range_std: FloatArray | None  # (K, M, N) metres, 0 where no link; None: not in the log
    anchors: FloatArray  # (M, 3) metres, world frame; (K, M, 3) where they move
    tags: FloatArray  # (N, 3) metres, body frame
    anchor_ids: tuple[str, ...]  # in the order of `anchors`
    tag_ids: tuple[str, ...]  # in the order of `tags`
    truth: Truth | None  # at times of its own, see `truth_at`
    report: Report = Report()  # what was dropped, sorted and found while it was read
    offset: str | None = None  # whose ranges have an unknown offset in common, and any sign
    odometry: OdometryLog | None = None  # on the clock of `times`
    inertial: InertialLog | None = None  # in the body frame, on the clock of `times`
    directions: DirectionLaw | None = None  # what ranges have too much by the ray's direction

    @property
    def anchors_by_epoch(self) -> FloatArray:
        """Anchors (K, M, 3) at every epoch, also of those that stand; a view, not to be written."""
        shape = (len(self.times), *self.anchors.shape[-2:])
        return np.broadcast_to(self.anchors, shape)

    @property
    def last_anchors(self) -> FloatArray:
        """Anchors (M, 3) where they stand, or stood at last."""
        return self.anchors_by_epoch[-1]
