"""The command line: rbl-gym demo, replay, reproduce."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rbl_gym import __version__


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status (2: what came in is wrong, with a message)."""
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except MissingExtraError as error:
        print(f"rbl-gym: {error}", file=sys.stderr)
    except (ValueError, OSError) as error:
        print(f"rbl-gym {options.command}: {error}", file=sys.stderr)
    return 2


class MissingExtraError(Exception):
    """A library is missing that one of the extras installs."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rbl-gym", description="Localization of rigid bodies by radio."
    )
    parser.add_argument("--version", action="version", version=f"rbl-gym {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    _add_demo(commands)
    _add_replay(commands)
    _add_reproduce(commands)
    return parser


def _add_demo(commands: Any) -> None:
    demo = commands.add_parser(
        "demo",
        help="the tracking paper's experiment: five filters against the bound",
        description="Monte-Carlo tracking of a rigid body (CAMSAP 2013): a table, a picture.",
    )
    _add_trials(demo)
    demo.add_argument("--plot", default="out/demo.png", metavar="F", help="default out/demo.png")
    _add_json(demo)
    demo.set_defaults(run=_demo)


def _add_reproduce(commands: Any) -> None:
    from rbl_gym.app.papers import experiments

    reproduce = commands.add_parser(
        "reproduce",
        help="an experiment of a paper: tables, figures, CSV",
        description="; ".join(f"{name}: {e.summary}" for name, e in experiments().items()),
    )
    reproduce.add_argument("experiment", choices=sorted(experiments()))
    _add_trials(reproduce)
    reproduce.add_argument("--plot", metavar="F", help="default out/EXPERIMENT.png")
    reproduce.add_argument("--csv", metavar="F", help="every figure as a row")
    _add_json(reproduce)
    reproduce.set_defaults(run=_reproduce)


def _add_trials(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--trials", type=_positive, default=1000, help="default 1000")
    parser.add_argument("--seed", type=_natural, default=0, help="of all randomness, default 0")


def _add_replay(commands: Any) -> None:
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
        default=0.0,
        metavar="X",
        help="of the tags' plane below the anchors', with --planar",
    )
    replay.add_argument(
        "--yaw-offset-deg",
        type=float,
        default=0.0,
        metavar="X",
        help="yaw error = estimate - (truth + offset)",
    )
    replay.add_argument("--filter", default="iekf", metavar="NAME", help="default iekf")
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
    replay.add_argument("--no-robust", action="store_true", help="squares in place of Huber's loss")
    replay.add_argument("--plot", metavar="F", help="picture of the track and the errors")
    _add_json(replay)
    replay.set_defaults(run=_replay)  # fmt: skip


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", nargs="?", const="-", metavar="F",
                        help="write the figures as JSON to F; without F, to standard output "
                        "in place of the table")  # fmt: skip


def _demo(options: argparse.Namespace) -> int:
    from rbl_gym.app import camsap2013

    with progress("tracking", camsap2013.work_units()) as advance:
        result = camsap2013.run(options.trials, options.seed, advance)
    from rbl_gym.app import figures, reports

    figures.save(figures.camsap2013(result, camsap2013.example(options.seed)), options.plot)
    if write_json(result, options.json):
        reports.print_camsap2013(result)
        print(f"picture: {options.plot}")
    return 0


def _reproduce(options: argparse.Namespace) -> int:
    from rbl_gym.app import camsap2013, papers

    experiment = papers.experiments()[options.experiment]
    with progress(options.experiment, experiment.work_units) as advance:
        result = experiment.run(options.trials, options.seed, advance)
    from rbl_gym.app import figures, reports

    plot = options.plot or f"out/{options.experiment}.png"
    if options.experiment == "camsap2013":
        figure = figures.camsap2013(result, camsap2013.example(options.seed))
    else:
        figure = figures.static(result)
    figures.save(figure, plot)
    if options.csv:
        papers.write_csv(result, options.csv)
    if write_json(result, options.json):
        report = reports.print_camsap2013 if "readings" in result else reports.print_static
        report(result)
        print(f"picture: {plot}")
    return 0


def _replay(options: argparse.Namespace) -> int:
    from rbl_gym import recordings
    from rbl_gym.app import replay

    settings = replay.Settings(
        filter=options.filter,
        range_std_m=options.range_std_m,
        walk_m=options.walk_m,
        walk_deg=options.walk_deg,
        robust=not options.no_robust,
        planar=options.planar,
        height_offset_m=options.height_offset_m,
        yaw_offset_deg=options.yaw_offset_deg,
    )
    recording = recordings.read_recording(
        options.ranges, options.anchors, options.tags, options.truth, options.calibration
    )
    replay.make_filter(recording, settings)  # a wrong name is said before the work begins
    with progress("replay", len(recording.times)) as advance:
        track = replay.run(recording, settings, advance)
    found = replay.errors(recording, track, settings)
    result = replay.figures(recording, track, found, settings)
    if write_json(result, options.json):
        from rbl_gym.app import reports

        reports.print_replay(result)
    if options.plot:
        from rbl_gym.app import figures

        figures.save(figures.replay(recording, track, found), options.plot)
    return 0


@contextlib.contextmanager
def progress(label: str, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar on standard error; yields the function that advances it."""
    try:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
    except ImportError as error:
        raise MissingExtraError(
            "this command needs the extra cli: pip install 'rbl-gym[cli]'"
        ) from error
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(label, total=total)
        yield lambda: bar.advance(task)


def write_json(result: dict[str, Any], target: str | None) -> bool:
    """Write figures where asked; returns whether standard output is free for a table."""
    if target is None:
        return True
    text = json.dumps(result, indent=1, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
        return False
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    Path(target).write_text(text, encoding="utf-8")
    return True


def _positive(text: str) -> int:
    value = _natural(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must be at least 1, got 0")
    return value


def _natural(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be a whole number, not negative, got {text!r}")
    return value
