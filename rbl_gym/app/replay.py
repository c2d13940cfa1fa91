"""A recording through a filter: the same estimators on real radios."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import estimators, metrics, motion, ranging, recordings, rotations
from rbl_gym.checks import FloatArray, check_number
from rbl_gym.estimators.belief import check_takes_noise
from rbl_gym.link_bias import LinkBias
from rbl_gym.recordings import Recording

# What the planar constraint leaves to height (m), roll and pitch (rad).
_PLANAR_STD = 1e-3
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
        Law of the links' biases, of the filter ``"iekf-bias"`` (`rbl_gym.link_bias.LinkBias`).
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


DEFAULT_RANGE_STD_M = 0.12


class Track(NamedTuple):
    """Beliefs after every epoch: times (K,), rotation, translation, covariance (K, 6, 6)."""

    times: FloatArray
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray


def run(
    recording: Recording, settings: Settings, advance: Callable[[], None] = lambda: None
) -> Track:
    """Filter a recording causally, epoch by epoch; `advance` is called after each."""
    beliefs = []
    for _, belief in steps(recording, settings, make_filter(recording, settings)):
        beliefs.append(belief)
        advance()
    return track_of(recording, beliefs)


def steps(
    recording: Recording, settings: Settings, filter: estimators.Filter
) -> Iterator[tuple[Any, estimators.PoseBelief]]:
    """State and belief of a filter after every epoch of a recording, started from nothing.

    Standard deviations that the recording reports itself are the law of their epoch.
    """
    state = filter.initial(*_prior(recording, settings))
    before = recording.times[0]
    for k, now in enumerate(recording.times):
        if now > before:
            state = filter.predict(state, np.zeros(6), now - before)
        epoch = recording.ranges[k], recording.anchors, recording.links[k]
        law = {}
        if _has_own_std(recording, settings):
            law["noise"] = ranging.LinkNoise(recording.range_std[k])
        state = filter.update(state, *epoch, **law)
        yield state, filter.belief(state)
        before = now


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


def _prior(recording: Recording, settings: Settings) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Anywhere among the anchors, turned anyhow; the plane, where there is one, is known."""
    centre = recording.anchors.mean(axis=0)
    extent = max(float(np.ptp(recording.anchors, axis=0).max()), 1.0)
    std = np.array([math.pi] * 3 + [extent] * 3)
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

    The recording's truth, interpolated and turned by the offset; planar: its heading alone.
    """
    if recording.truth is None:
        return None
    rotation, translation, known = recordings.truth_at(recording.truth, track.times)
    if not known.any():
        spans = [
            f"{times[0]:g} to {times[-1]:g} s" for times in (track.times, recording.truth.times)
        ]
        raise ValueError(
            f"truth shares no time with the ranges: ranges {spans[0]}, truth {spans[1]}"
        )
    offset = rotations.exp([0.0, 0.0, math.radians(settings.yaw_offset_deg)])
    if settings.planar:
        heading = np.zeros((len(known), 3))
        heading[:, 2] = rotations.yaw(rotation)
        rotation = rotations.exp(heading)
    return offset @ rotation, translation, known


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
