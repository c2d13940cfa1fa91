"""Tracking errors of layouts and policies, measured with real filters, in comparison to the score.

Layouts: bodies move through way-points in each work region, among the anchors of a method. A filter
tracks them from the scene's prior, and knows which links lack sight. The comparison is between the
score b, which the layouts minimise, and the filter's root mean square tag error.

Tasks with a filter in the loop: episodes with other filters than that of the training.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import estimators, metrics, motion, placement
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry import rotations as rot
from rbl_gym.geometry.obstacles import Obstacles
from rbl_gym.measurements import ranging
from rbl_gym.placement import search
from rbl_gym.placement.problem import Context, PlacementTask
from rbl_gym.studies.epochs import Reading, track_epochs
from rbl_gym.studies.learning import evaluation, rollouts
from rbl_gym.studies.learning.evaluation import Layouts
from rbl_gym.studies.learning.own_policies import PolicyLike
from rbl_gym.studies.learning.policies import check_fit
from rbl_gym.studies.learning.rl_tasks import RlTask
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.worlds.scene import Scene

__all__ = [
    "FILTERS",
    "track_layouts",
    "tracking_filters",
    "transfer_references",
    "transfer_task",
]

# Steps of an episode, settling steps at its start, and way-points of an episode.
_STEPS, _SETTLING, _POINTS = 40, 10, 12
# The column of reflected paths: share of links, and their additional length.
NLOS_PROBABILITY, NLOS_BIAS_M = 0.1, 5.0
FILTERS = {
    "iekf": ("iekf", {"iterations": 2}, False),
    "iekf-bank": ("iekf-bank", {}, False),
    "iekf/robust=true, reflections": ("iekf", {"iterations": 4, "robust": True}, True),
    "uc-kf": ("uc-kf", {}, False),
}


# Scenes of the tasks with a filter in the loop, where the arguments have none.
_OWN_SCENES = {"RBL/MobileAnchors-v0": "auv_craft", "RBL/AnchorSelection-v0": "hall"}


def transfer_references(task: RlTask) -> list[str]:
    """Return default references besides the policies, as far as the task has them."""
    wanted = ("random", "ring", "greedy-swaps", "hybrid")
    if task.env_id in _OWN_SCENES:
        wanted = ("random", "orbit", "nearest", "greedy-blind", "greedy-with-map")
    known = evaluation.references(task)
    return [name for name in wanted if name in known]


def tracking_filters(task: RlTask) -> list[str]:
    """Return filters for the task's scene. UC-KF needs placed anchors that are not coplanar."""
    if task.env_id in _OWN_SCENES:
        return [name for name in FILTERS if name != "uc-kf"]
    env = task.make(1)
    known = env.family.corners if "scenes" in task.arguments else (env.task,)
    corners = [one.scene.anchor_region.bounds() for one in known]
    solid = all((high > low).all() for low, high in corners)
    return [name for name in FILTERS if name != "uc-kf" or solid]


def transfer_task(
    task: RlTask,
    policies: dict[str, PolicyLike],
    names: list[str],
    worlds: int,
    repeats: int,
    seed: int,
    advance: Advance = silent,
) -> dict[str, Any]:
    """Run policies and references in held-out worlds, and measure their tracking errors.

    In a placement task, they place anchors, and filters track bodies among these. In a task with a
    filter in the loop, each filter takes its place, and they act on the belief of that filter.

    Parameters
    ----------
    task, policies
        The task, and policies by label.
    names
        Names of `evaluation.references`.
    worlds, repeats, seed
        Number of held-out worlds, number of bodies in each (of a placement task), and the seed.
    advance
        Called after each layout, then after each filter and label.

    Returns
    -------
    The result of `track_layouts`, with `worlds` and `seed`. With a filter in the loop, score and
    error are those of the steps after the first ten; the correlation is over the worlds.
    """
    if task.env_id in _OWN_SCENES:
        return _transfer_loops(task, policies, names, worlds, seed, advance)
    groups = evaluation.layouts_of(task, policies, names, worlds, seed, advance)
    found = track_layouts(groups, tracking_filters(task), repeats, seed, advance)
    return found | {"worlds": worlds, "seed": seed}


