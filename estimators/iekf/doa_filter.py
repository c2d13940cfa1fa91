"""The iterated extended Kalman filter with directions of arrival, alone or with ranges."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array
from rbl_gym.estimators.costs.doa_cost import DoaCost, SumCost
from rbl_gym.estimators.costs.losses import LATE, SQUARES, huber
from rbl_gym.estimators.costs.map_problem import (
    MapProblem,
    PoseState,
    map_problem,
    minimize,
    positive_inverse,
)
from rbl_gym.estimators.costs.range_cost import RangeCost
from rbl_gym.estimators.costs.unseen_directions import kept_wide
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.iekf.pose_steps import as_state
from rbl_gym.estimators.iekf.vague_start import global_start, is_vague, settles, spread
from rbl_gym.estimators.inputs import check_epoch, check_variance, spanned_dimensions
from rbl_gym.estimators.locating.doa_global import global_search
from rbl_gym.kernels.constants import HUBER
from rbl_gym.measurements import bearing
from rbl_gym.measurements.ranging import NoiseLaw


@dataclass(frozen=True, eq=False)
class DoaEkf(IteratedEkf):
    """Iterated extended Kalman filter of the pose on directions of arrival at a base station.

    Parameters
    ----------
    tags, process, iterations, robust
        As in `IteratedEkf`; the loss of angles is Huber's.
    noise
        Noise law of the angles.
    range_noise
        Noise law of ranges, if an update also has ranges.
    offset
        None: angles have no unknown offset.
    """

    noise: Any  # bearing.AngleNoise, the base class has a law of ranges
    range_noise: NoiseLaw | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.noise, bearing.AngleNoise):
            raise ValueError(f"noise must be a bearing.AngleNoise, got {self.noise!r:.80}")
        if self.offset is not None:
            raise ValueError(f"offset must be None for angles, got {self.offset!r:.80}")

    def update(  # pyrefly: ignore[bad-override-param-name]
        self,
        state: PoseState,
        angles: ArrayLike,
        station: ArrayLike,
        links: ArrayLike | None = None,
        noise: bearing.AngleNoise | None = None,
        *,
        ranges: ArrayLike | None = None,
        anchors: ArrayLike | None = None,
        range_links: ArrayLike | None = None,
        range_noise: NoiseLaw | None = None,
    ) -> PoseState:
        """Return the state after one epoch of directions of arrival, and of ranges if given.

        If the prior rotation is vague in a direction that the epoch determines, the update also
        starts from the global solution of the angles and its alternatives. With fewer than three
        tags, or collinear tags, it starts from rotations spread over the prior. The prior decides
        between mirror images. Directions that the epoch does not determine keep their uncertainty.

        Parameters
        ----------
        angles
            (..., 2, N), radians (`rbl_gym.measurements.bearing`).
        station
            Position of the base station, (..., 3) or, as a single anchor, (..., 1, 3).
        links
            Mask (..., N) or (..., 1, N): which tags were received; None: all.
        noise, range_noise
            Laws of the angles and of the ranges of this epoch; None: the laws of the filter.
        ranges, anchors, range_links
            (..., M, N), (..., M, 3) and their mask, of the same epoch; anchors None: one range
            to every tag, from the station.

        Raises
        ------
        ValueError
            If a shape is wrong, a value is NaN, an angle is outside [0, pi], or ranges have no law.
        """
        n_tags = self.tags.shape[-2]
        station = _check_station(station)
        heard = _check_heard(links, n_tags)
        if heard is not None:
            shape = np.broadcast_shapes(np.shape(angles), (*heard.shape[:-1], 1, n_tags))
            # Entries that were not received may have any value.
            angles = np.where(heard[..., None, :], np.broadcast_to(angles, shape), 0.0)
        angles = bearing.check_angles(angles, n_tags)
        law = self.noise if noise is None else noise
        if not isinstance(law, bearing.AngleNoise):
            raise ValueError(f"noise must be a bearing.AngleNoise, or None, got {noise!r:.80}")
        weights = 1 / law.variance(angles)
        if heard is not None:
            weights = weights * heard[..., None, :]
        loss = huber(HUBER) if self.robust else SQUARES
        measured = (weights > 0).any(axis=-2)
        of_angles = DoaCost(angles, weights, self.tags, station, loss)
        data: DoaCost | SumCost = of_angles
        if ranges is not None:
            range_law = self.range_noise if range_noise is None else range_noise
            if range_law is None:
                raise ValueError(
                    "range_noise must be given, to the filter or to this update, if there are "
                    "ranges"
                )
            anchors = station[..., None, :] if anchors is None else anchors
            ranges, anchors, mask = check_epoch(ranges, anchors, range_links, self.tags)
            of_ranges = 1 / check_variance(range_law.variance(ranges, mask), mask)
            shape = np.broadcast_shapes(of_ranges.shape, ranges.shape)
            of_ranges = np.broadcast_to(of_ranges, shape)
            of_ranges = of_ranges if mask is None else of_ranges * mask
            of_late = LATE if self.robust == "late" else loss
            measured = measured | (of_ranges > 0).any(axis=-2)
            data = SumCost((of_angles, RangeCost(ranges, of_ranges, anchors, self.tags, of_late)))
        problem = map_problem(state, data)
        found = minimize(problem, *self._start(problem, data), self.iterations)
        covariance = positive_inverse(found.at.hessian)
        pose = as_state(found.rotation, found.translation, covariance)
        return kept_wide(state, pose, measured, self.tags)

    @functools.cached_property
    def _has_rotation(self) -> bool:
        return self.tags.shape[-2] > 2 and bool((spanned_dimensions(self.tags) > 1).all())

    def _start(self, problem: MapProblem, data: DoaCost | SumCost) -> tuple[FloatArray, FloatArray]:
        """Return the prior, or a search result if it is vague in a determined direction."""
        vague = is_vague(problem.prior.covariance)
        if not vague.any():
            return problem.prior.rotation, problem.prior.translation
        batch = np.broadcast_shapes(vague.shape, data.batch)
        plain = dataclasses.replace(problem, data=data.with_loss(SQUARES))
        sought = settles(plain, vague, batch)
        if not sought.any():
            return problem.prior.rotation, problem.prior.translation
        starts = _starts_of_angles if self._has_rotation else _spread_of_prior
        return global_start(problem, sought, batch, starts)


def _starts_of_angles(problem: MapProblem) -> tuple[FloatArray, FloatArray]:
    """Return poses (K, S, ...): the prior, the global solution of the angles, its alternatives.

    `problem`: trials (K, 1).
    """
    prior, data = problem.prior, problem.data
    of_angles: Any = data.parts[0] if isinstance(data, SumCost) else data
    angles = of_angles.angles[:, 0], of_angles.weights[:, 0], of_angles.tags[:, 0]
    best, others = global_search(*angles, None)
    missing = np.isinf(others.cost)
    rotation = np.where(missing[..., None, None], best.rotation[:, None], others.rotation)
    translation = np.where(missing[..., None], best.translation[:, None], others.translation)
    translation = np.concatenate([translation, best.translation[:, None]], axis=1)
    return (
        np.concatenate([rotation, best.rotation[:, None], prior.rotation], axis=1),
        np.concatenate([translation + of_angles.station, prior.translation], axis=1),
    )


def _spread_of_prior(problem: MapProblem) -> tuple[FloatArray, FloatArray]:
    """Return poses (K, S, ...) at the prior position, with rotations spread over the prior."""
    rotation = spread(problem.prior)
    return rotation, np.broadcast_to(problem.prior.translation, rotation.shape[:-1])


def _check_station(station: ArrayLike) -> FloatArray:
    """Return a position (..., 3), from this shape or from one anchor (..., 1, 3)."""
    place = check_array("station", station, (3,))
    return place[..., 0, :] if place.ndim > 1 and place.shape[-2] == 1 else place


def _check_heard(links: ArrayLike | None, n_tags: int) -> BoolArray | None:
    """Return the mask (..., N), or None if every tag was received."""
    if links is None:
        return None
    mask = np.asarray(links)
    if mask.ndim > 1 and mask.shape[-2] == 1:
        mask = mask[..., 0, :]
    if mask.shape[-1:] != (n_tags,):
        raise ValueError(f"links must have shape (..., {n_tags}), got {mask.shape}")
    if not (right := np.isin(mask, (0, 1))).all():
        raise ValueError(f"links must be True (measured) or False, got {mask[~right][0]}")
    mask = mask.astype(np.bool_)
    return None if mask.all() else mask
