"""The iterated extended Kalman filter with directions of arrival, alone or beside ranges."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_one_of
from rbl_gym.estimators.costs.doa_cost import DoaCost, SumCost
from rbl_gym.estimators.costs.range_cost import Index, Loss, RangeCost, huber
from rbl_gym.estimators.costs.unseen_directions import kept_wide
from rbl_gym.estimators.filter import register
from rbl_gym.estimators.iekf.manifold import (
    IteratedEkf,
    MapProblem,
    PoseState,
    map_problem,
    posterior,
    update_in_blocks,
)
from rbl_gym.estimators.iekf.robust_update import HUBER
from rbl_gym.estimators.iekf.vague_start import best_start, global_start, is_vague, settles, spread
from rbl_gym.estimators.inputs import check_epoch, check_variance, spanned_dimensions
from rbl_gym.estimators.locating.doa_global import global_search
from rbl_gym.measurements import bearing
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

MEASUREMENTS = ("ranges", "doa")
# Trials that are updated at once.
_BLOCK = 512


@dataclass(frozen=True, eq=False)
class DoaEkf(IteratedEkf):
    """Iterated extended Kalman filter of the pose on directions of arrival at a base station.

    Parameters
    ----------
    tags, process, iterations, robust
        As `IteratedEkf`.
    noise
        Law of the angles.
    range_noise
        Law of the ranges, where an update is given some besides.
    """

    noise: Any  # bearing.AngleNoise, where the base class has a law of ranges
    range_noise: NoiseLaw | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.noise, bearing.AngleNoise):
            raise ValueError(f"noise must be a bearing.AngleNoise, got {self.noise!r:.80}")

    def update(  # pyright: ignore[reportIncompatibleMethodOverride]
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
        """State after one epoch of directions of arrival, and of ranges where there are any.

        Where the prior rotation is vague in a direction that the epoch determines, the update
        starts from the global solution of the angles and its alternatives besides (with fewer
        than three tags, or tags in a line, from rotations all over the prior); of mirror images
        the prior decides. What the epoch does not see stays as wide as it was.

        Parameters
        ----------
        angles
            (..., 2, N), radians (`rbl_gym.measurements.bearing`).
        station
            Place of the base station, (..., 3) or, as the one anchor, (..., 1, 3).
        links
            Mask (..., N) or (..., 1, N): which tags were heard; None: all.
        noise, range_noise
            Laws of the angles and of the ranges of this epoch; None: the filter's.
        ranges, anchors, range_links
            (..., M, N), (..., M, 3) and their mask, of the same epoch; anchors None: one range
            to every tag, from the station.

        Raises
        ------
        ValueError
            On wrong shapes, NaN, angles outside [0, pi], ranges without their law.
        """
        n_tags = self.tags.shape[-2]
        station = _check_station(station)
        heard = _check_heard(links, n_tags)
        if heard is not None:
            shape = np.broadcast_shapes(np.shape(angles), (*heard.shape[:-1], 1, n_tags))
            # What was not heard may hold anything.
            angles = np.where(heard[..., None, :], np.broadcast_to(angles, shape), 0.0)
        angles = bearing.check_angles(angles, n_tags)
        law = self.noise if noise is None else noise
        if not isinstance(law, bearing.AngleNoise):
            raise ValueError(f"noise must be a bearing.AngleNoise, or None, got {noise!r:.80}")
        weights = 1 / law.variance(angles)
        if heard is not None:
            weights = weights * heard[..., None, :]
        epoch, trailing = [*state, angles, weights, station], [2, 1, 2, 2, 2, 1]
        if ranges is not None:
            range_law = self.range_noise if range_noise is None else range_noise
            if range_law is None:
                raise ValueError("range_noise must be given to the filter that takes ranges")
            anchors = station[..., None, :] if anchors is None else anchors
            ranges, anchors, mask = check_epoch(ranges, anchors, range_links, self.tags)
            of_ranges = 1 / check_variance(range_law.variance(ranges, mask), mask)
            shape = np.broadcast_shapes(of_ranges.shape, ranges.shape)
            of_ranges = np.broadcast_to(of_ranges, shape)
            epoch += [ranges, of_ranges if mask is None else of_ranges * mask, anchors]
            trailing += [2, 2, 2]
        size = _BLOCK if self.tags.ndim == 2 else math.inf
        return update_in_blocks(self._update_angles, epoch, trailing, size)

    @functools.cached_property
    def _has_rotation(self) -> bool:
        return self.tags.shape[-2] > 2 and bool((spanned_dimensions(self.tags) > 1).all())

    def _update_angles(
        self,
        state: PoseState,
        angles: FloatArray,
        weights: FloatArray,
        station: FloatArray,
        *of_ranges: FloatArray,
    ) -> PoseState:
        """The update of one block of trials; `of_ranges`: ranges, their weights, the anchors."""

        def problem_by(loss: Loss | None) -> MapProblem:
            data: DoaCost | SumCost = DoaCost(angles, weights, self.tags, station, loss)
            if of_ranges:
                ranges, range_weights, anchors = of_ranges
                cost = RangeCost(ranges, range_weights, anchors, self.tags, loss, lift=self._lift)
                data = SumCost((data, cost))
            return map_problem(state, data)

        problem = problem_by(huber(HUBER) if self.robust else None)
        start = problem.prior.rotation, problem.prior.translation
        vague = is_vague(state.covariance)
        if vague.any():
            others = (array.shape[:-2] for array in (angles, weights, *of_ranges, self.tags))
            batch = np.broadcast_shapes(vague.shape, station.shape[:-1], *others)
            sought = settles(problem_by(None), vague, batch)
            if sought.any():
                search = _best_of_angles if self._has_rotation else _best_of_spread
                start = global_start(problem, sought, batch, search)
        heard = (weights > 0).any(axis=-2)
        if of_ranges:
            heard = heard | (of_ranges[1] > 0).any(axis=-2)
        return kept_wide(state, posterior(problem, *start, self.iterations), heard, self.tags)


def _best_of_angles(
    problem: MapProblem, batch: tuple[int, ...], where: Index
) -> tuple[FloatArray, FloatArray]:
    """The best solve from the prior, the global solution of the angles, and its alternatives."""
    part = problem.take(batch, where)
    data: Any = part.data.parts[0] if isinstance(part.data, SumCost) else part.data
    best, others = global_search(data.angles, data.weights, data.tags, None)
    missing = np.isinf(others.cost)
    rotation = np.where(missing[..., None, None], best.rotation[:, None], others.rotation)
    translation = np.where(missing[..., None], best.translation[:, None], others.translation)
    translation, shift = translation + data.station[:, None], best.translation + data.station
    return best_start(
        problem,
        batch,
        where,
        np.stack([*np.moveaxis(rotation, 1, 0), best.rotation, part.prior.rotation], axis=1),
        np.stack([*np.moveaxis(translation, 1, 0), shift, part.prior.translation], axis=1),
    )


def _best_of_spread(
    problem: MapProblem, batch: tuple[int, ...], where: Index
) -> tuple[FloatArray, FloatArray]:
    """The best solve from the prior's place, turned as far as the prior is wide."""
    prior = problem.take(batch, where).prior
    rotation = spread(prior)
    translation = np.broadcast_to(prior.translation[:, None], rotation.shape[:-1])
    return best_start(problem, batch, where, rotation, translation)


