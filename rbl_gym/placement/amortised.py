"""Layouts from a network trained on many problems: one pass, without the score.

In boxes, shells and rooms the network gives a position for each anchor, which the region projects
to a legal one. On other mounts each anchor chooses among candidates. `dilution` improves the
layout: in the open by steps, elsewhere by exchanges of anchors for candidates.
`rbl_gym.studies.learning.amortised` trains the network.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, check_count
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.geometry.regions import Box, Region, Shell, Walls
from rbl_gym.placement import dilution, exchange, network_input, setting
from rbl_gym.placement.attention import MOST, chosen, forward
from rbl_gym.placement.building import Problem, cube
from rbl_gym.placement.descent import follow
from rbl_gym.placement.problem import Context, PlacementTask, link_shares
from rbl_gym.placement.sample import sample
from rbl_gym.placement.tokens import KINDS, Scenery, mirrored, mirrored_points, shown_of, tokens_of

__all__ = ["Network", "load", "of_problem", "of_task", "read"]

_FILE = "amortised.npz"
# Numbers of positions for the score and gradient of a building, and of legal positions tried
# instead of one inside an obstacle.
_STEP_PLACES, _SPOTS = 256, 512
# Where something is in the way: numbers of mirror images to compare, and of swaps after them.
_IMAGES, _SWAPS = 2, 10
# Steps and largest numbers of exchanges by the dilution of precision.
_STEPS = 5
_EXCHANGES = {"walls": 2, "mounts": 12}
# Contexts that are placed at once, with swaps and without.
_AT_ONCE = {True: 16, False: 256}


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


class _Play(NamedTuple):
    """A problem with all that the network needs.

    `judge` is the score at the places of `scenery`, `held` the obstacles in which no anchor may be,
    `open` whether nothing is in the way, `count` the number of anchors to place.
    """

    scenery: Scenery
    judge: setting.Setting
    held: Obstacles
    open: bool
    count: int

    def share(self, points: FloatArray) -> FloatArray:
        """Return the information fractions (..., P, M) of the links of anchors (..., M, 3)."""
        return link_shares(self.judge.scene, self.judge.obstacles, points, self.scenery.places)

    def legal(self, points: FloatArray) -> FloatArray:
        """Return legal positions (..., M, 3) for points of any kind."""
        return _legal(self.judge.region, self.held, points)


def _placed(network: Network, play: _Play, image: int = 0) -> FloatArray:
    """Return anchors (..., M, 3) of one pass of the network, on one of the mirror images.

    The dilution of precision improves it: in the open by steps, among candidates by exchanges.
    """
    scenery = mirrored(play.scenery, image) if image else play.scenery
    total = play.count + scenery.fixed.shape[-2]
    steps, scores = forward(network.weights, tokens_of(scenery, play.count), play.count, total)
    if KINDS[scenery.kind] == "mounts":
        index = chosen(scores)[..., None]
        points = np.take_along_axis(play.scenery.candidates, index, axis=-2)
    else:
        _, unit = scenery.frame()
        points = scenery.aim()[..., None, :] + unit[..., None, None] * steps
        points = play.legal(mirrored_points(points, image, back=True))
    if scenery.candidates.shape[-2]:
        return _exchanged(play, points)
    return _stepped(play, points) if play.open else points


def _stepped(play: _Play, points: FloatArray) -> FloatArray:
    """Return anchors (..., M, 3) after steps along the gradient, without the score."""
    scenery, batch = play.scenery, points.shape[:-2]
    fixed = dilution.links_of(scenery, scenery.fixed, play.share(scenery.fixed))

    def evaluate(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        points = points.reshape(*batch, *points.shape[1:])
        share = play.share(points)
        links = dilution.links_of(scenery, points, share)
        square, slope = dilution.square_and_slope(
            scenery, play.judge.sample.weight, links, fixed, share
        )
        return square.reshape(-1), slope.reshape(-1, *slope.shape[-2:])

    flat = points.reshape(-1, *points.shape[-2:])
    return follow(evaluate, play.judge.region, flat, _STEPS).reshape(points.shape)


def _exchanged(play: _Play, points: FloatArray) -> FloatArray:
    """Return anchors (..., M, 3) after exchanges for candidates, without the score."""
    scenery = shown_of(play.scenery)
    shares = play.share(points), play.share(scenery.fixed), scenery.visibility
    parts = dilution.Parts(
        *(
            dilution.links_of(scenery, x, share)
            for x, share in zip((points, scenery.fixed, scenery.candidates), shares, strict=True)
        )
    )
    return dilution.exchanged(
        play.judge.sample.weight,
        dilution.prior_of(scenery),
        parts,
        ~_illegal(play, scenery.candidates),
        _EXCHANGES[KINDS[scenery.kind]],
    )


def _illegal(play: _Play, candidates: FloatArray) -> BoolArray:
    """Return which candidates (..., C) are not legal positions."""
    if KINDS[play.scenery.kind] == "mounts":
        return np.zeros(candidates.shape[:-1], dtype=np.bool_)
    away = np.abs(play.legal(candidates) - candidates).max(axis=-1)
    return away > 1e-6 * play.scenery.frame()[1][..., None]


def _swapped(network: Network, play: _Play, evaluations: int) -> tuple[FloatArray, int]:
    """Return anchors (..., M, 3) after mirror images and swaps, and the number of evaluations."""
    candidates = play.scenery.candidates
    bound = exchange.bound_of(play.judge, candidates)
    best, used = exchange.evaluated(bound, _placed(network, play)), 1
    for image in range(1, min(_IMAGES, evaluations)):
        best, _ = exchange.better(best, exchange.evaluated(bound, _placed(network, play, image)))
        used += 1
    illegal = _illegal(play, candidates)[..., None, :]
    tried = illegal | exchange.occupied(best.points, candidates)
    while used < min(_IMAGES + _SWAPS, evaluations) and (best.decrease > 0)[~tried].any():
        points, pair = exchange.swapped(best, candidates, tried)
        best, is_new = exchange.better(best, exchange.evaluated(bound, points))
        fresh = illegal | exchange.occupied(best.points, candidates)
        tried = np.where(is_new[..., None, None], fresh, tried | pair)
        used += 1
    return best.points, used


def of_task(
    task: PlacementTask, context: Context, evaluations: int = 0, network: Network | None = None
) -> FloatArray:
    """Return layouts (..., M, 3) of a task in contexts (...).

    The layout of the network is improved by `dilution`, without the score: with steps in the open,
    with exchanges of anchors behind obstacles and on mounts.

    Parameters
    ----------
    task, context
        The problems; 1 to 16 anchors.
    evaluations
        Largest number of evaluations of the score and its derivatives after the network. With
        obstacles, or on mounts, the first 2 compare the network's layouts for the problem and a
        mirror image, up to 10 are swaps of an anchor for a candidate, see `exchange`. The others
        are for gradient steps. 0: none.
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
    number = math.prod(batch)
    flat = [field.reshape(number, *field.shape[len(batch) :]) for field in context]
    swap = evaluations > 1 and bool(task.obstacles_in(context))
    size, found = _AT_ONCE[swap], np.zeros((number, task.n_anchors, 3))
    for k in range(0, number, size):
        part = Context(*(field[k : k + size] for field in flat))
        found[k : k + size] = _of_contexts(task, part, evaluations, network, swap)
    return found.reshape(*batch, task.n_anchors, 3)


