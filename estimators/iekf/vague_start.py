"""Find start poses of an update whose prior is vague about the rotation.

An update starts globally if the prior is vague in a direction that its epoch determines: at the
first epoch, and after a lost track. A direction that the epoch does not determine remains
uncertain, and needs no search.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.estimators.costs.map_problem import MapProblem, PoseState, minimize
from rbl_gym.estimators.costs.range_cost import RangeCost
from rbl_gym.estimators.linear.squared_range import statistic
from rbl_gym.estimators.locating.differences import places_of_differences
from rbl_gym.estimators.locating.rotation_net import ROTATION_NET
from rbl_gym.geometry import rotations
from rbl_gym.kernels.constants import VAGUE

_NET = rotations.log(ROTATION_NET)

# Function from a problem of trials (K, 1) to start poses (K, S, 3, 3), (K, S, 3).
Starts = Callable[[MapProblem], tuple[FloatArray, FloatArray]]


def is_vague(covariance: FloatArray) -> BoolArray:
    """Return whether (...) the largest variance of the rotation exceeds `VAGUE`."""
    limit = VAGUE
    # The trace bounds the largest eigenvalue, which suffices for most priors.
    if covariance.ndim == 2:
        trace = covariance.item(0, 0) + covariance.item(1, 1) + covariance.item(2, 2)
        if not trace > limit:
            return np.asarray(False)
    vague = np.asarray(
        covariance[..., 0, 0] + covariance[..., 1, 1] + covariance[..., 2, 2] > limit
    )
    if vague.any():
        vague[vague] = np.linalg.eigvalsh(covariance[vague, :3, :3])[..., -1] > limit
    return vague


def settles(problem: MapProblem, vague: BoolArray, batch: tuple[int, ...]) -> BoolArray:
    """Return whether (...) an epoch determines a direction in which its prior rotation is vague.

    This is so if the linear update leaves fewer vague directions than the prior has. It is computed
    at the prior position and one standard deviation from it on all sides, because the information
    of coplanar anchors vanishes in their plane. `problem` is that of the update by least squares:
    with a robust loss, poor fits would give little information. Checked are the trials `vague`
    (...), from `is_vague`; the others are False.
    """
    # A single trial has no axis to index, so one is added.
    axes = batch or (1,)
    where = np.broadcast_to(vague, axes)
    part = problem.take(axes, where)
    values, vectors = np.linalg.eigh(part.prior.covariance[:, 0, 3:, 3:])
    steps = np.swapaxes(vectors * np.sqrt(values)[..., None, :], -1, -2)
    offsets = np.concatenate([np.zeros_like(steps[:, :1]), steps, -steps], axis=1)
    places = part.prior.translation + offsets
    if isinstance(part.data, RangeCost) and part.data.offset is not None:
        # Differences give little information outside the anchors, where a vague prior may be.
        middle = part.data.anchors.mean(axis=-2)
        places = np.concatenate([places, np.broadcast_to(middle, places[:, :1].shape)], axis=1)
    told = part.data(part.prior.rotation, places).hessian
    left = _vague_directions(np.linalg.inv(part.prior_information + told))
    result = np.zeros(axes, np.bool_)
    result[where] = (left < _vague_directions(part.prior.covariance)).any(axis=-1)
    return result.reshape(batch)


def _vague_directions(covariance: FloatArray) -> np.ndarray:
    """Return the number (...) of vague principal axes of the rotation."""
    values = np.linalg.eigvalsh(covariance[..., :3, :3])
    return (values > VAGUE).sum(axis=-1)


def global_start(
    problem: MapProblem, vague: BoolArray, batch: tuple[int, ...], starts: Starts
) -> tuple[FloatArray, FloatArray]:
    """Return start poses: for vague priors the best solution from `starts`, else the prior."""
    # A single trial has no axis to index, so one is added for the search.
    axes = batch or (1,)
    rotation = np.broadcast_to(problem.prior.rotation, (*axes, 3, 3)).copy()
    translation = np.broadcast_to(problem.prior.translation, (*axes, 3)).copy()
    where = np.broadcast_to(vague, axes)
    part = problem.take(axes, where)
    found = minimize(part, *starts(part), 12, 1e-3)
    best = np.arange(len(found.at.cost)), np.argmin(found.at.cost, axis=1)
    rotation[where], translation[where] = found.rotation[best], found.translation[best]
    return rotation.reshape((*batch, 3, 3)), translation.reshape((*batch, 3))


def net_of_starts(problem: MapProblem) -> tuple[FloatArray, FloatArray]:
    """Return 24 start poses, whose rotations are spread over the prior on each axis.

    Their translations follow from the squared ranges and the prior, a linear problem. `problem` is
    one of ranges, with trials (K, 1).
    """
    rotation, data = spread(problem.prior), problem.data
    assert isinstance(data, RangeCost)
    if data.offset is None:
        return rotation, _translation_given(rotation, problem.prior, data)
    # For differences the linear problem gives little or no information: try other positions too.
    places = places_of_differences(data, ROTATION_NET)[:, :, None]
    places = places - (rotation @ data.tags.mean(axis=-2)[..., None])[..., 0][:, None]
    near: list[FloatArray] = [problem.prior.translation + np.zeros(rotation.shape[:-1])]
    if data.offset != "anchor":
        near.append(_translation_given(rotation, problem.prior, data))
    translation = np.concatenate([*near, *np.moveaxis(places, 1, 0)], axis=1)
    return np.tile(rotation, (1, translation.shape[1] // rotation.shape[1], 1, 1)), translation


def spread(prior: PoseState) -> FloatArray:
    """Return rotations (K, 24, 3, 3) around priors (K, 1), spread by the variance of each axis."""
    values, vectors = np.linalg.eigh(prior.covariance[..., :3, :3])
    # The variance of a fixed axis may round to less than zero.
    reach = np.minimum(np.sqrt(np.maximum(values, 0.0) / VAGUE), 1.0)
    shape = (vectors * reach[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return rotations.exp((_NET @ shape)[:, 0]) @ prior.rotation


def _translation_given(rotation: FloatArray, prior: PoseState, data: RangeCost) -> FloatArray:
    """Return translations (K, S, 3) from the linear squared-range model and the prior."""
    # To first order var(r^2) = 4 r^2 var(r); for differences r is unknown.
    pseudo = data.offset is not None
    scale = 1.0 if pseudo else 4 * np.where(data.weights > 0, data.ranges, 1.0) ** 2
    stat = statistic(data.ranges, data.anchors, data.tags, data.weights / scale, pseudo=pseudo)
    information = np.linalg.inv(prior.covariance[..., 3:, 3:])
    turned = data.tags @ np.swapaxes(rotation, -1, -2)
    of_tags = stat.b - (stat.G @ turned[..., None])[..., 0]
    right = (information @ prior.translation[..., None])[..., 0] + of_tags.sum(axis=-2)
    return np.linalg.solve(information + stat.G.sum(axis=-3), right[..., None])[..., 0]
