"""Bank of iterated EKFs that starts without a prior pose, detects divergence and restarts.

One hypothesis is the leader. Its rivals run in parallel until their likelihood ratio decides.
`locate` supplies rivals, mirror poses included, if the prior is vague or if recent ranges
contradict the leader. Trials without rivals cost the same as the iterated EKF.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbl_gym.checks import BoolArray, FloatArray, check_array, check_number
from rbl_gym.estimators.bank.hypotheses import (
    SAME,
    BankState,
    alone,
    distance,
    flat,
    leader_of,
    of_batch,
    rivals_of,
    rows_of,
    with_best,
    with_rivals,
)
from rbl_gym.estimators.costs.map_problem import PoseState
from rbl_gym.estimators.filter import PoseBelief, register
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.iekf.pose_steps import WEIGHTS, as_state, update_pose
from rbl_gym.estimators.inputs import check_batches, check_one_process, plain, spanned_dimensions
from rbl_gym.estimators.locating.localization import locate
from rbl_gym.geometry.rotations import error as rotation_error
from rbl_gym.measurements.ranging import LinkNoise, NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise

# Forgetting factor per epoch of the fading window: about three epochs count.
_FORGET = 0.3
# Squared whitened innovation per link, over the window, above which the leader is doubted. A
# consistent filter has 1, within this many standard deviations. A robust filter with a fifth of
# the ranges wrong has 2.8 and still works.
_DEVIATIONS, _MOST_STRAIN = 6.0, 4.0
# Prior log odds that a filter has diverged at a given epoch.
_LOST = -10.0
# Rivals with log odds against their leader below this are dropped.
_BEATEN = -12.0
# Rivals with log odds against their leader below this (3 sigma) do not widen its belief.
_ALIVE = -4.5
# A pose has six degrees of freedom: fewer ranges do not determine it.
_FEWEST_LINKS = 6


class _Scored(NamedTuple):
    """A pose after an update, and the cost of the epoch at it, prior included."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    cost: FloatArray


