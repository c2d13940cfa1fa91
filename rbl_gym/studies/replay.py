"""A recording through a filter: the same estimators on real radios."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import estimators, metrics, motion
from rbl_gym.checks import FloatArray, check_number
from rbl_gym.estimators.filter import check_takes_noise
from rbl_gym.geometry import rotations
from rbl_gym.geometry.mirror import mirror_pose
from rbl_gym.measurements import ranging
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.recordings.reading import Recording
from rbl_gym.studies.replay_mirror import DECIDED, Mirror, covering, is_outside, other_pose
from rbl_gym.studies.replay_truth import (
    Judged,
    check_overlap,
    fault_hints,
    judged_of,
    matched,
    stamp_hints,
)

# What the planar constraint leaves to height (m), roll and pitch (rad).
_PLANAR_STD = 1e-3
# Coordinates beyond this are those of a map.
_MAP_M = 1e4
# How much wider than the belief its mirror image starts.
_IMAGE_RAD, _IMAGE_M = 0.1, 0.2
# How many extents of the anchors away from them the bank looks where the volume has no limit.
_REACH = 10.0
# Heights of anchors within this much are one plane.
_PLANE_M = 0.1


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a recording is filtered.

    Parameters
    ----------
    filter
        Name of the filter.
    range_std_m
        Standard deviation of a range; None: the recording's own where it has one, else
        `DEFAULT_RANGE_STD_M`, which covers link biases that change with the pose.
    walk_m, walk_deg
        No twist is known: the pose is a random walk of this standard deviation after 1 s.
    robust
        Huber's loss (the iterated EKFs only).
    bias_std_m, bias_time_s, bias_common_m
        Law of the links' biases (`rbl_gym.measurements.link_bias.LinkBias`), of the filter
        ``"iekf-bias"``.
    accel_m, accel_deg
        Of the filter ``"iekf-cv"``: how much speed (m/s) and turn rate (deg/s) change in 1 s.
    planar
        Hold height, roll and pitch by a tight prior.
    height_offset_m
        How far the tags' mean height lies below the anchors' (planar only). None: the same height,
        which anchors in one plane alone can mean.
    yaw_offset_deg
        Constant turn of the tag table against the truth's body frame: the yaw error is
        estimate - (truth + offset).
    volume
        Where the body's origin may be: xmin, xmax, ymin, ymax, zmin, zmax in metres, None where
        there is no limit. It tells a pose from its mirror image.
    below_anchors
        The body stays below the anchors' mean height.
    truth_gap_s
        Longest gap, of the truth or of the ranges, that is bridged to compare the two.
    """

    filter: str = "iekf"
    range_std_m: float | None = None
    walk_m: float = 0.1
    walk_deg: float = 7.0
    robust: bool = True
    bias_std_m: float = 0.02
    bias_time_s: float | None = 3.0
    bias_common_m: float = 0.0
    accel_m: float = 0.5
    accel_deg: float = 30.0
    planar: bool = False
    height_offset_m: float | None = None
    yaw_offset_deg: float = 0.0
    volume: tuple[float | None, ...] | None = None
    below_anchors: bool = False
    truth_gap_s: float = 0.5

    def __post_init__(self) -> None:
        if self.range_std_m is not None:
            check_number("range_std_m", self.range_std_m, low=1e-6)
        check_number("walk_m", self.walk_m, low=0.0)
        check_number("walk_deg", self.walk_deg, low=0.0)
        LinkBias(self.bias_std_m, self.bias_time_s, self.bias_common_m)
        check_number("accel_m", self.accel_m, low=0.0)
        check_number("accel_deg", self.accel_deg, low=0.0)
        if check_number("height_offset_m", self.height_offset_m or 0.0) != 0 and not self.planar:
            raise ValueError("height_offset_m means nothing without planar")
        check_number("yaw_offset_deg", self.yaw_offset_deg)
        check_number("truth_gap_s", self.truth_gap_s, low=0.0)
        if self.volume is not None:
            object.__setattr__(self, "volume", _six_limits(self.volume))


