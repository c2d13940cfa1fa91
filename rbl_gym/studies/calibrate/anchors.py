"""`rbl-gym calibrate` without truth, as a function: survey anchors by the log of a moving body."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from rbl_gym.checks import FloatArray, check_count, check_number, check_one_of, did_you_mean
from rbl_gym.estimators.calibration.drift import find_drift
from rbl_gym.estimators.calibration.survey import Survey, SurveyModel, SurveyState, adjust
from rbl_gym.estimators.calibration.survey_start import (
    anchors_from_pairs,
    anchors_from_points,
    start_from_anchors,
)
from rbl_gym.geometry import rotations
from rbl_gym.recordings import align_positions, apply_alignment
from rbl_gym.recordings.recording import Recording
from rbl_gym.recordings.tables import AnyPath, read_table
from rbl_gym.studies.calibrate.files import write_link_table, write_points

__all__ = ["AnchorSettings", "SurveyedAnchors", "read_anchor_ranges", "survey_anchors"]

# Biases (m) to try if anchors are found without start positions.
_BIASES = (0.0, 0.15, 0.3)
# A larger relative standard deviation of the scale is reported.
_SCALE = 0.002


@dataclass(frozen=True)
class AnchorSettings:
    """Settings for surveying anchors.

    Parameters
    ----------
    start
        ``"table"``: from the positions in the recording, which may be rough. ``"ranges"``: without
        positions.
    known
        Ids of anchors with known positions.
    bias_m, bias_std_m, link_std_m, planar
        As in `rbl_gym.estimators.calibration.survey.SurveyModel`.
    height_offset_m
        Mean height of the anchors minus that of the tags, if planar.
    epochs
        Maximum number of epochs used, evenly spread.
    """

    start: str = "table"
    known: tuple[str, ...] = ()
    bias_m: float = 0.0
    bias_std_m: float = 0.5
    link_std_m: float = 0.05
    planar: bool = False
    height_offset_m: float = 0.0
    epochs: int = 1500

    def __post_init__(self) -> None:
        check_one_of("start", self.start, ("table", "ranges"))
        check_number("height_offset_m", self.height_offset_m)
        check_count("epochs", self.epochs)
        _ = self.model

    @property
    def model(self) -> SurveyModel:
        """Return the model of the estimator."""
        return SurveyModel(self.bias_m, self.bias_std_m, self.link_std_m, self.planar)


class SurveyedAnchors(NamedTuple):
    """Anchors surveyed with a recording without truth.

    Attributes
    ----------
    settings
        The settings used.
    survey
        Anchors, poses, biases, covariance, residuals.
    times
        Times (K,) of the epochs used.
    links
        Links (M, N) with ranges.
    anchor_ids, tag_ids
        Ids, in the order of the arrays.
    figures
        Plain numbers, as written by `rbl-gym calibrate --json`.
    """

    settings: AnchorSettings
    survey: Survey
    times: FloatArray
    links: Any
    anchor_ids: tuple[str, ...]
    tag_ids: tuple[str, ...]
    figures: dict[str, Any]

    def write(self, folder: str | os.PathLike[str]) -> dict[str, str]:
        """Write ``anchors.csv`` and ``calibration.csv`` to a folder; return their paths by name."""
        paths = {name: os.path.join(folder, f"{name}.csv") for name in ("anchors", "calibration")}
        state = self.survey.state
        write_points(paths["anchors"], "anchor", self.anchor_ids, state.anchors)
        bias = state.bias_m + state.link_m
        columns = {
            "bias_m": bias,
            "slope": np.zeros_like(bias),
            "sigma_m": np.full_like(bias, self.survey.noise_std_m),
        }
        ids = self.anchor_ids, self.tag_ids
        write_link_table(paths["calibration"], *ids, columns, self.links)
        return paths


def read_anchor_ranges(path: AnyPath, anchor_ids: tuple[str, ...]) -> FloatArray:
    """Read ranges between anchors: a table with the columns anchor_a, anchor_b and range.

    Parameters
    ----------
    path
        Text with a header; ranges in metres. A pair may occur several times: the median is used.
    anchor_ids
        Ids of the M anchors.

    Returns
    -------
    pairs
        Ranges (M, M) in metres, 0 without a range.

    Raises
    ------
    ValueError
        If an anchor is unknown, a pair joins an anchor to itself, or a range is not positive. The
        message names the line.
    """
    table = read_table(path)
    table.require("anchor_a", "anchor_b", "range")
    a, b = (table.positions(column, anchor_ids) for column in ("anchor_a", "anchor_b"))
    for column, at in (("anchor_a", a), ("anchor_b", b)):
        table.check(at >= 0, column, "unknown anchor")
    table.check(a != b, "anchor_b", "must be another anchor than anchor_a")
    values = table.numbers("range")
    table.check(values > 0, "range", "range must be positive")
    pairs = np.zeros((len(anchor_ids),) * 2)
    for i, j in {*zip(a.tolist(), b.tolist(), strict=True)}:
        pairs[i, j] = np.median(values[(a == i) & (b == j)])
    return pairs


def survey_anchors(
    recording: Recording,
    settings: AnchorSettings = AnchorSettings(),
    pairs: FloatArray | None = None,
    advance: Callable[[], None] = lambda: None,
) -> SurveyedAnchors:
    """Estimate anchor positions and biases from the ranges of a moving body.

    Parameters
    ----------
    recording
        The recording; its truth is not used. Anchors must be fixed; a table of tags is needed.
    settings
        Start, known anchors, biases.
    pairs
        Ranges (M, M) between anchors, metres, 0 without a range (`read_anchor_ranges`).
    advance
        Called after each of the three parts of the work.

    Returns
    -------
    SurveyedAnchors
        If the frame is unknown: with a table, the mean shift and rotation from it are zero;
        without one, the first anchor is the origin and the second is on the x axis.

    Raises
    ------
    ValueError
        If anchors move, an id is unknown, no start is found, or there are too few ranges.
    """
    if recording.anchors.ndim > 2:
        raise ValueError("anchors must be fixed to be surveyed, got moving anchors")
    unknown = [name for name in settings.known if name not in recording.anchor_ids]
    if unknown:
        raise ValueError(
            f"known must be anchors of the recording, got {unknown[0]!r}; the anchors are "
            f"{', '.join(recording.anchor_ids):.200}"
            f"{did_you_mean(unknown[0], recording.anchor_ids)}"
        )
    known = np.isin(recording.anchor_ids, settings.known)
    at = slice(None, None, -(-len(recording.times) // settings.epochs))
    ranges, links, times = recording.ranges[at], recording.links[at], recording.times[at]
    some = links.any(axis=(1, 2))
    ranges, links, times = ranges[some], links[some], times[some]
    start = _start(recording, settings, known, ranges, links, pairs)
    advance()
    told = (ranges, links, recording.tags)
    first = adjust(*told, start, settings.model, known, pairs)
    advance()
    lasting = _lasting(first, links, times)
    survey = adjust(*told, first.state, settings.model, known, pairs, lasting)
    if settings.start == "ranges" and not known.any():
        survey = _in_own_frame(survey, settings.planar)
    advance()
    return _result(recording, settings, survey, times, links, known)


def _lasting(first: Survey, links: Any, times: FloatArray) -> float:
    """Return the correlation length of errors in epochs."""
    K = len(times)
    z = (first.residuals / first.noise_std_m).reshape(K, -1)
    drift = find_drift(z, links.reshape(K, -1), times)
    step = float(np.median(np.diff(times))) if K > 1 else 1.0
    a = np.exp(-step / drift.time_s)
    return 1 - drift.share + drift.share * (1 + a) / (1 - a)


def _start(
    recording: Recording, settings: AnchorSettings, known: Any, ranges: FloatArray, links: Any,
    pairs: FloatArray | None,
) -> SurveyState:  # fmt: skip
    tags, table, planar = recording.tags, recording.anchors, settings.planar
    height = float(table[:, 2].mean()) - settings.height_offset_m - float(tags[:, 2].mean())
    if settings.start == "table":
        return start_from_anchors(ranges, links, table, tags, settings.bias_m, planar, height)
    M = len(table)
    layouts = []
    if pairs is not None and connected_components((pairs + pairs.T) > 0)[0] == 1:
        layouts.append((anchors_from_pairs(pairs, settings.bias_m, planar), settings.bias_m))
    points = ranges.transpose(0, 2, 1).reshape(-1, M), links.transpose(0, 2, 1).reshape(-1, M)
    for more in _BIASES:
        bias = settings.bias_m + more
        layout = anchors_from_points(*points, bias, planar)
        if layout is not None:
            layouts.append((layout, bias))
    if not layouts:
        raise ValueError(
            f"{M} anchors cannot be located without rough positions, as this takes "
            f"{6 if planar else 10} or more anchors in range of a tag at one time, or ranges "
            "between the anchors: give rough positions and set start to 'table'"
        )
    best: tuple[float, SurveyState] | None = None
    for layout, bias in layouts:
        for mirror in (1.0, -1.0):
            anchors = layout * np.array([1.0, mirror, 1.0])
            if known.sum() >= (2 if planar else 3):
                mode = "yaw" if planar else "se3"
                onto = align_positions(anchors[known], table[known], mode)
                anchors = apply_alignment(onto, None, anchors)[1]
                anchors[known] = table[known]
            if planar:
                anchors[:, 2] = table[:, 2]
            state = start_from_anchors(ranges, links, anchors, tags, bias, planar, height)
            left = _misfit(ranges, links, tags, state)
            if best is None or left < best[0]:
                best = left, state
    assert best is not None
    return best[1]


def _misfit(ranges: FloatArray, links: Any, tags: FloatArray, state: SurveyState) -> float:
    places = np.einsum("kij,nj->kni", state.rotation, tags) + state.translation[:, None]
    d = np.linalg.norm(places[:, None] - state.anchors[:, None], axis=-1)
    left = (ranges - d - state.bias_m)[links]
    return float(np.median(np.abs(left))) if left.size else 0.0


def _in_own_frame(survey: Survey, planar: bool) -> Survey:
    """Move the first anchor to the origin (planar: keep its height), the second to the x axis."""
    state = survey.state
    along = state.anchors[1] - state.anchors[0]
    turn = rotations.exp([0.0, 0.0, -np.arctan2(along[1], along[0])])
    if not planar:
        along = turn @ along
        turn = rotations.exp([0.0, np.arctan2(along[2], along[0]), 0.0]) @ turn
        if len(state.anchors) > 2:
            third = turn @ (state.anchors[2] - state.anchors[0])
            turn = rotations.exp([-np.arctan2(third[2], third[1]), 0.0, 0.0]) @ turn
    origin = state.anchors[0] * ([1, 1, 0] if planar else [1, 1, 1])
    M = len(state.anchors)
    whole = np.eye(3 * M + 1)
    whole[: 3 * M, : 3 * M] = np.kron(np.eye(M), turn)
    covariance = whole @ survey.covariance @ whole.T
    moved = state._replace(
        anchors=(state.anchors - origin) @ turn.T,
        rotation=turn @ state.rotation,
        translation=(state.translation - origin) @ turn.T,
    )
    std = np.sqrt(np.maximum(np.diag(covariance)[:-1], 0.0)).reshape(M, 3)
    return survey._replace(state=moved, std_m=std, covariance=covariance)


def _result(
    recording: Recording, settings: AnchorSettings, survey: Survey, times: FloatArray, links: Any,
    known: Any,
) -> SurveyedAnchors:  # fmt: skip
    state = survey.state
    ids = recording.anchor_ids, recording.tag_ids
    said = []
    if survey.scale_std > _SCALE:
        said.append(
            f"size of the layout to better than {100 * survey.scale_std:.2g} %: it is correlated "
            f"with the common bias (correlation {survey.scale_bias_correlation:.2f}, bias +- "
            f"{survey.bias_std_m:.3f} m); give bias_m and bias_std_m, or a known pair of anchors"
        )
    if settings.planar:
        said.append("heights: the heights are held")
    arms = recording.tags - recording.tags.mean(axis=0)
    rank = np.linalg.matrix_rank(arms[:, : 2 if settings.planar else 3], tol=1e-3)
    if rank < (2 if settings.planar else 3) and known.sum() < 3 and settings.start == "ranges":
        said.append("which of two mirror images the layout is: the tags do not determine it")
    frame = (
        "that of the known anchors"
        if known.sum() >= (2 if settings.planar else 3)
        else "that of the known anchors; the rotation that they leave open is that of the table"
        if known.any()
        else "that of the table; the mean shift and rotation of the anchors against it are zero"
        if settings.start == "table"
        else f"anchor {ids[0][0]} is the origin, anchor {ids[0][1]} lies on the x axis"
    )
    figures = {
        "ranges": int(links.sum()),
        "epochs": len(times),
        "frame": frame,
        "anchors": [
            {
                "anchor": name,
                "place_m": state.anchors[m].tolist(),
                "std_m": survey.std_m[m].tolist(),
                "known": bool(known[m]),
                "moved_m": float(np.linalg.norm(state.anchors[m] - recording.anchors[m]))
                if settings.start == "table"
                else None,
            }
            for m, name in enumerate(ids[0])
        ],
        "common_bias_m": state.bias_m,
        "common_bias_std_m": survey.bias_std_m,
        "link_bias_m": state.link_m.tolist(),
        "scale_std": survey.scale_std,
        "scale_bias_correlation": survey.scale_bias_correlation,
        "noise_std_m": survey.noise_std_m,
        "not_determined": said,
    }
    return SurveyedAnchors(settings, survey, times, links.any(axis=0), *ids, figures)
