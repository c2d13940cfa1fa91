"""The score of a layout and its derivative with respect to the anchor positions."""

from __future__ import annotations

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray, as_float, check_array, check_finite
from rbl_gym.kernels import compiled
from rbl_gym.measurements import ranging
from rbl_gym.measurements.gain import EVERYWHERE, Gain, share_and_slope
from rbl_gym.placement.problem import root_of
from rbl_gym.placement.sample import Sample

__all__ = ["score_and_gradient"]


def score_and_gradient(
    anchors: FloatArray,
    sample: Sample,
    tags: FloatArray,
    noise: ranging.NoiseLaw,
    share: FloatArray | None = None,
    gain: Gain = EVERYWHERE,
    normals: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return score (...) of layouts and its derivative (..., M, 3) by the anchor positions.

    The score is the root of the weighted mean over the poses of b^2, ``b^2 = mean_n tr(J_n P
    J_n^T)`` with ``P = (F + prior)^-1``. `share` and `normals` are constants of the derivative: it
    does not see that an anchor is about to lose sight of a pose.

    Parameters
    ----------
    anchors
        (..., M, 3), metres.
    sample
        The poses, their weights and the prior information.
    tags
        (N, 3) in the body frame, metres.
    noise
        The law of the ranges: one of `ranging.NOISE_LAWS`.
    share
        Information fraction of each link, (..., P, M), or (..., P, M, N) per tag. None: 1.
    gain
        Reach and field of view of the anchors.
    normals
        (..., M, 3) of the mounts, of unit length, for the field of view; None or zero: all
        directions.

    Raises
    ------
    ValueError
        If arrays have wrong shapes or are not finite, the law is not one of `NOISE_LAWS`, or the
        information is singular.
    """
    anchors, tags = check_array("anchors", anchors, ("M", 3)), check_array("tags", tags, ("N", 3))
    law = ranging.numbers_of(noise, len(tags))
    if law is None:
        raise ValueError(
            "noise must be a law whose derivative is known, such as ranging.RangeNoise(0.1), got "
            f"{noise!r:.80}"
        )
    if normals is None:
        normals = np.zeros((1, 3))
    normals = np.broadcast_to(check_array("normals", normals, ("M", 3)), anchors.shape)
    shares = _shares(share, len(sample.places), anchors.shape[-2], len(tags))
    return of_arrays(anchors, normals, *sample[:4], tags, law, gain.numbers, shares)


def of_arrays(*arrays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `score_and_gradient` for the arguments of `square_and_gradient`."""
    square, gradient = square_and_gradient(*arrays)
    root = root_of(square)
    return root, gradient / (2 * root[..., None, None])


def _shares(share: FloatArray | None, p: int, m: int, n: int) -> FloatArray:
    """Return the information fractions (..., P, M, N) of the links."""
    if share is None:
        return np.ones((p, m, n))
    share = check_finite("share", as_float("share", share))
    if share.shape[-2:] == (p, m) and share.shape[-3:] != (p, m, n):
        share = share[..., None]
    if share.ndim < 3 or share.shape[-3:-1] != (p, m) or share.shape[-1] not in (1, n):
        raise ValueError(
            f"share must have shape (..., {p}, {m}) or (..., {p}, {m}, {n}), got {share.shape}"
        )
    return np.broadcast_to(share, (*share.shape[:-1], n))


@compiled("layout_gradient:square_and_gradient")
def square_and_gradient(
    anchors: FloatArray,
    normals: FloatArray,
    rotation: FloatArray,
    places: FloatArray,
    weight: FloatArray,
    prior: FloatArray,
    tags: FloatArray,
    law: FloatArray,
    gain: FloatArray,
    share: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the weighted sum (...) of b^2 over poses, and its derivative (..., M, 3) by anchors.

    With ``K = P S P`` and S the mean of ``J_n^T J_n``, the derivative of b^2 is ``-tr(K dF)``. A
    link has the information ``F = w q q^T`` with ``q = J_n^T d`` and ``w = g / (var r^2)``, where
    ``d = s_n - a_m`` is its offset and g its gain.
    """
    # Laws of several problems are the same for all their poses.
    noise = ranging.law_of(law if law.ndim == 1 else law[..., None, :])
    J = bounds.tag_jacobian(rotation, tags[..., None, :, :])
    s = ranging.tag_positions(rotation, places, tags[..., None, :, :])
    d = s[..., None, :, :] - anchors[..., None, :, None, :]
    distance = np.sqrt((d**2).sum(axis=-1))
    variance = noise.variance(distance)
    full = share / (variance * distance**2)
    g, slope_of_gain = share_and_slope(gain, d, normals[..., None, :, None, :] + 0 * d)
    w = full * g
    q = np.einsum("...nia,...mni->...mna", J, d)
    P = np.linalg.inv(np.einsum("...mn,...mna,...mnb->...ab", w, q, q) + prior)
    S = np.einsum("...nia,...nib->...ab", J, J) / tags.shape[-2]
    Kq = q @ (P @ S @ P)[..., None, :, :]
    told = (q * Kq).sum(axis=-1)
    by_link, by_reference = _weight_slopes(law, distance, variance)
    by_square = w * told * by_link + (w * told).sum(axis=-1, keepdims=True) * by_reference
    # Derivatives by the offset, of w without its gain, then of the gain.
    slope = np.einsum("...mn,...nia,...mna->...mi", w, J, Kq)
    slope -= (by_square[..., None] * d).sum(axis=-2)
    slope += 0.5 * ((full * told)[..., None] * slope_of_gain).sum(axis=-2)
    square = np.einsum("...ab,...ba->...", S, P)
    return (weight * square).sum(axis=-1), 2 * (weight[..., None, None] * slope).sum(axis=-3)


def _weight_slopes(
    law: FloatArray, distance: FloatArray, variance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return minus the derivatives of ``log w`` by squared distances (..., P, M, N).

    The first is of each link by its own distance. The second is of all links of an anchor by the
    distance of the reference tag, and zero elsewhere.
    """
    kind, _, proportional, reference = np.moveaxis(law, -1, 0)[..., None, None, None]
    growth, by_square = proportional**2 / variance, 1 / distance**2
    by_link = np.where(kind == 1, 0.0, by_square + np.where(reference < 0, growth, 0.0))
    refers = np.arange(distance.shape[-1]) == reference
    return by_link, np.where(refers, np.where(kind == 1, by_square, growth), 0.0)
