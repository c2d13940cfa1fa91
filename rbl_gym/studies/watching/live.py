"""Simulated episodes as frames: filters side by side, with disturbances that can change."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray, check_count, check_number
from rbl_gym.estimators import Filter
from rbl_gym.measurements.ranging import Measurement
from rbl_gym.placement.building import Problem
from rbl_gym.studies.epochs import Reading, track_epochs
from rbl_gym.studies.monte_carlo import scene_filter, told_reading
from rbl_gym.studies.watching.frames import Frame, Links, Named, Pose, tracked
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scene import Scene

__all__ = ["CALM", "Disturbances", "Stage", "frames", "stage_of_problem", "stage_of_scene"]

# Minimum length of an episode if the body stays within its volume, seconds.
_WATCHED_S = 60.0
# A body in a building: speed, turn rate, time step, and process noise after 1 s.
_SPEED, _SPIN, _DT = 1.0, 0.29, 0.1
_ROTATION_RAD, _TRANSLATION_M = 0.083, 0.095
# A link that keeps this share of its information counts as in sight.
SEEN = 0.5
_STAYS = ("waypoints", "orbit", "lawn-mower")


@dataclass(frozen=True)
class Disturbances:
    """Disturbances of the ranges, in addition to those of the scene.

    Parameters
    ----------
    nlos, lost
        Probability that a range has a reflected path, and that a link gives no range.
    wrong_m
        Error of the first anchor's position as the filters know it, towards the centre of the
        volume, metres.
    noise
        Factor on the noise of all ranges. Filters do not know it.
    """

    nlos: float = 0.0
    lost: float = 0.0
    wrong_m: float = 0.0
    noise: float = 1.0

    def __post_init__(self) -> None:
        for name in ("nlos", "lost"):
            check_number(name, getattr(self, name), low=0.0, high=1.0)
        for name in ("wrong_m", "noise"):
            check_number(name, getattr(self, name), low=0.0)


CALM = Disturbances()


@dataclass(frozen=True, eq=False)
class Stage:
    """The world of an episode.

    Parameters
    ----------
    scene
        The scene.
    share
        Returns the share (M,) of its information that each link from anchors (M, 3) to a position
        (3,) keeps; None: computed from the scene's obstacles.
    """

    scene: Scene
    share: Callable[[FloatArray, FloatArray], FloatArray] | None = None

    def quality(self, at: simulation.Epoch, anchors: FloatArray) -> FloatArray | None:
        """Return the share (M,) of information that each link keeps; None if all of it."""
        if self.share is not None:
            return self.share(anchors, at.translation)
        if self.scene.weakens:
            return simulation.link_quality(self.scene, at, anchors)
        return None


def stage_of_scene(scene: Scene, steps: int | None = None) -> Stage:
    """Return the stage of a scene.

    Parameters
    ----------
    scene
        The scene.
    steps
        Length of the episode; None: the scene's length, but at least a minute if the body stays
        within its volume.
    """
    if steps is None:
        watched = int(np.ceil(_WATCHED_S / scene.dt)) if scene.trajectory in _STAYS else 0
        steps = max(scene.steps, watched)
    return Stage(dataclasses.replace(scene, steps=check_count("steps", steps)))


def stage_of_problem(problem: Problem, anchors: FloatArray, steps: int | None = None) -> Stage:
    """Return the stage of a building with anchors (M, 3); the body moves in the first zone.

    All obstacles and the anchors' gain weaken the links. Obstacles do not stop the body.
    """
    low, high = problem.zones[0].bounds()
    volume = dataclasses.replace(problem.scene.volume, low=tuple(low), high=tuple(high))
    scene = dataclasses.replace(
        problem.scene,
        volume=volume,
        n_anchors=len(anchors),
        anchors=tuple(map(tuple, anchors.tolist())),
        speed_m_s=_SPEED,
        spin_rad_s=_SPIN,
        dt=_DT,
        process=dataclasses.replace(
            problem.scene.process, rotation_rad=_ROTATION_RAD, translation_m=_TRANSLATION_M
        ),
        initial_rotation_rad=min(problem.scene.initial_rotation_rad, 0.2),
        initial_translation_m=min(problem.scene.initial_translation_m, 0.5),
    )

    def share(anchors: FloatArray, place: FloatArray) -> FloatArray:
        return problem.share(anchors, place[None])[0]

    obstructed = bool(problem.obstacles or problem.gain)
    return Stage(stage_of_scene(scene, steps).scene, share if obstructed else None)


class Moment(NamedTuple):
    """An epoch of a world, and the data that filters get."""

    time_s: float
    truth: Pose
    anchors: FloatArray
    links: Links
    reading: Reading
    score_m: float = np.nan


def moment_of(
    scene: Scene,
    epoch: int,
    at: simulation.Epoch,
    measured: Measurement,
    anchors: FloatArray,
    told: FloatArray,
    quality: FloatArray | None,
) -> Moment:
    """Return an epoch with its measurements.

    `anchors` are the true positions (M, 3), `told` those that the filters assume. `quality` (M,) is
    the share of its information that each link keeps; None if all keep all of it.
    """
    links = Links(measured.links, measured.nlos, weak_links(measured.links, quality))
    reading = told_reading(scene, at, measured, told, quality, first=not epoch)
    return Moment(epoch * scene.dt, Pose(at.rotation, at.translation), anchors, links, reading)


def frames(
    stage: Stage,
    filters: Sequence[Named],
    seed: int,
    disturb: Callable[[int], Disturbances] = lambda epoch: CALM,
) -> Iterator[Frame]:
    """Yield one frame per epoch of an episode, with filters side by side.

    All random numbers are drawn at the start. The same seed and disturbances give the same frames,
    and an undisturbed epoch is the same whatever happened before. An undisturbed episode is the one
    that ``RBL/Tracking-v0`` plays after ``reset(seed=seed)``, as long as both last.

    Parameters
    ----------
    stage
        The world of the episode.
    filters
        Filters of `filter_named`.
    seed
        Seed of all random numbers.
    disturb
        Called with the number of every epoch, returns the disturbances of its ranges.

    Raises
    ------
    ValueError
        If a filter is unknown or does not fit the scene; before the first frame.
    """
    check_count("seed", seed, least=0)
    scene = stage.scene
    made = make_filters(scene, filters)
    episode = simulation.draw_episode(_with_links(scene, 0.5), np.random.default_rng(seed))
    return tracked_moments(scene, episode, _moments(stage, episode, disturb), made)


Made = Sequence[tuple[str, Filter]]


def make_filters(scene: Scene, filters: Sequence[Named]) -> Made:
    """Return filters for a scene, with their labels."""
    return [(one.label, scene_filter(scene, one.name, one.options)) for one in filters]


def tracked_moments(
    scene: Scene, episode: simulation.Episode, moments: Iterator[Moment], filters: Made
) -> Iterator[Frame]:
    """Yield moments of an episode with the filters' results, started from its prior."""
    prior = episode.prior_rotation, episode.prior_translation, episode.prior_covariance
    first, *copies = itertools.tee(moments, len(filters) + 1)
    runs = [
        track_epochs(filter, prior, (moment.reading for moment in copy))
        for (_, filter), copy in zip(filters, copies, strict=True)
    ]
    for moment, *steps in zip(first, *runs, strict=True):
        found = tuple(
            tracked(label, filter, step, scene.body, scene.noise, moment.truth)
            for (label, filter), step in zip(filters, steps, strict=True)
        )
        time_s, truth, anchors, links, reading, score_m = moment
        yield Frame(time_s, truth, anchors, reading.anchors, links, found, score_m)


