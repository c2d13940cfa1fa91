"""Tune range noise and motion of the body by the likelihood of the first part of a log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, check_number
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.causes import local_trial
from rbl_gym.studies.replay.evidence import Trial, evidence
from rbl_gym.studies.replay.place import own_std
from rbl_gym.studies.replay.settings import DEFAULT_RANGE_STD_M, Settings
from rbl_gym.studies.replay.tracking import accel_of, recording_filter

__all__ = ["TUNING_ROUNDS", "Tuned", "tune"]

# Limits of each setting.
_LIMITS = {
    "range_std_m": (2e-3, 10.0),
    "walk_m": (5e-3, 100.0),
    "walk_deg": (0.2, 1e3),
    "accel_m": (1e-2, 100.0),
    "accel_deg": (1.0, 1e4),
    "odometry_m": (5e-3, 10.0),
    "odometry_deg": (0.5, 1e3),
    "constant_std_m": (1e-2, 1.0),
    "drift_std_m": (1e-3, 1.0),
}
# Factors between the tested values of each setting, by round.
_FACTORS = (4.0, 3.0, 2.0, 1.5, 1.25, 1.15)
TUNING_ROUNDS = len(_FACTORS)
# Longest part that is used, in epochs.
MOST_EPOCHS = 3_000


class Tuned(NamedTuple):
    """Settings that maximise the likelihood of a log.

    Attributes
    ----------
    settings
        The settings with the tuned values.
    found
        The tuned values, by the names of the settings; `filter` if it was chosen too.
    options
        The same as options of ``rbl-gym replay``.
    log_likelihood, log_likelihood_before
        Per range, over the part used, with the tuned and with the given settings.
    epochs, seconds
        Length of the part of the log that was used.
    """

    settings: Settings
    found: dict[str, float | str]
    options: str
    log_likelihood: float
    log_likelihood_before: float
    epochs: int
    seconds: float

    def figures(self) -> dict[str, Any]:
        """Return all fields except the settings as plain numbers and text."""
        return {name: value for name, value in self._asdict().items() if name != "settings"}


def tune(
    recording: Recording,
    settings: Settings,
    seconds: float = 20.0,
    filters: Sequence[str] = (),
    advance: Callable[[], None] = lambda: None,
) -> Tuned:
    """Choose the range standard deviation and the motion by the likelihood of the innovations.

    The likelihood is that of `estimators.Innovations`: a Gaussian for used ranges, and a constant
    for rejected ranges, so that rejection has a cost. The tuned settings are ``range_std_m``,
    ``walk_m`` and ``walk_deg``, and for filters that estimate a twist ``accel_m`` and
    ``accel_deg``. A walk of zero remains zero. The laws of the biases are not tuned, because they
    would absorb the motion. With odometry, which measures the motion, they are tuned instead of
    it: ``odometry_m``, ``odometry_deg``, ``constant_std_m`` and ``drift_std_m``. The truth is not
    used.

    Parameters
    ----------
    recording, settings
        The recording and the settings, from which the search starts.
    seconds
        Length of the part of the log, from its start, that is used; at most 3,000 epochs of it.
    filters
        Names of filters, of which the one with the highest likelihood is chosen; empty: that of
        the settings.
    advance
        Called after each of the `TUNING_ROUNDS` of each filter.

    Raises
    ------
    ValueError
        If `seconds` is not positive, or the part has fewer than ten epochs.
    """
    seconds = check_number("seconds", seconds, low=1e-6)
    count = int(np.searchsorted(recording.times, recording.times[0] + seconds, "right"))
    count = min(count, MOST_EPOCHS)
    if count < 10:
        raise ValueError(
            f"the first {seconds:g} s must have at least 10 epochs for tuning, got {count}: use a "
            "longer part (--tune-s)"
        )
    given = local_trial(recording.part(slice(count)), settings)
    ranges = given.recording.links.sum()
    before = float(evidence([given]).log_likelihood.sum() / ranges)
    names = dict.fromkeys(filters or (settings.filter_text,))
    tried = {
        name: _climbed(given._replace(settings=given.settings.changed(filter=name)), advance)
        for name in names
    }
    best = max(tried, key=lambda name: tried[name][0])
    value, found = tried[best]
    if best != settings.filter_text or len(names) > 1:
        found = {"filter": best, **found}
    if recording.odometry is not None:
        # The smoother uses the same laws.
        same = {"constant_std_m": "smooth_constant_m", "drift_std_m": "smooth_bias_std_m"}
        found |= {there: found[here] for here, there in same.items() if here in found}
    # Without the name of the filter, other options may select another filter.
    options = " ".join(
        f"--{name.replace('_', '-')} {value if isinstance(value, str) else f'{value:g}'}"
        for name, value in {"filter": best, **found}.items()
    )
    span = float(np.ptp(given.recording.times))
    after = float(value / ranges)
    return Tuned(settings.changed(**found), found, options, after, before, count, span)


def _climbed(trial: Trial, advance: Callable[[], None]) -> tuple[float, dict[str, Any]]:
    """Return the log-likelihood reached by a search from the settings, and the values found."""
    start = _start(trial)
    names = list(start)
    low, high = np.array([_LIMITS[name] for name in names]).T
    seen: dict[tuple[float, ...], float] = {}

    def values_of(points: list[FloatArray]) -> FloatArray:
        keys = [tuple(point.tolist()) for point in points]
        new = [key for key in dict.fromkeys(keys) if key not in seen]
        trials = [
            trial._replace(settings=trial.settings.changed(**dict(zip(names, key, strict=True))))
            for key in new
        ]
        if trials:
            seen.update(zip(new, evidence(trials).log_likelihood.sum(axis=1), strict=True))
        return np.array([seen[key] for key in keys])

    centre = np.clip(np.array(list(start.values())), low, high)
    for factor in _FACTORS:
        star = [centre]
        for k in range(len(names)):
            for step in (1 / factor, factor):
                point = centre.copy()
                point[k] *= step
                star.append(np.clip(point, low, high))
        values = values_of(star)
        # The maximum of a parabola in the logarithm along each axis; all together if that is
        # better.
        steps = [_top(*values[[2 * k + 1, 0, 2 * k + 2]]) for k in range(len(names))]
        together = np.clip(centre * factor ** np.array(steps), low, high)
        star.append(together)
        centre = star[int(np.argmax(np.append(values, values_of([together]))))]
        advance()
    best = max(seen, key=lambda key: seen[key])
    return seen[best], {name: float(f"{x:.3g}") for name, x in zip(names, best, strict=True)}


def _start(trial: Trial) -> dict[str, float]:
    """Return the current values of the tuned settings."""
    recording, settings = trial
    std = settings.range_std_m
    own = own_std(recording, settings)
    if std is None and own is not None:
        std = float(np.median(own[recording.links]))
    start: dict[str, Any] = {"range_std_m": std or DEFAULT_RANGE_STD_M}
    if recording.odometry is not None:
        known = settings.flat()
        names = ("odometry_m", "odometry_deg", "constant_std_m", "drift_std_m")
        start |= {name: known[name] for name in names}
        return {name: value for name, value in start.items() if value > 0}
    start |= {name: getattr(settings.motion, name) for name in ("walk_m", "walk_deg")}
    if getattr(recording_filter(recording, settings), "twist", None) is not None:
        start |= dict(zip(("accel_m", "accel_deg"), accel_of(settings), strict=True))
    return {name: value for name, value in start.items() if value > 0}


def _top(below: float, here: float, above: float) -> float:
    """Return the maximum of a parabola through values at -1, 0 and 1, at most two away."""
    bend = below - 2 * here + above
    if not bend < 0:
        return 1.0 if above > below else -1.0
    return float(np.clip(0.5 * (below - above) / bend, -2.0, 2.0))
