"""Layouts from a network trained on many problems: one pass, no search.

Tokens of the problem and one token per anchor attend to each other. In boxes, shells and rooms each
anchor's token gives a position, which the region projects to a legal one. On other mounts it
chooses among candidates. `rbl_gym.studies.learning.amortised` trains the network.
"""

from __future__ import annotations

import functools
import json
import math
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, check_count
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Region, Walls
from rbl_gym.placement import scenery, setting
from rbl_gym.placement.building import Problem, cube
from rbl_gym.placement.descent import descend
from rbl_gym.placement.problem import Context, PlacementTask, score_of_checked
from rbl_gym.placement.sample import sample
from rbl_gym.placement.tokens import (
    IMAGES,
    KINDS,
    Scenery,
    Tokens,
    tokens_of,
    turned,
    turned_points,
)

__all__ = ["Network", "load", "of_problem", "of_task", "read"]

# Largest number of anchors, and number of attention heads.
MOST, HEADS = 16, 4
_FILE = "amortised.npz"
# Numbers of positions for the score and gradient of a building, and of legal positions tried
# instead of one inside an obstacle.
_STEP_PLACES, _SPOTS = 256, 512


class Network(NamedTuple):
    """Weights by name, and how they were trained."""

    weights: dict[str, FloatArray]
    meta: dict[str, Any]


@functools.cache
def load() -> Network:
    """Load the network of the package."""
    return read(resources.files("rbl_gym.placement").joinpath(_FILE))


def read(path: Any) -> Network:
    """Read a network from a file written by the training: a path, or an object with `open`."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        meta = json.loads(str(arrays["meta"]))
        weights = {name: arrays[name].astype(float) for name in arrays.files if name != "meta"}
    return Network(weights, meta)


def shapes(sizes: dict[str, int], width: int, layers: int) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of the weights; `sizes` are the lengths of the token rows."""
    found: dict[str, tuple[int, ...]] = {
        f"{kind}.weight": (sizes[kind], width) for kind in Tokens._fields
    }
    found |= {"candidates.bias": (width,), "candidates.mix": (width, width)}
    found |= {"ordinal": (MOST, width), "count": (MOST, width), "pattern.weight": (3, width)}
    for layer in range(layers):
        name = f"layer{layer}"
        for norm in ("first", "second"):
            found |= {f"{name}.{norm}.scale": (width,), f"{name}.{norm}.bias": (width,)}
        found |= {f"{name}.query": (width, width), f"{name}.seen": (width, 2 * width)}
        found |= {f"{name}.out": (width, width), f"{name}.up": (width, 4 * width)}
        found |= {f"{name}.up.bias": (4 * width,), f"{name}.down": (4 * width, width)}
    found |= {"last.scale": (width,), "last.bias": (width,)}
    found |= {"action": (width, 3), "action.bias": (3,)}
    return found | {"point.query": (width, width), "point.key": (width, width)}


def pattern(count: int) -> FloatArray:
    """Return a ring (M, 3), alternately low and high, to which the network's steps are added."""
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    height = np.where(np.arange(count) % 2, 0.5, -0.5)
    return np.stack([np.cos(angle), np.sin(angle), height], axis=-1)


