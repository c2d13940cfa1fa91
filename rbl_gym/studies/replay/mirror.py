"""Test whether a mirror pose explains a recording equally well: track and compare both."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbl_gym.checks import BoolArray, FloatArray
from rbl_gym.geometry import mirror, rotations
from rbl_gym.measurements import offsets, ranging
from rbl_gym.recordings.recording import Recording

# Anchors are nearly coplanar if their distance from a plane is below this share of their width.
_THICK = 0.5
# The position in the plane is known if its standard deviation is below the first share of the size
# of the scene. Both poses start with the second share, and with this rotation (rad).
_KNOWN, _START, _START_RAD = 0.2, 0.1, 0.3
# Limit (rad) of the standard deviation of an undetermined rotation. It is below the value at
# which filters start a global search.
_MOST_RAD = 0.45
# Squared whitened residuals are clipped at this value, for both poses.
_MOST_RESIDUAL = 9.0
# Number of consistent ranges assumed before the first one.
_PRIOR_LINKS = 10.0
# Log odds below which a pose is excluded for good, and above which it is possible (3 sigma).
_DEAD, _ALIVE = -30.0, -4.5
# Log odds above which the ranges have decided.
DECIDED = 12.0
# Two poses differ if they are this many standard deviations apart. They are the same if their tags
# are within this share of the size of the scene for this many epochs in a row.
_APART = 3.0
_SAME, _SAME_EPOCHS = 5e-3, 20


class Mirror(NamedTuple):
    """The other pose after every epoch: rotation, translation (K, ...), covariance (K, 6, 6).

    `log_odds` (K,) compare the other pose with the track by all ranges so far; minus infinity if
    there is no other pose. They are scaled by the residuals of the better of the two. `alive` (K,)
    is True if the other pose explains the ranges as well and differs from the track. An image that
    later ranges excluded was alive before.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    log_odds: FloatArray
    alive: BoolArray


class _Two(NamedTuple):
    """A pose and its image, arrays (2, ...), after an epoch."""

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray


def other_pose(
    recording: Recording,
    filter: Any,
    range_std: float | None,
    track: tuple[FloatArray, FloatArray, FloatArray],
    volume: FloatArray | None = None,
) -> Mirror | None:
    """Return the mirror pose of a track, or None if the ranges exclude it at once.

    Only anchors and tags with ranges are used. The filter is an iterated EKF with the recording's
    tags and motion; `range_std` [m] None: the recording's own; `track` is rotation, translation and
    covariance (K, ...) of the beliefs; a pose outside of the corners (2, 3) of `volume` is not
    counted.
    """
    seen = recording.links.any(axis=0)
    measured = np.flatnonzero(seen.sum(axis=1))
    anchors = recording.anchors_by_epoch[0][measured]
    tags = recording.tags[np.flatnonzero(seen.sum(axis=0))]
    plane = mirror.plane_of(anchors)
    if plane.width < 1e-6 or plane.thickness > _THICK * plane.width:
        return None
    median = float(np.median(recording.ranges[recording.links]))
    size = max(float(np.ptp(anchors, axis=0).max()), median)
    start = _first_known(track[2], plane.normal, _KNOWN * size)
    if start is None:
        return None
    here = track[0][start], track[1][start]
    anchors = recording.anchors_by_epoch[start][measured]
    P = np.diag([_START_RAD**2] * 3 + [(_START * size) ** 2] * 3)
    there = mirror.mirror_pose(*here, P, anchors, tags)
    poses = _Two(
        np.stack([here[0], there[0]]), np.stack([here[1], there[1]]), np.stack([P, there[2]])
    )
    return _followed(recording, filter, range_std, track, volume, start, poses, _SAME * size)


def _first_known(covariance: FloatArray, normal: FloatArray, std: float) -> int | None:
    """Return the first epoch with a known position in the plane, in which both poses agree."""
    along = np.linalg.svd(normal[None])[2][1:]
    variance = along @ covariance[:, 3:, 3:] @ along.T
    known = np.linalg.eigvalsh(variance)[:, -1] < std**2
    return int(known.argmax()) if known.any() else None


