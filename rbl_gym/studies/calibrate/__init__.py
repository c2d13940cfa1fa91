"""Calibration from logs: links, tags and clocks by truth; anchors without it."""

from rbl_gym.studies.calibrate.files import write_link_table, write_points
from rbl_gym.studies.calibrate.links import CalibratedLinks, calibrate_links
from rbl_gym.studies.calibrate.settings import LinkSettings

__all__ = [
    "CalibratedLinks",
    "LinkSettings",
    "calibrate_links",
    "write_link_table",
    "write_points",
]
