"""Filters of the pose and further states by their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rbl_gym.checks import FloatArray, check_count
from rbl_gym.estimators.bank.headings import HeadingBank
from rbl_gym.estimators.filter import Filter, register
from rbl_gym.estimators.iekf.augmented import AugmentedEkf
from rbl_gym.estimators.iekf.clock import ClockEkf
from rbl_gym.estimators.iekf.manifold import IteratedEkf
from rbl_gym.estimators.iekf.odometry import OdometryEkf
from rbl_gym.measurements.direction_bias import DirectionLaw
from rbl_gym.measurements.link_bias import LinkBias
from rbl_gym.measurements.odometry import OdometrySensor
from rbl_gym.measurements.offsets import Clock
from rbl_gym.measurements.ranging import NoiseLaw
from rbl_gym.motion.kinematics import ProcessNoise
from rbl_gym.motion.unknown_twist import TwistSensor, WanderingTwist


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
    """The filter ``"iekf-cv"``: pose and twist of a body without odometry (12 error states).

    Parameters
    ----------
    tags, noise, process, iterations, robust, offset
        As `IteratedEkf`; `process` moves the pose beyond what the twist does.
    turn_rate_rad_s, speed_m_s, turn_acceleration, acceleration
        As `WanderingTwist`.
    gyro_std_rad_s, speed_std_m_s, frame
        As `TwistSensor`: what `predict` is told is then a reading. Both None: it is ignored.
    """
    law = WanderingTwist(turn_rate_rad_s, speed_m_s, turn_acceleration, acceleration)  # pyright: ignore[reportArgumentType]
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
    """The filter ``"iekf-bias"``: the pose, and a bias of every link that it learns on the way.

    Parameters
    ----------
    tags, noise, process, iterations, robust, offset
        As `IteratedEkf`; `noise` is what remains of a range beside its bias.
    bias_std_m, bias_time_s, common_std_m
        As `LinkBias`. A short time marginalises errors that are correlated rather than learning
        them.
    directions
        As `AugmentedEkf`.
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
    """The filter ``"iekf-log"``: a log of raw ranges of which nothing else is known.

    Pose and twist, and of every link two biases: one that stays, of cables and antennas, and one
    that moves with the body. The defaults were chosen on logs of a planar robot, a hand-held rig,
    a wheeled robot and two robots that range to each other, so as to do well on all of them.

    Parameters
    ----------
    tags, noise, process, iterations, offset
        As `IteratedEkf`; `noise` is what remains of a range beside its biases, and `process` moves
        the pose beyond what the twist does.
    robust
        As `IteratedEkf`; real ranges err late.
    turn_rate_rad_s, speed_m_s, turn_acceleration, acceleration
        As `WanderingTwist`.
    constant_std_m, constant_common_m
        Standard deviations of the biases that stay: of each link, and of what all have in common.
    drift_std_m, drift_time_s
        Of the biases that move: standard deviation of each link's, and how long it lasts.
    clock
        Law of offsets that last, in place of `offset`, as of ``"iekf"``; with one heading and
        no odometry.
    odometry
        Law of the odometry that `predict` is then told, an `OdometrySensor` or its fields; the
        twist is that of the body's axes. None: there is none.
    headings
        1, or how many hypotheses of the heading there are at the start, as of `iekf-imu`.
    directions
        As `AugmentedEkf`.
    """
    law = WanderingTwist(turn_rate_rad_s, speed_m_s, turn_acceleration, acceleration)  # pyright: ignore[reportArgumentType]
    stays = LinkBias(constant_std_m, None, constant_common_m)
    moves = LinkBias(drift_std_m, drift_time_s)
    pose = IteratedEkf(tags, noise, process, iterations, robust, offset)
    if clock is not None:
        if odometry is not None or headings != 1 or directions is not None:
            raise ValueError(
                f"clock must be None beside odometry, headings or directions, got {clock!r:.80}"
            )
        filter = ClockEkf(pose, law, None, (stays, moves), clock=clock)
    elif odometry is None:
        filter = AugmentedEkf(pose, law, None, (stays, moves), directions)
    else:
        sensor = odometry if isinstance(odometry, OdometrySensor) else OdometrySensor(**odometry)
        # A bias that cannot be needs no states.
        biases = tuple(bias for bias in (stays, moves) if bias.std_m or bias.common_std_m)
        filter = OdometryEkf(pose, law, None, biases, directions, sensor)
    return filter if check_count("headings", headings) == 1 else HeadingBank(filter, headings)


register("iekf-cv", iekf_cv)
register("iekf-bias", iekf_bias)
register("iekf-log", iekf_log)
