"""Random buildings for training: inner walls, furniture, zones, mounts on walls and ceilings."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.geometry.obstacles import Obstacles, Prisms, box_bounds
from rbl_gym.geometry.polygons import rectangle
from rbl_gym.measurements.gain import Gain
from rbl_gym.placement.building import cube
from rbl_gym.placement.tokens import KINDS, Scenery, mirrored
from rbl_gym.studies.learning.random_problems import (
    Batch,
    body_and_noise,
    draw_count,
    draw_fixed,
    priors,
)

# Candidates of a building, and poses.
CANDIDATES, _PLACES = 96, 16


def buildings(rng: np.random.Generator, size: int) -> Batch:
    """Return floors with inner walls, furniture, zones, and mounts on walls and ceilings."""
    n_fixed = draw_fixed(rng)
    rows = [_building(rng, n_fixed) for _ in range(size)]
    found = _Building(*(np.stack(column) for column in zip(*rows, strict=True)))
    tags, noise = body_and_noise(rng, size, found.extent)
    none = np.zeros(size)
    scenery = Scenery(
        kind=KINDS.index("mounts"),
        low=found.spots.min(axis=1),
        high=found.spots.max(axis=1),
        inner=none,
        zones=found.zones,
        obstacles=found.boxes,
        fixed=found.spots[:, :0],
        tags=tags,
        noise=noise,
        gain=found.gain,
        extent=found.extent,
        nearest=none,
        even=True,
        places=found.places,
        candidates=found.spots,
        normals=found.normals,
        visibility=found.views,
    )
    fixed = np.take_along_axis(found.spots, found.fixed[..., None], axis=1)
    low, high = scenery.corners()
    away = np.linalg.norm(found.spots - 0.5 * (low + high)[:, None], axis=-1)
    return Batch(
        scenery._replace(fixed=fixed, nearest=away.min(axis=-1)),
        draw_count(rng, n_fixed),
        found.rotation,
        found.weight,
        found.prior,
        none,
        none + 1,
        np.take_along_axis(found.views, found.fixed[:, None], axis=2),
    )


def again(rng: np.random.Generator, batch: Batch) -> Batch:
    """Return a mirror image of the same buildings, with other bodies, noise and numbers."""
    scenery = mirrored(batch.scenery, int(rng.integers(8)))
    tags, noise = body_and_noise(rng, len(scenery.extent), scenery.extent)
    count = draw_count(rng, scenery.fixed.shape[1])
    return batch._replace(scenery=scenery._replace(tags=tags, noise=noise), count=count)


class _Building(NamedTuple):
    """One building in metres: zones, boxes of obstacles, candidates, poses; as in `Scenery`."""

    zones: FloatArray
    extent: FloatArray
    boxes: FloatArray
    spots: FloatArray
    normals: FloatArray
    views: FloatArray
    fixed: np.ndarray
    rotation: FloatArray
    places: FloatArray
    weight: FloatArray
    prior: FloatArray
    gain: FloatArray


_MOST_ZONES, _MOST_BOXES = 3, 12


def _building(rng: np.random.Generator, n_fixed: int) -> _Building:
    """Return one building; `fixed` are candidates."""
    x, y = rng.uniform(8, 40), rng.uniform(6, 25)
    if rng.random() < 0.5:
        x, y = y, x
    size = np.array([x, y, rng.uniform(2.5, 5.0)])
    solid, shares = _inner_walls(rng, size)
    blocked = float(rng.choice([0.01, 0.02, 0.05]))
    low, high = box_bounds(solid)
    prisms = Prisms.packed(list(rectangle(low, high)), low[:, 2], high[:, 2], shares)
    obstacles = Obstacles(np.empty((0, 6)), blocked, prisms)
    zones, extent = _zones(rng, size)
    spots, normals = _spots(rng, size, solid)
    order = np.flatnonzero(~obstacles.contain(spots))
    index = np.resize(order, CANDIDATES) if len(order) else np.zeros(CANDIDATES, int)
    spots, normals = spots[index], normals[index]
    rotation, places, weight, prior = _zone_poses(rng, zones, extent, obstacles)
    gain = Gain()
    if rng.random() < 0.3:
        reach = rng.uniform(0.5, 1.5) * max(x, y)
        gain = Gain(reach, 0.2 * reach, math.radians(85), math.radians(10))
    fixed = rng.integers(CANDIDATES, size=n_fixed)
    views = obstacles.share(spots, places)
    if gain:
        offsets = places[:, None] - spots
        views = views * gain.share(offsets, np.broadcast_to(normals, offsets.shape))
    boxes = np.zeros((_MOST_BOXES, 7))
    boxes[: len(solid), :6] = solid
    boxes[: len(solid), 6] = np.where(np.isnan(shares), blocked, shares)
    return _Building(
        zones, np.array(extent), boxes, spots, normals, views, fixed, rotation, places, weight,
        prior, gain.numbers,
    )  # fmt: skip


def _inner_walls(rng: np.random.Generator, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return boxes (K, 6) of walls from an outer wall and of furniture, and their shares."""
    boxes, shares = [], []
    for _ in range(int(rng.integers(0, 7))):
        axis = int(rng.integers(2))
        across = rng.uniform(0.2, 0.8) * size[axis]
        begin, end = 0.0, size[1 - axis] * rng.uniform(0.3, 0.9)
        if rng.random() < 0.5:
            begin, end = size[1 - axis] - end, size[1 - axis]
        if rng.random() < 0.3:
            begin += 0.2 * (end - begin)
        half = [0.0, 0.0, 0.5 * size[2]]
        half[axis], half[1 - axis] = rng.uniform(0.04, 0.15), 0.5 * (end - begin)
        centre = [0.0, 0.0, 0.5 * size[2]]
        centre[axis], centre[1 - axis] = across, 0.5 * (begin + end)
        boxes.append([*centre, *half])
        shares.append(math.nan if rng.random() < 0.3 else rng.choice([0.7, 0.6, 0.5, 0.15, 0.05]))
    for _ in range(int(rng.integers(0, 6))):
        half = [*rng.uniform(0.2, 2.0, 2), 0.5 * size[2] * rng.uniform(0.2, 1.0)]
        boxes.append([*(rng.uniform(0.15, 0.85, 2) * size[:2]), half[2], *half])
        shares.append(math.nan if rng.random() < 0.5 else rng.choice([0.05, 0.3, 0.0]))
    return np.array(boxes).reshape(-1, 6), np.array(shares)


