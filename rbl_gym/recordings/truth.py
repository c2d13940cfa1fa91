"""Reference poses: read from a file, and between their times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import motion
from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number
from rbl_gym.geometry import rotations
from rbl_gym.recordings.report import Said
from rbl_gym.recordings.tables import AS_NAMED, AnyPath, Source, Table, read_table

__all__ = ["Truth", "read_truth", "truth_at"]

MAX_YAW_DEG = 1e6


class Truth(NamedTuple):
    """Reference poses of the body, ``p_world = rotation @ p_body + translation``."""

    times: FloatArray  # (L,) seconds, strictly increasing
    rotation: FloatArray | None  # (L, 3, 3); None: positions alone
    translation: FloatArray  # (L, 3) metres
    planar: bool = False  # height, roll and pitch are not known: 0 where they stand
    form: str = "poses"  # how the file had it, in words


def truth_at(
    truth: Truth, times: ArrayLike, max_gap_s: float = 0.5
) -> tuple[FloatArray | None, FloatArray, BoolArray]:
    """Truth at other times: linear in position, along the geodesic in rotation.

    Parameters
    ----------
    truth, times
        Reference poses; the times they are wanted at, (..., K) seconds.
    max_gap_s
        Longest gap between two reference poses that is bridged, seconds.

    Returns
    -------
    rotation, translation
        (..., K, 3, 3) and (..., K, 3) metres; finite but meaningless where not `valid`. The
        rotation is None where the truth has none.
    valid
        (..., K) False outside the truth's time span and inside a gap longer than `max_gap_s`.

    Raises
    ------
    ValueError
        If `times` is empty or not finite, or `max_gap_s` is negative.
    """
    times = check_array("times", times, ("K",))
    max_gap_s = check_number("max_gap_s", max_gap_s, low=0.0)
    last = len(truth.times) - 1
    left = np.clip(np.searchsorted(truth.times, times, side="right") - 1, 0, last)
    right = np.minimum(left + 1, last)
    elapsed, gap = times - truth.times[left], truth.times[right] - truth.times[left]
    turned = truth.rotation
    still = np.broadcast_to(np.eye(3), (len(truth.times), 3, 3))
    known = still if turned is None else turned
    path = motion.interpolate(truth.times, known, truth.translation, times)
    inside = (times >= truth.times[0]) & (times <= truth.times[-1])
    return (
        None if turned is None else path.rotation,
        path.translation,
        inside & ((gap <= max_gap_s) | (elapsed == 0)),
    )


def read_truth(
    path: AnyPath,
    source: Source = AS_NAMED,
    said: Said | None = None,
    *,
    run: str | None = None,
    times: FloatArray | None = None,
) -> Truth:
    """The reference poses of a file.

    Parameters
    ----------
    path, source, said
        The file, how its columns are named, and who takes down what was found.
    run
        Where the file has a column `run`, the one that is meant.
    times
        Of a file without times that has one pose: those at which the body stands there.

    Raises
    ------
    ValueError
        If the file is not as `read_recording` describes it.
    """
    said = said or Said()
    table = read_table(path, source)
    if run is not None and "run" in table.columns:
        rows = np.array([cell == run for cell in table.text("run")])
        if not rows.any():
            raise ValueError(f"{table.path}: has no run {run!r} in column {table.name('run')!r}")
        table = table.select(rows)
    rotation, translation, read = _poses(table)
    said.read(table, (*read, "run"))
    if "t" not in table.columns and times is not None and len(table.lines) == 1:
        shape = len(times), 3
        return Truth(
            times, np.broadcast_to(rotation, (*shape, 3)), np.broadcast_to(translation, shape)
        )
    return Truth(table.times(), rotation, translation)


def _poses(table: Table) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Rotations (L, 3, 3), translations (L, 3), and the columns that they are of."""
    if "yaw_deg" in table.columns:
        angles = [a for a in ("roll_deg", "pitch_deg", "yaw_deg") if a in table.columns]
        places = [axis for axis in "xyz" if axis in table.columns]
        table.require("x", "y", *(("z", "roll_deg", "pitch_deg") if len(angles) > 1 else ()))
        must = f"must be at most {MAX_YAW_DEG:g} in magnitude"
        rotation = np.eye(3)
        for angle in reversed(angles):  # ZYX: about z, then about the new y, then about the new x
            turn = table.numbers(angle)
            table.check(np.abs(turn) <= MAX_YAW_DEG, angle, must)
            axis = np.eye(3)[("roll_deg", "pitch_deg", "yaw_deg").index(angle)]
            rotation = rotation @ rotations.exp(np.radians(turn)[:, None] * axis)
        translation = np.pad(table.points(places), ((0, 0), (0, 3 - len(places))))
        return rotation, translation, ("t", *places, *angles)

    names = ("qw", "qx", "qy", "qz")
    table.require("x", "y", "z", *names)
    q = np.stack([table.numbers(name) for name in names], axis=-1)
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(q, axis=-1)
    table.check(np.abs(norm - 1) <= 1e-2, "qw", "quaternion norm must be 1 within 0.01", got=norm)
    return rotations.from_quaternion(q), table.points("xyz"), ("t", *"xyz", *names)
