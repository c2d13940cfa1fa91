"""Compute Cramer-Rao bounds of the pose from directions of arrival at one base station.

Shapes, the pose error (w, v) and the order of the 6 x 6 matrices are those of `bounds`.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from rbl_gym import bounds
from rbl_gym.checks import FloatArray, check_array, kernel
from rbl_gym.geometry import rotations
from rbl_gym.measurements import bearing, ranging

__all__ = ["doa_crb", "doa_information"]

# Internal functions without checks: their arguments were checked.
_TAG_POSITIONS = kernel(ranging.tag_positions)


def doa_information(
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: bearing.AngleNoise,
    station: ArrayLike | None = None,
) -> FloatArray:
    """Return the Fisher information (..., 6, 6) of one epoch of directions about the pose.

    Parameters
    ----------
    tags, rotation, translation
        (..., N, 3), (..., 3, 3), (..., 3); metres.
    noise
        Noise law of the angles.
    station
        Position (..., 3) of the base station; None: the origin.
    """
    tags = check_array("tags", tags, ("N", 3))
    rotation = rotations.check_rotation("rotation", rotation)
    translation = check_array("translation", translation, (3,))
    if not isinstance(noise, bearing.AngleNoise):
        raise ValueError(f"noise must be a bearing.AngleNoise, got {noise!r:.80}")
    if station is not None:
        translation = translation - check_array("station", station, (3,))
    return doa_information_at(tags, rotation, translation, noise)


def doa_information_at(
    tags: FloatArray, rotation: FloatArray, translation: FloatArray, noise: bearing.AngleNoise
) -> FloatArray:
    """Compute `doa_information` from checked arrays, with the station at the origin."""
    positions = _TAG_POSITIONS(rotation, translation, tags)
    return bounds.lift(bounds.tag_jacobian(rotation, tags), bearing.information(positions, noise))


def doa_crb(
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: bearing.AngleNoise,
    prior_information: ArrayLike | None = None,
) -> FloatArray:
    """Return the constrained Cramer-Rao bound (..., 6, 6) of the pose from directions of arrival.

    The pose error (w, v) includes the constraint ``R^T R = I``. ``sqrt(2 tr P_w)`` bounds the
    Frobenius RMSE of R and ``sqrt(tr P_v)`` the RMSE of t, as in the DOA paper. Arguments as in
    `doa_information`, and `prior_information` (..., 6, 6).

    Raises
    ------
    ValueError
        As in `doa_information`, and if the information is singular; the message gives its rank.
    """
    information = doa_information(tags, rotation, translation, noise)
    if prior_information is not None:
        information = information + check_array("prior_information", prior_information, (6, 6))
    return bounds.inverted(information, "tags")
