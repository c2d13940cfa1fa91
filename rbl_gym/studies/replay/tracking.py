"""Filter a recording, with the same estimators as in simulation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from rbl_gym import estimators, motion
from rbl_gym.checks import FloatArray
from rbl_gym.estimators import Innovations
from rbl_gym.estimators.filter import check_takes_noise
from rbl_gym.geometry.mirror import mirror_pose
from rbl_gym.measurements import ranging
from rbl_gym.recordings.inertial import samples_between
from rbl_gym.recordings.odometry import odometry_between
from rbl_gym.recordings.recording import Recording
from rbl_gym.studies.epochs import Reading, Step, track_epochs
from rbl_gym.studies.groups import Steps, each, innovations_of, joined, track_log
from rbl_gym.studies.progress import Advance, silent
from rbl_gym.studies.replay.centre import about_origin, centred
from rbl_gym.studies.replay.inertial import clocked, standing
from rbl_gym.studies.replay.mirror import Mirror, covering, is_outside, other_pose
from rbl_gym.studies.replay.place import (
    has_own_std,
    level_of,
    origin_of,
    own_std,
    reach_of,
    start_of,
    volume_of,
)
from rbl_gym.studies.replay.settings import DEFAULT_RANGE_STD_M, Settings

__all__ = [
    "Track",
    "named_filter",
    "range_std_of",
    "recording_filter",
    "recording_steps",
    "track_recording",
]

# Filters that support biases by ray direction.
_DIRECTED = ("iekf-log", "iekf-bias", "iekf-imu")
# Added standard deviations of rotation and position when a belief restarts from its mirror image.
_IMAGE_RAD, _IMAGE_M = 0.1, 0.2


class LinkBiases(NamedTuple):
    """Constant biases of the links after the last epoch: mean (M, N) and covariance (M N, M N)."""

    mean_m: FloatArray
    covariance: FloatArray


class Track(NamedTuple):
    """Beliefs after every epoch: times (K,), rotation, translation, covariance (K, 6, 6).

    `other`: the mirror pose if it explains the ranges too; the covariance then includes it.
    `innovations`: innovations of the ranges, arrays (K, ...). `nis` over `dof` is 1 on average if
    the filter is consistent. `at_centre`: covariances (K, 6, 6) with the errors of the centre of
    the tags in place of those of the origin, if this centre was tracked (`replay.centre`).
    `biases`: None if the filter estimates no constant biases.
    """

    times: FloatArray
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    other: Mirror | None = None
    innovations: Innovations | None = None
    at_centre: FloatArray | None = None
    biases: LinkBiases | None = None


def track_recording(recording: Recording, settings: Settings, advance: Advance = silent) -> Track:
    """Filter a recording causally, epoch by epoch; `advance` is called with the number of
    epochs done.

    If a mirror pose explains the ranges equally well, the belief includes both (`replay.mirror`).
    A rotation that the ranges do not determine keeps a large variance (`replay.centre`).
    """
    recording, settings, centre = centred(recording, settings)
    track = _tracked(recording, settings, advance)
    if centre is None:
        return track
    return about_origin(track, centre)._replace(at_centre=track.covariance)


def _tracked(recording: Recording, settings: Settings, advance: Advance) -> Track:
    filter = recording_filter(recording, settings)
    steps = _counted(log_steps(recording, settings, filter), advance)
    beliefs, found, state = [], [], None
    for group, innovations in innovations_of(filter, steps, recording.tags, _noise(settings)):
        # Only the last of the states are kept, as those of a long log fill the memory.
        state = group.state
        beliefs.append(group.belief)
        found.append(innovations)
    belief, foretold = joined(beliefs), joined(found)
    biases = _constant_biases(filter, state, recording.links.shape[1:])
    track = Track(recording.times, *belief[:3], innovations=foretold, biases=biases)
    known = settings.knowledge
    if known.planar or known.height_std_m is not None or known.tilt_std_deg is not None:
        # Known height, roll and pitch distinguish the two sides.
        return track
    std = None
    if not has_own_std(recording, settings):
        std = settings.range_std_m or DEFAULT_RANGE_STD_M
    judge = named_filter(recording, settings, "iekf", {"robust": robust_of(settings)})
    poses = track[1:4]
    other = other_pose(recording, judge, std, poses, volume_of(recording, settings))
    if other is None:
        return track
    return track._replace(covariance=covering(other, poses), other=other)


def _constant_biases(filter: Any, states: Any, shape: tuple[int, ...]) -> LinkBiases | None:
    """Return the constant biases (M, N) of the last of some states; None: there are none."""
    if hasattr(filter, "leader"):
        filter, states = filter.filter, filter.leader(states)
    links = math.prod(shape)
    # The last states are the biases, law after law.
    for k, law in enumerate(reversed(getattr(filter, "biases", ())), 1):
        if law.time_s is None:
            end = states.extra.shape[-1] - (k - 1) * links
            mean, P = states.extra[-1, end - links : end], states.covariance[-1, 6:, 6:]
            return LinkBiases(mean.reshape(shape), P[end - links : end, end - links : end].copy())
    return None


def _counted(steps: Iterator[Step | Steps], advance: Advance) -> Iterator[Step | Steps]:
    for step in steps:
        yield step
        advance(step.count)


def recording_steps(
    recording: Recording, settings: Settings, filter: estimators.Filter
) -> Iterator[Step]:
    """Run a filter over the epochs of a recording, without a known start.

    Epochs with their own standard deviations use these as their noise law. A belief outside the
    volume of the settings restarts from its mirror image, if that is inside. Map coordinates are
    taken relative to the anchors; beliefs are in world coordinates.
    """
    for step in log_steps(recording, settings, filter):
        yield from step.each() if isinstance(step, Steps) else (step,)


def log_steps(
    recording: Recording, settings: Settings, filter: estimators.Filter
) -> Iterator[Step | Steps]:
    """Yield the steps of `recording_steps`, of one epoch or of many (`epochs.track_log`)."""
    origin = origin_of(recording)
    local = recording._replace(anchors=recording.anchors - origin)
    volume = volume_of(recording, settings)
    volume = None if volume is None else volume - origin
    restart = None if volume is None else partial(_image_inside, recording.tags, volume)
    rotation, translation, covariance = prior_of(recording, settings)
    how = (rotation, translation - origin, covariance), _log(local, settings)
    rest = restart, level_of(settings, origin)
    if recording.odometry is None and recording.inertial is None:
        steps = track_log(filter, *how, *rest)
    else:
        steps = track_epochs(filter, how[0], _sensed(recording, settings, how[1]), *rest)
    if not origin.any():
        yield from steps
        return
    for step in steps:
        belief = step.belief
        yield step._replace(belief=belief._replace(translation=belief.translation + origin))


def _log(recording: Recording, settings: Settings) -> Reading:
    """Return the epochs of a recording, for `epochs.each`."""
    own = own_std(recording, settings)
    return Reading(
        recording.ranges,
        recording.anchors_by_epoch,
        recording.links,
        None if own is None else ranging.LinkNoise(own),
        np.zeros((len(recording.times), 6)),
        np.diff(recording.times, prepend=recording.times[0]),  # pyrefly: ignore[bad-argument-type]
    )


def _sensed(recording: Recording, settings: Settings, log: Reading) -> Iterator[Reading]:
    """Yield the epochs of a log with the readings of the body sensor."""
    for time, reading in zip(recording.times.tolist(), each(log), strict=True):
        yield reading._replace(**sensed(recording, settings, time - reading.dt, time))


def prior_of(recording: Recording, settings: Settings) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rotation, translation and covariance of the body before the first ranges."""
    prior = start_of(recording, settings)
    return standing(recording, settings, prior) if settings.filter == "iekf-imu" else prior


