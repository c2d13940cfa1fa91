"""Align one track to another by the least-squares rigid transform, as `evo` does.

A track and its ground truth are often given in two world frames. The transform between them is
estimated from matched positions alone, without scale, as in tools that compare trajectories.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array, check_one_of
from rbl_gym.geometry import rotations

__all__ = ["ALIGNMENTS", "Alignment", "align_positions", "apply_alignment"]

# What is estimated: nothing, a shift, a shift and a rotation about z, a shift and any rotation.
ALIGNMENTS = ("none", "position", "yaw", "se3")
# A spread below this share of the largest one, or of the coordinates, counts as zero.
_FLAT, _ROUNDING = 1e-6, 1e-12


class Alignment(NamedTuple):
    """A rigid transform of the world frame: ``p_target = rotation @ p_source + translation``.

    Attributes
    ----------
    rotation
        (3, 3).
    translation
        (3,) metres.
    turn_rad
        Angle of the rotation.
    shift_m
        Distance by which the centre of the source positions is moved. Unlike `translation`, it
        does not depend on the origin.
    """

    rotation: FloatArray
    translation: FloatArray
    turn_rad: float
    shift_m: float


def align_positions(source: ArrayLike, target: ArrayLike, mode: str = "se3") -> Alignment:
    """Return the rigid transform that aligns positions to others in least squares, without scale.

    Minimises ``sum |R p_source + t - p_target|^2``.

    Parameters
    ----------
    source, target
        Matched positions (K, 3), metres.
    mode
        ``"none"``: the identity. ``"position"``: a shift. ``"yaw"``: a shift and a rotation about
        z, for frames with the same vertical. ``"se3"``: a shift and any rotation.

    Raises
    ------
    ValueError
        If the positions do not determine the transform: the body does not move or, with
        ``"se3"``, it moves along a line.

    Notes
    -----
    Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
    IEEE PAMI 13 (1991), with the scale held at 1. `evo` calls ``"se3"`` ``--align``.
    """
    check_one_of("mode", mode, ALIGNMENTS)
    source = check_array("source", source, ("K", 3))
    target = check_array("target", target, ("K", 3))
    if source.ndim != 2 or source.shape != target.shape:
        raise ValueError(
            f"source and target must both be (K, 3), got {source.shape} and {target.shape}"
        )
    centre, goal = source.mean(axis=0), target.mean(axis=0)
    spread = (target - goal).T @ (source - centre) / len(source)
    size = max(np.abs(source).max(), np.abs(target).max())
    if mode == "none":
        goal = centre
    R = np.eye(3)
    if mode == "yaw":
        cosine, sine = spread[0, 0] + spread[1, 1], spread[1, 0] - spread[0, 1]
        if np.hypot(cosine, sine) <= (_ROUNDING * size) ** 2:
            raise ValueError(
                f"the {len(source)} positions do not determine a heading, as they differ only in "
                "height: align by 'position'"
            )
        R = rotations.exp([0.0, 0.0, np.arctan2(sine, cosine)])
    elif mode == "se3":
        values = np.linalg.svd(spread, compute_uv=False)
        if values[1] <= max(_FLAT * values[0], (_ROUNDING * size) ** 2):
            raise ValueError(
                f"the {len(source)} positions do not determine a rotation, as they lie on a line "
                "or at one place: align by 'yaw' or 'position'"
            )
        R = rotations.nearest(spread)
    turn = float(np.linalg.norm(rotations.log(R)))
    return Alignment(R, goal - R @ centre, turn, float(np.linalg.norm(goal - centre)))


def apply_alignment(
    alignment: Alignment, rotation: ArrayLike | None, translation: ArrayLike
) -> tuple[FloatArray | None, FloatArray]:
    """Transform poses to the world frame of the target.

    Parameters
    ----------
    alignment
        The result of `align_positions`.
    rotation
        (..., 3, 3) in the world frame of the source; None: only positions.
    translation
        (..., 3), metres.

    Returns
    -------
    rotation, translation
        ``R Q`` and ``R p + t``, with the same shapes.
    """
    R = alignment.rotation
    moved = np.asarray(translation) @ R.T + alignment.translation
    return None if rotation is None else R @ np.asarray(rotation), moved
