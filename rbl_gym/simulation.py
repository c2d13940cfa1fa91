"""Episodes of a scene: what the environment and the Monte-Carlo experiments share.

An episode's randomness is drawn at once from one Generator, in a fixed order; everything after
is arithmetic on arrays with leading batch axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbl_gym import bounds, motion, ranging, rotations
from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.scenes import Scene


class Episode(NamedTuple):
    """All of an episode that does not depend on actions, with leading batch axes.

    Attributes
    ----------
    rotation, translation
        True poses at epochs 0 ... T, (..., T + 1, 3, 3) and (..., T + 1, 3).
    twists
        Known twist of the interval that ends at each epoch, (..., T + 1, 6); zero at epoch 0
        unless the prior is older than it.
    prior_rotation, prior_translation, prior_covariance
        Belief at epoch 0 before its update: (..., 3, 3), (..., 3), (..., 6, 6).
    anchors
        At epoch 0, (..., M, 3).
    normals, uniforms
        Random numbers of the ranges (..., T + 1, M, N), of the links (..., T + 1, 2, M, N) or
        None where the scene's links need none.
    """

    rotation: FloatArray
    translation: FloatArray
    twists: FloatArray
    prior_rotation: FloatArray
    prior_translation: FloatArray
    prior_covariance: FloatArray
    anchors: FloatArray
    normals: FloatArray
    uniforms: FloatArray | None


def draw_episode(scene: Scene, rng: np.random.Generator, batch: tuple[int, ...] = ()) -> Episode:
    """An episode of a scene, or a batch of independent ones.

    Anchors that the scene leaves open are drawn anew for every episode of the batch.
    """
    older = scene.prior == "start"
    steps = scene.steps + older
    trajectory = _trajectory(scene, rng, batch, steps)
    path = motion.simulate(
        trajectory, scene.dt, scene.process, rng.standard_normal((*batch, steps, 6))
    )
    twists = np.broadcast_to(trajectory.twists, (*batch, steps, 6))
    offset = rng.standard_normal((*batch, 6))
    covariance = np.broadcast_to(scene.prior_covariance, (*batch, 6, 6))
    rotation, translation = path.rotation[..., 0, :, :], path.translation[..., 0, :]
    if older:
        prior = motion.propagate(rotation, translation, twists[..., 0, :], scene.dt)
        covariance = bounds.predict_covariance(
            covariance, twists[..., 0, :], scene.dt, scene.process
        )
        path = motion.Path(path.rotation[..., 1:, :, :], path.translation[..., 1:, :])
    else:
        prior = (
            rotations.exp(scene.initial_rotation_rad * offset[..., :3]) @ rotation,
            translation + scene.initial_translation_m * offset[..., 3:],
        )
        twists = np.concatenate([np.zeros((*batch, 1, 6)), twists], axis=-2)
    if scene.anchors is None:
        anchors = scene.anchor_region.draw(rng.random((*batch, scene.n_anchors, 3)))
    else:
        anchors = np.broadcast_to(scene.anchors, (*batch, scene.n_anchors, 3))
    shape = (scene.n_anchors, len(scene.tags))
    normals = rng.standard_normal((*batch, scene.steps + 1, *shape))
    uniforms = rng.random((*batch, scene.steps + 1, 2, *shape)) if scene.links.is_random else None
    return Episode(*path, twists, *prior, covariance, anchors, normals, uniforms)


def _trajectory(
    scene: Scene, rng: np.random.Generator, batch: tuple[int, ...], steps: int
) -> motion.Trajectory:
    """The scene's nominal motion; waypoints and the start are uniform in its volume."""
    rotation = rotations.random(rng, batch)
    if scene.start_rotation is not None:
        rotation = np.broadcast_to(scene.start_rotation, (*batch, 3, 3))
    low, high = scene.volume.bounds()
    length = scene.speed_m_s * scene.dt * steps
    # Legs average above a quarter of the extent: four times as many as that calls for, and 8.
    extent = max(float(np.linalg.norm(high - low)), 1e-9)
    n_points = 8 + int(np.ceil(16 * length / extent)) if scene.trajectory == "waypoints" else 1
    points = low + rng.random((*batch, n_points, 3)) * (high - low)
    start = points[..., 0, :]
    if scene.start_translation is not None:
        start = np.broadcast_to(scene.start_translation, (*batch, 3))
        points[..., 0, :] = start
    spin = scene.spin_rad_s * rng.standard_normal((*batch, 3))
    if scene.trajectory == "constant":
        return motion.constant_twist(rotation, start, scene.twist, steps)
    if scene.trajectory == "random-twist":
        return motion.random_twist(rotation, start, scene.speed_m_s, scene.spin_rad_s, steps, rng)
    if scene.trajectory == "orbit":
        radius = 0.35 * float((high - low)[:2].min())
        phase = 2 * np.pi * rng.random(batch)
        return motion.orbit(0.5 * (low + high), radius, scene.speed_m_s, scene.dt, steps, phase)
    if scene.trajectory == "lawn-mower":
        spacing = max(0.2 * float((high - low)[1]), 1e-9)
        points = np.broadcast_to(lanes := motion.lawn_mower_points(low, high, spacing),
                                 (*batch, *lanes.shape))  # fmt: skip
    return motion.waypoints(rotation, points, scene.speed_m_s, scene.dt, steps, spin)


def measure(scene: Scene, episode: Episode, epoch: int, anchors: FloatArray) -> ranging.Measurement:
    """Ranges (..., M, N) of an epoch to the anchors where they stand then (..., M, 3)."""
    positions = ranging.tag_positions(
        episode.rotation[..., epoch, :, :], episode.translation[..., epoch, :], scene.tags
    )
    measured = ranging.measure(
        ranging.distances(anchors, positions),
        scene.noise,
        episode.normals[..., epoch, :, :],
        scene.links,
        None if episode.uniforms is None else episode.uniforms[..., epoch, :, :, :],
    )
    # A range of zero has no variance under a proportional law: such a reading is no reading.
    links = measured.links & (measured.ranges > 0)
    return measured._replace(ranges=np.minimum(measured.ranges, scene.range_limit_m), links=links)


def move_anchors(scene: Scene, anchors: FloatArray, action: FloatArray) -> FloatArray:
    """Anchors after one step of the commanded velocities.

    `action` (..., 3 M) holds a velocity per anchor in units of the scene's limit; a longer
    one than 1 is cut to 1, and the place is projected onto the anchors' region.
    """
    velocity = action.reshape(*action.shape[:-1], scene.n_anchors, 3)
    length = np.linalg.norm(velocity, axis=-1, keepdims=True)
    velocity = velocity * (scene.anchor_speed_m_s / np.maximum(length, 1.0))
    return scene.anchor_region.project(anchors + scene.dt * velocity)


def posterior_information(
    scene: Scene,
    episode: Episode,
    epoch: int,
    anchors: FloatArray,
    links: BoolArray,
    previous: FloatArray | None,
) -> FloatArray:
    """Posterior Cramer-Rao information (..., 6, 6) at the true pose of an epoch.

    From that of the epoch before, or from the prior at epoch 0 (`previous` None). Links that
    gave nothing tell nothing.
    """
    if previous is None:
        predicted = np.linalg.inv(episode.prior_covariance)
    else:
        predicted = bounds.predict_information(
            previous, episode.twists[..., epoch, :], scene.dt, scene.process
        )
    return predicted + bounds.information_at(
        anchors,
        np.asarray(scene.tags),
        episode.rotation[..., epoch, :, :],
        episode.translation[..., epoch, :],
        scene.noise,
        links,
    )
