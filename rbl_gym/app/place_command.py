"""The command rbl-gym place."""

from __future__ import annotations

import argparse
import json
from typing import Any

from rbl_gym.app.plan_options import (
    add_plan_options,
    add_report_options,
    check_report_options,
    read_problem,
    write_report,
)
from rbl_gym.app.terminal import (
    BOX,
    add_html,
    add_json,
    add_plot,
    add_trials,
    box,
    check_html,
    natural,
    positive,
    print_files,
    progress,
    write_json,
)


def add_place(commands: Any) -> None:
    """Add the parser of ``rbl-gym place``."""
    place = commands.add_parser(
        "place",
        help="design anchor positions and predict the accuracy of the pose",
        description="Design a layout of anchors, predict its accuracy, compare it with the usual "
        "layouts and check it with filters. See docs/placement.md for the file format.",
    )
    scene = place.add_mutually_exclusive_group(required=True)
    text = "a named scene, a building file .toml or .json, or a plan .dxf, .geojson, .png, .jpg"
    scene.add_argument("scene", nargs="?", metavar="NAME|F", help=text)
    scene.add_argument(
        "--scene", dest="scene_", metavar="NAME|F", help="the scene, in place of NAME|F"
    )
    place.add_argument(
        "--anchors",
        type=_numbers,
        metavar="N|A..B",
        help=(
            "number of anchors; A..B: accuracy for each number, or with --fewest the allowed "
            "numbers"
        ),
    )
    place.add_argument(
        "--fewest",
        action="store_true",
        help="find the least number of anchors that meets the requirements of all zones",
    )
    place.add_argument(
        "--survive",
        type=int,
        choices=(0, 1),
        default=0,
        help="1: the search and the results assume that any one anchor may fail; default 0",
    )
    place.add_argument(
        "--layout",
        metavar="F",
        help="evaluate the layout in a CSV file with columns x_m, y_m, z_m, name",
    )
    place.add_argument(
        "--optimise",
        action="store_true",
        help="optimise the layout of --layout; with more --anchors, add anchors to it",
    )
    place.add_argument(
        "--keep",
        metavar="NAMES",
        help=(
            "anchors of --layout that stay in place: names or numbers, separated by commas; or all"
        ),
    )
    place.add_argument(
        "--start",
        choices=("search", "amortised"),
        default="search",
        help="search (default): search over layouts; amortised: start from the layout of a "
        "trained network and evaluate the score at most 20 times",
    )
    place.add_argument(
        "--racks",
        type=natural,
        default=0,
        metavar="K",
        help="number of random boxes that block the line of sight in a named room, default 0",
    )
    place.add_argument(
        "--region",
        type=_region,
        metavar=BOX,
        help="work region, metres; also its corners x0,y0,z0,x1,y1,z1 (write --region=-1,... if "
        "the first number is negative)",
    )
    place.add_argument(
        "--details", action="store_true", help="print all tables, and what their columns mean"
    )
    add_trials(place, 500, "number of trials of the check with filters")
    add_plot(place, "with maps over the plan, and layouts")
    add_html(place, "page with the plan, its maps, the tables and the scene in 3-D")
    add_report_options(place)
    add_json(place)
    add_plan_options(place)
    place.add_argument(
        "--schema", action=_Schema, nargs=0, help="print the JSON schema of building files and exit"
    )
    place.set_defaults(run=_place)


