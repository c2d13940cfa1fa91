"""Fit links to a log along its truth, together with biases by ray direction."""

from __future__ import annotations

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.estimators.calibration import KnownPath, LinkFit, LinkModel, fit_links
from rbl_gym.estimators.calibration.harmonics import FoundDirections, candidates_of, fit_harmonics
from rbl_gym.measurements.direction_bias import direction_bias
from rbl_gym.studies.calibrate.known_path import Log, path_at
from rbl_gym.studies.calibrate.settings import LinkSettings

# Number of epochs used to find the tags, and the change of a fit with the clock.
_FEW_EPOCHS = 1000
# Number of rounds in which links and harmonics are fitted in turn.
_ROUNDS = 2
# Number of harmonics to fit if none are requested, to judge the tag positions.
_LOOKED_AT = 3


def fit_log(
    log: Log,
    settings: LinkSettings,
    model: LinkModel,
    turn: FloatArray,
    shift: float,
    few: bool = False,
    beta: FloatArray | None = None,
) -> LinkFit:
    """Return the fit to all epochs, or to `few` of them, for a clock offset of the truth.

    `beta` (K, M, N), metres, is subtracted from the ranges first.
    """
    at = slice(None, None, max(1, len(log.times) // _FEW_EPOCHS) if few else 1)
    path, known = path_at(log, settings, shift)
    links = (log.links & known[:, None, None])[at]
    path = KnownPath(*(a[at] for a in path))
    ranges = log.ranges if beta is None else log.ranges - beta
    return fit_links(ranges[at], links, log.anchors[at], log.tags, path, model, turn)


def with_directions(
    log: Log, settings: LinkSettings, model: LinkModel, fit: LinkFit, shift: float
) -> tuple[LinkFit, FoundDirections]:
    """Return the fit of links after biases by direction are subtracted, and these biases."""
    path, known = path_at(log, settings, shift)
    links = log.links & known[:, None, None]
    # If tags may turn or move, their motion is already a first harmonic at the tags.
    first = 1 if model.tags == "held" else 2
    candidates = candidates_of(settings.harmonics or _LOOKED_AT, settings.ends)
    beta = np.zeros(log.ranges.shape)
    for _ in range(_ROUNDS):
        left = np.where(links, fit.residuals + beta, 0.0)
        found = fit_harmonics(
            left, links, log.anchors, fit.tags, path, candidates, _lasting(fit, log.times),
            first,
        )  # fmt: skip
        if not settings.harmonics:
            return fit, found
        beta = direction_bias(
            found.law, path.rotation, path.translation, log.anchors, fit.tags
        ).bias
        fit = fit_log(log, settings, model, fit.rotation, shift, beta=beta)
    return fit, found  # pyrefly: ignore[unbound-name]


def _lasting(fit: LinkFit, times: FloatArray) -> float:
    """Return the correlation length of link errors in epochs."""
    step = np.diff(times)
    forward = step[step > 0]
    usual = float(np.median(forward)) if len(forward) else 1.0
    a, share = np.exp(-usual / fit.drift.time_s), fit.drift.share
    return float(1 - share + share * (1 + a) / (1 - a))
