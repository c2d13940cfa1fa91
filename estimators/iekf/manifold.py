"""The iterated extended Kalman filter on SO(3) x R^3 with raw ranges.

Every update is the maximum a posteriori pose of the epoch by Gauss-Newton, with the prior
residual ``log(Q Q_pred^T)``; it reaches the posterior Cramer-Rao bound, which the linear
filters of the tracking paper cannot, because they project ``|s|^2`` out.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    BoolArray,
    FloatArray,
    all_finite,
    check_array,
    check_count,
    check_duration,
    kernel,
)
from rbl_gym.estimators.costs.losses import SQUARES, huber
from rbl_gym.estimators.costs.map_problem import PoseState, map_problem
from rbl_gym.estimators.costs.range_cost import RangeCost
from rbl_gym.estimators.filter import PoseBelief
from rbl_gym.estimators.iekf.pose_steps import (
    WEIGHTS,
    as_state,
    predict_pose,
    update_pose,
    update_pose_near,
)
from rbl_gym.estimators.iekf.robust_update import check_robust
from rbl_gym.estimators.iekf.vague_start import (
    global_start,
    is_vague,
    net_of_starts,
    settles,
)
from rbl_gym.estimators.inputs import (
    check_batches,
    check_epoch,
    check_offset_epoch,
    check_prior,
    epoch_variance,
    links_of_plain_epoch,
    plain,
)
from rbl_gym.kernels.constants import HUBER
from rbl_gym.measurements import offsets, ranging
from rbl_gym.measurements.noise_laws import LinkNoise, WeakenedNoise, numbers_of
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

# With fewer ranges in an epoch, no search is made.
_FEWEST_SOUGHT = 3
_BOOL = np.dtype(np.bool_)
# Internal functions without checks: their arguments were checked, or made here.
_TAG_POSITIONS, _DISTANCES = kernel(ranging.tag_positions), kernel(ranging.distances)


@dataclass(frozen=True, eq=False)
class IteratedEkf:
    """Iterated extended Kalman filter of the pose on raw ranges.

    Parameters
    ----------
    tags
        (N, 3), metres, body frame; with leading axes for individual trials.
    noise
        Noise law of the ranges; variances are taken at the measured ranges.
    process
        Process noise; with leading axes for individual trials.
    iterations
        Gauss-Newton iterations of an update. With a single iteration the filter is overconfident if
        the rotation is noisy.
    robust
        Handling of ranges that do not fit. False: all ranges have full weight. True: Huber's loss
        on the whitened residuals (threshold 1.5), and ranges that contradict the others are
        rejected. ``"late"``, for ranges that are mostly too long: weights fall with the square of
        the residual, and are halved for ranges that are too long.
    offset
        The ranges of one ``"tag"`` (uplink time differences), ``"anchor"`` or ``"epoch"`` share an
        unknown offset, which is independent at every epoch. None: no offset. With an offset, ranges
        may be negative, and variances are taken at the distances of the prior.
    """

    tags: FloatArray
    noise: NoiseLaw
    process: ProcessNoise
    iterations: int = 4
    robust: bool | str = False
    offset: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "tags", check_array("tags", self.tags, ("N", 3)))
        check_count("iterations", self.iterations)
        check_robust(self.robust)
        offsets.check_offset(self.offset)

    @functools.cached_property
    def options(self) -> np.ndarray:
        """Return the options (3,) of `update_pose`."""
        codes = offsets.code_of(self.offset), self.iterations, check_robust(self.robust)
        return np.array(codes, np.int64)

    @functools.cached_property
    def _numbers(self) -> FloatArray | None:
        """Return the noise law as used by `update_pose`; None if it does not support it."""
        return numbers_of(self.noise, len(self.tags))

    @functools.cached_property
    def _variance(self) -> FloatArray:
        """Return the variances (..., 6) of the process noise after 1 s."""
        return self.process.std() ** 2

    def initial(
        self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike
    ) -> PoseState:
        """Return the state of a prior, covariance (..., 6, 6).

        Raises
        ------
        ValueError
            If a shape is wrong, a matrix is not a rotation, or a covariance is not positive.
        """
        rotation, translation, covariance = check_prior(rotation, translation, covariance, (6,))
        batch = np.broadcast_shapes(
            rotation.shape[:-2], translation.shape[:-1], covariance.shape[:-2]
        )
        return PoseState(
            np.full((*batch, 3, 3), rotation),
            np.full((*batch, 3), translation),
            np.full((*batch, 6, 6), covariance),
        )

    def predict(self, state: PoseState, twist: ArrayLike, dt: ArrayLike) -> PoseState:
        """Return the state after `dt` seconds (...) of the twist (..., 6), ``P <- F P F^T + Q``."""
        twist = check_array("twist", twist, (6,))
        dt = check_duration("dt", dt)
        if twist.ndim > 1 or type(dt) is not float or self._variance.ndim > 1:
            batches = {"twist": twist.shape[:-1], "dt": np.shape(dt)}
            batches["process"] = self._variance.shape[:-1]
            check_batches(state=state.translation.shape[:-1], **batches)
        rotation, translation, P = state
        return PoseState(*predict_pose(rotation, translation, P, twist, dt, self._variance))

    def update(
        self,
        state: PoseState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> PoseState:
        """Return the state after an epoch of ranges (..., M, N); `noise` None: the filter's law.

        If the prior rotation is vague in a direction that the epoch determines (first epoch, lost
        track), the update starts from many poses and keeps the best. Directions that the epoch does
        not determine keep their uncertainty. With coplanar anchors the mirror pose may explain the
        ranges equally well. Then only the prior can distinguish the two (`locate` lists both,
        ``"iekf-bank"`` follows both).

        Raises
        ------
        ValueError
            If a shape is wrong, a value is NaN, or a range is not positive.
        """
        found = self._update_plain(state, ranges, anchors, links, noise)
        if found is not None:
            return found
        state = plain(state)
        epoch = ranges, anchors, links, noise
        ranges, weights, anchors = self.weighed(*epoch, state)
        batch = state.translation.shape[:-1]
        check_batches(state=batch, ranges=ranges.shape[:-2])
        check_batches(state=batch, anchors=anchors.shape[:-2])
        start = self.start(state, ranges, weights, anchors)
        if self.offset is not None and start[0] is not state.rotation:
            weights = self.weighed(*epoch, PoseState(*start, state.covariance))[1]
        return as_state(
            *update_pose(
                *state, ranges, weights, WEIGHTS, anchors, self.tags, *start, self.options
            )[:3]
        )

    def _update_plain(
        self, state: PoseState, ranges: ArrayLike, anchors: ArrayLike, links: Any, noise: Any
    ) -> PoseState | None:
        """Return the update with a plain epoch, in few calls; None for other epochs.

        Other epochs and vague priors need the general code, which also raises the errors.
        `update_pose_near` checks the values.
        """
        if self.offset is not None:
            return None
        (rotation, translation, P), tags = state, self.tags
        shares, numbers = links_of_plain_epoch(ranges, anchors, tags, P.shape[:-2]), self._numbers
        if shares is not None and (links is not None or noise is not None):
            shares, numbers = self._plain_law(ranges, links, noise)  # pyrefly: ignore[bad-argument-type]
        if shares is None or numbers is None:
            return None
        # Arguments one by one: unpacking them takes a tenth of the time of the call.
        rotation, translation, P = update_pose_near(
            rotation, translation, P, ranges, shares, numbers, anchors, tags, self.options
        )
        # One number of each trial suffices.
        if not all_finite(P[..., 0, 0] if P.ndim > 2 else P[0, 0]):
            return None
        return PoseState(rotation, translation, P)

    def _plain_law(
        self, ranges: FloatArray, links: Any, noise: Any
    ) -> tuple[FloatArray | None, FloatArray | None]:
        """Return shares and law for `update_pose`; None if the general code must compute them."""
        if type(links) is not np.ndarray or links.dtype != _BOOL or links.shape != ranges.shape:
            return None, None
        if type(noise) is LinkNoise and noise.std_m.shape == ranges.shape and noise.std_m.min() > 0:
            return links / (noise.std_m * noise.std_m), WEIGHTS
        share: Any = 1.0
        law = self.noise
        if type(noise) is WeakenedNoise and noise.share.shape == ranges.shape[:-1]:
            law, share = noise.law, noise.share[..., None]
        elif noise is not None:
            return None, None
        numbers = numbers_of(law, len(self.tags))
        if numbers is None or numbers.item(3) >= 0:
            # The range of a reference tag may be lost.
            return None, None
        return links * share, numbers

    def weighed(
        self,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None,
        noise: NoiseLaw | None,
        state: Any,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return a checked epoch: ranges, weights (inverse variances, 0 if lost), and anchors.

        For ranges with offsets, the `state` gives the distances for the variances.
        """
        ranges, variance, anchors, mask = self.measured(state, ranges, anchors, links, noise)
        if variance.shape[-2:] != ranges.shape[-2:]:
            variance = np.broadcast_to(variance, np.broadcast_shapes(variance.shape, ranges.shape))
        return ranges, 1 / variance if mask is None else mask / variance, anchors

    def measured(
        self, state: Any, ranges: Any, anchors: Any, links: Any, noise: NoiseLaw | None
    ) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray | None]:
        """Return a checked epoch: ranges, variances, anchors, and links (None: all measured)."""
        if self.offset is None:
            ranges, anchors, mask = check_epoch(ranges, anchors, links, self.tags)
            return ranges, epoch_variance(noise, self.noise, ranges, mask), anchors, mask
        ranges, anchors, mask = check_offset_epoch(ranges, anchors, links, self.tags, self.offset)
        places = _TAG_POSITIONS(state.rotation, state.translation, self.tags)
        distance = _DISTANCES(anchors, places)
        distance = np.broadcast_to(distance, np.broadcast_shapes(distance.shape, ranges.shape))
        return ranges, epoch_variance(noise, self.noise, distance, mask), anchors, mask

    def start(
        self, state: PoseState, ranges: FloatArray, weights: FloatArray, anchors: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the start of an update with a checked epoch: the prior, or a search result."""
        sought = self.is_sought(state, ranges, weights, anchors)
        if not sought.any():
            return state.rotation, state.translation
        # With late ranges, least squares would reach a wrong local minimum.
        late = self.robust == "late" or (self.robust and self.offset is not None)
        loss = huber(HUBER) if late else SQUARES
        problem = map_problem(state, self._cost(ranges, weights, anchors, loss=loss))
        return global_start(problem, sought, sought.shape, net_of_starts)

    def is_sought(
        self, state: PoseState, ranges: FloatArray, weights: FloatArray, anchors: FloatArray
    ) -> BoolArray:
        """Return whether (...) an update starts from many poses (`vague_start`)."""
        vague = is_vague(state.covariance)
        if not vague.any():
            return vague
        # So few ranges leave a curve of poses, and a search would pick an arbitrary one.
        vague = vague & ((weights > 0).sum(axis=(-2, -1)) >= _FEWEST_SOUGHT)
        if not vague.any():
            return vague
        data = self._cost(ranges, weights, anchors)
        batch = np.broadcast_shapes(vague.shape, state.translation.shape[:-1], data.batch)
        return settles(map_problem(state, data), vague, batch)

    def _cost(
        self,
        ranges: FloatArray,
        weights: FloatArray,
        anchors: FloatArray,
        loss: FloatArray = SQUARES,
    ) -> RangeCost:
        return RangeCost(ranges, weights, anchors, self.tags, loss, offset=self.offset)

    def belief(self, state: PoseState) -> PoseBelief:
        """Return the state as a belief (copies)."""
        rotation, translation, P = state
        rotation = rotation.copy()
        return PoseBelief(rotation, translation.copy(), P.copy(), rotation)
