"""Does the prediction hold? Real filters on simulated ranges, at random poses in the region."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy import special

from rbl_gym import bounds, estimators, metrics
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.placement.scene_files import Problem
from rbl_gym.studies.epochs import Reading, track_epochs

__all__ = [
    "DrawnBodies",
    "check_layout",
    "draw_bodies",
]

# A consistent belief is this far from the truth once in a million: such a pose is lost, for
# instance the mirror image behind a plane of anchors.
_LOST_NEES = float(special.chdtri(6, 1e-6))
# A range below this, metres, is no reading.
_LEAST_RANGE_M = 1e-3


class DrawnBodies(NamedTuple):
    """Bodies (B, ...) at random poses, their ranges (B, M, N) and what is known of them.

    Attributes
    ----------
    rotation, translation
        The truth.
    ranges, links, told
        Ranges, which of them are readings, and the law of every link.
    prior_rotation, prior_translation
        Drawn around the truth by the scene's prior.
    information
        Fisher information (B, 6, 6) of the ranges at the truth.
    """

    rotation: FloatArray
    translation: FloatArray
    ranges: FloatArray
    links: np.ndarray
    told: ranging.LinkNoise
    prior_rotation: FloatArray
    prior_translation: FloatArray
    information: FloatArray


def check_layout(problem: Problem, anchors: FloatArray, trials: int, seed: int) -> dict[str, Any]:
    """Errors of real filters beside what the bound predicts for the same poses.

    - ``iterated EKF``: one update from a prior drawn around the truth; told which links are
      blocked, as radios report it.
    - ``iterated EKF, not told``: takes all links for clear, with Huber's loss; only where there
      are obstacles.
    - ``locate, from nothing``: maximum likelihood without a prior; told as well.

    Parameters
    ----------
    problem, anchors
        What is placed, and where (M, 3).
    trials, seed
        Bodies at random poses, and of which random numbers.
    """
    drawn = draw_bodies(problem, anchors, trials, np.random.default_rng([seed, 1]))
    scene = problem.scene
    prior = scene.prior_covariance
    with_prior = np.linalg.inv(drawn.information + np.linalg.inv(prior))
    laws: dict[str, tuple[ranging.NoiseLaw, bool]] = {"iterated EKF": (drawn.told, False)}
    if problem.obstacles:
        laws["iterated EKF, not told"] = (scene.noise, True)
    result = {}
    for name, (law, robust) in laws.items():
        filter = estimators.IteratedEkf(
            np.array(scene.tags), scene.noise, scene.process, robust=robust
        )
        start = drawn.prior_rotation, drawn.prior_translation, prior
        reading = Reading(drawn.ranges, anchors, drawn.links, law)
        (step,) = track_epochs(filter, start, [reading])
        result[name] = found_figures(drawn, step.belief, with_prior)
    if (bounds.information_rank(drawn.information) == 6).all():
        tags = np.asarray(scene.tags)
        found = estimators.locate(drawn.ranges, anchors, tags, drawn.told, links=drawn.links)
        result["locate, from nothing"] = found_figures(
            drawn, found, np.linalg.inv(drawn.information)
        )
    std = np.sqrt(np.diag(prior))
    return {
        "trials": trials,
        "prior_rotation_deg": float(np.rad2deg(std[0])),
        "prior_position_m": float(std[3]),
        "filters": result,
    }


def draw_bodies(
    problem: Problem, anchors: FloatArray, trials: int, rng: np.random.Generator
) -> DrawnBodies:
    """Bodies uniform over the free part of the region, turned anyhow, and one epoch of ranges.

    Parameters
    ----------
    problem, anchors
        What is placed, and where (M, 3).
    trials, rng
        How many bodies, and their random numbers.
    """
    task = problem.task
    scene = task.scene
    translation = _free_places(problem, trials, rng)
    rotation = rotations.random(rng, (trials,))
    tags = np.asarray(scene.tags)
    weight = problem.share(anchors, translation[:, None])[:, 0, :, None]
    distance = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    normals = rng.standard_normal(distance.shape)
    # A link with nothing left of its information gives no reading.
    scale = np.where(weight > 0, 1 / np.sqrt(np.maximum(weight, 1e-300)), 0.0)
    ranges = scene.noise.sample(distance, scale * normals)
    links = (weight > 0) & (ranges > _LEAST_RANGE_M)
    ranges = np.maximum(ranges, _LEAST_RANGE_M)
    std = np.sqrt(scene.noise.variance(ranges)) * np.where(weight > 0, scale, 1.0)
    offset = rng.standard_normal((trials, 6))
    return DrawnBodies(
        rotation,
        translation,
        ranges,
        links,
        ranging.LinkNoise(np.broadcast_to(std, ranges.shape)),
        rotations.exp(scene.initial_rotation_rad * offset[:, :3]) @ rotation,
        translation + scene.initial_translation_m * offset[:, 3:],
        bounds.information_at(anchors, tags, rotation, translation, scene.noise, weight),
    )


def _free_places(problem: Problem, count: int, rng: np.random.Generator) -> FloatArray:
    """Places (count, 3) uniform over the zones without the obstacles."""
    low, high = problem.corners()
    free = np.empty((0, 3))
    while len(free) < count:
        drawn = low + rng.random((2 * count, 3)) * (high - low)
        free = np.concatenate([free, drawn[problem.free(drawn)]])
    return free[:count]


def found_figures(drawn: DrawnBodies, found: Any, bound: FloatArray) -> dict[str, float]:
    """Real and predicted root mean squares, of all bodies and of those found, and their ratios.

    `lost` is the share of bodies further off than chance allows, or without a pose. Keys with
    `_all` are of every body that has a pose, the others of those that are not lost. `found` has
    rotation, translation and covariance; `bound` is the predicted covariance.
    """
    error = metrics.pose_error(found.rotation, found.translation, drawn.rotation, drawn.translation)
    nees = metrics.nees(error, found.covariance)
    # By the bound too: a filter that claims too little must not hide its errors as lost.
    known = np.isfinite(nees)
    kept = known & ~((nees > _LOST_NEES) & (metrics.nees(error, bound) > _LOST_NEES))
    result = {"lost": float(1 - kept.mean())}
    variance = np.einsum("bii->bi", bound)
    for of, rows in (("", kept), ("_all", known)):
        if not rows.any():
            continue
        for name, part, unit, scale in (
            ("position", slice(3, 6), "m", 1.0),
            ("rotation", slice(3), "deg", 180 / np.pi),
        ):
            real = scale * np.sqrt((error[rows, part] ** 2).sum(-1).mean())
            predicted = scale * np.sqrt(variance[rows, part].sum(-1).mean())
            result |= {
                f"{name}_rmse{of}_{unit}": float(real),
                f"{name}_predicted{of}_{unit}": float(predicted),
                f"{name}_ratio{of}": float(real / predicted),
            }
        result[f"nees{of}"] = float(nees[rows].mean())
    return result
