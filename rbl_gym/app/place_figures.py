"""The picture of a placement: accuracy maps in plan, the answer, the usual layouts."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from rbl_gym.app import place_answer, place_draw
from rbl_gym.app import place_shapes as shapes
from rbl_gym.checks import FloatArray
from rbl_gym.placement.scene_files import Problem
from rbl_gym.studies.placing.accuracy import Map
from rbl_gym.studies.placing.answer import Placed
from rbl_gym.studies.placing.tape import slabs_of

DESIGNED, USUAL, OTHER = "#0072b2", "#9db4c0", "#d55e00"
# Width of a map in the picture, its largest height, height of a chart alone: inches.
_WIDE, _TALL, _CHART = 5.7, 6.0, 2.4

styled = matplotlib.rc_context({"font.size": 9, "axes.titlesize": 10, "axes.labelsize": 8})


@styled
def place_figure(placed: Placed) -> Figure:
    """Draw one sheet: verdicts, maps of the required quantities, zones in words, a chart."""
    problem, anchors, result = placed.problem, placed.design.anchors, placed.result
    maps = shapes.maps_of(placed)
    panels = map_panels(problem)
    tall = map_height(problem, anchors)
    heights = [tall] * ((len(panels) + 1) // 2)
    # A chart in its own row is lower than a map.
    if len(panels) % 2 == 0:
        heights.append(_CHART)
    size = (14, sum(heights) + 0.75 * len(heights) + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
    groups = []
    for index, quantity in enumerate(panels):
        axes = figure.add_subplot(grid[index // 2, index % 2])
        groups.append((axes, map_panel(axes, placed, maps, quantity, index == 0)))
    axes = figure.add_subplot(grid[-1, len(panels) % 2 :])
    draw_chart(axes, result)
    sign = place_answer.SIGNS[result["verdict"]].strip("-")
    title = f"{result['scene']}   {sign}   {place_answer.headline(result)}"
    figure.suptitle(title, fontsize=13)
    figure.supxlabel(legend_text(problem), fontsize=8, color="0.35")
    place_draw.settle_labels(figure, groups)
    return figure


@styled
def building_figure(problem: Problem) -> Figure:
    """Draw the building alone with a metre grid, to check how it was read."""
    nothing = np.empty((0, 3))
    figure = Figure(figsize=(11, 0.9 * map_height(problem, nothing, 9.0) + 1.2))
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    for zone in problem.zones:
        axes.fill(*zone.polygon.T, color="#dcecf7", zorder=0)
    place_draw.draw_building(axes, problem, nothing)
    edges = shapes.limits(problem, nothing)
    step = next(s for s in (1, 2, 5, 10, 20, 50, 100, 1e9) if np.ptp(edges, axis=0).max() / s < 25)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(step))
    axes.grid(color="0.6", lw=0.4, zorder=0.5)
    axes.plot(*problem.fixed[:, :2].T, "s", ms=7, color=place_draw.KEPT, mec="white", zorder=7)
    axes.set_title(f"{problem.name}: the building as read, a grid line every {step:g} m")
    figure.supxlabel(legend_text(problem), fontsize=8, color="0.35")
    return figure


def map_panels(problem: Problem) -> list[shapes.Quantity]:
    """Return the shown maps: the requirement if there is one, and each quantity."""
    first = [REQUIREMENT] if shapes.has_requirement(problem) else []
    return first + shapes.quantities(problem)


REQUIREMENT = shapes.Quantity("relative", "requirement", "", None)


def map_height(problem: Problem, anchors: FloatArray, wide: float = _WIDE) -> float:
    """Return the height of a map of this width, inches."""
    width, height = np.ptp(shapes.limits(problem, anchors), axis=0)
    return float(np.clip(wide * height / width, 2.8, _TALL))


def map_panel(
    axes: Any, placed: Placed, maps: list[Map], quantity: shapes.Quantity, heights: bool
) -> list[Any]:
    """Draw one map with its title; return the labels of the anchors."""
    problem, anchors = placed.problem, placed.design.anchors
    shown = shapes.layers(problem, maps, quantity.field)
    case = place_answer.case_of_maps(placed.result)
    case, between = (f"\n{case}", ", ") if case else ("", ", ")
    if quantity.field == "relative":
        place_draw.draw_verdict(axes, shown)
        title = f"where the requirements are met{case}"
        axes.legend(
            handles=place_draw.verdict_handles(shown),
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=3,
            frameon=False,
            fontsize=8,
            borderaxespad=0.1,
        )
        axes.set_title(title, pad=22)
    else:
        place_draw.draw_map(axes, shown, quantity)
        levels = sorted({f"{one.at:.3g}" for one in maps}, key=float)
        at = levels[0] if len(levels) == 1 else f"{levels[0]} to {levels[-1]}"
        limited = any(
            (layer.values > (quantity.limit_of(layer.zone) or np.inf)).any() for layer in shown
        )
        title = f"error of {quantity.name} at z = {at} m{case}"
        axes.set_title(title + (f"{between}hatched: beyond the requirement" if limited else ""))
    place_draw.draw_building(axes, problem, anchors, names=heights)
    return place_draw.draw_anchors(axes, problem, anchors, anchor_names(placed), heights)


def anchor_names(placed: Placed) -> list[str]:
    """Return the names of the anchors."""
    return [str(row["name"]) for row in placed.result["anchors"]]


def legend_text(problem: Problem) -> str:
    """Return the legend of a plan."""
    parts = ["triangles: anchors, by number"]
    if len(problem.fixed):
        parts.append("squares: fixed anchors")
    parts += ["dashed: zones", "violet: where anchors may be mounted"]
    if problem.obstacles:
        parts.append("grey: obstacles, darker if they weaken links more")
    if any(shapes.is_overhead(problem, solid) for solid in shapes.solids_in_plan(problem)):
        parts.append("dotted: overhead")
    if slabs_of(problem):
        parts.append("dotted brown: slabs")
    return "     ".join(parts)


def draw_chart(axes: Any, result: dict[str, Any]) -> None:
    """Draw accuracy against the number of anchors, or the usual layouts."""
    if "against_number" in result:
        _draw_numbers(axes, result["against_number"])
    elif result["verdict"] == "no requirement":
        _draw_scores(axes, result["layouts"])
    else:
        _draw_margins(axes, result)


def _draw_scores(axes: Any, rows: dict[str, dict[str, Any]]) -> None:
    """Draw b of every layout, the best on top."""
    names = list(rows)[::-1]
    values = [rows[name]["score_m"] for name in names]
    texts = [f"{rows[name]['score_m']:.3g} m  (x {rows[name]['ratio']:.2f})" for name in names]
    own = _own(rows)
    # A bad layout must not hide differences of the good ones.
    edge = min(1.12 * max(values), 4.0 * rows[own]["score_m"])
    _draw_bars(axes, names, values, texts, own, edge)
    axes.set_xlabel("b, root mean square error of the tags over all zones [m]")
    axes.set_title("this layout and the usual ones")


def _draw_margins(axes: Any, result: dict[str, Any]) -> None:
    """Draw the margin of every layout to the requirements, the best on top."""
    rows = result["layouts"]
    # The design was evaluated at more positions than the others.
    own = _own(rows)
    zones = {name: row["zones"] for name, row in rows.items()} | {own: result["zones"]}
    margins = {
        name: min(zone["margin"] for zone in found if "margin" in zone)
        for name, found in zones.items()
    }
    names = sorted(margins, key=margins.__getitem__)
    verdicts = {name: row["verdict"] for name, row in rows.items()}
    verdicts[own] = result["verdict"]
    texts = [f"{margins[name]:.2f}  {place_answer.SIGNS[verdicts[name]]}" for name in names]
    values = [margins[name] for name in names]
    _draw_bars(axes, names, values, texts, own, 1.45 * max(1.0, *values))
    axes.axvline(1.0, color="0.2", lw=1.2, ls=(0, (4, 2)))
    label = "margin: allowed over predicted error, in the worst zone; 1 or more is enough"
    # Exchanges are for requirements.
    if result["method"].startswith("search") and "exchanges for" not in result["method"]:
        label += (
            "\nThe search minimised b, not this margin: every layout marked PASS meets all "
            "requirements."
        )
    axes.set_xlabel(label)
    case = ", with any one anchor missing" if result["survive"] else ""
    axes.set_title(f"margins of this layout and of the usual ones{case}")


def _own(rows: dict[str, dict[str, Any]]) -> str:
    """Return the layout of the report."""
    return "designed" if "designed" in rows else "given"


def _draw_bars(
    axes: Any, names: list[str], values: list[float], texts: list[str], own: str, edge: float
) -> None:
    places = np.arange(len(names))
    colours = [DESIGNED if name == own else USUAL for name in names]
    axes.barh(places, values, color=colours, height=0.7)
    axes.set_xlim(0, edge)
    for place, value, text in zip(places, values, texts, strict=True):
        inside = value > 0.75 * edge
        axes.annotate(
            text + (" >" if value > edge else ""),
            (min(value, edge), place),
            xytext=(-5 if inside else 5, 0),
            textcoords="offset points",
            ha="right" if inside else "left",
            va="center",
            fontsize=8,
            color="white" if inside and names[place] == own else "black",
            bbox=None if inside else {"fc": "white", "ec": "none", "pad": 1.0},
            zorder=4,
        )
    axes.set_yticks(places, names)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_numbers(axes: Any, rows: list[dict[str, float]]) -> None:
    """Draw accuracy against the number of anchors."""
    numbers = [int(row["n_anchors"]) for row in rows]
    other = axes.twinx()
    for ax, key, unit, colour in (
        (axes, "position", "m", DESIGNED),
        (other, "rotation", "deg", OTHER),
    ):
        if rows[0][f"{key}_median_{unit}"] is None:
            ax.set_yticks([])
            continue
        for what, style in (("median", "o-"), ("p95", "s--"), ("worst", "^:")):
            if f"{key}_{what}_{unit}" not in rows[0]:
                continue
            values = [row[f"{key}_{what}_{unit}"] for row in rows]
            label = what if ax is axes else None
            ax.plot(numbers, values, style, color=colour, ms=4.5, lw=1.4, label=label)
        name = "orientation" if key == "rotation" else key
        ax.set_ylabel(f"{name}, one sigma [{unit}]", color=colour)
        ax.set_ylim(bottom=0)
        ax.spines[["top"]].set_visible(False)
    axes.set_xticks(numbers)
    axes.set_xlabel("anchors")
    axes.grid(alpha=0.25, lw=0.5)
    axes.legend(frameon=False, fontsize=8)
    axes.set_title("accuracy against the number of anchors")
