"""The command rbl-gym calibrate."""

from __future__ import annotations

import argparse
import os
from typing import Any

from rbl_gym.app.reading_options import add_reading, read_runs
from rbl_gym.app.terminal import (
    add_json,
    add_plot,
    offset,
    print_files,
    progress,
    window,
    write_json,
)


def add_calibrate(commands: Any) -> None:
    """Add the parser of ``rbl-gym calibrate``."""
    calibrate = commands.add_parser(
        "calibrate",
        help="with truth: estimate biases, tag positions, clock offset and noise; without: survey "
        "the anchors",
        description="With --truth: estimate biases and scale errors of links, tag positions, the "
        "clock offset, noise, and biases that depend on the direction of the ray; with --imu also "
        "the axes of the inertial sensor. Without --truth: estimate the anchor positions from the "
        "ranges of a moving body. See docs/calibration.md.",
    )
    add_reading(calibrate)
    _add_plane(calibrate.add_argument_group("knowledge of the body's position"))
    with_truth = calibrate.add_argument_group("model of the links (with --truth)")
    _add_links(with_truth)
    _add_directions(with_truth)
    _add_truth(calibrate.add_argument_group("the truth"))
    _add_anchors(calibrate.add_argument_group("survey of the anchors (without --truth)"))
    output = calibrate.add_argument_group("output")
    output.add_argument(
        "--out", metavar="DIR", help="folder for calibration.csv, tags.csv, ..., which replay reads"
    )
    add_plot(output, "of the biases and residuals of the links")
    add_json(output)
    calibrate.set_defaults(run=_calibrate)


def _add_links(group: Any) -> None:
    group.add_argument(
        "--model",
        dest="biases",
        choices=("auto", "link", "node", "common"),
        help="link: one bias for each link; node: one for each anchor and each tag (antenna "
        "delays); common: one for all links; auto (default): link if each link has enough ranges, "
        "else node",
    )
    group.add_argument(
        "--no-slopes",
        dest="slopes",
        action="store_false",
        default=None,
        help="estimate no scale errors of the ranges",
    )
    group.add_argument(
        "--arms",
        dest="tags_model",
        choices=("held", "turned", "free"),
        help="positions of the tags. held: the table is exact; turned (default): a turn and a "
        "shift of the whole table are estimated; free: every position is estimated",
    )


def _add_directions(group: Any) -> None:
    group.add_argument(
        "--harmonics",
        type=int,
        metavar="N",
        help="estimate a bias that depends on the direction of the ray in the body frame, a "
        "Fourier series of its bearing with at most N harmonics; cross-validation chooses the "
        "number; default 0: no such bias",
    )
    group.add_argument(
        "--ends",
        choices=("tags", "both"),
        help=(
            "bias of --harmonics by the direction at the tags (default), or at both ends, if "
            "the anchors are on a body too"
        ),
    )


def _add_plane(group: Any) -> None:
    group.add_argument(
        "--planar",
        action="store_true",
        default=None,
        help="the body moves in a level plane: only the heading of the truth is used, and anchors "
        "keep their heights",
    )
    group.add_argument(
        "--height-offset-m",
        type=float,
        metavar="X",
        help=(
            "depth of the tags below the anchors (difference of the mean heights), metres; "
            "if the truth has no heights, this or --height-m is needed"
        ),
    )
    group.add_argument(
        "--height-m",
        type=float,
        metavar="X",
        help="with --truth: height of the body's origin, metres, if the truth has no heights",
    )


def _add_truth(group: Any) -> None:
    group.add_argument(
        "--time-offset",
        type=offset,
        metavar="S",
        help="how far the clock of the truth is ahead of the clock of the ranges, seconds; "
        "default auto: estimated, up to 1 s",
    )
    group.add_argument(
        "--truth-gap-s",
        type=float,
        metavar="X",
        help="longest gap of the truth that is interpolated, seconds, default 0.5",
    )
    group.add_argument(
        "--truth-exclude",
        type=window,
        action="append",
        metavar="START:END",
        help="interval with wrong truth, seconds by the clock of the ranges; may be given several "
        "times",
    )


def _add_anchors(group: Any) -> None:
    group.add_argument(
        "--start",
        choices=("table", "ranges"),
        help=(
            "table (default): start from the rough positions in --anchors; ranges: start from "
            "the ranges alone"
        ),
    )
    group.add_argument(
        "--known",
        type=_names,
        metavar="ID,ID,...",
        help="anchors whose positions in --anchors are exact",
    )
    group.add_argument(
        "--anchor-ranges", metavar="F", help="ranges between anchors: anchor_a,anchor_b,range"
    )
    for name, text in (
        ("--bias-m", "bias common to all ranges, metres, default 0"),
        ("--bias-std-m", "standard deviation of the common bias, metres, default 0.5"),
        (
            "--link-std-m",
            "standard deviation of the bias of each link, beside the common bias, metres, default "
            "0.05",
        ),
    ):
        group.add_argument(name, type=float, metavar="X", help=text)