def _check_station(station: ArrayLike) -> FloatArray:
    """A place (..., 3) from that or from one anchor (..., 1, 3)."""
    place = check_array("station", station, (3,))
    return place[..., 0, :] if place.ndim > 1 and place.shape[-2] == 1 else place


def _check_heard(links: ArrayLike | None, n_tags: int) -> BoolArray | None:
    """The mask (..., N), or None where every tag was heard."""
    if links is None:
        return None
    mask = np.asarray(links)
    if mask.ndim > 1 and mask.shape[-2] == 1:
        mask = mask[..., 0, :]
    if mask.shape[-1:] != (n_tags,) or not np.isin(mask, (0, 1)).all():
        raise ValueError(f"links must be a mask (..., {n_tags}), got shape {mask.shape}")
    mask = mask.astype(np.bool_)
    return None if mask.all() else mask


def iterated_ekf(
    tags: FloatArray,
    noise: Any,
    process: ProcessNoise,
    iterations: int = 4,
    robust: bool = False,
    measurement: str = "ranges",
    range_noise: NoiseLaw | None = None,
) -> IteratedEkf:
    """The filter ``"iekf"``: `IteratedEkf` on ranges, `DoaEkf` on directions of arrival.

    Parameters
    ----------
    measurement
        ``"ranges"`` or ``"doa"``; `noise` is the law of what is measured.
    range_noise
        Of ``"doa"``: the law of ranges that an update may bring besides.
    tags, process, iterations, robust
        As `IteratedEkf`.
    """
    check_one_of("measurement", measurement, MEASUREMENTS)
    if measurement == "doa":
        return DoaEkf(tags, noise, process, iterations, robust, range_noise)
    if range_noise is not None:
        raise ValueError("range_noise must be None where noise is the law of the ranges")
    return IteratedEkf(tags, noise, process, iterations, robust)


register("iekf", iterated_ekf)
