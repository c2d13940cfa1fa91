"""Where do my anchors go, and how good will the pose be? Design, prediction, comparison."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import placement
from rbl_gym.checks import FloatArray
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.placement import criteria, layouts, scene_files, search
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.placement.scene_files import Problem
from rbl_gym.studies.monte_carlo import rms
from rbl_gym.studies.placing import check
from rbl_gym.studies.placing.accuracy import accuracy, free_grid, free_sample
from rbl_gym.studies.progress import Advance, silent

__all__ = [
    "Design",
    "Placed",
    "design_layout",
    "place_anchors",
    "prediction",
]

# Poses over which layouts are scored while searching: racks make the score rough.
_N_POSES, _N_POSES_OBSTACLES = 64, 160
# Poses over which the criteria of the result are averaged.
_MANY_POSES = 1000
# First standard deviations of CMA-ES, in units of half the legal space: near the start, and far.
_SIGMAS = (0.1, 0.4)
_GENERATIONS = 80
# Random layouts whose median stands for "at random".
_RANDOM_DRAWS = 25


class FreeTask(PlacementTask):
    """A task scored over poses in the zones of a problem, outside of its obstacles."""

    problem: Problem

    def obstacles(self, context: Context) -> Obstacles:
        """Those of the problem."""
        return self.problem.obstacles

    @functools.cached_property
    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Rotations (P, 3, 3) and offsets (P, 3), spread evenly over what is free."""
        low, high = self.scene.volume.bounds()
        # Few places may be free: they are then taken in turns.
        places = np.resize(self.problem.free_places(self.n_poses), (self.n_poses, 3))
        half = 0.5 * (high - low)
        offsets = (places - 0.5 * (low + high)) / np.where(half > 0, half, 1.0)
        return PlacementTask(self.scene, self.n_anchors, n_poses=self.n_poses).poses[0], offsets


def free_task(problem: Problem, n_poses: int) -> FreeTask:
    """The problem's task over so many free poses."""
    task = FreeTask(problem.scene, problem.n_anchors, n_poses=n_poses)
    object.__setattr__(task, "problem", problem)
    return task


class Design(NamedTuple):
    """A layout (M, 3), how it was found, and what the searches reached: name -> layout."""

    anchors: FloatArray
    method: str
    searched: dict[str, FloatArray]


# --- design ----------------------------------------------------------------------------------


def design_layout(
    problem: Problem,
    seed: int,
    advance: Advance = silent,
    smaller: FloatArray | None = None,
) -> Design:
    """The best layout of a problem: greedy with swaps, then CMA-ES from it and from the ring.

    Parameters
    ----------
    problem, seed
        What is placed, and the seed of candidates and searches.
    advance
        Called after each of the `SEARCH_STEPS` steps.
    smaller
        A good layout (M - 1, 3) of one anchor fewer: with the best candidate added, it is one
        more start.
    """
    context = problem.context
    task = free_task(problem, _N_POSES_OBSTACLES if problem.obstacles else _N_POSES)
    rng = np.random.default_rng([seed, task.n_anchors])
    candidates = free_candidates(problem, rng, max(200, 4 * task.n_anchors))
    greedy = search.greedy(task, context, rng, candidates, swaps=True)
    searched = {"greedy with swaps": greedy}
    starts = {"greedy": greedy, "ring": layouts.ring(task, context, rng)}
    if smaller is not None:
        added = np.concatenate(
            [np.broadcast_to(smaller, (len(candidates), *smaller.shape)), candidates[:, None]],
            axis=-2,
        )
        scores = placement.score(task, _repeated(context, len(added)), added)
        starts["one fewer"] = searched["one added"] = added[scores.argmin()]
    advance()
    for sigma in _SIGMAS:
        found = search.cma_es(
            task,
            _repeated(context, len(starts)),
            rng,
            _GENERATIONS,
            sigma=sigma,
            start=np.array(list(starts.values())),
        )
        for name, anchors in zip(starts, found, strict=True):
            searched[f"CMA-ES from {name}, step {sigma:g}"] = anchors
        advance()
    # Nobody mounts to less than a millimetre.
    region = task.scene.anchor_region
    searched = {name: region.project(np.round(x, 3)) for name, x in searched.items()}
    searched |= usual(task, context, rng)
    legal = {
        name: anchors
        for name, anchors in searched.items()
        if not problem.obstacles.contain(anchors).any()
    }
    # Judged over more places than those that the search has seen.
    places = free_sample(problem)
    scores = {name: float(rms(accuracy(problem, x, places).score)) for name, x in legal.items()}
    best = min(scores, key=scores.__getitem__)
    return Design(_in_order(legal[best], context.centre), best, searched)


SEARCH_STEPS = 1 + len(_SIGMAS)


def free_candidates(problem: Problem, rng: np.random.Generator, count: int) -> FloatArray:
    """Legal places (count, 3) outside of the obstacles, uniform.

    Raises
    ------
    ValueError
        If hardly any place is free.
    """
    drawn = problem.mounts.draw(rng.random((20 * count, 3)))
    free = drawn[~problem.obstacles.contain(drawn)]
    if len(free) < problem.n_anchors:
        raise ValueError("anchors have no legal place: obstacles cover all of them")
    return free[:count]


def _in_order(anchors: FloatArray, centre: FloatArray) -> FloatArray:
    """Anchors counted around the region, counter-clockwise from the x axis."""
    away = anchors - centre
    return anchors[np.argsort(np.arctan2(away[:, 1], away[:, 0]) % (2 * np.pi), kind="stable")]


