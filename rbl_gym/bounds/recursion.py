"""The posterior Cramer-Rao recursion (Tichavsky et al. 1998), of any motion and with nuisances."""

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
    J: ArrayLike,
    epoch: RangeEpoch,
    motion: Motion | None,
    nuisances: Nuisances | None = None,
) -> FloatArray:
    """One step of the recursion at the truth: information after the epoch.

    Parameters
    ----------
    J
        Joint information (..., n + q, n + q) of the epoch before: n states of the body, of which
        the first six are the pose, then q nuisances in standard deviations of their priors. At a
        start that of the prior, `with_nuisances`.
    epoch
        What is measured.
    motion
        Of the interval that ends at the epoch: a `KnownTwist` (n = 6), an `UnknownTwist` (12), an
        `InertialMotion` (15 or 17); None: there is none, and J is about the same time.
    nuisances
        What else is not known; their states as of `epoch_information`.

    Returns
    -------
    Information (..., n + q, n + q); `marginal_information` of it, or the first rows of its
    inverse, bound the pose.

    Raises
    ------
    ValueError
        On wrong shapes or values, and on a singular J where the motion has more states than the
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
        more = f" with {count} states of nuisances" * (count > 0)
        raise ValueError(f"J must have shape {wanted}{more}, got {J.shape}")
    if motion is not None:
        motion = motion.checked()
        J = motion.predict(J, states, np.asarray(epoch.rotation))
        if not np.isfinite(J).all():
            raise ValueError("J must be information about all states, got a singular one")
        rows = nuisances.bias_rows(anchors, tags)
        J = nuisances.faded(J, 0 if rows is None else len(rows), motion.seconds)
    told = information_of(epoch, nuisances, epoch.links)  # pyright: ignore[reportArgumentType]
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
    """`posterior_step` of a pose alone, whose twist is told, with everything else known.

    Parameters
    ----------
    J
        Posterior information (..., 6, 6) of the epoch before.
    anchors, tags, rotation, translation, noise, links
        At the new epoch, as of `RangeEpoch`.
    twist, dt, process
        Of the interval that ends there, as of `KnownTwist`.

    Returns
    -------
    Information (..., 6, 6) after the new epoch; its inverse is the bound.
    """
    J = check_array("J", J, (6, 6))
    epoch = RangeEpoch(anchors, tags, rotation, translation, noise, links)
    return posterior_step(J, epoch, KnownTwist(twist, dt, process))
