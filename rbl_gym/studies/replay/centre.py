"""Track the centre of the tags in place of the body's origin, where the ranges leave a turn open.

One tag, or tags on a line, do not determine the rotation about them. The origin of the body may be
elsewhere. A filter of its pose has to linearize this rotation, and makes up information about it.
About the centre of the tags, rotation and position are independent, so that the rotation keeps the
variance of its prior.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.replay.place import START_M
from rbl_gym.studies.replay.settings import Settings

# Tags are collinear if the ratio of their squared thickness to squared length is below this.
_THIN = 0.01


def is_line(tags: FloatArray) -> bool:
    """Return whether tags (N, 3) are one or nearly collinear: rotation about them is unknown."""
    values = np.linalg.svd(tags - tags.mean(axis=0), compute_uv=False) ** 2
    return len(tags) < 3 or bool(values[1] <= _THIN * values[0])


def centred(
    recording: Recording, settings: Settings
) -> tuple[Recording, Settings, FloatArray | None]:
    """Return a recording and settings about the centre of the tags, and the centre (3,).

    The centre is None, and nothing changes, if the ranges and what is known determine the rotation,
    or a sensor measures the motion of the origin.
    """
    known, tags = settings.knowledge, recording.tags
    level = known.planar or known.tilt_std_deg is not None
    moved = recording.odometry is not None or settings.filter == "iekf-imu"
    centre = tags.mean(axis=0)
    if moved or not centre.any() or not is_line(tags) or (level and len(tags) > 1):
        return recording, settings, None
    changed = {}
    if known.start is not None:
        place, yaw = np.array(known.start[:3]), known.start[3:]
        std = START_M if known.prior_position_m is None else known.prior_position_m
        if yaw or known.prior_rotation_deg is not None:
            place = place + rotations.exp([0.0, 0.0, math.radians(sum(yaw))]) @ centre
        else:
            std = math.hypot(std, float(np.linalg.norm(centre)))
        changed = {"start": (*place.tolist(), *yaw), "prior_position_m": std}
    if known.height_m is not None:
        changed["height_m"] = known.height_m + float(centre[2])
    return recording._replace(tags=tags - centre), settings.changed(**changed), centre


def about_origin(poses: Any, centre: FloatArray) -> Any:
    """Return a track or mirror about the centre of the tags as one about the body's origin.

    The origin is on a sphere or circle around the centre. Its error is that of the centre plus
    ``exp(w) a - a``, with the arm a. Let s be the variance of w along a principal axis u. About
    this axis, with ``p = u x a`` and r the part of a across u, the moments of the second part are

        E = exp(-s/2) w p,  C = (1 - exp(-2s))/2 p p^T + (3/2 - 2 exp(-s/2) + exp(-2s)/2) r r^T,

    which for a small s are those of the linear ``w x a``. The contributions of the axes are added.
    """
    Q, P = poses.rotation, poses.covariance
    arm = -Q @ centre
    variance, axes = np.linalg.eigh(P[:, :3, :3])
    u = np.swapaxes(axes, 1, 2)  # (K, 3 axes, 3)
    across = np.cross(u, arm[:, None])
    radial = np.cross(across, u)
    slope = np.exp(-0.5 * np.maximum(variance, 0.0))
    T = np.broadcast_to(np.eye(6), P.shape).copy()
    T[:, 3:, :3] = np.einsum("ka,kai,kaj->kij", slope, across, u)
    moved = T @ P @ np.swapaxes(T, 1, 2)
    beyond = 0.5 * (1 - slope**4) - variance * slope**2
    moved[:, 3:, 3:] += np.einsum("ka,kai,kaj->kij", beyond, across, across)
    beyond = 1.5 - 2 * slope + 0.5 * slope**4
    moved[:, 3:, 3:] += np.einsum("ka,kai,kaj->kij", beyond, radial, radial)
    other = getattr(poses, "other", None)
    if other is not None:
        poses = poses._replace(other=about_origin(other, centre))
    return poses._replace(translation=poses.translation + arm, covariance=moved)
