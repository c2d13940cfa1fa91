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
        Numbers a, b (..., 2) of the noise: a range r has the variance ``a^2 + (b r)^2``.
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
    candidates, normals, visibility
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
    visibility: FloatArray
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


def mirrored(scenery: Scenery, image: int) -> Scenery:
    """Return one of the eight mirror images of a problem: x, y mirrored, and both exchanged.

    The body does not change, because its attitude may be any.
    """

    def points(x: FloatArray) -> FloatArray:
        return mirrored_points(x, image)

    def rows(x: FloatArray) -> FloatArray:
        half = np.abs(points(x[..., 3:6]))
        return np.concatenate([points(x[..., :3]), half, x[..., 6:]], axis=-1)

    a, b = points(scenery.low), points(scenery.high)
    return scenery._replace(
        low=np.minimum(a, b),
        high=np.maximum(a, b),
        zones=rows(scenery.zones),
        obstacles=rows(scenery.obstacles),
        fixed=points(scenery.fixed),
        places=points(scenery.places),
        candidates=points(scenery.candidates),
        normals=points(scenery.normals),
    )


def mirrored_points(points: FloatArray, image: int, back: bool = False) -> FloatArray:
    """Return points (..., 3) in a mirror image of `mirrored`, or back from it."""
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


def tokens_of(scenery: Scenery, count: int) -> Tokens:
    """Return the tokens of a problem in which `count` anchors are placed."""
    return Tokens(
        _world(scenery, count)[..., None, :],
        _zones(scenery),
        _obstacles(scenery),
        _fixed(scenery),
        _candidates(shown_of(scenery)),
    )


def shown_of(scenery: Scenery) -> Scenery:
    """Return the scenery with only those candidates of which there are tokens."""
    if scenery.shown is None:
        return scenery
    return scenery._replace(
        candidates=scenery.candidates[..., : scenery.shown, :],
        normals=scenery.normals[..., : scenery.shown, :],
        visibility=scenery.visibility[..., : scenery.shown],
        shown=None,
    )


def _zones(scenery: Scenery) -> FloatArray:
    """Return for each zone whether it is one, its centre, size, share of the weight, attitude."""
    zones = scenery.zones
    weight = zones[..., 6:7]
    real = (weight > 0).astype(float)
    share = weight / weight.sum(axis=-2, keepdims=True)
    place, size = _of_boxes(scenery, zones)
    return _joined(real, place, size, share, zones[..., 7:10]) * real


def _obstacles(scenery: Scenery) -> FloatArray:
    """Return for each obstacle whether it is one, its centre, size, information fraction."""
    share = scenery.obstacles[..., 6:7]
    real = (scenery.obstacles[..., 3:4] > 0).astype(float)
    place, size = _of_boxes(scenery, scenery.obstacles)
    return _joined(real, place, size, share, np.log10(share + 1e-3) / 3) * real


