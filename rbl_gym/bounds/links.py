"""Cramer-Rao bounds where links are lost, biased, or take a reflected path.

Shapes, the pose error (w, v) and the order of the 6 x 6 matrices are those of `bounds`. A bias is
a nuisance: it joins the pose as further parameters, and `marginal_information` takes them out
again by the Schur complement. A random path is a mixture of densities, whose information about
the range is an integral.
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
    check_links,
    check_number,
    check_one_of,
    kernel,
)
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.motion.kinematics import ProcessNoise, check_process

__all__ = [
    "GROUPS", "bias_information", "expected_information", "marginal_information",
    "nlos_efficiency", "posterior_bias_step", "realised_crb", "with_biases",
]  # fmt: skip

GROUPS = ("link", "anchor", "tag", "common")
# Nodes of the trapezoid rule on +-9 standard deviations; such integrands converge exponentially.
_NODES = np.linspace(-9.0, 9.0, 721)
# Draws, or biases, beyond which no memory suffices.
_MOST = 10**6
_ALL_MEASURE = ranging.LinkModel()
# Links whose integrals are taken at once.
_BLOCK = 512

# --- lost and reflected links --------------------------------------------------------------------


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
    """Mean Fisher information (..., 6, 6) of one epoch over the fates of its links.

    Its inverse bounds the error averaged over lost links too, but not tightly: the mean of the
    bounds is above the bound of the mean information (`realised_crb`).

    Parameters
    ----------
    anchors, tags, rotation, translation, noise
        As `bounds.range_information`.
    link_model
        What happens to links: `drop_probability`, `reach_m`, `nlos_probability`, `nlos_bias_m`.
    nlos_std_m
        Standard deviation of a reflected path's bias about ``nlos_bias_m``, metres; None: nothing
        is known of it, and a reflected range tells nothing.
    nlos_known
        Whether the receiver is told which ranges took a reflected path.

    Raises
    ------
    ValueError
        As `bounds.range_information`.
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
    return bounds.information_at(*places, noise, share)  # pyright: ignore[reportArgumentType]


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
    """Cramer-Rao bound (..., 6, 6) averaged over which links measure, each draw its own bound.

    What a filter that sees which ranges are missing can reach on average; reflected paths do not
    enter. Arguments as `bounds.pose_crb`; `draws` realisations by `rng`.

    Raises
    ------
    ValueError
        As `bounds.pose_crb`: also where the links of a single draw do not determine the pose.
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
    """Share (...) of its information that a link keeps if its path is reflected by chance.

    The noise is ``(1 - p) N(0, s^2) + p N(bias, s^2 + bias_std^2)``; the Fisher information of
    its density about the range is compared with ``1 / s^2``.

    Parameters
    ----------
    probability
        Of a reflected path, p.
    bias_m, bias_std_m
        Mean and standard deviation of what it adds; standard deviation None: nothing is known
        of the bias, and the share is ``1 - p``.
    std_m
        Standard deviation s (...) of the range, metres.
    known
        Whether it is known which ranges are reflected: ``1 - p + p s^2 / (s^2 + bias_std^2)``.

    Raises
    ------
    ValueError
        On a probability outside [0, 1], or standard deviations that are not positive (`std_m`)
        or negative.
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
    """Fisher information (K,) about its place of ``(1 - p) N(0, 1) + p N(shift, width^2)``."""
    shift, width = shift[:, None], width[:, None]
    step = _NODES[1] - _NODES[0]
    bell = np.exp(-0.5 * _NODES**2) * step / np.sqrt(2 * np.pi)
    total = np.zeros(len(shift))
    # The mean squared score, over each component of the mixture in turn.
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


# --- biased links --------------------------------------------------------------------------------


def bias_information(
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: ranging.NoiseLaw,
    links: ArrayLike | None = None,
    *,
    groups: str = "link",
) -> FloatArray:
    """Joint Fisher information (..., 6 + G, 6 + G) of one epoch about the pose and its biases.

    Parameters
    ----------
    anchors, tags, rotation, translation, noise, links
        As `bounds.range_information`.
    groups
        Which ranges share a bias: ``"link"`` (G = M N, in the order of the ranges), ``"anchor"``
        (M), ``"tag"`` (N), ``"common"`` (1).

    Raises
    ------
    ValueError
        As `bounds.range_information`, and on an unknown grouping.
    """
    check_one_of("groups", groups, GROUPS)
    places = _checked(anchors, tags, rotation, translation)
    shape = (places[0].shape[-2], places[1].shape[-2])
    mask = check_links(links, shape)
    _check_laws(noise)
    distance, J = bounds.range_jacobian(*places)
    if not (distance > 0).all():
        raise ValueError("anchors must not stand on a tag, where a range has no derivative")
    weight = 1 / np.broadcast_to(noise.variance(distance), distance.shape)
    if mask is not None:
        weight = weight * mask
    flat = weight.reshape((*weight.shape[:-2], 1, -1))
    D = _group_rows(groups, *shape)
    J = np.broadcast_to(J, (*flat.shape[:-2], *J.shape[-2:]))
    rows = np.concatenate([J, np.broadcast_to(D, (*flat.shape[:-2], *D.shape))], axis=-2)
    return (rows * flat) @ np.swapaxes(rows, -1, -2)


