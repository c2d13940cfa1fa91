"""Find which pose directions the ranges of a recording determine, and since when."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.tracking import Track

__all__ = ["Observed", "observed"]

# A direction is known if its standard deviation is below this rotation (rad) or position (m).
_KNOWN_RAD, _KNOWN_M = 0.5, 1.0
# Above this standard deviation the direction of an axis may be any (deg).
_ANY_DEG = 100.0


class Observed(NamedTuple):
    """The known directions of the pose, epoch by epoch.

    Attributes
    ----------
    turns, places
        Number (K,) of known directions of the rotation and of the position, of three each: standard
        deviation below 0.5 rad and below 1 m. The position is that of the tag centre.
    turn_axes
        Principal axes of the rotation error in the body frame, columns of (K, 3, 3), the best known
        first.
    turn_std, place_std
        Standard deviations (K, 3) along the principal axes, rad and m.
    """

    turns: np.ndarray
    places: np.ndarray
    turn_axes: FloatArray
    turn_std: FloatArray
    place_std: FloatArray


def observed(track: Track, tags: FloatArray) -> Observed:
    """Return the known directions of the beliefs (K,) of a track; tags (N, 3)."""
    Q, P = track.rotation, track.covariance
    moved = track.at_centre
    if moved is None:
        # Covariance at the tag centre: v + w x Q c.
        T = np.broadcast_to(np.eye(6), P.shape).copy()
        T[:, 3:, :3] = -rotations.hat(Q @ tags.mean(axis=0))
        moved = T @ P @ np.swapaxes(T, -1, -2)
    values, axes = np.linalg.eigh(np.swapaxes(Q, -1, -2) @ P[:, :3, :3] @ Q)
    turn = np.sqrt(np.maximum(values, 0.0))
    place = np.sqrt(np.maximum(np.linalg.eigvalsh(moved[:, 3:, 3:]), 0.0))
    return Observed(
        (turn < _KNOWN_RAD).sum(axis=-1), (place < _KNOWN_M).sum(axis=-1), axes, turn, place
    )


def known_figures(recording: Recording, track: Track) -> tuple[dict[str, Any], list[str]]:
    """Return the number of known directions, since when, and notes on the unknown ones."""
    found, times = observed(track, recording.tags), track.times - track.times[0]
    known = found.turns + found.places
    result: dict[str, Any] = {
        "known_directions": int(known[-1]),
        "known_directions_since_s": _since(known, times),
        "undetermined": [],
    }
    notes = []
    if found.turns[-1] < 3:
        spread = np.rad2deg(found.turn_std[-1, found.turns[-1] :])
        what = (
            "the rotation",
            f"the rotation, except that about the body's axis {_axis(found.turn_axes[-1, :, 0])}",
            f"the rotation about the body's axis {_axis(found.turn_axes[-1, :, 2])}",
        )[int(found.turns[-1])]
        result["undetermined"].append(what)
        std = f"{spread.max():.0f} deg" if spread.max() < _ANY_DEG else None
        middle = recording.tags.mean(axis=0)
        if found.turns[-1] == 2:
            axis = found.turn_axes[-1, :, 2]
            middle = middle - (middle @ axis) * axis
        lever = float(np.linalg.norm(middle))
        far = lever > found.place_std[-1].max()
        notes.append(_note(what, std, _since(found.turns, times), lever if far else None))
    if found.places[-1] < 3:
        result["undetermined"].append("the position")
        spread = found.place_std[-1].max()
        notes.append(_note("the position", f"{spread:.3g} m", _since(found.places, times)))
    return result, notes


def _since(count: np.ndarray, times: FloatArray) -> float:
    """Return the time from which a count keeps its final value."""
    other = np.flatnonzero(count != count[-1])
    return float(times[other[-1] + 1]) if len(other) else 0.0


def _axis(axis: FloatArray) -> str:
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return "(" + ", ".join(f"{x:.2f}" for x in axis + 0.0) + ")"


def _note(what: str, std: str | None, since: float, lever_m: float | None = None) -> str:
    """Return a note, a warning if the origin of the body is `lever_m` away from the tags."""
    when = "since the start" if since == 0 else f"since {since:.1f} s after the start"
    spread = "it may have any value" if std is None else f"its standard deviation is {std}"
    text = f"the ranges do not determine {what} ({when}): {spread} at the end."
    if lever_m is None:
        return f"Note: {text} The covariance includes this."
    return (
        f"WARNING: {text} The origin of the body is {lever_m:.2f} m away from the tags, so its "
        "position is unknown by as much; the covariance includes this. State what is known "
        "(--planar with --height-m, or --tilt-std-deg), or give the tags relative to their centre."
    )