def _transfer_loops(
    task: RlTask,
    policies: dict[str, PolicyLike],
    names: list[str],
    worlds: int,
    seed: int,
    advance: Advance,
) -> dict[str, Any]:
    for label, policy in policies.items():
        check_fit(policy, label, task.make(1))
    filters = tracking_filters(task)
    advance(0, more=len(filters) * (len(names) + len(policies)))
    found: dict[str, Any] = {}
    for name in filters:
        under = _with_filter(task, name)
        rows = found[name] = {}
        for label in [*names, *policies]:
            if label in policies:
                act: Any = policies[label].player()
            else:
                act = evaluation.reference_player(task, label, seed)
            rows[label] = _figures(*_episode_logs(under, act, worlds, seed))
            advance()
    return {"filters": found, "worlds": worlds, "seed": seed}


def _with_filter(task: RlTask, name: str) -> RlTask:
    """Return the task with a filter of `FILTERS` in the loop, and its reflections in the scenes."""
    kind, options, reflections = FILTERS[name]
    arguments = {**task.arguments, "filter": {"name": kind, **options}}
    if reflections:
        key = "scenes" if "scenes" in arguments else "scene"
        scenes = arguments.get(key, _OWN_SCENES[task.env_id])
        one = isinstance(scenes, str | Mapping | Scene)
        made = [_reflecting(scene) for scene in ([scenes] if one else scenes)]
        arguments[key] = made[0] if one else made
    return dataclasses.replace(task, arguments=arguments)


def _reflecting(scene: Any) -> Any:
    law = {"nlos_probability": NLOS_PROBABILITY, "nlos_bias_m": NLOS_BIAS_M}
    if isinstance(scene, Scene):
        return dataclasses.replace(scene, links=dataclasses.replace(scene.links, **law))
    table: dict[str, Any] = {"name": scene} if isinstance(scene, str) else dict(scene)
    return {**table, "links": {**table.get("links", {}), **law}}


