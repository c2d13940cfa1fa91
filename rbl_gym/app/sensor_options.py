"""Options of ``rbl-gym replay`` for sensors on the body and their clocks."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rbl_gym.app.terminal import offset, progress

if TYPE_CHECKING:
    from rbl_gym.recordings import Recording
    from rbl_gym.studies.replay import Settings

# Settings that are clock offsets.
_CLOCKS = {"truth": "time_offset", "odometry": "odometry_offset_s", "imu": "imu_offset_s"}


def add_odometry(group: Any) -> None:
    """Add the options of `rbl_gym.studies.replay.Odometry`."""
    for name, text in (
        (
            "odometry-m",
            "standard deviation of the forward distance after 1 s, metres, default 0.05",
        ),
        (
            "slip-m",
            "standard deviation of the sideways and vertical distance after 1 s, metres, "
            "default 0.03",
        ),
        ("odometry-deg", "standard deviation of the turn after 1 s, degrees, default 6"),
        ("odometry-scale", "standard deviation of the scale errors (0.03: 3 %%), default 0.03"),
        (
            "odometry-bias-deg-s",
            "standard deviation of the biases of the turn rates, deg/s, default 0.5",
        ),
    ):
        group.add_argument(f"--{name}", type=float, metavar="X", help=text)
    group.add_argument(
        "--headings",
        type=int,
        metavar="N",
        help="number of headings to start from if --start has none, default 12",
    )


def add_inertial(group: Any) -> None:
    """Add the options of `rbl_gym.studies.replay.Inertial`."""
    for name, text in (
        (
            "gyro-noise",
            "density of the white noise of the gyroscope, rad/s/sqrt(Hz), default 0.003",
        ),
        (
            "accel-noise",
            "density of the white noise of the accelerometer, m/s^2/sqrt(Hz), default 0.05",
        ),
        (
            "gravity-tilt-deg",
            "standard deviation of the tilt of the world's z axis against the vertical, degrees, "
            "default 1",
        ),
        (
            "recorded-share",
            "share of the standard deviations of the ranges in the log (column std) that is "
            "white noise, default 0.5; the filter estimates the rest as biases",
        ),
    ):
        group.add_argument(f"--{name}", type=float, metavar="X", help=text)


def add_clocks(group: Any) -> None:
    """Add the option ``--time-offset``."""
    group.add_argument(
        "--time-offset",
        type=_clock,
        action="append",
        dest="time_offsets",
        metavar="[WHAT=]S",
        help="S: how far the clock of the truth is ahead of the clock of the ranges, seconds; "
        "auto: estimated from the motion. odometry=S, imu=S: how far these clocks are ahead; "
        "odometry=auto: estimated from the likelihood of the ranges, up to 2.4 s; imu=auto: "
        "estimated from accelerations, up to 10 s. May be given several times",
    )


def told_clocks(options: argparse.Namespace) -> dict[str, Any]:
    """Return settings of the given clocks; that of the truth may be ``"auto"``.

    ValueError if there is no sensor for a clock.
    """
    told = dict(options.time_offsets or ())
    for what in told:
        if what != "truth" and getattr(options, what) is None:
            raise ValueError(f"--time-offset {what}=... needs --{what}")
    return {
        _CLOCKS[what]: value for what, value in told.items() if what == "truth" or value != "auto"
    }


def found_clocks(
    options: argparse.Namespace, runs: Mapping[str, Recording], settings: Settings
) -> tuple[Settings, dict[str, Any]]:
    """Return the settings with estimated sensor clocks, and figures of these."""
    from rbl_gym.studies import replay

    figures: dict[str, Any] = {}
    for what, value in dict(options.time_offsets or ()).items():
        if what == "truth" or value != "auto":
            continue
        longest = max(runs.values(), key=lambda run: len(run.times))
        with progress(f"clock of {what}", replay.CLOCK_TRIALS) as advance:
            clock = replay.sensor_clock(longest, settings, _CLOCKS[what], advance)
        settings = settings.changed(**{_CLOCKS[what]: clock.offset_s})
        figures[f"{what}_clock"] = clock._asdict()
    return settings, figures


def _clock(text: str) -> tuple[str, float | str]:
    what, equal, value = text.rpartition("=")
    what = what if equal else "truth"
    if what not in _CLOCKS:
        raise argparse.ArgumentTypeError(
            f"must name one of {', '.join(_CLOCKS)}, as in odometry=0.1, got {text!r}"
        )
    return what, offset(value)
