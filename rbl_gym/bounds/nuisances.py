"""Include unknowns besides the pose in the bounds: anchor positions, biases, offsets.

Nuisances with a prior are added to the states of the body, in units of their prior standard
deviations. Their prior is therefore always ``N(0, I)``. Anchor positions and constant biases do
not change between epochs, so that a recursion (`posterior.posterior_step`) estimates them. Slow
biases decorrelate. The marginal information of the pose is the Schur complement. A white offset
has no prior and no states: it is eliminated within its epoch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.bounds import information as fisher
from rbl_gym.bounds.pose import inverted, symmetric
from rbl_gym.checks import (
    BoolArray,
    FloatArray,
    check_array,
    check_count,
    check_links,
    check_one_of,
)
from rbl_gym.geometry import rotations
from rbl_gym.measurements import offsets
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.measurements.noise_laws import check_law
from rbl_gym.measurements.ranging import NoiseLaw

__all__ = [
    "GROUPS", "Nuisances", "RangeEpoch", "epoch_crb", "epoch_information", "marginal_information",
    "with_nuisances",
]  # fmt: skip

GROUPS = ("link", "anchor", "tag", "common")
# Minimum correlation of a bias over an interval.
_LEAST_KEPT = 1e-6
_ONE = np.ones((1, 1))
# Maximum number of nuisance states, limited by memory.
_MOST = 10**5


class RangeEpoch(NamedTuple):
    """One epoch of ranges at the true pose.

    Attributes
    ----------
    anchors, tags, rotation, translation
        (..., M, 3), (..., N, 3), (..., 3, 3), (..., 3); metres. The pose is the true one.
    noise
        Noise law of the ranges.
    links
        Mask (..., M, N), True = measured; None: all.
    """

    anchors: ArrayLike
    tags: ArrayLike
    rotation: ArrayLike
    translation: ArrayLike
    noise: NoiseLaw
    links: ArrayLike | None = None

    def checked(self) -> RangeEpoch:
        """Return the epoch with float64 arrays; raise ValueError for invalid arguments."""
        anchors = check_array("anchors", self.anchors, ("M", 3))
        tags = check_array("tags", self.tags, ("N", 3))
        rotation = rotations.check_rotation("rotation", self.rotation)
        translation = check_array("translation", self.translation, (3,))
        check_law("noise", self.noise, ("variance",))
        mask = check_links(self.links, (anchors.shape[-2], tags.shape[-2]))
        return RangeEpoch(anchors, tags, rotation, translation, self.noise, mask)


@dataclass(frozen=True, eq=False)
class Nuisances:
    """The unknowns besides the states of the body.

    Parameters
    ----------
    offset
        Which ranges share an unknown offset, independent at every epoch (`measurements.offsets`).
    anchor_std_m
        Standard deviation of the anchor positions: one, one per anchor (M,), or one per axis
        (M, 3). The positions are constant.
    bias
        Law of range biases, constant or slow; None: no biases.
    groups
        Which ranges share a bias: ``"link"`` (M N biases, in the order of the ranges),
        ``"anchor"`` (M), ``"tag"`` (N), ``"common"`` (1).

    Raises
    ------
    ValueError
        If `offset`, `bias` or `groups` is none of the above, or a deviation is negative.
    """

    offset: str | None = None
    anchor_std_m: ArrayLike = 0.0
    bias: LinkBias | None = None
    groups: str = "link"

    def __post_init__(self) -> None:
        offsets.check_offset(self.offset)
        if (check_array("anchor_std_m", self.anchor_std_m, ()) < 0).any():
            raise ValueError(f"anchor_std_m must not be negative, got {self.anchor_std_m!r:.80}")
        if not isinstance(self.bias, LinkBias | None):
            raise ValueError(f"bias must be a LinkBias or None, got {self.bias!r:.80}")
        check_one_of("groups", self.groups, GROUPS)

    def anchor_std(self, anchors: int) -> FloatArray | None:
        """Return standard deviations (M, 3) of the anchor positions; None: they are known."""
        return fisher.anchor_deviations(self.anchor_std_m, anchors)

    def bias_rows(self, anchors: int, tags: int) -> FloatArray | None:
        """Return the derivative (G, M N) of the ranges by the biases, in prior deviations."""
        law, links = self.bias, anchors * tags
        if law is None:
            return None
        own = {
            "link": np.eye(links),
            "anchor": np.repeat(np.eye(anchors), tags, axis=1),
            "tag": np.tile(np.eye(tags), anchors),
            "common": np.ones((1, links)),
        }[self.groups]
        rows = [own] * (law.std_m > 0), [np.ones((1, links))] * (law.common_std_m > 0)
        scaled = [law.std_m * row for row in rows[0]] + [law.common_std_m * row for row in rows[1]]
        return np.concatenate(scaled) if scaled else None

    def count(self, anchors: int, tags: int) -> int:
        """Return the number of nuisance states for these numbers of anchors and tags."""
        rows = self.bias_rows(anchors, tags)
        places = 0 if self.anchor_std(anchors) is None else 3 * anchors
        return places + (0 if rows is None else len(rows))

    def faded(self, J: FloatArray, biases: int, dt: ArrayLike) -> FloatArray:
        """Return the joint information (..., n, n) after `dt` seconds.

        The biases, which are the last states, decorrelate in this time.
        """
        if self.bias is None or self.bias.time_s is None or biases == 0:
            return J
        n = J.shape[-1]
        kept = np.maximum(np.exp(-np.asarray(dt, float) / self.bias.time_s), _LEAST_KEPT)
        scale = np.ones((*kept.shape, n))
        scale[..., n - biases :] = kept[..., None]
        fresh = 1 - scale**2
        told = J / (scale[..., :, None] * scale[..., None, :])
        return symmetric(np.linalg.solve(np.eye(n) + told * fresh[..., None, :], told))


def epoch_information(epoch: RangeEpoch, nuisances: Nuisances | None = None) -> FloatArray:
    """Return the joint Fisher information (..., 6 + q, 6 + q) of one epoch on pose and nuisances.

    It is that of the ranges alone, without the prior of the nuisances.

    Parameters
    ----------
    epoch
        The measured ranges.
    nuisances
        The order of their q states is: anchor positions (x, y, z of the first, then of the next),
        biases by group, the bias common to all. All are in units of their prior standard
        deviations.

    Raises
    ------
    ValueError
        As in `bounds.range_information`.
    """
    epoch, nuisances = RangeEpoch(*epoch).checked(), nuisances or Nuisances()
    return information_of(epoch, nuisances, epoch.links)  # pyrefly: ignore[bad-argument-type]


def information_of(
    epoch: RangeEpoch, nuisances: Nuisances, share: FloatArray | BoolArray | None
) -> FloatArray:
    """Compute `epoch_information` of a checked epoch.

    `share` (..., M, N) as in `information_at`.
    """
    anchors, tags, rotation, translation = (np.asarray(array) for array in epoch[:4])
    places = anchors, tags, rotation, translation
    shape = anchors.shape[-2], tags.shape[-2]
    if not nuisances.count(*shape):
        return fisher.information_at(*places, epoch.noise, share, nuisances.offset)
    rows, weight = fisher.weighted_rows(
        *places, epoch.noise, _ONE if share is None else share, nuisances.offset,
        nuisances.anchor_std(shape[0]), nuisances.bias_rows(*shape),
    )  # fmt: skip
    return (rows * weight[..., None, :]) @ np.swapaxes(rows, -1, -2)


def with_nuisances(information: ArrayLike, count: int) -> FloatArray:
    """Return joint information (..., n + q, n + q) of body states and the prior of q nuisances.

    Parameters
    ----------
    information
        (..., n, n), of the prior of the body states.
    count
        q, as from `Nuisances.count`.
    """
    J, count = (
        check_array("information", information, ("n", "n")),
        check_count("count", count, least=0, most=_MOST),
    )
    n = J.shape[-1]
    if J.shape[-2] != n:
        raise ValueError(f"information must have shape (..., n, n), got {J.shape}")
    joint = np.zeros((*J.shape[:-2], n + count, n + count))
    joint[..., :n, :n] = J
    joint[..., range(n, n + count), range(n, n + count)] = 1.0
    return joint


def with_epoch(J: FloatArray, told: FloatArray, states: int) -> FloatArray:
    """Add the information of an epoch to joint information J on body states and q nuisances.

    `told` (..., 6 + q, 6 + q) is on the pose, which is first among the states, and the nuisances.
    """
    n, batch = J.shape[-1], np.broadcast_shapes(J.shape[:-2], told.shape[:-2])
    result = np.broadcast_to(J, (*batch, n, n)).copy()
    where = np.r_[0:6, states:n]
    result[..., where[:, None], where] += told
    return result


def marginal_information(joint: ArrayLike) -> FloatArray:
    """Return the information (..., 6, 6) on the pose, the first six states: the Schur complement.

    Raises
    ------
    ValueError
        If the matrix is not square, has fewer states, or is singular in the other states.
    """
    joint = check_array("joint", joint, ("n", "n"))
    if joint.shape[-1] != joint.shape[-2] or joint.shape[-1] < 6:
        raise ValueError(f"joint must have shape (..., 6 + q, 6 + q), got {joint.shape}")
    try:
        with np.errstate(all="ignore"):
            found = fisher.marginal(joint, 6)
    except np.linalg.LinAlgError:
        found = np.full((6, 6), np.nan)
    if not np.isfinite(found).all():
        raise ValueError(
            f"joint must be an information matrix (positive semidefinite), got {joint!r:.80}"
        )
    return found


def epoch_crb(
    epoch: RangeEpoch,
    nuisances: Nuisances | None = None,
    prior_information: ArrayLike | None = None,
) -> FloatArray:
    """Return the Cramer-Rao bound (..., 6, 6) of the pose from one epoch with nuisances.

    Parameters
    ----------
    epoch, nuisances
        As in `epoch_information`.
    prior_information
        (..., 6, 6) of the pose, if any.

    Raises
    ------
    ValueError
        As in `bounds.pose_crb`.
    """
    joint = epoch_information(epoch, nuisances)
    own = np.arange(6, joint.shape[-1])
    joint[..., own, own] += 1.0
    told = fisher.marginal(joint, 6)
    if prior_information is not None:
        told = told + check_array("prior_information", prior_information, (6, 6))
    return inverted(told, "anchors or tags")
