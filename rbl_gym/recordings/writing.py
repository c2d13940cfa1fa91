"""Write tables, and write and read tracks: TUM, which other tools read, or CSV with covariance."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable
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
    """A track of K epochs, as stored in a file.

    Attributes
    ----------
    times
        (K,), seconds.
    rotation, translation
        (K, 3, 3), and (K, 3) in metres.
    covariance
        (K, 6, 6) of the pose error (w, v), ``Q_hat = exp(w) Q``, ``t_hat = t + v``, radians and
        metres; None if the file has none, as in TUM.
    nis, dof
        (K,) normalised innovation squared of the ranges of each epoch, and (K,) its degrees of
        freedom; None if the file has none.
    rank
        (K,) how many of the six directions of the pose the ranges of each epoch determine; None if
        the file has none.
    """

    times: FloatArray
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray | None = None
    nis: FloatArray | None = None
    dof: NDArray[np.int64] | None = None
    rank: NDArray[np.int64] | None = None


def write_table(path: AnyPath, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV file with one header line; its folder is created."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def check_track_path(path: AnyPath) -> None:
    """Raise ValueError unless the file suffix is ``.tum``, ``.txt`` or ``.csv``."""
    if Path(path).suffix.lower() not in _TUM + _CSV:
        raise ValueError(
            f"{os.fspath(path)}: the name of a track must end in .tum or .txt (TUM format), or in "
            ".csv (with covariance)"
        )


def write_track(path: AnyPath, track: TrackFile) -> None:
    """Write a track in the format given by the file suffix.

    ``.tum`` and ``.txt``: ``t x y z qx qy qz qw`` without a header. ``.csv``: a header, and
    ``t,x,y,z,qw,qx,qy,qz``. If the track has them, the upper triangle of the covariance follows by
    rows, ``cov_rx_rx,cov_rx_ry,...,cov_z_z``, and ``nis,dof,rank``. Numbers are written with full
    precision.

    Parameters
    ----------
    path
        Path of the file. Its folder is made.
    track
        The track to write. An infinite NIS becomes an empty cell.

    Raises
    ------
    ValueError
        If the suffix is another one, or the shape of an array is not the one in `TrackFile`.
    OSError
        If the file cannot be written.
    """
    check_track_path(path)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
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
    write_table(path, names, zip(*cells, strict=True))


def _column(name: str, value: ArrayLike, count: int) -> list[float]:
    column = np.asarray(value)
    if column.shape != (count,):
        raise ValueError(f"{name} must have shape ({count},), got {column.shape}")
    return column.tolist()


def read_track(path: AnyPath) -> TrackFile:
    """Read a track written by `write_track`, or any poses that `read_truth` accepts.

    Raises
    ------
    ValueError
        If the file is not a track. The message names file, line and column.
    """
    truth = read_truth(path)
    if truth.rotation is None:
        raise ValueError(f"{os.fspath(path)}: a track must have rotations, got only positions")
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
