"""Evaluate the requirements of a zone from the information at its poses.

The figures at a position are standard deviations for one epoch of ranges by the Cramer-Rao bound,
as root mean squares over the possible rotations of the body. A position is within the requirement
if every figure with a limit is at most that limit. A zone passes if the share of such positions is
at least the required share.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special

from rbl_gym import bounds
from rbl_gym.checks import BoolArray, FloatArray, check_number
from rbl_gym.geometry import rotations
from rbl_gym.kernels import Compiled, compiled

__all__ = [
    "Asked",
    "Errors",
    "Limits",
    "asked_of",
    "errors_of",
    "relative_errors",
    "set_interval",
    "shortfall",
    "turns",
    "value_at_share",
    "wilson_interval",
]

# Shortfall of a zone: for the margin that it lacks, and for the whole of its required share.
_MARGIN, _ALL = 0.3, 0.7
# Weight of the mean log of the errors above their limits, which gives a slope far from the limits.
_EXCESS = 0.1
# Random rotations of a free body are always the same.
_TURN_SEED = 20130821


class Errors(NamedTuple):
    """Predicted errors at positions, (...): one sigma, root mean squares over the rotations.

    Attributes
    ----------
    position, rotation
        Over all three axes: metres, radians.
    score
        b, the root mean square error of the tags, metres.
    horizontal, height
        Horizontal position, ``sqrt(P_xx + P_yy)``, and height, metres.
    heading
        Rotation about the vertical, radians.
    """

    position: FloatArray
    rotation: FloatArray
    score: FloatArray
    horizontal: FloatArray
    height: FloatArray
    heading: FloatArray

    def of_places(self, which: slice) -> Errors:
        """Return the errors of some of the positions."""
        return Errors(*(values[..., which] for values in self))


class Asked(NamedTuple):
    """Errors (...) that a zone may limit, a subset of `Errors`."""

    horizontal: FloatArray
    height: FloatArray
    heading: FloatArray


class Limits(NamedTuple):
    """Limits of the errors at a position: metres, metres, radians; infinite if none."""

    horizontal: float = math.inf
    height: float = math.inf
    heading: float = math.inf

    def any(self) -> bool:
        """Return whether any limit is finite."""
        return any(math.isfinite(limit) for limit in self)


def turns(attitude: str, count: int) -> FloatArray:
    """Return rotations (count, 3, 3) over which the figures at a position are averaged.

    Parameters
    ----------
    attitude
        ``"free"``: random rotations, drawn once. ``"level"`` or ``"heading"``: about the vertical,
        evenly spaced, the first is the identity.
    count
        Number of rotations.
    """
    if attitude == "free":
        return rotations.random(np.random.default_rng(_TURN_SEED), (count,))
    angle = 2 * np.pi * np.arange(count) / count
    return rotations.exp(angle[:, None] * np.array([0.0, 0.0, 1.0]))


def errors_of(
    information: FloatArray, rotation: FloatArray, tags: FloatArray, part: FloatArray | None = None
) -> Errors:
    """Return errors (...) at positions from information (..., T, 6, 6) at T rotations, with prior.

    Parameters
    ----------
    information
        Total information at every position and rotation.
    rotation, tags
        Rotations (..., T, 3, 3), and tags (N, 3) on the body.
    part
        Information (..., T, 6, 6) to add: of one more anchor, or the negative of one to remove.

    Raises
    ------
    ValueError
        If the information is singular, as with fewer ranges than a pose needs and no prior.
    """
    args = information, _part(part, information), rotation, tags
    return Errors(*_roots(_mean_squares, *args))


def asked_of(information: FloatArray, part: FloatArray | None = None) -> Asked:
    """Return the part of `errors_of` that a zone may limit, three times faster."""
    return Asked(*_roots(_asked_squares, information, _part(part, information)))


def _part(part: FloatArray | None, information: FloatArray) -> FloatArray:
    """Return the information to add; zero for None."""
    part = np.zeros((1, 6, 6)) if part is None else part
    return np.broadcast_to(part, (*part.shape[:-3], *information.shape[-3:]))


def _roots(squares: Compiled, *args: FloatArray) -> list[FloatArray]:
    """Return the square roots of `squares`; raise ValueError if singular."""
    try:
        found = squares(*args)
    except np.linalg.LinAlgError:
        found = (np.array(np.nan),)
    if not np.isfinite(found[0]).all():
        raise ValueError("information must be positive definite at every place")
    return [np.sqrt(square) for square in found]


@compiled("place_errors:mean_squares")
def _mean_squares(
    base: FloatArray, part: FloatArray, rotation: FloatArray, tags: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the mean squares of `Errors` over the rotations, for the information base + part."""
    P = np.linalg.inv(base + part)
    variance = np.einsum("...ii->...i", P)
    b = bounds.score(P, rotation, tags[..., None, :, :])
    squares = (
        variance[..., 3:].sum(axis=-1),
        variance[..., :3].sum(axis=-1),
        b**2,
        variance[..., 3] + variance[..., 4],
        variance[..., 5],
        variance[..., 2],
    )
    return tuple(square.mean(axis=-1) for square in squares)


