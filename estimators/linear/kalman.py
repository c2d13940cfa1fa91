"""The Kalman filters of the tracking paper on the 12 states ``x = [vec Q; t]``.

Source: S. P. Chepuri, A. Simonetto, G. Leus, A.-J. van der Veen, "Tracking position and
orientation of a mobile rigid body", CAMSAP 2013: KF (17)-(22), UC-KF (23)-(27), ET-KF (28),
KF-ortho Section V. The four are one filter with a different `constrain` step after the linear
update. The linear algebra below is filterpy's (one body) or the batched engine (any leading
axes); both read the statistic of `squared_range`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import (
    HUGE,
    BoolArray,
    FloatArray,
    all_finite,
    check_array,
    check_number,
    check_one_of,
)
from rbl_gym.estimators.filter import PoseBelief, register
from rbl_gym.estimators.inputs import (
    VAGUE_ENTRY_VARIANCE,
    check_batches,
    check_epoch,
    check_one_process,
    check_prior,
    epoch_variance,
    links_of_plain_epoch,
    plain,
)
from rbl_gym.estimators.linear.engines import (
    ENGINES,
    Batched,
    FilterPy,
    LinearEpoch,
    Motion,
    engine_for,
    is_vague,
    update_covariance,
    update_means,
    update_plain,
    weigh_plain,
)
from rbl_gym.estimators.linear.least_squares import unvec, vec
from rbl_gym.estimators.linear.squared_range import geometric_rank
from rbl_gym.estimators.linear.unitary import (
    constrained_belief,
    coupled_fit,
    decoupled_fit,
    projected_belief,
)
from rbl_gym.geometry import rotations
from rbl_gym.measurements.noise_laws import numbers_of
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

# Sizes of the parts of a belief, for kernels.
_SIZES = np.zeros(3), np.zeros(6)


class KalmanState(NamedTuple):
    """State of the family, with leading batch axes.

    Attributes
    ----------
    mean
        (..., 12), ``[vec Q; t]``, columns of Q first.
    covariance
        (..., 12, 12). It has fewer leading axes than the mean if it is the same for all
        trials: for one common prior, as long as anchors, weights, links and twists are common.
    constrained
        (...), whether the last update projected the rotation onto SO(3).
    """

    mean: FloatArray
    covariance: FloatArray
    constrained: BoolArray


@dataclass(frozen=True, eq=False)
class KalmanFamily:
    """A Kalman filter on squared ranges, with a constraint step (tracking paper, (16)-(28)).

    Parameters
    ----------
    tags
        (N, 3), metres, body frame. If their mean is zero, rotation and translation are decoupled.
    noise
        Noise law of the ranges; weights are computed from the measured ranges.
    process
        Process noise.
    constraint
        ``"none"`` KF, (17)-(22); ``"newton"`` UC-KF, (23)-(27): the rotation of the weighted
        problem (26), then the translation (27); ``"threshold"`` ET-KF: projection (28) if
        ``|Q^T Q - I|_F > threshold``; ``"always"`` KF-ortho, Section V: projection after every
        update. The next prediction starts from the projected rotation.
    sigma_q_scale
        Ratio of the process noise of an entry of Q to that of the rotation. The paper prints 1.
        With sqrt(2/3) the trace of the covariance of the nine entries is right; with sqrt(2) the
        variance of a rotation angle is right (docs/leaderboard.md).
    threshold
        Threshold of the event-triggered filter.
    coupled
        UC-KF only: solve the coupled problem (23) instead of (26)-(27). This is always done if
        the weights of the tags differ (lost links, per-link noise).
    weights
        Fixed inverse variances of the squared ranges [1/m^4], (M,) or (M, N); None: from the
        measured ranges.
    engine
        ``"auto"``: filterpy for one body, if no array has leading axes, batched otherwise.
        ``"batched"`` or ``"filterpy"``: always this one.
    """

    tags: FloatArray
    noise: NoiseLaw
    process: ProcessNoise
    constraint: str = "none"
    sigma_q_scale: float = 1.0
    threshold: float = 0.15
    coupled: bool = False
    weights: ArrayLike | None = None
    engine: str = "auto"

    def __post_init__(self) -> None:
        object.__setattr__(self, "tags", check_array("tags", self.tags, ("N", 3)))
        check_one_process(self.process)
        check_one_of("constraint", self.constraint, list(_CONSTRAINTS))
        check_one_of("engine", self.engine, list(ENGINES))
        check_number("sigma_q_scale", self.sigma_q_scale, low=0.0)
        check_number("threshold", self.threshold, low=0.0)
        if self.weights is not None:
            weights = check_array("weights", self.weights, ("M",))
            if (weights < 0).any():
                raise ValueError(f"weights must not be negative, got {weights.min()}")

    def initial(
        self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike
    ) -> KalmanState:
        """Return the state of a prior; covariance (..., 6, 6) of pose or (..., 12, 12) of state.

        A pose covariance becomes ``blkdiag(2/3 tr(P_w) I9, P_v)``: isotropic and of full rank.

        Raises
        ------
        ValueError
            If a shape is wrong, a matrix is not a rotation, or a covariance is not positive.
        """
        rotation, translation, covariance = check_prior(rotation, translation, covariance, (6, 12))
        if covariance.shape[-1] == 6:
            covariance = expand_covariance(covariance)
        batch = np.broadcast_shapes(
            rotation.shape[:-2], translation.shape[:-1], covariance.shape[:-2]
        )
        mean = np.empty((*batch, 12))
        mean[..., :9], mean[..., 9:] = vec(rotation), translation
        return KalmanState(mean, covariance.copy(), np.zeros(batch, bool))

    def predict(self, state: KalmanState, twist: ArrayLike, dt: float) -> KalmanState:
        """Return the state after `dt` seconds of the twist (..., 6), by (10)-(15)."""
        state = plain(state)
        twist = check_array("twist", twist, (6,))
        dt = check_number("dt", dt, low=0.0)
        engine = engine_for(self.engine, state=state.mean.shape[:-1], twist=twist.shape[:-1])
        motion = Motion(twist, dt, self._variance_rate)
        mean, covariance = engine.predict(state.mean, state.covariance, motion)
        return KalmanState(mean, covariance, np.zeros(mean.shape[:-1], bool))

    def update(
        self,
        state: KalmanState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> KalmanState:
        """Return the state after an epoch of ranges (..., M, N); `noise` None: the filter's law.

        Fixed weights of the filter take precedence over any law.

        Raises
        ------
        ValueError
            If a shape is wrong, a value is NaN, a range is not positive, or anchors and tags do
            not determine the 12 states and the covariance of the state is too large to
            compensate (the message gives the rank).
        """
        found = self._update_plain(state, ranges, anchors, links, noise)
        if found is not None:
            return found
        state = plain(state)
        ranges, anchors, mask = check_epoch(ranges, anchors, links, self.tags)
        self._check_determined(state, anchors)
        if self.weights is None:
            weights = 1 / epoch_variance(noise, self.noise, ranges, mask, squared=True)
        else:
            weights = self._fixed_weights(ranges)
        if state.mean.ndim > 1 or ranges.ndim > 2:
            check_batches(state=state.mean.shape[:-1], ranges=ranges.shape[:-2])
        if mask is not None:
            weights = np.where(mask, weights, 0.0)
        epoch = LinearEpoch(ranges, anchors, self.tags, weights)
        engine = engine_for(
            self.engine,
            state=state.mean.shape[:-1],
            ranges=ranges.shape[:-2],
            anchors=anchors.shape[:-2],
            weights=weights.shape[:-2],
        )
        mean, covariance = engine.update(state.mean, state.covariance, epoch)
        posterior = KalmanState(mean, covariance, np.zeros(mean.shape[:-1], bool))
        return _CONSTRAINTS[self.constraint](self, state, posterior, epoch)

    def _update_plain(
        self, state: KalmanState, ranges: ArrayLike, anchors: ArrayLike, links: Any, noise: Any
    ) -> KalmanState | None:
        """Return the KF update with a plain epoch, in few calls; None for other epochs.

        Other epochs need the general code, which also raises the errors.
        """
        if links is not None or noise is not None or self.constraint != "none":
            return None
        if self.weights is not None:
            return self._update_common(state, ranges, anchors)
        batch = state.mean.shape[:-1]
        if (
            state.covariance.shape[:-2] != batch
            or links_of_plain_epoch(ranges, anchors, self.tags, batch) is None
        ):
            return None
        law = numbers_of(self.noise, len(self.tags))
        if law is None:
            return None
        if engine_for(self.engine, state=batch) is Batched:
            mean, covariance = update_plain(
                state.mean, state.covariance, ranges, law, anchors, self.tags, VAGUE_ENTRY_VARIANCE
            )
            if not all_finite(mean):
                return None
        else:
            weights = weigh_plain(state.covariance, ranges, law, anchors, VAGUE_ENTRY_VARIANCE)
            if not (all_finite(weights) and all_finite(anchors)):
                return None
            epoch = LinearEpoch(np.asarray(ranges), np.asarray(anchors), self.tags, weights)
            mean, covariance = FilterPy.update(*plain(state)[:2], epoch)
        return KalmanState(mean, covariance, np.zeros(batch, bool))

    def _update_common(self, state: KalmanState, ranges: Any, anchors: Any) -> KalmanState | None:
        """Return the KF update of trials with one covariance, by fixed weights; None for others."""
        mean, P, _ = state
        if (
            mean.ndim != 2
            or P.ndim != 2
            or type(ranges) is not np.ndarray
            or ranges.shape[:-2] != mean.shape[:1]
            or not len(mean)
            or links_of_plain_epoch(ranges[0], anchors, self.tags, ()) is None
            or not np.vdot(anchors, anchors) < HUGE
            or engine_for(self.engine, state=mean.shape[:1]) is not Batched
        ):
            return None
        self._check_determined(state, anchors)
        weights = self._fixed_weights(ranges)
        if weights.ndim > 2:
            return None
        P = update_covariance(P, anchors, self.tags, weights)
        mean = update_means(mean, P, ranges, anchors, self.tags, weights)
        # The general code raises the error of a range.
        return KalmanState(mean, P, np.zeros(len(mean), bool)) if all_finite(mean) else None

    def _fixed_weights(self, ranges: FloatArray) -> FloatArray:
        """Return the weights of the filter, (M, 1) or (..., M, N), or raise ValueError."""
        weights = np.asarray(self.weights, dtype=np.float64)
        weights = weights[..., None] if weights.ndim == 1 else weights
        links = ranges.shape[-2:]
        if weights.shape[-2] != links[0] or weights.shape[-1] not in (1, links[1]):
            raise ValueError(f"weights must fit links {links}, got shape {weights.shape}")
        return weights

    def belief(self, state: KalmanState) -> PoseBelief:
        """Return the pose, its covariance, and the raw matrix (copies).

        The covariance is that of the projected output, ``J^+ P J^+T``. For UC-KF, whose mean is
        already constrained, it is ``(J^T P^-1 J)^-1``.
        """
        state = plain(state)
        form = constrained_belief if self.constraint == "newton" else projected_belief
        rotation, translation, covariance, matrix = form(state.mean, state.covariance, *_SIZES)
        if self.constraint in ("newton", "always"):
            matrix = rotation
        return PoseBelief(rotation, translation, covariance, matrix)

    @cached_property
    def _variance_rate(self) -> FloatArray:
        """Return the process noise (12,) of the state after 1 s."""
        std = self.process.std()
        sigma_q = self.sigma_q_scale * np.sqrt(np.mean(std[:3] ** 2))
        return np.concatenate([np.full(9, sigma_q**2), std[3:] ** 2])

    def _check_determined(self, state: KalmanState, anchors: FloatArray) -> None:
        vague = is_vague(state.covariance, anchors, VAGUE_ENTRY_VARIANCE)
        if not np.count_nonzero(vague):
            return
        rank = geometric_rank(anchors, self.tags)
        if ((rank < 12) & vague).any():
            raise ValueError(
                f"anchors and tags determine only rank {int(rank.min())} of the filter's 12 "
                "states (it needs 4 anchors and 4 tags, neither coplanar), and the prior is too "
                f"wide for the missing states; got {anchors.shape[-2]} anchors, "
                f"{self.tags.shape[-2]} tags. Use 'iekf', or a smaller prior covariance"
            )


# --- constraints on the rotation after the linear update --------------------


def _no_constraint(
    family: KalmanFamily, prior: KalmanState, posterior: KalmanState, epoch: LinearEpoch
) -> KalmanState:
    return posterior


def _project(posterior: KalmanState, where: BoolArray) -> KalmanState:
    mean = posterior.mean.copy()
    mean[..., :9] = np.where(
        where[..., None], vec(rotations.nearest(unvec(mean[..., :9]))), mean[..., :9]
    )
    return KalmanState(mean, posterior.covariance, where)


def _always(
    family: KalmanFamily, prior: KalmanState, posterior: KalmanState, epoch: LinearEpoch
) -> KalmanState:
    return _project(posterior, np.ones(posterior.mean.shape[:-1], bool))


def _above_threshold(
    family: KalmanFamily, prior: KalmanState, posterior: KalmanState, epoch: LinearEpoch
) -> KalmanState:
    matrix = unvec(posterior.mean[..., :9])
    defect = np.swapaxes(matrix, -1, -2) @ matrix - np.eye(3)
    return _project(posterior, np.asarray(np.linalg.norm(defect, axis=(-2, -1)) > family.threshold))


def _newton(
    family: KalmanFamily, prior: KalmanState, posterior: KalmanState, epoch: LinearEpoch
) -> KalmanState:
    """Solve UC-KF: (26)-(27) if all tags share their weights, else the coupled problem (23).

    The covariance remains that of the linear update, (22) as printed: an overestimate.
    """
    if epoch.weights.shape[-1] == 1 and not family.coupled:
        mean = decoupled_fit(prior.mean, prior.covariance, *epoch)
    else:
        mean = coupled_fit(posterior.mean, posterior.covariance)
    return KalmanState(mean, posterior.covariance, np.ones(mean.shape[:-1], bool))


_CONSTRAINTS: dict[str, Callable[..., KalmanState]] = {
    "none": _no_constraint,
    "newton": _newton,
    "threshold": _above_threshold,
    "always": _always,
}


# --- between 6 and 12 states ---------------------------------------------------------------


def expand_covariance(covariance: FloatArray) -> FloatArray:
    """Return the covariance of 12 states, ``blkdiag(2/3 tr(P_w) I9, P_v)``, of one (..., 6, 6)."""
    expanded = np.zeros((*covariance.shape[:-2], 12, 12))
    trace = np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1)
    index = np.arange(9)
    expanded[..., index, index] = (2 / 3) * trace[..., None]
    expanded[..., 9:, 9:] = covariance[..., 3:, 3:]
    return expanded


for _name, _constraint in {
    "kf": "none",
    "uc-kf": "newton",
    "et-kf": "threshold",
    "kf-ortho": "always",
}.items():
    register(_name, partial(KalmanFamily, constraint=_constraint))