def _of_boxes(scenery: Scenery, boxes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return numbers (..., K, 6) of the centres, and of the sizes, of boxes (..., K, 6 or more)."""
    _, unit = scenery.frame()
    half = boxes[..., 3:6] / unit[..., None, None]
    return _places(scenery, boxes[..., :3]), _size(half)


def _places(scenery: Scenery, points: FloatArray) -> FloatArray:
    """Return numbers (..., K, 6) of points (..., K, 3)."""
    origin, unit = scenery.frame()
    return place_row((points - origin[..., None, :]) / unit[..., None, None])


def _fixed(scenery: Scenery) -> FloatArray:
    """Return for each fixed anchor 1 and its position."""
    place = _places(scenery, scenery.fixed)
    return _joined(np.ones_like(place[..., :1]), place)


def _candidates(scenery: Scenery) -> FloatArray:
    """Return for each candidate 1, its position, normal, and views of the zones."""
    place = _places(scenery, scenery.candidates)
    return _joined(np.ones_like(place[..., :1]), place, scenery.normals, _views(scenery))


def _world(scenery: Scenery, count: int) -> FloatArray:
    """Return numbers (..., G) of the region, the body and the noise."""
    origin, unit = scenery.frame()
    by = unit[..., None]
    tags = scenery.tags / by[..., None]
    second = np.einsum("...ni,...nj->...ij", tags, tags) / tags.shape[-2]
    radius = np.sqrt(np.einsum("...ii->...", second))
    floor, growth = scenery.noise[..., 0] / unit, scenery.noise[..., 1]
    sigma = np.sqrt(floor**2 + growth**2)
    limit = unit / scenery.gain[..., 0]
    # Constants bring each number to order one.
    numbers = {
        "real": 1.0,
        "anchors": count / 16,
        "share of an anchor": 1 / count,
        "fixed anchors": scenery.fixed.shape[-2] / 8,
        "even": float(scenery.even),
        "noise": np.log10(sigma),
        "share of the growth": growth**2 / sigma**2,
        "growth of the noise": np.log10(growth + _LEAST),
        "radius of the body": np.log10(radius),
        "noise as an angle": np.log10(sigma / radius),
        "offset of the tags": np.sqrt((tags.mean(axis=-2) ** 2).sum(axis=-1)) / radius,
        "height of the body": second[..., 2, 2] / radius**2,
        "tags": np.log(tags.shape[-2]) - 1.7,
        "extent of the zones": np.log10(scenery.extent / unit),
        "nearest position": scenery.nearest / unit,
        "inner radius": np.arcsinh(scenery.inner / unit),
        "range limit": limit / (1 + limit),
        "limit of the view": np.maximum(scenery.gain[..., 2], -1.0),
    }
    batch = origin.shape[:-1]
    row = np.stack([np.broadcast_to(value, batch) for value in numbers.values()], axis=-1)
    kind = np.broadcast_to(np.eye(len(KINDS))[scenery.kind], (*batch, len(KINDS)))
    axes = np.linalg.eigvalsh(second) / (radius**2)[..., None]
    low, high = scenery.low, scenery.high
    corners = [place_row((point - origin) / by) for point in (low, high, 0.5 * (low + high))]
    sizes = [_size(0.5 * (b - a) / by) for a, b in ((low, high), scenery.corners())]
    return _joined(row, kind, axes, *corners, *sizes)


def _views(scenery: Scenery) -> FloatArray:
    """Return information fractions (..., C, 10) of candidates: in each cell, and over all."""
    low, high = scenery.corners()
    size = np.maximum(high - low, 1e-12 * np.abs(high - low).max(axis=-1, keepdims=True))
    share = ((scenery.places - low[..., None, :]) / size[..., None, :])[..., :2]
    cell = np.clip((share * _CELLS).astype(int), 0, _CELLS - 1)
    index = cell[..., 0] * _CELLS + cell[..., 1]
    inside = (index[..., None] == np.arange(_CELLS**2)).astype(float)
    mean = scenery.visibility.mean(axis=-2)[..., None]
    number = inside.sum(axis=-2)
    told = (
        np.einsum("...pc,...pk->...ck", scenery.visibility, inside)
        / np.maximum(number, 1)[..., None, :]
    )
    return _joined(np.where(number[..., None, :] > 0, told, mean), mean)


def place_row(x: FloatArray) -> FloatArray:
    """Return coordinates (..., 3) on a near and a far scale as (..., 6)."""
    return _joined(np.minimum(np.maximum(x, -3.0), 3.0), 0.5 * np.arcsinh(x))


def _size(x: FloatArray) -> FloatArray:
    """Return half sizes (..., 3) on a small and a large scale as (..., 6)."""
    return _joined(0.5 * np.arcsinh(x), 0.2 * np.log10(x + 1e-3))


def _joined(*arrays: FloatArray) -> FloatArray:
    return np.concatenate(arrays, axis=-1)
