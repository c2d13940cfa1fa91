"""Random placement problems, batch by batch, on which `amortised` trains.

There are four families: boxes, shells, rooms with racks, and buildings with inner walls, zones and
mounts. All problems of a batch have the same numbers of anchors, tags and fixed anchors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import placement
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Shell, Walls
from rbl_gym.measurements.gain import Gain
from rbl_gym.placement.building import cube
from rbl_gym.placement.tokens import KINDS, Scenery
from rbl_gym.studies.learning.random_buildings import buildings
from rbl_gym.studies.learning.random_problems import (
    Batch,
    body_and_noise,
    draw_count,
    draw_fixed,
    log_uniform,
    priors,
)

# Half size of a work region as a share of the volume's, as in contexts.
_LEAST, _SPAN = np.array([0.15, 0.15, 0.3]), np.array([0.45, 0.45, 0.7])
_POSES = 32
# Candidates in rooms with racks.
ROOM_CANDIDATES = 48


def draw(family: str, rng: np.random.Generator, size: int) -> Batch:
    """Return a batch of problems of a family."""
    return FAMILIES[family](rng, size)


def _work(rng: np.random.Generator, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return a zone (B, 1, 10) inside each volume: a smaller box, or all of it."""
    size = len(low)
    share = _LEAST + _SPAN * rng.random((size, 3))
    share[rng.random(size) < 0.15] = 1.0
    half = share * (0.5 * (high - low))
    centre = low + half + rng.random((size, 3)) * (high - low - 2 * half)
    zone = np.concatenate([centre, half, np.ones((size, 1)), np.zeros((size, 3))], axis=-1)
    zone[:, 7] = 1.0
    return zone[:, None]


_TASK = placement.task("uwb_room")


def _poses(rng: np.random.Generator, zones: FloatArray, even: bool) -> tuple[FloatArray, ...]:
    """Return rotations, positions and weights of the poses in one zone each."""
    size = len(zones)
    rotation, offset = _TASK.poses
    rotation = np.broadcast_to(rotation, (size, *rotation.shape))
    if even:
        rotation = rotations.random(rng, (size, _POSES))
        offset = 2 * ((cube(_POSES) + rng.random((size, 1, 3))) % 1.0) - 1
    places = zones[:, 0, None, :3] + zones[:, 0, None, 3:6] * offset
    return rotation, places, np.full((size, _POSES), 1 / _POSES)


class _Where(NamedTuple):
    """Region, zones and obstacles; fields as in `Scenery` and `Batch`."""

    kind: str
    low: FloatArray
    high: FloatArray
    zones: FloatArray
    extent: FloatArray
    fixed: FloatArray
    obstacles: FloatArray
    left: FloatArray
    inner: FloatArray
    outer: FloatArray


def _plain(rng: np.random.Generator, where: _Where) -> Batch:
    """Return a batch in boxes, shells or rooms: with a body, noise and poses."""
    low, high, zones, left = where.low, where.high, where.zones, where.left
    size = len(low)
    even = bool(rng.random() < 0.25)
    rotation, places, weight = _poses(rng, zones, even)
    tags, noise = body_and_noise(rng, size, where.extent)
    n_fixed = where.fixed.shape[1]
    share = np.broadcast_to(left[:, None, None], (*where.obstacles.shape[:2], 1))
    candidates = normals = np.zeros((size, 0, 3))
    views, fixed_share = np.zeros((size, _POSES, 0)), np.ones((size, _POSES, n_fixed))
    if where.obstacles.shape[1]:
        rooms = [Walls(tuple(a), tuple(b)) for a, b in zip(low, high, strict=True)]
        candidates = np.stack([room.draw(cube(ROOM_CANDIDATES)) for room in rooms])
        normals = _inward(candidates, low[:, None], high[:, None])
        sight = Obstacles(where.obstacles, 0.0)
        views = _kept(sight.share(candidates, places), left)
        fixed_share = _kept(sight.share(where.fixed, places), left)
    scenery = Scenery(
        kind=KINDS.index(where.kind),
        low=low,
        high=high,
        inner=where.inner,
        zones=zones,
        obstacles=np.concatenate([where.obstacles, share], axis=-1),
        fixed=where.fixed,
        tags=tags,
        noise=noise,
        gain=np.broadcast_to(Gain().numbers, (size, 4)),
        extent=where.extent,
        nearest=_nearest(where),
        even=even,
        places=places,
        candidates=candidates,
        normals=normals,
        visibility=views,
    )
    prior = priors(where.extent, _POSES)
    return Batch(
        scenery, draw_count(rng, n_fixed), rotation, weight, prior, where.outer, left, fixed_share
    )


