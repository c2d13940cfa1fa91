"""The command rbl-gym replay."""

from __future__ import annotations

import argparse
from typing import Any

from rbl_gym.app.terminal import (
    add_html,
    add_json,
    check_html,
    print_files,
    progress,
    write_json,
)


def add_replay(commands: Any) -> None:
    """The parser of ``rbl-gym replay``."""
    replay = commands.add_parser(
        "replay",
        help="a recording of ranges through a filter",
        description="Track a recorded body; with --truth, the errors. All files are CSV; "
        "see docs/recordings.md for their columns.",
    )
    for name, text in (
        ("ranges", "t,anchor,tag,range[,std,valid] or t,a0t0,a0t1,..."),
        ("anchors", "anchor,x,y,z"),
        ("tags", "tag,x,y,z"),
    ):
        replay.add_argument(f"--{name}", required=True, metavar="F", help=text)
    replay.add_argument("--truth", metavar="F", help="t,x,y,z,qw,qx,qy,qz or t,x,y[,z],yaw_deg")
    replay.add_argument("--calibration", metavar="F", help="anchor,tag,bias_m,slope")
    replay.add_argument("--planar", action="store_true", help="hold height, roll and pitch")
    replay.add_argument(
        "--height-offset-m",
        type=float,
        metavar="X",
        help="of the tags' mean height below the anchors', with --planar; default 0 where the "
        "anchors stand at one height",
    )
    replay.add_argument(
        "--yaw-offset-deg",
        type=float,
        default=0.0,
        metavar="X",
        help="yaw error = estimate - (truth + offset)",
    )
    replay.add_argument(
        "--truth-gap-s",
        type=float,
        default=0.5,
        metavar="X",
        help="longest gap that is bridged between truth and ranges, default 0.5",
    )
    replay.add_argument(
        "--volume",
        type=_volume,
        metavar="xmin,xmax,ymin,ymax,zmin,zmax",
        help="where the body's origin may be, metres: tells a pose from its mirror image; empty "
        "where there is no limit, as in --volume=,,,,,1.8; write --volume=-1,... for a minus",
    )
    replay.add_argument(
        "--below-anchors",
        action="store_true",
        help="the body stays below the anchors' mean height",
    )
    replay.add_argument("--filter", metavar="NAME", help="default iekf, iekf-bias with a bias")
    replay.add_argument(
        "--range-std-m",
        type=float,
        metavar="X",
        help="of a range; default the recording's own, else 0.12",
    )
    replay.add_argument(
        "--walk-m",
        type=float,
        default=0.1,
        metavar="X",
        help="random walk of the position after 1 s, default 0.1",
    )
    replay.add_argument(
        "--walk-deg",
        type=float,
        default=7.0,
        metavar="X",
        help="random walk of the rotation after 1 s, default 7",
    )
    replay.add_argument(
        "--bias-std-m",
        type=float,
        metavar="X",
        help="filter iekf-bias: of a link's bias, default 0.02, with --raw 0.05",
    )
    replay.add_argument(
        "--bias-time-s",
        type=float,
        metavar="X",
        help="how long a bias lasts, default 3, with --raw for ever",
    )
    replay.add_argument(
        "--bias-common-m",
        type=float,
        metavar="X",
        help="of the bias that all links have in common, default 0, with --raw 0.1",
    )
    replay.add_argument(
        "--raw",
        action="store_true",
        help="ranges of radios that nobody calibrated: iekf-bias learns the biases that stay",
    )
    replay.add_argument(
        "--accel-m",
        type=float,
        default=0.5,
        metavar="X",
        help="filter iekf-cv: change of the speed (m/s) after 1 s, default 0.5",
    )
    replay.add_argument(
        "--accel-deg",
        type=float,
        default=30.0,
        metavar="X",
        help="filter iekf-cv: change of the turn rate (deg/s) after 1 s, default 30",
    )
    replay.add_argument("--no-robust", action="store_true", help="squares in place of Huber's loss")
    replay.add_argument("--plot", metavar="F", help="picture of the track and the errors")
    add_html(replay, "3-D page of the track with charts and tables")
    add_json(replay)
    replay.set_defaults(run=_replay)


def _replay(options: argparse.Namespace) -> int:
    from rbl_gym import recordings
    from rbl_gym.studies import replay

    check_html(options)
    settings = replay.Settings(
        **_bias(options),
        range_std_m=options.range_std_m,
        walk_m=options.walk_m,
        walk_deg=options.walk_deg,
        accel_m=options.accel_m,
        accel_deg=options.accel_deg,
        robust=not options.no_robust,
        planar=options.planar,
        height_offset_m=options.height_offset_m,
        yaw_offset_deg=options.yaw_offset_deg,
        volume=options.volume,
        below_anchors=options.below_anchors,
        truth_gap_s=options.truth_gap_s,
    )
    recording = recordings.read_recording(
        options.ranges, options.anchors, options.tags, options.truth, options.calibration
    )
    # What is wrong is said before the work begins.
    replay.check_replay(recording, settings)
    with progress("replay", len(recording.times)) as advance:
        replayed = replay.replay_recording(recording, settings, advance)
    if options.plot:
        from rbl_gym.app import figures

        figures.save_figure(figures.replay_figure(recording, replayed), options.plot)
    if options.html:
        from rbl_gym.app import page, track_pages

        page.write(track_pages.replay_page(recording, replayed), options.html)
    if write_json(replayed.figures, options.json):
        from rbl_gym.app import reports

        reports.print_replay(replayed.figures)
        print_files(picture=options.plot, page=options.html)
    return 0


def _bias(options: argparse.Namespace) -> dict[str, Any]:
    """The filter's name and the law of the biases, from what was said of either."""
    given = {
        name: getattr(options, name)
        for name in ("bias_std_m", "bias_time_s", "bias_common_m")
        if getattr(options, name) is not None
    }
    if options.raw:
        if options.calibration:
            raise ValueError("--raw means ranges without --calibration")
        given = {"bias_std_m": 0.05, "bias_time_s": None, "bias_common_m": 0.1, **given}
    name = options.filter or ("iekf-bias" if given else "iekf")
    if given and name != "iekf-bias":
        raise ValueError(f"{name} knows no biases: --raw and --bias-... are of iekf-bias")
    return {"filter": name, **given}


def _volume(text: str) -> tuple[float | None, ...]:
    """Six numbers with commas, some of which may be empty."""
    try:
        limits = [float(part) if part.strip() else None for part in text.split(",")]
    except ValueError:
        limits = []
    if len(limits) != 6:
        raise argparse.ArgumentTypeError(
            f"must be xmin,xmax,ymin,ymax,zmin,zmax in metres, got {text!r}"
        )
    return tuple(limits)
