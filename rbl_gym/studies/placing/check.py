"""Check the prediction: run filters on simulated ranges, at random poses in the zones."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy import special

from rbl_gym import bounds, estimators, metrics
from rbl_gym.checks import FloatArray
from rbl_gym.geometry import rotations
from rbl_gym.measurements import ranging
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.placement.building import Problem
from rbl_gym.studies.epochs import Reading, track_epochs
from rbl_gym.studies.placing.accuracy import draw_places
from rbl_gym.studies.placing.judging import limits_of
from rbl_gym.studies.placing.links import link_shares

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
# Standard deviation of a tilt that is known, radians.
_KNOWN_RAD = 1e-6
# The prediction holds where the errors of all bodies are at most so many times the predicted
# ones, and three standard deviations of such a ratio; and where so few are without a pose.
_RATIO, _WITHOUT_POSE = 1.1, 0.01
# Errors that are drawn from each body's bound, for the share that is predicted to be within.
_DRAWS = 40


class DrawnBodies(NamedTuple):
    """Bodies (B, ...) at random poses, with their ranges (B, M, N) and priors.

    Attributes
    ----------
    zone
        Index (B,) of the zone of each body.
    rotation, translation
        The truth.
    ranges, links, told
        Ranges, the mask of measured ones, and the noise law of every link.
    prior_rotation, prior_translation, prior
        Drawn around the truth, with the covariance (B, 6, 6).
    information
        Fisher information (B, 6, 6) of the ranges at the truth.
    """

    zone: np.ndarray
    rotation: FloatArray
    translation: FloatArray
    ranges: FloatArray
    links: np.ndarray
    told: ranging.LinkNoise
    prior_rotation: FloatArray
    prior_translation: FloatArray
    prior: FloatArray
    information: FloatArray


class Found(NamedTuple):
    """Poses (B, ...) found by a filter, NaN if none, and the covariance (B, 6, 6)."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray


def check_layout(problem: Problem, anchors: FloatArray, trials: int, seed: int) -> dict[str, Any]:
    """Compare the errors of filters with the prediction of the bound for the same poses.

    - ``iterated EKF``: one update from a prior drawn around the truth; it knows which links
    are blocked, as reported by radios.
    - ``iterated EKF, not told``: treats all links as clear, with Huber's loss; only with
    obstacles or a limited gain.
    - ``locate, from nothing``: maximum likelihood without a prior; it also knows blocked links.
    Only if the ranges determine the pose of nine bodies in ten, and no zone has a known tilt.

    The figures include all bodies with a pose, found or lost; see `_figures`.

    Parameters
    ----------
    problem, anchors
        The problem, and the anchors (M, 3).
    trials, seed
        Number of bodies at random poses, equally many in each zone, and the random seed.
    """
    drawn = draw_bodies(problem, anchors, trials, np.random.default_rng([seed, 1]))
    with_prior = np.linalg.inv(drawn.information + np.linalg.inv(drawn.prior))
    laws: dict[str, tuple[ranging.NoiseLaw, bool]] = {"iterated EKF": (drawn.told, False)}
    if problem.obstacles or problem.gain:
        laws["iterated EKF, not told"] = (problem.noise, True)
    result = {}
    for name, (law, robust) in laws.items():
        filter = estimators.IteratedEkf(problem.tags, problem.noise, ProcessNoise(), robust=robust)
        start = drawn.prior_rotation, drawn.prior_translation, drawn.prior
        reading = Reading(drawn.ranges, anchors, drawn.links, law)
        (step,) = track_epochs(filter, start, [reading])
        belief = step.belief
        found = Found(belief.rotation, belief.translation, belief.covariance)
        result[name] = _figures(problem, drawn, found, with_prior, seed)
    enough = bounds.information_rank(drawn.information) == 6
    known = any(zone.attitude == "heading" for zone in problem.zones)
    if enough.mean() >= 0.9 and not known:
        found = _located(problem, anchors, drawn, enough)
        regular = np.where(enough[:, None, None], drawn.information, np.eye(6))
        bound = np.where(enough[:, None, None], np.linalg.inv(regular), np.nan)
        result["locate, from nothing"] = _figures(problem, drawn, found, bound, seed)
    return {
        "trials": trials,
        "prior_rotation_deg": float(np.rad2deg(problem.prior.rotation_rad)),
        "prior_position_m": problem.prior.position_m,
        "filters": result,
    }


