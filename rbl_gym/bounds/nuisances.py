"""What ranges depend on besides the pose and is not known either: anchors' places, biases, offsets.

Nuisances with a prior join the states of the body, and count in standard deviations of it: their
prior is ``N(0, I)``, whatever they are. Anchors' places and constant biases stand still from epoch
to epoch, so that a recursion (`posterior.posterior_step`) learns them; slow biases fade. The
marginal information of the pose is the Schur complement. A white offset has no prior and no
states: it is taken out within its epoch.
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
from rbl_gym.measurements.ranging import NoiseLaw

__all__ = [
    "GROUPS", "Nuisances", "RangeEpoch", "epoch_crb", "epoch_information", "marginal_information",
    "with_nuisances",
]  # fmt: skip

GROUPS = ("link", "anchor", "tag", "common")
# A bias that keeps less than this of itself over an interval counts as one that keeps so much.
_LEAST_KEPT = 1e-6
_ONE = np.ones((1, 1))
# States of nuisances beyond which no memory suffices.
_MOST = 10**5


class RangeEpoch(NamedTuple):
    """One epoch of ranges at the truth.

    Attributes
    ----------
    anchors, tags, rotation, translation
        (..., M, 3), (..., N, 3), (..., 3, 3), (..., 3); metres. The pose is the true one.
    noise
        Law of the ranges.
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
        """The same as arrays of float64; a ValueError that names what is wrong."""
        anchors = check_array("anchors", self.anchors, ("M", 3))
        tags = check_array("tags", self.tags, ("N", 3))
        rotation = rotations.check_rotation("rotation", self.rotation)
        translation = check_array("translation", self.translation, (3,))
        if not callable(getattr(self.noise, "variance", None)):
            raise ValueError(
                f"noise must be a noise law of rbl_gym.ranging, got {self.noise!r:.80}"
            )
        mask = check_links(self.links, (anchors.shape[-2], tags.shape[-2]))
        return RangeEpoch(anchors, tags, rotation, translation, self.noise, mask)


@dataclass(frozen=True, eq=False)
class Nuisances:
    """What is not known besides the states of the body.

    Parameters
    ----------
    offset
        Whose ranges have an unknown offset in common, new at every epoch (`measurements.offsets`).
    anchor_std_m
        Standard deviation of the anchors' places: one, one for each anchor (M,), or for each of
        their axes (M, 3). They do not change.
    bias
        Law of biases of the ranges, constant or slow; None: there are none.
    groups
        Which ranges share a bias: ``"link"`` (M N biases, in the order of the ranges),
        ``"anchor"`` (M), ``"tag"`` (N), ``"common"`` (1).

    Raises
    ------
    ValueError
        On a value that is none of these.
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
        """Standard deviations (M, 3) of the anchors' places; None: these are known."""
        return fisher.anchor_deviations(self.anchor_std_m, anchors)

    def bias_rows(self, anchors: int, tags: int) -> FloatArray | None:
        """Derivative (G, M N) of the ranges by the biases, in standard deviations."""
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
        """How many states the nuisances have, for so many anchors and tags."""
        rows = self.bias_rows(anchors, tags)
        places = 0 if self.anchor_std(anchors) is None else 3 * anchors
        return places + (0 if rows is None else len(rows))

    def faded(self, J: FloatArray, biases: int, dt: ArrayLike) -> FloatArray:
        """Joint information (..., n, n) after `dt` seconds: its last states, the biases, fade."""
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
    """Joint Fisher information (..., 6 + q, 6 + q) of one epoch about the pose and its nuisances.

    Of the ranges alone, without the nuisances' prior.

    Parameters
    ----------
    epoch
        What was measured.
    nuisances
        Their q states come in this order: places of the anchors (x, y, z of the first, then of
        the next), biases by groups, the bias common to all. All in standard deviations of their
        priors.

    Raises
    ------
    ValueError
        As `bounds.range_information`.
    """
    epoch, nuisances = RangeEpoch(*epoch).checked(), nuisances or Nuisances()
    return information_of(epoch, nuisances, epoch.links)  # pyright: ignore[reportArgumentType]


def information_of(
    epoch: RangeEpoch, nuisances: Nuisances, share: FloatArray | BoolArray | None
) -> FloatArray:
    """`epoch_information` of a checked epoch; `share` (..., M, N) as `information_at`."""
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
    """Joint information (..., n + q, n + q) of the body's states and of q nuisances' prior.

    Parameters
    ----------
    information
        (..., n, n), of the prior of the body's states.
    count
        q, as `Nuisances.count` says.
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
    """Joint information J about so many states of the body and q nuisances, with an epoch's.

    `told` (..., 6 + q, 6 + q) is about the pose, which comes first of the states, and nuisances.
    """
    n, batch = J.shape[-1], np.broadcast_shapes(J.shape[:-2], told.shape[:-2])
    result = np.broadcast_to(J, (*batch, n, n)).copy()
    where = np.r_[0:6, states:n]
    result[..., where[:, None], where] += told
    return result


def marginal_information(joint: ArrayLike, states: int = 6) -> FloatArray:
    """Information (..., n, n) about the first `states` of a joint one: the Schur complement.

    Raises
    ------
    ValueError
        On what is not square, has fewer states, or is singular in the others.
    """
    joint = check_array("joint", joint, ("n", "n"))
    if joint.shape[-1] != joint.shape[-2] or joint.shape[-1] < states:
        raise ValueError(
            f"joint must have shape (..., {states} + q, {states} + q), got {joint.shape}"
        )
    try:
        with np.errstate(all="ignore"):
            found = fisher.marginal(joint, states)
    except np.linalg.LinAlgError:
        found = np.full((states, states), np.nan)
    if not np.isfinite(found).all():
        raise ValueError(f"joint must be information, positive semidefinite, got {joint!r:.80}")
    return found


def epoch_crb(
    epoch: RangeEpoch,
    nuisances: Nuisances | None = None,
    prior_information: ArrayLike | None = None,
) -> FloatArray:
    """Cramer-Rao bound (..., 6, 6) of the pose from one epoch of ranges with nuisances.

    Parameters
    ----------
    epoch, nuisances
        As of `epoch_information`.
    prior_information
        (..., 6, 6) of the pose, if any.

    Raises
    ------
    ValueError
        As `bounds.pose_crb`.
    """
    joint = epoch_information(epoch, nuisances)
    own = np.arange(6, joint.shape[-1])
    joint[..., own, own] += 1.0
    told = fisher.marginal(joint, 6)
    if prior_information is not None:
        told = told + check_array("prior_information", prior_information, (6, 6))
    return inverted(told, "anchors or tags")