def readings_of(recording: Recording, settings: Settings) -> list[tuple[FloatArray, FloatArray]]:
    """Return the readings of the body sensor and their durations, between all epochs."""
    what = "inertial" if settings.filter == "iekf-imu" else "odometry"
    found = (sensed(recording, settings, *ends) for ends in pairwise(recording.times.tolist()))
    return [(one[what], one["steps"]) for one in found]


def sensed(
    recording: Recording, settings: Settings, start_s: float, end_s: float
) -> dict[str, Any]:
    """Return fields of a `Reading`: the sensor readings between two times."""
    if settings.filter == "iekf-imu" and recording.inertial is not None:
        log = clocked(recording, settings)
        readings, steps = samples_between(log, start_s, end_s)  # pyrefly: ignore[bad-argument-type]
        return {"inertial": readings, "steps": steps}
    if recording.odometry is None:
        return {}
    ahead = settings.odometry.odometry_offset_s
    readings, steps = odometry_between(recording.odometry, start_s + ahead, end_s + ahead)
    return {"odometry": readings, "steps": steps}


def _image_inside(
    tags: FloatArray, volume: FloatArray, belief: estimators.PoseBelief, anchors: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the widened mirror image of a belief outside the volume, if the image is inside."""
    if not is_outside(volume, belief.translation, belief.covariance):
        return None
    image = mirror_pose(*belief[:3], anchors, tags)
    if is_outside(volume, *image[1:]):
        return None
    # For nearly coplanar anchors the image is near the best pose, not at it.
    widened = image[2] + np.diag([_IMAGE_RAD**2] * 3 + [_IMAGE_M**2] * 3)
    return image[0], image[1], widened


def range_std_of(recording: Recording, settings: Settings) -> float | str:
    """Return the standard deviation of a range [m], or ``"recorded"`` if each has its own."""
    if settings.range_std_m is not None:
        return settings.range_std_m
    return "recorded" if has_own_std(recording, settings) else DEFAULT_RANGE_STD_M


def recording_filter(recording: Recording, settings: Settings) -> estimators.Filter:
    """Return the filter of the settings, with the tags and motion of a recording.

    Raises
    ------
    ValueError
        As in `named_filter`, and if the recording has a sensor, or biases by direction, that the
        filter does not support.
    """
    if (recording.inertial is None) == (settings.filter == "iekf-imu"):
        if recording.inertial is None:
            raise ValueError("filter 'iekf-imu' needs imu, the readings of an inertial sensor")
        raise ValueError(
            f"imu needs the filter 'iekf-imu', got {settings.filter!r}: leave out filter or imu"
        )
    if recording.odometry is not None and settings.filter != "iekf-log":
        raise ValueError(
            f"odometry needs the filter 'iekf-log', got {settings.filter!r}: leave out filter or "
            "odometry"
        )
    options = _options(recording, settings)
    if recording.directions is not None:
        if settings.filter not in _DIRECTED:
            raise ValueError(
                f"directions needs one of the filters {', '.join(_DIRECTED)}, got "
                f"{settings.filter!r}"
            )
        options["directions"] = recording.directions
    options |= dict(settings.filter_options)
    return named_filter(recording, settings, settings.filter, options)


def named_filter(
    recording: Recording, settings: Settings, name: str | Callable, options: dict[str, Any]
) -> estimators.Filter:
    """Return a named filter with the tags of a recording, a random walk and the range noise.

    Parameters
    ----------
    recording, settings
        The recording to filter, and the settings.
    name, options
        Name and options of the filter, instead of those of the settings.

    Raises
    ------
    ValueError
        As in `estimators.make`, and if the recording has a law per epoch that the filter does not
        support.
    """
    walk, turn = settings.motion.walk_m, math.radians(settings.motion.walk_deg)
    if settings.knowledge.planar:
        process = motion.ProcessNoise((0.0, 0.0, turn), (walk, walk, 0.0))
    else:
        process = motion.ProcessNoise(turn, walk)
    if options.get("odometry") is not None:
        # The error of dead reckoning has its own law.
        process = motion.ProcessNoise(0.0, 0.0)
    volume = volume_of(recording, settings)
    if name == "iekf-bank" and volume is not None:
        # The bank searches a lost body in a finite volume.
        box = np.clip(volume, *reach_of(recording))
        options = {"volume": box - origin_of(recording), **options}
    if recording.offset is not None:
        options = {"offset": recording.offset, **options}
    laws = {"tags": recording.tags, "noise": _noise(settings), "process": process}
    filter = estimators.make(name, **laws, **options)
    if has_own_std(recording, settings):
        why = "the recording has a standard deviation for every range"
        check_takes_noise(name, filter, why)
    return filter


def accel_of(settings: Settings, told: bool = False) -> tuple[float, float]:
    """Return the change of velocity (m/s) and turn rate (deg/s) in 1 s; `told`: with odometry."""
    given = settings.motion.accel_m, settings.motion.accel_deg
    usual = _TOLD if told else _ACCEL.get(settings.filter, _ACCEL["iekf-log"])
    accel_m, accel_deg = (a if b is None else b for a, b in zip(usual, given, strict=True))
    return accel_m, accel_deg


def _noise(settings: Settings) -> ranging.RangeNoise:
    """Return the noise law of ranges without their own."""
    return ranging.RangeNoise(settings.range_std_m or DEFAULT_RANGE_STD_M)


# Standard deviations of an unknown turn rate (rad/s) and velocity (m/s).
_ANY_TURN, _ANY_SPEED = 1.0, 3.0
# Default change in 1 s (m/s, deg/s) with odometry.
_TOLD = (3.0, 1000.0)
_ACCEL = {"iekf-log": (1.0, 30.0), "iekf-cv": (0.5, 30.0)}


def robust_of(settings: Settings) -> bool | str:
    """Return the loss of the filter."""
    if settings.loss.robust is not None:
        return settings.loss.robust
    return "late" if settings.filter in ("iekf-log", "iekf-imu") else True


def _options(recording: Recording, settings: Settings) -> dict[str, Any]:
    """Return the options of the named filter from the settings."""
    robust, biases = {"robust": robust_of(settings)}, settings.biases
    if settings.filter in ("iekf", "iekf-bank"):
        return robust
    if settings.filter == "iekf-bias":
        return {
            **robust,
            "bias_std_m": biases.bias_std_m,
            "bias_time_s": biases.bias_time_s,
            "common_std_m": biases.bias_common_m,
        }
    if settings.filter == "iekf-cv":
        return {**robust, **_twist(settings, accel_of(settings))}
    if settings.filter == "iekf-imu":
        return {
            **robust,
            "inertial": settings.inertial.sensor(),
            "gravity_tilt_rad": math.radians(settings.inertial.gravity_tilt_deg),
            "bias_std_m": biases.constant_std_m,
            "common_std_m": biases.constant_common_m,
            "drift_std_m": biases.drift_std_m,
            "drift_time_s": biases.drift_time_s,
            "headings": _headings(settings),
        }
    if settings.filter == "iekf-log":
        names = ("constant_std_m", "constant_common_m", "drift_std_m", "drift_time_s")
        options = {**robust, **{name: getattr(biases, name) for name in names}}
        if recording.odometry is None:
            return {**options, **_twist(settings, accel_of(settings))}
        accel = accel_of(settings, told=True)
        options |= {**_twist(settings, accel), "odometry": settings.odometry.sensor()}
        return {**options, "headings": _headings(settings)}
    return {}


def _headings(settings: Settings) -> int:
    """Return the number of start headings of the filter."""
    known = settings.knowledge
    told = known.start is not None and len(known.start) == 4
    return 1 if told or known.prior_rotation_deg is not None else settings.odometry.headings


def _twist(settings: Settings, accel: tuple[float, float]) -> dict[str, Any]:
    """Return the law of an unknown twist."""
    accel_m, accel_deg = accel
    turn, shift = ((0, 0, 1), (1, 1, 0)) if settings.knowledge.planar else ((1, 1, 1), (1, 1, 1))
    return {
        "turn_rate_rad_s": tuple(_ANY_TURN * axis for axis in turn),
        "speed_m_s": tuple(_ANY_SPEED * axis for axis in shift),
        "turn_acceleration": tuple(math.radians(accel_deg) * axis for axis in turn),
        "acceleration": tuple(accel_m * axis for axis in shift),
    }
