"""Store a log of ranges as arrays."""

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
    """Ranges between M anchors and N tags over K epochs, and the data that belong to them."""

    times: FloatArray  # (K,) seconds, strictly increasing, any spacing
    ranges: FloatArray  # (K, M, N) metres, 0 without a link
    links: BoolArray  # (K, M, N) True where a range was measured
    range_std: FloatArray | None  # (K, M, N) metres, 0 without a link; None: not in the log
    anchors: FloatArray  # (M, 3) metres, world frame; (K, M, 3) if they move
    tags: FloatArray  # (N, 3) metres, body frame
    anchor_ids: tuple[str, ...]  # in the order of `anchors`
    tag_ids: tuple[str, ...]  # in the order of `tags`
    truth: Truth | None  # with its own times, see `truth_at`
    report: Report = Report()  # what was dropped, sorted and found while it was read
    offset: str | None = None  # which ranges share an unknown offset; they may be negative
    odometry: OdometryLog | None = None  # on the clock of `times`
    inertial: InertialLog | None = None  # in the body frame, on the clock of `times`
    directions: DirectionLaw | None = None  # range bias by ray direction

    @property
    def anchors_by_epoch(self) -> FloatArray:
        """Return the anchors (K, M, 3) at every epoch, also if they are fixed; a read-only view."""
        shape = (len(self.times), *self.anchors.shape[-2:])
        return np.broadcast_to(self.anchors, shape)

    def part(self, epochs: slice) -> Recording:
        """Return some epochs; truth and readings of sensors, with times of their own, are kept."""
        return self._replace(
            times=self.times[epochs],
            ranges=self.ranges[epochs],
            links=self.links[epochs],
            range_std=None if self.range_std is None else self.range_std[epochs],
            anchors=self.anchors[epochs] if self.anchors.ndim == 3 else self.anchors,
        )

    @property
    def last_anchors(self) -> FloatArray:
        """Return the anchors (M, 3) at fixed positions, or at their last positions."""
        return self.anchors_by_epoch[-1]
