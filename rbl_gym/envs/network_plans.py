"""Parameters of planar networks, and families from which every episode draws them."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbl_gym.checks import check_count, check_number, did_you_mean
from rbl_gym.networks.bounds import Sensing
from rbl_gym.worlds import field_laws

__all__ = ["NetworkFamily", "NetworkPlan"]

# Standard deviation of an unknown orientation, uniform on the circle.
PRIOR_STD_RAD = math.pi / math.sqrt(3)
# Limit of n: the bound inverts n x n matrices.
MOST_NODES = 10_000
# Bounds below a millionth of a radian and of the side are not reliable in double precision.
_SHARPEST = 1e-6
# Limit of the observation space: the longest link plus this many standard deviations.
_TAIL = 8.0


@dataclass(frozen=True)
class NetworkPlan:
    """Parameters of a planar network.

    Parameters
    ----------
    n_nodes
        Number of nodes.
    side_m
        Side of the square.
    radius_m, blind_m
        Sensing radius, and the distance below which nodes do not see each other.
    bearing_std_rad, length_std_m
        Standard deviations of a bearing and of a length.
    step_m
        Longest displacement along an axis.

    Raises
    ------
    ValueError
        If a value is invalid.
    """

    n_nodes: int = 12
    side_m: float = 10.0
    radius_m: float = 4.0
    blind_m: float = 0.5
    bearing_std_rad: float = 0.05
    length_std_m: float = 0.1
    step_m: float = 0.5

    def __post_init__(self) -> None:
        check_count("n_nodes", self.n_nodes, least=2, most=MOST_NODES)
        for name, low in _LEAST.items():
            object.__setattr__(self, name, check_number(name, getattr(self, name), low=low))

    @property
    def reach_m(self) -> float:
        """Length of the longest possible link."""
        return min(self.radius_m, self.side_m * math.sqrt(2))

    @property
    def longest_m(self) -> float:
        """Limit of observed lengths."""
        return self.reach_m + _TAIL * self.length_std_m

    @property
    def sensing(self) -> Sensing:
        """The measurement model, which an estimator knows besides the observation."""
        return Sensing(
            bearing_std_rad=max(self.bearing_std_rad, _SHARPEST),
            length_std_m=max(self.length_std_m, _SHARPEST * self.side_m),
            typical_length_m=_ring(self.blind_m, self.reach_m),
            prior_std_rad=PRIOR_STD_RAD,
            prior_std_m=self.side_m / math.sqrt(6),
        )


_LEAST = {
    "side_m": 1e-6,
    "radius_m": 0.0,
    "blind_m": 1e-9,
    "bearing_std_rad": 1e-9,
    "length_std_m": 1e-9,
    "step_m": 0.0,
}
# Fields with physical numbers, in the order of `numbers_of`.
COLUMNS = tuple(_LEAST)
_NAMES = ("n_nodes", *COLUMNS)


def numbers_of(plan: NetworkPlan) -> list[float]:
    """Return the numbers of a network in the order of `COLUMNS`."""
    return [getattr(plan, name) for name in COLUMNS]


def sensing_of(plans: Sequence[NetworkPlan]) -> Sensing:
    """Return `sensing` of several networks, each field (R, 1, 1)."""
    each = [plan.sensing for plan in plans]
    mean, std = np.array([one.typical_length_m for one in each]).T[..., None, None]
    fields = {
        name: np.array([getattr(one, name) for one in each])[:, None, None]
        for name in ("bearing_std_rad", "length_std_m", "prior_std_rad", "prior_std_m")
    }
    return Sensing(**fields, typical_length_m=(mean, std))  # pyrefly: ignore[bad-argument-type]


def _ring(low: float, high: float) -> tuple[float, float]:
    """Return mean and standard deviation of the distance of points spread evenly over a ring."""
    high = max(high, 1.001 * low)
    mean = 2 / 3 * (high**3 - low**3) / (high**2 - low**2)
    return mean, math.sqrt((high**2 + low**2) / 2 - mean**2)


@dataclass(frozen=True, eq=False)
class NetworkFamily:
    """A family of planar networks; every episode draws one of them.

    Parameters
    ----------
    members
        Dicts with fields of `NetworkPlan`, drawn with equal probability. A value may be a law from
        which it is drawn, see `rbl_gym.worlds.families.SceneFamily`.
    plan
        Values of the fields that a member does not set.

    Raises
    ------
    ValueError
        If there is no member, a field is unknown, or a law or a value is invalid.
    """

    members: tuple[Any, ...]
    plan: NetworkPlan = NetworkPlan()

    def __post_init__(self) -> None:
        if not self.members:
            raise ValueError("scenes must have at least one network, got none")
        for index, member in enumerate(self.members):
            if not isinstance(member, Mapping):
                raise ValueError(
                    f"scenes[{index}] must be a dict with fields of a network "
                    f"({', '.join(_NAMES)}), got {member!r:.80}"
                )
            for name in member:
                if name not in _NAMES:
                    raise ValueError(
                        f"scenes[{index}] must only have the fields {', '.join(_NAMES)}, "
                        f"got {name!r:.80}{did_you_mean(name, _NAMES)}"
                    )
            for one in field_laws.corners(member, f"scenes[{index}]"):
                self._made(index, one)
            for extreme in (0, 1):
                # Both ends of all laws must be networks too.
                self._made(
                    index, {key: field_laws.limits(one)[extreme] for key, one in member.items()}
                )

    @functools.cached_property
    def highest(self) -> NetworkPlan:
        """The largest value of every field."""
        ends = [
            {
                **dataclasses.asdict(self.plan),
                **{k: field_laws.limits(v)[1] for k, v in one.items()},
            }
            for one in self.members
        ]
        largest: dict[str, Any] = {name: max(end[name] for end in ends) for name in _NAMES}
        return NetworkPlan(**largest)

    def draw(self, rng: np.random.Generator) -> tuple[NetworkPlan, dict[str, Any]]:
        """Draw a network; return it with the fields of its member."""
        index = int(rng.integers(len(self.members))) if len(self.members) > 1 else 0
        member = field_laws.draw(self.members[index], rng)
        return self._made(index, member), dict(member)

    def _made(self, index: int, member: Mapping[str, Any]) -> NetworkPlan:
        try:
            return dataclasses.replace(self.plan, **member)
        except ValueError as error:
            raise ValueError(f"scenes[{index}]: {error}") from error


def network_family(value: Any, plan: NetworkPlan) -> NetworkFamily:
    """Return the family of a list of dicts, or of one dict."""
    if isinstance(value, Mapping):
        value = (value,)
    if not isinstance(value, list | tuple):
        raise ValueError(f"scenes must be a list of dicts or a dict, got {value!r:.80}")
    return NetworkFamily(tuple(value), plan)