def _episode_logs(task: RlTask, act: Any, worlds: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return mean logs of the score and logs of the root mean square tag error (worlds,)."""
    score, square, count = np.zeros(worlds), np.zeros(worlds), np.zeros(worlds)
    for k, (going, _, _, info) in enumerate(rollouts.steps(task, act, worlds, seed), start=1):
        if k > _SETTLING:
            score += np.where(going, np.log(info["score_m"]), 0.0)
            square += np.where(going, info["tag_error_m"] ** 2, 0.0)
            count += going
    if not count.all():
        raise ValueError(f"scenes must have episodes of more than {_SETTLING} steps")
    return score / count, 0.5 * np.log(square / count)


class Bodies(NamedTuple):
    """Moving bodies (T + 1, B, ...): poses, twists into each epoch, normal variates."""

    rotation: FloatArray
    translation: FloatArray
    twists: FloatArray
    normals: FloatArray
    reflected: BoolArray
    prior: tuple[FloatArray, FloatArray]


def track_layouts(
    groups: list[Layouts], filters: list[str], repeats: int, seed: int, advance: Advance = silent
) -> dict[str, Any]:
    """Return scores and filter errors of layouts. All layouts have the same bodies.

    Parameters
    ----------
    groups
        Layouts of C worlds of one problem each, or L layouts of each world (C, L, M, 3).
    filters
        Names of `FILTERS`.
    repeats, seed
        Number of bodies in each world, and the seed.
    advance
        Called after every filter and label.

    Returns
    -------
    A dict. ``filters[name][label]`` has the geometric means of score (`score_m`) and error
    (`tag_rmse_m`), and the correlation of their logarithms over the layouts (None for fewer than
    three).
    """
    several = [
        _bodies(*one[:2], repeats, np.random.default_rng([seed, 2, *([i] if i else [])]))
        for i, one in enumerate(groups)
    ]
    labels = list(groups[0].found)
    result: dict[str, Any] = {"steps": _STEPS, "repeats": repeats, "filters": {}}
    advance(0, more=len(filters) * len(labels))
    for name in filters:
        rows = {}
        for label in labels:
            pairs = [
                _logs(one, label, bodies, name, repeats)
                for one, bodies in zip(groups, several, strict=True)
            ]
            score, errors = (np.concatenate(part) for part in zip(*pairs, strict=True))
            rows[label] = _figures(score, errors)
            advance()
        result["filters"][name] = rows
    return result


def _logs(
    group: Layouts, label: str, bodies: Bodies, name: str, repeats: int
) -> tuple[FloatArray, FloatArray]:
    """Return logarithms of the scores of layouts and of a filter's errors, flat."""
    task, contexts, found = group
    anchors = found[label]
    each = search.expand(contexts) if anchors.ndim == 4 else contexts
    score = placement.score(task, each, anchors)
    several = anchors if anchors.ndim == 4 else anchors[:, None]
    errors = [
        _tag_rmse(task, contexts, several[:, k], bodies, name, repeats)
        for k in range(several.shape[1])
    ]
    return np.log(score).ravel(), np.log(np.stack(errors, axis=1)).ravel()


def _figures(score: FloatArray, error: FloatArray) -> dict[str, float | None]:
    """Return the figures of a filter and a label from logarithms (worlds,) or (layouts,)."""
    return {
        "score_m": float(np.exp(score.mean())),
        "tag_rmse_m": float(np.exp(error.mean())),
        "correlation": float(np.corrcoef(score, error)[0, 1]) if len(score) > 2 else None,
    }


def _bodies(
    task: PlacementTask, contexts: Context, repeats: int, rng: np.random.Generator
) -> Bodies:
    """Return `repeats` bodies in each work region, flat over both."""
    scene = task.scene
    centre, half = (np.repeat(array, repeats, axis=0) for array in contexts[:2])
    batch = len(centre)
    points = centre[:, None] + half[:, None] * rng.uniform(-1, 1, (batch, _POINTS, 3))
    spin = scene.spin_rad_s * rng.standard_normal((batch, 3))
    start = rot.random(rng, (batch,))
    nominal = motion.waypoints(start, points, scene.speed_m_s, scene.dt, _STEPS, spin)
    path = motion.simulate(
        nominal, scene.dt, scene.process, rng.standard_normal((batch, _STEPS, 6))
    )
    offset = rng.standard_normal((batch, 6))
    shape = (_STEPS + 1, batch, task.n_anchors, len(scene.tags))
    prior = (
        rot.exp(scene.initial_rotation_rad * offset[:, :3]) @ path.rotation[:, 0],
        path.translation[:, 0] + scene.initial_translation_m * offset[:, 3:],
    )
    return Bodies(
        np.moveaxis(path.rotation, 1, 0),
        np.moveaxis(path.translation, 1, 0),
        np.moveaxis(np.broadcast_to(nominal.twists, (batch, _STEPS, 6)), 1, 0),
        rng.standard_normal(shape),
        rng.random(shape) < NLOS_PROBABILITY,
        prior,
    )


def _tag_rmse(
    task: PlacementTask,
    contexts: Context,
    anchors: FloatArray,
    bodies: Bodies,
    name: str,
    repeats: int,
) -> FloatArray:
    """Return the root mean square tag error (C,) of a filter after settling."""
    scene, tags = task.scene, np.asarray(task.scene.tags)
    kind, options, reflections = FILTERS[name]
    anchors = np.repeat(anchors, repeats, axis=0)
    repeated = Context(*(np.repeat(field, repeats, axis=0) for field in contexts))
    obstacles = task.obstacles_in(repeated)
    laws = {"tags": tags, "noise": scene.noise, "process": scene.process}
    filter = estimators.make(kind, **laws, **options)
    readings = _readings(scene, obstacles, anchors, bodies, reflections)
    total = np.zeros(len(anchors))
    steps = track_epochs(filter, (*bodies.prior, scene.prior_covariance), readings)
    for k, step in enumerate(steps):
        if k > _SETTLING:
            truth = bodies.rotation[k], bodies.translation[k]
            total += metrics.tag_error(*step.belief[:2], *truth, tags) ** 2
    return np.sqrt(total.reshape(-1, repeats).mean(axis=-1) / (_STEPS - _SETTLING))


def _readings(
    scene: Scene, obstacles: Obstacles, anchors: FloatArray, bodies: Bodies, reflections: bool
) -> Iterator[Reading]:
    """Return the filter's data: ranges of all links, and the law of links without sight."""
    for k, (rotation, translation) in enumerate(
        zip(bodies.rotation, bodies.translation, strict=True)
    ):
        scale = obstacles.share(anchors, translation[:, None])[:, 0, :, None] ** -0.5
        positions = ranging.tag_positions(rotation, translation, np.asarray(scene.tags))
        distance = ranging.distances(anchors, positions)
        ranges = scene.noise.sample(distance, scale * bodies.normals[k])
        if reflections:
            ranges = ranges + NLOS_BIAS_M * bodies.reflected[k]
        ranges = np.maximum(ranges, 1e-3)
        law = None
        if obstacles:
            law = ranging.LinkNoise(scale * np.sqrt(scene.noise.variance(ranges)))
        twist = bodies.twists[k - 1] if k else None
        yield Reading(ranges, anchors, noise=law, twist=twist, dt=scene.dt)
