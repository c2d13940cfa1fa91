"""Usual layouts of anchors, chosen without the bound.

A layout is a function ``(task, context, rng) -> anchors (..., M, 3)`` of a placement problem with
any leading axes. `search` has those that use the score.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym.checks import FloatArray, check_one_of
from rbl_gym.geometry.regions import Shell
from rbl_gym.placement import amortised as network
from rbl_gym.placement.problem import Context, PlacementTask

__all__ = ["LAYOUTS", "amortised", "corners", "grid", "layout", "perimeter", "random", "ring"]

Layout = Callable[[PlacementTask, Context, np.random.Generator], FloatArray]

# Radius of the ring around the work region: fractions of the region's half width and of the height
# between the region's centre and the anchors. Tuned on auv_buoys and drone_yard.
RING_WIDTH, RING_HEIGHT = 0.7, 0.65


def random(task: PlacementTask, context: Context, rng: np.random.Generator) -> FloatArray:
    """Draw uniform legal positions."""
    batch = context.centre.shape[:-1]
    return task.scene.anchor_region.draw(rng.random((*batch, task.n_anchors, 3)))


def corners(task: PlacementTask, context: Context, rng: np.random.Generator) -> FloatArray:
    """Use the corners of the legal space, alternately high and low, then the midpoints of edges."""
    if isinstance(task.scene.anchor_region, Shell):
        return _everywhere(task, context, sphere(task.n_anchors))
    around = [(-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0)]
    rounds = itertools.count()
    places = []
    while len(places) < task.n_anchors:
        up = 1 if next(rounds) % 2 else -1
        places += [(x, y, up * (-1) ** k) for k, (x, y) in enumerate(around)]
    return _everywhere(task, context, np.array(places[: task.n_anchors], float))


def grid(task: PlacementTask, context: Context, rng: np.random.Generator) -> FloatArray:
    """Use a regular grid on the ceiling, or on the top of the legal space."""
    if isinstance(task.scene.anchor_region, Shell):
        return _everywhere(task, context, sphere(task.n_anchors))
    n_rows = max(1, round(task.n_anchors**0.5))
    sizes = [len(part) for part in np.array_split(np.arange(task.n_anchors), n_rows)]
    places = [
        ((2 * i + 1) / size - 1, (2 * row + 1) / n_rows - 1, 1.0)
        for row, size in enumerate(sizes)
        for i in range(size)
    ]
    low, high = task.scene.anchor_region.bounds()
    return _broadcast(task, context, 0.5 * (low + high) + np.array(places) * 0.5 * (high - low))


def perimeter(task: PlacementTask, context: Context, rng: np.random.Generator) -> FloatArray:
    """Place anchors at equal distances along the legal space's edge, alternately low and high."""
    if isinstance(task.scene.anchor_region, Shell):
        return _everywhere(task, context, sphere(task.n_anchors))
    low, high = task.scene.anchor_region.bounds()
    x, y = (high - low)[:2]
    stops = np.cumsum([0, x, y, x, y])
    along = (np.arange(task.n_anchors) + 0.5) / task.n_anchors * stops[-1]
    places = np.empty((task.n_anchors, 3))
    for i, edge in enumerate(((0, 1, 1, 0, 0), (0, 0, 1, 1, 0))):
        places[:, i] = low[i] + np.interp(along, stops, edge) * (high - low)[i]
    places[:, 2] = np.where(np.arange(task.n_anchors) % 2, high[2], low[2])
    return _broadcast(task, context, places)


def ring(
    task: PlacementTask,
    context: Context,
    rng: np.random.Generator,
    width: float = RING_WIDTH,
    height: float = RING_HEIGHT,
) -> FloatArray:
    """Place anchors on a circle around the work region, alternately low and high if possible.

    Its radius is `width` times the region's mean half width plus `height` times the vertical
    distance between the region's centre and the anchors.

    Arguments as in `layout`.
    """
    if isinstance(task.scene.anchor_region, Shell):
        return _everywhere(task, context, sphere(task.n_anchors))
    low, high = task.scene.anchor_region.bounds()
    levels = np.where(np.arange(task.n_anchors) % 2, high[2], low[2])
    off = np.abs(context.centre[..., 2, None] - levels)
    radius = width * context.half[..., :2].mean(axis=-1)[..., None] + height * off
    angle = 2 * np.pi * (np.arange(task.n_anchors) + 0.5) / task.n_anchors
    places = np.empty((*radius.shape, 3))
    places[..., 0] = context.centre[..., 0, None] + radius * np.cos(angle)
    places[..., 1] = context.centre[..., 1, None] + radius * np.sin(angle)
    places[..., 2] = levels
    return task.scene.anchor_region.project(places)


def amortised(
    task: PlacementTask, context: Context, rng: np.random.Generator, evaluations: int = 0
) -> FloatArray:
    """Return the layout of a network trained on many random problems, see `placement.amortised`.

    Parameters
    ----------
    task, context, rng
        As in `layout`; 1 to 16 anchors. Nothing is random.
    evaluations
        Largest number of evaluations of the score and its derivatives after the network, in swaps
        and gradient steps; 0: none.
    """
    return network.of_task(task, context, evaluations)


LAYOUTS: dict[str, Layout] = {
    "random": random,
    "corners": corners,
    "grid": grid,
    "perimeter": perimeter,
    "ring": ring,
}


def layout(
    name: str, task: PlacementTask, context: Context, rng: np.random.Generator
) -> FloatArray:
    """Return the named layout (..., M, 3) of a problem.

    Parameters
    ----------
    name
        Name in `LAYOUTS`.
    task, context, rng
        The problem, contexts (...), and the source of random numbers.

    Raises
    ------
    ValueError
        If the name is unknown.
    """
    return LAYOUTS[check_one_of("layout", name, list(LAYOUTS))](task, context, rng)


def sphere(n: int) -> FloatArray:
    """Return directions (n, 3) spread evenly over the sphere (Fibonacci spiral), for shells."""
    z = 1 - (2 * np.arange(n) + 1) / n
    turn = np.pi * (3 - 5**0.5) * np.arange(n)
    flat = np.sqrt(1 - z**2)
    return 0.2 * np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=-1)


def _everywhere(task: PlacementTask, context: Context, actions: FloatArray) -> FloatArray:
    """Return the same positions for all contexts, from actions (M, 3)."""
    region: Any = task.scene.anchor_region
    return _broadcast(task, context, region.place(actions))


def _broadcast(task: PlacementTask, context: Context, anchors: FloatArray) -> FloatArray:
    legal = task.scene.anchor_region.project(anchors)
    return np.broadcast_to(legal, (*context.centre.shape[:-1], *legal.shape)).copy()
