"""The command rbl-gym studio."""

from __future__ import annotations

import argparse
from typing import Any

from rbl_gym.app.plan_options import add_plan_options, is_plan, read_plan, read_problem
from rbl_gym.app.terminal import add_seed, natural, positive
from rbl_gym.studies.extras import require


def add_studio(commands: Any) -> None:
    """The parser of ``rbl-gym studio``."""
    studio = commands.add_parser(
        "studio",
        help="take anchors by the hand: a page in the browser",
        description="Open a page on which anchors are dragged while a map of the accuracy follows. "
        "Whoever can open the page can change the layout and save into the folder.",
    )
    studio.add_argument(
        "scene",
        metavar="SCENE|FILE",
        help="a named scene, a building file .toml or .json, or a plan .dxf, .geojson, .png, .jpg",
    )
    studio.add_argument("--anchors", type=positive, metavar="N", help="how many, to begin with")
    studio.add_argument("--layout", metavar="F", help="anchors to begin with: a CSV file")
    studio.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="H",
        help="address to listen on, default 127.0.0.1: this machine alone",
    )
    studio.add_argument(
        "--port", type=natural, default=8080, help="the first that is tried, default 8080; 0: any"
    )
    studio.add_argument(
        "--folder", default=".", metavar="D", help="where files are saved, default the working one"
    )
    add_seed(studio, "of all searches")
    studio.add_argument("--no-browser", action="store_true", help="print the address alone")
    add_plan_options(studio)
    studio.set_defaults(run=_studio, region=None, racks=0)


def _studio(options: argparse.Namespace) -> int:
    require("viser", "studio")
    from rbl_gym import studio
    from rbl_gym.placement.layout_files import read_layout
    from rbl_gym.studio.opening import Options

    layout = read_layout(options.layout).positions if options.layout else None
    count = options.anchors if layout is None else len(layout)
    page = studio.show(
        read_problem(options, count),
        layout,
        tables=_tables(options, count),
        options=Options(
            options.host,
            options.port,
            options.folder,
            options.seed,
            not options.no_browser,
            _write_report,
        ),
    )
    print(f"{page.url}   (Ctrl-C ends it)", flush=True)
    page.wait()
    return 0


def _tables(options: argparse.Namespace, count: int | None) -> dict[str, Any] | None:
    """The tables of the file or plan that was opened; None: a named scene."""
    from rbl_gym.placement import scene_files
    from rbl_gym.placement.plans import toml_text

    if is_plan(options.scene):
        return toml_text.plain(read_plan(options.scene, options, count).tables)
    if options.scene.lower().endswith((".toml", ".json")):
        return scene_files.load(options.scene)
    return None


def _write_report(problem: Any, anchors: Any, path: str) -> None:
    """The report of a layout, as `rbl-gym place --layout F --report` writes it."""
    from rbl_gym.app import place_pdf
    from rbl_gym.studies.placing import answer

    count = len(anchors)
    question = answer.Question(range(count, count + 1), layout=anchors)
    place_pdf.write_pdf(answer.place_anchors(problem, question), path)
