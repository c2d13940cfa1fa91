"""Episodes of a scene, for the environments and the Monte-Carlo experiments.

All random numbers of an episode are drawn at once from one Generator, in a fixed order. Everything
after that is arithmetic on arrays with leading batch axes.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds, motion
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.kernels import compiled
from rbl_gym.measurements import ranging
from rbl_gym.motion.trajectories import between_waypoints
from rbl_gym.worlds import inertial_motion
from rbl_gym.worlds.scene import Scene

__all__ = [
    "Episode", "Epoch", "draw_episode", "epoch_of", "link_quality", "measure_epoch", "move_anchors",
]  # fmt: skip


class Draws(NamedTuple):
    """All random numbers of an episode: standard normals (..., n) and uniforms (..., m)."""

    normals: FloatArray
    uniforms: FloatArray


class Episode(NamedTuple):
    """The part of an episode that does not depend on actions, with leading batch axes.

    Attributes
    ----------
    rotation, translation
        True poses at epochs 0 ... T, (..., T + 1, 3, 3) and (..., T + 1, 3).
    twists
        Known twist of the interval that ends at each epoch, (..., T + 1, 6). At epoch 0 it is
        zero, unless the prior refers to an earlier time.
    normals, uniforms
        Random numbers of the ranges (..., T + 1, M, N), and of the links (..., T + 1, 2, M, N),
        None if the links need none.
    velocity, readings, bias
        None without an inertial sensor. Otherwise true velocity (..., T + 1, 3); readings (..., T +
        1, S, 6) of the interval that ends at each epoch, zero at epoch 0; the sensor's biases (...,
        T + 1, 6) at the epochs.
    offsets
        Standard normals (..., T + 1, 1 or M, 1 or N) of the range offsets; None without offsets.
    survey
        Errors (..., T + 1, M, 3) of the surveyed anchor positions, the same at all epochs; None
        without survey errors.
    prior_rotation, prior_translation, prior_covariance
        Belief at epoch 0 before its measurements: (..., 3, 3), (..., 3), (..., 6, 6).
    anchors
        Positions at epoch 0, (..., M, 3).
    """

    rotation: FloatArray
    translation: FloatArray
    twists: FloatArray
    normals: FloatArray
    uniforms: FloatArray | None
    velocity: FloatArray | None
    readings: FloatArray | None
    bias: FloatArray | None
    offsets: FloatArray | None
    survey: FloatArray | None
    prior_rotation: FloatArray
    prior_translation: FloatArray
    prior_covariance: FloatArray
    anchors: FloatArray


class Epoch(NamedTuple):
    """An episode at one epoch: the first ten fields of `Episode` without the time axis."""

    rotation: FloatArray
    translation: FloatArray
    twist: FloatArray
    normals: FloatArray
    uniforms: FloatArray | None
    velocity: FloatArray | None = None
    readings: FloatArray | None = None
    bias: FloatArray | None = None
    offsets: FloatArray | None = None
    survey: FloatArray | None = None


class Motion(NamedTuple):
    """True poses at one epoch and the known twist before it: three fields of `Epoch`."""

    rotation: FloatArray
    translation: FloatArray
    twist: FloatArray


# Number of fields of an `Episode` with a time axis.
_TIMED = len(Epoch._fields)
# Number of standard normals of the start of an episode: rotation, spin, prior.
_START_NORMALS = 4 + 3 + 6
# Number of steps for which a random twist is constant.
_HOLD = 10


def draw(scene: Scene, rng: np.random.Generator, batch: tuple[int, ...] = ()) -> Draws:
    """Draw the random numbers of an episode: one call for normals, one for uniforms."""
    return Draws(
        rng.standard_normal((*batch, sum(_normal_sizes(scene)))),
        rng.random((*batch, sum(_uniform_sizes(scene)))),
    )


def empty_draws(scene: Scene, count: int) -> Draws:
    """Return arrays for the random numbers of `count` episodes, (count, n) and (count, m)."""
    return Draws(
        np.empty((count, sum(_normal_sizes(scene)))), np.empty((count, sum(_uniform_sizes(scene))))
    )


def draw_each(draws: Draws, worlds: np.ndarray, generators: Iterable[np.random.Generator]) -> None:
    """Apply `draw` to these rows, each with a generator of its own, for vector environments."""
    for world, generator in zip(worlds.tolist(), generators, strict=True):
        generator.standard_normal(out=draws.normals[world])
        generator.random(out=draws.uniforms[world])


def of_ranges(scene: Scene, draws: Draws) -> tuple[FloatArray, FloatArray | None]:
    """Return views of the draws: `normals` and `uniforms` of an `Episode`."""
    normals = _split(draws.normals, _normal_sizes(scene))[2]
    return _by_epoch(scene, normals, _split(draws.uniforms, _uniform_sizes(scene))[3])


def _by_epoch(
    scene: Scene, normals: FloatArray, uniforms: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """Return random numbers of ranges and links, with axes of epochs and links."""
    batch, shape = normals.shape[:-1], (scene.n_anchors, len(scene.tags))
    normals = normals.reshape((*batch, scene.steps + 1, *shape))
    if not scene.links.is_random:
        return normals, None
    return normals, uniforms.reshape((*batch, scene.steps + 1, 2, *shape))


def draw_episode(scene: Scene, rng: np.random.Generator, batch: tuple[int, ...] = ()) -> Episode:
    """Draw an episode of a scene, or a batch of independent ones.

    Anchors that the scene does not fix are drawn for every episode of the batch.

    Parameters
    ----------
    scene, rng, batch
        The world, the source of all random numbers, and the shape of the leading axes.
    """
    return build_episode(scene, draw(scene, rng, batch))


def _links(scene: Scene) -> int:
    return scene.n_anchors * len(scene.tags)


def _normal_sizes(scene: Scene) -> tuple[int, int, int, int, int, int, int]:
    """Return numbers of normals: start, process, ranges, twists, sensor, offsets, survey."""
    held = -(-scene.steps_of_motion // _HOLD) * 6 if scene.trajectory == "random-twist" else 0
    ranges, felt = (scene.steps + 1) * _links(scene), inertial_motion.normals_of(scene)
    offsets = (scene.steps + 1) * scene.links.n_offsets(scene.n_anchors, len(scene.tags))
    survey = 3 * scene.n_anchors * (scene.survey_std_m > 0)
    return _START_NORMALS, 6 * scene.steps_of_motion, ranges, held, felt, offsets, survey


def _uniform_sizes(scene: Scene) -> tuple[int, int, int, int]:
    """Return numbers of uniforms: way-points, phase of the orbit, anchors, links."""
    anchors = 3 * scene.n_anchors if scene.anchors is None else 0
    links = 2 * (scene.steps + 1) * _links(scene) if scene.links.is_random else 0
    return 3 * scene.n_waypoints, int(scene.trajectory == "orbit"), anchors, links


def build_episode(scene: Scene, draws: Draws, out: Motion | None = None) -> Episode:
    """Return the episodes of these random numbers, batched over their leading axes.

    `out` are arrays for the motion, in any memory order, as `motion_shapes` says; None: new ones.
    """
    batch = draws.normals.shape[:-1]
    start, process, ranges, held, felt, common, surveyed = _split(
        draws.normals, _normal_sizes(scene)
    )
    places, phase, spots, links = _split(draws.uniforms, _uniform_sizes(scene))
    trajectory = _trajectory(scene, start[..., :7], places, phase, held)
    steps = scene.steps_of_motion
    process = process.reshape((*batch, steps, 6))
    if out is None:
        out = Motion(*(np.empty((*batch, *shape)) for shape in motion_shapes(scene)))
    inertial = (None, None, None)
    if scene.inertial is not None:
        track = inertial_motion.fly(scene, trajectory, process, felt)
        path, twists = motion.Path(track.rotation, track.translation), track.twists
        inertial = track.velocity, track.readings, track.bias
    else:
        path = motion.simulate(trajectory, scene.dt, scene.process, process, motion.Path(*out[:2]))
        twists = trajectory.twists
    first_known = scene.steps + 1 - twists.shape[-2]
    out.twist[..., :first_known, :] = 0.0
    out.twist[..., first_known:, :] = twists
    covariance = scene.prior_covariance
    rotation, translation = path.rotation[..., 0, :, :], path.translation[..., 0, :]
    if scene.prior == "start":
        # A constant twist is the same for all episodes: it has few leading axes or none.
        first = trajectory.twists[..., 0, :]
        prior = motion.propagate(rotation, translation, first, scene.dt)
        covariance = bounds.predict_covariance(covariance, first, scene.dt, scene.process)
    else:
        offset = np.sqrt(covariance.diagonal()) * start[..., 7:]
        prior = motion.propagate(rotation, translation, offset, 1.0)
    before = steps - scene.steps
    out = Motion(path.rotation[..., before:, :, :], path.translation[..., before:, :], out.twist)
    if scene.anchors is None:
        spots = spots.reshape((*batch, scene.n_anchors, 3))
        if scene.anchor_start_m is None:
            anchors = scene.anchor_region.draw(spots)
        else:
            around = out.translation[..., :1, :] + scene.anchor_start_m * (2 * spots - 1)
            anchors = scene.anchor_region.project(around)
        if scene.fixed:
            anchors[..., : len(scene.fixed), :] = scene.fixed
    else:
        anchors = np.full((*batch, scene.n_anchors, 3), scene.anchors)
    covariance = np.full((*batch, 6, 6), covariance)
    random, offsets = _by_epoch(scene, ranges, links), None
    if scene.links.offset is not None:
        shape = scene.links.offset_shape(scene.n_anchors, len(scene.tags))
        offsets = common.reshape((*batch, scene.steps + 1, *shape))
    survey = None
    if scene.survey_std_m > 0:
        # Cut at six standard deviations, so that the observation space stays finite.
        survey = scene.survey_std_m * np.clip(surveyed, -6.0, 6.0)
        survey = survey.reshape((*batch, 1, scene.n_anchors, 3))
        survey = np.broadcast_to(survey, (*batch, scene.steps + 1, scene.n_anchors, 3))
    return Episode(*out, *random, *inertial, offsets, survey, *prior, covariance, anchors)


def motion_shapes(scene: Scene) -> tuple[tuple[int, ...], ...]:
    """Return shapes of the arrays of `Motion` in which an episode is built.

    The poses have an epoch more than the twists if there is a step before epoch 0.
    """
    poses = scene.steps_of_motion + 1
    return (poses, 3, 3), (poses, 3), (scene.steps + 1, 6)


def _split(block: FloatArray, sizes: tuple[int, ...]) -> list[FloatArray]:
    ends = itertools.accumulate(sizes)
    return [block[..., end - size : end] for size, end in zip(sizes, ends, strict=True)]


def _trajectory(
    scene: Scene, start: FloatArray, places: FloatArray, phase: FloatArray, held: FloatArray
) -> motion.Trajectory:
    """Return the scene's nominal motion; way-points and the start are uniform in its volume."""
    batch, steps = start.shape[:-1], scene.steps_of_motion
    if scene.start_rotation is None:
        rotation = rotations.from_quaternion(start[..., :4])
    else:
        rotation = np.asarray(scene.start_rotation)
    low, high = scene.volume.bounds()
    places = places.reshape((*batch, -1, 3))
    points = low + places * (high - low)
    if scene.start_volume is not None:
        points[..., 0, :] = scene.start_volume.draw(places[..., 0, :])
    first = points[..., 0, :]
    if scene.start_translation is not None:
        first = np.asarray(scene.start_translation)
        points[..., 0, :] = first
    if scene.trajectory == "constant":
        return motion.constant_twist(rotation, first, scene.twist, steps)
    if scene.trajectory == "random-twist":
        rates = (scene.spin_rad_s, scene.speed_m_s)
        twists = motion.held_twists(held.reshape((*batch, -1, 2, 3)), *rates, steps, _HOLD)
        return motion.Trajectory(rotation, first, twists)
    if scene.trajectory == "orbit":
        radius = 0.35 * float((high - low)[:2].min())
        turn = 2 * np.pi * phase[..., 0]
        return motion.orbit(0.5 * (low + high), radius, scene.speed_m_s, scene.dt, steps, turn)
    if scene.trajectory == "lawn-mower":
        lanes = motion.lawn_mower_points(low, high, max(0.2 * float((high - low)[1]), 1e-9))
        points = np.broadcast_to(lanes, (*batch, *lanes.shape))
    spin = scene.spin_rad_s * start[..., 4:7]
    return between_waypoints(rotation, points, scene.speed_m_s, scene.dt, steps, spin)


