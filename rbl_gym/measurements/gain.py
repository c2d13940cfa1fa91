"""How far and how wide an anchor reaches: the share of a link's information by range and angle."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from rbl_gym.checks import FloatArray, check_number

__all__ = ["Gain"]


@dataclass(frozen=True)
class Gain:
    """A limit of range and a field of view, both with a smooth edge; the default is neither.

    Within an edge the share falls as ``x^2 (3 - 2 x)``, x from 1 where the edge begins to 0 at the
    limit: linear in the range, and in the cosine of the angle to the mount's normal.

    Parameters
    ----------
    max_range_m
        Beyond it a link tells nothing.
    range_edge_m
        Width of the edge before it; 0: none.
    half_angle_rad
        Farther from the normal of its mount an anchor does not see; pi: it sees everywhere.
    angle_edge_rad
        Width of the edge before it; 0: none.
    """

    max_range_m: float = math.inf
    range_edge_m: float = 0.0
    half_angle_rad: float = math.pi
    angle_edge_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.max_range_m != math.inf:
            check_number("max_range_m", self.max_range_m, low=1e-9)
        check_number("range_edge_m", self.range_edge_m, low=0.0, high=self.max_range_m)
        check_number("half_angle_rad", self.half_angle_rad, low=1e-3, high=math.pi)
        check_number("angle_edge_rad", self.angle_edge_rad, low=0.0, high=self.half_angle_rad)

    def __bool__(self) -> bool:
        """Whether anything is limited."""
        return self.max_range_m < math.inf or self.half_angle_rad < math.pi

    @functools.cached_property
    def numbers(self) -> FloatArray:
        """Limit and edge of the range; cosines at the limit of the angle and where its edge begins.

        Without a limit of the angle both cosines are -2.
        """
        cosines = (-2.0, -2.0)
        if self.half_angle_rad < math.pi:
            least = math.cos(self.half_angle_rad)
            cosines = least, max(math.cos(self.half_angle_rad - self.angle_edge_rad), least)
        return np.array([self.max_range_m, self.range_edge_m, *cosines])

    def share(self, offsets: FloatArray, normals: FloatArray) -> FloatArray:
        """Share (...) of its information that a link has.

        Parameters
        ----------
        offsets
            (..., 3) from the anchor to the tag, metres.
        normals
            (..., 3) of the anchor's mount, of unit length; zero: the anchor sees everywhere.
        """
        limit, edge, least, full = self.numbers.tolist()
        distance = np.sqrt(np.einsum("...i,...i->...", offsets, offsets))
        share = np.ones_like(distance)
        if limit < math.inf:
            share = _step(limit - distance, edge)[0]
        if least > -2:
            cosine = np.einsum("...i,...i->...", offsets, normals) / distance
            share = share * np.where(
                normals.any(axis=-1), _step(cosine - least, full - least)[0], 1.0
            )
        return share


# Neither limit.
EVERYWHERE = Gain()


def share_and_slope(
    numbers: FloatArray, offsets: FloatArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`Gain.share` (...) and its derivative (..., 3) by the offsets, of a gain's numbers."""
    limit, edge, least, full = numbers.tolist()
    distance = np.sqrt((offsets**2).sum(axis=-1))
    share, slope = np.ones_like(distance), np.zeros_like(offsets)
    direction = offsets / distance[..., None]
    if limit < math.inf:
        share, along = _step(limit - distance, edge)
        slope = -along[..., None] * direction
    if least > -2:
        cosine = (normals * direction).sum(axis=-1)
        seen, rise = _step(cosine - least, full - least)
        blind = ~normals.any(axis=-1)
        seen, rise = np.where(blind, 1.0, seen), np.where(blind, 0.0, rise)
        turn = (normals - cosine[..., None] * direction) / distance[..., None]
        slope = slope * seen[..., None] + (share * rise)[..., None] * turn
        share = share * seen
    return share, slope


def _step(inside: FloatArray, edge: float) -> tuple[FloatArray, FloatArray]:
    """A smooth step from 0 to 1 over an edge, and its derivative."""
    if not edge > 0:
        return np.where(inside >= 0, 1.0, 0.0), np.zeros_like(inside)
    x = np.clip(inside / edge, 0.0, 1.0)
    return x * x * (3 - 2 * x), 6 * x * (1 - x) / edge
