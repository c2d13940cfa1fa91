"""Settings for filtering a recording, by subject."""

from __future__ import annotations

import dataclasses
from typing import Any

from rbl_gym.checks import check_number, check_one_of, did_you_mean
from rbl_gym.estimators.filter import filter_text, parse_filter
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
# For the filter iekf-imu: lasting biases of single links cannot be separated from the common one.
_INERTIAL_BIASES = {"constant_std_m": 0.0, "constant_common_m": 0.073, "drift_time_s": 20.0}
# Fields that only one filter uses, or that are its motion, for `Settings.of`.
_FILTERS_BY_FIELD = {
    "bias_std_m": "iekf-bias",
    "bias_time_s": "iekf-bias",
    "bias_common_m": "iekf-bias",
    "walk_m": "iekf",
    "walk_deg": "iekf",
}


@dataclasses.dataclass(frozen=True)
class Motion:
    """Motion of the body with unknown twist.

    Parameters
    ----------
    walk_m, walk_deg
        The pose is a random walk of this standard deviation after 1 s.
    accel_m, accel_deg
        For the filters ``"iekf-log"`` and ``"iekf-cv"``: standard deviation of the change of
        velocity (m/s) and turn rate (deg/s) in 1 s; None: 30 deg/s, and 1 m/s (``"iekf-cv"``:
        0.5 m/s). With odometry, which measures all changes, 1000 deg/s and 3 m/s.
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
    """Laws of the link biases.

    Parameters
    ----------
    bias_std_m, bias_time_s, bias_common_m
        For the filter ``"iekf-bias"``: as in `rbl_gym.measurements.link_bias.LinkBias`.
    constant_std_m, constant_common_m
        For ``"iekf-log"`` and ``"iekf-imu"``: constant biases, of each link and common to all.
    drift_std_m, drift_time_s
        For the same filters: biases that change with the motion.
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
    """Treatment of ranges that do not fit.

    Parameters
    ----------
    robust
        For the iterated EKFs: False for squares; True for Huber's loss; ``"late"`` for the
        redescending loss for late ranges. None: ``"late"`` for ``"iekf-log"``, else True.
    """

    robust: bool | str | None = None


