"""Options of `plan` and `place` about floor plans: reading them, and the report."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rbl_gym.extras import require

if TYPE_CHECKING:
    from rbl_gym.placement.plans.drawing import Drawing

_PICTURES = (".png", ".jpg", ".jpeg")
_HELP = {
    "walls": "lines that weaken links: name, material (as in material=concrete), thickness_m, "
    "side_by_side_m (largest distance of two lines that are one wall)",
    "obstacles": "areas that weaken links and where the body cannot be: name, material, low_m, "
    "high_m",
    "zones": "areas where the body works, and what they require: name, low_m, high_m, weight, "
    "attitude (free, level or heading), position_m, height_m, heading_deg, share",
    "mounts": "where anchors may be mounted: kind (wall, ceiling, column, area or points), low_m, "
    "high_m, height_m, side, cost",
    "forbidden": "areas where no anchor may be mounted",
    "fixed": "points of fixed anchors: height_m",
}


def add_plan_options(parser: argparse.ArgumentParser) -> None:
    """Add the options about a drawing or a picture."""
    plan = parser.add_argument_group(
        "floor plan",
        "For a drawing (.dxf, .geojson) or a picture (.png, .jpg). Each of the first six options "
        "says what a layer of a drawing is, as LAYER,KEY=VALUE,...; * in LAYER matches any "
        "letters; each may be given several times. Without the option, layers of that name (walls, "
        "zones, ...) are used. The keys are listed after the colon.",
    )
    for kind, text in _HELP.items():
        plan.add_argument(f"--{kind}", action="append", default=[], metavar="LAYER", help=text)
    plan.add_argument(
        "--units",
        metavar="U",
        help="unit of the drawing: mm, cm, m, km, in, ft or degrees; default: the unit that a DXF "
        "states, metres for GeoJSON",
    )
    plan.add_argument(
        "--zero",
        type=_pair,
        metavar="X,Y",
        help="point of the drawing, in its units, that becomes the origin (0, 0)",
    )
    plan.add_argument(
        "--layer-property",
        metavar="P",
        help="GeoJSON property with the name of the layer; default: layer, kind or class",
    )
    plan.add_argument(
        "--height",
        type=float,
        default=3.0,
        metavar="M",
        help="height of the room, metres, default 3",
    )
    plan.add_argument(
        "--picture", metavar="F", help="picture to show behind the drawing or the building"
    )
    plan.add_argument(
        "--metres-per-pixel", type=float, metavar="M", help="scale of the picture: metres per pixel"
    )
    plan.add_argument(
        "--width",
        type=float,
        metavar="M",
        help="width of the picture in metres, instead of --metres-per-pixel",
    )
    plan.add_argument(
        "--origin",
        type=_pair,
        default=(0.0, 0.0),
        metavar="X,Y",
        help="position of the lower left corner of the picture, metres; default 0,0",
    )


class Plan(NamedTuple):
    """A plan that was read: tables of a building file, layers and their meanings."""

    tables: dict[str, Any]
    said: list[str]
    used: dict[str, list[str]]
    drawing: Drawing | None


def is_plan(path: str) -> bool:
    """Return whether a file is a drawing or a picture, not a building file."""
    suffix = Path(path).suffix.lower()
    if suffix != ".json":
        return suffix in (".dxf", ".dwg", ".geojson", *_PICTURES)
    with Path(path).open("rb") as file:
        return b'"Feature' in file.read(4096)


def read_plan(path: str, options: argparse.Namespace, n_anchors: int | None = None) -> Plan:
    """Return the plan of a file and the options; a ValueError says what is wrong."""
    from rbl_gym.placement.plans import layers, pictures, reading, uses

    told = [uses.parse_use(kind, text) for kind in uses.KINDS for text in getattr(options, kind)]
    if not 0 < options.height < float("inf"):
        raise ValueError(f"--height must be positive, got {options.height:g}")
    n_anchors = 8 if n_anchors is None else n_anchors
    if Path(path).suffix.lower() in _PICTURES:
        if told:
            raise ValueError(f"{path}: a picture has no layers: leave out --{told[0].kind}")
        shown = pictures.backdrop(path, scale(path, options), options.origin)
        made = pictures.of_picture(shown, options.height, n_anchors)
        return Plan(made.tables, made.said, made.used, None)
    found = reading.read_drawing(path, options.units, options.zero, options.layer_property)
    made = layers.building(found, told, options.height, n_anchors)
    if options.picture:
        made.tables["plan"] |= picture(options)
    return Plan(made.tables, [*found.said, *made.said], made.used, found)


def read_problem(options: argparse.Namespace, n_anchors: int | None) -> Any:
    """Return the `Problem` of --scene: a named scene, a building file, or a plan with layers."""
    from rbl_gym.placement import building, scene_files
    from rbl_gym.placement.plans import layers, toml_text

    path = options.scene
    if not is_plan(path):
        told = [kind for kind in _HELP if getattr(options, kind)]
        if told:
            raise ValueError(f"--{told[0]} needs a drawing, .dxf or .geojson, got {path}")
        problem = scene_files.problem(path, n_anchors, options.region, options.racks, options.seed)
        if options.picture:
            plan = problem.plan or building.Plan()
            problem = dataclasses.replace(problem, plan=plan._replace(**picture(options)))
        return problem
    if options.racks:
        raise ValueError(f"--racks must be left out with a plan, got {options.racks}")
    plan = read_plan(path, options, n_anchors)
    for line in plan.said:
        print(f"{path}: {line}", file=sys.stderr)
    tables = toml_text.plain(plan.tables)
    try:
        found = scene_files.of_mapping(tables, n_anchors, options.region, Path(path).stem)
        return dataclasses.replace(found, notes=(layers.ASSUMED, *found.notes))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def add_report_options(parser: argparse.ArgumentParser) -> None:
    """Add the options --report and --export."""
    parser.add_argument(
        "--report",
        metavar="F",
        help="PDF report with the answer, plan, maps, mounting list and tables",
    )
    parser.add_argument(
        "--export",
        action="append",
        default=[],
        metavar="F",
        help="file of the layout: .csv (mounting list), .geojson, or .dxf (a copy of the drawing "
        "with the anchors); may be given several times",
    )


def check_report_options(options: argparse.Namespace) -> None:
    """Raise ValueError before the work if a file cannot be written in its format."""
    from rbl_gym.studies.placing.layout_export import SUFFIXES

    for path in options.export:
        if not path.lower().endswith(SUFFIXES):
            raise ValueError(f"--export must end in one of {', '.join(SUFFIXES)}, got {path}")
        if path.lower().endswith(".dxf"):
            require("ezdxf", "placement", "a drawing (.dxf)")
    if options.report and not options.report.lower().endswith(".pdf"):
        raise ValueError(f"--report must end in .pdf, got {options.report}")


def write_report(placed: Any, options: argparse.Namespace) -> None:
    """Write the files of --report and --export."""
    if options.report:
        from rbl_gym.app import place_pdf

        place_pdf.write_pdf(placed, options.report)
    if options.export:
        from rbl_gym.studies.placing import layout_export

        names = [str(row["name"]) for row in placed.result["anchors"]]
        for path in options.export:
            layout_export.write_layout(placed.problem, placed.design.anchors, path, names)


def picture(options: argparse.Namespace) -> dict[str, Any]:
    """Return the table [plan] of the option --picture."""
    from rbl_gym.placement.plans import pictures

    return pictures.backdrop(options.picture, scale(options.picture, options), options.origin)


def scale(path: str, options: argparse.Namespace) -> float:
    """Return metres per pixel; raises ValueError if invalid."""
    from rbl_gym.placement.plans import pictures

    if (options.metres_per_pixel is None) == (options.width is None):
        raise ValueError(f"{path}: a picture needs either --metres-per-pixel or --width")
    if options.metres_per_pixel is not None:
        return options.metres_per_pixel
    return options.width / pictures.pixels(path)[0]


def _pair(text: str) -> tuple[float, float]:
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be X,Y, got {text!r}") from None
    return x, y