def forward(
    weights: dict[str, FloatArray], tokens: Tokens, count: int, total: int
) -> tuple[FloatArray, FloatArray]:
    """Return steps (..., M, 3) of the anchors, and scores (..., M, C) of the candidates.

    Parameters
    ----------
    weights
        Weights of a `Network`.
    tokens
        Tokens of the problem.
    count, total
        Number of placed anchors, and of all anchors with the fixed ones.
    """
    w = weights
    width = w["ordinal"].shape[1]
    batch = tokens.world.shape[:-2]
    ring = pattern(count)
    anchors = w["ordinal"][:count] + w["count"][min(total, MOST) - 1] + ring @ w["pattern.weight"]
    rows, masks = [], []
    for kind in ("world", "zones", "obstacles", "fixed"):
        row = getattr(tokens, kind)
        if row.shape[-2]:
            rows.append(row @ w[f"{kind}.weight"])
            masks.append(row[..., 0] > 0)
    rows.append(np.broadcast_to(anchors, (*batch, count, width)))
    masks.append(np.ones((*batch, count), dtype=np.bool_))
    x = np.concatenate(rows, axis=-2)
    spots = _silu(tokens.candidates @ w["candidates.weight"] + w["candidates.bias"])
    spots = spots @ w["candidates.mix"]
    real = tokens.candidates[..., 0] > 0
    mask = np.concatenate([*masks, real], axis=-1)
    hidden = None if mask.all() else np.where(mask, 0.0, -np.inf)[..., None, None, :]
    layer = 0
    while (name := f"layer{layer}") + ".query" in w:
        y = _normed(x, w[f"{name}.first.scale"], w[f"{name}.first.bias"])
        seen = np.concatenate([y, spots], axis=-2) @ w[f"{name}.seen"]
        key, value = _heads(seen[..., :width]), _heads(seen[..., width:])
        query = _heads(y @ w[f"{name}.query"]) * (HEADS / width) ** 0.5
        attention = query @ np.swapaxes(key, -1, -2)
        if hidden is not None:
            attention = attention + hidden
        attention = np.exp(attention - attention.max(axis=-1, keepdims=True))
        attention /= attention.sum(axis=-1, keepdims=True)
        mixed = np.swapaxes(attention @ value, -2, -3)
        x = x + mixed.reshape(x.shape) @ w[f"{name}.out"]
        y = _normed(x, w[f"{name}.second.scale"], w[f"{name}.second.bias"])
        x = x + _silu(y @ w[f"{name}.up"] + w[f"{name}.up.bias"]) @ w[f"{name}.down"]
        layer += 1
    x = _normed(x[..., -count:, :], w["last.scale"], w["last.bias"])
    steps = x @ w["action"] + w["action.bias"] + ring
    key = spots @ w["point.key"]
    scores = (x @ w["point.query"]) @ np.swapaxes(key, -1, -2) / math.sqrt(width)
    return steps, np.where(real[..., None, :], scores, -np.inf)


def _heads(x: FloatArray) -> FloatArray:
    return np.swapaxes(x.reshape(*x.shape[:-1], HEADS, -1), -2, -3)


def _normed(x: FloatArray, scale: FloatArray, bias: FloatArray) -> FloatArray:
    x = x - x.mean(axis=-1, keepdims=True)
    return x / np.sqrt((x**2).mean(axis=-1, keepdims=True) + 1e-5) * scale + bias


def _silu(x: FloatArray) -> FloatArray:
    return x / (1 + np.exp(-x))


def places(network: Network, seen: Scenery, count: int, image: int = 0) -> FloatArray:
    """Return positions (..., M, 3) of `count` anchors, not yet legal on boxes, shells and walls.

    On walls a position stands for the ray from the centre of the room, see `Walls.place`. The
    network is applied to one of the eight mirror images of the problem.
    """
    if image:
        seen = turned(seen, image)
    total = count + seen.fixed.shape[-2]
    steps, scores = forward(network.weights, tokens_of(seen, count), count, total)
    if KINDS[seen.kind] == "mounts":
        return turned_points(_chosen(scores, seen.candidates), image, back=True)
    origin, unit = seen.frame()
    return turned_points(origin[..., None, :] + unit[..., None, None] * steps, image, back=True)


def _chosen(scores: FloatArray, candidates: FloatArray) -> FloatArray:
    """Return the candidates (..., M, 3) with the largest scores (..., M, C), each at most once."""
    scores = scores.copy()
    found = []
    for m in range(scores.shape[-2]):
        best = scores[..., m, :].argmax(axis=-1)[..., None]
        found.append(best)
        if candidates.shape[-2] > m + 1:
            np.put_along_axis(scores, best[..., None, :], -np.inf, axis=-1)
    index = np.concatenate(found, axis=-1)
    return np.take_along_axis(candidates, index[..., None], axis=-2)


