"""Mirror poses: reflected at the plane of the anchors, a body keeps its ranges.

Where the anchors lie in a plane and the body is flat, the image explains all ranges exactly as
well. Where either is nearly so, it explains them nearly as well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.geometry import rotations

__all__ = ["Plane", "mirror_pose", "plane_of"]


class Plane(NamedTuple):
    """The plane nearest to some points: a point of it, its unit normal, and how the points lie.

    Attributes
    ----------
    point, normal
        (3,) each; the normal points up, and where it is level to the positive side.
    thickness, width
        Root mean square distance of the points from the plane, and in it along the narrower of
        the two principal axes, metres.
    """

    point: FloatArray
    normal: FloatArray
    thickness: float
    width: float


def plane_of(points: ArrayLike) -> Plane:
    """The plane of least squares through points (P, 3).

    Raises
    ------
    ValueError
        On a wrong shape or numbers that are not finite.
    """
    points = check_array("points", points, ("P", 3))
    centre = points.mean(axis=0)
    spread = (points - centre) / np.sqrt(len(points))
    values, axes = np.linalg.eigh(spread.T @ spread)
    normal = axes[:, 0]
    # The last axis that is not 0 decides the sign.
    leading = normal[np.flatnonzero(np.abs(normal) > 1e-9)[-1]]
    thickness, width = np.sqrt(np.maximum(values[:2], 0.0))
    return Plane(centre, normal * np.sign(leading), float(thickness), float(width))


def mirror_pose(
    rotation: ArrayLike,
    translation: ArrayLike,
    covariance: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The image of poses in the plane of the anchors, with its covariance.

    The tags are reflected in that plane, and the body is put on them: with S the reflection in
    the plane of the anchors and B that in the plane of the tags, ``Q' = S Q B``, and the tags'
    centre is reflected. Of a body that is not flat, the image is the best fit.

    Parameters
    ----------
    rotation, translation, covariance
        (..., 3, 3), (..., 3) and (..., 6, 6), of the error (w, v).
    anchors, tags
        (M, 3) in the world frame and (N, 3) in the body frame.

    Raises
    ------
    ValueError
        On wrong shapes or numbers that are not finite.
    """
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    covariance = check_array("covariance", covariance, (6, 6))
    plane, body = plane_of(anchors), plane_of(tags)
    S, B = (np.eye(3) - 2 * np.outer(p.normal, p.normal) for p in (plane, body))
    image = S @ rotation @ B
    centre = translation + rotation @ body.point - plane.point
    image_translation = centre @ S + plane.point - image @ body.point
    # w' = -S w, and v' = S (v + w x Q (c - B c)) for the tags' centre c.
    arm = rotation @ (body.point - B @ body.point)
    T = np.zeros(np.broadcast_shapes(covariance.shape, (*rotation.shape[:-2], 6, 6)))
    T[..., :3, :3], T[..., 3:, 3:] = -S, S
    T[..., 3:, :3] = -S @ rotations.hat(arm)
    return image, image_translation, T @ covariance @ np.swapaxes(T, -1, -2)
