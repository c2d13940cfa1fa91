"""Where an update starts from when its prior says little about the rotation.

An update starts globally where the prior is vague in a direction that its epoch determines: at a
first epoch, and after a track was lost. A direction that the epoch does not see stays wide, and
needs no search. Arguments named `problem` are `manifold.MapProblem`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.costs.levenberg_marquardt import minimize_pose
from rbl_gym.estimators.costs.range_cost import Index
from rbl_gym.estimators.linear.squared_range import statistic
from rbl_gym.estimators.locating.rotation_net import ROTATION_NET
from rbl_gym.geometry import rotations

# Beyond this standard deviation (rad) of the prior rotation, no single linearisation is right.
VAGUE_ROTATION_RAD = 0.5
# Starts that are solved from at once.
_BLOCK = 1024


def is_vague(covariance: FloatArray) -> BoolArray:
    """Where (...) the rotation's largest variance is above that of `VAGUE_ROTATION_RAD`."""
    limit = VAGUE_ROTATION_RAD**2
    # The trace bounds the largest eigenvalue: most priors need no more.
    vague = np.asarray(np.einsum("...ii->...", covariance[..., :3, :3]) > limit)
    if vague.any():
        vague[vague] = np.linalg.eigvalsh(covariance[vague, :3, :3])[..., -1] > limit
    return vague


def settles(problem: Any, vague: BoolArray, batch: tuple[int, ...]) -> BoolArray:
    """Where (...) an epoch determines a direction in which its prior rotation is vague.

    That is where the linear update leaves fewer vague directions than there were. It is tried at
    the prior's place and one standard deviation from it to all sides: what anchors in a plane tell
    vanishes in that plane.

    Parameters
    ----------
    problem
        The problem of the update, of least squares: by a loss, what misfits there tells little.
    vague
        Trials (...) to be looked at, by `is_vague`; the others are False.
    batch
        Leading axes of the problem.
    """
    # A trial alone has no axis to index: it gets one.
    axes = batch or (1,)
    where = np.broadcast_to(vague, axes).nonzero()
    prior = problem.take(axes, where).prior
    values, vectors = np.linalg.eigh(prior.covariance[..., 3:, 3:])
    steps = np.swapaxes(vectors * np.sqrt(values)[..., None, :], -1, -2)
    offsets = np.concatenate([np.zeros_like(steps[:, :1]), steps, -steps], axis=1)
    count = offsets.shape[1]
    tried = problem.take(axes, tuple(np.repeat(axis, count) for axis in where))
    places = prior.translation[:, None] + offsets
    told = tried.data(tried.prior.rotation, places.reshape(-1, 3)).hessian
    left = _vague_directions(np.linalg.inv(tried.prior_information + told))
    result = np.zeros(axes, np.bool_)
    fewer = left < _vague_directions(tried.prior.covariance)
    result[where] = fewer.reshape(-1, count).any(axis=-1)
    return result.reshape(batch)


def _vague_directions(covariance: FloatArray) -> np.ndarray:
    """How many (...) principal axes of the rotation are vague."""
    values = np.linalg.eigvalsh(covariance[..., :3, :3])
    return (values > VAGUE_ROTATION_RAD**2).sum(axis=-1)


_NET = rotations.log(ROTATION_NET)


def global_start(
    problem: Any,
    vague: BoolArray,
    batch: tuple[int, ...],
    best_of: Callable[..., tuple[FloatArray, FloatArray]],
) -> tuple[FloatArray, FloatArray]:
    """Poses to start from: for vague priors what `best_of` finds, else the prior.

    `best_of` takes the problem, the batch, and where in it the trials stand.
    """
    # A trial alone has no axis to index: it gets one for the search.
    axes = batch or (1,)
    rotation = np.broadcast_to(problem.prior.rotation, (*axes, 3, 3)).copy()
    translation = np.broadcast_to(problem.prior.translation, (*axes, 3)).copy()
    trials = np.broadcast_to(vague, axes).nonzero()
    size = 1 + _BLOCK // len(_NET)
    for start in range(0, len(trials[0]), size):
        where = tuple(axis[start : start + size] for axis in trials)
        rotation[where], translation[where] = best_of(problem, axes, where)
    return rotation.reshape((*batch, 3, 3)), translation.reshape((*batch, 3))


def best_of_net(
    problem: Any, batch: tuple[int, ...], where: Index
) -> tuple[FloatArray, FloatArray]:
    """The best local solve (K, 3, 3), (K, 3) of the trials at an index into the batch.

    The net is 24 rotations spread as far as the prior is wide on each axis; every one gets
    the translation that the squared ranges and the prior imply (a linear problem), then a few
    Gauss-Newton steps on the full cost.
    """
    part = problem.take(batch, where)
    rotation = spread(part.prior)
    translation = _translation_given(rotation, part)
    return best_start(problem, batch, where, rotation, translation)


def best_start(
    problem: Any,
    batch: tuple[int, ...],
    where: Index,
    rotation: FloatArray,
    translation: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """The best local solve (K, 3, 3), (K, 3) from S starts (K, S, 3, 3), (K, S, 3) each."""
    count = rotation.shape[1]
    # Every start is a trial of its own, so that calls run over all of them.
    starts = problem.take(batch, tuple(np.repeat(axis, count) for axis in where))
    solution = minimize_pose(
        starts, rotation.reshape(-1, 3, 3), translation.reshape(-1, 3), 12, tolerance=1e-3
    )
    cost = solution.at.cost.reshape(-1, count)
    best = np.arange(len(cost)) * count + np.argmin(cost, axis=1)
    return solution.rotation[best], solution.translation[best]


def spread(prior: Any) -> FloatArray:
    """Rotations (K, 24, 3, 3) around priors (K, ...), on each axis as far as it is uncertain."""
    values, vectors = np.linalg.eigh(prior.covariance[..., :3, :3])
    reach = np.minimum(np.sqrt(values) / VAGUE_ROTATION_RAD, 1.0)
    shape = (vectors * reach[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return rotations.exp(_NET @ shape) @ prior.rotation[:, None]


def _translation_given(rotation: FloatArray, problem: Any) -> FloatArray:
    """Translations (K, 24, 3) of the linear squared-range model with its prior, given rotations."""
    data = problem.data
    # To first order var(r^2) = 4 r^2 var(r).
    scale = 4 * np.where(data.weights > 0, data.ranges, 1.0) ** 2
    stat = statistic(data.ranges, data.anchors, data.tags, data.weights / scale)
    information = np.linalg.inv(problem.prior.covariance[..., 3:, 3:])
    tags = data.tags if data.tags.ndim == 2 else data.tags[:, None]
    turned = tags @ np.swapaxes(rotation, -1, -2)
    per_tag = stat.b[:, None] - (stat.G[:, None] @ turned[..., None])[..., 0]
    held = information @ problem.prior.translation[..., None]
    right = held + np.swapaxes(per_tag.sum(axis=-2), -1, -2)
    solved = np.linalg.solve(information + stat.G.sum(axis=-3), right)
    return np.swapaxes(solved, -1, -2)