def of_task(
    task: PlacementTask,
    context: Context,
    evaluations: int = 0,
    network: Network | None = None,
) -> FloatArray:
    """Return layouts (..., M, 3) of a task in contexts (...).

    Parameters
    ----------
    task, context
        The problems; 1 to 16 anchors.
    evaluations
        Largest number of score evaluations after the network. If there are obstacles, up to 8 of
        them compare the network's layouts for mirror images of the problem. The others, with the
        gradient, are for gradient steps. 0: none.
    network
        None selects the network of the package.

    Raises
    ------
    ValueError
        If there are more anchors than the network can place.
    """
    check_count("n_anchors", task.n_anchors, least=1, most=MOST)
    evaluations = check_count("evaluations", evaluations, least=0)
    seen, network = scenery.of_task(task, context), network or load()
    region, in_the_way = task.scene.anchor_region, task.scene.obstruction
    images = _images(evaluations, bool(task.obstacles(context)))
    found = np.stack(
        [
            _legal(region, in_the_way, seen, places(network, seen, task.n_anchors, image))
            for image in range(images)
        ]
    )
    if images > 1:
        scores = score_of_checked(task, context, found)
        found = np.take_along_axis(found, scores.argmin(axis=0)[None, ..., None, None], axis=0)
        evaluations -= images
    found = found[0]
    if evaluations:
        for where in np.ndindex(found.shape[:-2]):
            one = setting.of_task(task, Context(*(field[where] for field in context)))
            found[where], _ = descend(one, found[where], evaluations)
    return found


def of_problem(
    problem: Problem, evaluations: int = 0, network: Network | None = None
) -> FloatArray:
    """Return the layout (M, 3) of a building, fixed anchors first.

    Parameters
    ----------
    problem
        The problem; 1 to 16 anchors besides the fixed ones.
    evaluations, network
        As `of_task`.

    Raises
    ------
    ValueError
        If there are more anchors than the network can place, or than legal positions.
    """
    count = problem.n_anchors - len(problem.fixed)
    if not count:
        return problem.fixed.copy()
    check_count("the number of anchors to place", count, least=1, most=MOST)
    evaluations = check_count("evaluations", evaluations, least=0)
    seen, network = scenery.of_problem(problem), network or load()
    if KINDS[seen.kind] == "mounts" and len(seen.candidates) < count:
        raise ValueError("anchors have no permitted place: obstacles cover all of them")
    smooth = KINDS[seen.kind] != "mounts" and not problem.obstacles
    found = [
        _legal(problem.mounts, problem.obstacles, seen, places(network, seen, count, image))
        for image in range(_images(evaluations, not smooth))
    ]
    if not evaluations:
        return np.concatenate([problem.fixed, found[0]])
    judged = setting.of_problem(problem, sample(problem, _STEP_PLACES))
    if len(found) > 1:
        found.sort(key=judged.score)
        evaluations -= len(found)
    if evaluations:
        found[0], _ = descend(judged, found[0], evaluations)
    return np.concatenate([problem.fixed, found[0]])


def _images(evaluations: int, in_the_way: bool) -> int:
    """Return the number of mirror images to compare."""
    return min(max(evaluations, 1), IMAGES) if in_the_way else 1


def _legal(region: Region, obstacles: Obstacles, seen: Scenery, points: FloatArray) -> FloatArray:
    """Return legal positions (..., M, 3) for points, outside of obstacles."""
    if KINDS[seen.kind] == "mounts":
        return points
    if isinstance(region, Walls):
        action = region.action(points)
        points = region.place(action / np.maximum(np.abs(action).max(axis=-1, keepdims=True), 1.0))
    else:
        points = region.project(points)
    if not obstacles:
        return points
    held = obstacles.contain(points)
    if held.any():
        spots = region.draw(cube(_SPOTS))
        spots = spots[~obstacles.contain(spots)]
        if len(spots):
            away = ((points[held][:, None] - spots) ** 2).sum(axis=-1)
            points[held] = spots[away.argmin(axis=-1)]
    return points
