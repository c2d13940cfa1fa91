"""The command line: demo, place, train, bench, convert, replay, calibrate, reproduce, network."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

from rbl_gym import __version__
from rbl_gym.app import bench_command, calibrate_command, convert_command, learning, replay_command
from rbl_gym.app.terminal import (
    add_html,
    add_json,
    add_trials,
    check_html,
    natural,
    positive,
    print_files,
    progress,
    write_json,
)
from rbl_gym.studies.extras import MissingExtraError, require


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status (2: what came in is wrong, with a message)."""
    options = _parser().parse_args(arguments)
    # MODULE:FACTORY may be a file of the working folder, which only `python -m` would search.
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        return options.run(options)
    except MissingExtraError as error:
        print(f"rbl-gym: {error}", file=sys.stderr)
    except OSError as error:
        said = f"{error.filename}: {error.strerror}" if error.filename else error
        print(f"rbl-gym {options.command}: {said}", file=sys.stderr)
    except ValueError as error:
        print(f"rbl-gym {options.command}: {error}", file=sys.stderr)
    return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rbl-gym", description="Localization of rigid bodies by radio."
    )
    parser.add_argument("--version", action="version", version=f"rbl-gym {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    _add_demo(commands)
    _add_place(commands)
    learning.add_train(commands)
    learning.add_evaluate(commands)
    learning.add_transfer(commands)
    bench_command.add_bench(commands)
    bench_command.add_rerun(commands)
    convert_command.add_convert(commands)
    replay_command.add_replay(commands)
    calibrate_command.add_calibrate(commands)
    _add_reproduce(commands)
    _add_network(commands)
    return parser


def _add_demo(commands: Any) -> None:
    demo = commands.add_parser(
        "demo",
        help="the tracking paper's experiment: five filters against the bound",
        description="Monte-Carlo tracking of a rigid body (CAMSAP 2013): a table, a picture.",
    )
    add_trials(demo)
    demo.add_argument("--plot", default="out/demo.png", metavar="F", help="default out/demo.png")
    add_html(demo, "3-D page of a trial, charts and tables")
    add_json(demo)
    demo.set_defaults(run=_demo)


def _add_place(commands: Any) -> None:
    place = commands.add_parser(
        "place",
        help="where anchors go, and how good the pose will be",
        description="Design a layout of anchors, predict the accuracy, compare with the usual "
        "layouts, check with real filters. See docs/placement.md for the file format.",
    )
    place.add_argument(
        "--scene", required=True, metavar="NAME|F", help="a named scene, or a file .toml or .json"
    )
    place.add_argument(
        "--anchors",
        type=_numbers,
        metavar="N|A..B",
        help="how many; A..B: accuracy against the number",
    )
    place.add_argument(
        "--racks",
        type=natural,
        default=0,
        metavar="K",
        help="random boxes that block sight in a named room, default 0",
    )
    place.add_argument(
        "--region",
        type=_region,
        metavar="x0,y0,z0,x1,y1,z1",
        help="work region, metres; write --region=-1,... for a minus",
    )
    add_trials(place, 500, "of the check, ")
    place.add_argument("--plot", metavar="F", help="picture: maps, side view, layouts")
    add_html(place, "3-D page with the tables")
    add_json(place)
    place.set_defaults(run=_place)


def _add_reproduce(commands: Any) -> None:
    from rbl_gym.app.papers import experiments

    reproduce = commands.add_parser(
        "reproduce",
        help="an experiment of a paper, or our own: tables, figures, CSV",
        description="; ".join(f"{name}: {e.summary}" for name, e in experiments().items()),
    )
    reproduce.add_argument("experiment", choices=sorted(experiments()))
    add_trials(reproduce)
    reproduce.add_argument("--plot", metavar="F", help="default out/EXPERIMENT.png")
    reproduce.add_argument("--csv", metavar="F", help="every figure as a row")
    network = reproduce.add_argument_group("network2009")
    network.add_argument(
        "--positions", metavar="F", help="CSV, header x,y: fixed points, the reference first"
    )
    network.add_argument(
        "--footprint",
        dest="footprints",
        metavar="R",
        type=float,
        nargs="+",
        help="sensing radii, in the unit of the positions",
    )
    network.add_argument(
        "--variance",
        metavar="S2",
        type=float,
        help="of a bearing, rad^2; default 0.1, in Figs 5 and 6 0.01",
    )
    add_json(reproduce)
    reproduce.set_defaults(run=_reproduce)


def _add_network(commands: Any) -> None:
    network = commands.add_parser(
        "network",
        help="orientations of a planar network or pose graph",
        description="Maximum-likelihood orientations from edge angles, their cost, and whether "
        "it is proved that none are better. See docs/networks.md for the file formats.",
    )
    network.add_argument("file", metavar="FILE", help=".g2o, or CSV: i,j and dtheta (or a,b)")
    network.add_argument(
        "--weights",
        choices=("information", "unit"),
        default="information",
        help="of the edges: the file's information of theta (default), or all alike",
    )
    network.add_argument("--plot", metavar="F", help="picture: the graph and the residuals")
    add_json(network)
    network.set_defaults(run=_network)


def _demo(options: argparse.Namespace) -> int:
    from rbl_gym.studies.papers import camsap2013

    check_html(options)
    with progress("tracking") as advance:
        result = camsap2013.tracking_experiment(options.trials, options.seed, advance)
    from rbl_gym.app import figures, reports

    example = camsap2013.example(options.seed)
    figures.save_figure(figures.camsap2013_figure(result, example), options.plot)
    if options.html:
        from rbl_gym.app import page, track_pages

        page.write(track_pages.demo_page(result, example), options.html)
    if write_json(result, options.json):
        reports.print_camsap2013(result)
        print_files(picture=options.plot, page=options.html)
    return 0


def _reproduce(options: argparse.Namespace) -> int:
    from rbl_gym.app import papers

    experiment = papers.experiments()[options.experiment]
    named = ("positions", "footprints", "variance")
    given = {name: getattr(options, name) for name in named if getattr(options, name) is not None}
    if wrong := [name for name in given if name not in experiment.options]:
        raise ValueError(f"{options.experiment} takes no {' and no '.join(wrong)}")
    with progress(options.experiment) as advance:
        result = experiment.run(options.trials, options.seed, advance, **given)
    from rbl_gym.app import figures

    plot = options.plot or f"out/{options.experiment}.png"
    figures.save_figure(experiment.figure(result, options.seed), plot)
    if options.csv:
        papers.write_csv(result, options.csv)
    if write_json(result, options.json):
        experiment.show(result)
        print_files(picture=plot)
    return 0


def _network(options: argparse.Namespace) -> int:
    from rbl_gym.studies import network

    solved = network.solve_network(options.file, options.weights)
    if options.plot:
        from rbl_gym.app import figures, network_figures

        figures.save_figure(network_figures.network_figure(solved), options.plot)
    if write_json(solved.result, options.json):
        from rbl_gym.app import network_figures

        network_figures.print_network(solved.result)
        print_files(picture=options.plot)
    return 0


def _place(options: argparse.Namespace) -> int:
    require("cmaes", "placement")
    check_html(options)
    from rbl_gym.placement import scene_files
    from rbl_gym.studies.placing import design as place

    numbers = options.anchors
    problem = scene_files.problem(
        options.scene, numbers[-1] if numbers else None, options.region, options.racks, options.seed
    )
    numbers = numbers or range(problem.task.n_anchors, problem.task.n_anchors + 1)
    scene_files.check_n_anchors(numbers[0])
    with progress("placing") as advance:
        placed = place.place_anchors(problem, numbers, options.seed, options.trials, advance)
    if options.plot:
        from rbl_gym.app import figures, place_figures

        figures.save_figure(place_figures.place_figure(placed), options.plot)
    if options.html:
        from rbl_gym.app import place_html

        place_html.write_place(placed, options.html)
    if write_json(placed.result, options.json):
        from rbl_gym.app import place_report

        place_report.print_place(placed.result)
        print_files(picture=options.plot, page=options.html)
    return 0


def _numbers(text: str) -> range:
    """N or A..B as a range."""
    first, dots, last = text.partition("..")
    numbers = range(positive(first), positive(last if dots else first) + 1)
    if not numbers:
        raise argparse.ArgumentTypeError(f"must rise from A to B, got {text!r}")
    return numbers


def _region(text: str) -> tuple[list[float], list[float]]:
    """Six numbers as two corners."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise argparse.ArgumentTypeError(f"must be six numbers x0,y0,z0,x1,y1,z1, got {text!r}")
    return numbers[:3], numbers[3:]
