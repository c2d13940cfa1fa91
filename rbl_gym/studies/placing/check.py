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

__all__ = ["DrawnBodies", "check_layout", "draw_bodies"]

# A pose is lost if a consistent belief would be this far from the truth once in a million, for
# instance the mirror image behind a plane of anchors.
_LOST_NEES = float(special.chdtri(6, 1e-6))
# Ranges below this value (metres) do not count as measured.
_LEAST_RANGE_M = 1e-3
# Iterations of the filters. The usual four do not always converge from a prior as vague as that of
# the check, with precise ranges.
_ITERATIONS = 20
# The ranges of a pose fit if a chi-square variable is larger more often than this.
_FITS = 1e-3
# Standard deviation of a known tilt, radians.
_KNOWN_RAD = 1e-6
# The prediction holds if the ratio of actual to predicted errors of all bodies is at most the first
# value, plus three standard deviations of such a ratio, and the share of bodies without a pose is
# at most the second.
_RATIO, _WITHOUT_POSE = 1.1, 0.01
# Number of errors drawn from the bound of each body, for the predicted share within the limits.
_DRAWS = 40


class DrawnBodies(NamedTuple):
    """Bodies (B, ...) at random poses, with their ranges (B, M, N) and priors.

    Attributes
    ----------
    zone
        Index (B,) of the zone of each body.
    rotation, translation
        The true rotation (B, 3, 3) and translation (B, 3).
    ranges, links, told
        Ranges, the mask of measured ones, and the noise law of each link.
    prior_rotation, prior_translation, prior
        Prior poses, drawn around the truth, and their covariance (B, 6, 6).
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
    """Poses (B, ...) found by a filter, NaN if none, and their covariance (B, 6, 6)."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray


def check_layout(problem: Problem, anchors: FloatArray, trials: int, seed: int) -> dict[str, Any]:
    """Compare the errors of filters with the prediction of the bound for the same poses.

    - ``iterated EKF``: one update from a prior drawn around the truth. It knows which links are
      blocked, as radios report it.
    - ``iterated EKF, not told``: treats all links as clear, with Huber's loss. Only with obstacles
      or a limited gain.
    - ``locate, from nothing``: maximum likelihood without a prior. It also knows the blocked links.
      Only if the ranges determine the pose of nine bodies in ten, and no zone has a known tilt.

    The figures include all bodies with a pose, found or lost; see `_figures`.

    Parameters
    ----------
    problem, anchors
        The placement problem, and the anchor positions (M, 3).
    trials, seed
        Number of bodies at random poses, the same in each zone, and the random seed.
    """
    drawn = draw_bodies(problem, anchors, trials, np.random.default_rng([seed, 1]))
    with_prior = np.linalg.inv(drawn.information + np.linalg.inv(drawn.prior))
    laws: dict[str, tuple[ranging.NoiseLaw, bool]] = {"iterated EKF": (drawn.told, False)}
    if problem.obstacles or problem.gain:
        laws["iterated EKF, not told"] = (problem.noise, True)
    result = {}
    for name, (law, robust) in laws.items():
        filter = estimators.IteratedEkf(
            problem.tags, problem.noise, ProcessNoise(), _ITERATIONS, robust
        )
        start = drawn.prior_rotation, drawn.prior_translation, drawn.prior
        reading = Reading(drawn.ranges, anchors, drawn.links, law)
        (step,) = track_epochs(filter, start, [reading])
        belief = step.belief
        found = Found(belief.rotation, belief.translation, belief.covariance)
        result[name] = _figures(problem, anchors, drawn, found, with_prior, seed)
    enough = bounds.information_rank(drawn.information) == 6
    known = any(zone.attitude == "heading" for zone in problem.zones)
    if enough.mean() >= 0.9 and not known:
        found = _located(problem, anchors, drawn, enough)
        regular = np.where(enough[:, None, None], drawn.information, np.eye(6))
        bound = np.where(enough[:, None, None], np.linalg.inv(regular), np.nan)
        result["locate, from nothing"] = _figures(problem, anchors, drawn, found, bound, seed)
    return {
        "trials": trials,
        "prior_rotation_deg": float(np.rad2deg(problem.scene.initial_rotation_rad)),
        "prior_position_m": problem.scene.initial_translation_m,
        "through_walls": _through_walls(problem, drawn),
        "filters": result,
    }


def _through_walls(problem: Problem, drawn: DrawnBodies) -> list[dict[str, Any]]:
    """Return the share of the bodies of each zone with a tag inside an obstacle or behind a wall.

    Positions are free for the origin of the body only. Such a body would reach through a wall.
    """
    tags = ranging.tag_positions(drawn.rotation, drawn.translation, problem.tags)
    seen = problem.obstacles.sees(drawn.translation[:, None], tags)[..., 0]
    through = np.any(np.logical_not(seen) | problem.obstacles.contain(tags), axis=-1)
    return [
        {"name": zone.name, "share": float(np.mean(through, where=drawn.zone == k))}
        for k, zone in enumerate(problem.zones)
        if (drawn.zone == k).any()
    ]