@compiled("place_errors:asked_squares")
def _asked_squares(base: FloatArray, part: FloatArray) -> tuple[FloatArray, ...]:
    """Return the mean squares of `Asked` over the rotations, for the information base + part."""
    variance = np.einsum("...ii->...i", np.linalg.inv(base + part))
    squares = variance[..., 3] + variance[..., 4], variance[..., 5], variance[..., 2]
    return tuple(square.mean(axis=-1) for square in squares)


def relative_errors(errors: Errors | Asked, limits: Limits) -> FloatArray:
    """Return the largest ratio (...) of an error to its limit at each position; within if <= 1.

    Parameters
    ----------
    errors
        Errors at positions.
    limits
        Limits of the zone; at least one is finite.
    """
    ratios = [getattr(errors, name) / limit for name, limit in limits._asdict().items()]
    return np.max(ratios, axis=0)


def value_at_share(values: FloatArray, share: float) -> FloatArray:
    """Return the smallest value (...) that this share of the positions (..., L) does not exceed.

    For relative errors it is at most 1 if and only if the share within is at least `share`.

    Parameters
    ----------
    values
        Values at positions; infinite if undefined.
    share
        Share of the positions, above 0, at most 1.
    """
    check_number("share", share, low=0.0, high=1.0)
    rank = _rank(share, values.shape[-1])
    return np.partition(values, rank, axis=-1)[..., rank]


def shortfall(relative: FloatArray, share: float) -> FloatArray:
    """Return what a zone lacks of its requirement (...), zero if and only if it is met.

    Of the best positions that fill the required share, it is 0.7 times the part whose errors are
    above their limits, plus 0.3 times what the margin lacks of 1, plus a tenth of the mean log of
    the errors over the limits.

    Parameters
    ----------
    relative
        Relative errors at positions (..., L).
    share
        Required share of the positions, above 0, at most 1.
    """
    rank = _rank(share, relative.shape[-1])
    best = np.partition(relative, rank, axis=-1)[..., : rank + 1]
    above = (best > 1).mean(axis=-1)
    excess = np.log(np.maximum(best, 1.0)).mean(axis=-1)
    margin = 1 / np.maximum(best.max(axis=-1), 1.0)
    return _MARGIN * (1 - margin) + _ALL * above + _EXCESS * excess


def _rank(share: float, count: int) -> int:
    """Return the index, in ascending order, of the position that fills the share."""
    # Shares are decimals: 0.95 of 100 positions is 95, not 96.
    return min(max(math.ceil(share * count - 1e-9) - 1, 0), count - 1)


def wilson_interval(within: int, places: int) -> tuple[float, float]:
    """Return the 95 % interval of the share of a zone, from uniform positions (Wilson, 1927).

    `within` of all `places` are within the requirement.
    """
    z = float(special.ndtri(0.975))
    share = within / places
    middle = share + z * z / (2 * places)
    half = z * math.sqrt(share * (1 - share) / places + z * z / (4 * places**2))
    scale = 1 + z * z / places
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def set_interval(shares: FloatArray) -> tuple[float, float]:
    """Return the 95 % interval of the share of a zone, from shares (K,) of independent sets.

    It is Student's interval of the mean of at least two sets. Unlike `wilson_interval` it takes
    into account that each set fills the zone evenly.
    """
    mean, deviation = float(shares.mean()), float(shares.std(ddof=1))
    t = float(special.stdtrit(len(shares) - 1, 0.975))
    half = t * deviation / math.sqrt(len(shares))
    return max(0.0, mean - half), min(1.0, mean + half)


def share_within(relative: FloatArray) -> BoolArray:
    """Return the share (...) of positions (..., L) within the requirement."""
    return (relative <= 1).mean(axis=-1)
