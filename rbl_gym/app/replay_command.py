"""The command rbl-gym replay."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
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
    FILTER_HELP,
    add_html,
    add_json,
    check_html,
    print_files,
    progress,
    window,
    write_json,
)

# Law of the biases of uncalibrated radios: constant, learned.
_RAW = {"bias_std_m": 0.05, "bias_time_s": None, "bias_common_m": 0.1}


def add_replay(commands: Any) -> None:
    """Add the parser of ``rbl-gym replay``.

    An argument for a field of `rbl_gym.studies.replay.Settings` has its name and no default.
    Arguments that are not given keep the values of the settings.
    """
    replay = commands.add_parser(
        "replay",
        help="a recording of ranges through a filter",
        description="Track a recorded body; with --truth, the errors.",
    )
    add_reading(replay)
    _add_knowledge(replay.add_argument_group("what is known of the body's place"))
    _add_filter(replay.add_argument_group("filter"))
    _add_motion(replay.add_argument_group("how the body moves"))
    add_odometry(replay.add_argument_group("odometry"))
    add_inertial(replay.add_argument_group("inertial sensor (filter iekf-imu)"))
    _add_tuning(replay.add_argument_group("settings by the likelihood of the log"))
    _add_biases(replay.add_argument_group("biases of the links"))
    _add_smoothing(replay.add_argument_group("the smoothed track"))
    _add_comparison(replay.add_argument_group("comparison with the truth"))
    _add_output(replay.add_argument_group("output"))
    replay.set_defaults(run=_replay)


def _add_knowledge(group: Any) -> None:
    group.add_argument(
        "--planar", action="store_true", default=None, help="hold height, roll and pitch"
    )
    _add_number(
        group,
        "--height-offset-m",
        "of the tags' mean height below the anchors', with --planar; default 0 where the "
        "anchors stand at one height",
    )
    group.add_argument(
        "--volume",
        type=_volume,
        metavar="xmin,xmax,ymin,ymax,zmin,zmax",
        help="where the body's origin may be, metres: tells a pose from its mirror image; empty "
        "where there is no limit, as in --volume=,,,,,1.8; write --volume=-1,... for a minus",
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
        help="where the body's origin is at first, metres, and its heading; write --start=-1,... "
        "for a minus",
    )
    _add_number(group, "--prior-position-m", "standard deviation of the start, default 0.5")
    _add_number(
        group, "--prior-rotation-deg", "of its rotation, default 30 with a yaw, else unknown"
    )
    _add_number(group, "--height-m", "the body's origin stays at about this height (or --planar)")
    _add_number(group, "--height-std-m", "standard deviation of that")
    _add_number(group, "--tilt-std-deg", "the body stays level but for this, about each axis")


def _add_filter(group: Any) -> None:
    group.add_argument(
        "--filter",
        metavar="NAME",
        help=f"{FILTER_HELP}; default iekf-log, with --walk-... iekf, with --raw or --bias-... "
        "iekf-bias, with --imu iekf-imu; robust is late of iekf-log and iekf-imu, else true",
    )
    # Of 0.1: --filter NAME/robust=false.
    group.add_argument(
        "--no-robust", dest="robust", action="store_false", default=None, help=argparse.SUPPRESS
    )
    _add_number(group, "--range-std-m", "of a range; default the recording's own, else 0.12")


def _add_motion(group: Any) -> None:
    _add_number(group, "--walk-m", "random walk of the position after 1 s, default 0.1")
    _add_number(group, "--walk-deg", "random walk of the rotation after 1 s, default 7")
    _add_number(
        group,
        "--accel-m",
        "iekf-log, iekf-cv: change of the speed (m/s) after 1 s, default 1 and 0.5",
    )
    _add_number(
        group,
        "--accel-deg",
        "iekf-log, iekf-cv: of the turn rate (deg/s) after 1 s, default 30",
    )


def _add_tuning(group: Any) -> None:
    group.add_argument(
        "--tune",
        action="store_true",
        help="choose --range-std-m and the motion (--walk-..., of an estimated twist --accel-...) "
        "by the likelihood of the log's first part; the truth is not looked at; where no "
        "--filter is given it is chosen too, with a --calibration iekf-bias",
    )
    _add_number(group, "--tune-s", "length of that part, default 20; tunes as --tune does")


def _add_biases(group: Any) -> None:
    for name, text in (
        ("constant-std-m", "iekf-log: of a link's bias that stays, default 0.05"),
        ("constant-common-m", "iekf-log: of what all links have in common, default 0.1"),
        ("drift-std-m", "iekf-log: of a link's bias that moves, default 0.05"),
        ("drift-time-s", "iekf-log: how long that lasts, default 3"),
        ("bias-std-m", "iekf-bias: of a link's bias, default 0.02, with --raw 0.05"),
        ("bias-time-s", "iekf-bias: how long it lasts, default 3, with --raw for ever"),
        ("bias-common-m", "iekf-bias: of what all have in common, default 0, with --raw 0.1"),
    ):
        _add_number(group, f"--{name}", text)
    group.add_argument(
        "--raw",
        action="store_true",
        help="ranges of radios that nobody calibrated: iekf-bias learns the biases that stay",
    )


def _add_smoothing(group: Any) -> None:
    group.add_argument(
        "--smooth",
        action="store_true",
        default=None,
        help="the most likely track of the whole log beside the causal one",
    )
    _add_number(group, "--smooth-accel-m", "change of the speed (m/s) after 1 s, default 0.2")
    _add_number(group, "--smooth-accel-deg", "of the turn rate (deg/s) after 1 s, default 15")
    _add_number(group, "--smooth-bias-std-m", "of a link's bias that drifts, default 0.06")
    _add_number(group, "--smooth-bias-time-s", "how long that lasts, default 3")
    _add_number(group, "--smooth-constant-m", "of a link's bias that stays, default 0.1")
    _add_number(group, "--smooth-common-m", "of what those have in common, default 0.2")


def _add_comparison(group: Any) -> None:
    _add_number(group, "--yaw-offset-deg", "yaw error = estimate - (truth + offset)")
    _add_number(group, "--truth-gap-s", "longest gap bridged between truth and ranges, default 0.5")
    group.add_argument(
        "--truth-exclude",
        type=window,
        action="append",
        metavar="START:END",
        help="seconds (of the ranges' clock) in which the truth is wrong: not judged; may be "
        "given more than once",
    )
    add_clocks(group)
    group.add_argument(
        "--align",
        choices=("none", "position", "yaw", "se3"),
        help="estimate the truth's world frame from the matched positions, as evo does; default "
        "none",
    )


def _add_output(group: Any) -> None:
    group.add_argument(
        "--track",
        metavar="F",
        help="the track, with --smooth the smoothed one: TUM where F ends in .tum or .txt, else "
        ".csv with covariance, NIS and rank",
    )
    group.add_argument("--plot", metavar="F", help="picture of the track and the errors")
    add_html(group, "3-D page of the track with charts and tables")
    add_json(group)


def _add_number(group: Any, name: str, text: str) -> None:
    group.add_argument(name, type=float, metavar="X", help=text)


def _replay(options: argparse.Namespace) -> int:
    from rbl_gym import recordings
    from rbl_gym.studies import replay

    check_html(options)
    if options.track:
        recordings.check_track_path(options.track)
    settings = _settings(options)
    runs = read_runs(options)
    # Report errors before the work begins.
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

    if options.plot or options.html or options.track:
        raise ValueError(
            f"--plot, --html and --track are of one run, and {options.ranges} has {len(runs)}, "
            f"{[*runs]!r:.200}: choose one by --run"
        )
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
    from rbl_gym import estimators
    from rbl_gym.studies import replay

    given = {
        name: getattr(options, name)
        for name in replay.Settings().flat()
        if getattr(options, name, None) is not None
    }
    given |= told_clocks(options)
    biases = {name: value for name, value in given.items() if name in _RAW}
    if options.raw:
        if options.calibration:
            raise ValueError("--raw means ranges without --calibration")
        biases = {**_RAW, **biases}
    filter = options.filter or ("iekf-imu" if options.imu else _filter_for(given, biases))
    name, _ = estimators.parse_filter(filter)
    if biases and name != "iekf-bias":
        raise ValueError(
            f"{name} knows no biases of that law: --raw and --bias-... are of iekf-bias"
        )
    of_log = [key for key in given if key.startswith(("constant_", "drift_"))]
    if of_log and name not in ("iekf-log", "iekf-imu"):
        option = of_log[0].replace("_", "-")
        raise ValueError(f"--{option} is of iekf-log, not of {name}")
    return replay.Settings.of(**{**given, **biases, "filter": filter})


def _filter_for(given: Mapping[str, Any], biases: Mapping[str, Any]) -> str:
    """Return a filter for the given inputs; without inputs, one that needs none."""
    if biases:
        return "iekf-bias"
    return "iekf" if "walk_m" in given or "walk_deg" in given else "iekf-log"


def _start(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (3, 4):
        raise argparse.ArgumentTypeError(f"must be x,y,z or x,y,z,yaw_deg, got {text!r}")
    return values


def _volume(text: str) -> tuple[float | None, ...]:
    """Parse six numbers separated by commas, some of which may be empty."""
    try:
        limits = [float(part) if part.strip() else None for part in text.split(",")]
    except ValueError:
        limits = []
    if len(limits) != 6:
        raise argparse.ArgumentTypeError(
            f"must be xmin,xmax,ymin,ymax,zmin,zmax in metres, got {text!r}"
        )
    return tuple(limits)
