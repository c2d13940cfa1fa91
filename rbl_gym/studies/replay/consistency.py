"""Check the consistency of a log without truth: NIS, residuals of anchors, tags and links."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators import Innovations
from rbl_gym.estimators.innovation import GATE
from rbl_gym.recordings.recording import Recording

__all__ = ["contradicts", "nis_curve", "residual_tables"]

# The data contradict a filter if the NIS of a log, or of a part of this size, exceeds a multiple of
# its expectation, or if more than a share of the ranges is rejected; and if the probability of this
# by chance is below a limit.
MOST_NIS, MOST_REJECTED, _PART = 1.5, 0.2, 0.1
_CHANCE = 1e-6
_BLOCKS = 20
# The data also contradict it in two other cases, each with at least `_FEWEST` ranges. First, the
# mean squared whitened innovation of an anchor or tag (rejected ones clipped) exceeds
# `_MOST_SQUARE`, and `_BEYOND_OTHERS` times the median over all of them. Second, more than half of
# the innovations of a link exceed `_FAR` standard deviations. `_FAR_BEYOND` times the median is
# enough: noise that is assumed too large does not hide a bad anchor.
_MOST_SQUARE, _BEYOND_OTHERS, _FAR_BEYOND, _FAR, _FEWEST = 2.5, 2.0, 3.0, 2.0, 20


def consistency_figures(found: Innovations, recording: Recording) -> dict[str, Any]:
    """Return how well a filter predicted a log, in plain numbers.

    ``nis_per_dof`` (1 if the filter is consistent), ``log_likelihood`` (per range),
    ``rejected_share``, ``contradicts``, and the tables of `residual_tables`, from innovations (K,
    ...).
    """
    ranges, used = int(recording.links.sum()), int(found.dof.sum())
    return {
        "nis_per_dof": float(found.nis.sum() / max(used, 1)),
        "log_likelihood": float(found.log_likelihood.sum() / ranges),
        "rejected_share": 1 - used / ranges,
        "contradicts": contradicts(found, recording),
        "residuals": residual_tables(found, recording),
    }


def contradicts(found: Innovations, recording: Recording) -> bool:
    """Return whether the ranges of a log contradict the filter."""
    whole, parts = (_is_strained(*_sums(found, recording, n)) for n in (1, _BLOCKS))
    if whole[0] or parts.sum() >= max(2, _PART * len(parts)):
        return True
    links = recording.links
    z = _whitened(found, links)
    far = np.abs(z) > _FAR
    for other in ((0, 1), (0, 2)):
        mean = _mean_squares(z, links, other)
        if len(mean):
            usual = np.median(mean)
            most = max(_MOST_SQUARE, _BEYOND_OTHERS * usual)
            if mean.max() > min(most, _FAR_BEYOND * usual):
                return True
    count = links.sum(axis=0)
    return bool(((far.sum(axis=0) > 0.5 * count) & (count >= _FEWEST)).any())


def typical_square(found: Innovations, recording: Recording) -> float:
    """Return the mean squared whitened innovation of the median anchor: 1 if consistent."""
    links = recording.links
    mean = _mean_squares(_whitened(found, links), links, (0, 2))
    return float(np.median(mean)) if len(mean) else 1.0


def _whitened(found: Innovations, links: BoolArray) -> FloatArray:
    return np.divide(found.innovation, found.std, out=np.zeros(links.shape), where=links)


def _mean_squares(z: FloatArray, links: BoolArray, axes: tuple[int, int]) -> FloatArray:
    """Return mean squares of anchors or tags with enough ranges; rejected ranges are clipped."""
    count = links.sum(axis=axes)
    return (np.minimum(z**2, GATE**2).sum(axis=axes) / np.maximum(count, 1))[count >= _FEWEST]


def _sums(found: Innovations, recording: Recording, blocks: int) -> tuple[FloatArray, ...]:
    """Return NIS, used and rejected ranges for this number of parts of a log."""
    links = recording.links.sum(axis=(1, 2))
    starts = np.unique(np.linspace(0, len(links), blocks, endpoint=False).astype(int))
    nis, dof, links = (np.add.reduceat(a, starts) for a in (found.nis, found.dof, links))
    return nis, dof, links - dof


def _is_strained(nis: FloatArray, dof: FloatArray, refused: FloatArray) -> BoolArray:
    lost = refused > MOST_REJECTED * (dof + refused)
    # A single wrong range among five is not reported.
    high = nis > MOST_NIS * dof
    if high.any():
        high &= nis > scipy.special.chdtri(np.maximum(dof, 1), _CHANCE)
    return high | (lost & (refused > _BLOCKS))


def residual_tables(found: Innovations, recording: Recording) -> dict[str, list[dict[str, Any]]]:
    """Return tables of residuals after the update, by anchor, by tag and by link.

    A row has the ids, ``ranges`` (their number), ``mean_m`` over the used ranges, ``spread_m`` over
    all ranges, and ``rejected_share``. The spread is 1.4826 times the median distance from the
    median, which is the standard deviation of a Gaussian. Points and links without ranges have no
    row.
    """
    links = recording.links
    M, N = links.shape[1:]
    rows: dict[str, list[dict[str, Any]]] = {"anchors": [], "tags": [], "links": []}
    for m, name in enumerate(recording.anchor_ids):
        row = _row(found, links, (slice(None), m))
        rows["anchors"] += [{"anchor": name, **row}] if row else []
    for n, name in enumerate(recording.tag_ids):
        row = _row(found, links, (slice(None), slice(None), n))
        rows["tags"] += [{"tag": name, **row}] if row else []
    for m, n in np.ndindex(M, N):
        row = _row(found, links, (slice(None), m, n))
        ids = {"anchor": recording.anchor_ids[m], "tag": recording.tag_ids[n]}
        rows["links"] += [{**ids, **row}] if row else []
    return rows


def _row(found: Innovations, links: Any, index: tuple[Any, ...]) -> dict[str, Any]:
    measured = links[index]
    count = int(measured.sum())
    if not count:
        return {}
    residual, used = found.residual[index][measured], found.used[index][measured]
    middle = np.median(residual)
    return {
        "ranges": count,
        "mean_m": float(residual[used].mean()) if used.any() else None,
        "spread_m": float(1.4826 * np.median(np.abs(residual - middle))),
        "rejected_share": float(1 - used.mean()),
    }


def nis_curve(
    times: FloatArray, found: Innovations, points: int = 400
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the NIS per degree of freedom over time, in a limited number of points.

    Returns
    -------
    Times, NIS over degrees of freedom of the epochs around each, and the interval that contains
    95 % of them if the filter is consistent.
    """
    starts = np.unique(np.linspace(0, len(times), points, endpoint=False).astype(int))
    starts = starts[starts < len(times)]
    nis, dof, when = (np.add.reduceat(a, starts) for a in (found.nis, found.dof, times))
    when = when / np.diff(starts, append=len(times))
    some = dof > 0
    when, nis, dof = when[some], nis[some], dof[some]
    low, high = (scipy.special.chdtri(dof, p) / dof for p in (0.975, 0.025))
    return when, nis / dof, low, high
