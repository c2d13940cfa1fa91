"""Calibration from logs by batch least squares: link biases, lever arms, clocks, surveys."""

from rbl_gym.estimators.calibration.clock import Clock, find_clock
from rbl_gym.estimators.calibration.link_equations import KnownPath, LinkModel
from rbl_gym.estimators.calibration.links import LinkFit, fit_links, spread_of_residuals

__all__ = [
    "Clock",
    "KnownPath",
    "LinkFit",
    "LinkModel",
    "find_clock",
    "fit_links",
    "spread_of_residuals",
]