def epoch_of(episode: Episode, epoch: int) -> Epoch:
    """Return views of an episode at one epoch, the same for the whole batch."""
    batch = episode.rotation.ndim - 3
    at: Any = (slice(None),) * batch + (epoch,) if batch else epoch
    return Epoch(*[None if field is None else field[at] for field in episode[:_TIMED]])  # pyrefly: ignore[bad-argument-type]


def whole(episode: Episode) -> Epoch:
    """Return all epochs of an episode at once: the time axis is the last batch axis."""
    return Epoch(*episode[:_TIMED])  # pyrefly: ignore[bad-argument-type]


def measure_epoch(
    scene: Scene, at: Epoch, anchors: FloatArray, quality: FloatArray | None = None
) -> ranging.Measurement:
    """Measure the ranges (..., M, N) of an epoch to anchors at positions (..., M, 3).

    `at` is an epoch of an episode of `scene`. `quality` (`link_quality`) may be given if it is
    already known, or to use other obstacles than the scene's.
    """
    normals = at.normals
    if quality is None and scene.weakens:
        quality = link_quality(scene, at, anchors)
    if quality is not None:
        normals = normals / np.sqrt(np.where(quality > 0, quality, 1.0))[..., None]
    longest = scene.range_limit_m
    body = at.rotation, at.translation, scene.body
    ranges = ranging.sample(*body, anchors, normals, scene.noise, longest)
    # A range of zero has no variance under a proportional law, so it is not a measurement.
    if scene.links.never_fails:
        links, nlos = ranges > 0, np.zeros(ranges.shape, dtype=np.bool_)
    else:
        reaches = scene.links.reach_m is not None
        true = ranging.true_distances(*body, anchors) if reaches else None
        taken = ranging.lose_links(ranges, true, scene.links, at.uniforms)
        ranges = np.minimum(taken.ranges, np.asarray(longest)[..., None, None])
        links, nlos = taken.links & (ranges > 0), taken.nlos
    if quality is not None and not np.all(quality):
        links &= quality[..., None] > 0
        ranges[~links] = 0.0
    measured = ranging.Measurement(ranges, links, nlos)
    if scene.links.offset is None:
        return measured
    if at.offsets is None:
        raise ValueError(
            f"links.offset must be None, got {scene.links.offset!r}: the episode was drawn from a "
            "scene without offsets; draw it from this scene"
        )
    return ranging.with_offsets(measured, scene.links, at.offsets)