def with_biases(pose_information: ArrayLike, bias_std_m: float, n_biases: int) -> FloatArray:
    """Joint information (..., 6 + G, 6 + G) of a pose's prior and of G independent biases."""
    J = check_array("pose_information", pose_information, (6, 6))
    std = check_number("bias_std_m", bias_std_m, low=1e-12)
    n_biases = check_count("n_biases", n_biases, most=_MOST)
    joint = np.zeros((*J.shape[:-2], 6 + n_biases, 6 + n_biases))
    joint[..., :6, :6] = J
    joint[..., range(6, 6 + n_biases), range(6, 6 + n_biases)] = std**-2
    return joint


def marginal_information(joint: ArrayLike) -> FloatArray:
    """Information (..., 6, 6) about the pose alone, of one about pose and biases.

    The Schur complement ``J_pp - J_pb J_bb^-1 J_bp``; where a bias is without any information
    its row is zero, and it is left out.

    Raises
    ------
    ValueError
        On a matrix smaller than 7 x 7 or not square.
    """
    joint = check_array("joint", joint, ("n", "n"))
    if joint.shape[-1] != joint.shape[-2] or joint.shape[-1] < 7:
        raise ValueError(f"joint must have shape (..., 6 + G, 6 + G), got {joint.shape}")
    cross, own = joint[..., :6, 6:], joint[..., 6:, 6:].copy()
    idle = np.einsum("...ii->...i", own)
    idle[...] = np.where(idle > 0, idle, 1.0)
    try:
        with np.errstate(all="ignore"):
            told = np.linalg.solve(own, np.swapaxes(cross, -1, -2))
            marginal = bounds.symmetric(joint[..., :6, :6] - cross @ told)
    except np.linalg.LinAlgError:
        marginal = np.full((6, 6), np.nan)
    if not np.isfinite(marginal).all():
        raise ValueError(f"joint must be information, positive semidefinite, got {joint!r:.80}")
    return marginal


def posterior_bias_step(
    J: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: ranging.NoiseLaw,
    twist: ArrayLike,
    dt: float,
    process: ProcessNoise,
    links: ArrayLike | None = None,
    *,
    groups: str = "link",
    bias_walk_m: float = 0.0,
) -> FloatArray:
    """`bounds.posterior_crb_step` of the pose and its biases together.

    Parameters
    ----------
    J
        Joint information (..., 6 + G, 6 + G) of the epoch before; the first from `with_biases`.
    anchors, tags, rotation, translation, noise, links, groups
        At the new epoch, as `bias_information`.
    twist, dt, process
        Motion of the interval that ends at the new epoch.
    bias_walk_m
        Standard deviation of a bias's random walk after one second, metres.

    Returns
    -------
    Joint information after the new epoch; `marginal_information` of it bounds the pose.

    Raises
    ------
    ValueError
        As `bias_information`, and where J has another number of biases.
    """
    J = check_array("J", J, ("n", "n"))
    twist = check_array("twist", twist, (6,))
    dt = check_number("dt", dt, low=0.0)
    check_process(process)
    walk = check_number("bias_walk_m", bias_walk_m, low=0.0)
    told = bias_information(anchors, tags, rotation, translation, noise, links, groups=groups)
    n = told.shape[-1]
    if J.shape[-2:] != (n, n):
        raise ValueError(f"J must have shape (..., {n}, {n}) for groups {groups!r}, got {J.shape}")
    F = np.zeros((*twist.shape[:-1], n, n))
    F[..., range(n), range(n)] = 1.0
    F[..., :3, :3] = rotations.exp(twist[..., :3] * dt)
    Q = np.zeros((*twist.shape[:-1], n, n))
    Q[..., range(6, n), range(6, n)] = dt * walk**2
    Q[..., :6, :6] = process.covariance(twist, dt)
    turned = F @ J @ np.swapaxes(F, -1, -2)
    return bounds.symmetric(np.linalg.solve(np.eye(n) + turned @ Q, turned)) + told


def _group_rows(groups: str, n_anchors: int, n_tags: int) -> FloatArray:
    """Derivative (G, M N) of the ranges by the biases."""
    if groups == "link":
        return np.eye(n_anchors * n_tags)
    if groups == "anchor":
        return np.repeat(np.eye(n_anchors), n_tags, axis=1)
    if groups == "tag":
        return np.tile(np.eye(n_tags), n_anchors)
    return np.ones((1, n_anchors * n_tags))


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
    """Distances (..., M, N) of checked places."""
    return kernel(ranging.distances)(
        anchors, kernel(ranging.tag_positions)(rotation, translation, tags)
    )


def _check_laws(noise: Any, link_model: Any = _ALL_MEASURE) -> None:
    if not callable(getattr(noise, "variance", None)):
        raise ValueError(f"noise must be a noise law of rbl_gym.ranging, got {noise!r:.80}")
    if not isinstance(link_model, ranging.LinkModel):
        raise ValueError(f"link_model must be a ranging.LinkModel, got {link_model!r:.80}")
