"""Model the coverage of an anchor: the share of link information by range and angle."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from rbl_gym.checks import FloatArray, check_number

__all__ = ["Gain"]


@dataclass(frozen=True)
class Gain:
    """A maximum range and a field of view, both with a smooth edge; by default neither is limited.

    Within an edge the share falls as ``x^2 (3 - 2 x)``, with x from 1 at the start of the edge to 0
    at the limit. x is linear in the range, or in the cosine of the angle to the normal of the
    mount.

    Parameters
    ----------
    max_range_m
        Maximum range; a longer link has no information.
    range_edge_m
        Width of the edge before it; 0: no edge.
    half_angle_rad
        Largest angle to the normal of the mount at which an anchor measures; pi: all directions.
    angle_edge_rad
        Width of the edge before it; 0: no edge.
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
        """Return whether range or angle is limited."""
        return self.max_range_m < math.inf or self.half_angle_rad < math.pi

    @functools.cached_property
    def numbers(self) -> FloatArray:
        """Return limit and edge of the range, and the cosines at the limit and edge of the angle.

        Without a limit of the angle, both cosines are -2.
        """
        cosines = (-2.0, -2.0)
        if self.half_angle_rad < math.pi:
            least = math.cos(self.half_angle_rad)
            cosines = least, max(math.cos(self.half_angle_rad - self.angle_edge_rad), least)
        return np.array([self.max_range_m, self.range_edge_m, *cosines])

    def share(self, offsets: FloatArray, normals: FloatArray) -> FloatArray:
        """Return the share (...) of its information that a link has.

        Parameters
        ----------
        offsets
            (..., 3) from the anchor to the tag, metres.
        normals
            (..., 3) of the anchor's mount, of unit length; zero: all directions.
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


# No limits.
EVERYWHERE = Gain()


def share_and_slope(
    numbers: FloatArray, offsets: FloatArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return `Gain.share` (...) and its derivative (..., 3) by the offsets, from `Gain.numbers`."""
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
    """Return a smooth step from 0 to 1 over an edge, and its derivative."""
    if not edge > 0:
        return np.where(inside >= 0, 1.0, 0.0), np.zeros_like(inside)
    x = np.clip(inside / edge, 0.0, 1.0)
    return x * x * (3 - 2 * x), 6 * x * (1 - x) / edge
