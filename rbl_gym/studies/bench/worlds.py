"""Simulate the worlds of the benchmark: the truth, and the data for filters.

A world is a batch of episodes of a scene under a condition. Its random numbers do not depend on the
filter. Those of motion, prior and ranges do not depend on the condition either. Every comparison is
therefore paired.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import bounds
from rbl_gym.checks import FloatArray
from rbl_gym.studies import monte_carlo
from rbl_gym.studies.epochs import Reading
from rbl_gym.worlds import simulation
from rbl_gym.worlds.scene import Scene

NLOS_PROBABILITY, DROP_PROBABILITY = 0.1, 0.5
NOISE_FACTOR, ANCHOR_ERROR_M, TAG_ERROR_M = 2.0, 0.5, 0.05
CONDITIONS = {
    "nominal": "the filter has the true parameters of the scene",
    "nlos": "10 % of the ranges come over a reflected path, with the excess length set in the "
    "scene's links",
    "lost-links": "half of the links give no range",
    "noise-x2": "the noise is twice as large as the filter assumes",
    "anchor-off": "the filter's position of the first anchor is 0.5 m off, in a random direction",
    "tag-off": "the filter's position of the first tag is 5 cm off",
}
# Streams of random numbers of a scene: episodes, additional links, errors of the geometry known to
# filters.
_WORLD, _LINKS, _TOLD = range(3)


class BenchWorld(NamedTuple):
    """A batch of B episodes of K epochs.

    `told` is the scene as known to filters: tags, noise, process, dt. `tags` (N, 3) and `anchors`
    (B, M, 3) are the true ones; true poses have axes (K, B, ...); `readings` are the inputs of
    filters, one per epoch, `prior` is rotation, translation and covariance before the first.
    `bound` (K, B, 6, 6) is the posterior Cramer-Rao covariance under the true laws, for the links
    with a range; reflected ranges count as direct.
    """

    told: Scene
    tags: FloatArray
    rotation: FloatArray
    translation: FloatArray
    readings: list[Reading]
    prior: tuple[FloatArray, FloatArray, FloatArray]
    bound: FloatArray
    anchors: FloatArray


def simulate_condition(scene: Scene, condition: str, trials: int, seed: int) -> BenchWorld:
    """Simulate a scene under one of `CONDITIONS`.

    Anchors are fixed.
    """
    true = _true_scene(scene, condition)
    entropy = [seed, int(scene_hash(scene), 16)]
    episode = simulation.build_episode(true, _draws(scene, true, trials, entropy))
    anchors = simulation.surveyed(simulation.epoch_of(episode, 0), episode.anchors)
    told, anchors = _told(scene, condition, anchors, np.random.default_rng([*entropy, _TOLD]))
    measurements = monte_carlo.measure_episode(true, episode)
    links = [measured.links for measured in measurements]
    return BenchWorld(
        told,
        np.asarray(scene.tags),
        np.moveaxis(episode.rotation, 1, 0),
        np.moveaxis(episode.translation, 1, 0),
        monte_carlo.told_readings(true, episode, measurements, told, anchors),
        (episode.prior_rotation, episode.prior_translation, episode.prior_covariance),
        monte_carlo.bound_of(true, episode, links),
        np.asarray(episode.anchors),
    )


def _true_scene(scene: Scene, condition: str) -> Scene:
    links = scene.links
    if condition == "nlos":
        probability = max(links.nlos_probability, NLOS_PROBABILITY)
        links = dataclasses.replace(links, nlos_probability=probability)
    elif condition == "lost-links":
        probability = max(links.drop_probability, DROP_PROBABILITY)
        links = dataclasses.replace(links, drop_probability=probability)
    noise = _noisier(scene.noise, NOISE_FACTOR) if condition == "noise-x2" else scene.noise
    return dataclasses.replace(scene, links=links, noise=noise)


def _noisier(noise: Any, factor: float) -> Any:
    scaled = {
        field.name: factor * getattr(noise, field.name)
        for field in dataclasses.fields(noise)
        if field.name in ("floor_m", "proportional", "sigma_m")
    }
    if not scaled:
        raise ValueError(f"condition 'noise-x2' cannot double the noise law {noise!r:.80}")
    return dataclasses.replace(noise, **scaled)


def _draws(scene: Scene, true: Scene, trials: int, entropy: list[int]) -> simulation.Draws:
    """Draw the random numbers of the scene first, then those for additional links."""
    draws = simulation.draw(scene, np.random.default_rng([*entropy, _WORLD]), (trials,))
    more = simulation.empty_draws(true, 1).uniforms.shape[-1] - draws.uniforms.shape[-1]
    besides = np.random.default_rng([*entropy, _LINKS]).random((trials, more))
    return simulation.Draws(draws.normals, np.concatenate([draws.uniforms, besides], axis=-1))


def _told(
    scene: Scene, condition: str, anchors: FloatArray, rng: np.random.Generator
) -> tuple[Scene, FloatArray]:
    """Return the scene and the anchors (B, M, 3) as known to filters."""
    if condition == "anchor-off":
        return scene, off_by(anchors, ANCHOR_ERROR_M, rng)
    if condition == "tag-off":
        tags: Any = off_by(np.array(scene.tags), TAG_ERROR_M, rng)
        return dataclasses.replace(scene, tags=tags), anchors
    return scene, anchors


def off_by(points: FloatArray, distance_m: float, rng: np.random.Generator) -> FloatArray:
    """Return points (..., N, 3), the first moved by a distance in a random direction."""
    direction = rng.standard_normal((*points.shape[:-2], 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    moved = np.array(points)
    moved[..., 0, :] += distance_m * direction
    return moved


def pose_rank(world: BenchWorld) -> int:
    """Return how many of the 6 pose directions the first epoch determines if no link is missing."""
    information = bounds.information_at(
        world.anchors, world.tags, world.rotation[0], world.translation[0], world.told.noise,
        offset=world.told.links.offset,
    )  # fmt: skip
    return int(bounds.information_rank(information).min())


def mirrored(world: BenchWorld) -> FloatArray | None:
    """Return images (K, B, 3) of the true positions behind the anchor plane; None without one."""
    centre = world.anchors.mean(axis=-2)
    _, size, axes = np.linalg.svd(world.anchors - centre[:, None], full_matrices=False)
    if world.anchors.shape[-2] < 3 or not (size[:, 2] <= 1e-6 * size[:, 0]).all():
        return None
    normal = axes[:, 2]
    height = np.einsum("kbi,bi->kb", world.translation - centre, normal)
    return world.translation - 2 * height[..., None] * normal


# Fields added to scenes after the first leaderboard. They enter the hash only if they differ from
# their default. Other scenes keep their hash, and with it the seed of their trials.
_YOUNGER_FIELDS = frozenset(
    {"inertial", "offset", "offset_std_m", "survey_std_m", "prisms", "gain", "fixed"}
)


def scene_hash(scene: Scene) -> str:
    """Return sixteen hexadecimal digits that identify all fields of a scene."""
    text = json.dumps(scene_facts(scene), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def scene_facts(value: Any) -> Any:
    """Return a scene as plain numbers, lists and dicts; some parts have a `kind`."""
    if dataclasses.is_dataclass(value):
        fields = {
            f.name: scene_facts(getattr(value, f.name))
            for f in dataclasses.fields(value)
            if f.name not in _YOUNGER_FIELDS or getattr(value, f.name) != f.default
        }
        return {"kind": type(value).__name__, **fields}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [scene_facts(item) for item in value]
    return value