def _repeated(context: Context, count: int) -> Context:
    return Context(*(np.broadcast_to(field, (count, *field.shape)) for field in context))


# --- results ---------------------------------------------------------------------------------


class Placed(NamedTuple):
    """What a run found: the problem with its last number of anchors, its design, the figures."""

    problem: Problem
    design: Design
    result: dict[str, Any]


def place_anchors(
    problem: Problem,
    numbers: range,
    seed: int,
    trials: int,
    advance: Advance = silent,
) -> Placed:
    """Design, predict, compare and check; figures as plain numbers.

    Parameters
    ----------
    problem
        What is placed.
    numbers
        Numbers of anchors; all but the last appear only in the table over the number.
    seed, trials
        Of all randomness, and bodies of the Monte-Carlo check.
    advance
        Called after every step of the work.
    """
    rows, best, found = [], None, None
    advance(0, more=len(numbers) * SEARCH_STEPS + 1)
    for number in numbers:
        problem = scene_files.with_anchors(problem, number)
        found = design_layout(problem, seed, advance, best)
        best = found.anchors
        rows.append({"n_anchors": number, **_summary(problem, best)})
    assert found is not None
    low, high = problem.corners()
    scene, task = problem.scene, free_task(problem, _MANY_POSES)
    seen = placement.sight_fractions(task, problem.context, found.anchors)
    boxes = problem.obstacles.boxes
    result = {
        "scene": problem.name,
        "seed": seed,
        "n_anchors": problem.n_anchors,
        "region": {"low_m": low.tolist(), "high_m": high.tolist()},
        "obstacles": [
            {"low_m": (box[:3] - box[3:]).tolist(), "high_m": (box[:3] + box[3:]).tolist()}
            for box in boxes
        ],
        "tags_m": [list(tag) for tag in scene.tags],
        "method": found.method,
        "anchors": [
            {**dict(zip(("x_m", "y_m", "z_m"), anchor, strict=True)), "sees": float(share)}
            for anchor, share in zip(found.anchors.tolist(), seen, strict=True)
        ],
        "coplanar": _is_flat(found.anchors),
        "predicted": prediction(problem, found.anchors),
        "criteria": _criteria(task, problem.context, found.anchors),
        "layouts": comparison(problem, found, seed),
        "check": check.check_layout(problem, found.anchors, trials, seed),
    }
    if len(numbers) > 1:
        result["against_number"] = rows
    advance()
    return Placed(problem, found, result)


def prediction(problem: Problem, anchors: FloatArray) -> dict[str, Any]:
    """Median, 95th percentile and worst place of position, rotation and b over the region."""
    sample = free_sample(problem)
    found = accuracy(problem, anchors, np.concatenate([sample, free_grid(problem)]))
    result: dict[str, Any] = {"places": len(found.places)}
    for name, values in (
        ("position_m", found.position),
        ("rotation_deg", np.rad2deg(found.rotation)),
        ("score_m", found.score),
    ):
        worst = int(values.argmax())
        inner = values[: len(sample)]
        result[name] = {
            "rms": float(rms(inner)),
            "median": float(np.median(inner)),
            "p95": float(np.quantile(inner, 0.95)),
            "worst": float(values[worst]),
            "worst_at_m": found.places[worst].tolist(),
        }
    return result


def _summary(problem: Problem, anchors: FloatArray) -> dict[str, float]:
    """A prediction's row in a table of layouts."""
    found = prediction(problem, anchors)
    row = {"score_m": found["score_m"]["rms"]}
    for name in ("position_m", "rotation_deg"):
        row |= {
            f"{name.replace('_', f'_{what}_')}": found[name][what]
            for what in ("median", "p95", "worst")
        }
    return row


def usual(task: PlacementTask, context: Context, rng: np.random.Generator) -> dict[str, FloatArray]:
    """The usual layouts; `random` is the median of many draws."""
    found = {
        name: layout(task, context, rng)
        for name, layout in layouts.LAYOUTS.items()
        if name != "random"
    }
    many = layouts.random(task, _repeated(context, _RANDOM_DRAWS), rng)
    order = np.argsort(placement.score(task, _repeated(context, _RANDOM_DRAWS), many))
    return found | {"random": many[order[_RANDOM_DRAWS // 2]]}


def comparison(problem: Problem, found: Design, seed: int) -> dict[str, dict[str, Any]]:
    """The design and the usual layouts, each a row of figures."""
    task = free_task(problem, _N_POSES)
    drawn = usual(task, problem.context, np.random.default_rng([seed, 2]))
    rows = {"designed": found.anchors, "greedy with swaps": found.searched["greedy with swaps"]}
    table = {name: _summary(problem, anchors) for name, anchors in (rows | drawn).items()}
    least = table["designed"]["score_m"]
    return {
        name: {**row, "ratio": row["score_m"] / least}
        for name, row in sorted(table.items(), key=lambda item: item[1]["score_m"])
    }


def _criteria(task: PlacementTask, context: Context, anchors: FloatArray) -> dict[str, Any]:
    """The criteria as numbers; None where there is none (conditioning of coplanar anchors)."""
    values = criteria.criteria(task, context, anchors)._asdict()
    numbers = {name: float(value) for name, value in values.items()}
    if _is_flat(anchors):
        numbers["conditioning"] = math.inf
    return {name: value if math.isfinite(value) else None for name, value in numbers.items()}


def _is_flat(anchors: FloatArray) -> bool:
    """Whether the anchors lie in one plane, as three always do."""
    spread = np.linalg.svd(anchors - anchors.mean(axis=0), compute_uv=False)
    return bool(len(anchors) < 4 or spread[2] < 1e-6 * spread[0])