def _followed(
    recording: Recording,
    filter: Any,
    range_std: float | None,
    track: tuple[FloatArray, FloatArray, FloatArray],
    volume: FloatArray | None,
    start: int,
    poses: _Two,
    same_m: float,
) -> Mirror | None:
    """Filter both poses from epoch `start` on, until the image is excluded."""
    count = len(recording.times)
    rotation, translation, covariance = (np.array(a) for a in track)
    odds_of, alive = np.full(count, -np.inf), np.zeros(count, dtype=np.bool_)
    result = Mirror(rotation, translation, covariance, odds_of, alive)
    gain, cost, links, same = np.zeros(2), np.zeros(2), _PRIOR_LINKS, 0
    state = filter.initial(*poses)
    spread = np.diag(filter.process.std() ** 2)
    hold = np.diag([_MOST_RAD**-2] * 3 + [0.0] * 3)
    for k in range(start, count):
        elapsed = recording.times[k] - recording.times[k - 1] if k > start else 0.0
        P = np.linalg.inv(np.linalg.inv(state.covariance + elapsed * spread) + hold)
        before = state._replace(covariance=0.5 * (P + P.swapaxes(1, 2)))
        std = recording.range_std[k] if range_std is None else range_std  # pyrefly: ignore[unsupported-operation]
        state, likelihood, spent = _update(filter, before, recording, k, std)
        gain += likelihood
        cost += spent
        links += recording.links[k].sum()
        scale = (2 * cost.min() + _PRIOR_LINKS) / links
        odds = float(gain[1] - gain[0]) / scale
        points = ranging.tag_positions(state.rotation, state.translation, recording.tags)
        same = same + 1 if np.abs(points[1] - points[0]).max() < same_m else 0
        if same == _SAME_EPOCHS:
            return None
        if odds < _DEAD:
            break
        # The track is at the nearer of the two poses.
        off = np.linalg.norm(state.translation - track[1][k], axis=-1)
        far = int(off[1] >= off[0])
        if far == 0 and odds > -_DEAD:
            # The track is at the image, and the first pose is excluded for good.
            break
        if volume is not None and is_outside(volume, state.translation[far], state.covariance[far]):
            continue
        for field, value in zip(result[:3], state, strict=True):
            field[k] = value[far]
        result.log_odds[k] = odds if far else -odds
        gap = state.translation[1] - state.translation[0]
        squared = gap @ np.linalg.solve(state.covariance[:, 3:, 3:].sum(axis=0), gap)
        result.alive[k] = result.log_odds[k] > _ALIVE and squared > _APART**2
    return result if result.alive.any() else None


def _update(
    filter: Any, before: Any, recording: Recording, k: int, std: FloatArray | float
) -> tuple[Any, FloatArray, FloatArray]:
    """Return both states (2,) after epoch `k`, their log evidence (Laplace), and their cost."""
    links, ranges = recording.links[k], recording.ranges[k]
    anchors = recording.anchors_by_epoch[k]
    told = np.where(links, std, 1.0)
    law = ranging.LinkNoise(told)
    state = filter.update(before, np.where(links, ranges, 1.0), anchors, links, noise=law)
    points = ranging.tag_positions(state.rotation, state.translation, recording.tags)
    residual = ranging.distances(anchors, points) - ranges
    if recording.offset is not None:
        residual = offsets.centred(residual, links / told**2, recording.offset)
    residual = residual / told
    squares = np.minimum(residual**2, _MOST_RESIDUAL) * links
    error = np.concatenate(
        [rotations.error(state.rotation, before.rotation), state.translation - before.translation],
        axis=-1,
    )
    pull = np.linalg.solve(before.covariance, error[..., None])[..., 0]
    cost = 0.5 * (squares.sum(axis=(1, 2)) + (error * pull).sum(axis=-1))
    volumes = [np.linalg.slogdet(P)[1] for P in (state.covariance, before.covariance)]
    return state, 0.5 * (volumes[0] - volumes[1]) - cost, cost


def covering(other: Mirror, track: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
    """Return covariances (K, 6, 6) of the track, which include both poses if both are alive.

    They are second moments about the pose of the track, each pose weighted by its odds. A belief
    that is already wide enough is unchanged.
    """
    rotation, translation, covariance = track
    step = np.concatenate(
        [rotations.error(rotation, other.rotation), translation - other.translation], axis=-1
    )
    pull = np.linalg.solve(covariance, step[..., None])[..., 0]
    sharp = np.einsum("ki,ki->k", step, pull) > _APART**2
    where = other.alive & sharp
    share = 1 / (1 + np.exp(-np.clip(other.log_odds, -50, 50)))[:, None, None]
    spread = other.covariance + step[..., None] * step[:, None]
    return np.where(where[:, None, None], (1 - share) * covariance + share * spread, covariance)


def is_outside(volume: FloatArray, translation: FloatArray, covariance: FloatArray) -> BoolArray:
    """Return whether positions (..., 3) are outside a box (2, 3) by more than three sigma."""
    margin = _APART * np.sqrt(np.einsum("...ii->...i", covariance)[..., 3:])
    off = (translation < volume[0] - margin) | (translation > volume[1] + margin)
    return np.asarray(off.any(axis=-1))
