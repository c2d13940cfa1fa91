"""Layouts from a network trained on many problems: one pass, no search.

Tokens of the problem and one token per anchor attend to each other. In boxes, shells and rooms each
anchor's token gives a position, which the region projects to a legal one. On other mounts it
chooses among candidates. `rbl_gym.studies.learning.amortised` trains the network.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import FloatArray, check_count
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Box, Region, Shell, Walls
from rbl_gym.placement import scenery, setting, swaps
from rbl_gym.placement.building import Problem, cube
from rbl_gym.placement.descent import descend
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.placement.sample import sample
from rbl_gym.placement.tokens import (
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
# Where something is in the way: numbers of mirror images to compare, and of swaps after them.
_IMAGES, _SWAPS = 2, 10
# Contexts whose swaps are done at once.
_AT_ONCE = 16


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
        weights = {name: arrays[name].astype(np.float32) for name in arrays.files if name != "meta"}
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
    width, numbers = w["ordinal"].shape[1], w["ordinal"].dtype
    tokens = Tokens(*(rows.astype(numbers) for rows in tokens))
    batch = tokens.world.shape[:-2]
    ring = pattern(count).astype(numbers)
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


class _Play(NamedTuple):
    """A problem with all that the network needs.

    Attributes
    ----------
    seen
        Input of the network.
    share
        Returns the information fractions (..., P, M) of the links of anchors (..., M, 3).
    legal
        Returns legal positions (..., M, 3) for points of any kind.
    count
        Number of anchors to place.
    """

    seen: Scenery
    share: Callable[[FloatArray], FloatArray]
    legal: Callable[[FloatArray], FloatArray]
    count: int


def _placed(network: Network, play: _Play, image: int = 0) -> FloatArray:
    """Return anchors (..., M, 3) of one pass of the network, on one of the mirror images."""
    seen = turned(play.seen, image) if image else play.seen
    total = play.count + seen.fixed.shape[-2]
    steps, scores = forward(network.weights, tokens_of(seen, play.count), play.count, total)
    if KINDS[seen.kind] == "mounts":
        index = _chosen(scores)
        return np.take_along_axis(play.seen.candidates, index[..., None], axis=-2)
    _, unit = seen.frame()
    points = seen.aim()[..., None, :] + unit[..., None, None] * steps
    return play.legal(turned_points(points, image, back=True))


def _chosen(scores: FloatArray) -> np.ndarray:
    """Return the candidates (..., M) with the largest scores (..., M, C), each at most once."""
    scores = scores.copy()
    found = []
    for m in range(scores.shape[-2]):
        best = scores[..., m, :].argmax(axis=-1)[..., None]
        found.append(best)
        if scores.shape[-1] > m + 1:
            np.put_along_axis(scores, best[..., None, :], -np.inf, axis=-1)
    return np.concatenate(found, axis=-1)


def _swapped(
    network: Network, play: _Play, poses: swaps.Poses, evaluations: int
) -> tuple[FloatArray, int]:
    """Return anchors (..., M, 3) after mirror images and swaps, and the number of evaluations."""
    bound, candidates = swaps.bound_of(play.seen, poses), play.seen.candidates

    def judged(points: FloatArray) -> swaps.State:
        return swaps.evaluated(bound, points, play.share(points))

    best, used = judged(_placed(network, play)), 1
    for image in range(1, min(_IMAGES, evaluations)):
        best, _ = swaps.better(best, judged(_placed(network, play, image)))
        used += 1
    away = np.abs(play.legal(candidates) - candidates).max(axis=-1)
    illegal = (away > 1e-6 * play.seen.frame()[1][..., None])[..., None, :]
    tried = illegal | swaps.occupied(best.points, candidates)
    while used < min(_IMAGES + _SWAPS, evaluations) and (best.decrease > 0)[~tried].any():
        points, pair = swaps.swapped(best, candidates, tried)
        best, is_new = swaps.better(best, judged(points))
        fresh = illegal | swaps.occupied(best.points, candidates)
        tried = np.where(is_new[..., None, None], fresh, tried | pair)
        used += 1
    return best.points, used


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
        Largest number of evaluations of the score and its derivatives after the network. With
        obstacles, or on mounts, the first 2 compare the network's layouts for the problem and a
        mirror image, up to 10 are swaps of an anchor for a candidate, see `swaps`. The others are
        for gradient steps. 0: none.
    network
        None selects the network of the package.

    Raises
    ------
    ValueError
        If there are more anchors than the network can place.
    """
    check_count("n_anchors", task.n_anchors, least=1, most=MOST)
    evaluations = check_count("evaluations", evaluations, least=0)
    batch, network = context.centre.shape[:-1], network or load()
    swap = evaluations > 1 and bool(task.obstacles(context))
    if swap and math.prod(batch) > _AT_ONCE:
        flat = [field.reshape(-1, *field.shape[len(batch) :]) for field in context]
        some = [slice(k, k + _AT_ONCE) for k in range(0, len(flat[0]), _AT_ONCE)]
        found = [
            of_task(task, Context(*(field[part] for field in flat)), evaluations, network)
            for part in some
        ]
        return np.concatenate(found).reshape(*batch, task.n_anchors, 3)
    seen = scenery.of_task(task, context, swap)

    def legal(points: FloatArray) -> FloatArray:
        return _legal(task.scene.anchor_region, task.scene.obstruction, points)

    def share(points: FloatArray) -> FloatArray:
        return task.obstacles(context).share(points, seen.places)

    play, used = _Play(seen, share, legal, task.n_anchors), 0
    if swap:
        poses = scenery.poses_of_task(task, seen, context)
        found, used = _swapped(network, play, poses, evaluations)
    else:
        found = _placed(network, play)
    if evaluations > used:
        for where in np.ndindex(batch):
            one = setting.of_task(task, Context(*(field[where] for field in context)))
            found[where], _ = descend(one, found[where], evaluations - used, strict=True)
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
    drawn = sample(problem, scenery.PLACES)
    smooth = isinstance(problem.mounts, Box | Shell | Walls) and not problem.obstacles
    swap = evaluations > 1 and not smooth
    seen, network = scenery.of_problem(problem, drawn, swap), network or load()
    if KINDS[seen.kind] == "mounts" and len(seen.candidates) < count:
        raise ValueError("anchors have no permitted place: obstacles cover all of them")

    def legal(points: FloatArray) -> FloatArray:
        return _legal(problem.mounts, problem.obstacles, points)

    def share(points: FloatArray) -> FloatArray:
        return problem.share(points, seen.places)

    play, used = _Play(seen, share, legal, count), 0
    if swap:
        poses = scenery.poses_of_problem(problem, drawn)
        found, used = _swapped(network, play, poses, evaluations)
    else:
        found = _placed(network, play)
    if evaluations > used:
        judged = setting.of_problem(problem, sample(problem, _STEP_PLACES))
        found, _ = descend(judged, found, evaluations - used, strict=True)
    return np.concatenate([problem.fixed, found])


def _legal(region: Region, obstacles: Obstacles, points: FloatArray) -> FloatArray:
    """Return legal positions (..., M, 3) for points, outside of obstacles."""
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
