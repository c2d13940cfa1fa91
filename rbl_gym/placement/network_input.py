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
from rbl_gym.placement.building import ATTITUDES, Problem, cube
from rbl_gym.placement.problem import Context, PlacementTask, link_shares, positions
from rbl_gym.placement.sample import Sample
from rbl_gym.placement.tokens import KINDS, Scenery

__all__ = ["of_problem", "of_task"]

# Numbers of candidates in a room with obstacles, and on mounts: of which the network is told, and
# for swaps.
SHOWN, FOR_SWAPS = {"walls": 48, "mounts": 160}, {"walls": 400, "mounts": 160}
# Number of positions to judge candidates of a building.
PLACES = 64
_KINDS: dict[type, str] = {Box: "box", Shell: "shell", Walls: "walls"}


def of_task(task: PlacementTask, context: Context, for_swaps: bool = False) -> Scenery:
    """Return the scenery of a task in contexts (...); swaps need more candidates."""
    batch = context.centre.shape[:-1]
    zone = np.concatenate([context.centre, context.half, np.zeros((*batch, 4))], axis=-1)
    zone[..., 6:8] = 1.0
    fixed = np.array(task.scene.fixed).reshape(-1, 3)
    fixed = np.broadcast_to(fixed, (*batch, *fixed.shape))
    places, rows = positions(task, context), zone[..., None, :]
    return _scenery(task, context, places, for_swaps, zones=rows, fixed=fixed, even=False)


def of_problem(problem: Problem, drawn: Sample, for_swaps: bool = False) -> Scenery:
    """Return the scenery of a building, candidates judged at the positions of a sample."""
    rows = []
    for zone in problem.zones:
        low, high = zone.bounds()
        attitude = [float(zone.attitude == name) for name in ATTITUDES]
        rows.append([*0.5 * (low + high), *0.5 * (high - low), zone.weight, *attitude])
    zones, fixed = np.array(rows), problem.fixed
    places = drawn.places, for_swaps
    return _scenery(problem, problem.context, *places, zones=zones, fixed=fixed, even=True)


def _rows_of(obstacles: Obstacles) -> FloatArray:
    """Return boxes around obstacles, and their information fractions: (..., K, 7)."""
    boxes, prisms = obstacles.boxes, obstacles.prisms
    low, high = prisms.limits[:, [0, 2, 4]], prisms.limits[:, [1, 3, 5]]
    share = np.where(np.isnan(prisms.share), obstacles.blocked_information, prisms.share)
    others = np.concatenate([0.5 * (low + high), 0.5 * (high - low), share[:, None]], axis=1)
    blocked = np.full((*boxes.shape[:-1], 1), obstacles.blocked_information)
    others = np.broadcast_to(others, (*boxes.shape[:-2], *others.shape))
    return np.concatenate([np.concatenate([boxes, blocked], axis=-1), others], axis=-2)


def _scenery(
    task: PlacementTask, context: Context, places: FloatArray, for_swaps: bool, **known: Any
) -> Scenery:
    """Return the remaining fields from the task and its context."""
    scene, obstacles, zones = task.scene, task.obstacles_in(context), known["zones"]
    region, batch = scene.anchor_region, zones.shape[:-2]
    kind = _KINDS.get(type(region), "mounts")
    spots, shown = np.zeros((0, 3)), SHOWN.get(kind, 0)
    number = FOR_SWAPS[kind] if for_swaps and kind in SHOWN else shown
    if kind == "mounts":
        spots = _spots(region, obstacles, number)
        shown = shown if region.listed() is None else len(spots)
    elif kind == "walls" and obstacles:
        spots = region.draw(cube(number))
    candidates, normals = (
        np.broadcast_to(x, (*batch, *x.shape)) for x in (spots, region.normal(spots))
    )
    numbers = ranging.numbers_of(scene.noise, len(scene.tags))
    assert numbers is not None  # the laws of scenes have numbers
    squared, first, second, _ = numbers.tolist()
    low, high = region.bounds()
    corner = zones[..., :3] - zones[..., 3:6], zones[..., :3] + zones[..., 3:6]
    origin = 0.5 * (corner[0].min(axis=-2) + corner[1].max(axis=-2))
    return Scenery(
        kind=KINDS.index(kind),
        low=low,
        high=high,
        inner=np.asarray(region.inner_m if isinstance(region, Shell) else 0.0),
        obstacles=_rows_of(obstacles),
        tags=scene.body,
        # Squared ranges as ranges.
        noise=np.array([0.5 * first, 0.0] if squared else [first, second]),
        gain=scene.gain.numbers,
        extent=np.full(batch, float(np.ptp(scene.volume.bounds(), axis=0).max())),
        nearest=np.linalg.norm(region.project(origin) - origin, axis=-1),
        places=places,
        candidates=candidates,
        normals=normals,
        visibility=link_shares(scene, obstacles, candidates, places),
        shown=shown,
        **known,
    )


def _spots(region: Region, obstacles: Obstacles, number: int) -> FloatArray:
    """Return legal positions (C, 3) on mounts: all of a list, else some spread evenly."""
    spots = region.listed()
    if spots is None:
        spots = _scaled_draw(region, cube(2 * number))
    free = spots[~obstacles.contain(spots)]
    return free[:number] if region.listed() is None else free


def _scaled_draw(region: Region, uniforms: FloatArray) -> FloatArray:
    """Draw points of the region scaled to unit size, so that tolerances fit any unit."""
    if not isinstance(region, Mounts):
        return region.draw(uniforms)
    unit = 0.1 * float(np.ptp(region.bounds(), axis=0).max())
    scaled = dataclasses.replace(region, pieces=region.pieces / unit)
    return unit * scaled.draw(uniforms)
