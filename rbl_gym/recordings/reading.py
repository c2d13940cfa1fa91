"""Real measurement logs: CSV files of anchors, tags, ranges, truth and calibration as arrays.

Every file has a header line; columns may come in any order. UTF-8 with or without a byte order
mark, any line ending; blank lines and lines that start with ``#`` are skipped. Whatever is wrong
in a file is a ValueError that names the file, the line, the column and the value that came.
"""

from __future__ import annotations

import os
from typing import NamedTuple

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.recordings.calibration import calibrated
from rbl_gym.recordings.points import read_points
from rbl_gym.recordings.ranges import read_long, read_wide
from rbl_gym.recordings.tables import AnyPath, read_table
from rbl_gym.recordings.truth import Truth, read_truth
from rbl_gym.recordings.units import check_units

__all__ = ["Recording", "read_recording"]


class Recording(NamedTuple):
    """Ranges between M anchors and N tags over K epochs, and what is known beside them."""

    times: FloatArray  # (K,) seconds, strictly increasing, at any spacing
    ranges: FloatArray  # (K, M, N) metres, 0 where there is no link
    links: BoolArray  # (K, M, N) True where a range was measured
    range_std: FloatArray | None  # (K, M, N) metres, 0 where no link; None: not in the log
    anchors: FloatArray  # (M, 3) metres, world frame
    tags: FloatArray  # (N, 3) metres, body frame
    anchor_ids: tuple[str, ...]  # in the order of `anchors`
    tag_ids: tuple[str, ...]  # in the order of `tags`
    truth: Truth | None  # at times of its own, see `truth_at`


def read_recording(
    ranges: AnyPath,
    anchors: AnyPath,
    tags: AnyPath,
    truth: AnyPath | None = None,
    calibration: AnyPath | None = None,
) -> Recording:
    """Read a measurement log from its CSV files.

    Parameters
    ----------
    ranges
        Long, ``t,anchor,tag,range[,std][,valid]``: rows of equal `t` make an epoch, `t` does not
        decrease; where `valid` (0 or 1) is 0, range and std may be any number or empty. Or wide,
        ``t,a{anchor}t{tag},...``: a row is an epoch, `t` increases. Seconds and metres. A link
        whose range is empty, or that has no row or column, is missing.
    anchors, tags
        ``anchor,x,y,z`` and ``tag,x,y,z`` (or ``id,x,y,z``), metres; ids are any unique text.
    truth
        ``t,x,y,z,qw,qx,qy,qz`` or, planar, ``t,x,y[,z],yaw_deg`` with z = 0 where absent.
        Quaternions may be off unit norm by 0.01 and are normalised.
    calibration
        ``anchor,tag,bias_m,slope[,sigma_m]``: ``(range - bias) / (1 + slope)`` replaces the
        range of that link and ``std / (1 + slope)`` its std. A corrected range that is not
        positive cannot be a distance and becomes a missing link. Links without a row stay as
        they are; `sigma_m` is not read.

    Raises
    ------
    ValueError
        If a file is not as described or holds values that cannot be (NaN, ranges that are not
        positive, units that do not fit together), or if no epoch has a link.
    """
    anchor_ids, anchor_points = read_points(anchors, "anchor")
    tag_ids, tag_points = read_points(tags, "tag")
    ids = anchor_ids, tag_ids
    table = read_table(ranges)
    is_wide = table.columns.keys().isdisjoint(("anchor", "tag", "range"))
    times, measured, std = (read_wide if is_wide else read_long)(table, ids)
    if calibration is not None:
        measured, std = calibrated(measured, std, read_table(calibration), ids)
    links = measured > 0
    if not links.any():
        raise ValueError(f"{table.path}: must have an epoch with a link, got none")
    paths = table.path, os.fspath(anchors), os.fspath(tags)
    check_units(paths, times, measured, links, anchor_points, tag_points)
    poses = None if truth is None else read_truth(truth)
    return Recording(times, measured, links, std, anchor_points, tag_points, *ids, poses)
