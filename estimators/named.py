"""The filters ``"iekf"``, ``"iekf-cv"``, ``"iekf-bias"`` and ``"iekf-log"`` by their options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import ArrayLike

from rbl_gym.checks import FloatArray, check_count, check_one_of
from rbl_gym.estimators.bank.headings import HeadingBank
from rbl_gym.estimators.filter import Filter, register
from rbl_gym.estimators.iekf.augmented import AugmentedEkf
from rbl_gym.estimators.iekf.clock import ClockEkf
from rbl_gym.estimators.iekf.doa_filter import DoaEkf
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.iekf.odometry import OdometryEkf
from rbl_gym.estimators.iekf.surveyed import SurveyedEkf
from rbl_gym.measurements.direction_bias import DirectionLaw
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.measurements.odometry import OdometrySensor
from rbl_gym.measurements.offsets import Clock
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import TwistSensor, WanderingTwist


def iekf(
    tags: FloatArray,
    noise: Any,
    process: ProcessNoise,
    iterations: int = 4,
    robust: bool | str = False,
    measurement: str = "ranges",
    range_noise: NoiseLaw | None = None,
    offset: str | None = None,
    clock: Clock | None = None,
    anchor_std_m: ArrayLike | None = None,
) -> IteratedEkf | AugmentedEkf | ClockEkf:
    """Return the filter ``"iekf"``: `IteratedEkf` on ranges, `DoaEkf` on directions of arrival.

    Parameters
    ----------
    measurement
        ``"ranges"`` or ``"doa"``; `noise` is their law.
    range_noise
        For ``"doa"``: the law of additional ranges of an update.
    tags, process, iterations, robust, offset
        As in `IteratedEkf`.
    clock
        Law of lasting offsets, instead of `offset`: their clocks become states (`ClockEkf`).
    anchor_std_m
        Standard deviation of the anchor positions: they become states (`SurveyedEkf`).
    """
    check_one_of("measurement", measurement, ("ranges", "doa"))
    if measurement == "doa":
        for name, told in (("offset", offset), ("clock", clock), ("anchor_std_m", anchor_std_m)):
            if told is not None:
                raise ValueError(f"{name} must be None with angles, got {told!r:.80}")
        return DoaEkf(tags, noise, process, iterations, robust, range_noise=range_noise)
    if range_noise is not None:
        raise ValueError(
            "range_noise must be None with measurement='ranges', as noise is the law of the ranges"
        )
    filter = IteratedEkf(tags, noise, process, iterations, robust, offset)
    if anchor_std_m is None:
        return filter if clock is None else ClockEkf(filter, clock=clock)
    if clock is not None:
        raise ValueError(f"clock must be None with anchor_std_m, got {clock!r:.80}")
    return SurveyedEkf(filter, anchor_std_m=anchor_std_m)


def iekf_cv(
    tags: FloatArray,
    noise: NoiseLaw,
    process: ProcessNoise,
    iterations: int = 4,
    robust: bool | str = False,
    turn_rate_rad_s: float | Sequence[float] = 0.5,
    speed_m_s: float | Sequence[float] = 5.0,
    turn_acceleration: float | Sequence[float] = 0.3,
    acceleration: float | Sequence[float] = 1.0,
    gyro_std_rad_s: float | None = None,
    speed_std_m_s: float | None = None,
    frame: str = "world",
    offset: str | None = None,
) -> AugmentedEkf:
    """Return the filter ``"iekf-cv"`` for pose and twist without odometry (12 error states).

    Parameters
    ----------
    tags, noise, process, iterations, robust, offset
        As in `IteratedEkf`; `process` is pose noise in addition to the twist.
    turn_rate_rad_s, speed_m_s, turn_acceleration, acceleration
        As in `WanderingTwist`.
    gyro_std_rad_s, speed_std_m_s, frame
        As in `TwistSensor`; the twist passed to `predict` is then a measurement. Both None: it is
        ignored.
    """
    law = WanderingTwist(turn_rate_rad_s, speed_m_s, turn_acceleration, acceleration)  # pyrefly: ignore[bad-argument-type]
    sensor = TwistSensor(gyro_std_rad_s, speed_std_m_s, frame)
    measured = gyro_std_rad_s is not None or speed_std_m_s is not None
    pose = IteratedEkf(tags, noise, process, iterations, robust, offset)
    return AugmentedEkf(pose, law, sensor if measured else None)


def iekf_bias(
    tags: FloatArray,
    noise: NoiseLaw,
    process: ProcessNoise,
    iterations: int = 4,
    robust: bool | str = False,
    bias_std_m: float = 0.05,
    bias_time_s: float | None = None,
    common_std_m: float = 0.1,
    offset: str | None = None,
    directions: DirectionLaw | None = None,
) -> AugmentedEkf:
    """Return the filter ``"iekf-bias"`` for the pose and a bias of every link.

    Parameters
    ----------
    tags, noise, process, iterations, robust, offset
        As in `IteratedEkf`; `noise` excludes the bias.
    bias_std_m, bias_time_s, common_std_m
        As in `LinkBias`. With a short time, correlated errors are marginalised rather than
        estimated.
    directions
        As in `AugmentedEkf`.
    """
    pose = IteratedEkf(tags, noise, process, iterations, robust, offset)
    law = LinkBias(bias_std_m, bias_time_s, common_std_m)
    return AugmentedEkf(pose, biases=(law,), directions=directions)


def iekf_log(
    tags: FloatArray,
    noise: NoiseLaw,
    process: ProcessNoise,
    iterations: int = 4,
    robust: bool | str = "late",
    turn_rate_rad_s: float | Sequence[float] = 1.0,
    speed_m_s: float | Sequence[float] = 3.0,
    turn_acceleration: float | Sequence[float] = 0.5,
    acceleration: float | Sequence[float] = 1.0,
    constant_std_m: float = 0.05,
    constant_common_m: float = 0.1,
    drift_std_m: float = 0.05,
    drift_time_s: float = 3.0,
    offset: str | None = None,
    clock: Clock | None = None,
    odometry: Mapping[str, float] | OdometrySensor | None = None,
    headings: int = 1,
    directions: DirectionLaw | None = None,
) -> Filter:
    """Return the filter ``"iekf-log"`` for a log of raw ranges without other knowledge.

    It estimates pose, twist and two biases of every link: a constant one, of cables and antennas,
    and one that changes as the body moves. The defaults were chosen to work well on all of these
    logs: a planar robot, a hand-held rig, a wheeled robot, and two robots that range to each other.

    Parameters
    ----------
    tags, noise, process, iterations, offset
        As in `IteratedEkf`; `noise` excludes the biases, and `process` is pose noise in addition to
        the twist.
    robust
        As in `IteratedEkf`; outliers of real ranges are late.
    turn_rate_rad_s, speed_m_s, turn_acceleration, acceleration
        As in `WanderingTwist`.
    constant_std_m, constant_common_m
        Standard deviations of the constant biases: one per link, and one common to all links.
    drift_std_m, drift_time_s
        Standard deviation and correlation time of the changing bias of each link.
    clock
        Model of clock offsets that persist, in place of `offset`, as in ``"iekf"``. It requires one
        heading and no odometry.
    odometry
        Error model of the odometry passed to `predict`, an `OdometrySensor` or its fields. The
        twist is in the body frame. None: no odometry.
    headings
        Number of heading hypotheses at the start, as in `iekf_imu`; 1 for a known heading.
    directions
        As in `AugmentedEkf`.
    """
    law = WanderingTwist(turn_rate_rad_s, speed_m_s, turn_acceleration, acceleration)  # pyrefly: ignore[bad-argument-type]
    stays = LinkBias(constant_std_m, None, constant_common_m)
    moves = LinkBias(drift_std_m, drift_time_s)
    pose = IteratedEkf(tags, noise, process, iterations, robust, offset)
    if clock is not None:
        if odometry is not None or headings != 1 or directions is not None:
            raise ValueError(
                "clock must be None if odometry, directions or several headings are given, got "
                f"{clock!r:.80}"
            )
        filter = ClockEkf(pose, law, None, (stays, moves), clock=clock)
    elif odometry is None:
        filter = AugmentedEkf(pose, law, None, (stays, moves), directions)
    else:
        try:
            sensor = (
                odometry if isinstance(odometry, OdometrySensor) else OdometrySensor(**odometry)
            )
        except TypeError as error:
            raise ValueError(
                f"odometry must be an OdometrySensor, its fields, or None, got {odometry!r:.80}"
            ) from error
        # A bias with zero standard deviation needs no states.
        biases = tuple(bias for bias in (stays, moves) if bias.std_m or bias.common_std_m)
        filter = OdometryEkf(pose, law, None, biases, directions, sensor)
    found = filter if check_count("headings", headings) == 1 else HeadingBank(filter, headings)
    return found  # pyrefly: ignore[bad-return]


register("iekf", iekf)
register("iekf-cv", iekf_cv)
register("iekf-bias", iekf_bias)
register("iekf-log", iekf_log)