@dataclass(frozen=True, eq=False)
class IteratedEkfBank:
    """A bank of iterated EKFs on raw ranges: several poses, each with its probability.

    Parameters
    ----------
    tags, noise, process, iterations, robust
        As `IteratedEkf`.
    volume
        Corners (2, 3), metres, of the box that contains the body's origin. It excludes mirror poses
        and bounds the search for a lost body. None: anywhere near the anchors.
    """

    tags: FloatArray
    noise: NoiseLaw
    process: ProcessNoise
    iterations: int = 4
    robust: bool | str = False
    volume: ArrayLike | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "tags", self._filter.tags)
        check_one_process(self.process)
        if self.tags.ndim != 2:
            raise ValueError(f"tags must have shape (N, 3), got {self.tags.shape}")
        if self.volume is not None:
            volume = check_array("volume", self.volume, (2, 3))
            if volume.shape != (2, 3) or (volume[0] > volume[1]).any():
                corners = "[lower corner, upper corner], shape (2, 3)"
                raise ValueError(f"volume must be {corners}, got {volume.tolist()!s:.80}")
            object.__setattr__(self, "volume", volume)

    @functools.cached_property
    def _filter(self) -> IteratedEkf:
        return IteratedEkf(self.tags, self.noise, self.process, self.iterations, self.robust)

    def initial(
        self, rotation: ArrayLike, translation: ArrayLike, covariance: ArrayLike
    ) -> BankState:
        """Return the state of a prior.

        For an unknown pose, give a covariance that covers all possible poses.

        Raises
        ------
        ValueError
            As in `IteratedEkf.initial`.
        """
        return alone(self._filter.initial(rotation, translation, covariance))

    def predict(self, state: BankState, twist: ArrayLike, dt: float) -> BankState:
        """Return the state after `dt` seconds of the twist (..., 6), for all hypotheses."""
        state = plain(state)
        twist, dt = check_array("twist", twist, (6,)), check_number("dt", dt, low=0.0)
        leader = self._filter.predict(leader_of(state), twist, dt)
        batch = leader.translation.shape[:-1]
        state = flat(state._replace(**leader._asdict()), batch)
        where = np.isfinite(state.log_odds).nonzero()
        if len(where[0]):
            twists = np.broadcast_to(twist, (*batch, 6)).reshape(-1, 6)[where[0]]
            state = with_rivals(
                state, where, self._filter.predict(rivals_of(state, where), twists, dt)
            )
        return of_batch(state, batch)

    def update(
        self,
        state: BankState,
        ranges: ArrayLike,
        anchors: ArrayLike,
        links: ArrayLike | None = None,
        noise: NoiseLaw | None = None,
    ) -> BankState:
        """Return the state after one epoch of ranges (..., M, N).

        Hypotheses are weighted, added and dropped. `noise` is the noise model of this epoch; None:
        that of the filter.

        Raises
        ------
        ValueError
            As in `IteratedEkf.update`.
        """
        state = plain(state)
        ranges, weights, anchors = self._filter.weighed(ranges, anchors, links, noise, state)
        check_batches(state=state.log_odds.shape[:-1], ranges=ranges.shape[:-2])
        batch = np.broadcast_shapes(
            state.log_odds.shape[:-1], ranges.shape[:-2], weights.shape[:-2], anchors.shape[:-2]
        )
        prior = flat(state, batch)
        epoch = _Epoch(*(rows_of(a, batch) for a in (ranges, weights, anchors)))
        led = self._scored(leader_of(prior), epoch)
        as_state(*led[:3])
        count = (epoch.weights > 0).sum(axis=(-2, -1))
        state = prior._replace(
            rotation=led.rotation,
            translation=led.translation,
            covariance=led.covariance,
            nis=(1 - _FORGET) * prior.nis + 2 * led.cost,
            links=(1 - _FORGET) * prior.links + count,
        )
        state = self._weigh_rivals(prior, state, led, epoch)
        strained = state.nis > self._bearable(state.links)
        if self.volume is not None:
            strained |= self._is_outside(led.translation, led.covariance)
        vague = self._filter.is_sought(leader_of(prior), *epoch)
        if self._is_line:
            # The update of the leader has already searched; `locate` finds nothing more.
            vague = np.zeros_like(vague)
        lost = np.flatnonzero((strained | vague) & (count >= _FEWEST_LINKS))
        if len(lost):
            state = self._look_around(prior, state, led, epoch, lost, vague)
        return of_batch(self._elect(state), batch)

    def belief(self, state: BankState) -> PoseBelief:
        """Return the leader's pose with a covariance that covers the live rivals (copies).

        The covariance is the second moment of all hypotheses about the leader, weighted by their
        probabilities. Rivals with log odds below `_ALIVE` are left out. `probabilities` returns
        the probabilities; the state holds the leader's own covariance.
        """
        state = plain(state)
        belief = self._filter.belief(leader_of(state))
        odds = np.where(state.log_odds > _ALIVE, state.log_odds, -np.inf)
        if np.isneginf(odds).all():
            return belief
        weight = np.exp(odds)[..., None, None]
        turn = rotation_error(state.rotation[..., None, :, :], state.rival_rotation)
        shift = state.translation[..., None, :] - state.rival_translation
        gap = np.concatenate([turn, shift], axis=-1)
        spread = weight * (state.rival_covariance + gap[..., None] * gap[..., None, :])
        whole = belief.covariance + spread.sum(axis=-3)
        return belief._replace(covariance=whole / (1 + weight.sum(axis=-3)))

    def probabilities(self, state: BankState) -> FloatArray:
        """Return the probabilities (..., 1 + K) of the leader and of each rival."""
        odds = np.exp(np.concatenate([np.zeros_like(state.nis)[..., None], state.log_odds], -1))
        return odds / odds.sum(axis=-1, keepdims=True)

    def _bearable(self, links: FloatArray) -> FloatArray:
        """Return the limits (...) of the sum of squared whitened innovations of a leader."""
        most = _MOST_STRAIN * links
        return most if self.robust else np.minimum(most, links + _DEVIATIONS * np.sqrt(2 * links))

    def _scored(
        self, prior: PoseState, epoch: _Epoch, start: tuple[FloatArray, FloatArray] | None = None
    ) -> _Scored:
        """Return the update of trials (B,) and its cost, NaN if it has none."""
        start = start or self._filter.start(prior, *epoch)
        return _Scored(
            *update_pose(
                *prior,
                epoch.ranges,
                epoch.weights,
                WEIGHTS,
                epoch.anchors,
                self.tags,
                *start,
                self._filter.options,
            )
        )

    def _weigh_rivals(
        self, prior: BankState, state: BankState, led: _Scored, epoch: _Epoch
    ) -> BankState:
        """Update the rivals and their odds by the epoch, and drop unlikely ones."""
        where = np.isfinite(prior.log_odds).nonzero()
        if not len(where[0]):
            return state
        rows = where[0]
        before = rivals_of(prior, where)
        scored = self._scored(before, epoch.take(rows))
        of_leader = _log_likelihood(prior.covariance[rows], _Scored(*(a[rows] for a in led)))
        odds = prior.log_odds[where] + _log_likelihood(before.covariance, scored) - of_leader
        after = PoseState(*scored[:3])
        same = distance(after, PoseState(*(a[rows] for a in led[:3]))) < SAME
        log_odds = prior.log_odds.copy()
        log_odds[where] = np.where(same | (odds < _BEATEN), -np.inf, odds)
        return with_rivals(state._replace(log_odds=log_odds), where, after)

    def _look_around(
        self,
        prior: BankState,
        state: BankState,
        led: _Scored,
        epoch: _Epoch,
        rows: np.ndarray,
        vague: BoolArray,
    ) -> BankState:
        """Find new rivals of some trials (R,) from their ranges alone."""
        part = epoch.take(rows)
        if self._is_line:
            rotation, translation, known = self._searched(state.rotation[rows], part)
        else:
            rotation, translation, known = self._candidates(part)
        trial, _ = known.nonzero()
        rotation, translation = rotation[known], translation[known]
        wide = self._anywhere(rotation, part.anchors[trial])
        own = vague[rows][trial]
        before = PoseState(
            *(
                np.where(own.reshape(-1, *[1] * n), old[rows][trial], new)
                for old, new, n in zip(leader_of(prior), wide, (2, 1, 2), strict=True)
            )
        )
        nis = state.nis.copy()
        nis[rows] = state.links[rows]
        state = state._replace(nis=nis)
        if not len(trial):
            return state
        scored = self._scored(before, part.take(trial), (rotation, translation))
        # No candidate may have a finite cost if anchors are so far apart that rounding dominates.
        found = np.isfinite(scored.cost)
        if not found.any():
            return state
        known[known] = found
        trial, own = trial[found], own[found]
        scored = _Scored(*(a[found] for a in scored))
        before = PoseState(*(a[found] for a in before))
        leader = _Scored(*(a[rows] for a in led))
        odds = _log_likelihood(before.covariance, scored)
        odds -= _log_likelihood(prior.covariance[rows], leader)[trial]
        odds += np.where(own, 0.0, _LOST)
        after = PoseState(*scored[:3])
        odds[distance(after, PoseState(*(a[trial] for a in leader[:3]))) < SAME] = -np.inf
        if self.volume is not None:
            odds[self._is_outside(after.translation, after.covariance)] = -np.inf
            # A leader outside the volume is no reference; the best candidate is used instead.
            best = np.full(len(rows), -np.inf)
            np.maximum.at(best, trial, odds)
            out = self._is_outside(leader.translation, leader.covariance) & np.isfinite(best)
            odds -= np.where(out, best, 0.0)[trial]
        odds[odds < _BEATEN] = -np.inf
        return with_best(state, rows, np.nonzero(known), known.shape[1], after, odds)

    def _candidates(self, epoch: _Epoch) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return poses (R, C, 3, 3), (R, C, 3) that explain the ranges, and which are valid."""
        links = epoch.weights > 0
        noise = LinkNoise(1 / np.sqrt(np.where(links, epoch.weights, 1.0)))
        method = "robust" if self.robust else "ml"
        found = locate(epoch.ranges, epoch.anchors, self.tags, noise, method, links)
        others = found.alternatives
        rotation = np.concatenate([found.rotation[:, None], others.rotation], axis=1)
        translation = np.concatenate([found.translation[:, None], others.translation], axis=1)
        known = np.isfinite(np.concatenate([found.cost[:, None], others.cost], axis=1))
        known &= np.isfinite(translation).all(axis=-1) & (found.rank == 6)[:, None]
        return rotation, translation, known

    @functools.cached_property
    def _is_line(self) -> bool:
        """Return whether the tags are collinear, so that ranges do not determine the pose."""
        return bool(spanned_dimensions(self.tags) < 2)

    def _searched(
        self, rotation: FloatArray, epoch: _Epoch
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return one candidate each, as `_candidates`, by a filter update with a vague prior."""
        found = self._scored(self._anywhere(rotation, epoch.anchors), epoch)
        known = np.isfinite(found.cost)
        return found.rotation[:, None], found.translation[:, None], known[:, None]

    def _anywhere(self, rotation: FloatArray, anchors: FloatArray) -> PoseState:
        """Return priors (K,) with unknown rotation and the known bounds of the position."""
        if self.volume is None:
            low, high = anchors.min(axis=-2), anchors.max(axis=-2)
        else:
            low, high = np.broadcast_to(self.volume, (len(rotation), 2, 3)).swapaxes(0, 1)
        reach = np.maximum(np.linalg.norm(high - low, axis=-1), 1.0)
        variance = np.empty((len(rotation), 6))
        variance[:, :3], variance[:, 3:] = math.pi**2, np.square(reach)[:, None]
        return PoseState(rotation, 0.5 * (low + high), variance[..., None] * np.eye(6))

    def _is_outside(self, translation: FloatArray, covariance: FloatArray) -> BoolArray:
        """Return whether (...) a position is over three standard deviations outside the volume."""
        low, high = self.volume  # pyrefly: ignore[not-iterable]
        margin = 3 * np.sqrt(np.einsum("...ii->...i", covariance)[..., 3:])
        off = (translation < low - margin) | (translation > high + margin)
        return np.asarray(off.any(axis=-1))

    def _elect(self, state: BankState) -> BankState:
        """Return the state with the most likely hypothesis as the leader."""
        log_odds = state.log_odds
        if not np.isfinite(log_odds).any():
            return state
        against = np.zeros(len(log_odds))
        if self.volume is not None:
            outside = self._is_outside(state.rival_translation, state.rival_covariance)
            log_odds = np.where(outside, -np.inf, log_odds)
            # Any rival inside the volume replaces a leader outside.
            against[self._is_outside(state.translation, state.covariance)] = -np.inf
        best = np.argmax(log_odds, axis=-1)
        rows = np.flatnonzero(log_odds[np.arange(len(best)), best] > against)
        if not len(rows):
            return state._replace(log_odds=log_odds)
        slot = best[rows]
        fields = {"log_odds": log_odds.copy(), "nis": state.nis.copy()}
        won = log_odds[rows, slot]
        fields["log_odds"][rows] -= won[:, None]
        # A hypothesis excluded by the volume does not return.
        fields["log_odds"][rows, slot] = np.where(np.isinf(against[rows]), -np.inf, -won)
        fields["nis"][rows] = state.links[rows]
        for name in PoseState._fields:
            leading, rival = getattr(state, name).copy(), getattr(state, f"rival_{name}").copy()
            leading[rows], rival[rows, slot] = rival[rows, slot], leading[rows]
            fields[name], fields[f"rival_{name}"] = leading, rival
        fields["log_odds"][fields["log_odds"] < _BEATEN] = -np.inf
        return state._replace(**fields)


class _Epoch(NamedTuple):
    """Ranges (B, M, N), weights (B, M, N), anchors (B, M, 3)."""

    ranges: FloatArray
    weights: FloatArray
    anchors: FloatArray

    def take(self, rows: np.ndarray) -> _Epoch:
        return _Epoch(*(array[rows] for array in self))


def _log_likelihood(before: FloatArray, scored: _Scored) -> FloatArray:
    """Return the log evidence (...) of an epoch by Laplace's method, up to a shared constant."""
    determinants = [np.linalg.slogdet(P)[1] for P in (scored.covariance, before)]
    return -scored.cost + 0.5 * (determinants[0] - determinants[1])


register("iekf-bank", IteratedEkfBank)
