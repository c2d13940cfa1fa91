"""What a zone asks for, and when a place meets it: functions on the information at its poses.

The figures at a place are one standard deviation of one epoch of ranges by the Cramer-Rao bound,
root mean squares over the turns that the body may have there. A place is within the requirement
where every figure that has a limit is at most that limit. A zone passes where the share of such
places is at least the share that it asks for.
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
    "turns",
    "value_at_share",
    "wilson_interval",
]

# The turns of a body that may turn anyhow are the same for ever.
_TURN_SEED = 20130821


class Errors(NamedTuple):
    """Predicted errors at places, (...): one sigma, root mean squares over the turns.

    Attributes
    ----------
    position, rotation
        Of all three axes together: metres, radians.
    score
        b, the root mean square error of the tags, metres.
    horizontal, height
        Position across the vertical, ``sqrt(P_xx + P_yy)``, and along it, metres.
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
        """Of some of the places."""
        return Errors(*(values[..., which] for values in self))


class Asked(NamedTuple):
    """Those of the `Errors` (...) that a zone may ask for."""

    horizontal: FloatArray
    height: FloatArray
    heading: FloatArray


class Limits(NamedTuple):
    """Most that a place may have: metres, metres, radians; infinite: anything."""

    horizontal: float = math.inf
    height: float = math.inf
    heading: float = math.inf

    def any(self) -> bool:
        """Whether one of them is a limit."""
        return any(math.isfinite(limit) for limit in self)


def turns(attitude: str, count: int) -> FloatArray:
    """Turns (count, 3, 3) of a body over which the figures at a place are averaged.

    Parameters
    ----------
    attitude
        ``"free"``: drawn once for all from all rotations. ``"level"`` or ``"heading"``: about
        the vertical, evenly spaced, the first none.
    count
        How many.
    """
    if attitude == "free":
        return rotations.random(np.random.default_rng(_TURN_SEED), (count,))
    angle = 2 * np.pi * np.arange(count) / count
    return rotations.exp(angle[:, None] * np.array([0.0, 0.0, 1.0]))


def errors_of(
    information: FloatArray, rotation: FloatArray, tags: FloatArray, part: FloatArray | None = None
) -> Errors:
    """Errors (...) at places of an information (..., T, 6, 6) at T turns, its prior included.

    Parameters
    ----------
    information
        At every place and turn, of all that is known.
    rotation, tags
        Turns (..., T, 3, 3), and tags (N, 3) on the body.
    part
        (..., T, 6, 6), information that is added: of one more anchor, or less of one.

    Raises
    ------
    ValueError
        Where an information is singular: without a prior, of fewer ranges than a pose needs.
    """
    args = information, _part(part, information), rotation, tags
    return Errors(*_roots(_mean_squares, *args))


def asked_of(information: FloatArray, part: FloatArray | None = None) -> Asked:
    """`errors_of` that a zone may ask for, in a third of its time. Arguments as there."""
    return Asked(*_roots(_asked_squares, information, _part(part, information)))


def _part(part: FloatArray | None, information: FloatArray) -> FloatArray:
    """What is added to the information, nothing for None."""
    part = np.zeros((1, 6, 6)) if part is None else part
    return np.broadcast_to(part, (*part.shape[:-3], *information.shape[-3:]))


def _roots(squares: Compiled, *args: FloatArray) -> list[FloatArray]:
    """Roots of what `squares` says, or a ValueError where an information is singular."""
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
    """Means over the turns of the squares of `Errors`, of the information base + part."""
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
    """Means over the turns of the squares of `Asked`, of the information base + part."""
    variance = np.einsum("...ii->...i", np.linalg.inv(base + part))
    squares = variance[..., 3] + variance[..., 4], variance[..., 5], variance[..., 2]
    return tuple(square.mean(axis=-1) for square in squares)


def relative_errors(errors: Errors | Asked, limits: Limits) -> FloatArray:
    """The largest ratio (...) of an error to its limit at each place: within where at most 1.

    Parameters
    ----------
    errors
        At places.
    limits
        Of the zone; one of them at least is finite.
    """
    ratios = [getattr(errors, name) / limit for name, limit in limits._asdict().items()]
    return np.max(ratios, axis=0)


def value_at_share(values: FloatArray, share: float) -> FloatArray:
    """The least value (...) that this share of the places (..., L) does not exceed.

    Of relative errors it is at most 1 just where the share within is at least `share`.

    Parameters
    ----------
    values
        At places; infinite where a place has none.
    share
        Of the places, above 0, at most 1.
    """
    check_number("share", share, low=0.0, high=1.0)
    rank = _rank(share, values.shape[-1])
    return np.partition(values, rank, axis=-1)[..., rank]


def _rank(share: float, count: int) -> int:
    """Index, in rising order, of the place that fills the share."""
    # Shares are decimals: 0.95 of 100 places are 95, not 96.
    return min(max(math.ceil(share * count - 1e-9) - 1, 0), count - 1)


def wilson_interval(within: int, places: int, level: float = 0.95) -> tuple[float, float]:
    """Ends of the interval for the share of a zone, of places drawn uniformly (Wilson, 1927).

    Parameters
    ----------
    within, places
        How many of how many places are within.
    level
        Probability that the interval holds the share.
    """
    z = math.sqrt(2) * float(special.erfinv(level))
    share = within / places
    middle = share + z * z / (2 * places)
    half = z * math.sqrt(share * (1 - share) / places + z * z / (4 * places**2))
    scale = 1 + z * z / places
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def share_within(relative: FloatArray) -> BoolArray:
    """Share (...) of places (..., L) that are within."""
    return (relative <= 1).mean(axis=-1)