def _inward(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return normals (B, C, 3) of points on walls and ceilings, of the first matching face."""
    at_low, at_high = points == low, points == high
    at_low[..., 2] = False
    on = at_low | at_high
    first = on & (on.cumsum(axis=-1) == 1)
    return np.where(first, np.where(at_low, 1.0, -1.0), 0.0)


def _kept(free: FloatArray, left: FloatArray) -> FloatArray:
    return left[:, None, None] + (1 - left[:, None, None]) * free


def _nearest(where: _Where) -> FloatArray:
    """Return the distance from the centre of the zones to the region (B,)."""
    origin, low, high = where.zones[:, 0, :3], where.low, where.high
    if where.kind == "shell":
        radius = np.linalg.norm(origin, axis=-1)
        return np.maximum(np.maximum(where.inner - radius, radius - where.outer), 0.0)
    if where.kind == "box":
        return np.linalg.norm(origin - origin.clip(low, high), axis=-1)
    # All faces except the floor.
    gaps = np.concatenate([origin - low, high - origin], axis=-1)[:, [0, 1, 3, 4, 5]]
    return np.abs(gaps).min(axis=-1)


# --- the families ------------------------------------------------------------------------------


def _boxes(rng: np.random.Generator, size: int) -> Batch:
    """Return problems in boxes and on planes below, above and around the body's volume."""
    half = np.stack(
        [np.ones(size), log_uniform(rng, 0.5, 1.0, size), log_uniform(rng, 0.05, 1.0, size)],
        axis=-1,
    )
    swap = rng.random(size) < 0.5
    half[swap] = half[swap][:, [1, 0, 2]]
    volume_low, volume_high = -half, half
    reach = half * np.array([1, 1, 0]) * log_uniform(rng, 0.6, 2.5, size)[:, None]
    middle = rng.uniform(-0.3, 0.3, (size, 3)) * half * (rng.random((size, 1)) < 0.5)
    low, high = middle - reach, middle + reach
    # Types of region: a plane above or below, a slab there, or a box around.
    which = rng.integers(4, size=size)
    gap = (
        half[:, 2] * rng.choice([0.0, 1.0], size, p=[0.2, 0.8]) * log_uniform(rng, 0.05, 1.5, size)
    )
    thick = np.where(which < 2, 0.0, half[:, 2] * log_uniform(rng, 0.05, 1.0, size))
    near = np.where(rng.random(size) < 0.3, -0.3 * half[:, 2], gap)
    sign = np.where(which % 2 == 0, 1.0, -1.0)
    bottom = sign * (half[:, 2] + near)
    top = bottom + sign * thick
    low[:, 2], high[:, 2] = np.minimum(bottom, top), np.maximum(bottom, top)
    around = rng.random(size) < 0.15
    low[around, 2] = -(half[:, 2] * log_uniform(rng, 0.8, 1.6, size))[around]
    high[around, 2] = (half[:, 2] * log_uniform(rng, 0.8, 1.6, size))[around]
    zones = _work(rng, volume_low, volume_high)
    extent = 2 * half.max(axis=-1)
    fixed = low[:, None] + rng.random((size, draw_fixed(rng), 3)) * (high - low)[:, None]
    none, nothing = np.zeros(size), np.zeros((size, 0, 6))
    where = _Where("box", low, high, zones, extent, fixed, nothing, none + 1, none, none)
    return _plain(rng, where)


def _shells(rng: np.random.Generator, size: int) -> Batch:
    """Return problems in shells around a small volume."""
    half = np.exp(rng.uniform(-0.7, 0.0, (size, 3)))
    inner = log_uniform(rng, 1.0, 20.0, size)
    outer = inner * log_uniform(rng, 1.05, 10.0, size)
    zones = _work(rng, -half, half)
    high = np.repeat(outer[:, None], 3, axis=1)
    number = draw_fixed(rng)
    shells = [Shell(a, b) for a, b in zip(inner, outer, strict=True)]
    fixed = np.stack([shell.draw(rng.random((number, 3))) for shell in shells])
    nothing = np.zeros((size, 0, 6))
    extent = 2 * half.max(axis=-1)
    where = _Where("shell", -high, high, zones, extent, fixed, nothing, np.ones(size), inner, outer)
    return _plain(rng, where)


def _rooms(rng: np.random.Generator, size: int) -> Batch:
    """Return problems in rooms with up to four racks on the floor."""
    floor = np.stack([np.ones(size), log_uniform(rng, 0.4, 1.0, size)], axis=-1)
    swap = rng.random(size) < 0.5
    floor[swap] = floor[swap][:, ::-1]
    height = log_uniform(rng, 0.12, 0.7, size) * floor.min(axis=-1)
    low = np.zeros((size, 3))
    high = np.concatenate([floor, height[:, None]], axis=-1)
    low[:, 2] = height * rng.uniform(0.0, 0.4, size) * (rng.random(size) < 0.7)
    margin = rng.uniform(0.02, 0.15, (size, 1)) * floor.min(axis=-1, keepdims=True)
    bottom, top = height * rng.uniform(0, 0.25, size), height * rng.uniform(0.4, 0.95, size)
    volume_low = np.concatenate([low[:, :2] + margin, bottom[:, None]], axis=-1)
    volume_high = np.concatenate([floor - margin, top[:, None]], axis=-1)
    number = int(rng.choice([0, 1, 2, 3, 5, 9], p=[0.27, 0.23, 0.3, 0.08, 0.06, 0.06]))
    racks = np.zeros((size, number, 6))
    racks[..., :2] = floor[:, None] * rng.uniform(0.15, 0.85, (size, number, 2))
    thin = rng.uniform(0.015, 0.05, (size, number))
    long = rng.uniform(0.08, 0.25, (size, number))
    along = rng.random((size, number)) < 0.5
    racks[..., 3], racks[..., 4] = np.where(along, long, thin), np.where(along, thin, long)
    racks[..., 5] = racks[..., 2] = 0.5 * height[:, None] * rng.uniform(0.3, 1.0, (size, number))
    left = np.where(rng.random(size) < 0.6, 0.01, log_uniform(rng, 0.002, 0.3, size))
    zones = _work(rng, volume_low, volume_high)
    extent = (volume_high - volume_low).max(axis=-1)
    number = draw_fixed(rng)
    rooms = [Walls(tuple(a), tuple(b)) for a, b in zip(low, high, strict=True)]
    fixed = np.stack([room.draw(rng.random((number, 3))) for room in rooms])
    none = np.zeros(size)
    return _plain(rng, _Where("walls", low, high, zones, extent, fixed, racks, left, none, none))


FAMILIES = {"boxes": _boxes, "shells": _shells, "rooms": _rooms, "buildings": buildings}