def _located(
    problem: Problem, anchors: FloatArray, drawn: DrawnBodies, enough: np.ndarray
) -> Found:
    """Locate the bodies whose ranges determine a pose by maximum likelihood; others are NaN."""
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
    """Draw bodies at random poses, with one epoch of ranges.

    Positions are uniform over the free part of each zone, rotations are random.

    Parameters
    ----------
    problem, anchors
        The placement problem, and the anchor positions (M, 3).
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
    # A link without information gives no range.
    scale = np.where(weight > 0, 1 / np.sqrt(np.maximum(weight, 1e-300)), 0.0)
    ranges = problem.noise.sample(distance, scale * normals)
    links = (weight > 0) & (ranges > _LEAST_RANGE_M)
    ranges = np.maximum(ranges, _LEAST_RANGE_M)
    std = np.sqrt(problem.noise.variance(ranges)) * np.where(weight > 0, scale, 1.0)
    turned, moved = problem.scene.initial_rotation_rad, problem.scene.initial_translation_m
    prior_std = np.tile([turned] * 3 + [moved] * 3, (trials, 1))
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
    problem: Problem,
    anchors: FloatArray,
    drawn: DrawnBodies,
    found: Found,
    bound: FloatArray,
    seed: int,
) -> dict[str, Any]:
    """Return actual and predicted errors, over all bodies and by zone.

    - ``found``: share of the bodies whose pose is not lost (see `_LOST_NEES`).
    - ``without_pose``: share of the bodies without a pose.
    - ``wrong``: the lost poses, see `_wrong`; None if there are none.
    - ``position_rmse_m``, ``position_predicted_m``, ``position_ratio``: over all bodies with a
      pose.
    - ``position_p95_m``: over all bodies; None if more than 5 % have no pose.
    - the same keys of ``rotation``, in degrees, and ``nees``. Keys with ``_found`` are over the
      bodies that are found.
    - ``holds``: whether the errors of all bodies agree with the prediction.
    - ``zones``: rows of the zones. ``within`` is the share of the bodies of a zone whose errors are
      within its limits, ``within_predicted`` the share predicted by the bound.
    """
    known = np.all(
        [np.isfinite(x.reshape(len(x), -1)).all(axis=1) for x in (*found, bound)], axis=0
    )
    # Without a pose, the truth is a placeholder.
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
    # The bound must agree: an overconfident filter must not hide its errors as lost poses.
    kept = known & ~((nees > _LOST_NEES) & (metrics.nees(error, bound) > _LOST_NEES))
    variance = np.einsum("bii->bi", bound)
    result: dict[str, Any] = {"found": float(kept.mean()), "without_pose": float(1 - known.mean())}
    result["wrong"] = _wrong(problem, anchors, drawn, found, error, known & ~kept)
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


def _wrong(
    problem: Problem,
    anchors: FloatArray,
    drawn: DrawnBodies,
    found: Found,
    error: FloatArray,
    lost: np.ndarray,
) -> dict[str, Any] | None:
    """Return what the wrong poses have in common, to name the cause.

    - ``bodies``: their number; ``zones``: names of the zones that have any.
    - ``fit``: number of those whose ranges agree with the wrong pose, by a chi-square test. The
      ranges do not tell such a pose from the true one. The others are false minima.
    - ``horizontal_m``, ``height_m``: root mean square errors of their positions.
    """
    if not lost.any():
        return None
    tags = ranging.tag_positions(found.rotation[lost], found.translation[lost], problem.tags)
    miss = (drawn.ranges[lost] - ranging.distances(anchors, tags)) / drawn.told.std_m[lost]
    links = drawn.links[lost]
    square = np.where(links, miss**2, 0.0).sum(axis=(-2, -1))
    fit = special.chdtrc(links.sum(axis=(-2, -1)), square) > _FITS
    across, up = (error[lost][:, 3:5] ** 2).sum(-1).mean(), (error[lost, 5] ** 2).mean()
    return {
        "bodies": int(lost.sum()),
        "zones": [problem.zones[k].name for k in np.unique(drawn.zone[lost])],
        "fit": int(fit.sum()),
        "horizontal_m": float(np.sqrt(across)),
        "height_m": float(np.sqrt(up)),
    }


_PARTS = (("position", slice(3, 6), "m", 1.0), ("rotation", slice(3), "deg", 180 / np.pi))


def _zones(
    problem: Problem,
    zone: np.ndarray,
    error: FloatArray,
    bound: FloatArray,
    known: np.ndarray,
    kept: np.ndarray,
    seed: int,
) -> list[dict[str, Any]]:
    """Return a row for each zone: horizontal and heading errors, share within the limits."""
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
    """Return which pose errors (..., 6) are within the limits."""
    across = np.hypot(error[..., 3], error[..., 4]) <= limits.horizontal
    up, turn = np.abs(error[..., 5]) <= limits.height, np.abs(error[..., 2]) <= limits.heading
    return across & up & turn
