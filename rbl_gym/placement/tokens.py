"""A placement problem as tokens: rows of dimensionless numbers, for the network of `amortised`.

Lengths are divided by a length of the problem, `Scenery.unit`, and relative to the centre of the
zones. The first number of a row is 1; rows of zeros are padding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

__all__ = ["KINDS", "Scenery", "Tokens", "tokens_of"]

# Kinds of regions. "mounts" is any other, with candidates for the anchors.
KINDS = ("box", "shell", "walls", "mounts")
# Cells of the plan of the zones, in x and in y, for the views of candidates.
_CELLS = 3
# Added to the growth of the noise, whose logarithm is then finite without growth.
_LEAST = 1e-6


class Scenery(NamedTuple):
    """All inputs of the score of a layout, as arrays with leading axes; lengths in any unit.

    Attributes
    ----------
    kind
        Kind of the region: an index of `KINDS`.
    low, high
        Corners (..., 3) of the box around the region.
    inner
        Inner radius (...) of a shell around the origin; otherwise 0.
    zones
        Zones (..., Z, 10): centre and half size, weight, and one-hot attitude of
        `building.ATTITUDES`. Rows of zeros are padding.
    obstacles
        Obstacles (..., K, 7): centre and half size of boxes, and their information fraction. Rows
        of zeros are padding.
    fixed
        Fixed anchors (..., F, 3).
    tags
        Tags (..., N, 3) in the body frame.
    noise
        Standard deviation of a range at the anchor, and its growth with the range (..., 2).
    gain
        `Gain.numbers` (..., 4).
    extent
        Largest extent (...) of the zones; the prior's position standard deviation is half of it.
    nearest
        Distance (...) from the centre of the zones to the nearest position of the region.
    even
        Whether the poses fill the zones evenly; otherwise they are those of a placement task.
    places
        Positions (..., P, 3) of the body for judging candidates.
    candidates, normals, seen
        Legal positions (..., C, 3), their normals, and the information fractions (..., P, C) of
        their links. C may be 0.
    shown
        Only this many candidates, the first ones, have tokens; None: all.
    """

    kind: int
    low: FloatArray
    high: FloatArray
    inner: FloatArray
    zones: FloatArray
    obstacles: FloatArray
    fixed: FloatArray
    tags: FloatArray
    noise: FloatArray
    gain: FloatArray
    extent: FloatArray
    nearest: FloatArray
    even: bool
    places: FloatArray
    candidates: FloatArray
    normals: FloatArray
    seen: FloatArray
    shown: int | None = None

    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Return corners (..., 3) of the box around all zones."""
        centre, half, real = self.zones[..., :3], self.zones[..., 3:6], self.zones[..., 6:7] > 0
        low = np.where(real, centre - half, np.inf).min(axis=-2)
        return low, np.where(real, centre + half, -np.inf).max(axis=-2)

    def frame(self) -> tuple[FloatArray, FloatArray]:
        """Return origin (..., 3) and unit (...): the centre of the zones, and a length.

        The length is a typical anchor distance: the root of the sum of squares of the half width
        and of the distance to the nearest legal position.
        """
        low, high = self.corners()
        origin, half = 0.5 * (low + high), 0.5 * (high - low)
        square = 0.5 * (half[..., :2] ** 2).sum(axis=-1) + self.nearest**2
        span = np.sqrt(((self.high - self.low) ** 2).sum(axis=-1))
        return origin, np.maximum(np.sqrt(square), 1e-3 * span)

    def aim(self) -> FloatArray:
        """Return the position (..., 3) in the box around the region that is nearest to the zones.

        The network's steps begin there.
        """
        return self.frame()[0].clip(self.low, self.high)


def turned(seen: Scenery, image: int) -> Scenery:
    """Return one of the eight mirror images of a problem: x, y mirrored, and both exchanged.

    The body does not change, because its attitude may be any.
    """

    def points(x: FloatArray) -> FloatArray:
        return turned_points(x, image)

    def rows(x: FloatArray) -> FloatArray:
        half = np.abs(points(x[..., 3:6]))
        return np.concatenate([points(x[..., :3]), half, x[..., 6:]], axis=-1)

    a, b = points(seen.low), points(seen.high)
    return seen._replace(
        low=np.minimum(a, b),
        high=np.maximum(a, b),
        zones=rows(seen.zones),
        obstacles=rows(seen.obstacles),
        fixed=points(seen.fixed),
        places=points(seen.places),
        candidates=points(seen.candidates),
        normals=points(seen.normals),
    )


def turned_points(points: FloatArray, image: int, back: bool = False) -> FloatArray:
    """Return points (..., 3) in a mirror image of `turned`, or back from it."""
    signs = np.array([1.0 - 2 * (image & 1), 1.0 - (image & 2), 1.0])
    axes = [1, 0, 2] if image & 4 else [0, 1, 2]
    return points[..., axes] * signs if not back else (points * signs)[..., axes]


class Tokens(NamedTuple):
    """Rows of numbers; a row that begins with 0 is padding.

    Attributes
    ----------
    world
        Region, body and noise (..., 1, G).
    zones, obstacles, fixed, candidates
        Rows (..., Z, .), (..., K, .), (..., F, .), (..., C, .).
    """

    world: FloatArray
    zones: FloatArray
    obstacles: FloatArray
    fixed: FloatArray
    candidates: FloatArray