_WITH_TRUTH = {
    "biases": "--model",
    "slopes": "--no-slopes",
    "tags_model": "--arms",
    "harmonics": "--harmonics",
    "ends": "--ends",
    "height_m": "--height-m",
    "time_offset": "--time-offset",
    "truth_gap_s": "--truth-gap-s",
    "truth_exclude": "--truth-exclude",
}
_WITHOUT = {
    "start": "--start",
    "known": "--known",
    "bias_m": "--bias-m",
    "bias_std_m": "--bias-std-m",
    "link_std_m": "--link-std-m",
    "anchor_ranges": "--anchor-ranges",
}


def _calibrate(options: argparse.Namespace) -> int:
    for name in ("calibration", "directions"):
        if getattr(options, name) is not None:
            raise ValueError(f"calibrate estimates the corrections itself: leave out --{name}")
    if options.imu_frame is not None:
        raise ValueError("calibrate estimates the axes of --imu: leave out --imu-frame")
    if options.imu is not None and not options.truth:
        raise ValueError("--imu needs --truth")
    mine, others = (_WITH_TRUTH, _WITHOUT) if options.truth else (_WITHOUT, _WITH_TRUTH)
    if options.height_m is not None and not options.truth:
        raise ValueError(
            "--height-m needs --truth; a survey with --planar takes --height-offset-m, the depth "
            "of the tags below the anchors"
        )
    if wrong := [option for name, option in others.items() if getattr(options, name) is not None]:
        raise ValueError(
            f"{wrong[0]} {'must be left out with' if options.truth else 'needs'} --truth"
        )
    names = [*mine, "planar", "height_offset_m"]
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    found = (_links if options.truth else _anchors)(options, given)
    files = found.write(options.out) if options.out else {}
    if options.imu is not None:
        files |= _inertial(options, found.figures)
    if options.plot:
        from rbl_gym.app import calibrate_figures, figures

        figures.save_figure(calibrate_figures.figure_of(found), options.plot)
    if write_json(found.figures, options.json):
        from rbl_gym.app import calibrate_report

        calibrate_report.print_calibrated(found.figures)
        print_files(**files, picture=options.plot)
    return 0


def _links(options: argparse.Namespace, given: dict[str, Any]) -> Any:
    from rbl_gym.studies import calibrate

    if "tags_model" in given:
        given["tags"] = given.pop("tags_model")
    if "truth_exclude" in given:
        given["truth_exclude"] = tuple(given["truth_exclude"])
    settings = calibrate.LinkSettings(**given)
    runs = read_runs(options)
    with progress("calibrate", 4) as advance:
        return calibrate.calibrate_links(runs, settings, advance)


def _inertial(options: argparse.Namespace, figures: dict[str, Any]) -> dict[str, str]:
    """Add axes and clock of the inertial sensor to the figures; return the written file."""
    from rbl_gym.studies import calibrate

    longest = max(read_runs(options).values(), key=lambda run: len(run.times))
    assert longest.inertial is not None
    assert longest.truth is not None
    found = calibrate.calibrate_inertial(longest.inertial, longest.truth)
    clock, told = figures.get("time_offset"), options.time_offset
    ahead = clock["offset_s"] if clock else told if isinstance(told, float) else 0.0
    figures["inertial"] = calibrate.inertial_figures(found, ahead)
    if not options.out:
        return {}
    path = os.path.join(options.out, "imu_frame.csv")
    calibrate.write_frame(path, found.turn.rotation)
    return {"imu_frame": path}


def _anchors(options: argparse.Namespace, given: dict[str, Any]) -> Any:
    from rbl_gym.studies import calibrate

    path = given.pop("anchor_ranges", None)
    settings = calibrate.AnchorSettings(**given)
    runs = read_runs(options)
    if len(runs) > 1:
        raise ValueError(
            f"a survey needs a single run, but {options.ranges} has {len(runs)}, "
            f"{[*runs]!r:.200}: choose one by --run"
        )
    (recording,) = runs.values()
    pairs = None if path is None else calibrate.read_anchor_ranges(path, recording.anchor_ids)
    with progress("calibrate", 3) as advance:
        return calibrate.survey_anchors(recording, settings, pairs, advance)


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))
