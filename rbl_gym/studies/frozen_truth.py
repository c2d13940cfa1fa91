"""Find spells in which a truth repeats one pose while the ranges show that the body moves."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.recordings.recording import Recording
from rbl_gym.recordings.truth import Truth

# Shortest reported spell (s).
_SHORTEST_S = 0.2
# The ranges of a link are compared in at most so many parts of a spell, of at least so many ranges.
_PARTS, _FEWEST = 8, 4
# The body moves if the medians of the parts of most links change by more than this (m), as ranges
# of a body at rest drift by 0.02 m; and if the probability that noise changes them as much is below
# 1e-6, the probability beyond so many standard deviations.
_CHANGE_M, _DEVIATIONS = 0.05, 4.753
# Variance of a median relative to that of a mean.
_OF_MEDIAN = 0.5 * np.pi


class Spell(NamedTuple):
    """Start and end of a spell, seconds on the clock of the ranges."""

    start_s: float
    end_s: float


def renewed(truth: Truth) -> BoolArray:
    """Return which poses (L,) of a truth differ from the pose before; the first one does."""
    values = truth.translation
    if truth.rotation is not None:
        values = np.column_stack([values, truth.rotation.reshape(-1, 9)])
    return np.append(True, (np.diff(values, axis=0) != 0).any(axis=1))


def frozen_spells(recording: Recording, offset_s: float = 0.0) -> list[Spell]:
    """Return the spells in which the truth repeats one pose, but the ranges change.

    A tracker that loses its markers may repeat its last pose. The ranges tell such a spell from a
    body at rest: the medians of a link over parts of the spell differ by more than their noise. The
    noise is that of the differences of successive ranges.

    Parameters
    ----------
    recording
        A recording with truth.
    offset_s
        How far the clock of the truth is ahead of that of the ranges.
    """
    truth = recording.truth
    assert truth is not None
    first = np.flatnonzero(renewed(truth))
    last = np.append(first[1:], len(truth.times)) - 1
    spans = np.stack([truth.times[first], truth.times[last]], axis=-1) - offset_s
    spans = spans[np.diff(spans)[:, 0] >= _SHORTEST_S]
    if not len(spans):
        return []
    K = len(recording.times)
    ranges, links = recording.ranges.reshape(K, -1), recording.links.reshape(K, -1)
    steps = np.concatenate([np.diff(ranges[there, k]) for k, there in enumerate(links.T)])
    if not len(steps):
        return []
    noise = 1.4826 * float(np.median(np.abs(steps))) / np.sqrt(2)
    return [
        Spell(*span)
        for span in spans.tolist()
        if _moves(ranges, links, slice(*np.searchsorted(recording.times, span)), noise)
    ]


def _moves(ranges: FloatArray, links: BoolArray, inside: slice, noise_m: float) -> bool:
    """Return whether the ranges (K, L) of a spell change by more than their noise."""
    squares, freedom = 0.0, 0
    changes = []
    for of_link, there in zip(ranges[inside].T, links[inside].T, strict=True):
        measured = of_link[there]
        count = min(len(measured) // _FEWEST, _PARTS)
        if count < 2:
            continue
        parts = np.array_split(measured, count)
        middle = np.array([np.median(part) for part in parts])
        sizes = np.array([len(part) for part in parts])
        squares += float((sizes * (middle - np.average(middle, weights=sizes)) ** 2).sum())
        freedom += count - 1
        changes.append(np.ptp(middle))
    if not changes or np.median(changes) < _CHANGE_M:
        return False
    # The quantile of chi-square by Wilson and Hilferty: scipy.special takes long to import.
    spread = 2 / (9 * freedom)
    quantile = freedom * (1 - spread + _DEVIATIONS * math.sqrt(spread)) ** 3
    return squares > quantile * _OF_MEDIAN * noise_m**2


def frozen_notes(
    recording: Recording, offset_s: float = 0.0, excluded: Iterable[tuple[float, float]] = ()
) -> list[str]:
    """Return a note on the spells of `frozen_spells` outside the `excluded` times, if any."""
    windows = list(excluded)
    spells = [
        (start, end)
        for start, end in frozen_spells(recording, offset_s)
        if not any(low <= start and end <= high for low, high in windows)
    ]
    if not spells:
        return []
    start, end = max(spells, key=lambda spell: spell[1] - spell[0])
    text = "the truth repeats one pose"
    if len(spells) > 1:
        text += f" in {len(spells)} spells, the longest"
    low, high = math.floor(100 * start) / 100, math.ceil(100 * end) / 100
    return [
        f"{text} for {end - start:.2f} s from {low:.2f} s on, while the ranges change: the "
        f"tracker may have lost the body. To leave this out, give --truth-exclude "
        f"{low:.2f}:{high:.2f}"
    ]
