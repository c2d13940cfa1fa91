"""`rbl-gym calibrate` with truth, as a function: calibrate links, tags, noise and clock."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.estimators.calibration import LinkFit, LinkModel
from rbl_gym.estimators.calibration.clock import Clock
from rbl_gym.estimators.calibration.harmonics import FoundDirections
from rbl_gym.estimators.calibration.link_equations import (
    ARM_M,
    BIAS_M,
    SLOPE,
    TURN_RAD,
    carried_tags,
    directions,
)
from rbl_gym.geometry import rotations
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.calibrate.directed import fit_log, with_directions
from rbl_gym.studies.calibrate.files import write_directions, write_link_table, write_points
from rbl_gym.studies.calibrate.known_path import Log, clock_of, first_turn, log_of, path_at
from rbl_gym.studies.calibrate.outliers import few, outliers
from rbl_gym.studies.calibrate.settings import LinkSettings
from rbl_gym.studies.frozen_truth import frozen_notes
from rbl_gym.studies.replay.overlap import rough_offset, seconds_text

__all__ = ["CalibratedLinks", "calibrate_links"]

# A parameter is undetermined if its standard deviation remains above this share of its prior.
_UNTOLD = 0.5
# Standard deviation (s) of a clock that the ranges do not separate from the tags.
_VAGUE_S = 0.2
# With fewer ranges per link (median), only antenna delays of nodes are estimated.
_FEW_RANGES = 30
# Median noise (m) with its slow share, and median slope of the links, beyond which the geometry is
# taken to be wrong.
_MOST_NOISE_M, _LASTING, _MOST_SLOPE = 0.5, 0.9, 0.1


class CalibratedLinks(NamedTuple):
    """Links calibrated with a recording with truth.

    Attributes
    ----------
    settings
        The settings used.
    fit
        Biases, slopes, tags and noise with standard deviations; residuals of all epochs.
    clock
        Clock of the truth; None if it was given or the ranges do not determine it.
    anchor_ids, tag_ids
        Ids, in the order of the arrays.
    distances
        Distances (K, M, N) along the path, metres; NaN without a range.
    figures
        Plain numbers, as written by `rbl-gym calibrate --json`.
    directions
        Bias by ray direction; None if it was not estimated.
    """

    settings: LinkSettings
    fit: LinkFit
    clock: Clock | None
    anchor_ids: tuple[str, ...]
    tag_ids: tuple[str, ...]
    distances: Any
    figures: dict[str, Any]
    directions: FoundDirections | None = None

    def write(self, folder: str | os.PathLike[str]) -> dict[str, str]:
        """Write the results to a folder; return the paths by name.

        The files are ``calibration.csv``, ``tags.csv`` and, with biases by direction,
        ``directions.csv``.
        """
        paths = {name: os.path.join(folder, f"{name}.csv") for name in ("calibration", "tags")}
        fit = self.fit
        columns = {
            "bias_m": fit.bias_m,
            "slope": fit.slope,
            "sigma_m": fit.noise_std_m,
            "bias_std_m": fit.bias_std_m,
            "slope_std": fit.slope_std,
        }
        ids = self.anchor_ids, self.tag_ids
        write_link_table(paths["calibration"], *ids, columns, fit.counts > 0)
        write_points(paths["tags"], "tag", self.tag_ids, fit.tags)
        if self.directions is not None and self.directions.bias.harmonics:
            paths["directions"] = os.path.join(folder, "directions.csv")
            write_directions(paths["directions"], ids, self.directions.law)
        return paths


def calibrate_links(
    recordings: Recording | Mapping[str, Recording],
    settings: LinkSettings = LinkSettings(),  # noqa: B008 (frozen)
    advance: Callable[[], None] = lambda: None,
) -> CalibratedLinks:
    """Calibrate links, tags and clock by the truth of a recording, or of several runs.

    Parameters
    ----------
    recordings
        A recording with truth, or runs by their names, with the same anchors and tags.
    settings
        Settings of the calibration.
    advance
        Called after each of the four parts of the work.

    Returns
    -------
    CalibratedLinks
        The clock is estimated from range changes (`find_clock`), then links and tags by robust
        least squares (`rbl_gym.estimators.calibration.fit_links`).

    Raises
    ------
    ValueError
        If there is no usable truth, no range has truth, or no calibration makes the ranges agree
        with the anchors, the tags and the truth.
    """
    if isinstance(recordings, Recording):
        recordings = {"": recordings}
    log = log_of(recordings, settings)
    told = settings.time_offset
    start = 0.0 if isinstance(told, str) else float(told)
    turn = first_turn(log, settings, start)
    clock = clock_of(log, settings, log.tags @ turn.T) if told == "auto" else None
    shift = start if clock is None else clock.offset_s
    turn = first_turn(log, settings, shift)
    advance()
    links = log.links & path_at(log, settings, shift)[1][:, None, None]
    if not links.any():
        raise ValueError(
            f"no range has truth within {settings.truth_gap_s:g} s: {_spans(log.runs[0])}; see "
            "time_offset, truth_gap_s and truth_exclude" + _clock_hint(log.runs[0], start)
        )
    biases = settings.biases
    if biases == "auto":
        counts = links.sum(axis=0)
        biases = "link" if np.median(counts[counts > 0]) >= _FEW_RANGES else "node"
    tags = "held" if len(log.tags) == 1 and not log.tags.any() else settings.tags
    first = LinkModel(biases, settings.slopes, "held" if tags == "held" else "turned",
                      settings.planar)  # fmt: skip
    if clock is not None:
        # The clock is more accurate once the tags are at their estimated positions.
        coarse = fit_log(log, settings, first, turn, shift, few=True)
        turn, known = coarse.rotation, clock_of(log, settings, coarse.tags, first)
        if known is None and first.tags != "held":
            # The ranges do not separate the clock from the tags, and the first estimate took the
            # tags as exact.
            known = Clock(clock.offset_s, _VAGUE_S)
        clock = known or clock
        shift = clock.offset_s
    advance()
    fit = fit_log(log, settings, first, turn, shift)
    advance()
    model = first
    if tags == "free":
        model = LinkModel(biases, settings.slopes, "free", settings.planar)
        fit = fit_log(log, settings, model, fit.rotation, shift)
    found = None
    if settings.harmonics or tags == "free":
        fit, found = with_directions(log, settings, model, fit, shift)
    if clock is not None:
        fit = _with_clock(log, settings, model, fit, clock)
    if tags == "free" and found is not None:
        # A first harmonic as large as the others is indistinguishable from a shift of its tag.
        told = fit.tags_std_m > 0
        fit = fit._replace(tags_std_m=np.where(told, np.hypot(fit.tags_std_m, found.spread_m), 0.0))
    _check_fit(fit)
    advance()
    result = _result(log, settings, model, fit, clock, shift, found)
    result.figures["notes"] += [
        f"Note: {f'run {name!r}: ' if name else ''}{note}."
        for name, run in recordings.items()
        for note in frozen_notes(run, shift, settings.truth_exclude)
    ]
    return result


def _check_fit(fit: LinkFit) -> None:
    """Raise ValueError if the links contradict the geometry."""
    told = fit.counts > 0
    noise = float(np.median(fit.noise_std_m[told]))
    # A slope counts where it is determined; half of the links, as one bad anchor is no bad table.
    slopes = np.abs(fit.slope[told & (fit.slope_std < _UNTOLD * SLOPE)])
    slope = float(np.median(slopes)) if len(slopes) else 0.0
    # The noise of a poor radio is large too, but a wrong geometry leaves errors that last.
    wrong = noise > _MOST_NOISE_M and fit.drift.share > _LASTING
    if wrong or slope > _MOST_SLOPE:
        raise ValueError(
            "the ranges contradict anchors, tags and truth: after the calibration the noise of a "
            f"range is {noise:.2g} m and the slope of a link {slope:.2g} (medians). Nothing of it "
            "is usable, nothing is written. Check the axes (x and y swapped?), units and ids of "
            "the anchors and the tags, the frame and heading of the truth, and its clock "
            "(time_offset)"
        )


def _spans(run: Recording) -> str:
    """Return the times of the ranges and of the truth of a run, as text."""
    assert run.truth is not None
    spans = [
        f"{seconds_text(times[0])} to {seconds_text(times[-1])} s"
        for times in (run.times, run.truth.times)
    ]
    return f"ranges {spans[0]}, truth {spans[1]}"


def _clock_hint(run: Recording, told_s: float) -> str:
    """Return a hint if ranges and truth look like those of one run with two clocks."""
    assert run.truth is not None
    offset = rough_offset(run.times + told_s, run.truth)
    if not offset:
        return ""
    total = offset + told_s
    side = "ahead" if total > 0 else "behind"
    return (
        f"; the truth's clock may be {side} by about {seconds_text(abs(total))} s, and auto "
        "searches only up to 1 s: find the offset by rbl-gym replay --time-offset auto, and give it"
    )


def _with_clock(
    log: Log, settings: LinkSettings, model: LinkModel, fit: LinkFit, clock: Clock
) -> LinkFit:
    """Return standard deviations including that of the clock, by two fits to fewer epochs."""
    fits = [
        fit_log(log, settings, model, fit.rotation, shift, few=True)
        for shift in (clock.offset_s, clock.offset_s + clock.std_s)
    ]
    moved = {
        "bias_std_m": fits[1].bias_m - fits[0].bias_m,
        "slope_std": fits[1].slope - fits[0].slope,
        "rotation_std_rad": rotations.error(fits[1].rotation, fits[0].rotation),
        "shift_std_m": fits[1].shift_m - fits[0].shift_m,
        "tags_std_m": np.where(fit.tags_std_m > 0, fits[1].tags - fits[0].tags, 0.0),
    }
    wider: dict[str, Any] = {k: np.hypot(getattr(fit, k), by) for k, by in moved.items()}
    return fit._replace(**wider)


def _result(
    log: Log, settings: LinkSettings, model: LinkModel, fit: LinkFit, clock: Clock | None,
    shift: float, found: FoundDirections | None,
) -> CalibratedLinks:  # fmt: skip
    anchor_ids, tag_ids = log.runs[0].anchor_ids, log.runs[0].tag_ids
    told = fit.counts > 0
    path, known = path_at(log, settings, shift)
    away, distance = directions(log.anchors, carried_tags(path, fit.tags))
    links = log.links & known[:, None, None]
    distance = np.where(links, distance, np.nan)
    left = fit.residuals[log.links & (fit.residuals != 0)]
    figures: dict[str, Any] = {
        "ranges": int(fit.counts.sum()),
        "epochs": len(log.times),
        "biases": model.biases,
        "links": [
            {
                "anchor": anchor_ids[m],
                "tag": tag_ids[n],
                "ranges": int(fit.counts[m, n]),
                "bias_m": float(fit.bias_m[m, n]),
                "bias_std_m": float(fit.bias_std_m[m, n]),
                "slope": float(fit.slope[m, n]),
                "slope_std": float(fit.slope_std[m, n]),
                "noise_std_m": float(fit.noise_std_m[m, n]),
            }
            for m, n in np.argwhere(told)
        ],
        "noise": {
            "std_m": float(np.median(fit.noise_std_m[told])),
            "slow_share": fit.drift.share,
            "slow_time_s": fit.drift.time_s if fit.drift.share else None,
            "beyond_3_std": float((np.abs(left) > 3 * np.median(fit.noise_std_m[told])).mean()),
            "late_quantile_99_m": float(np.quantile(left, 0.99)),
        },
        "time_offset": None if clock is None else {"offset_s": shift, "std_s": clock.std_s},
        "tags": [
            {
                "tag": tag,
                "place_m": fit.tags[n].tolist(),
                "std_m": [float(std) if std > 0 else None for std in fit.tags_std_m[n]],
            }
            for n, tag in enumerate(tag_ids)
        ],
    }
    if fit.node_delay_m is not None and fit.node_delay_std_m is not None:
        names = [*(("anchor", a) for a in anchor_ids), *(("tag", t) for t in tag_ids)]
        figures["nodes"] = [
            {kind: name, "delay_m": float(delay), "std_m": float(std)}
            for (kind, name), delay, std in zip(
                names, fit.node_delay_m, fit.node_delay_std_m, strict=True
            )
        ]
    turn = np.rad2deg(rotations.log(fit.rotation))
    if model.tags == "turned":
        figures["turn"] = {
            "rotation_vector_deg": turn.tolist(),
            "std_deg": np.rad2deg(fit.rotation_std_rad).tolist(),
            "shift_m": fit.shift_m.tolist(),
            "shift_std_m": fit.shift_std_m.tolist(),
        }
    elif model.tags == "free" and len(log.tags) > 1:
        figures["turn"] = _table_beside(log.tags, fit, settings.planar)
    away = -away * distance[..., None]
    figures |= outliers(log.ranges - distance, away, links, (anchor_ids, tag_ids), settings.planar)
    figures["not_determined"] = _untold(fit, model, settings, clock, (anchor_ids, tag_ids), found)
    if found is not None and settings.harmonics:
        figures["directions"] = {
            "bias": found.bias._asdict(),
            "deviation": found.deviation._asdict(),
            "explained": found.gain,
            "size_m": found.spread_m,
        }
    else:
        found = None
    return CalibratedLinks(settings, fit, clock, anchor_ids, tag_ids, distance, figures, found)


def _table_beside(table: Any, fit: LinkFit, planar: bool) -> dict[str, Any]:
    """Return the rigid transform from the table to the estimated tags, and the residuals."""
    a, b = table - table.mean(axis=0), fit.tags - fit.tags.mean(axis=0)
    if planar:
        spread = b[:, :2].T @ a[:, :2]
        angle = np.arctan2(spread[1, 0] - spread[0, 1], spread[0, 0] + spread[1, 1])
        turn = rotations.exp([0.0, 0.0, angle])
    else:
        turn = rotations.nearest(b.T @ a)
    shift = fit.tags.mean(axis=0) - turn @ table.mean(axis=0)
    back = (fit.tags - shift) @ turn
    return {
        "rotation_vector_deg": np.rad2deg(rotations.log(turn)).tolist(),
        "shift_m": shift.tolist(),
        "tags_in_table_axes_m": back.tolist(),
        "off_table_m": (back - table).tolist(),
    }


def _untold(
    fit: LinkFit, model: LinkModel, settings: LinkSettings, clock: Clock | None, ids: Any,
    found: FoundDirections | None,
) -> list[str]:  # fmt: skip
    """Return notes on what the ranges do not determine, one sentence each."""
    said = []
    none = np.argwhere(fit.counts == 0)
    names = [f"{ids[0][m]}-{ids[1][n]}" for m, n in none]
    if names:
        said.append(f"links without ranges: {few(names)}")
    loose = np.argwhere((fit.counts > 0) & (fit.bias_std_m > _UNTOLD * BIAS_M))
    if len(loose):
        said.append(f"bias of {few([f'{ids[0][m]}-{ids[1][n]}' for m, n in loose])}")
    loose = np.argwhere((fit.counts > 0) & (fit.slope_std > _UNTOLD * SLOPE))
    if model.slopes and len(loose):
        said.append(
            f"slope of {few([f'{ids[0][m]}-{ids[1][n]}' for m, n in loose])}: the distances vary "
            "too little; bias and slope trade off"
        )
    if settings.time_offset == "auto" and clock is None:
        said.append("time offset of the truth: the ranges change too little; 0 is assumed")
    axes = "xyz"
    if settings.planar:
        said.append("heights of the tags, and the truth's roll and pitch: the motion is planar")
    if model.tags == "turned":
        turns = [axes[i] for i in np.flatnonzero(fit.rotation_std_rad > _UNTOLD * TURN_RAD)]
        shifts = [axes[i] for i in np.flatnonzero(fit.shift_std_m > _UNTOLD * ARM_M)]
        said += [f"turn of the tags about {axis}" for axis in turns]
        said += [f"shift of the tags along {axis}" for axis in shifts]
    elif model.tags == "free":
        if found is not None and found.spread_m > 0.005:
            said.append(
                f"positions of the tags to better than {found.spread_m:.3f} m: the bias by "
                "direction has harmonics of this size, and the first harmonic of a tag has the "
                "same effect as a shift of the tag"
            )
        for n, i in np.argwhere(fit.tags_std_m > _UNTOLD * ARM_M):
            said.append(f"{axes[i]} of tag {ids[1][n]}")
    return said
