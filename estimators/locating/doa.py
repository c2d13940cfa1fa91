"""Localization from directions of arrival at a single base station.

`locate_doa` is the entry point; every method is a function of a flat `DoaEpoch`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym import bounds
from rbl_gym.checks import (
    FloatArray,
    are_finite,
    check_array,
    check_generator,
    check_number,
    check_one_of,
)
from rbl_gym.estimators.costs.doa_cost import DoaCost
from rbl_gym.estimators.inputs import spanned_dimensions
from rbl_gym.estimators.locating.doa_global import global_search
from rbl_gym.estimators.locating.doa_newton import Places, newton_iteration, unit_quaternion
from rbl_gym.estimators.locating.localization import PoseEstimate
from rbl_gym.estimators.locating.locators import Fit, covariance_of
from rbl_gym.estimators.locating.maximum_likelihood import Alternatives, no_alternatives
from rbl_gym.estimators.locating.swarm import ParticipatorySearch, ParticleSwarm, search_places
from rbl_gym.measurements import bearing

# Below this length, squares are lost in rounding.
_SMALLEST_BODY_M = 1e-50
HALF_SPACES: dict[str | None, float | None] = {"y>0": 1.0, "y<0": -1.0, None: None}
# Trials of a block, for Newton's iteration and for methods with many starts per trial. Their
# arrays fit in the processor's cache.
_BLOCK, _BLOCK_OF_STARTS = 1024, 64


class DoaEpoch(NamedTuple):
    """Checked arrays of B trials relative to the base station, and options of the methods.

    angles (B, 2, N), weights (B, 2, N) [1/rad^2], tags (B, N, 3); `side`: sign of y or None.
    """

    angles: FloatArray
    weights: FloatArray
    tags: FloatArray
    side: float | None
    distance_weight: float | None
    rng: np.random.Generator


def locate_doa(
    angles: ArrayLike,
    tags: ArrayLike,
    method: str = "ml",
    noise: bearing.AngleNoise = bearing.AngleNoise(),  # noqa: B008 (frozen)
    half_space: str | None = None,
    station: ArrayLike | None = None,
    *,
    distance_weight: float | None = None,
    rng: np.random.Generator | None = None,
) -> PoseEstimate:
    """Estimate the pose of a body from one epoch of directions of arrival; batched.

    Parameters
    ----------
    angles
        (..., 2, N) radians: to the x axis, then to the z axis (`rbl_gym.measurements.bearing`).
    tags
        (..., N, 3), positions in the body frame, metres; three or more, not collinear.
    method
        ``"ml"``: maximum likelihood, the global optimum. ``"nia"``: Newton's iteration on the
        positions of the tags, then the unit quaternion method (DOA paper). ``"pso"``, ``"psa"``:
        the paper's competitors, particle swarm optimisation and the participatory search
        algorithm over the distances of the tags (`rbl_gym.estimators.locating.swarm`).
    noise
        Noise model of the angles, by default 0.1 degrees. Covariance and alternatives depend on
        it.
    half_space
        Known side of the base station's xz plane on which the mean of the tags lies: ``"y>0"`` or
        ``"y<0"``. None: found from the handedness of the body, which needs four tags that are not
        coplanar.
    station
        Position (..., 3) of the base station; None: the origin.
    distance_weight
        For ``nia``: weight of a distance error, radians per metre; None: scale-free.
    rng
        For ``pso`` and ``psa``; None: seed 0.

    Returns
    -------
    A `PoseEstimate`. `cost` is half the sum of squared whitened angles. `alternatives` (for
    ``ml``) are poses within 3 sigma of the best: mirror images that neither `half_space` nor
    the geometry excludes (three tags, coplanar tags, y close to 0). The pose is NaN if ``nia``
    diverged.

    Raises
    ------
    ValueError
        If shapes are wrong, values are NaN, angles are outside [0, pi], there are fewer than three
        tags or they are collinear, or the method or half-space is unknown.
    """
    check_one_of("method", method, list(METHODS))
    if not isinstance(half_space, str | None) or half_space not in HALF_SPACES:
        raise ValueError(f"half_space must be 'y>0', 'y<0' or None, got {half_space!r}")
    if not isinstance(noise, bearing.AngleNoise):
        raise ValueError(f"noise must be a bearing.AngleNoise, got {noise!r:.80}")
    rng = np.random.default_rng(0) if rng is None else check_generator("rng", rng)
    if distance_weight is not None:
        distance_weight = check_number("distance_weight", distance_weight, low=1e-12)
    tags = check_array("tags", tags, ("N", 3))
    if tags.shape[-2] < 3 or (spanned_dimensions(tags) < 2).any():
        count = tags.shape[-2]
        raise ValueError(
            "tags must be at least 3 and not on one line, got "
            f"{f'{count} on one line' if count > 2 else count}"
        )
    spans = np.ptp(tags, axis=-2).max(axis=-1)
    if (spans < _SMALLEST_BODY_M).any():
        raise ValueError(
            f"tags must be at least {_SMALLEST_BODY_M:g} m apart, got {spans.min():g} m: are they "
            "in metres?"
        )
    angles = bearing.check_angles(angles, tags.shape[-2])
    where = np.zeros(3) if station is None else check_array("station", station, (3,))
    batch = np.broadcast_shapes(angles.shape[:-2], tags.shape[:-2], where.shape[:-1])

    def flat(array: FloatArray, trailing: int) -> FloatArray:
        shape = array.shape[array.ndim - trailing :]
        return np.broadcast_to(array, (*batch, *shape)).reshape(-1, *shape)

    epoch = DoaEpoch(
        flat(angles, 2),
        1 / noise.variance(flat(angles, 2)),
        flat(tags, 2),
        HALF_SPACES[half_space],
        distance_weight,
        rng,
    )
    size = _BLOCK if method == "nia" else _BLOCK_OF_STARTS
    blocks = [
        _solve(METHODS[method], _rows(epoch, slice(start, start + size)))
        for start in range(0, len(epoch.angles), size)
    ]
    fields = [np.concatenate(parts) for parts in zip(*blocks, strict=True)]
    origin = flat(where, 1)
    fields[1] = fields[1] + origin
    fields[7] = fields[7] + origin[:, None]
    fields = [field.reshape((*batch, *field.shape[1:])) for field in fields]
    rotation, translation, covariance, cost, converged, rank, *others, iterations = fields
    return PoseEstimate(
        rotation, translation, covariance, cost, converged, rank, Alternatives._make(others),
        matrix=rotation, iterations=iterations,
    )  # fmt: skip


def _rows(epoch: DoaEpoch, rows: slice) -> DoaEpoch:
    return epoch._replace(
        angles=epoch.angles[rows], weights=epoch.weights[rows], tags=epoch.tags[rows]
    )


def _solve(method: Callable[[DoaEpoch], Fit], epoch: DoaEpoch) -> tuple[np.ndarray, ...]:
    """Return the fields of a `PoseEstimate` (three for alternatives, no matrix) of one block."""
    found = method(epoch)
    known = are_finite(found.translation, 1) & are_finite(found.rotation, 2)
    cost, information = found.cost, found.information
    if cost is None or information is None:
        at = DoaCost(epoch.angles, epoch.weights, epoch.tags, np.zeros(3))(
            np.where(known[:, None, None], found.rotation, np.eye(3)),
            np.where(known[:, None], found.translation, np.ones(3)),
        )
        cost, information = np.where(known, at.cost, np.inf), at.hessian
    rank = np.where(known, bounds.information_rank(information), 0)
    others = found.alternatives or no_alternatives(len(known))
    iterations = np.zeros(len(known), int) if found.iterations is None else found.iterations
    return (
        found.rotation, found.translation, found.covariance, cost, found.converged, rank, *others,
        iterations,
    )  # fmt: skip


# --- methods -------------------------------------------------------------------------------


def _ml(epoch: DoaEpoch) -> Fit:
    solution, alternatives = global_search(epoch.angles, epoch.weights, epoch.tags, epoch.side)
    return Fit(
        solution.rotation, solution.translation, covariance_of(solution.at.hessian),
        solution.converged, solution.at.cost, solution.at.hessian, alternatives,
    )  # fmt: skip


def _nia(epoch: DoaEpoch) -> Fit:
    return fit_of_places(epoch, newton_iteration(epoch.angles, epoch.tags, epoch.distance_weight))


def fit_of_places(epoch: DoaEpoch, places: Places) -> Fit:
    """Fit the body to the positions of its tags, or to their mirror image across y = 0.

    Use the known side, or else the side with the better fit. The covariance is that of maximum
    likelihood at the pose, from the noise of the angles alone.
    """
    known = are_finite(places.positions, 2)
    positions = np.where(known[:, None, None], places.positions, epoch.tags)
    if epoch.side is not None:
        wrong = epoch.side * positions[..., 1].mean(axis=-1) < 0
        positions = np.where(wrong[:, None, None], bearing.MIRROR * positions, positions)
        rotation, translation = unit_quaternion(positions, epoch.tags)
    else:
        both = np.stack([positions, bearing.MIRROR * positions], axis=1)
        rotation, translation = unit_quaternion(both, epoch.tags[:, None])
        turned = epoch.tags[:, None] @ np.swapaxes(rotation, -1, -2) + translation[..., None, :]
        better = np.argmin(((turned - both) ** 2).sum(axis=(-2, -1)), axis=1)
        row = np.arange(len(better))
        rotation, translation = rotation[row, better], translation[row, better]
    at = DoaCost(epoch.angles, epoch.weights, epoch.tags, np.zeros(3))(rotation, translation)
    blank = np.where(known, 1.0, np.nan)
    return Fit(
        rotation * blank[:, None, None],
        translation * blank[:, None],
        covariance_of(at.hessian) * blank[:, None, None],
        places.converged & known,
        np.where(known, at.cost, np.inf),
        at.hessian,
        iterations=places.iterations,
    )


def _searched(search: ParticleSwarm | ParticipatorySearch, epoch: DoaEpoch) -> Fit:
    std = epoch.weights.min(axis=(-2, -1)) ** -0.5
    return fit_of_places(epoch, search_places(search, epoch.angles, epoch.tags, std, epoch.rng))


METHODS: dict[str, Callable[[DoaEpoch], Fit]] = {
    "ml": _ml,
    "nia": _nia,
    "pso": partial(_searched, ParticleSwarm()),
    "psa": partial(_searched, ParticipatorySearch()),
}
