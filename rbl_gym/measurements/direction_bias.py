"""Model the bias and standard deviation of ranges as functions of the ray direction.

Antennas are not isotropic, and bodies block their own radios. The bias of a range therefore
depends on the bearing of the ray at each end,

    beta_mn = sum_k [a_m,2k-1 cos(k phi) + a_m,2k sin(k phi)]
            + sum_k [b_n,2k-1 cos(k psi) + b_n,2k sin(k psi)],

with phi the bearing of the tag in the frame of the anchors and psi that of the anchor in the frame
of the body, both about z from x. The logarithm of the standard deviation is such a sum too.
Constant terms are link biases. The first harmonic of a tag has the same effect as a shift of the
tag: the two cannot be distinguished.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray

__all__ = ["DirectionLaw", "direction_bias"]

# Rays with a smaller horizontal length have no bearing (m).
_LEAST_M = 1e-6


class DirectionLaw(NamedTuple):
    """Harmonics of the bearing at the ends of the links: cos, sin of the first, of the second, ...

    Attributes
    ----------
    anchors, tags
        (M, 2 H) and (N, 2 H'), metres of bias.
    anchors_log_std, tags_log_std
        The same shapes: logarithm of the factor on the standard deviation of a range.
    """

    anchors: FloatArray
    tags: FloatArray
    anchors_log_std: FloatArray
    tags_log_std: FloatArray

    @classmethod
    def of(
        cls,
        anchors: ArrayLike,
        tags: ArrayLike,
        anchors_log_std: ArrayLike | None = None,
        tags_log_std: ArrayLike | None = None,
    ) -> DirectionLaw:
        """Return a law with checked coefficients; standard deviations not given do not vary.

        Raises
        ------
        ValueError
            If the shapes do not match.
        """
        fields = []
        for name, bias, log_std in (
            ("anchors", anchors, anchors_log_std),
            ("tags", tags, tags_log_std),
        ):
            bias = np.asarray(bias, dtype=np.float64)
            log_std = np.asarray(np.zeros_like(bias) if log_std is None else log_std, dtype=float)
            if bias.ndim != 2 or bias.shape[1] % 2 or log_std.shape != bias.shape:
                raise ValueError(
                    f"{name} and {name}_log_std must have shape (n, 2 H), a cosine and a sine "
                    f"of every harmonic, got {bias.shape} and {log_std.shape}"
                )
            if not (np.isfinite(bias).all() and np.isfinite(log_std).all()):
                both = np.concatenate([bias, log_std], axis=None)
                raise ValueError(
                    f"{name} and {name}_log_std must be finite, got {both[~np.isfinite(both)][0]}"
                )
            fields.append((bias, log_std))
        (a, log_a), (b, log_b) = fields
        return cls(a, b, log_a, log_b)


class Directed(NamedTuple):
    """Bias of every range, its derivative, and the effect on the standard deviation.

    The bias is (..., M, N), its derivative by the pose error (w, v) is (..., M, N, 6), and the
    logarithm of the factor on the standard deviation is (..., M, N).
    """

    bias: FloatArray
    jacobian: FloatArray
    log_std: FloatArray


def direction_bias(
    law: DirectionLaw,
    rotation: FloatArray,
    translation: FloatArray,
    anchors: FloatArray,
    tags: FloatArray,
) -> Directed:
    """Return the bias of ranges by ray direction at poses.

    Parameters
    ----------
    law
        Law of M anchors and N tags.
    rotation, translation
        (..., 3, 3) and (..., 3).
    anchors, tags
        (..., M, 3) and (N, 3), metres.

    Returns
    -------
    Directed
        Bias in metres; its derivative by the global pose error, ``Q' = exp(w) Q``, ``t' = t + v``;
        logarithm of the factor on the standard deviation.
    """
    arms = tags @ np.swapaxes(rotation, -1, -2)
    ray = (arms + translation[..., None, :])[..., None, :, :] - anchors[..., :, None, :]
    # In body axes: from the tag to the anchor.
    back = -ray @ rotation[..., None, :, :]
    out_bearing, out_over = _bearing(ray)
    bearing, over = _bearing(back)
    at_anchor, slope_a = _sum(law.anchors[:, None], out_bearing)
    at_tag, slope_b = _sum(law.tags, bearing)
    log_std = _sum(law.anchors_log_std[:, None], out_bearing)[0]
    log_std = log_std + _sum(law.tags_log_std, bearing)[0]
    # The position of a tag changes by w x (Q c) + v, that of the anchor in the body frame by
    # Q^T ((a - t) x w) - Q^T v.
    by_place = slope_a[..., None] * out_over
    to_anchor = (anchors - translation[..., None, :])[..., :, None, :]
    by_anchor = slope_b[..., None] * over @ np.swapaxes(rotation, -1, -2)[..., None, :, :]
    turn = np.cross(arms[..., None, :, :], by_place) + np.cross(by_anchor, to_anchor)
    jacobian = np.concatenate([turn, by_place - by_anchor], axis=-1)
    return Directed(at_anchor + at_tag, jacobian, log_std)


def _bearing(ray: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return bearings (...) of rays (..., 3), and their derivatives (..., 3) by the ray."""
    x, y = ray[..., 0], ray[..., 1]
    squared = np.maximum(x**2 + y**2, _LEAST_M**2)
    return np.arctan2(y, x), np.stack([-y, x, np.zeros_like(x)], axis=-1) / squared[..., None]


def _sum(coefficients: FloatArray, bearing: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return sums of harmonics of bearings (..., M, N), and their derivatives."""
    order = 1 + np.arange(coefficients.shape[-1] // 2)
    angle = bearing[..., None] * order
    cos, sin = np.cos(angle), np.sin(angle)
    a, b = coefficients[..., ::2], coefficients[..., 1::2]
    return (a * cos + b * sin).sum(axis=-1), (order * (b * cos - a * sin)).sum(axis=-1)