def _of_contexts(
    task: PlacementTask, context: Context, evaluations: int, network: Network, swap: bool
) -> FloatArray:
    """Return the layouts (C, M, 3) of contexts."""
    judge, held = setting.of_task(task, context), task.scene.obstruction
    scenery, is_open = network_input.of_task(task, context, swap), not judge.obstacles and not held

    def free(points: FloatArray) -> BoolArray:
        each = (task.obstacles_in(Context(*row)) for row in zip(*context, strict=True))
        return ~np.stack([one.contain(x) for one, x in zip(each, points, strict=True)])

    play = _Play(scenery, judge, held, is_open, task.n_anchors)
    return _improved(network, play, evaluations, swap, judge, free if judge.obstacles else None)


def _improved(
    network: Network,
    play: _Play,
    evaluations: int,
    swap: bool,
    judge: setting.Setting,
    free: Callable[[FloatArray], BoolArray] | None,
) -> FloatArray:
    """Return layouts (..., M, 3) after swaps, then steps along the gradient of another `judge`.

    `free` returns which anchors (C, M) of layouts have legal positions; None: all.
    """
    found, used = _swapped(network, play, evaluations) if swap else (_placed(network, play), 0)
    if evaluations <= used:
        return found
    flat = found.reshape(-1, *found.shape[-2:])
    left = evaluations - used
    return follow(judge.score_and_gradient, judge.region, flat, left, free).reshape(found.shape)


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
    smooth = isinstance(problem.mounts, Box | Shell | Walls) and not problem.obstacles
    swap = evaluations > 1 and not smooth
    judge, later = (
        setting.of_problem(problem, sample(problem, number))
        for number in (network_input.PLACES, _STEP_PLACES)
    )
    scenery = network_input.of_problem(problem, judge.sample, swap)
    if KINDS[scenery.kind] == "mounts" and len(scenery.candidates) < count:
        raise ValueError(
            f"{count} anchors cannot be mounted: obstacles leave {len(scenery.candidates)} "
            "permitted positions"
        )
    play = _Play(scenery, judge, problem.obstacles, smooth, count)
    found = _improved(network or load(), play, evaluations, swap, later, later.legal)
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