def _place(options: argparse.Namespace) -> int:
    options.scene = options.scene or options.scene_
    check_html(options)
    check_report_options(options)
    from rbl_gym.placement import scene_files
    from rbl_gym.studies.placing import answer

    layout = _layout(options)
    numbers = options.anchors
    if numbers is None and layout is not None:
        numbers = range(len(layout.positions), len(layout.positions) + 1)
    problem = read_problem(options, numbers[-1] if numbers else None)
    if numbers is None:
        least = max(scene_files.MIN_ANCHORS, len(problem.fixed))
        most = scene_files.MAX_ANCHORS if options.fewest else problem.n_anchors
        numbers = range(least if options.fewest else most, most + 1)
    scene_files.check_n_anchors(numbers[0])
    question = answer.Question(
        numbers,
        options.fewest,
        None if layout is None else layout.positions,
        () if layout is None else layout.names,
        options.optimise,
        _kept(options.keep, layout),
        options.survive,
        options.seed,
        options.trials,
        options.start,
    )
    with progress("placing") as advance:
        placed = answer.place_anchors(problem, question, advance)
    if options.plot:
        from rbl_gym.app import figures, place_figures

        figures.save_figure(place_figures.place_figure(placed), options.plot)
    if options.html:
        from rbl_gym.app import place_html

        place_html.write_place(placed, options.html)
    write_report(placed, options)
    if write_json(placed.result, options.json):
        from rbl_gym.app import place_summary

        place_summary.print_place(placed.result, options.details)
        layout = ", ".join(options.export)
        print_files(picture=options.plot, page=options.html, report=options.report, layout=layout)
    return 0


class _Schema(argparse.Action):
    """Print the JSON schema of a building file, for editors, and exit."""

    def __call__(self, parser: Any, *_: Any) -> None:
        from rbl_gym.placement.file_schema import schema

        print(json.dumps(schema(), indent=1))
        parser.exit()


def _layout(options: argparse.Namespace) -> Any:
    """Return the anchors of --layout, or None; check options that need or exclude it."""
    if options.layout is None:
        for name in ("optimise", "keep"):
            if getattr(options, name):
                raise ValueError(f"--{name} needs --layout")
        return None
    if options.fewest:
        raise ValueError("--fewest searches for a layout: leave out --layout")
    if options.keep and not options.optimise:
        raise ValueError("--keep needs --optimise: otherwise the whole layout stays")
    if options.anchors is not None and not options.optimise:
        raise ValueError(
            "--anchors with --layout needs --optimise: otherwise the anchors of the layout are "
            "evaluated"
        )
    from rbl_gym.placement.layout_files import read_layout

    return read_layout(options.layout)


def _kept(names: str | None, layout: Any) -> tuple[int, ...]:
    """Return indices of the anchors of a layout that stay."""
    if names is None:
        return ()
    if names.strip() == "all":
        return tuple(range(len(layout.names)))
    known = {str(k + 1): k for k in range(len(layout.names))}
    known |= {name: k for k, name in enumerate(layout.names)}
    asked = [name.strip() for name in names.split(",")]
    for name in asked:
        if name not in known:
            raise ValueError(
                f"--keep must name anchors of the layout, {', '.join(layout.names)}; got {name!r}"
            )
    return tuple(sorted({known[name] for name in asked}))


def _numbers(text: str) -> range:
    """Parse N or A..B as a range."""
    first, dots, last = text.partition("..")
    try:
        numbers = range(positive(first), positive(last if dots else first) + 1)
    except argparse.ArgumentTypeError:
        numbers = range(0)
    if not numbers:
        raise argparse.ArgumentTypeError(
            f"must be N or A..B, positive whole numbers with A at most B, got {text!r}"
        )
    return numbers


def _region(text: str) -> tuple[list[float], list[float]]:
    """Parse `BOX`, or six numbers, as two corners."""
    if (pairs := box(text)) is not None:
        if any(None in pair for pair in pairs):
            raise argparse.ArgumentTypeError(f"must have six limits, {BOX}, got {text!r}")
        return [float(pair[0] or 0) for pair in pairs], [float(pair[1] or 0) for pair in pairs]
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise argparse.ArgumentTypeError(
            f"must be {BOX}, or the corners x0,y0,z0,x1,y1,z1, got {text!r}"
        )
    if not all(low <= high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
        raise argparse.ArgumentTypeError(
            f"must be the corner x0,y0,z0 and the opposite, larger one, or {BOX}, got {text!r}"
        )
    return numbers[:3], numbers[3:]
