"""Tracks as files: TUM, which other tools read, or CSV with covariance, and reading them back."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.geometry import rotations
from rbl_gym.recordings.tables import AnyPath, Table, read_table
from rbl_gym.recordings.truth import read_truth

__all__ = ["TrackFile", "check_track_path", "read_track", "write_track"]

_TUM, _CSV = (".tum", ".txt"), (".csv",)
_POSE = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")
_ERROR = ("rx", "ry", "rz", "x", "y", "z")
_UPPER = np.triu_indices(6)
_COVARIANCE = tuple(f"cov_{_ERROR[i]}_{_ERROR[j]}" for i, j in zip(*_UPPER, strict=True))


class TrackFile(NamedTuple):
    """A track of K epochs, as a file holds it.

    Attributes
    ----------
    times
        (K,), seconds.
    rotation, translation
        (K, 3, 3), and (K, 3) in metres.
    covariance
        (K, 6, 6) of the pose error (w, v), ``Q_hat = exp(w) Q``, ``t_hat = t + v``, radians and
        metres; None where the file has none, as TUM.
    nis, dof
        Normalised innovation squared (K,) of each epoch's ranges, and of how many it is (K,);
        None where the file has none.
    rank
        How many of the six directions of the pose the ranges of each epoch determine (K,); None
        where the file has none.
    """

    times: FloatArray
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray | None = None
    nis: FloatArray | None = None
    dof: NDArray[np.int64] | None = None
    rank: NDArray[np.int64] | None = None


def check_track_path(path: AnyPath) -> None:
    """Raise ValueError unless the ending says a format: ``.tum`` or ``.txt``, or ``.csv``."""
    if Path(path).suffix.lower() not in _TUM + _CSV:
        raise ValueError(
            f"{os.fspath(path)}: a track must end in .tum or .txt (TUM) or in .csv, with covariance"
        )


def write_track(path: AnyPath, track: TrackFile) -> None:
    """Write a track; the ending of the file says how.

    ``.tum`` and ``.txt``: ``t x y z qx qy qz qw`` without a header. ``.csv``: a header;
    ``t,x,y,z,qw,qx,qy,qz``, then, where the track has them, the upper triangle of the covariance by
    rows, ``cov_rx_rx,cov_rx_ry,...,cov_z_z``, and ``nis,dof,rank``. Numbers have all their digits.

    Parameters
    ----------
    path
        Of the file.
    track
        What is written. An infinite NIS is an empty cell.

    Raises
    ------
    ValueError
        On another ending, or arrays that are not as `TrackFile` says.
    OSError
        If the file cannot be written.
    """
    check_track_path(path)
    times = check_array("times", track.times, ("K",))
    q = rotations.quaternion(check_array("rotation", track.rotation, (len(times), 3, 3)))
    place = check_array("translation", track.translation, (len(times), 3))
    if Path(path).suffix.lower() in _TUM:
        table = np.column_stack([times, place, q[:, 1:], q[:, :1]]).tolist()
        with open(path, "w", encoding="utf-8", newline="\n") as file:
            file.writelines(" ".join(map(repr, row)) + "\n" for row in table)
        return
    names, columns = [*_POSE], [*times[None], *place.T, *q.T]
    if track.covariance is not None:
        P = check_array("covariance", track.covariance, (len(times), 6, 6))
        names += _COVARIANCE
        columns += [*P[:, *_UPPER].T]
    cells = [column.tolist() for column in columns]
    for name in ("nis", "dof", "rank"):
        value = getattr(track, name)
        if value is not None:
            names.append(name)
            cells.append([x if np.isfinite(x) else "" for x in _column(name, value, len(times))])
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(zip(*cells, strict=True))


def _column(name: str, value: ArrayLike, count: int) -> list[float]:
    column = np.asarray(value)
    if column.shape != (count,):
        raise ValueError(f"{name} must have shape ({count},), got {column.shape}")
    return column.tolist()


def read_track(path: AnyPath) -> TrackFile:
    """A track as `write_track` writes it, or any poses that `read_truth` takes.

    Raises
    ------
    ValueError
        If the file is none: it names file, line and column.
    """
    truth = read_truth(path)
    if truth.rotation is None:
        raise ValueError(f"{os.fspath(path)}: a track needs rotations, got positions alone")
    track = TrackFile(truth.times, truth.rotation, truth.translation)
    if Path(path).suffix.lower() not in _CSV:
        return track
    table = read_table(path)
    covariance = None
    if any(name in table.columns for name in _COVARIANCE):
        table.require(*_COVARIANCE)
        covariance = np.empty((len(truth.times), 6, 6))
        for i, j, name in zip(*_UPPER, _COVARIANCE, strict=True):
            covariance[:, i, j] = covariance[:, j, i] = table.numbers(name)
    nis = None
    if "nis" in table.columns:
        nis = table.numbers("nis", may_be_missing=True)
        nis = np.where(np.isnan(nis), np.inf, nis)
        table.check(nis >= 0, "nis", "must not be negative")
    return track._replace(
        covariance=covariance, nis=nis, dof=_counts(table, "dof"), rank=_counts(table, "rank")
    )


def _counts(table: Table, name: str) -> NDArray[np.int64] | None:
    if name not in table.columns:
        return None
    values = table.numbers(name)
    whole = (values == np.round(values)) & (values >= 0) & (values < 1e9)
    table.check(whole, name, "must be a whole number")
    return values.astype(np.int64)
