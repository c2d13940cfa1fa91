"""How a recording is filtered, by subject."""

from __future__ import annotations

import dataclasses
from typing import Any

from rbl_gym.checks import check_number, check_one_of
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.recordings.align import ALIGNMENTS
from rbl_gym.studies.replay.sensors import Inertial, Odometry

__all__ = [
    "DEFAULT_RANGE_STD_M",
    "Biases",
    "Comparison",
    "Knowledge",
    "Loss",
    "Motion",
    "Settings",
    "Smoothing",
]

DEFAULT_RANGE_STD_M = 0.12
# Of the filter iekf-imu: what a link keeps for long is not told from what all keep.
_INERTIAL_BIASES = {"constant_std_m": 0.0, "constant_common_m": 0.073, "drift_time_s": 20.0}


@dataclasses.dataclass(frozen=True)
class Motion:
    """How the body moves: no twist is told.

    Parameters
    ----------
    walk_m, walk_deg
        The pose is a random walk of this standard deviation after 1 s.
    accel_m, accel_deg
        Of the filters ``"iekf-log"`` and ``"iekf-cv"``: how much speed (m/s) and turn rate (deg/s)
        change in 1 s; None: 30 deg/s, and 1 m/s, of ``"iekf-cv"`` 0.5; with odometry, which
        tells of every change, 1000 deg/s and 3 m/s.
    """

    walk_m: float = 0.1
    walk_deg: float = 7.0
    accel_m: float | None = None
    accel_deg: float | None = None

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is not None:
                check_number(field.name, value, low=0.0)


@dataclasses.dataclass(frozen=True)
class Biases:
    """Laws of the links' biases.

    Parameters
    ----------
    bias_std_m, bias_time_s, bias_common_m
        Of the filter ``"iekf-bias"``: as of `rbl_gym.measurements.link_bias.LinkBias`.
    constant_std_m, constant_common_m
        Of ``"iekf-log"`` and ``"iekf-imu"``: biases that stay, of each link and in common to all.
    drift_std_m, drift_time_s
        Of the same: biases that move as the body does.
    """

    bias_std_m: float = 0.02
    bias_time_s: float | None = 3.0
    bias_common_m: float = 0.0
    constant_std_m: float = 0.05
    constant_common_m: float = 0.1
    drift_std_m: float = 0.05
    drift_time_s: float = 3.0

    def __post_init__(self) -> None:
        LinkBias(self.bias_std_m, self.bias_time_s, self.bias_common_m)
        for field in dataclasses.fields(self)[3:]:
            low = 1e-9 if field.name == "drift_time_s" else 0.0
            check_number(field.name, getattr(self, field.name), low=low)


@dataclasses.dataclass(frozen=True)
class Loss:
    """How much a range counts that does not fit.

    Parameters
    ----------
    robust
        Of the iterated EKFs: False, squares; True, Huber's loss; ``"late"``, the redescending loss
        for ranges that err late. None: ``"late"`` of ``"iekf-log"``, else True.
    """

    robust: bool | str | None = None


@dataclasses.dataclass(frozen=True)
class Knowledge:
    """What is known of the body's place before any range.

    Parameters
    ----------
    planar
        Hold height, roll and pitch by a tight prior.
    height_offset_m
        How far the tags' mean height lies below the anchors' (planar only). None: the same height,
        which anchors in one plane alone can mean.
    volume
        Where the body's origin may be: xmin, xmax, ymin, ymax, zmin, zmax in metres, None where
        there is no limit. It tells a pose from its mirror image.
    below_anchors
        The body stays below the anchors' mean height.
    start
        Where the body's origin is at the first epoch: x, y, z in metres, and its yaw in degrees or
        nothing. None: anywhere among the anchors, turned anyhow.
    prior_position_m, prior_rotation_deg
        Standard deviations of that, on each axis; None: 0.5 m, and 30 degrees where a yaw is told.
    height_m, height_std_m
        The body's origin stays at about this height; with `planar` at this height.
    tilt_std_deg
        The body stays level but for this, about each of two axes.
    """

    planar: bool = False
    height_offset_m: float | None = None
    volume: tuple[float | None, ...] | None = None
    below_anchors: bool = False
    start: tuple[float, ...] | None = None
    prior_position_m: float | None = None
    prior_rotation_deg: float | None = None
    height_m: float | None = None
    height_std_m: float | None = None
    tilt_std_deg: float | None = None

    def __post_init__(self) -> None:
        if check_number("height_offset_m", self.height_offset_m or 0.0) != 0 and not self.planar:
            raise ValueError("height_offset_m means nothing without planar")
        for name in ("prior_position_m", "prior_rotation_deg"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), low=1e-6)
                if self.start is None:
                    raise ValueError(f"{name} means nothing without start")
        for name in ("height_std_m", "tilt_std_deg"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), low=1e-6)
                if self.planar:
                    raise ValueError(f"planar holds height, roll and pitch: leave out {name}")
        if self.height_m is not None:
            check_number("height_m", self.height_m)
            if self.height_std_m is None and not self.planar:
                raise ValueError("height_m needs height_std_m, or planar, which holds it")
            if self.height_offset_m:
                raise ValueError("height_m and height_offset_m say the same: give one")
        elif self.height_std_m is not None:
            raise ValueError("height_std_m needs height_m")
        if self.start is not None:
            object.__setattr__(self, "start", _start(self.start))
        if self.volume is not None:
            object.__setattr__(self, "volume", _six_limits(self.volume))


