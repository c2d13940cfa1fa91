"""Episodes of environments as frames."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from rbl_gym import placement
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.estimators.filter import filter_text
from rbl_gym.placement.problem import Context
from rbl_gym.studies.watching.frames import Frame, Links, Named, Pose
from rbl_gym.studies.watching.live import Moment, make_filters, moment_of, tracked_moments
from rbl_gym.worlds import simulation
from rbl_gym.wrappers import EstimatePose
from rbl_gym.wrappers.compositions import TaskEnv
from rbl_gym.wrappers.estimate import unpadded

__all__ = ["env_frames"]

# Returns the action for an environment and its observation.
Act = Callable[[Any, Any], Any]

_NO_LINKS = Links(*(np.zeros((0, 0), np.bool_),) * 3)


def env_frames(
    env: gym.Env[Any, Any], filters: tuple[Named, ...] = (), seed: int = 0, act: Act | None = None
) -> Iterator[Frame]:
    """Yield one frame per step of an episode of an environment.

    If the environment tracks a body, filters run beside the environment's own estimates. They get
    the same data as an `EstimatePose` in the environment, which is one of them. In a placement the
    frames show the anchors placed so far; for any other environment they show its rendered picture.

    Parameters
    ----------
    env
        A scalar environment, raw or wrapped.
    filters
        Filters of `filter_named`, beside that of the environment.
    seed
        Seed of the reset and of random actions.
    act
        Called with the environment and its observation, returns an action; None: random actions.

    Raises
    ------
    ValueError
        If `env` is not an environment, or has nothing to show; at the first frame, if a filter does
        not fit.
    """
    if not isinstance(env, gym.Env):
        raise ValueError(f"env must be a gymnasium.Env, got {env!r:.80}")
    if world_of(env) is None and not places_anchors(env) and env.render_mode != "rgb_array":
        raise ValueError(
            "env must track a body or place anchors, or have render_mode='rgb_array', got "
            f"{env!r:.80}"
        )
    return _frames(env, filters, seed, act)


def _frames(
    env: gym.Env[Any, Any], filters: tuple[Named, ...], seed: int, act: Act | None
) -> Iterator[Frame]:
    env.action_space.seed(seed)
    steps = _steps(env, seed, act or (lambda env, _: env.action_space.sample()))
    first = next(steps)
    steps = itertools.chain([first], steps)
    world = world_of(env)
    if world is not None:
        episode = world._episode
        assert episode is not None
        own = own_filter(env)
        made = make_filters(world.scene, [*([] if own is None else [own]), *filters])
        yield from tracked_moments(world.scene, episode, _moments(env, steps), made)
    elif places_anchors(env):
        for count, info in enumerate(steps):
            yield _placed(env, count, info)
    else:
        for count, info in enumerate(steps):
            told = np.asarray(info.get("score_m", np.nan))
            # An environment of several bodies has several worlds.
            score = float(told) if told.ndim == 0 else np.nan
            nothing = np.empty((0, 3))
            picture: Any = env.render()
            yield Frame(count, None, nothing, nothing, _NO_LINKS, (), score, picture=picture)


def _steps(env: gym.Env[Any, Any], seed: int, act: Act) -> Iterator[dict[str, Any]]:
    """Yield the infos of an episode, from its reset on."""
    observation, info = env.reset(seed=seed)
    yield info
    over = False
    while not over:
        observation, _, terminated, truncated, info = env.step(act(env, observation))
        over = terminated or truncated
        yield info


def world_of(env: gym.Env[Any, Any]) -> TrackingEnv | None:
    """Return the world below an environment that tracks a body; None if there is none."""
    base: Any = env.unwrapped
    if isinstance(base, TaskEnv):
        base = base.inner.unwrapped
    return base if isinstance(base, TrackingEnv) else None


def own_filter(env: gym.Env[Any, Any]) -> Named | None:
    """Return the filter of the environment's `EstimatePose`; None if there is none."""
    layer: Any = env
    while layer is not None:
        if isinstance(layer, EstimatePose):
            name, options = layer._named
            return Named(filter_text(name, options or {}), name, dict(options or {}))
        layer = getattr(layer, "inner", None) or getattr(layer, "env", None)
    return None


def _moments(env: gym.Env[Any, Any], infos: Iterator[dict[str, Any]]) -> Iterator[Moment]:
    world, base = world_of(env), env.unwrapped
    assert world is not None
    for info in infos:
        scene, episode, epoch = world.scene, world._episode, world._epoch
        assert episode is not None
        at, anchors = simulation.epoch_of(episode, epoch), world._anchors.copy()
        quality = simulation.link_quality(scene, at, anchors) if scene.obstacles else None
        measured = simulation.measure_epoch(scene, at, anchors, quality)
        if isinstance(base, TaskEnv) and base.inner_observation is not None:
            # The policy may choose which anchors measure.
            chosen: BoolArray = unpadded(base.inner_observation, scene)["links"].astype(np.bool_)
            ranges = np.where(chosen, measured.ranges, 0.0)
            measured = measured._replace(ranges=ranges, links=chosen, nlos=measured.nlos & chosen)
        told = simulation.surveyed(at, anchors)
        found = moment_of(scene, epoch, at, measured, anchors, told, quality)
        yield found._replace(score_m=float(info.get("score_m", np.nan)))


# --- placement --------------------------------------------------------------------------------


def places_anchors(env: gym.Env[Any, Any]) -> bool:
    """Return whether an environment places anchors in one scene."""
    return isinstance(getattr(env.unwrapped, "task", None), placement.PlacementTask)


def _placed(env: gym.Env[Any, Any], count: int, info: dict[str, Any]) -> Frame:
    """Return the anchors placed so far, and their score."""
    base: Any = env.unwrapped
    one_shot = base._batch.mode == "one-shot"
    anchors: FloatArray = info["anchors"][: None if one_shot and count else count].copy()
    score = np.nan
    if len(anchors):
        context = Context(*(field[0] for field in base._batch.contexts))
        score = float(placement.score(base.task, context, anchors))
    centre = Pose(None, np.asarray(info["region"][:3], float))
    return Frame(float(count), centre, anchors, anchors, _NO_LINKS, (), score)
