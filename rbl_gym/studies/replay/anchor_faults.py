"""Find an anchor with a wrong position that the biases of a filter have absorbed."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.measurements import ranging
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.misplaced import ANCHOR_M, LEFT, MOST_OFF_M, Misplaced, misplaced
from rbl_gym.studies.replay.causes import local_trial
from rbl_gym.studies.replay.evidence import Trial, evidence
from rbl_gym.studies.replay.settings import Settings
from rbl_gym.studies.replay.suppositions import likely_height
from rbl_gym.studies.replay.tracking import Track

# An anchor is examined if its bias is above this (m), or if a move of it leaves less than this
# share of the variance of its ranges.
_STRANGE_M, _STRANGE = 0.1, 0.8
# A bias is known if it exceeds this multiple of its standard deviation.
_SURE = 4.0
# A move is believed if it raises the log-likelihood by more than this.
_GAIN = 30.0
# Most epochs that are examined, and their spacing (s) if each has most of the links.
_EPOCHS, _STEP_S = 2_000, 0.1


def anchor_note(recording: Recording, settings: Settings, track: Track) -> list[str]:
    """Return a warning about an anchor whose ranges contradict the others; empty: none does.

    The biases of the filter absorb a wrong position, so that the innovations look sound. An anchor
    is strange if its bias is large for a radio, or if its ranges fit the track better after a move.
    A strange anchor is moved to where it fits a track by the other anchors. The warning names the
    anchor whose move makes the ranges most likely. It names a bias if no move does, but the bias is
    `MOST_OFF_M` above that of the other anchors. If another height of a planar body makes the
    ranges more likely than any move, the warning names the height.
    """
    offset = _relative_biases(recording, track)
    if offset is None or recording.offset is not None or recording.inertial is not None:
        return []
    planar, poses = settings.knowledge.planar, track[1:3]
    seen = np.flatnonzero(recording.links.any(axis=(0, 2)))
    strange = [
        m
        for m in seen.tolist()
        if abs(offset[m]) > _STRANGE_M or _move(recording, *poses, m, planar).left < _STRANGE
    ]
    if not strange:
        return []
    trial = _some(recording, settings)
    moves, gains = _moves(trial, strange, planar)
    if planar:
        # At a wrong height the ranges of low and high anchors err in opposite directions.
        least = max(_GAIN, float(gains.max()))
        height, gain = likely_height(trial, least)
        if gain > least:
            return [f"WARNING: {height.text}. The filter's biases hide the error."]
    # The bias of a filter is of the whole log, and the surest sign.
    largest = max(strange, key=lambda m: abs(offset[m]))
    best = int(np.argmax(gains))
    if abs(offset[largest]) > MOST_OFF_M:
        best = strange.index(largest)
    m, move = strange[best], moves[best]
    turns = move.left < LEFT or abs(offset[m]) > ANCHOR_M
    name = f"WARNING: anchor {recording.anchor_ids[m]}"
    if gains[best] > _GAIN and move.size_m > MOST_OFF_M and turns:
        words = ", ".join(f"{x:+.2f}" for x in move.move_m)
        return [
            f"{name} looks misplaced: its ranges fit those of the other anchors if it is moved by "
            f"({words}) m. Check its position: the filter's biases hide the error."
        ]
    if abs(offset[m]) > MOST_OFF_M:
        side = "long" if offset[m] > 0 else "short"
        return [
            f"{name} may be misplaced, or its radio has a bias: its ranges look "
            f"{abs(offset[m]):.2f} m too {side} relative to those of the other anchors. UWB radios "
            f"differ by about 0.05 m."
        ]
    return []


def _relative_biases(recording: Recording, track: Track) -> FloatArray | None:
    """Return the mean biases (M,) relative to the median anchor; zero if they are not known."""
    if track.biases is None:
        return None
    measured: Any = recording.links.any(axis=0)
    there = measured.any(axis=1)
    if there.sum() < 3:
        return None
    M = len(there)
    share = measured / np.maximum(measured.sum(axis=1, keepdims=True), 1)
    average = (np.eye(M)[:, :, None] * share).reshape(M, -1)
    mean = average @ track.biases.mean_m.ravel()
    offset = np.where(there, mean - np.median(mean[there]), 0.0)
    # A bias that all links share does not count.
    average = average - average[there].mean(axis=0)
    std = np.sqrt(np.einsum("ij,jk,ik->i", average, track.biases.covariance, average))
    return np.where(np.abs(offset) > _SURE * std, offset, 0.0)


def _some(recording: Recording, settings: Settings) -> Trial:
    """Return the epochs that are examined, without the truth."""
    step = 1
    if recording.links.sum() > 0.5 * len(recording.times) * recording.links.any(axis=0).sum():
        step = max(1, int(_STEP_S / np.median(np.diff(recording.times, append=np.inf))))
    part = recording.part(slice(None, None, step))
    return local_trial(part.part(slice(_EPOCHS)), settings)


def _moves(trial: Trial, chosen: list[int], planar: bool) -> tuple[list[Misplaced], FloatArray]:
    """Return the moves of some anchors that fit tracks by the others, and the gains by them.

    A gain is the increase of the log-likelihood of all ranges.
    """
    recording = trial.recording
    without = []
    for m in chosen:
        links = recording.links.copy()
        links[:, m] = False
        without.append(trial._replace(recording=recording._replace(links=links)))
    there = evidence([trial, *without])
    moves, moved = [], []
    for k, m in enumerate(chosen, 1):
        moves.append(_move(recording, there.rotation[k], there.translation[k], m, planar))
        anchors = recording.anchors.copy()
        anchors[..., m, :] += moves[-1].move_m
        moved.append(trial._replace(recording=recording._replace(anchors=anchors)))
    likelihood = [seen.log_likelihood.sum(axis=1) for seen in (there, evidence(moved))]
    return moves, np.nan_to_num(likelihood[1] - likelihood[0][0], nan=-np.inf)


def _move(
    recording: Recording, rotation: FloatArray, translation: FloatArray, m: int, planar: bool
) -> Misplaced:
    """Return the move of an anchor that fits poses (K, ...)."""
    points = ranging.tag_positions(rotation, translation, recording.tags)
    away = recording.anchors_by_epoch[:, m, None] - points
    off, links = recording.ranges[:, m] - np.linalg.norm(away, axis=-1), recording.links[:, m]
    sound = links & np.isfinite(off)
    return misplaced(off, away, sound, planar)
