"""The command rbl-gym replay."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from typing import Any

from rbl_gym.app.reading_options import add_reading, read_runs
from rbl_gym.app.sensor_options import (
    add_clocks,
    add_inertial,
    add_odometry,
    found_clocks,
    told_clocks,
)
from rbl_gym.app.terminal import (
    BOX,
    FILTER_HELP,
    add_html,
    add_json,
    add_plot,
    box,
    check_html,
    print_files,
    progress,
    window,
    write_json,
)

# Law of the biases of uncalibrated radios: constant, learned.
_RAW = {"bias_std_m": 0.05, "bias_time_s": None, "bias_common_m": 0.1}
_COMPARISON = ("yaw_offset_deg", "truth_gap_s", "truth_exclude", "align")


def add_replay(commands: Any) -> None:
    """Add the parser of ``rbl-gym replay``.

    An argument for a field of `rbl_gym.studies.replay.Settings` has its name and no default.
    Arguments that are not given keep the values of the settings.
    """
    replay = commands.add_parser(
        "replay",
        help="track a body with the ranges of a recording",
        description="Track a body with the ranges of a recording. With --truth, report the errors. "
        "See docs/recordings.md.",
    )
    add_reading(replay)
    _add_knowledge(replay.add_argument_group("knowledge of the body's position"))
    _add_filter(replay.add_argument_group("filter"))
    _add_motion(replay.add_argument_group("motion of the body"))
    add_odometry(replay.add_argument_group("odometry"))
    add_inertial(replay.add_argument_group("inertial sensor (filter iekf-imu)"))
    _add_tuning(replay.add_argument_group("tuning by the likelihood of the log"))
    _add_biases(replay.add_argument_group("biases of the links"))
    _add_smoothing(replay.add_argument_group("the smoothed track"))
    _add_comparison(replay.add_argument_group("comparison with the truth"))
    _add_output(replay.add_argument_group("output"))
    replay.set_defaults(run=_replay)


def _add_knowledge(group: Any) -> None:
    group.add_argument(
        "--planar",
        action="store_true",
        default=None,
        help="the body moves in a level plane: height, roll and pitch stay constant",
    )
    _add_numbers(group, (
        ("height-offset-m", "with --planar: depth of the tags below the anchors (difference of "
         "the mean heights), metres; default 0 if all anchors have the same height"),
    ))  # fmt: skip
    group.add_argument(
        "--volume",
        type=_volume,
        metavar=BOX,
        help="where the body's origin may be, metres; separates a pose from its mirror image. "
        "An axis or a limit may be left out: --volume z=:1.8. Also xmin,xmax,ymin,ymax,zmin,zmax, "
        "with empty numbers for no limit",
    )
    group.add_argument(
        "--below-anchors",
        action="store_true",
        default=None,
        help="the body stays below the anchors' mean height",
    )
    group.add_argument(
        "--start",
        type=_start,
        metavar="x,y,z[,yaw_deg]",
        help="first position of the body's origin, metres, and its heading; write --start=-1,... "
        "if the first number is negative",
    )
    _add_numbers(group, (
        ("prior-position-m", "standard deviation of the first position, metres, default 0.5"),
        ("prior-rotation-deg", "standard deviation of the first rotation, degrees; default 30 "
         "with a yaw in --start, else unknown"),
        ("height-m", "height of the body's origin, metres; held exactly with --planar, else "
         "within --height-std-m"),
        ("height-std-m", "standard deviation of --height-m, metres"),
        ("tilt-std-deg", "the body stays level: standard deviation of roll and pitch, degrees"),
    ))  # fmt: skip


def _add_filter(group: Any) -> None:
    group.add_argument(
        "--filter",
        metavar="NAME",
        help=f"{FILTER_HELP}. Default: iekf-log; iekf with --walk-...; iekf-bias with --raw or "
        "--bias-...; iekf-imu with --imu. Default of its option robust: late for iekf-log and "
        "iekf-imu, else true",
    )
    _add_numbers(group, (
        ("range-std-m", "standard deviation of a range, metres; default: that of the recording, "
         "else 0.12"),
    ))  # fmt: skip


def _add_motion(group: Any) -> None:
    _add_numbers(group, (
        ("walk-m", "random walk of the position: standard deviation after 1 s, metres, default "
         "0.1"),
        ("walk-deg", "random walk of the rotation: standard deviation after 1 s, degrees, default "
         "7"),
        ("accel-m", "iekf-log, iekf-cv: standard deviation of the change of speed after 1 s, m/s; "
         "default 1 for iekf-log, 0.5 for iekf-cv"),
        ("accel-deg", "iekf-log, iekf-cv: standard deviation of the change of turn rate after 1 "
         "s, deg/s; default 30"),
    ))  # fmt: skip


def _add_tuning(group: Any) -> None:
    group.add_argument(
        "--tune",
        action="store_true",
        help="choose --range-std-m and the motion (--walk-..., or --accel-... if the twist is "
        "estimated) by the likelihood of the first part of the log. Without --filter it "
        "also chooses the filter; with --calibration it takes iekf-bias. The truth is not used",
    )
    _add_numbers(group, (
        ("tune-s", "length of the first part of the log that --tune uses, seconds, default 20, "
         "at most 3000 epochs; implies --tune"),
    ))  # fmt: skip


def _add_biases(group: Any) -> None:
    _add_numbers(group, (
        ("constant-std-m", "iekf-log: standard deviation of the constant bias of a link, metres, "
         "default 0.05"),
        ("constant-common-m", "iekf-log: standard deviation of the constant bias common to all "
         "links, metres, default 0.1"),
        ("drift-std-m", "iekf-log: standard deviation of the drifting bias of a link, metres, "
         "default 0.05"),
        ("drift-time-s", "iekf-log: correlation time of the drifting bias, seconds, default 3"),
        ("bias-std-m", "iekf-bias: standard deviation of the bias of a link, metres, default "
         "0.02, with --raw 0.05"),
        ("bias-time-s", "iekf-bias: correlation time of this bias, seconds, default 3, with "
         "--raw constant"),
        ("bias-common-m", "iekf-bias: standard deviation of the bias common to all links, metres, "
         "default 0, with --raw 0.1"),
    ))  # fmt: skip
    group.add_argument(
        "--raw",
        action="store_true",
        help="the radios are not calibrated: iekf-bias estimates constant biases",
    )


def _add_smoothing(group: Any) -> None:
    group.add_argument(
        "--smooth",
        action="store_true",
        default=None,
        help="compute the most likely track from the whole log, in addition to the causal one",
    )
    _add_numbers(group, (
        ("smooth-accel-m", "standard deviation of the change of speed after 1 s, m/s, default 0.2"),
        ("smooth-accel-deg", "standard deviation of the change of turn rate after 1 s, deg/s, "
         "default 15"),
        ("smooth-bias-std-m", "standard deviation of the drifting bias of a link, metres, default "
         "0.06"),
        ("smooth-bias-time-s", "correlation time of the drifting bias, seconds, default 3"),
        ("smooth-constant-m", "standard deviation of the constant bias of a link, metres, default "
         "0.1"),
        ("smooth-common-m", "standard deviation of the constant bias common to all links, metres, "
         "default 0.2"),
    ))  # fmt: skip


def _add_comparison(group: Any) -> None:
    _add_numbers(group, (
        ("yaw-offset-deg", "constant that is added to the yaw of the truth, if the table of tags "
         "is turned against the body frame of the truth; degrees, default 0"),
        ("truth-gap-s", "longest interpolated gap of truth or ranges, seconds, default 0.5"),
    ))  # fmt: skip
    group.add_argument(
        "--truth-exclude",
        type=window,
        action="append",
        metavar="START:END",
        help="interval with wrong truth, seconds by the clock of the ranges, left out of the "
        "errors; may be given several times",
    )
    add_clocks(group)
    group.add_argument(
        "--align",
        choices=("none", "position", "yaw", "se3"),
        help="align the world frame of the truth to the estimated positions, as evo does; default "
        "none",
    )


def _add_output(group: Any) -> None:
    group.add_argument(
        "--track",
        metavar="F",
        help="file of the track, with --smooth of the smoothed one: .tum or .txt (TUM format), or "
        ".csv with covariance, NIS and rank",
    )
    add_plot(group, "of the track and the errors")
    add_html(group, "page with the track in 3-D, charts and tables")
    add_json(group)


def _add_numbers(group: Any, texts: Iterable[tuple[str, str]]) -> None:
    for name, text in texts:
        group.add_argument(f"--{name}", type=float, metavar="X", help=text)


def _replay(options: argparse.Namespace) -> int:
    from rbl_gym import recordings
    from rbl_gym.studies import replay

    check_html(options)
    if options.track:
        recordings.check_track_path(options.track)
    settings = _settings(options)
    runs = read_runs(options)
    # Report errors before the work begins.
    _check_compared(options, runs)
    if len(runs) > 1 and (options.plot or options.html or options.track):
        raise ValueError(
            f"--plot, --html and --track need a single run, but {options.ranges} has {len(runs)}, "
            f"{[*runs]!r:.200}: choose one by --run"
        )
    for recording in runs.values() if len(runs) == 1 else ():
        replay.check_replay(recording, settings)
    settings, clocks = found_clocks(options, runs, settings)
    runs = {run: replay.covered(recording, settings) for run, recording in runs.items()}
    tuned = _tuned(options, runs, settings)
    settings = settings if tuned is None else tuned.settings
    if len(runs) > 1:
        return _replay_runs(options, runs, settings, tuned, clocks)
    (recording,) = runs.values()
    with progress("replay", len(recording.times)) as advance:
        replayed = replay.replay_recording(recording, settings, advance)
    replayed.figures.update(clocks)
    if tuned is not None:
        replayed.figures["tuned"] = tuned.figures()
    if options.track:
        best = replayed.track if replayed.smoothed is None else replayed.smoothed.track
        recordings.write_track(options.track, replay.track_file(recording, best))
    if options.plot:
        from rbl_gym.app import figures

        figures.save_figure(figures.replay_figure(recording, replayed), options.plot)
    if options.html:
        from rbl_gym.app import page, track_pages

        page.write(track_pages.replay_page(recording, replayed), options.html)
    if write_json(replayed.figures, options.json):
        from rbl_gym.app import reports

        reports.print_replay(replayed.figures)
        print_files(track=options.track, picture=options.plot, page=options.html)
    return 0


def _tuned(options: argparse.Namespace, runs: Any, settings: Any) -> Any:
    """Return the settings tuned on the longest run, if requested."""
    if not options.tune and options.tune_s is None:
        return None
    from rbl_gym.studies import replay

    longest = max(runs.values(), key=lambda run: len(run.times))
    length = {} if options.tune_s is None else {"seconds": options.tune_s}
    filters: tuple[str, ...] = ()
    if not options.filter and not options.odometry and settings.filter in ("iekf", "iekf-log"):
        # Without a named filter the likelihood also chooses one. Errors left by a calibration are
        # small and move with the pose: the law of iekf-bias.
        filters = ("iekf-bias",) if options.calibration else ("iekf-log", "iekf", "iekf-bias")
    with progress("tune", replay.TUNING_ROUNDS * max(len(filters), 1)) as advance:
        return replay.tune(longest, settings, filters=filters, advance=advance, **length)


def _replay_runs(
    options: argparse.Namespace, runs: Any, settings: Any, tuned: Any, clocks: Mapping[str, Any]
) -> int:
    from rbl_gym.app import reports
    from rbl_gym.studies import replay

    with progress("replay", sum(len(run.times) for run in runs.values())) as advance:
        replayed = replay.replay_runs(runs, settings, advance)
    replayed.figures.update(clocks)
    if tuned is not None:
        replayed.figures["tuned"] = tuned.figures()
    if write_json(replayed.figures, options.json):
        reports.print_runs(replayed.figures)
    return 0


def _settings(options: argparse.Namespace) -> Any:
    """Return the `rbl_gym.studies.replay.Settings` of the arguments."""
    from rbl_gym.studies import replay

    given = {
        name: getattr(options, name)
        for name in replay.Settings().flat()
        if getattr(options, name, None) is not None
    }
    given |= told_clocks(options)
    if options.raw:
        if options.calibration:
            raise ValueError("--raw must be left out with --calibration")
        given = {**_RAW, **given}
    if options.imu:
        given.setdefault("filter", "iekf-imu")
    settings = replay.Settings.of(**given)
    name = settings.filter
    if given.keys() & _RAW.keys() and name != "iekf-bias":
        raise ValueError(f"--raw and --bias-... need the filter iekf-bias, got {name}")
    of_log = [key for key in given if key.startswith(("constant_", "drift_"))]
    if of_log and name not in ("iekf-log", "iekf-imu"):
        option = of_log[0].replace("_", "-")
        raise ValueError(f"--{option} needs the filter iekf-log or iekf-imu, got {name}")
    return settings


def _check_compared(options: argparse.Namespace, runs: Mapping[str, Any]) -> None:
    """Raise ValueError if an option of the comparison is given, but no truth."""
    if any(recording.truth is not None for recording in runs.values()):
        return
    given = [name for name in _COMPARISON if getattr(options, name) is not None]
    if given:
        raise ValueError(f"--{given[0].replace('_', '-')} needs --truth")


def _start(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (3, 4):
        raise argparse.ArgumentTypeError(f"must be x,y,z or x,y,z,yaw_deg, got {text!r}")
    return values


def _volume(text: str) -> tuple[float | None, ...]:
    """Parse `BOX`, or its six numbers separated by commas, some of which may be empty."""
    if (pairs := box(text)) is not None:
        return tuple(limit for pair in pairs for limit in pair)
    try:
        limits = [float(part) if part.strip() else None for part in text.split(",")]
    except ValueError:
        limits = []
    if len(limits) != 6:
        raise argparse.ArgumentTypeError(
            f"must be {BOX}, or xmin,xmax,ymin,ymax,zmin,zmax, in metres, got {text!r}"
        )
    return tuple(limits)