@dataclasses.dataclass(frozen=True)
class Knowledge:
    """Prior knowledge of the pose of the body.

    Parameters
    ----------
    planar
        Hold height, roll and pitch by a tight prior.
    height_offset_m
        Mean height of the anchors minus that of the tags (planar only). None: the same height,
        which is only possible for anchors in one plane.
    volume
        Possible positions of the body origin: xmin, xmax, ymin, ymax, zmin, zmax in metres, None
        for no limit. It can distinguish a pose from its mirror image.
    below_anchors
        The body is below the mean height of the anchors.
    start
        Position of the body origin at the first epoch: x, y, z in metres, and optionally its yaw in
        degrees. None: anywhere among the anchors, with any rotation.
    prior_position_m, prior_rotation_deg
        Standard deviations of `start` on each axis; None: 0.5 m, and 30 degrees if a yaw is given.
    height_m, height_std_m
        Approximate height of the body origin and its standard deviation; exact with `planar`.
    tilt_std_deg
        Standard deviation of roll and pitch of a body that stays level.
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
            raise ValueError("height_offset_m needs planar")
        for name in ("prior_position_m", "prior_rotation_deg"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), low=1e-6)
                if self.start is None:
                    raise ValueError(f"{name} needs start")
        for name in ("height_std_m", "tilt_std_deg"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), low=1e-6)
                if self.planar:
                    raise ValueError(
                        f"{name} must be left out with planar, where height, roll and pitch are "
                        "constant"
                    )
        if self.height_m is not None:
            check_number("height_m", self.height_m)
            if self.height_std_m is None and not self.planar:
                raise ValueError(
                    "height_m needs height_std_m, its standard deviation; or set planar, with "
                    "which the height is exact"
                )
            if self.height_offset_m:
                raise ValueError(
                    "height_m and height_offset_m must not both be given: they set the same height"
                )
        elif self.height_std_m is not None:
            raise ValueError("height_std_m needs height_m")
        if self.start is not None:
            object.__setattr__(self, "start", _start(self.start))
        if self.volume is not None:
            object.__setattr__(self, "volume", _six_limits(self.volume))


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Comparison of a track with the truth.

    Parameters
    ----------
    yaw_offset_deg
        Constant rotation of the tag table relative to the body frame of the truth: the yaw error is
        estimate - (truth + offset).
    truth_gap_s
        Longest gap, in the truth or the ranges, that is interpolated for the comparison.
    truth_exclude
        Time windows in which the truth is wrong: pairs of start and end, in seconds on the clock of
        the ranges. Their epochs are not compared.
    time_offset
        How far the clock of the truth is ahead of that of the ranges, seconds; ``"auto"``:
        estimated from the motion (`rbl_gym.recordings.motion_offset`).
    align
        The part of the world frame of the truth that is estimated from matched positions
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
    """The smoothed track, in addition to the causal one, and its laws.

    Parameters
    ----------
    smooth
        Whether to compute it.
    smooth_accel_m, smooth_accel_deg
        The twist is an unknown random walk: standard deviation of the change of velocity (m/s) and
        turn rate (deg/s) in 1 s.
    smooth_bias_std_m, smooth_bias_time_s
        Drifting bias of every link, as in `rbl_gym.measurements.link_bias.LinkBias`.
    smooth_constant_m, smooth_common_m
        Standard deviations of the constant bias of every link, and of the common bias.
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
    """Settings for filtering a recording.

    No two groups have a field of the same name: `of`, `changed` and `flat` read and write fields
    without their groups, as the command line, files and JSON name them.

    Parameters
    ----------
    filter
        Name of the filter. Options may follow it, as in ``"iekf/robust=late"``
        (`rbl_gym.estimators.parse_filter`).
    filter_options
        Options of the filter that the other settings do not cover, as a dict or as pairs. Options
        after the name are added to it. `robust` is the same option as in `loss`.
    range_std_m
        Standard deviation of a range; None: the value of the recording if given, else
        `DEFAULT_RANGE_STD_M`, which includes link biases that change with the pose.
    motion, biases, odometry, inertial, loss, knowledge, comparison, smoothing
        The other settings, by subject.

    Examples
    --------
    >>> Settings("iekf", motion=Motion(walk_m=0.3)) == Settings.of(walk_m=0.3)
    True
    """

    filter: str = "iekf-log"
    filter_options: tuple[tuple[str, Any], ...] = ()
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
        name, options = parse_filter(self.filter, dict(self.filter_options))
        if "robust" in options:
            object.__setattr__(self, "loss", Loss(options["robust"]))
        # Settings must be hashable.
        pairs = ((key, tuple(x) if isinstance(x, list) else x) for key, x in options.items())
        object.__setattr__(self, "filter", name)
        object.__setattr__(self, "filter_options", tuple(pairs))

    @property
    def filter_text(self) -> str:
        """The filter with its options, as `parse_filter` reads them."""
        robust = self.loss.robust
        options = {} if robust is None else {"robust": robust}
        return filter_text(self.filter, options | dict(self.filter_options))

    @classmethod
    def of(cls, **fields: Any) -> Settings:
        """Return settings with these fields, of any group.

        The filter defaults to ``"iekf-bias"`` if a field of its biases is given, else to ``"iekf"``
        if a random walk is given, else to ``"iekf-log"``. Link biases default to those of the
        filter. For ``"iekf-imu"``, with an accurate motion, these are a constant bias common to all
        links (0.073 m), and a bias of each link that drifts in 20 s.

        Raises
        ------
        ValueError
            If a field is unknown, or a value is invalid for its group.
        """
        wanted = [name for field, name in _FILTERS_BY_FIELD.items() if field in fields]
        fields = {"filter": (*wanted, "iekf-log")[0], **fields}
        inertial = parse_filter(fields["filter"])[0] == "iekf-imu"
        usual = _INERTIAL_BIASES if inertial else {}
        return cls().changed(**{**usual, **fields})

    def changed(self, **fields: Any) -> Settings:
        """Return settings with new values of fields, of any group; errors as in `of`."""
        known = self.flat()
        unknown = [name for name in fields if name not in known]
        if unknown:
            raise ValueError(
                f"settings have no field {unknown[0]!r}; the fields are {', '.join(known)}"
                f"{did_you_mean(unknown[0], known)}"
            )
        # The options belong to the previous filter.
        options = dict(
            fields.get("filter_options", () if "filter" in fields else self.filter_options)
        )
        if "robust" in fields:
            if "robust" in parse_filter(fields.get("filter", ""))[1]:
                raise ValueError(
                    "robust is given twice, in filter and as robust: leave out one, got "
                    f"{fields!r:.200}"
                )
            options |= {"robust": fields["robust"]} if "robust" in options else {}
        fields["filter_options"] = tuple(options.items())
        groups = {name: getattr(self, name) for name in vars(self)}
        for name, group in groups.items():
            if dataclasses.is_dataclass(group):
                new = {key: fields[key] for key in vars(group) if key in fields}
                if new:
                    groups[name] = dataclasses.replace(group, **new)
            else:
                groups[name] = fields.get(name, group)
        return Settings(**groups)

    def flat(self) -> dict[str, Any]:
        """Return all fields by their names, without the groups."""
        result: dict[str, Any] = {}
        for name, value in vars(self).items():
            result |= vars(value) if dataclasses.is_dataclass(value) else {name: value}
        return result


def _start(start: Any) -> tuple[float, ...]:
    values = tuple(check_number("start", x) for x in start)
    if len(values) not in (3, 4):
        raise ValueError(f"start must be x, y, z and optionally yaw_deg, got {len(values)} numbers")
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