def tokens_of(seen: Scenery, count: int) -> Tokens:
    """Return the tokens of a problem in which `count` anchors are placed."""
    origin, unit = seen.frame()
    at, by = origin[..., None, :], unit[..., None, None]
    real = (seen.zones[..., 6:7] > 0).astype(float)
    weight = seen.zones[..., 6:7] / seen.zones[..., 6:7].sum(axis=-2, keepdims=True)
    half = seen.zones[..., 3:6] / by
    zones = [real, place_row((seen.zones[..., :3] - at) / by), _size(half), weight]
    solid = (seen.obstacles[..., 3:4] > 0).astype(float)
    share = seen.obstacles[..., 6:7]
    half = seen.obstacles[..., 3:6] / by
    centre = (seen.obstacles[..., :3] - at) / by
    obstacles = [solid, place_row(centre), _size(half), share, np.log10(share + 1e-3) / 3]
    one = np.ones((*seen.fixed.shape[:-1], 1))
    fixed = [one, place_row((seen.fixed - at) / by)]
    seen = shown_of(seen)
    one = np.ones((*seen.candidates.shape[:-1], 1))
    where = place_row((seen.candidates - at) / by)
    candidates = [one, where, seen.normals, _views(seen)]
    return Tokens(
        _world(seen, count, origin, unit)[..., None, :],
        _joined(*zones, seen.zones[..., 7:10]) * real,
        _joined(*obstacles) * solid,
        _joined(*fixed),
        _joined(*candidates),
    )


def shown_of(seen: Scenery) -> Scenery:
    """Return the scenery with only those candidates of which there are tokens."""
    if seen.shown is None:
        return seen
    return seen._replace(
        candidates=seen.candidates[..., : seen.shown, :],
        normals=seen.normals[..., : seen.shown, :],
        seen=seen.seen[..., : seen.shown],
        shown=None,
    )


def _world(seen: Scenery, count: int, origin: FloatArray, unit: FloatArray) -> FloatArray:
    """Return numbers (..., G) of the region, the body and the noise."""
    batch = origin.shape[:-1]
    by = unit[..., None]
    kind = np.broadcast_to(np.eye(len(KINDS))[seen.kind], (*batch, len(KINDS)))
    low, high = seen.corners()
    tags = seen.tags / by[..., None]
    second = np.einsum("...ni,...nj->...ij", tags, tags) / tags.shape[-2]
    radius = np.sqrt(np.einsum("...ii->...", second))
    axes = np.linalg.eigvalsh(second) / (radius**2)[..., None]
    off = np.sqrt((tags.mean(axis=-2) ** 2).sum(axis=-1)) / radius
    floor, growth = seen.noise[..., 0] / unit, seen.noise[..., 1]
    sigma = np.sqrt(floor**2 + growth**2)
    limit = by[..., 0] / seen.gain[..., 0]
    sees = np.maximum(seen.gain[..., 2], -1.0)
    told = [
        np.ones(batch),
        np.full(batch, count / 16),
        np.full(batch, 1 / count),
        np.full(batch, seen.fixed.shape[-2] / 8),
        np.full(batch, float(seen.even)),
        np.log10(sigma),
        growth**2 / sigma**2,
        np.broadcast_to(np.log10(growth + _LEAST), batch),
        np.log10(radius),
        np.log10(sigma / radius),
        off,
        second[..., 2, 2] / radius**2,
        np.full(batch, np.log(tags.shape[-2]) - 1.7),
        np.log10(seen.extent / unit),
        seen.nearest / unit,
        np.arcsinh(seen.inner / unit),
        limit / (1 + limit),
        np.broadcast_to(sees, batch),
    ]
    region = [place_row((seen.low - origin) / by), place_row((seen.high - origin) / by)]
    middle = place_row((0.5 * (seen.low + seen.high) - origin) / by)
    size = _size(0.5 * (seen.high - seen.low) / by)
    work = _size(0.5 * (high - low) / by)
    return _joined(np.stack(told, axis=-1), kind, axes, *region, middle, size, work)


def _views(seen: Scenery) -> FloatArray:
    """Return information fractions (..., C, 10) of candidates: in each cell, and over all."""
    low, high = seen.corners()
    size = np.maximum(high - low, 1e-12 * np.abs(high - low).max(axis=-1, keepdims=True))
    share = ((seen.places - low[..., None, :]) / size[..., None, :])[..., :2]
    cell = np.clip((share * _CELLS).astype(int), 0, _CELLS - 1)
    index = cell[..., 0] * _CELLS + cell[..., 1]
    inside = (index[..., None] == np.arange(_CELLS**2)).astype(float)
    mean = seen.seen.mean(axis=-2)[..., None]
    number = inside.sum(axis=-2)
    told = np.einsum("...pc,...pk->...ck", seen.seen, inside) / np.maximum(number, 1)[..., None, :]
    return _joined(np.where(number[..., None, :] > 0, told, mean), mean)


def place_row(x: FloatArray) -> FloatArray:
    """Return coordinates (..., 3) on a near and a far scale as (..., 6)."""
    return _joined(np.minimum(np.maximum(x, -3.0), 3.0), 0.5 * np.arcsinh(x))


def _size(x: FloatArray) -> FloatArray:
    """Return half sizes (..., 3) on a small and a large scale as (..., 6)."""
    return _joined(0.5 * np.arcsinh(x), 0.2 * np.log10(x + 1e-3))


def _joined(*arrays: FloatArray) -> FloatArray:
    return np.concatenate(arrays, axis=-1)
