"""Write the files of a calibration, for `rbl_gym.recordings`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.measurements.direction_bias import DirectionLaw
from rbl_gym.recordings.writing import write_table

__all__ = ["write_directions", "write_frame", "write_link_table", "write_points"]


def write_link_table(
    path: str | os.PathLike[str],
    anchor_ids: Sequence[str],
    tag_ids: Sequence[str],
    columns: Mapping[str, FloatArray],
    told: ArrayLike,
) -> None:
    """Write ``anchor,tag,bias_m,...``, one row per link.

    Parameters
    ----------
    path
        File; its folder is created.
    anchor_ids, tag_ids
        Ids, in the order of the arrays.
    columns
        Values (M, N) of each column, by its name in the header.
    told
        Links (M, N) with a row.
    """
    write_table(
        path,
        ("anchor", "tag", *columns),
        [
            [
                anchor_ids[int(m)],
                tag_ids[int(n)],
                *(f"{column[m, n]:.6f}" for column in columns.values()),
            ]
            for m, n in np.argwhere(np.asarray(told))
        ],
    )


def write_points(
    path: str | os.PathLike[str], kind: str, ids: Sequence[str], places: FloatArray
) -> None:
    """Write ``anchor,x,y,z`` or ``tag,x,y,z``.

    Parameters
    ----------
    path
        File; its folder is created.
    kind
        ``"anchor"`` or ``"tag"``.
    ids, places
        Names, and positions (n, 3) in metres.
    """
    rows = [[name, *(f"{x:.6f}" for x in place)] for name, place in zip(ids, places, strict=True)]
    write_table(path, (kind, "x", "y", "z"), rows)


def write_directions(
    path: str | os.PathLike[str], ids: tuple[Sequence[str], Sequence[str]], law: DirectionLaw
) -> None:
    """Write ``end,id,harmonic,bias_cos_m,...``, as `rbl_gym.recordings.read_directions` reads it.

    Parameters
    ----------
    path
        File; its folder is created.
    ids
        Ids of the anchors and of the tags, in the order of the arrays.
    law
        Bias by direction; ends without a harmonic have no row.
    """
    rows = []
    sides = (("anchor", law.anchors, law.anchors_log_std), ("tag", law.tags, law.tags_log_std))
    for (end, bias, log_std), names in zip(sides, ids, strict=True):
        for k in range(0, bias.shape[1], 2):
            rows += [
                [
                    end,
                    name,
                    k // 2 + 1,
                    *(f"{x:.6f}" for x in (*row[k : k + 2], *factor[k : k + 2])),
                ]
                for name, row, factor in zip(names, bias, log_std, strict=True)
            ]
    header = ("end", "id", "harmonic", "bias_cos_m", "bias_sin_m", "log_std_cos", "log_std_sin")
    write_table(path, header, rows)


def write_frame(path: str | os.PathLike[str], rotation: FloatArray) -> None:
    """Write ``qw,qx,qy,qz`` of the rotation (3, 3) from sensor axes to body axes.

    Parameters
    ----------
    path
        File for `replay --imu-frame`; its folder is created.
    rotation
        ``turn.rotation`` from `calibrate_inertial`.
    """
    write_table(
        path, ("qw", "qx", "qy", "qz"), [[f"{x:.8f}" for x in rotations.quaternion(rotation)]]
    )