def _zones(rng: np.random.Generator, size: FloatArray) -> tuple[FloatArray, float]:
    """Return zones (Z, 10), some of which may be padding, and the extent of all of them."""
    zones = np.zeros((_MOST_ZONES, 10))
    attitude = int(rng.choice(3, p=[0.3, 0.5, 0.2]))
    for index in range(int(rng.integers(1, _MOST_ZONES + 1))):
        half = 0.5 * size * np.array([*rng.uniform(0.15, 0.95, 2), 0.0])
        centre = half + rng.random(3) * (size - 2 * half)
        bottom, top = rng.uniform(0.1, 0.8), rng.uniform(0.9, 2.0)
        centre[2], half[2] = 0.5 * (bottom + top), 0.5 * (top - bottom)
        weight = float(np.exp(rng.uniform(-0.7, 0.7)))
        zones[index] = [*centre, *half, weight, *(np.arange(3) == attitude)]
        if rng.random() < 0.2:
            attitude = int(rng.integers(3))
    real = zones[zones[:, 6] > 0]
    low, high = (real[:, :3] - real[:, 3:6]).min(axis=0), (real[:, :3] + real[:, 3:6]).max(axis=0)
    return zones, float((high - low).max())


def _zone_poses(
    rng: np.random.Generator, zones: FloatArray, extent: float, obstacles: Obstacles
) -> tuple[FloatArray, ...]:
    """Return poses, divided among the zones with a minimum number in each."""
    real = zones[zones[:, 6] > 0]
    share = real[:, 6] / real[:, 6].sum()
    which = np.searchsorted(np.cumsum(share), (np.arange(_PLACES) + 0.5) / _PLACES)
    which = np.minimum(which, len(real) - 1)
    tries = 2 * ((cube(8 * _PLACES) + rng.random(3)) % 1.0).reshape(8, _PLACES, 3) - 1
    tries = real[which, :3] + real[which, 3:6] * tries
    free = ~obstacles.contain(tries)
    places = tries[free.argmax(axis=0), np.arange(_PLACES)]
    count = np.bincount(which, minlength=len(real))
    weight = share[which] / np.maximum(count, 1)[which]
    rotation = rotations.random(rng, (_PLACES,))
    upright = real[which, 7] == 0
    turn = rotations.exp(rng.uniform(0, 2 * np.pi, (_PLACES, 1)) * np.array([0.0, 0.0, 1.0]))
    rotation = np.where(upright[:, None, None], turn, rotation)
    prior = priors(np.array([extent]), _PLACES)[0]
    prior[real[which, 9] == 1, 0, 0] = prior[real[which, 9] == 1, 1, 1] = 1e6
    return rotation, places, weight / weight.sum(), prior


def _spots(
    rng: np.random.Generator, size: FloatArray, solid: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return candidates and their normals on outer walls, the ceiling and inner walls."""
    low, high = rng.uniform(0.5, 0.85) * size[2], rng.uniform(0.86, 0.98) * size[2]
    faces: list[tuple[Any, Any, Any, Any]] = []  # origin, u, v, normal
    x, y = size[:2]
    up = np.array([0, 0, high - low])
    if rng.random() < 0.85:
        for origin, u, normal in (
            ((0, 0), (x, 0), (0, 1)), ((x, 0), (0, y), (-1, 0)),
            ((x, y), (-x, 0), (0, -1)), ((0, y), (0, -y), (1, 0)),
        ):  # fmt: skip
            if rng.random() < 0.9:
                faces.append(([*origin, low], [*u, 0], up, [*normal, 0]))
    if rng.random() < 0.6 or not faces:
        faces.append(([0, 0, high], [x, 0, 0], [0, y, 0], [0, 0, -1]))
    if rng.random() < 0.6:
        for box in solid:
            if box[2] + box[5] < 0.95 * size[2]:
                continue
            a, b = box[:2] - box[3:5], box[:2] + box[3:5]
            gap = 1e-3
            u = [b[0] - a[0], 0, 0]
            v = [0, b[1] - a[1], 0]
            if box[3] > box[4]:
                faces.append(([a[0], a[1] - gap, low], u, up, [0, -1, 0]))
                faces.append(([a[0], b[1] + gap, low], u, up, [0, 1, 0]))
            else:
                faces.append(([a[0] - gap, a[1], low], v, up, [-1, 0, 0]))
                faces.append(([b[0] + gap, a[1], low], v, up, [1, 0, 0]))
    origin, u, v, normal = (np.array(column, float) for column in zip(*faces, strict=True))
    area = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
    uniforms = (cube(2 * CANDIDATES) + rng.random(3)) % 1.0
    face = np.searchsorted(np.cumsum(area) / area.sum(), uniforms[:, 0])
    face = np.minimum(face, len(area) - 1)
    spots = origin[face] + uniforms[:, 1:2] * u[face] + uniforms[:, 2:3] * v[face]
    return spots, normal[face]