def surveyed(at: Epoch, anchors: FloatArray) -> FloatArray:
    """Return the surveyed anchor positions (..., M, 3), a copy."""
    return anchors.copy() if at.survey is None else anchors + at.survey


def link_quality(scene: Scene, at: Epoch, anchors: FloatArray) -> FloatArray:
    """Return the information fraction (..., M) of each anchor's links: sight, reach and view."""
    centre = at.translation[..., None, :]
    if not scene.gain:
        return scene.obstruction.share(anchors, centre)[..., 0, :]
    share = scene.gain.share(centre - anchors, scene.anchor_region.normal(anchors))
    if scene.obstruction:
        share = share * scene.obstruction.share(anchors, centre)[..., 0, :]
    return share


def shares(scene: Scene, at: Epoch, anchors: FloatArray, links: BoolArray) -> Any:
    """Return the information fraction (..., M, N) of each link, 0 without a range."""
    return links * link_quality(scene, at, anchors)[..., None] if scene.weakens else links


def move_anchors(scene: Scene, anchors: FloatArray, action: FloatArray) -> FloatArray:
    """Return the anchors after one step of the commanded velocities.

    `action` (..., 3 M) has a velocity per anchor in units of the scene's limit. Longer velocities
    are cut to length 1, and positions are projected onto the anchors' region.
    """
    velocity = action.reshape((*action.shape[:-1], scene.n_anchors, 3))
    moved = _move(anchors, velocity, scene.anchor_speed_m_s * scene.dt)
    return scene.anchor_region.project(moved)


@compiled("epoch:move")
def _move(places: FloatArray, velocity: FloatArray, reach: float) -> FloatArray:
    """Return positions (..., M, 3) after a step of `reach` along velocities of length up to 1."""
    length = np.linalg.norm(velocity, axis=-1, keepdims=True)
    longest = np.asarray(reach)[..., None, None]
    return velocity * (longest / np.maximum(length, 1.0)) + places
