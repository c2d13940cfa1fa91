"""Calibration of link biases and lever arms from ranges along a known path.

The range of anchor m and tag n at epoch k is

    r = (1 + s_mn) |Q_k c_n + p_k - a_m| + b_mn + noise,

where Q_k, p_k is the path and c_n the position of the tag in its body frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.calibration.drift import Drift
from rbl_gym.estimators.calibration.link_equations import (
    Fit,
    KnownPath,
    LinkModel,
    Problem,
    axes_of,
    directions,
    placed,
    problem_of,
    solve,
    sum_zero,
)

__all__ = ["LinkFit", "fit_links", "spread_of_residuals"]


class LinkFit(NamedTuple):
    """Estimated links and tags, with standard deviations.

    Attributes
    ----------
    bias_m, bias_std_m, slope, slope_std
        (M, N): ``range = (1 + slope) distance + bias``.
    noise_std_m
        (M, N) robust standard deviation of the residuals; late ranges hardly count.
    drift
        Slow part of the residuals: its fraction of the variance, and its correlation time (s).
    node_delay_m, node_delay_std_m
        (M + N,) of the anchors, then of the tags; None unless ``biases="node"``.
    rotation, rotation_std_rad
        (3, 3) from the table to the body frame of the path, and (3,) about the axes of that frame.
    shift_m, shift_std_m
        (3,): ``tags = rotation @ table + shift`` if the table is rotated as a whole.
    tags, tags_std_m
        (N, 3) in the body frame of the path.
    residuals
        (K, M, N) metres, 0 without a range.
    counts
        (M, N) number of ranges of each link.
    covariance
        Covariance of all parameters: biases and slopes in the form of the model, then tags.
    """

    bias_m: FloatArray
    bias_std_m: FloatArray
    slope: FloatArray
    slope_std: FloatArray
    noise_std_m: FloatArray
    drift: Drift
    node_delay_m: FloatArray | None
    node_delay_std_m: FloatArray | None
    rotation: FloatArray
    rotation_std_rad: FloatArray
    shift_m: FloatArray
    shift_std_m: FloatArray
    tags: FloatArray
    tags_std_m: FloatArray
    residuals: FloatArray
    counts: np.ndarray
    covariance: FloatArray


def spread_of_residuals(
    ranges: FloatArray, links: BoolArray, anchors: FloatArray, places: FloatArray
) -> float:
    """Return the robust spread of ranges about distances, without a bias of every link.

    It is the median absolute deviation, metres, and serves to compare coarse starts.

    Parameters
    ----------
    ranges, links
        (K, M, N) metres, and a mask of the measured ranges.
    anchors
        (M, 3), or (K, M, 3) if they move.
    places
        Tags (K, N, 3) in the world frame.
    """
    d = directions(np.broadcast_to(anchors, (len(ranges), *anchors.shape[-2:])), places)[1]
    left = np.where(links, ranges - d, np.nan)
    seen = links.any(axis=0)
    left = left[:, seen]
    return float(np.nanmedian(np.abs(left - np.nanmedian(left, axis=0))))


def fit_links(
    ranges: ArrayLike,
    links: ArrayLike | None,
    anchors: ArrayLike,
    tags: ArrayLike,
    path: KnownPath,
    model: LinkModel = LinkModel(),  # noqa: B008 (frozen)
    rotation: ArrayLike | None = None,
) -> LinkFit:
    """Estimate biases and slopes of links, and tags, by robust least squares.

    Parameters
    ----------
    ranges, links
        (K, M, N) metres, and a mask of the measured ranges; None: all positive ranges.
    anchors
        (M, 3), or (K, M, 3) if they move.
    tags
        (N, 3), the table of nominal positions.
    path
        Path of the body, at the epochs.
    model
        Parameters to estimate.
    rotation
        (3, 3) start of the search for the rotation of the table; default the identity.

    Raises
    ------
    ValueError
        If shapes do not match, or there is no range.

    Notes
    -----
    Gauss-Newton with iterated weights (`robust.share_of`); every link has its own spread. Errors of
    a link are white noise and a slow part. The slow part is estimated from the residuals and
    whitened (`drift`). Standard deviations then remain consistent for biases that change slowly
    with the pose.
    """
    problem = problem_of(ranges, links, anchors, tags, path, model, rotation)
    fit = solve(problem)
    return _result(problem, fit)


def _result(problem: Problem, fit: Fit) -> LinkFit:
    model, cov = problem.model, fit.covariance
    M, N = problem.ranges.shape[1:]
    L, n_link = M * N, problem.n_link
    of_links = (problem.design[: 2 * L] @ fit.parameters).reshape(2, M, N)
    of_links_std = _std_of(problem.design[: 2 * L], cov).reshape(2, M, N)
    delay = delay_std = None
    if model.biases == "node":
        nodes = np.zeros((M + N, len(fit.parameters)))
        nodes[:M, :M] = np.eye(M)
        nodes[M:, M : M + N - 1] = sum_zero(N)
        delay, delay_std = nodes @ fit.parameters, _std_of(nodes, cov)
    tags, derivative = placed(problem, fit.parameters, fit.rotation)
    G = derivative.shape[-1]
    of_tags = np.zeros((3 * N, len(fit.parameters)))
    of_tags[:, n_link : n_link + G] = derivative.reshape(3 * N, G)
    turn_std, shift, shift_std = np.zeros(3), np.zeros(3), np.zeros(3)
    if model.tags == "turned":
        std = np.sqrt(np.diag(cov))[n_link : n_link + G]
        turn_axes, move_axes = axes_of(model)
        turn_std[turn_axes], shift_std[move_axes] = np.split(std, [len(turn_axes)])
        shift = tags[0] - fit.rotation @ problem.tags[0]
    return LinkFit(
        *(of_links[0], of_links_std[0], of_links[1], of_links_std[1], fit.std, fit.drift),
        *(delay, delay_std, fit.rotation, turn_std, shift, shift_std),
        *(tags, _std_of(of_tags, cov).reshape(N, 3)),
        *(fit.residual, problem.links.sum(axis=0), cov),
    )


def _std_of(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard deviations of ``rows @ parameters``."""
    return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", rows, covariance, rows), 0.0))
