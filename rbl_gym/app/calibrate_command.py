"""The command rbl-gym calibrate."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rbl_gym.app.reading_options import add_reading, read_runs
from rbl_gym.app.terminal import add_json, offset, print_files, progress, window, write_json


def add_calibrate(commands: Any) -> None:
    """The parser of ``rbl-gym calibrate``."""
    calibrate = commands.add_parser(
        "calibrate",
        help="biases of links, lever arms, clock and noise from a recording with truth",
        description="Calibrate radios by a recording with truth. See docs/calibration.md.",
    )
    add_reading(calibrate)
    _add_links(calibrate.add_argument_group("what is estimated"))
    _add_truth(calibrate.add_argument_group("the truth"))
    output = calibrate.add_argument_group("output")
    output.add_argument(
        "--out", metavar="DIR", help="folder of calibration.csv and tags.csv, which replay reads"
    )
    output.add_argument("--plot", metavar="F", help="picture of the links and their residuals")
    add_json(output)
    calibrate.set_defaults(run=_calibrate)


def _add_links(group: Any) -> None:
    group.add_argument(
        "--model",
        dest="biases",
        choices=("auto", "link", "node", "common"),
        help="biases of every link, of every anchor and tag (antenna delays), or one of all; "
        "default auto: of links that have ranges enough, else of nodes",
    )
    group.add_argument(
        "--no-slopes",
        dest="slopes",
        action="store_false",
        default=None,
        help="ranges grow as distances do",
    )
    group.add_argument(
        "--arms",
        dest="tags_model",
        choices=("held", "turned", "free"),
        help="the table of tags holds; is turned and shifted as a whole (default); or every tag is "
        "found by itself",
    )
    group.add_argument(
        "--planar",
        action="store_true",
        default=None,
        help="a body in a level plane: only the heading of the truth is read",
    )
    group.add_argument(
        "--height-offset-m",
        type=float,
        metavar="X",
        help="of the tags' mean height below the anchors', where the truth has no heights",
    )


def _add_truth(group: Any) -> None:
    group.add_argument(
        "--time-offset",
        type=offset,
        metavar="S",
        help="how far the truth's clock is ahead of that of the ranges, seconds; default auto: "
        "found, up to 1 s",
    )
    group.add_argument(
        "--truth-gap-s", type=float, metavar="X", help="longest gap that is bridged, default 0.5"
    )
    group.add_argument(
        "--truth-exclude",
        type=window,
        action="append",
        metavar="START:END",
        help="seconds (of the ranges' clock) in which the truth is wrong; may be given more than "
        "once",
    )


def _calibrate(options: argparse.Namespace) -> int:
    from rbl_gym.studies import calibrate

    if options.truth is None:
        raise ValueError("--truth is missing: links are calibrated by truth")
    if options.calibration is not None:
        raise ValueError("calibrate takes ranges as the radios gave them, without --calibration")
    names = ("biases", "slopes", "planar", "height_offset_m", "time_offset", "truth_gap_s")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.tags_model:
        given["tags"] = options.tags_model
    if options.truth_exclude:
        given["truth_exclude"] = tuple(options.truth_exclude)
    settings = calibrate.LinkSettings(**given)
    runs = read_runs(options)
    with progress("calibrate", 4) as advance:
        found = calibrate.calibrate_links(runs, settings, advance)
    files = {}
    if options.out:
        folder = Path(options.out)
        files = {name: str(folder / f"{name}.csv") for name in ("calibration", "tags")}
        calibrate.write_link_table(files["calibration"], found.fit, *found[3:5])
        calibrate.write_points(files["tags"], "tag", found.tag_ids, found.fit.tags)
    if options.plot:
        from rbl_gym.app import calibrate_figures, figures

        figures.save_figure(calibrate_figures.links_figure(found), options.plot)
    if write_json(found.figures, options.json):
        from rbl_gym.app import calibrate_report

        calibrate_report.print_links(found.figures)
        print_files(**files, picture=options.plot)
    return 0