def _moments(
    stage: Stage, episode: simulation.Episode, disturb: Callable[[int], Disturbances]
) -> Iterator[Moment]:
    scene, anchors = stage.scene, episode.anchors
    for epoch in range(scene.steps + 1):
        at, now = simulation.epoch_of(episode, epoch), disturb(epoch)
        quality = stage.quality(at, anchors)
        measured = _measured(scene, at, anchors, quality, now)
        told = simulation.surveyed(at, anchors)
        if now.wrong_m > 0:
            inwards = np.mean(scene.volume.bounds(), axis=0) - told[0]
            told[0] += now.wrong_m * inwards / max(float(np.linalg.norm(inwards)), 1e-9)
        yield moment_of(scene, epoch, at, measured, anchors, told, quality)


def weak_links(links: BoolArray, quality: FloatArray | None) -> BoolArray:
    """Return links (M, N) that keep less than half of their information, from shares (M,)."""
    if quality is None:
        return np.zeros(links.shape, np.bool_)
    return np.broadcast_to(quality[:, None] < SEEN, links.shape)


def _measured(
    scene: Scene,
    at: simulation.Epoch,
    anchors: FloatArray,
    quality: FloatArray | None,
    now: Disturbances,
) -> Measurement:
    """Return the ranges of an epoch under disturbances."""
    links = scene.links
    lost = 1 - (1 - links.drop_probability) * (1 - now.lost)
    nlos = 1 - (1 - links.nlos_probability) * (1 - now.nlos)
    disturbed = _with_links(scene, nlos, lost)
    if not disturbed.links.is_random:
        at = at._replace(uniforms=None)
    at = at._replace(normals=now.noise * at.normals)
    return simulation.measure_epoch(disturbed, at, anchors, quality)


def _with_links(scene: Scene, nlos: float, lost: float | None = None) -> Scene:
    links = scene.links
    lost = links.drop_probability if lost is None else lost
    if (links.nlos_probability, links.drop_probability) == (nlos, lost):
        return scene
    changed = dataclasses.replace(links, nlos_probability=nlos, drop_probability=lost)
    return dataclasses.replace(scene, links=changed)