def _located(
    problem: Problem, anchors: FloatArray, drawn: DrawnBodies, enough: np.ndarray
) -> Found:
    """What maximum likelihood finds of the bodies whose ranges tell a pose; NaN of the others."""
    found = estimators.locate(
        drawn.ranges[enough],
        anchors,
        problem.tags,
        ranging.LinkNoise(drawn.told.std_m[enough]),
        links=drawn.links[enough],
    )
    shapes = (drawn.rotation.shape, drawn.translation.shape, drawn.information.shape)
    poses = [np.full(shape, np.nan) for shape in shapes]
    for pose, name in zip(poses, Found._fields, strict=True):
        pose[enough] = getattr(found, name)
    return Found(*poses)


def draw_bodies(
    problem: Problem, anchors: FloatArray, trials: int, rng: np.random.Generator
) -> DrawnBodies:
    """Draw bodies uniformly over the free part of each zone, with random rotation, and one epoch.

    Parameters
    ----------
    problem, anchors
        The problem, and the anchors (M, 3).
    trials, rng
        Number of bodies, and the source of randomness.
    """
    zone = np.sort(np.arange(trials) % len(problem.zones))
    translation = np.concatenate(
        [
            draw_places(problem, one, rng, int((zone == k).sum()))
            for k, one in enumerate(problem.zones)
        ]
    )
    free = np.array([one.attitude == "free" for one in problem.zones])[zone]
    known = np.array([one.attitude == "heading" for one in problem.zones])[zone]
    about_vertical = rotations.exp(2 * np.pi * rng.random((trials, 1)) * np.array([0.0, 0.0, 1.0]))
    rotation = np.where(free[:, None, None], rotations.random(rng, (trials,)), about_vertical)
    tags = problem.tags
    weight = link_shares(problem, anchors, translation, rotation[:, None])[:, 0]
    distance = ranging.distances(anchors, ranging.tag_positions(rotation, translation, tags))
    normals = rng.standard_normal(distance.shape)
    # A link with nothing left of its information gives no reading.
    scale = np.where(weight > 0, 1 / np.sqrt(np.maximum(weight, 1e-300)), 0.0)
    ranges = problem.noise.sample(distance, scale * normals)
    links = (weight > 0) & (ranges > _LEAST_RANGE_M)
    ranges = np.maximum(ranges, _LEAST_RANGE_M)
    std = np.sqrt(problem.noise.variance(ranges)) * np.where(weight > 0, scale, 1.0)
    prior_std = np.empty((trials, 6))
    prior_std[:, :3], prior_std[:, 3:] = problem.prior
    prior_std[known, :2] = _KNOWN_RAD
    offset = prior_std * rng.standard_normal((trials, 6))
    return DrawnBodies(
        zone,
        rotation,
        translation,
        ranges,
        links,
        ranging.LinkNoise(np.broadcast_to(std, ranges.shape)),
        rotations.exp(offset[:, :3]) @ rotation,
        translation + offset[:, 3:],
        prior_std[:, :, None] ** 2 * np.eye(6),
        bounds.information_at(anchors, tags, rotation, translation, problem.noise, weight),
    )


