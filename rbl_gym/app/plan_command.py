"""The command rbl-gym plan."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rbl_gym.app.plan_options import add_plan_options, is_plan, picture, read_plan
from rbl_gym.app.terminal import add_json, add_plot, positive, print_files, write_json
from rbl_gym.extras import MissingExtraError


def add_plan(commands: Any) -> None:
    """Add the parser of ``rbl-gym plan``."""
    plan = commands.add_parser(
        "plan",
        help="convert a floor plan (DXF, GeoJSON, PNG) to a building file for place",
        description="Write a building file (TOML, for you to edit) from the layers of a drawing, "
        "or from a picture. Without --out: show the layers. See docs/placement.md.",
    )
    plan.add_argument(
        "plan", metavar="FILE", help="a .dxf, .geojson, .png or .jpg file, or a building file"
    )
    plan.add_argument("-o", "--out", metavar="F", help="name of the building file, .toml")
    plan.add_argument("--anchors", type=positive, metavar="N", help="number of anchors, default 8")
    add_plot(plan, "of the building as read, with a grid in metres")
    add_plan_options(plan)
    add_json(plan)
    plan.set_defaults(run=_plan)


def _plan(options: argparse.Namespace) -> int:
    from rbl_gym.app import plan_report
    from rbl_gym.placement import scene_files
    from rbl_gym.placement.plans import layers as plan_layers
    from rbl_gym.placement.plans import toml_text

    path, assumed = options.plan, list[str]()
    if is_plan(path):
        plan = read_plan(path, options, options.anchors)
        tables, said, layers = plan.tables, plan.said, plan_report.layer_rows(plan)
        assumed.append(plan_layers.ASSUMED)
    elif not path.lower().endswith((".toml", ".json")):
        raise ValueError(
            f"{path}: must be a drawing (.dxf, .geojson), a picture (.png, .jpg) or a building "
            "file (.toml, .json)"
        )
    elif options.out:
        raise ValueError(f"{path}: --out needs a drawing or a picture, got a building file")
    else:
        tables, said, layers = scene_files.load(path), [], []
        if options.picture:
            tables["plan"] = tables.get("plan", {}) | picture(options)
    if options.out:
        if not options.out.lower().endswith(".toml"):
            raise ValueError(f"--out must end in .toml, got {options.out}")
        plan_report.write_building(tables, path, said, options.out)
    problem, doubts = _problem(tables, path, must=bool(options.plot))
    said = [*said, *assumed, *doubts]
    result = {"plan": path, "layers": layers, "said": said, "tables": toml_text.plain(tables)}
    if options.plot:
        from rbl_gym.app import figures, place_figures

        figures.save_figure(place_figures.building_figure(problem), options.plot)
    if write_json(result, options.json):
        plan_report.print_plan(layers, said)
        print_files(building=options.out, picture=options.plot)
    return 0


def _problem(tables: dict[str, Any], path: str, must: bool) -> tuple[Any, list[str]]:
    """Return the problem of the tables, and notes on it; None if it is invalid and not needed."""
    from rbl_gym.placement import scene_files
    from rbl_gym.placement.plans import toml_text

    try:
        problem = scene_files.of_mapping(toml_text.plain(tables), name=Path(path).stem)
    except (ValueError, MissingExtraError) as error:
        if must:
            raise
        return None, [f"not ready for rbl-gym place: {error}"]
    return problem, list(problem.notes)
