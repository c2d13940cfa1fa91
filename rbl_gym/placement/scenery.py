"""Input of the network of `amortised` from a placement task or a building."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray
from rbl_gym.geometry.mounts import Mounts
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Box, Region, Shell, Walls
from rbl_gym.measurements import ranging
from rbl_gym.measurements.gain import Gain
from rbl_gym.placement.building import ATTITUDES, Problem, cube
from rbl_gym.placement.problem import Context, PlacementTask, positions
from rbl_gym.placement.sample import sample
from rbl_gym.placement.tokens import KINDS, Scenery

__all__ = ["of_problem", "of_task"]

# Numbers of candidates in a room with obstacles, and on mounts; positions to judge the latter.
ROOM_CANDIDATES, _CANDIDATES, _PLACES = 48, 160, 64
_KINDS = {Box: "box", Shell: "shell", Walls: "walls"}


def of_task(task: PlacementTask, context: Context) -> Scenery:
    """Return the scenery of a task in contexts (...)."""
    scene = task.scene
    batch = context.centre.shape[:-1]
    zone = np.concatenate([context.centre, context.half, np.zeros((*batch, 4))], axis=-1)
    zone[..., 6:8] = 1.0
    left = np.broadcast_to(scene.blocked_information, (*context.racks.shape[:-1], 1))
    extent = float(np.ptp(scene.volume.bounds(), axis=0).max())
    return _scenery(
        scene.anchor_region,
        task.obstacles(context),
        np.concatenate([context.racks, left], axis=-1),
        Gain(),
        zones=zone[..., None, :],
        fixed=np.zeros((*batch, 0, 3)),
        tags=scene.body,
        noise=_noise(scene.noise, len(scene.tags)),
        extent=np.full(batch, extent),
        even=False,
        places=positions(task, context),
    )


def of_problem(problem: Problem) -> Scenery:
    """Return the scenery of a building."""
    rows = []
    for zone in problem.zones:
        low, high = zone.bounds()
        attitude = [float(zone.attitude == name) for name in ATTITUDES]
        rows.append([*0.5 * (low + high), *0.5 * (high - low), zone.weight, *attitude])
    low, high = problem.corners()
    return _scenery(
        problem.mounts,
        problem.obstacles,
        _rows_of(problem.obstacles),
        problem.gain,
        zones=np.array(rows),
        fixed=problem.fixed,
        tags=problem.tags,
        noise=_noise(problem.noise, len(problem.tags)),
        extent=np.asarray(np.ptp([low, high], axis=0).max()),
        even=True,
        places=sample(problem, _PLACES).places,
    )


def _noise(noise: ranging.NoiseLaw, n_tags: int) -> FloatArray:
    """Return standard deviation at the anchor and growth (2,); squared ranges as ranges."""
    numbers = ranging.numbers_of(noise, n_tags)
    assert numbers is not None  # the laws of scenes have numbers
    squared, first, second, _ = numbers.tolist()
    return np.array([0.5 * first, 0.0] if squared else [first, second])


def _rows_of(obstacles: Obstacles) -> FloatArray:
    """Return boxes around obstacles, and their information fractions: (K, 7)."""
    prisms = obstacles.prisms
    boxes = np.concatenate(
        [obstacles.boxes, np.full((len(obstacles.boxes), 1), obstacles.blocked_information)], axis=1
    )
    low, high = prisms.limits[:, [0, 2, 4]], prisms.limits[:, [1, 3, 5]]
    share = np.where(np.isnan(prisms.share), obstacles.blocked_information, prisms.share)
    of_prisms = np.concatenate([0.5 * (low + high), 0.5 * (high - low), share[:, None]], axis=1)
    return np.concatenate([boxes, of_prisms])


def _scenery(
    region: Region, obstacles: Obstacles, rows: FloatArray, gain: Gain, **known: Any
) -> Scenery:
    """Return the remaining fields from the region, the obstacles, and the gain."""
    zones, places = known["zones"], known["places"]
    batch = zones.shape[:-2]
    kind = _KINDS.get(type(region), "mounts")
    spots = np.zeros((0, 3))
    if kind == "mounts":
        spots = _spots(region, obstacles)
    elif kind == "walls" and obstacles:
        spots = region.draw(cube(ROOM_CANDIDATES))
    candidates, normals = (
        np.broadcast_to(x, (*batch, *x.shape)) for x in (spots, region.normal(spots))
    )
    seen = np.ones((*batch, places.shape[-2], candidates.shape[-2]))
    if candidates.shape[-2]:
        seen = obstacles.share(candidates, places) if obstacles else seen
        if gain:
            offsets = places[..., :, None, :] - candidates[..., None, :, :]
            seen = seen * gain.share(offsets, normals[..., None, :, :])
    low, high = region.bounds()
    corner = zones[..., :3] - zones[..., 3:6], zones[..., :3] + zones[..., 3:6]
    origin = 0.5 * (corner[0].min(axis=-2) + corner[1].max(axis=-2))
    nearest = np.linalg.norm(region.project(origin) - origin, axis=-1)
    return Scenery(
        kind=KINDS.index(kind),
        low=low,
        high=high,
        inner=np.asarray(region.inner_m if isinstance(region, Shell) else 0.0),
        obstacles=rows,
        gain=gain.numbers,
        nearest=nearest,
        candidates=candidates,
        normals=normals,
        seen=seen,
        **known,
    )


def _spots(region: Region, obstacles: Obstacles) -> FloatArray:
    """Return legal positions (C, 3) on mounts: all of a list, else some spread evenly."""
    spots = region.listed()
    if spots is None:
        spots = _scaled_draw(region, cube(2 * _CANDIDATES))
    free = spots[~obstacles.contain(spots)]
    return free[:_CANDIDATES] if region.listed() is None else free


def _scaled_draw(region: Region, uniforms: FloatArray) -> FloatArray:
    """Draw points of the region scaled to unit size, so that tolerances fit any unit."""
    if not isinstance(region, Mounts):
        return region.draw(uniforms)
    unit = 0.1 * float(np.ptp(region.bounds(), axis=0).max())
    scaled = dataclasses.replace(region, pieces=region.pieces / unit)
    return unit * scaled.draw(uniforms)
