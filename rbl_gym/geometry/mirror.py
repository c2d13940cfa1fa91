"""Compute mirror poses: a body reflected in the plane of the anchors has the same ranges.

If the anchors lie in a plane and the body is flat, the mirror pose explains all ranges exactly
equally well. If either is nearly flat, it explains them nearly as well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_array
from rbl_gym.geometry import rotations

__all__ = ["Plane", "mirror_pose", "plane_of"]


class Plane(NamedTuple):
    """The plane closest to some points: a point of it, its unit normal, and the points' spread.

    Attributes
    ----------
    point, normal
        (3,) each; the normal points up or, if it is horizontal, to the positive side.
    thickness, width
        Root mean square distance of the points from the plane, and their spread in the plane along
        the narrower of the two principal axes, metres.
    """

    point: FloatArray
    normal: FloatArray
    thickness: float
    width: float


def plane_of(points: ArrayLike) -> Plane:
    """Return the least-squares plane through points (P, 3).

    Raises
    ------
    ValueError
        If the shape is wrong or values are not finite.
    """
    points = check_array("points", points, ("P", 3))
    centre = points.mean(axis=0)
    spread = (points - centre) / np.sqrt(len(points))
    values, axes = np.linalg.eigh(spread.T @ spread)
    normal = axes[:, 0]
    # The last nonzero component determines the sign.
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
    """Return the mirror images of poses in the plane of the anchors, with their covariance.

    The tags are reflected in this plane, and the body is fitted to them. With S the reflection in
    the plane of the anchors and B that in the plane of the tags, ``Q' = S Q B``, and the centre of
    the tags is reflected. If the body is not flat, the image is the best fit.

    Parameters
    ----------
    rotation, translation, covariance
        (..., 3, 3), (..., 3) and (..., 6, 6), of the error (w, v).
    anchors, tags
        (M, 3) in the world frame and (N, 3) in the body frame.

    Raises
    ------
    ValueError
        If a shape is wrong or values are not finite.
    """
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    covariance = check_array("covariance", covariance, (6, 6))
    plane, body = plane_of(anchors), plane_of(tags)
    S, B = (np.eye(3) - 2 * np.outer(p.normal, p.normal) for p in (plane, body))
    image = S @ rotation @ B
    centre = translation + rotation @ body.point - plane.point
    image_translation = centre @ S + plane.point - image @ body.point
    # w' = -S w, and v' = S (v + w x Q (c - B c)) for the centre c of the tags.
    arm = rotation @ (body.point - B @ body.point)
    T = np.zeros(np.broadcast_shapes(covariance.shape, (*rotation.shape[:-2], 6, 6)))
    T[..., :3, :3], T[..., 3:, 3:] = -S, S
    T[..., 3:, :3] = -S @ rotations.hat(arm)
    return image, image_translation, T @ covariance @ np.swapaxes(T, -1, -2)
