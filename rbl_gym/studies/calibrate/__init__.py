"""Calibration from logs: links, tags and clocks by truth; anchors without it."""

from rbl_gym.studies.calibrate.anchors import (
    AnchorSettings,
    SurveyedAnchors,
    read_anchor_ranges,
    survey_anchors,
)
from rbl_gym.studies.calibrate.files import (
    write_directions,
    write_frame,
    write_link_table,
    write_points,
)
from rbl_gym.studies.calibrate.inertial import (
    CalibratedInertial,
    calibrate_inertial,
    inertial_figures,
)
from rbl_gym.studies.calibrate.links import CalibratedLinks, calibrate_links
from rbl_gym.studies.calibrate.settings import LinkSettings

__all__ = [
    "AnchorSettings",
    "CalibratedInertial",
    "CalibratedLinks",
    "LinkSettings",
    "SurveyedAnchors",
    "calibrate_inertial",
    "calibrate_links",
    "inertial_figures",
    "read_anchor_ranges",
    "survey_anchors",
    "write_directions",
    "write_frame",
    "write_link_table",
    "write_points",
]
