"""Compute Cramer-Rao bounds for unreliable links: lost, or over a reflected path.

Shapes, the pose error (w, v) and the order of the 6 x 6 matrices are those of `bounds`. A random
path is a mixture of densities, whose information about the range is an integral.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import bounds
from rbl_gym.checks import (
    FloatArray,
    check_array,
    check_count,
    check_generator,
    check_number,
    kernel,
)
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.measurements.noise_laws import check_law

__all__ = ["expected_information", "nlos_efficiency", "realised_crb"]

# Nodes of the trapezoid rule on +-9 standard deviations, which converges exponentially here.
_NODES = np.linspace(-9.0, 9.0, 721)
# Maximum number of draws, or biases, limited by memory.
_MOST = 10**6
_ALL_MEASURE = ranging.LinkModel()
# Number of links whose integrals are computed at once.
_BLOCK = 512


def expected_information(
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: ranging.NoiseLaw,
    link_model: ranging.LinkModel,
    *,
    nlos_std_m: float | None = None,
    nlos_known: bool = False,
) -> FloatArray:
    """Return the Fisher information (..., 6, 6) of one epoch, averaged over random links.

    Its inverse also bounds the error averaged over lost links, but not tightly: the mean of the
    bounds is above the bound of the mean information (`realised_crb`).

    Parameters
    ----------
    anchors, tags, rotation, translation, noise
        As in `bounds.range_information`.
    link_model
        Random links: `drop_probability`, `reach_m`, `nlos_probability`, `nlos_bias_m`.
    nlos_std_m
        Standard deviation of the bias of a reflected path about ``nlos_bias_m``, metres; None: the
        bias is unknown, and a reflected range gives no information.
    nlos_known
        Whether the receiver knows which ranges took a reflected path.

    Raises
    ------
    ValueError
        As in `bounds.range_information`.
    """
    _check_laws(noise, link_model)
    if nlos_std_m is not None:
        nlos_std_m = check_number("nlos_std_m", nlos_std_m, low=0.0)
    places = _checked(anchors, tags, rotation, translation)
    distance = _distances(*places)
    share = np.full(distance.shape, 1 - link_model.drop_probability)
    if link_model.reach_m is not None:
        share = np.where(distance <= link_model.reach_m, share, 0.0)
    if link_model.nlos_probability:
        std = np.sqrt(np.broadcast_to(noise.variance(distance), distance.shape))
        share = share * nlos_efficiency(
            link_model.nlos_probability, link_model.nlos_bias_m, std, nlos_std_m, known=nlos_known
        )
    return bounds.information_at(*places, noise, share)


def realised_crb(
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: ranging.NoiseLaw,
    link_model: ranging.LinkModel,
    rng: np.random.Generator,
    draws: int = 1000,
    prior_information: ArrayLike | None = None,
) -> FloatArray:
    """Return the Cramer-Rao bound (..., 6, 6), averaged over draws of the measured links.

    This is the bound on average for a filter that knows which ranges are missing. Reflected paths
    are not included. Arguments as in `bounds.pose_crb`; `draws` realisations from `rng`.

    Raises
    ------
    ValueError
        As in `bounds.pose_crb`, and if the links of one draw do not determine the pose.
    """
    _check_laws(noise, link_model)
    check_generator("rng", rng)
    draws = check_count("draws", draws, most=_MOST)
    places = _checked(anchors, tags, rotation, translation)
    distance = _distances(*places)
    links = rng.random((draws, *distance.shape)) >= link_model.drop_probability
    if link_model.reach_m is not None:
        links &= distance <= link_model.reach_m
    covariance = bounds.pose_crb(*places, noise, prior_information, links)
    return covariance.mean(axis=0)


def nlos_efficiency(
    probability: float,
    bias_m: float,
    std_m: ArrayLike,
    bias_std_m: float | None = None,
    *,
    known: bool = False,
) -> FloatArray:
    """Return the share (...) of its information that a link with random reflections keeps.

    The noise is ``(1 - p) N(0, s^2) + p N(bias, s^2 + bias_std^2)``; the Fisher information of
    its density about the range is compared with ``1 / s^2``.

    Parameters
    ----------
    probability
        Probability p of a reflected path.
    bias_m, bias_std_m
        Mean and standard deviation of its bias. Standard deviation None: the bias is unknown, and
        the share is ``1 - p``.
    std_m
        Standard deviation s (...) of the range, metres.
    known
        Whether it is known which ranges are reflected: ``1 - p + p s^2 / (s^2 + bias_std^2)``.

    Raises
    ------
    ValueError
        If the probability is outside [0, 1], `std_m` is not positive, or another standard
        deviation is negative.
    """
    p = check_number("probability", probability, low=0.0, high=1.0)
    bias_m = check_number("bias_m", bias_m)
    std = check_array("std_m", std_m, ())
    if (std < 1e-30).any():
        raise ValueError(f"std_m must be positive, got {std.min()}")
    if bias_std_m is None:
        return np.full(std.shape, 1 - p)
    bias_std_m = check_number("bias_std_m", bias_std_m, low=0.0)
    wider = np.sqrt(1 + (bias_std_m / std) ** 2)
    if known or p in (0.0, 1.0):
        return 1 - p + p / wider**2
    different, place = np.unique(std, return_inverse=True)
    shares = np.concatenate(
        [
            _mixture_information(p, bias_m / part, np.sqrt(1 + (bias_std_m / part) ** 2))
            for part in np.split(different, range(_BLOCK, len(different), _BLOCK))
        ]
    )
    return shares[place].reshape(std.shape)


def _mixture_information(p: float, shift: FloatArray, width: FloatArray) -> FloatArray:
    """Return the location information (K,) of ``(1 - p) N(0, 1) + p N(shift, width^2)``."""
    shift, width = shift[:, None], width[:, None]
    step = _NODES[1] - _NODES[0]
    bell = np.exp(-0.5 * _NODES**2) * step / np.sqrt(2 * np.pi)
    total = np.zeros(len(shift))
    # The mean squared score, integrated over each component of the mixture separately.
    for weight, x in (
        (1 - p, np.broadcast_to(_NODES, (len(shift), len(_NODES)))),
        (p, shift + width * _NODES),
    ):
        log_ratio = np.log(p / (1 - p)) - np.log(width)
        log_ratio = log_ratio - 0.5 * ((x - shift) / width) ** 2 + 0.5 * x**2
        reflected = 1 / (1 + np.exp(np.clip(-log_ratio, -700, 700)))
        score = (1 - reflected) * x + reflected * (x - shift) / width**2
        total += weight * (bell * score**2).sum(axis=-1)
    return total


def _checked(
    anchors: ArrayLike, tags: ArrayLike, rotation: ArrayLike, translation: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return (
        check_array("anchors", anchors, ("M", 3)),
        check_array("tags", tags, ("N", 3)),
        rotations.check_rotation("rotation", rotation),
        check_array("translation", translation, (3,)),
    )


def _distances(
    anchors: FloatArray, tags: FloatArray, rotation: FloatArray, translation: FloatArray
) -> FloatArray:
    """Return distances (..., M, N) of checked positions."""
    return kernel(ranging.distances)(
        anchors, kernel(ranging.tag_positions)(rotation, translation, tags)
    )


def _check_laws(noise: Any, link_model: Any = _ALL_MEASURE) -> None:
    check_law("noise", noise, ("variance",))
    if not isinstance(link_model, ranging.LinkModel):
        raise ValueError(f"link_model must be a ranging.LinkModel, got {link_model!r:.80}")
