"""Programs: what to watch, its surroundings, and how its frames start."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from rbl_gym.checks import FloatArray, as_tuples
from rbl_gym.geometry.regions import Box
from rbl_gym.measurements.ranging import RangeNoise
from rbl_gym.placement.building import Problem, Zone
from rbl_gym.recordings import Recording
from rbl_gym.studies.replay import Settings, Track
from rbl_gym.studies.watching.frames import Frame, filter_named
from rbl_gym.studies.watching.live import Disturbances, Stage, frames, stage_of_scene
from rbl_gym.studies.watching.played import Act, env_frames, own_filter, places_anchors, world_of
from rbl_gym.studies.watching.recorded import recorded_frames, track_all
from rbl_gym.worlds.scene import Scene

__all__ = ["Program", "env_program", "live_program", "program_of", "recorded_program"]

# Margin around the anchors and the track of a recording, metres.
_MARGIN_M = 0.5

Disturb = Callable[[int], Disturbances]


@dataclass(frozen=True, eq=False)
class Program:
    """A program to watch.

    Parameters
    ----------
    title
        Title above the figures.
    room
        Surroundings of the body.
    tags
        (N, 3) on the body, metres.
    start
        Makes frames from labels of filters, a seed and disturbances.
    filters
        Initial labels of the filters.
    seed
        Initial seed.
    can_disturb, can_choose, can_seed
        Whether disturbances, the filters and the seed can be changed.
    """

    title: str
    room: Problem
    tags: FloatArray
    start: Callable[[tuple[str, ...], int, Disturb], Iterator[Frame]]
    filters: tuple[str, ...]
    seed: int = 0
    can_disturb: bool = False
    can_choose: bool = False
    can_seed: bool = False


# Default filters: of a simulation, of a recording.
LIVE, RECORDED = ("iekf", "iekf/robust=true"), ("iekf-log",)


def program_of(what: Any, beside: Any = None, seed: int = 0) -> Program:
    """Return the program of any argument of `rbl_gym.app.studio.show` except problems.

    Parameters
    ----------
    what, beside
        Arguments as in `rbl_gym.app.studio.show`.
    seed
        Seed of an episode.

    Raises
    ------
    ValueError
        If `what` cannot be watched.
    """
    if isinstance(what, Program):
        return what
    if isinstance(what, Scene):
        filters = LIVE if beside is None else tuple(beside)
        return live_program(stage_of_scene(what), filters, room_of(what), seed)
    if isinstance(what, gym.Env):
        return env_program(what, beside, seed)
    if isinstance(what, Recording):
        if beside is None:
            beside = track_all(what, tuple(map(filter_named, RECORDED)), Settings())
        elif isinstance(beside, Track):
            beside = {"track": beside}
        return recorded_program(what, beside)
    raise ValueError(
        "what must be a Problem, a Scene, a Recording, an environment or a Program, "
        f"got {what!r:.80}"
    )


def live_program(stage: Stage, filters: tuple[str, ...], room: Problem, seed: int = 0) -> Program:
    """Return the program of a simulated episode with filters side by side.

    Parameters
    ----------
    stage
        The world of the episode.
    filters
        Labels of the filters.
    room
        Surroundings of the body.
    seed
        Seed of the episode.
    """

    def start(labels: tuple[str, ...], seed: int, disturb: Disturb) -> Iterator[Frame]:
        return frames(stage, [filter_named(label) for label in labels], seed, disturb)

    scene = stage.scene
    return Program(scene.name, room, scene.body, start, filters, seed, True, True, True)


def recorded_program(
    recording: Recording, tracks: Mapping[str, Track], settings: Settings | None = None
) -> Program:
    """Return the program of a recording with its tracks.

    Parameters
    ----------
    recording, tracks, settings
        Arguments as in `recorded_frames`.
    """

    def start(labels: tuple[str, ...], seed: int, disturb: Disturb) -> Iterator[Frame]:
        return recorded_frames(recording, tracks, settings)

    places = [recording.anchors.reshape(-1, 3), *(track.translation for track in tracks.values())]
    room = room_around("recording", np.concatenate(places), recording.tags)
    return Program("Recording", room, recording.tags, start, tuple(tracks))


def env_program(
    env: gym.Env[Any, Any],
    filters: Iterable[str] | None = None,
    seed: int = 0,
    act: Act | None = None,
) -> Program:
    """Return the program of an episode of an environment.

    Parameters
    ----------
    env
        A scalar environment, raw or wrapped.
    filters
        Labels of filters beside the environment's own; None: ``"iekf"`` if it has none.
    seed
        Seed of the episode.
    act
        As in `env_frames`.
    """
    # Raises for an environment that cannot be shown, before its reset.
    env_frames(env)
    _, info = env.reset(seed=seed)
    world, own = world_of(env), own_filter(env)
    if world is None:
        labels: tuple[str, ...] = ()
    elif filters is None:
        labels = () if own else LIVE[:1]
    else:
        labels = tuple(filters)
    shown = labels if own is None or world is None else (own.label, *labels)

    def start(_: tuple[str, ...], seed: int, disturb: Disturb) -> Iterator[Frame]:
        return env_frames(env, tuple(map(filter_named, labels)), seed, act)

    title = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    if world is not None:
        return Program(title, room_of(world.scene), world.scene.body, start, shown, seed)
    if not places_anchors(env):
        tag = np.zeros((1, 3))
        return Program(title, room_around(title, np.eye(3), tag), tag, start, (), seed)
    base: Any = env.unwrapped
    scene = base.task.scene
    centre, half = np.split(np.asarray(info["region"], float), 2)
    racks = np.asarray(info["racks"], float).reshape(-1, 6)
    region = Box(as_tuples(centre - half), as_tuples(centre + half))
    racks = as_tuples(racks[racks[:, 3] > 0])
    room = room_of(dataclasses.replace(scene, volume=region, obstacles=racks))
    return Program(title, room, scene.body, start, (), seed)


def room_of(scene: Scene) -> Problem:
    """Return the drawing of a scene."""
    return Problem(scene, scene.n_anchors, zones=(_zone(*scene.volume.bounds()),))


def room_around(name: str, places: FloatArray, tags: FloatArray) -> Problem:
    """Return only a floor below points (K, 3)."""
    found = places[np.isfinite(places).all(axis=1)]
    # A filter that was lost for a while does not enlarge the room.
    low, high = np.quantile(found, [0.01, 0.99], axis=0)
    zone = _zone(low - _MARGIN_M, high + _MARGIN_M)
    region = Box(*(as_tuples(corner) for corner in zone.bounds()))
    return Problem.of(
        (zone,),
        1,
        name=name,
        tags=as_tuples(tags),
        noise=RangeNoise(0.1),
        anchor_region=region,
        initial_rotation_rad=1.0,
        initial_translation_m=1.0,
    )


def _zone(low: FloatArray, high: FloatArray) -> Zone:
    (x0, y0, z0), (x1, y1, z1) = low.tolist(), high.tolist()
    plan = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return Zone("volume", plan, z0, z1)
