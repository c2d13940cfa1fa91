"""The command rbl-gym place."""

from __future__ import annotations

import argparse
import json
from typing import Any

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
from rbl_gym.studies.extras import require


def add_place(commands: Any) -> None:
    """The parser of ``rbl-gym place``."""
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
    place.add_argument(
        "--schema", action=_Schema, nargs=0, help="print the JSON schema of the file, and stop"
    )
    place.set_defaults(run=_place)


def _place(options: argparse.Namespace) -> int:
    require("cmaes", "placement")
    check_html(options)
    from rbl_gym.placement import scene_files
    from rbl_gym.studies.placing import design as place

    numbers = options.anchors
    problem = scene_files.problem(
        options.scene, numbers[-1] if numbers else None, options.region, options.racks, options.seed
    )
    numbers = numbers or range(problem.n_anchors, problem.n_anchors + 1)
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


class _Schema(argparse.Action):
    """Prints the JSON schema of a building file, for editors, and ends the program."""

    def __call__(self, parser: Any, *_: Any) -> None:
        from rbl_gym.placement.file_schema import schema

        print(json.dumps(schema(), indent=1))
        parser.exit()


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