DEFAULT_RANGE_STD_M = 0.12


def _six_limits(volume: Any) -> tuple[float | None, ...]:
    limits = tuple(volume)
    if len(limits) != 6:
        raise ValueError(
            f"volume must be xmin, xmax, ymin, ymax, zmin, zmax, got {len(limits)} numbers"
        )
    limits = tuple(None if x is None else check_number("volume", x) for x in limits)
    for axis, low, high in zip("xyz", limits[::2], limits[1::2], strict=True):
        if low is not None and high is not None and low >= high:
            raise ValueError(f"volume must have {axis}min below {axis}max, got {low:g}, {high:g}")
    return limits


class Track(NamedTuple):
    """Beliefs after every epoch: times (K,), rotation, translation, covariance (K, 6, 6).

    `other`: the mirror pose where one explains the ranges too; the covariance covers it then.
    """

    times: FloatArray
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    other: Mirror | None = None


def run(
    recording: Recording, settings: Settings, advance: Callable[[], None] = lambda: None
) -> Track:
    """Filter a recording causally, epoch by epoch; `advance` is called after each.

    Where a mirror pose explains the ranges as well, the belief covers both (`replay_mirror`).
    """
    beliefs = []
    for _, belief in steps(recording, settings, make_filter(recording, settings)):
        beliefs.append(belief)
        advance()
    track = track_of(recording, beliefs)
    if settings.planar:
        # Height, roll and pitch are held: they tell the sides apart.
        return track
    std = None
    if not _has_own_std(recording, settings):
        std = settings.range_std_m or DEFAULT_RANGE_STD_M
    judge = named_filter(recording, settings, "iekf", {"robust": settings.robust})
    poses = track[1:4]
    other = other_pose(recording, judge, std, poses, volume_of(recording, settings))
    if other is None:
        return track
    return track._replace(covariance=covering(other, poses), other=other)


def steps(
    recording: Recording, settings: Settings, filter: estimators.Filter
) -> Iterator[tuple[Any, estimators.PoseBelief]]:
    """State and belief of a filter after every epoch of a recording, started from nothing.

    Standard deviations that the recording reports itself are the law of their epoch. A belief
    outside the settings' volume starts again from its mirror image, where that is inside.
    Coordinates of a map are taken relative to the anchors; beliefs are of the world.
    """
    origin = origin_of(recording)
    local = recording._replace(anchors=recording.anchors - origin)
    volume = volume_of(recording, settings)
    volume = None if volume is None else volume - origin
    state = filter.initial(*_prior(local, settings, volume))
    before = local.times[0]
    for k, now in enumerate(local.times):
        if now > before:
            state = filter.predict(state, np.zeros(6), now - before)
        epoch = local.ranges[k], local.anchors, local.links[k]
        law = {}
        if _has_own_std(local, settings):
            law["noise"] = ranging.LinkNoise(local.range_std[k])
        state = filter.update(state, *epoch, **law)
        belief = filter.belief(state)
        if volume is not None and (image := _image_inside(local, belief, volume)) is not None:
            state = filter.update(filter.initial(*image), *epoch, **law)
            belief = filter.belief(state)
        yield state, belief._replace(translation=belief.translation + origin)
        before = now