@dataclasses.dataclass(frozen=True)
class Comparison:
    """How a track is compared with the truth.

    Parameters
    ----------
    yaw_offset_deg
        Constant turn of the tag table against the truth's body frame: the yaw error is
        estimate - (truth + offset).
    truth_gap_s
        Longest gap, of the truth or of the ranges, that is bridged to compare the two.
    truth_exclude
        Windows of time, in seconds of the ranges' clock, in which the truth is known to be wrong:
        pairs of start and end. Their epochs are not judged.
    time_offset
        How far the truth's clock is ahead of that of the ranges, seconds; ``"auto"``: found by
        the motion (`rbl_gym.recordings.motion_offset`).
    align
        What of the truth's world frame is estimated from the matched positions
        (`rbl_gym.recordings.align_positions`): ``"none"``, ``"position"``, ``"yaw"``, ``"se3"``.
    """

    yaw_offset_deg: float = 0.0
    truth_gap_s: float = 0.5
    truth_exclude: tuple[tuple[float, float], ...] = ()
    time_offset: float | str = 0.0
    align: str = "none"

    def __post_init__(self) -> None:
        check_number("yaw_offset_deg", self.yaw_offset_deg)
        check_number("truth_gap_s", self.truth_gap_s, low=0.0)
        if self.time_offset != "auto":
            check_number("time_offset", self.time_offset)
        check_one_of("align", self.align, ALIGNMENTS)
        if self.truth_exclude:
            object.__setattr__(self, "truth_exclude", _windows(self.truth_exclude))


@dataclasses.dataclass(frozen=True)
class Smoothing:
    """The smoothed track, beside the causal one, and its laws.

    Parameters
    ----------
    smooth
        Whether to find it.
    smooth_accel_m, smooth_accel_deg
        The twist is unknown, and wanders: by how much speed (m/s) and turn rate (deg/s) change in
        1 s.
    smooth_bias_std_m, smooth_bias_time_s
        Of every link's bias that drifts, as of `rbl_gym.measurements.link_bias.LinkBias`.
    smooth_constant_m, smooth_common_m
        Standard deviations of every link's bias that stays, and of what they have in common.
    """

    smooth: bool = False
    smooth_accel_m: float = 0.2
    smooth_accel_deg: float = 15.0
    smooth_bias_std_m: float = 0.06
    smooth_bias_time_s: float = 3.0
    smooth_constant_m: float = 0.1
    smooth_common_m: float = 0.2

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if field.name != "smooth":
                low = 1e-9 if field.name.endswith("_s") else 0.0
                check_number(field.name, getattr(self, field.name), low=low)


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a recording is filtered.

    No two groups have a field of the same name: `of`, `changed` and `flat` read and write fields
    without their groups, as the command line, files and JSON name them.

    Parameters
    ----------
    filter
        Name of the filter.
    range_std_m
        Standard deviation of a range; None: the recording's own where it has one, else
        `DEFAULT_RANGE_STD_M`, which covers link biases that change with the pose.
    motion, biases, odometry, inertial, loss, knowledge, comparison, smoothing
        The rest, by subject.

    Examples
    --------
    >>> Settings(motion=Motion(walk_m=0.3)) == Settings.of(walk_m=0.3)
    True
    """

    filter: str = "iekf"
    range_std_m: float | None = None
    motion: Motion = Motion()
    biases: Biases = Biases()
    odometry: Odometry = dataclasses.field(default_factory=Odometry)
    inertial: Inertial = dataclasses.field(default_factory=Inertial)
    loss: Loss = Loss()
    knowledge: Knowledge = Knowledge()
    comparison: Comparison = Comparison()
    smoothing: Smoothing = Smoothing()

    def __post_init__(self) -> None:
        if self.range_std_m is not None:
            check_number("range_std_m", self.range_std_m, low=1e-6)

    @classmethod
    def of(cls, **fields: Any) -> Settings:
        """The settings with these fields, of whatever group.

        Biases of the links default to those of the filter: of ``"iekf-imu"``, which knows the
        motion well, one that all have in common and stays (0.073 m), and of each one that drifts
        in 20 s.

        Raises
        ------
        ValueError
            On a field that no group has, and as the groups.
        """
        usual = _INERTIAL_BIASES if fields.get("filter") == "iekf-imu" else {}
        return cls().changed(**{**usual, **fields})

    def changed(self, **fields: Any) -> Settings:
        """These settings with new values of fields, of whatever group; errors as of `of`."""
        known = self.flat()
        unknown = [name for name in fields if name not in known]
        if unknown:
            raise ValueError(f"settings have no {unknown[0]!r}; they have {', '.join(known)}")
        groups = {name: getattr(self, name) for name in vars(self)}
        for name, group in groups.items():
            if dataclasses.is_dataclass(group):
                new = {key: fields[key] for key in vars(group) if key in fields}
                if new:
                    groups[name] = dataclasses.replace(group, **new)  # pyright: ignore[reportArgumentType]
            else:
                groups[name] = fields.get(name, group)
        return Settings(**groups)

    def flat(self) -> dict[str, Any]:
        """All fields by their names, without the groups."""
        result: dict[str, Any] = {}
        for name, value in vars(self).items():
            result |= vars(value) if dataclasses.is_dataclass(value) else {name: value}
        return result


def _start(start: Any) -> tuple[float, ...]:
    values = tuple(check_number("start", x) for x in start)
    if len(values) not in (3, 4):
        raise ValueError(f"start must be x, y, z and perhaps yaw_deg, got {len(values)} numbers")
    return values


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


def _windows(given: Any) -> tuple[tuple[float, float], ...]:
    try:
        windows = tuple((float(start), float(end)) for start, end in given)
    except (TypeError, ValueError):
        windows = ((1.0, 0.0),)
    if not all(start < end for start, end in windows):
        raise ValueError(
            f"truth_exclude must be pairs of start and end in seconds, got {given!r:.80}"
        )
    return windows