def _figures(
    problem: Problem, drawn: DrawnBodies, found: Found, bound: FloatArray, seed: int
) -> dict[str, Any]:
    """Real errors beside the predicted ones: of all bodies, of those found, and of every zone.

    Keys: ``found``, the share of bodies with a pose no further off than once in a million;
    ``without_pose``, the share that has none; of all that have one ``position_rmse_m``,
    ``position_p95_m`` (of every body, None where more than that have no pose),
    ``position_predicted_m``, ``position_ratio``, the same of ``rotation`` in degrees, and
    ``nees``; keys with ``_found`` are of those found. ``holds``: whether the errors of all are as
    predicted. ``zones``: of each zone, in its own terms; ``within`` is the share of its bodies
    whose errors are within the limits, ``within_predicted`` what the bound says of it.
    """
    known = np.all(
        [np.isfinite(x.reshape(len(x), -1)).all(axis=1) for x in (*found, bound)], axis=0
    )
    # The truth stands in where there is no pose.
    rotation, translation = (
        np.where(known.reshape(-1, *[1] * (truth.ndim - 1)), pose, truth)
        for pose, truth in (
            (found.rotation, drawn.rotation),
            (found.translation, drawn.translation),
        )
    )
    claimed, bound = (
        np.where(known[:, None, None], P, np.eye(6)) for P in (found.covariance, bound)
    )
    error = metrics.pose_error(rotation, translation, drawn.rotation, drawn.translation)
    nees = metrics.nees(error, claimed)
    # By the bound too: a filter that claims too little must not hide its errors as lost.
    kept = known & ~((nees > _LOST_NEES) & (metrics.nees(error, bound) > _LOST_NEES))
    variance = np.einsum("bii->bi", bound)
    result: dict[str, Any] = {
        "found": float(kept.mean()),
        "without_pose": float(1 - known.mean()),
    }
    for of, rows in (("", known), ("_found", kept)):
        if not rows.any():
            continue
        for name, part, unit, scale in _PARTS:
            real = scale * np.sqrt((error[rows, part] ** 2).sum(-1).mean())
            predicted = scale * np.sqrt(variance[rows, part].sum(-1).mean())
            result |= {
                f"{name}_rmse{of}_{unit}": float(real),
                f"{name}_predicted{of}_{unit}": float(predicted),
                f"{name}_ratio{of}": float(real / predicted),
            }
        result[f"nees{of}"] = float(nees[rows].mean())
    for name, part, unit, scale in _PARTS:
        size = np.where(known, scale * np.sqrt((error[:, part] ** 2).sum(-1)), np.inf)
        p95 = float(np.quantile(size, 0.95, method="higher"))
        result[f"{name}_p95_{unit}"] = p95 if np.isfinite(p95) else None
    chance = 3 / np.sqrt(6 * len(known))
    result["holds"] = bool(
        result["without_pose"] <= _WITHOUT_POSE
        and all(result.get(f"{name}_ratio", np.inf) <= _RATIO + chance for name, *_ in _PARTS)
    )
    result["zones"] = _zones(problem, drawn.zone, error, bound, known, kept, seed)
    return result


_PARTS = (
    ("position", slice(3, 6), "m", 1.0),
    ("rotation", slice(3), "deg", 180 / np.pi),
)


def _zones(
    problem: Problem,
    zone: np.ndarray,
    error: FloatArray,
    bound: FloatArray,
    known: np.ndarray,
    kept: np.ndarray,
    seed: int,
) -> list[dict[str, Any]]:
    """A row of each zone: horizontal position and heading, and what is within the limits."""
    rows = []
    variance = np.einsum("bii->bi", bound)
    for k, one in enumerate(problem.zones):
        here = (zone == k) & known
        row: dict[str, Any] = {
            "name": one.name,
            "bodies": int((zone == k).sum()),
            "found": float(kept[zone == k].mean()),
        }
        if here.any():
            across = (error[here, 3:5] ** 2).sum(-1).mean(), variance[here, 3:5].sum(-1).mean()
            turned = (error[here, 2] ** 2).mean(), variance[here, 2].mean()
            for name, values in (("rmse", 0), ("predicted", 1)):
                row[f"position_{name}_m"] = float(np.sqrt(across[values]))
                row[f"heading_{name}_deg"] = float(np.rad2deg(np.sqrt(turned[values])))
        limits = limits_of(one)
        if limits.any():
            within = known & _within(error, limits)
            row["within"] = float(within[zone == k].mean())
            root = np.linalg.cholesky(bound[here])
            drawn = np.random.default_rng([seed, 9]).standard_normal((_DRAWS, len(root), 6, 1))
            share = _within((root @ drawn)[..., 0], limits).mean() if here.any() else 0.0
            row["within_predicted"] = float(share * here.sum() / (zone == k).sum())
        rows.append(row)
    return rows


def _within(error: FloatArray, limits: Any) -> np.ndarray:
    """Which pose errors (..., 6) are within the limits."""
    across = np.hypot(error[..., 3], error[..., 4]) <= limits.horizontal
    up, turn = np.abs(error[..., 5]) <= limits.height, np.abs(error[..., 2]) <= limits.heading
    return across & up & turn