def _image_inside(
    recording: Recording, belief: estimators.PoseBelief, volume: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """The mirror image of a belief that is outside the volume, if that is inside; widened."""
    if not is_outside(volume, belief.translation, belief.covariance):
        return None
    image = mirror_pose(*belief[:3], recording.anchors, recording.tags)
    if is_outside(volume, *image[1:]):
        return None
    # Of anchors nearly in a plane the image is near the best pose, not at it.
    widened = image[2] + np.diag([_IMAGE_RAD**2] * 3 + [_IMAGE_M**2] * 3)
    return image[0], image[1], widened


def origin_of(recording: Recording) -> FloatArray:
    """Where coordinates (3,) are taken from: the origin, or for those of a map the anchors."""
    if np.abs(recording.anchors).max() < _MAP_M:
        return np.zeros(3)
    return np.round(recording.anchors.mean(axis=0))


def volume_of(recording: Recording, settings: Settings) -> FloatArray | None:
    """Corners (2, 3) of where the body may be, infinite where there is no limit; None: anywhere."""
    if settings.volume is None and not settings.below_anchors:
        return None
    limits = settings.volume or (None,) * 6
    low = [-np.inf if x is None else x for x in limits[::2]]
    high = [np.inf if x is None else x for x in limits[1::2]]
    if settings.below_anchors:
        seen = recording.links.any(axis=(0, 2))
        high[2] = min(high[2], float(recording.anchors[seen, 2].mean()))
    return np.array([low, high])


def range_std_of(recording: Recording, settings: Settings) -> float | str:
    """The standard deviation of a range [m], or ``"recorded"`` where each has its own."""
    if settings.range_std_m is not None:
        return settings.range_std_m
    return "recorded" if _has_own_std(recording, settings) else DEFAULT_RANGE_STD_M


def _has_own_std(recording: Recording, settings: Settings) -> bool:
    return settings.range_std_m is None and recording.range_std is not None


def track_of(recording: Recording, beliefs: list[estimators.PoseBelief]) -> Track:
    """Beliefs after every epoch as arrays."""
    return Track(
        recording.times,
        np.array([belief.rotation for belief in beliefs]),
        np.array([belief.translation for belief in beliefs]),
        np.array([belief.covariance for belief in beliefs]),
    )


def make_filter(recording: Recording, settings: Settings) -> estimators.Filter:
    """The named filter with the recording's tags, a random walk and the range noise."""
    return named_filter(recording, settings, settings.filter, _options(settings))


def named_filter(
    recording: Recording, settings: Settings, name: str, options: dict[str, Any]
) -> estimators.Filter:
    """`make_filter` for any filter and options of its own.

    Raises
    ------
    ValueError
        As `estimators.make`; and for a filter that does not take the law of an epoch, where the
        recording has one.
    """
    walk, turn = settings.walk_m, math.radians(settings.walk_deg)
    if settings.planar:
        process = motion.ProcessNoise((0.0, 0.0, turn), (walk, walk, 0.0))
    else:
        process = motion.ProcessNoise(turn, walk)
    noise = ranging.RangeNoise(settings.range_std_m or DEFAULT_RANGE_STD_M)
    volume = volume_of(recording, settings)
    if name == "iekf-bank" and volume is not None:
        # The bank looks for a lost body in its volume, which is finite.
        anchors = recording.anchors
        reach = _REACH * max(float(np.ptp(anchors, axis=0).max()), 1.0)
        box = np.clip(volume, anchors.min(axis=0) - reach, anchors.max(axis=0) + reach)
        options = {"volume": box - origin_of(recording), **options}
    laws = {"tags": recording.tags, "noise": noise, "process": process}
    filter = estimators.make(name, **laws, **options)
    if _has_own_std(recording, settings):
        why = "the recording has a standard deviation for every range"
        check_takes_noise(name, filter, why)
    return filter


# Standard deviations of a turn rate (rad/s) and a speed (m/s) of which nothing is known.
_ANY_TURN, _ANY_SPEED = 1.0, 3.0


def _options(settings: Settings) -> dict[str, Any]:
    """What the settings say to the named filter."""
    if settings.filter in ("iekf", "iekf-bank"):
        return {"robust": settings.robust}
    if settings.filter == "iekf-bias":
        return {
            "robust": settings.robust,
            "bias_std_m": settings.bias_std_m,
            "bias_time_s": settings.bias_time_s,
            "common_std_m": settings.bias_common_m,
        }
    if settings.filter == "iekf-cv":
        turn, shift = ((0, 0, 1), (1, 1, 0)) if settings.planar else ((1, 1, 1), (1, 1, 1))
        return {
            "robust": settings.robust,
            "turn_rate_rad_s": tuple(_ANY_TURN * axis for axis in turn),
            "speed_m_s": tuple(_ANY_SPEED * axis for axis in shift),
            "turn_acceleration": tuple(math.radians(settings.accel_deg) * axis for axis in turn),
            "acceleration": tuple(settings.accel_m * axis for axis in shift),
        }
    return {}


def _prior(
    recording: Recording, settings: Settings, volume: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Anywhere among the anchors, turned anyhow; the plane, where there is one, is known."""
    centre = recording.anchors.mean(axis=0)
    extent = max(float(np.ptp(recording.anchors, axis=0).max()), 1.0)
    std = np.array([math.pi] * 3 + [extent] * 3)
    if volume is not None:
        bounded = np.isfinite(volume).all(axis=0)
        centre = np.where(bounded, np.where(bounded, volume, 0.0).mean(axis=0), centre)
        half = 0.5 * np.diff(np.where(bounded, volume, 0.0), axis=0)[0]
        std[3:] = np.where(bounded, half, std[3:])
    if settings.planar:
        centre[2] -= height_offset(recording, settings) + recording.tags[:, 2].mean()
        std[[0, 1, 5]] = _PLANAR_STD
    return np.eye(3), centre, np.diag(std**2)


def height_offset(recording: Recording, settings: Settings) -> float:
    """How far the tags lie below the anchors [m]; a ValueError where that has to be said."""
    heights = recording.anchors[:, 2]
    if settings.planar and settings.height_offset_m is None and np.ptp(heights) > _PLANE_M:
        raise ValueError(
            f"height_offset_m must be given for anchors at heights of {heights.min():g} to "
            f"{heights.max():g} m: how far the tags lie below the anchors' mean height"
        )
    return settings.height_offset_m or 0.0


class Errors(NamedTuple):
    """Errors where truth exists: mask (K,), distance (m), yaw (rad), rotation angle (rad), NEES.

    `tags`: root mean square over the tags (m).
    """

    known: np.ndarray
    position: FloatArray
    yaw: FloatArray
    rotation: FloatArray
    nees: FloatArray
    tags: FloatArray


def truth_of(
    recording: Recording, track: Track, settings: Settings
) -> tuple[FloatArray, FloatArray, np.ndarray] | None:
    """What the estimates are judged by: rotation (K, 3, 3), translation (K, 3), known (K,).

    The recording's truth (`replay_truth.matched`), turned by the offset; planar: its heading alone.
    """
    if recording.truth is None:
        return None
    check_overlap(recording.truth, track.times, settings.truth_gap_s)
    rotation, translation, known = matched(recording.truth, *track[:3], settings.truth_gap_s)
    return _as_judged(rotation, settings), translation, known


def _as_judged(rotation: FloatArray, settings: Settings) -> FloatArray:
    """Rotations (K, 3, 3) of the truth, turned by the offset; planar: their headings."""
    offset = rotations.exp([0.0, 0.0, math.radians(settings.yaw_offset_deg)])
    if settings.planar:
        heading = np.zeros((len(rotation), 3))
        heading[:, 2] = rotations.yaw(rotation)
        rotation = rotations.exp(heading)
    return offset @ rotation


def errors(recording: Recording, track: Track, settings: Settings) -> Errors | None:
    """Errors against the recording's truth, interpolated; None without truth.

    Planar: position in x and y, NEES of (yaw, x, y); the truth's roll and pitch are not read.
    """
    truth = truth_of(recording, track, settings)
    if truth is None:
        return None
    expected, translation, known = truth
    error = metrics.pose_error(track.rotation, track.translation, expected, translation)
    axes = [2, 3, 4] if settings.planar else list(range(6))
    block = track.covariance[:, axes][:, :, axes]
    turn = rotations.yaw(track.rotation) - rotations.yaw(expected)
    place = translation.copy()
    if settings.planar:
        place[:, 2] = track.translation[:, 2]
    return Errors(
        known,
        np.linalg.norm(error[:, 3 : 5 if settings.planar else 6], axis=-1),
        (turn + np.pi) % (2 * np.pi) - np.pi,
        np.linalg.norm(error[:, :3], axis=-1),
        metrics.nees(error[:, axes], block),
        metrics.tag_error(track.rotation, track.translation, expected, place, recording.tags),
    )


def figures(
    recording: Recording, track: Track, found: Errors | None, settings: Settings
) -> dict[str, Any]:
    """The figures of a run as plain numbers; those of errors are absent without truth."""
    result: dict[str, Any] = {
        "settings": {
            **dataclasses.asdict(settings),
            "range_std_m": range_std_of(recording, settings),
        },
        "epochs": len(track.times),
        "duration_s": float(track.times[-1] - track.times[0]),
        "links": int(recording.links.sum()),
    }
    result |= _notes(recording, track, found, settings)
    if found is None:
        return result
    known = found.known
    result["epochs_with_truth"] = int(known.sum())
    result["position_axes"] = "xy" if settings.planar else "xyz"
    yaw = np.rad2deg(found.yaw[known])
    rotation = np.rad2deg(found.rotation[known])
    for name, values in (
        ("position_{}_m", found.position[known]), ("yaw_{}_deg", yaw), ("rotation_{}_deg", rotation)
    ):  # fmt: skip
        result[name.format("rmse")] = float(np.sqrt(np.mean(values**2)))
        result[name.format("median")] = float(np.median(np.abs(values)))
        result[name.format("p95")] = float(np.quantile(np.abs(values), 0.95))
    result["yaw_mean_deg"] = float(yaw.mean())
    result["anees"] = float(found.nees[known].mean() / (3 if settings.planar else 6))
    return result


def _notes(
    recording: Recording, track: Track, found: Errors | None, settings: Settings
) -> dict[str, Any]:
    """The mirror pose, and what a reader is to be warned of, a sentence each."""
    result: dict[str, Any] = {}
    notes = [f"Note: {hint}." for hint in stamp_hints(track.times, recording.truth)]
    count = len(track.times)
    if track.other is not None and np.isfinite(track.other.log_odds[-1]):
        alive = track.other.alive
        apart = np.linalg.norm(track.other.translation - track.translation, axis=-1)
        result["mirror"] = {
            "epochs": int(alive.sum()),
            "distance_m": float(np.median(apart[alive])),
            "log_odds": float(track.other.log_odds[alive][-1]),
        }
        notes.append(_mirror_note(result["mirror"], count))
    volume = volume_of(recording, settings)
    if volume is not None:
        outside = int(is_outside(volume, track.translation, track.covariance).sum())
        result["epochs_outside_volume"] = outside
        if outside:
            notes.append(f"Note: the track is outside the volume in {outside} of {count} epochs.")
    if found is not None:
        notes += [f"Note: {hint}." for hint in _fault_hints(recording, track, settings)]
    return {**result, "notes": notes}


def _mirror_note(found: dict[str, Any], count: int) -> str:
    as_well = "better" if found["log_odds"] > DECIDED else "as well"
    return (
        f"WARNING: a mirror pose behind the anchors' plane, {found['distance_m']:.2f} m away, "
        f"explains the ranges {as_well} in {found['epochs']} of {count} epochs. The belief covers "
        "both. Say where the body is: --below-anchors or --volume."
    )


def _fault_hints(recording: Recording, track: Track, settings: Settings) -> list[str]:
    truth = recording.truth
    assert truth is not None

    def at(late_s: float) -> Judged:
        moved = truth._replace(times=truth.times - late_s)
        there = matched(moved, *track[:3], settings.truth_gap_s)
        return judged_of(there, track, settings.planar)

    return fault_hints(at, lambda rotation: _as_judged(rotation, settings), settings.planar)
