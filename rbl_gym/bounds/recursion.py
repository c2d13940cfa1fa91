"""Compute the posterior Cramer-Rao recursion (Tichavsky et al. 1998), with nuisances."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds.motions import KnownTwist, Motion
from rbl_gym.bounds.nuisances import Nuisances, RangeEpoch, information_of, with_epoch
from rbl_gym.checks import FloatArray, check_array
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

__all__ = ["posterior_crb_step", "posterior_step"]


def posterior_step(
    J: ArrayLike, epoch: RangeEpoch, motion: Motion | None, nuisances: Nuisances | None = None
) -> FloatArray:
    """Return the information after one step of the recursion, at the true pose.

    Parameters
    ----------
    J
        Joint information (..., n + q, n + q) of the previous epoch: n states of the body, of which
        the first six are the pose, then q nuisances in units of their prior standard deviations.
        At the start it is that of the prior, `with_nuisances`.
    epoch
        The measured ranges.
    motion
        Motion of the interval that ends at the epoch: a `KnownTwist` (n = 6), an `UnknownTwist`
        (12), an `InertialMotion` (15 or 17); None: no interval, J is at the same time.
    nuisances
        Further unknowns; their states are those of `epoch_information`.

    Returns
    -------
    Information (..., n + q, n + q). The inverse of its `marginal_information`, or the first block
    of its inverse, bounds the pose.

    Raises
    ------
    ValueError
        If a shape or value is wrong, or J is singular and the motion has more states than the
        pose.
    """
    J = check_array("J", J, ("n", "n"))
    epoch, nuisances = RangeEpoch(*epoch).checked(), nuisances or Nuisances()
    anchors, tags = np.shape(epoch.anchors)[-2], np.shape(epoch.tags)[-2]
    count = nuisances.count(anchors, tags)
    states = J.shape[-1] - count
    sizes = (6, 12, 15, 17) if motion is None else motion.sizes
    if J.shape[-2] != J.shape[-1] or states not in sizes:
        wanted = " or ".join(f"(..., {n + count}, {n + count})" for n in sizes)
        more = f" with {count} nuisance states" * (count > 0)
        raise ValueError(f"J must have shape {wanted}{more}, got {J.shape}")
    if motion is not None:
        motion = motion.checked()
        J = motion.predict(J, states, np.asarray(epoch.rotation))
        if not np.isfinite(J).all():
            raise ValueError(
                "J must be positive definite (information about all states), got a singular matrix"
            )
        rows = nuisances.bias_rows(anchors, tags)
        J = nuisances.faded(J, 0 if rows is None else len(rows), motion.seconds)
    told = information_of(epoch, nuisances, epoch.links)  # pyrefly: ignore[bad-argument-type]
    return with_epoch(J, told, states)


def posterior_crb_step(
    J: ArrayLike,
    anchors: ArrayLike,
    tags: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    noise: NoiseLaw,
    twist: ArrayLike,
    dt: ArrayLike,
    process: ProcessNoise,
    links: ArrayLike | None = None,
) -> FloatArray:
    """Compute `posterior_step` of a pose with known twist and without nuisances.

    Parameters
    ----------
    J
        Posterior information (..., 6, 6) of the previous epoch.
    anchors, tags, rotation, translation, noise, links
        At the new epoch, as in `RangeEpoch`.
    twist, dt, process
        Of the interval that ends there, as in `KnownTwist`.

    Returns
    -------
    Information (..., 6, 6) after the new epoch; its inverse is the bound.
    """
    J = check_array("J", J, (6, 6))
    epoch = RangeEpoch(anchors, tags, rotation, translation, noise, links)
    return posterior_step(J, epoch, KnownTwist(twist, dt, process))
