"""A placement problem as tokens: rows of numbers without units, for the network of `amortised`.

Lengths are divided by a length of the problem itself, `Scenery.unit`, and counted from the middle
of where the body works. The first number of a row is 1; rows of zeros are padding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray

__all__ = ["KINDS", "Scenery", "Tokens", "tokens_of"]

# Kinds of regions. "mounts" is any other: there an anchor stands at one of the candidates.
KINDS = ("box", "shell", "walls", "mounts")
# Mirror images of a problem, itself the first.
IMAGES = 8
# Where a candidate sees the body: cells of the plan of where that works, in x and in y.
_CELLS = 3
# Lengths that are zero, and noise that does not grow, count as so much of the unit.
_LEAST = 1e-6


class Scenery(NamedTuple):
    """What a layout is judged by, as arrays with leading axes; lengths in any unit.

    Attributes
    ----------
    kind
        Of the region: an index of `KINDS`.
    low, high
        Corners (..., 3) of the box around the region.
    inner
        (...): inner radius of a shell about the origin; else 0.
    zones
        (..., Z, 10): where the body works. Centre and half size, weight, and 1 for the attitude
        of `building.ATTITUDES`. Rows of zeros are padding.
    obstacles
        (..., K, 7): centre and half size of boxes, and what they leave of a link. Rows of zeros are
        padding.
    fixed
        (..., F, 3): anchors that stay.
    tags
        (..., N, 3) in the body frame.
    noise
        (..., 2): standard deviation of a range at the anchor, and its growth with the range.
    gain
        (..., 4): of `Gain.numbers`.
    extent
        (...): largest extent of where the body may be, of which the prior's position is half.
    nearest
        (...): from the middle of where the body works to the nearest place of the region.
    even
        Whether the poses fill the zones evenly; else they are those of a placement task.
    places
        (..., P, 3): of the body, over which candidates are judged.
    candidates, normals, seen
        Legal places (..., C, 3), their normals, and the share (..., P, C) of a link's information
        at each. C may be 0.
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

    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Corners (..., 3) of the box around all zones."""
        centre, half, real = self.zones[..., :3], self.zones[..., 3:6], self.zones[..., 6:7] > 0
        low = np.where(real, centre - half, np.inf).min(axis=-2)
        return low, np.where(real, centre + half, -np.inf).max(axis=-2)

    def frame(self) -> tuple[FloatArray, FloatArray]:
        """Origin (..., 3) and unit (...): the middle of where the body works, and a length.

        The length is how far anchors stand from there: the root of the squares of the half
        width and of the way to the nearest legal place.
        """
        low, high = self.corners()
        origin, half = 0.5 * (low + high), 0.5 * (high - low)
        square = 0.5 * (half[..., :2] ** 2).sum(axis=-1) + self.nearest**2
        span = np.sqrt(((self.high - self.low) ** 2).sum(axis=-1))
        return origin, np.maximum(np.sqrt(square), 1e-3 * span)


def turned(seen: Scenery, image: int) -> Scenery:
    """One of the eight mirror images of a problem: of x, of y, and of the two for each other.

    The body, whose attitude may be any, stays as it is.
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
    """Points (..., 3) in a mirror image of `turned`, or back from it."""
    signs = np.array([1.0 - 2 * (image & 1), 1.0 - (image & 2), 1.0])
    axes = [1, 0, 2] if image & 4 else [0, 1, 2]
    return points[..., axes] * signs if not back else (points * signs)[..., axes]


class Tokens(NamedTuple):
    """Rows of numbers; a row that begins with 0 is padding.

    Attributes
    ----------
    world
        (..., 1, G): region, body, noise.
    zones, obstacles, fixed, candidates
        (..., Z, .), (..., K, .), (..., F, .), (..., C, .).
    """

    world: FloatArray
    zones: FloatArray
    obstacles: FloatArray
    fixed: FloatArray
    candidates: FloatArray


def tokens_of(seen: Scenery, count: int) -> Tokens:
    """The tokens of a problem in which `count` anchors are placed."""
    origin, unit = seen.frame()
    at, by = origin[..., None, :], unit[..., None, None]
    real = (seen.zones[..., 6:7] > 0).astype(float)
    weight = seen.zones[..., 6:7] / seen.zones[..., 6:7].sum(axis=-2, keepdims=True)
    half = seen.zones[..., 3:6] / by
    zones = [real, _place((seen.zones[..., :3] - at) / by), _size(half), weight]
    solid = (seen.obstacles[..., 3:4] > 0).astype(float)
    share = seen.obstacles[..., 6:7]
    half = seen.obstacles[..., 3:6] / by
    centre = (seen.obstacles[..., :3] - at) / by
    obstacles = [solid, _place(centre), _size(half), share, np.log10(share + 1e-3) / 3]
    one = np.ones((*seen.fixed.shape[:-1], 1))
    fixed = [one, _place((seen.fixed - at) / by)]
    one = np.ones((*seen.candidates.shape[:-1], 1))
    where = _place((seen.candidates - at) / by)
    candidates = [one, where, seen.normals, _views(seen)]
    return Tokens(
        _world(seen, count, origin, unit)[..., None, :],
        _joined(*zones, seen.zones[..., 7:10]) * real,
        _joined(*obstacles) * solid,
        _joined(*fixed),
        _joined(*candidates),
    )


def _world(seen: Scenery, count: int, origin: FloatArray, unit: FloatArray) -> FloatArray:
    """Numbers (..., G) of the region, the body and the noise."""
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
    region = [_place((seen.low - origin) / by), _place((seen.high - origin) / by)]
    middle = _place((0.5 * (seen.low + seen.high) - origin) / by)
    size = _size(0.5 * (seen.high - seen.low) / by)
    work = _size(0.5 * (high - low) / by)
    return _joined(np.stack(told, axis=-1), kind, axes, *region, middle, size, work)


def _views(seen: Scenery) -> FloatArray:
    """What share of its information a candidate has (..., C, 10): in each cell, and over all."""
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


def _place(x: FloatArray) -> FloatArray:
    """Coordinates (..., 3) near and far as (..., 6)."""
    return _joined(np.minimum(np.maximum(x, -3.0), 3.0), 0.5 * np.arcsinh(x))


def _size(x: FloatArray) -> FloatArray:
    """Half sizes (..., 3), small and large, as (..., 6)."""
    return _joined(0.5 * np.arcsinh(x), 0.2 * np.log10(x + 1e-3))


def _joined(*arrays: FloatArray) -> FloatArray:
    return np.concatenate(arrays, axis=-1)
